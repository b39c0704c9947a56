"""Convergence noise: against dense operators, exact sums over all lags, and many drawn records."""

import importlib.util
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from coslidar.pipeline import convergence, correlation
from coslidar.pipeline.geometry import MAP_KINDS, Geometry

_spec = importlib.util.spec_from_file_location(
    "bench_convergence", Path(__file__).parents[2] / "benchmarks" / "bench_convergence.py"
)
bench = importlib.util.module_from_spec(_spec)
sys.modules["bench_convergence"] = bench
_spec.loader.exec_module(bench)

SCINDAR = bench.SCINDAR
SMALL = Geometry(((1, 1, 0), (1, 1, 1)), 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
SINGLE = Geometry(((1, 1, 0), (1, 1, 1)), 0.07, 2670.0, 3.8e-6, ((0.0, 0.0),))


#: Pairs as measured: the processes drawn here are not the same all over the pupil, unless a test says so.
as_measured = partial(convergence.lagged, homogeneous=False)


def covariance_of_channels(geometry, seed=0):
    """Any covariance with everything correlated, in realistic units."""
    size = 3 * geometry.n_sources * geometry.n_subapertures
    mix = np.random.default_rng(seed).standard_normal((size, size))
    unit = np.repeat([2e-6, 3e-6, 0.1], size // 3)
    return (mix @ mix.T / size + np.eye(size)) * np.outer(unit, unit)


def relative(found, expected):
    unit = np.sqrt(np.diagonal(expected))
    return (found - expected) / np.outer(unit, unit)


def maps_of(slopes, flux, geometry):
    found = correlation.finalise(correlation.accumulate(slopes, flux), geometry)
    return correlation.data_vector(found.maps)[geometry.independent]


def zero_separations(geometry):
    """Rows of the data vector with the zero separation of the auto maps of x, y and i."""
    entries = geometry.pair_count.size
    return np.array([MAP_KINDS.index(f"{kind}_auto") for kind in ("xx", "yy", "ii")]) * entries + entries // 2


@pytest.mark.parametrize("geometry", [SCINDAR, SMALL, SINGLE], ids=["scindar", "small", "single"])
def test_independent_form_is_the_trace_of_dense_operators(geometry):
    matrix = covariance_of_channels(geometry)
    products = bench.operators(geometry) @ matrix
    rows = len(products)
    expected = 2 / 500 * products.reshape(rows, -1) @ products.swapaxes(1, 2).reshape(rows, -1).T
    found = convergence.independent(matrix, 500, geometry)
    unit = np.sqrt(np.diagonal(found))
    assert found.shape == (rows, rows) == (geometry.independent.size,) * 2
    # Both are sums of 1e3 products of order one.
    np.testing.assert_allclose(relative(found, expected), 0, atol=1e-12)
    np.testing.assert_array_equal(found, found.T)
    np.linalg.cholesky(found / np.outer(unit, unit))


def test_scindar_has_312_independent_data():
    assert convergence.independent(covariance_of_channels(SCINDAR), 10, SCINDAR).shape == (312, 312)


@pytest.mark.parametrize("missing", [0.0, 0.15], ids=["complete", "gaps"])
def test_independent_form_predicts_the_scatter_of_drawn_records(missing):
    frames, draws = 60, 3000
    matrix = covariance_of_channels(SMALL)
    rng = np.random.default_rng(1)
    factor = np.linalg.cholesky(matrix)
    maps = []
    for _ in range(draws):
        samples = (rng.standard_normal((frames, len(matrix))) @ factor.T).reshape(frames, 3, 2, 5)
        samples[rng.random(samples.shape) < missing] = np.nan
        # Large mean flux: the normalisation by the measured mean has a noise of its own.
        maps.append(maps_of(samples[:, :2], 1e6 * (1 + samples[:, 2] / 1e3), SMALL))
    scale = np.where(SMALL.independent // SMALL.pair_count.size >= 4, 1e6, 1.0)
    empirical = np.cov(np.array(maps).T * scale[:, None])
    valid = np.full((3, 2, 5), 1 - missing)
    # With the mean removed there are frames - 1 squares in a sum divided by frames.
    expected = convergence.independent(matrix, frames, SMALL, valid) * (frames - 1) / frames
    difference = relative(empirical, expected)
    # A sample is missing from its own square once, not twice: zero separations are predicted too large by 1 / v.
    centre = np.searchsorted(SMALL.independent, zero_separations(SMALL))
    np.testing.assert_allclose(np.diagonal(difference)[centre] + 1, 1 - missing, atol=0.05)
    others = np.setdiff1d(np.arange(len(difference)), centre)
    difference = difference[np.ix_(others, others)]
    # An element of the empirical matrix has a standard error of at most sqrt(2 / draws) = 0.026 in these units
    # (a few per cent more for sums of squares); 5 of them over 1,600 elements.
    assert np.abs(difference).max() < 5 * np.sqrt(2 / draws) * 1.2
    # The variances together are known ten times better.
    assert abs(np.diagonal(difference).mean()) < 0.03


def test_exact_process_covariance_agrees_with_its_definition():
    """The yardstick itself: sum over all pairs of frames of dense matrices, without any closed form."""
    rng = np.random.default_rng(0)
    process = bench.Process.turbulence(SMALL, 7, rng)
    frames, size = 14, 30
    step = np.arange(frames)[:, None] - np.arange(frames)[None, :]
    joint = np.zeros((frames, size, frames, size))
    for pattern, factor in zip(process.pattern.T, process.multiplier, strict=True):
        in_time = np.where(step >= 0, factor ** np.abs(step), factor.conj() ** np.abs(step))
        joint += np.einsum("ts,a,c->tasc", in_time, pattern, pattern.conj()).real
    joint[np.arange(frames), :, np.arange(frames), :] += np.diag(process.noise**2)
    removed = np.eye(frames) - 1 / frames
    joint = np.einsum("ut,tasc,sv->uavc", removed, joint, removed, optimize=True)
    unit = np.repeat([1e-5, 1e-5, 0.1], size // 3)
    matrices = bench.operators(SMALL)
    products = np.einsum("pab,tbsc->ptasc", matrices * np.outer(unit, unit), joint, optimize=True)
    rows = len(matrices)
    turned = products.transpose(0, 3, 4, 1, 2).reshape(rows, -1)
    expected = 2 / frames**2 * products.reshape(rows, -1) @ turned.T
    np.testing.assert_allclose(relative(process.covariance(frames, matrices), expected), 0, atol=1e-6)


def autoregression(factor, frames, records, rng, geometry=SMALL):
    """Records of channels that are independent of each other, x_t = factor x_{t-1} + white, unit variance."""
    channels = 3 * geometry.n_sources * geometry.n_subapertures
    samples = rng.standard_normal((records, frames, channels))
    samples[:, 1:] *= np.sqrt(1 - factor**2)
    for t in range(1, frames):
        samples[:, t] += factor * samples[:, t - 1]
    samples = samples.reshape(records, frames, 3, geometry.n_sources, geometry.n_subapertures)
    return samples[:, :, :2] * 1e-6, 1000 * (1 + 0.01 * samples[:, :, 2])


@pytest.mark.parametrize("factor", [0.0, 0.5, 0.9])
def test_first_order_autoregression(factor):
    """sum_l rho(l)^2 = (1 + factor^2) / (1 - factor^2) is the number of frames per independent one."""
    frames = 8192
    slopes, flux = autoregression(factor, frames, 6, np.random.default_rng(2))
    results = [as_measured(x, i, SMALL) for x, i in zip(slopes, flux, strict=True)]
    inflation = (1 + factor**2) / (1 - factor**2)
    effective = np.mean([result.n_effective for result in results], axis=0)
    # Ten independent channels and thousands of frames: 2 % of scatter at factor 0.9, less below.
    np.testing.assert_allclose(effective, frames / inflation, rtol=0.05)
    size = 30
    unit = np.repeat([1e-6, 1e-6, 0.01], size // 3)
    expected = inflation * convergence.independent(np.diag(unit**2), frames, SMALL)
    ratio = np.mean([np.diagonal(result.covariance) for result in results], axis=0) / np.diagonal(expected)
    # Six records; entries that rest on one pair of channels scatter by several per cent at factor 0.9.
    np.testing.assert_allclose(ratio, 1, atol=0.15)
    assert ratio.mean() == pytest.approx(1, abs=0.02)
    found = np.mean([relative(result.covariance, expected) for result in results], axis=0)
    np.testing.assert_allclose(found - np.diag(np.diagonal(found)), 0, atol=0.1)


def test_short_records_of_a_known_process():
    """Drawn records of a process with waves carried by the wind: prediction of each against the scatter of all."""
    frames, draws = 1024, 300
    rng = np.random.default_rng(3)
    process = bench.Process.turbulence(SMALL, 24, rng)
    exact = process.covariance(frames, bench.operators(SMALL))
    maps, estimates = [], []
    for number in range(draws):
        slopes, flux = process.draw(frames, rng)
        maps.append(maps_of(slopes, flux, SMALL))
        if number < 40:
            estimates.append(np.diagonal(as_measured(slopes, flux, SMALL).covariance))
    unit = np.sqrt(np.diagonal(exact))
    empirical = np.cov(np.array(maps).T / unit[:, None])
    by_map = SMALL.independent // SMALL.pair_count.size
    ratio = np.mean(estimates, axis=0) / np.diagonal(exact)
    for number, name in enumerate(MAP_KINDS):
        chosen = by_map == number
        # Few effective frames and 300 draws: maps of slow waves are far from normal, 10 to 20 % each.
        assert np.diagonal(empirical)[chosen].mean() == pytest.approx(1, abs=0.25), name
        # 40 estimates; those of slopes rest on a handful of slow waves in each record.
        assert ratio[chosen].mean() == pytest.approx(1, abs=0.12 if name.startswith("ii") else 0.5), name


def test_bias_of_few_ordinates_is_removed(monkeypatch):
    """One band of 15 ordinates: without the correction the variance is too large by its squared trace over 15."""
    frames, records = 32, 400
    slopes, flux = autoregression(0.0, frames, records, np.random.default_rng(4))
    corrected, raw = [], []
    for x, i in zip(slopes, flux, strict=True):
        corrected.append(np.diagonal(as_measured(x, i, SMALL).covariance))
    monkeypatch.setattr(convergence, "_squared_traces", lambda *arguments: 0.0)
    for x, i in zip(slopes, flux, strict=True):
        raw.append(np.diagonal(as_measured(x, i, SMALL).covariance))
    unit = np.repeat([1e-6, 1e-6, 0.01], 10)
    # 15 of 16 positive ordinates are used, the last one being real.
    expected = np.diagonal(convergence.independent(np.diag(unit**2), frames, SMALL)) * 15 / 16
    centre = np.searchsorted(SMALL.independent, zero_separations(SMALL))
    assert np.mean(raw, axis=0)[centre] / expected[centre] == pytest.approx(np.full(3, 1 + 10 / 15), abs=0.08)
    np.testing.assert_allclose(np.mean(corrected, axis=0) / expected, 1, atol=0.08)


def test_lagged_is_positive_definite_and_symmetric_even_for_short_records():
    rng = np.random.default_rng(5)
    process = bench.Process.turbulence(SCINDAR, 24, rng)
    for frames in (64, 200, 1500):
        found = as_measured(*process.draw(frames, rng), SCINDAR)
        unit = np.sqrt(np.diagonal(found.covariance))
        np.testing.assert_array_equal(found.covariance, found.covariance.T)
        assert np.linalg.eigvalsh(found.covariance / np.outer(unit, unit)).min() > 0
        assert np.all(found.n_effective > 0)
        assert np.all(found.n_effective < 1.2 * frames)


def test_single_precision_transform_is_accurate_enough(monkeypatch):
    rng = np.random.default_rng(6)
    slopes, flux = bench.Process.turbulence(SCINDAR, 48, rng).draw(6000, rng)
    single = as_measured(slopes, flux, SCINDAR).covariance
    monkeypatch.setattr(convergence.np, "float32", np.float64)
    double = as_measured(slopes, flux, SCINDAR).covariance
    assert np.abs(relative(single, double)).max() < 1e-5
    # Also in the directions that the inversion weights most.
    unit = np.sqrt(np.diagonal(double))
    values = np.linalg.eigvals(np.linalg.solve(double / np.outer(unit, unit), single / np.outer(unit, unit)))
    np.testing.assert_allclose(values, 1, atol=5e-3)


def test_gaps_make_the_noise_larger_as_drawn_records_show():
    frames, draws = 256, 800
    rng = np.random.default_rng(7)
    slopes, flux = autoregression(0.6, frames, draws, rng)
    gone = rng.random((draws, frames, 3, 2, 5)) < 0.3
    slopes[gone[:, :, :2]] = np.nan
    flux[gone[:, :, 2]] = np.nan
    maps = np.array([maps_of(x, i, SMALL) for x, i in zip(slopes, flux, strict=True)])
    estimates = np.mean(
        [np.diagonal(as_measured(x, i, SMALL).covariance) for x, i in zip(slopes[:80], flux[:80], strict=True)],
        axis=0,
    )
    ratio = estimates / maps.var(axis=0)
    centre = np.searchsorted(SMALL.independent, zero_separations(SMALL))
    others = np.setdiff1d(np.arange(ratio.size), centre)
    # A variance from 800 draws has 5 % of error, one estimate some 10 %; 57 rows.
    np.testing.assert_allclose(ratio[others], 1, atol=0.2)
    assert ratio[others].mean() == pytest.approx(1, abs=0.05)
    assert np.all((ratio[centre] > 1) & (ratio[centre] < 1 / 0.7))


def test_frames_lost_in_all_channels_are_on_the_safe_side():
    frames, draws = 256, 600
    rng = np.random.default_rng(8)
    slopes, flux = autoregression(0.6, frames, draws, rng)
    gone = rng.random((draws, frames)) < 0.2
    slopes[gone] = np.nan
    flux[gone] = np.nan
    maps = np.array([maps_of(x, i, SMALL) for x, i in zip(slopes, flux, strict=True)])
    estimates = np.mean(
        [np.diagonal(as_measured(x, i, SMALL).covariance) for x, i in zip(slopes[:60], flux[:60], strict=True)],
        axis=0,
    )
    ratio = np.mean(estimates / maps.var(axis=0))
    assert 0.97 < ratio < 1 / 0.8 + 0.05


def test_dead_channel_leaves_the_rows_that_others_measure():
    frames = 600
    rng = np.random.default_rng(9)
    (slopes,), (flux,) = autoregression(0.3, frames, 1, rng)
    slopes[:, 0, :, 0] = np.nan  # x slopes of the first subaperture, both sources
    flux[:, 1, 4] = 0.0
    reduced = correlation.finalise(correlation.accumulate(slopes, flux), SMALL)
    measured = np.isfinite(correlation.data_vector(reduced.maps)[SMALL.independent])
    assert not measured.all()
    alone = convergence.independent(reduced.covariance, frames, SMALL, reduced.valid_fraction)
    for found in (as_measured(slopes, flux, SMALL).covariance, alone):
        np.testing.assert_array_equal(np.isfinite(np.diagonal(found)), measured)
        kept = found[np.ix_(measured, measured)]
        unit = np.sqrt(np.diagonal(kept))
        np.linalg.cholesky(kept / np.outer(unit, unit))
    # Dense operators over the channels that are left.
    matrices = bench.operators(SMALL).reshape(-1, 30, 30)
    present = np.isfinite(np.diagonal(reduced.covariance))
    matrices = matrices * np.outer(present, present)
    before = bench.operators(SMALL)
    fraction = (matrices > 0).sum(axis=(1, 2)) / (before > 0).sum(axis=(1, 2))
    products = (matrices / np.where(fraction > 0, fraction, 1)[:, None, None]) @ np.nan_to_num(reduced.covariance)
    rows = len(products)
    expected = 2 / frames * products.reshape(rows, -1) @ products.swapaxes(1, 2).reshape(rows, -1).T
    chosen = np.ix_(measured, measured)
    np.testing.assert_allclose(relative(alone[chosen], expected[chosen]), 0, atol=1e-10)


def test_expand_repeats_the_autos_and_marks_what_is_not_measured():
    matrix = convergence.independent(covariance_of_channels(SCINDAR), 100, SCINDAR)
    full = convergence.expand(matrix, SCINDAR)
    assert full.shape == (486, 486)
    np.testing.assert_array_equal(np.isfinite(np.diagonal(full)), SCINDAR.valid)
    np.testing.assert_array_equal(full[np.ix_(SCINDAR.independent, SCINDAR.independent)], matrix)
    auto = full[:81, :81]
    np.testing.assert_array_equal(auto, auto[::-1])
    cross = full[162:243, 162:243]
    assert np.nanmax(np.abs(cross - cross[::-1])) > 0
    deviation = convergence.deviation_maps(matrix, SCINDAR)
    np.testing.assert_array_equal(deviation.ravel() ** 2 - np.diagonal(full) < 1e-18, SCINDAR.valid)
    single = convergence.independent(covariance_of_channels(SINGLE), 100, SINGLE)
    assert np.isnan(convergence.deviation_maps(single, SINGLE)[[2, 3, 5]]).all()


def test_faults_are_named():
    matrix = covariance_of_channels(SMALL)
    with pytest.raises(ValueError, match="must be \\(30, 30\\)"):
        convergence.independent(matrix[:5, :5], 10, SMALL)
    with pytest.raises(ValueError, match="no frame"):
        convergence.independent(matrix, 0, SMALL)
    with pytest.raises(ValueError, match="valid fraction"):
        convergence.independent(matrix, 10, SMALL, np.ones(3))
    (slopes,), (flux,) = autoregression(0.0, 40, 1, np.random.default_rng(0))
    with pytest.raises(ValueError, match="32 are needed"):
        as_measured(slopes[:20], flux[:20], SMALL)
    with pytest.raises(ValueError, match="the geometry"):
        as_measured(slopes, flux, SINGLE)
    with pytest.raises(ValueError, match="at least one frequency band"):
        as_measured(slopes, flux, SMALL, bands=0)
    for function in (convergence.expand, convergence.deviation_maps):
        with pytest.raises(ValueError, match="one row for each"):
            function(np.eye(3), SMALL)


def test_benchmark_runs_and_bands_agree_with_the_sum_over_lags(capsys):
    errors = bench.main(["--frames", "6000", "--records", "6", "--bands", "24", "--waves", "40"], SMALL)
    assert "24 bands" in capsys.readouterr().out
    assert np.abs(errors["24 bands"][4:]).max() < 0.1
    # What neglecting time would do.
    assert np.all(errors["independent"] < -0.5)


def test_correction_is_the_first_order_difference_of_two_halves():
    """One band of white noise: maps, covariances and the correction of Eq. (3) from dense operators and halves."""
    frames = 101
    (slopes,), (flux,) = autoregression(0.0, frames, 1, np.random.default_rng(12))
    found = as_measured(slopes, flux, SMALL, bands=1)
    series = np.concatenate([slopes.reshape(frames, -1), flux.reshape(frames, -1)], axis=1)
    series -= series.mean(axis=0)
    series[:, 20:] /= flux.reshape(frames, -1).mean(axis=0)
    unit = np.repeat([1e-6, 1e-6, 0.01], 10)
    ordinates = np.fft.rfft(series / unit, axis=0)[1:51]
    operators = bench.operators(SMALL) * np.outer(unit, unit)

    def seen(chosen):
        """Maps and their covariance of a whole record of which these ordinates are known."""
        n = len(chosen)
        spectrum = chosen.T @ chosen.conj() / (frames * n)
        products = operators @ spectrum
        traces = np.trace(products, axis1=1, axis2=2).real
        squares = np.einsum("pij,qji->pq", products, products).real
        squares = n**2 / (n**2 - 1) * (squares - np.outer(traces, traces) / n)
        return 2 * 50 / frames * traces, 4 * 50 / frames**2 * squares

    whole, first, second = seen(ordinates)[1], seen(ordinates[::2]), seen(ordinates[1::2])
    scale = np.sqrt(np.diagonal(whole))
    # Fifty ordinates leave the covariance of 57 data regular, but not well conditioned.
    np.testing.assert_allclose(relative(found.covariance, whole), 0, atol=1e-5)
    inverse = np.linalg.inv(found.covariance / np.outer(scale, scale))
    expected = (first[1] - second[1]) / np.outer(scale, scale) @ inverse @ ((first[0] - second[0]) / scale) / 4
    # Single precision in the difference of the two.
    np.testing.assert_allclose(found.correction / scale, expected, atol=1e-4 * np.abs(expected).max())
    assert np.abs(expected).max() > 0.01


@pytest.mark.slow
def test_halves_that_weight_each_other_take_away_the_bias_of_short_records():
    """Plane waves with noise, the same all over the pupil; the scale of a fit weighted with the estimate should be 1.

    Twenty records of 1,500 frames; the mean scale has the standard error that is computed.
    """
    rng = np.random.default_rng(3)
    process = bench.Process.turbulence(SCINDAR, 40, rng)
    truth = np.mean([maps_of(*process.draw(60_000, rng), SCINDAR) for _ in range(6)], axis=0)
    scale, chi2 = {}, {}
    for _ in range(20):
        slopes, flux = process.draw(1500, rng)
        found = maps_of(slopes, flux, SCINDAR)
        for homogeneous in (True, False):
            estimate = convergence.lagged(slopes, flux, SCINDAR, homogeneous=homogeneous)
            unit = np.sqrt(np.diagonal(estimate.covariance))
            inverse = np.linalg.inv(estimate.covariance / np.outer(unit, unit))
            for corrected in (True, False):
                data = (found + corrected * estimate.correction) / unit
                model, rest = truth / unit, data - truth / unit
                case = homogeneous, corrected
                scale.setdefault(case, []).append(model @ inverse @ data / (model @ inverse @ model))
                chi2.setdefault(case, []).append(rest @ inverse @ rest / len(rest))
    bias = {case: np.mean(values) - 1 for case, values in scale.items()}
    error = {case: np.std(values) / np.sqrt(len(values)) for case, values in scale.items()}
    # Averages over equal separations alone take away a part of it.
    assert bias[False, False] < 0
    assert abs(bias[True, False]) < 0.75 * abs(bias[False, False]), bias
    assert abs(bias[True, True]) < max(0.4 * abs(bias[True, False]), 2.5 * error[True, True]), (bias, error)
    # Too cautious instead of far too sure.
    assert np.mean(chi2[True, False]) < 1 < 2 < np.mean(chi2[False, False])


def test_short_records_are_averaged_and_long_ones_are_not():
    rng = np.random.default_rng(4)
    process = bench.Process.turbulence(SCINDAR, 40, rng)
    for frames, averaged in ((1500, True), (30_000, False)):
        slopes, flux = process.draw(frames, rng)
        chosen = convergence.lagged(slopes, flux, SCINDAR)
        forced = convergence.lagged(slopes, flux, SCINDAR, homogeneous=averaged)
        assert (chosen.n_effective[2] < convergence.HOMOGENEOUS_BELOW) == averaged
        np.testing.assert_array_equal(chosen.covariance, forced.covariance)


def test_averaged_estimate_against_dense_averages():
    """The average written as a double loop over pairs, for one band's worth of white noise."""
    rng = np.random.default_rng(5)
    size = 3 * 2 * SMALL.n_subapertures
    samples = rng.standard_normal((50, size)) + 1j * rng.standard_normal((50, size))
    spectrum = samples.T @ samples.conj() / 50
    index = SMALL.subaperture_index
    expected = np.zeros_like(spectrum)
    a = SMALL.n_subapertures
    for g, h in np.ndindex(6, 6):
        for i, j in np.ndindex(a, a):
            same = [
                spectrum[g * a + k, h * a + m]
                for k, m in np.ndindex(a, a)
                if (index[k] - index[m] == index[i] - index[j]).all()
            ]
            expected[g * a + i, h * a + j] = np.mean(same)
    values, vectors = np.linalg.eigh(expected)
    kept = np.maximum(values, 0) * values.sum() / np.maximum(values, 0).sum()
    expected = (vectors * kept) @ vectors.conj().T
    found = convergence._positive(convergence._averaged(spectrum[None], np.ones((3, 2, a)), SMALL))[0]
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
