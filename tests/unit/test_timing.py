"""Time stamps, repeated frames, outages and drifts; and what a batch makes of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coslidar.pipeline import batch, correlation, timing, vibration
from coslidar.pipeline.extraction import FLAGS
from coslidar.pipeline.geometry import Geometry
from coslidar.pipeline.parameters import CorrelationParameters
from coslidar.pipeline.products import QUALITY_FLAGS, SCHEMA, Measurements

RATE = 142.0
GEOMETRY = Geometry(((1, 1, 1), (1, 1, 1), (1, 1, 1)), 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
FRAMES = 9000


def times(frames: int) -> np.ndarray:
    return 1_347_624_900_000_000_000 + np.round(np.arange(frames) * 1e9 / RATE).astype(np.int64)


def measurements(frames: int = FRAMES, seed: int = 1) -> Measurements:
    """Normal slopes, log-normal fluxes of index 0.04, smooth over some frames; both sources see the same in part."""
    random = np.random.default_rng(seed)
    kernel = np.exp(-(np.arange(-6, 7) ** 2) / 8)
    kernel /= np.sqrt((kernel**2).sum())
    drawn = np.apply_along_axis(np.convolve, 0, random.standard_normal((frames, 4 * 9 + 3 * 9)), kernel, "same")
    own, common = drawn[:, :36].reshape(frames, 4, 9), drawn[:, 36:].reshape(frames, 3, 9)
    slopes = 1e-5 * (own.reshape(frames, 2, 2, 9) + common[:, :2, None]) / np.sqrt(2)
    flux = 1000 * np.exp(0.2 * np.repeat(common[:, 2:], 2, axis=1) - 0.02)
    flag = np.zeros(flux.shape, dtype=np.uint8)
    return Measurements(
        times(frames), slopes, flux, flag, np.full((2, 9), 100.0), np.full((2, 2, 9), 1e-13), np.ones((2, 2))
    )


def reduce(made: Measurements, **parameters: Any) -> batch.ReducedBatch:
    duration = len(made.time) / RATE
    return batch.reduce(made, GEOMETRY, RATE, duration, CorrelationParameters(**parameters))


def flags(reduced: batch.ReducedBatch) -> set[str]:
    return {name for name, (bit, _, _) in QUALITY_FLAGS.items() if reduced.quality_flag & bit}


def expected_flags() -> set[str]:
    """Slopes here are no turbulence: what is expected of every batch below."""
    return {"not_kolmogorov"}


# --- stamps ------------------------------------------------------------------------------------------------


def test_regular_stamps() -> None:
    seen = timing.stamps(times(1000), RATE)
    assert seen.rate == pytest.approx(RATE, rel=1e-6)
    assert seen.jitter < 1e-9  # rounded to nanoseconds
    assert (seen.missing, seen.backward) == (0, 0)


def test_gaps_jitter_and_steps_back() -> None:
    time = times(1000)
    kept = np.delete(time, [*range(100, 110), 500])
    seen = timing.stamps(kept, RATE)
    assert seen.missing == 11
    assert seen.rate == pytest.approx(RATE, rel=1e-6)
    shaken = time + np.random.default_rng(1).normal(0, 2e5, 1000).astype(np.int64)
    # The difference of two stamps has twice the variance of one.
    assert timing.stamps(shaken, RATE).jitter == pytest.approx(2e-4 * np.sqrt(2), rel=0.06)
    shaken[[3, 4]] = shaken[[4, 3]]
    shaken[8] = shaken[7]
    assert timing.stamps(shaken, RATE).backward == 2
    assert timing.stamps(times(1000), 140.0).rate == pytest.approx(RATE, rel=1e-6)
    assert np.isnan(timing.stamps(times(1), RATE).rate)


def test_series_on_equally_spaced_frames() -> None:
    """The header's rate is 0.5 % off: over 10,000 frames that would be 50, but gaps are counted one by one."""
    time = times(10_000)
    values = np.arange(10_000.0)
    lost = [*range(4000, 4010), 9000]
    spread = timing.regular(np.delete(values, lost), np.delete(time, lost), 1.005 * RATE)
    assert np.flatnonzero(np.isnan(spread)).tolist() == lost
    np.testing.assert_array_equal(np.delete(spread, lost), np.delete(values, lost))
    assert timing.regular(values, time, RATE) is values


