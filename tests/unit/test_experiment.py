"""Synthetic experiments: the covariance they draw from, the draws, and coverage where it is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import integrate

from coslidar.pipeline import convergence, experiment, inversion
from coslidar.pipeline.geometry import Geometry, SliceGrid
from coslidar.pipeline.response import response_matrix
from coslidar.plugins.hyperparameter_selectors import GCV, Fixed
from coslidar.plugins.source_models import Gaussian
from coslidar.plugins.turbulence_spectra import Kolmogorov

GEOMETRY = experiment.scindar()
GRID = SliceGrid.uniform(2670.0, 4)
LAMP = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")
CN2 = np.array([2e-14, 1e-14, 0.0, 3e-14])
OTHER = Geometry(((1, 1, 1), (1, 0, 1)), 0.05, 1500.0, 1.55e-6, ((-0.1, 0.0), (0.2, 0.3)))


@pytest.fixture(scope="module")
def signals() -> np.ndarray:
    return experiment.channel_covariance(GEOMETRY, GRID, CN2, Kolmogorov(), [LAMP, LAMP])


@pytest.fixture(scope="module")
def matrix() -> np.ndarray:
    return response_matrix(GEOMETRY, GRID, Kolmogorov(), [LAMP, LAMP], sampling="midpoint")


def check_blocks(geometry: Geometry, covariance: np.ndarray, data: np.ndarray) -> None:
    """Products of signals of one kind against response maps, which another quadrature makes to 1e-6."""
    size = geometry.n_subapertures
    blocks = covariance.reshape(3, 2, size, 3, 2, size)
    maps = data.reshape(6, *geometry.map_shape)
    i, j = geometry.subaperture_index.T
    dy, dx = i[:, None] - i + geometry.p - 1, j[:, None] - j + geometry.q - 1
    for kind, (auto, cross) in enumerate(((0, 2), (1, 3), (4, 5))):
        scale = maps[auto].max()
        np.testing.assert_allclose(blocks[kind, 0, :, kind, 0], maps[auto][dy, dx], atol=1e-4 * scale)
        np.testing.assert_allclose(blocks[kind, 0, :, kind, 1], maps[cross][dy, dx], atol=1e-4 * scale)
        np.testing.assert_allclose(blocks[kind, 1, :, kind, 0], maps[cross][dy, dx].T, atol=1e-4 * scale)


def test_signals_of_one_kind_are_those_of_the_response_matrix(signals: np.ndarray, matrix: np.ndarray) -> None:
    check_blocks(GEOMETRY, signals, matrix @ CN2)


def test_another_instrument_and_printed_slopes() -> None:
    """Sources apart along both axes, another wavelength, and slopes without the centroid term."""
    grid = SliceGrid.uniform(1500.0, 2)
    lamps = [Gaussian(fwhm_x="3 cm", fwhm_y="5 cm")] * 2
    cn2 = np.array([1e-14, 2e-14])
    found = experiment.channel_covariance(OTHER, grid, cn2, Kolmogorov(), lamps, centroid_term=False)
    expected = response_matrix(OTHER, grid, Kolmogorov(), lamps, sampling="midpoint", slope_response="printed") @ cn2
    check_blocks(OTHER, found, expected)


def test_covariance_is_one(signals: np.ndarray) -> None:
    """Symmetric and positive; x and y slopes of one subaperture know nothing of each other, nor of its flux."""
    np.testing.assert_allclose(signals, signals.T, rtol=1e-12, atol=0)
    deviation = np.sqrt(np.diag(signals))
    correlation = signals / deviation / deviation[:, None]
    assert np.linalg.eigvalsh(correlation)[0] > 0
    blocks = correlation.reshape(3, 2, 20, 3, 2, 20)
    for source in range(2):
        for one, two in ((0, 1), (0, 2), (1, 2)):
            assert np.abs(np.diag(blocks[one, source, :, two, source])).max() < 1e-10


def test_slope_and_flux_by_direct_integration() -> None:
    """<s_y(r) i(0)> of two subapertures apart along y, as a plain integral over a quadrant of frequencies.

    Uncorrelated at zero separation, of opposite sign on both sides. Whether the sign is nature's is told by the
    simulation, in tests/science.
    """
    length, z, wavelength, spread = 1000.0, 500.0, 1e-6, 0.02
    apart = 0.05
    geometry = Geometry(((1,), (1,)), apart, length, wavelength, ((0.0, 0.0),))
    fwhm = f"{spread * 2 * np.sqrt(2 * np.log(2))} m"
    source = Gaussian(fwhm_x=fwhm, fwhm_y=fwhm)
    wide = SliceGrid((z - 0.5, z + 0.5))
    found = experiment.channel_covariance(
        geometry, wide, np.ones(1), Kolmogorov(), [source], centroid_term=False
    ).reshape(3, 1, 2, 3, 1, 2)[1, 0, :, 2, 0, :]
    scaling = length / (length - z)
    k = 2 * np.pi / wavelength

    def density(fy: float, fx: float) -> float:
        f = np.hypot(fx, fy)
        x = np.pi * wavelength * z * scaling * f**2
        filters = (np.sinc(apart * fx) * np.sinc(apart * fy) * np.exp(-2 * (np.pi * spread * f) ** 2)) ** 2
        psd = 9.7e-3 * (scaling * f) ** (-11 / 3) * scaling**2
        # -2 pi i f_y cos X times 2 k sin X times exp(2 pi i f_y d): four quadrants of one real integrand.
        return float(
            4 * psd * filters * 2 * np.pi * fy * np.cos(x) * 2 * k * np.sin(x) * np.sin(2 * np.pi * fy * apart)
        )

    expected, _ = integrate.dblquad(density, 0, 60, 0, 60, epsrel=1e-5)
    assert found[1, 0] == pytest.approx(expected, rel=2e-3)
    assert found[0, 1] == pytest.approx(-expected, rel=2e-3)


# --- convergence noise ------------------------------------------------------------------------------------------------


def test_independent_frames_are_the_formula_of_the_paper(signals: np.ndarray) -> None:
    """With as many effective frames as there are, noise or not, nothing is left but (2 / N) tr(A S A S)."""
    for noise in ((0.0, 0.0, 0.0), (1e-13, 2e-13, 1e-4)):
        found = experiment.convergence_covariance(
            GEOMETRY, signals, effective_frames=(1000.0,) * 3, frames=1000, detection_noise=noise
        )
        expected = convergence.independent(signals + np.diag(np.repeat(noise, 40)), 1000, GEOMETRY)
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(found, expected, atol=1e-9 * scale.max() ** 2)
        np.testing.assert_allclose(found / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-9)


def test_effective_frames_of_each_kind(signals: np.ndarray) -> None:
    """The error of a variance with N_eff frames is sqrt(2 / N_eff) of it, for one channel; less when averaged."""
    effective = (100.0, 400.0, 1600.0)
    found = experiment.convergence_covariance(
        GEOMETRY, signals, effective_frames=effective, detection_noise=(0.0, 0.0, 0.0)
    )
    rows = [int(np.flatnonzero(GEOMETRY.independent == row)[0]) for row in (40, 121, 364)]
    blocks = signals.reshape(3, 40, 3, 40)
    for kind, row in enumerate(rows):
        own = blocks[kind, :, kind]
        # Mean of 40 squares: variance 2 sum S_ab^2 / 40^2 / N_eff.
        assert found[row, row] == pytest.approx(2 * (own**2).sum() / 1600 / effective[kind], rel=1e-9)
        assert found[row, row] < 2 * own[0, 0] ** 2 / effective[kind]


def test_white_noise_alone_averages_over_all_frames() -> None:
    """Noise in 40 channels of variance v: the zero separation is known to 2 v^2 / (40 N), whatever N_eff."""
    nothing = np.zeros((120, 120))
    found = experiment.convergence_covariance(
        GEOMETRY, nothing, effective_frames=(1.0,) * 3, frames=1000, detection_noise=(1e-13, 1e-13, 1e-4)
    )
    row = int(np.flatnonzero(GEOMETRY.independent == 364)[0])
    assert found[row, row] == pytest.approx(2 * 1e-8 / 40 / 1000, rel=1e-9)
    with pytest.raises(ValueError, match="without turbulence and detection noise"):
        experiment.convergence_covariance(GEOMETRY, nothing, detection_noise=(0.0, 0.0, 0.0))


# --- draws and reconstructions ----------------------------------------------------------------------------------------


def drawn(matrix: np.ndarray, signals: np.ndarray, draws: int, **options: Any) -> experiment.Setup:
    covariance = experiment.convergence_covariance(GEOMETRY, signals)
    return experiment.draw("x", CN2, GEOMETRY, GRID, matrix, covariance, draws=draws, seed=3, **options)


def test_draws_scatter_as_the_covariance_says(matrix: np.ndarray, signals: np.ndarray) -> None:
    """2000 draws: each variance is known to 3 %, and 312 of them to 5 deviations; the mean is M x plus the noise."""
    setup = drawn(matrix, signals, 2000)
    covariance = experiment.convergence_covariance(GEOMETRY, signals)
    rows = GEOMETRY.independent
    deviation = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(setup.data[:, rows].std(axis=0) / deviation, 1, atol=5 / np.sqrt(4000))
    bias = np.zeros(486)
    bias[[40, 121, 364]] = experiment.DETECTION_NOISE
    away = (setup.data.mean(axis=0) - matrix @ CN2 - bias)[rows] / deviation * np.sqrt(2000)
    assert np.abs(away).max() < 5
    np.testing.assert_allclose(
        np.corrcoef(setup.data[:, rows[:40]].T), (covariance / deviation / deviation[:, None])[:40, :40], atol=0.12
    )


def test_more_draws_begin_with_the_same(matrix: np.ndarray, signals: np.ndarray) -> None:
    few, many = drawn(matrix, signals, 3), drawn(matrix, signals, 5)
    scale = np.abs(few.data).max(axis=0)
    np.testing.assert_allclose(few.data / scale, many.data[:3] / scale, atol=1e-9)


def test_draws_do_not_depend_on_the_choice_of_eigenvectors(
    matrix: np.ndarray, signals: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other libraries return eigenvectors of other signs; a seed must give the same data."""
    before = drawn(matrix, signals, 3)
    whole = np.linalg.eigh

    def turned(a: np.ndarray) -> Any:
        values, vectors = whole(a)
        return values, vectors * np.where(np.arange(len(values)) % 2, 1.0, -1.0)

    covariance = experiment.convergence_covariance(GEOMETRY, signals)
    monkeypatch.setattr(experiment.np.linalg, "eigh", turned)
    after = experiment.draw("x", CN2, GEOMETRY, GRID, matrix, covariance, draws=3, seed=3)
    scale = np.abs(before.data).max(axis=0)
    np.testing.assert_allclose(after.data / scale, before.data / scale, atol=1e-9)


