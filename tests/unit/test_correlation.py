"""Correlation maps against a double loop over pairs of subapertures."""

import numpy as np
import pytest

from coslidar.pipeline import correlation
from coslidar.pipeline.geometry import MAP_KINDS, Geometry

MASK = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))
TWO = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
ONE = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, 0.0),))
OBLONG = Geometry(((1, 1, 0, 1), (0, 1, 1, 1)), 0.05, np.inf, 0.5e-6, ((0.0, 0.0), (3e-5, 1e-5)))


def record(geometry, frames, seed=0, missing=0.0):
    """Signals with all channels correlated, offsets much larger than fluctuations, in realistic units."""
    rng = np.random.default_rng(seed)
    channels = 3 * geometry.n_sources * geometry.n_subapertures
    mix = np.eye(channels) + rng.standard_normal((channels, channels)) / np.sqrt(channels)
    samples = rng.standard_normal((frames, channels)) @ mix
    samples[rng.random(samples.shape) < missing] = np.nan
    samples = samples.reshape(frames, 3, geometry.n_sources, geometry.n_subapertures)
    offset = 1e-4 * rng.standard_normal(samples.shape[1:])
    slopes = 2e-6 * samples[:, :2] + offset[:2]
    flux = 4000 * (1 + 0.1 * samples[:, 2] + 0.2 * rng.random(samples.shape[2:]))
    return slopes, flux


def maps_by_pairs(slopes, flux, geometry):
    """The definition: every pair of subapertures, every frame that has both, weighted by the frames of the pair."""
    index = geometry.subaperture_index
    mean = np.nansum(flux, axis=0) / np.maximum(np.sum(~np.isnan(flux), axis=0), 1)
    signal = {"x": slopes[:, 0], "y": slopes[:, 1], "i": flux / mean}
    shape = (len(MAP_KINDS), *geometry.map_shape)
    total, weight, pairs = np.zeros(shape), np.zeros(shape), np.zeros(shape, int)
    for number, name in enumerate(MAP_KINDS):
        sources = range(geometry.n_sources)
        combinations = [(s, s) for s in sources] if name.endswith("auto") else [(0, 1)] * (geometry.n_sources - 1)
        for first, second in combinations:
            for a, (row_a, column_a) in enumerate(index):
                for b, (row_b, column_b) in enumerate(index):
                    left, right = signal[name[0]][:, first, a], signal[name[0]][:, second, b]
                    both = ~np.isnan(left) & ~np.isnan(right)
                    if both.sum() < 2:
                        continue
                    left, right = left[both], right[both]
                    entry = number, row_a - row_b + geometry.p - 1, column_a - column_b + geometry.q - 1
                    total[entry] += np.sum((left - left.mean()) * (right - right.mean()))
                    weight[entry] += both.sum()
                    pairs[entry] += 1
    with np.errstate(invalid="ignore"):
        return total / weight, pairs


@pytest.mark.parametrize("geometry", [TWO, ONE, OBLONG], ids=["two", "one", "oblong"])
@pytest.mark.parametrize("missing", [0.0, 0.3], ids=["complete", "gaps"])
def test_maps_agree_with_a_double_loop_over_pairs(geometry, missing):
    slopes, flux = record(geometry, 40, missing=missing)
    found = correlation.finalise(correlation.accumulate(slopes, flux), geometry)
    maps, pairs = maps_by_pairs(slopes, flux, geometry)
    scale = np.fmax.reduce(np.abs(maps).reshape(6, -1), axis=1)[:, None, None]
    # Rounding: offsets are 50 times the fluctuations, so squares lose about 2500 eps.
    np.testing.assert_allclose(found.maps / scale, maps / scale, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(found.pair_count, pairs)


def test_complete_maps_have_the_pairs_of_the_geometry():
    slopes, flux = record(TWO, 5)
    found = correlation.finalise(correlation.accumulate(slopes, flux), TWO)
    for number, name in enumerate(MAP_KINDS):
        np.testing.assert_array_equal(found.pair_count[number], TWO.pair_count * (1 if "cross" in name else 2))
    np.testing.assert_array_equal(np.isfinite(correlation.data_vector(found.maps)), TWO.valid)


def test_auto_map_is_the_mean_of_both_sources():
    slopes, flux = record(TWO, 50)
    both = correlation.finalise(correlation.accumulate(slopes, flux), TWO).maps
    each = [correlation.finalise(correlation.accumulate(slopes[:, :, [s]], flux[:, [s]]), ONE).maps for s in (0, 1)]
    for number, name in enumerate(MAP_KINDS):
        if name.endswith("auto"):
            np.testing.assert_allclose(both[number], (each[0][number] + each[1][number]) / 2, rtol=1e-10)
        else:
            assert np.all(np.isnan(each[0][number]))
            assert np.all(each[0][number].shape == both[number].shape)


def test_covariance_and_index_are_those_of_numpy():
    slopes, flux = record(TWO, 60)
    found = correlation.finalise(correlation.accumulate(slopes, flux), TWO)
    mean = flux.mean(axis=0)
    normalised = np.concatenate([slopes.reshape(60, -1), (flux / mean - 1).reshape(60, -1)], axis=1)
    expected = np.cov(normalised.T, bias=True)
    unit = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(found.covariance / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-11)
    np.testing.assert_allclose(found.scintillation_index, (flux.var(axis=0) / mean**2).mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(found.mean_flux, mean, rtol=1e-13)
    np.testing.assert_allclose(found.mean_slope, slopes.mean(axis=0), rtol=1e-12)
    assert found.n_frames == 60
    assert np.all(found.valid_fraction == 1)


def test_ridge_lies_toward_the_second_source():
    # A layer prints P(r + m S) on the pupil for a source at S: with the first source at the origin and the
    # second at S = (0, S) and m S = 2 d, a frozen pattern is seen by source 2 two subapertures higher in y.
    geometry = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, 0.0), (0.0, 0.8)))
    rng = np.random.default_rng(3)
    position = np.rint(geometry.subaperture_position / 0.07).astype(int) + 20  # pixels of the pattern, x and y
    patterns = rng.standard_normal((3, 4000, 41, 41))  # white, a frame each: correlated with itself only
    x, y = position.T
    seen = np.stack([patterns[:, :, y, x], patterns[:, :, y + 2, x]], axis=2)  # kind, frame, source, subaperture
    slopes, flux = np.moveaxis(seen[:2], 0, 1), 1000 + 50 * seen[2]
    maps = correlation.finalise(correlation.accumulate(slopes, flux), geometry).maps
    for number, name in enumerate(MAP_KINDS):
        dy, dx = np.unravel_index(np.nanargmax(maps[number]), geometry.map_shape)
        expected = (2, 0) if name.endswith("cross") else (0, 0)
        assert (dy - 4, dx - 4) == expected, name