# --- repeated frames ---------------------------------------------------------------------------------------


def test_repeated_frames_are_found_and_nothing_else() -> None:
    made = measurements(1000)
    slopes, flux = made.slopes.copy(), made.flux.copy()
    slopes[:, 1, 0, 3], flux[::2, 1, 2] = np.nan, np.nan  # holes repeat too
    for start, stop in ((10, 11), (100, 180)):
        slopes[start:stop], flux[start:stop] = slopes[start - 1], flux[start - 1]
    flux[500, 0] = flux[499, 0]  # one source only: no copy of the frame
    slopes[700:710], flux[700:710] = np.nan, np.nan  # nothing measured
    found = timing.repeated(slopes, flux)
    assert np.flatnonzero(found).tolist() == [10, *range(100, 180)]
    assert not timing.repeated(slopes[:1], flux[:1]).any()


def test_repeated_frames_are_left_out() -> None:
    made = measurements()
    frozen = replace(made, slopes=made.slopes.copy(), flux=made.flux.copy())
    frozen.slopes[3000:4500], frozen.flux[3000:4500] = made.slopes[2999], made.flux[2999]
    result, whole = reduce(frozen), reduce(made)
    assert flags(result) - flags(whole) == {"repeated_frames", "lost_spots"}
    assert result.arrays["n_repeated"] == 1500
    assert result.arrays["valid_fraction"] == pytest.approx([1 - 1500 / FRAMES] * 2)
    kept = np.delete(np.arange(FRAMES), np.arange(3000, 4500))
    rest = correlation.finalise(correlation.accumulate(made.slopes[kept], made.flux[kept]), GEOMETRY)
    for kind, (one, other) in enumerate(zip(result.arrays["maps"], rest.maps, strict=True)):
        np.testing.assert_allclose(one, other, atol=1e-12 * np.abs(other).max(), rtol=0, err_msg=str(kind))
    # The arrays of the caller are as they were.
    assert np.isfinite(frozen.slopes).all()


def test_frozen_camera_is_no_batch() -> None:
    made = measurements(1000)
    made.slopes[200:], made.flux[200:] = made.slopes[200], made.flux[200]
    with pytest.raises(batch.BatchError, match="799 of 1000 frames repeat the one before"):
        reduce(made)


# --- sources that go out -----------------------------------------------------------------------------------


@pytest.mark.parametrize("light", [0.0, 0.05, 0.35])
def test_source_that_goes_out_is_left_out(light: float) -> None:
    """For 20 % of the time: spots too faint to be found (extraction says NaN), found in the noise, or half covered."""
    made = measurements()
    out = slice(4000, 5800)
    dark = replace(made, slopes=made.slopes.copy(), flux=made.flux.copy(), flag=made.flag.copy())
    if light:
        dark.flux[out, 1] *= light
        dark.slopes[out, :, 1] *= 30
    else:
        dark.flux[out, 1], dark.slopes[out, :, 1] = np.nan, np.nan
        dark.flag[out, 1] = FLAGS["no_light"]
    result, whole = reduce(dark), reduce(made)
    assert flags(result) - flags(whole) == {"source_out", "lost_spots"}
    first, second = result.arrays["out_fraction"]
    assert first == 0
    # Up to half a second more on either side.
    assert 1800 / FRAMES <= second <= (1800 + 2 * 72) / FRAMES
    assert result.arrays["n_frames"] == FRAMES
    # Source 1 has all its frames, and source 2 those that are left: nothing of the outage reaches the maps.
    deviation = np.sqrt(np.diagonal(whole.arrays["noise_covariance"]))
    rows = GEOMETRY.independent
    moved = (result.arrays["maps"] - whole.arrays["maps"]).ravel()[rows]
    # 20 % of the frames of half or all of the data: the two differ by about half of the noise.
    assert np.abs(moved / deviation).max() < 2.5
    assert np.sqrt(np.mean((moved / deviation) ** 2)) < 0.7
    # The noise grows with the frames that are missing, by 1 / 0.8 at most twice over.
    growth = np.diagonal(result.arrays["noise_covariance"]) / deviation**2
    assert 0.9 < np.median(growth) < 1.6
    assert np.isfinite(growth).all()