def test_numbers_of_an_outcome(matrix: np.ndarray, signals: np.ndarray) -> None:
    """Errors, gaps and bars against plain formulas on what the outcome holds."""
    setup = drawn(matrix, signals, 8)
    found = experiment.reconstruct(setup, np.eye(4), GCV(log_mu_min=25))
    mean = CN2.mean()
    for number in range(8):
        error = np.sqrt(np.mean((found.cn2_map[number] - CN2) ** 2)) / mean
        assert found.error_map[number] == pytest.approx(error)
        at = int(np.flatnonzero(found.log_mu_grid == found.log_mu[number])[0])
        assert found.error_curve[number, at] == pytest.approx(error)
        assert found.criterion[number, at] == found.criterion[number].min()
        assert found.error_best[number] == found.error_curve[number].min() <= error
    gaps = [(a - b) ** 2 for a, b in zip(found.log_mu, found.best_log_mu, strict=True)]
    assert found.squared_gap == pytest.approx(sum(gaps) / 8)
    np.testing.assert_allclose(found.bar_empirical**2 * 8, ((found.cn2_map - CN2) ** 2).sum(axis=0))
    assert (found.bar_ml >= found.bar_map).all()
    inside = np.abs(found.cn2_map - CN2) < found.bar_map
    np.testing.assert_allclose(found.coverage["map"].at_68, inside.mean(axis=0), atol=1 / 8)