def test_ridge_along_x_and_y_of_an_oblique_pair():
    rng = np.random.default_rng(4)
    index = TWO.subaperture_index + 10
    pattern = rng.standard_normal((3, 4000, 25, 25))
    i, j = index.T
    seen = np.stack([pattern[:, :, i, j], pattern[:, :, i + 1, j - 2]], axis=2)
    maps = correlation.finalise(correlation.accumulate(np.moveaxis(seen[:2], 0, 1), 1000 + 50 * seen[2]), TWO).maps
    for number in (2, 3, 5):
        dy, dx = np.unravel_index(np.nanargmax(maps[number]), TWO.map_shape)
        assert (dy - 4, dx - 4) == (1, -2)


def test_dead_channel_is_left_out():
    slopes, flux = record(TWO, 40)
    slopes[:, :, 0, 3] = np.nan
    flux[:, 0, 3] = np.nan
    flux[:, 1, 7] = 0.0  # no light: no intensity relative to its mean
    found = correlation.finalise(correlation.accumulate(slopes, flux), TWO)
    flux[:, 1, 7] = np.nan
    maps, pairs = maps_by_pairs(slopes, flux, TWO)
    np.testing.assert_array_equal(found.pair_count, pairs)
    np.testing.assert_allclose(found.maps[4:], maps[4:], rtol=0, atol=1e-12)
    assert found.valid_fraction[0, 0, 3] == 0
    assert np.isfinite(found.scintillation_index).all()
    assert np.isnan(found.mean_flux[0, 3])


def test_identical_frames_have_no_correlation_at_any_offset():
    # The naive mean of squares minus square of the mean would leave 1e16 eps here.
    flux = np.full((1000, 2, 20), 1e8 / 3)
    slopes = np.full((1000, 2, 2, 20), 1e-3 / 7)
    parts = [correlation.accumulate(slopes[i : i + 100], flux[i : i + 100]) for i in range(0, 1000, 100)]
    total = correlation.CorrelationSums.empty(2, 20)
    for part in parts:
        total = correlation.merge(total, part)
    found = correlation.finalise(total, TWO)
    assert np.nanmax(np.abs(found.maps[:4])) < (1e-3 * 1e-15) ** 2 * 100
    assert np.nanmax(np.abs(found.maps[4:])) < 1e-28


def test_small_fluctuations_on_a_large_offset():
    rng = np.random.default_rng(5)
    wiggle = rng.standard_normal((2000, 1, 20))
    slopes = np.stack([wiggle, wiggle], axis=1)
    offset = 1e6
    found = correlation.finalise(correlation.accumulate(slopes + offset, 1e3 + wiggle), ONE).maps
    plain = correlation.finalise(correlation.accumulate(slopes, 1e3 + wiggle), ONE).maps
    # The offset rounds the samples themselves at 1e6 eps = 1e-10, once; squaring it would leave 1e-4.
    np.testing.assert_allclose(found[0], plain[0], rtol=0, atol=1e-10)


def test_arguments_are_not_changed():
    slopes, flux = record(TWO, 10, missing=0.1)
    before = slopes.copy(), flux.copy()
    correlation.accumulate(slopes, flux)
    np.testing.assert_array_equal(slopes, before[0])
    np.testing.assert_array_equal(flux, before[1])


def test_faults_are_named():
    slopes, flux = record(TWO, 10)
    with pytest.raises(ValueError, match="slopes must be"):
        correlation.accumulate(slopes, flux[:, :1])
    with pytest.raises(ValueError, match="infinite"):
        correlation.accumulate(np.where(slopes == slopes.flat[7], np.inf, slopes), flux)
    sums = correlation.accumulate(slopes, flux)
    with pytest.raises(ValueError, match="different instruments"):
        correlation.merge(sums, correlation.CorrelationSums.empty(1, 20))
    with pytest.raises(ValueError, match="the geometry"):
        correlation.finalise(sums, ONE)
    with pytest.raises(ValueError, match="no frame"):
        correlation.finalise(correlation.CorrelationSums.empty(2, 20), TWO)