def test_source_out_most_of_the_time_is_no_batch() -> None:
    made = measurements(1000)
    made.flux[300:, 1], made.slopes[300:, :, 1] = np.nan, np.nan
    with pytest.raises(batch.BatchError, match="source 2 could be measured in 2"):
        reduce(made)


def test_deep_scintillation_is_no_outage() -> None:
    """Index 1 in each of 20 subapertures: the mean over the pupil stays above 0.3."""
    flux = np.random.default_rng(1).lognormal(-0.35, 0.83, (20_000, 1, 20))
    assert timing.outages(timing.pupil_mean(flux), RATE).sum() == 0


# --- drifts ------------------------------------------------------------------------------------------------


def test_trend_is_the_change_from_end_to_end() -> None:
    values = np.linspace(3.0, 5.0, 1001)[:, None] * [1.0, -2.0]
    values[::7] = np.nan
    assert timing.trend(values) == pytest.approx([2.0, -4.0])
    assert np.isnan(timing.trend(np.full((5, 1), np.nan))).all()


def test_drifting_spots_and_light_are_said() -> None:
    made = measurements()
    ramp = np.linspace(-0.5, 0.5, FRAMES)
    made.slopes[:, 1, 0] += 3e-5 * ramp[:, None]
    made.flux[:, 1] *= 1 + 0.5 * ramp[:, None]
    result = reduce(made)
    assert flags(result) == {"drifting_spots", "drifting_flux", *expected_flags()}
    # 1e-5 of each of nine spots, smooth over some 7 frames: 2e-7 of a trend.
    assert result.arrays["spot_drift"] == pytest.approx(np.array([[0, 3e-5], [0, 0]]), abs=1e-6)
    assert result.arrays["flux_drift"] == pytest.approx([0.0, 0.5], abs=0.02)


def test_slow_part_holds_what_is_below_the_cut() -> None:
    time = np.arange(FRAMES) / RATE
    slow, fast = 0.3 * np.cos(2 * np.pi * time / time[-1] / 2), 0.2 * np.sin(2 * np.pi * 1.0 * time)
    light = (1 + slow + fast)[:, None]
    light[2000:2100] = np.nan
    found = timing.slow_part(light, RATE, 0.1)[:, 0]
    # A hole of 0.7 s in a swing of 1 s leaves something.
    np.testing.assert_allclose(found, (1 + slow) / (1 + slow).mean(), atol=0.02)
    assert (timing.slow_part(np.full((100, 1), np.nan), RATE, 0.1) == 1).all()


def test_flux_trend_is_divided_out() -> None:
    """A lamp that fades by half: a variance of 0.5^2 / 12 on top of the scintillation, and none when divided out."""
    made = measurements()
    before = reduce(made).arrays["scintillation_index"]
    faded = replace(made, flux=made.flux * np.linspace(1.25, 0.75, FRAMES)[:, None, None])
    as_is, corrected = reduce(faded), reduce(faded, flux_trend="0.05 Hz")
    assert as_is.arrays["scintillation_index"] == pytest.approx(before + 0.5**2 / 12 * (1 + before), rel=0.05)
    assert corrected.arrays["scintillation_index"] == pytest.approx(before, rel=0.01)
    assert "drifting_flux" in flags(as_is)


# --- vibration in a batch ----------------------------------------------------------------------------------


def test_vibration_is_recorded_and_subtracted_on_request() -> None:
    made = measurements()
    still = reduce(made)
    assert np.isnan(still.arrays["vibration_frequency"])
    shake = np.sin(2 * np.pi * 50 * np.arange(FRAMES) / RATE)[:, None, None]
    made.slopes[:, 0] += np.sqrt(2e-12) * shake
    made.slopes[:, 1] += np.sqrt(8e-12) * shake
    left, taken = reduce(made), reduce(made, vibration="subtracted")
    for result in (left, taken):
        assert result.arrays["vibration_frequency"] == pytest.approx(50, abs=0.05)
        assert result.arrays["vibration_variance"] == pytest.approx([1e-12, 4e-12], rel=0.02)
        assert "vibration" in flags(result)
    for number, kind in enumerate(("xx_auto", "yy_auto", "xx_cross", "yy_cross", "ii_auto", "ii_cross")):
        step = {"x": 1e-12, "y": 4e-12}.get(kind[0], 0.0)
        moved = (left.arrays["maps"] - taken.arrays["maps"])[number]
        np.testing.assert_allclose(moved, step, rtol=0.02)
        # The line is independent of everything else: what is subtracted is what it added.
        np.testing.assert_allclose(taken.arrays["maps"][number], still.arrays["maps"][number], atol=5e-13)