def test_intervals_hold_what_they_say_where_the_prior_is_right() -> None:
    """300 truths of three slices drawn from the positive prior, seen through a smoothing response.

    Coverage of a Bayesian interval over the prior is its probability, whatever the data: binomial errors of 900 are
    1.6 % and 0.7 %. MAP bars make no such promise below zero.
    """
    rng = np.random.default_rng(8)
    sigma = 1e-14
    response = np.array([[1.0, 0.5, 0.2], [0.5, 1.0, 0.5], [0.2, 0.5, 1.0], [1.0, 1.0, 1.0]]) / sigma
    found = []
    for number in range(300):
        truth = sigma * np.abs(rng.standard_normal(3))
        data = response @ truth + rng.standard_normal(4)
        rows = np.zeros(6 * 1)
        reduction = inversion.prepare(
            np.concatenate([data, rows[:2]]), np.diag([1.0] * 4 + [1e6] * 2),
            np.concatenate([response, np.full((2, 3), 1e-6 / sigma)]),
            rows=np.arange(6), noise_bias=False, slope_offset=False,
        )  # fmt: skip
        setup = experiment.Setup(
            "prior", truth, SliceGrid.uniform(3, 3), np.concatenate([data, rows[:2]])[None], reduction
        )
        outcome = experiment.reconstruct(setup, np.eye(3), Fixed(mu="1e28 m^(4/3)"), seed=number)
        found.append([outcome.coverage["hpd"].at_68.mean(), outcome.coverage["hpd"].at_95.mean()])
    share = np.mean(found, axis=0)
    assert share[0] == pytest.approx(0.68, abs=0.05)
    assert share[1] == pytest.approx(0.95, abs=0.025)


def test_an_empty_truth_is_measured_by_the_weak_profile(matrix: np.ndarray) -> None:
    covariance = experiment.convergence_covariance(GEOMETRY, np.zeros((120, 120)))
    setup = experiment.draw("empty", np.zeros(4), GEOMETRY, GRID, matrix, covariance, draws=2, seed=0)
    assert setup.error(np.full(4, 8e-15)) == pytest.approx(1.0)
    assert experiment.reconstruct(setup, np.eye(4), GCV()).error_map.max() < 0.1


def test_truths_have_twelve_slices() -> None:
    assert {len(values) for values in experiment.TRUTHS.values()} == {12}
    assert np.mean(experiment.TRUTHS["weak"]) == pytest.approx(experiment.REFERENCE_LEVEL)
    assert (GEOMETRY.independent.size, GEOMETRY.n_subapertures) == (312, 20)