# --- all of it ---------------------------------------------------------------------------------------------


def test_quiet_batch_raises_no_flag_and_fits_the_schema() -> None:
    result = reduce(measurements())
    assert flags(result) == expected_flags()
    sizes = {"source": 2, "axis": 2, "axis_kind": 3, "harmonic": 4, "radial_order": 5, "log_amplitude": 200}
    sizes["frequency"] = len(vibration.cells(RATE))
    for name, value in result.arrays.items():
        if name in SCHEMA:
            variable = SCHEMA[name]
            assert value.shape == tuple(sizes[dim] for dim in variable.dims[1:]), name
            assert value.dtype == variable.dtype, name


def test_one_source() -> None:
    made = measurements()
    one = Measurements(
        made.time, made.slopes[:, :, :1], made.flux[:, :1], made.flag[:, :1],
        made.flux_noise[:1], made.slope_noise[:, :1], made.centroid_gain[:, :1],
    )  # fmt: skip
    alone = replace(GEOMETRY, positions=((0.0, 0.0),))
    result = batch.reduce(one, alone, RATE, FRAMES / RATE, CorrelationParameters())
    assert result.arrays["r0_direct"].shape == (1,)
    assert np.isfinite(result.arrays["r0_direct"]).all()
    assert np.isfinite(result.arrays["stationarity_error"]).all()
    # Nothing of the other source enters.
    both = reduce(made).arrays
    for name in ("r0_direct", "log_amplitude_deviation", "zernike_variance", "flux_drift", "spot_drift"):
        np.testing.assert_allclose(result.arrays[name], both[name][:1], rtol=1e-9, atol=1e-30)


def test_dead_subaperture_leaves_the_others() -> None:
    """Of both sources, so that the largest separations have no pair at all."""
    made = measurements()
    slopes, flux, flag = made.slopes.copy(), made.flux.copy(), made.flag.copy()
    slopes[:, :, :, 0], flux[:, :, 0], flag[:, :, 0] = np.nan, np.nan, FLAGS["bad_pixels"]
    result, whole = reduce(replace(made, slopes=slopes, flux=flux, flag=flag)), reduce(made)
    assert flags(result) - flags(whole) == {"lost_spots"}
    assert result.arrays["valid_fraction"] == pytest.approx([8 / 9] * 2)
    assert np.isnan(result.arrays["maps"][0, 0, 0])
    for name, value in result.arrays.items():
        if name in SCHEMA and name not in ("vibration_frequency", "zernike_variance", "zernike_variance_kolmogorov"):
            assert np.isfinite(value).all(), name
    np.testing.assert_allclose(result.arrays["mean_flux"], whole.arrays["mean_flux"], rtol=0.01)
    np.testing.assert_allclose(result.arrays["scintillation_index"], whole.arrays["scintillation_index"], rtol=0.1)


def test_irregular_time_is_said() -> None:
    made = measurements(1000)
    assert "irregular_time" in flags(batch.reduce(made, GEOMETRY, 145.0, 7.0, CorrelationParameters()))
    time = made.time.copy()
    time[500:] -= 50_000_000
    assert "irregular_time" in flags(reduce(replace(made, time=time)))
    kept = np.delete(np.arange(1000), np.arange(300, 320))
    gap = Measurements(
        made.time[kept], made.slopes[kept], made.flux[kept], made.flag[kept],
        made.flux_noise, made.slope_noise, made.centroid_gain,
    )  # fmt: skip
    result = reduce(gap)
    assert "gaps" in flags(result)
    assert "irregular_time" not in flags(result)
    assert result.arrays["n_missing"] == 20
