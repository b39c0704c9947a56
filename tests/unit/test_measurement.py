"""Spots of recordings in which something happens: drifts, sources that come and go; however the frames are cut."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from coslidar.pipeline.measurement import MeasurementError, measure
from coslidar.pipeline.parameters import ExtractionParameters, Header
from coslidar.pipeline.products import Measurements
from coslidar.pipeline.spots import FLAGS, Calibration

Array = NDArray[Any]
SCALE = 27e-6
SPOTS = np.array([[9.95, 15.5], [21.05, 15.5]])
PARAMETERS = ExtractionParameters(reference_frames=64)
HEADER = Header.model_validate(
    {
        "format": "shwfs-frames",
        "format_version": 1,
        "campaign": "test",
        "archive": "test",
        "instrument": {
            "wavelength": "3.8 um",
            "frame_rate": "142 Hz",
            "pixel_scale": "27 urad",
            "gain": "12 electron/count",
            "subaperture_size": "7 cm",
            "subaperture_mask": [[1, 1, 1]],
            "lenslet_origin": [0, 0],
            "lenslet_pitch": [32, 32],
        },
        "path": {"length": "2670 m"},
        "sources": [
            {"name": "a", "position": ["0 m", "-0.4 m"], "fwhm": ["9 cm", "6 cm"], "spot": SPOTS[0].tolist()},
            {"name": "b", "position": ["0 m", "0.4 m"], "fwhm": ["9 cm", "6 cm"], "spot": SPOTS[1].tolist()},
        ],
    }
)
DARK = Calibration(dark=np.full((32, 96), 100.0))


def record(frames: int, drift: Array, lit: Array, seed: int = 1) -> tuple[Array, Array]:
    """Noisy frames, and the displacement (T, 2, S, A) of each spot, px, from `drift` (T, 2) and `lit` (T, S)."""
    rng = np.random.default_rng(seed)
    move = 0.3 * rng.standard_normal((frames, 2, 2, 3)) + drift[:, :, None, None]
    rows, cols = np.indices((32, 32))
    image = np.full((frames, 32, 96), 100.0)
    for s, (row, col) in enumerate(SPOTS):
        for a in range(3):
            y, x = (move[:, axis, s, a, None, None] for axis in (1, 0))
            spot = np.exp(-((rows - row - y) ** 2 + (cols - col - x) ** 2) / 2.4)
            image[:, :, 32 * a : 32 * a + 32] += 1000 * lit[:, s, None, None] * spot
    return (image + 5 * rng.standard_normal(image.shape)).round().astype(np.uint16), move


def measured(
    frames: Array, cuts: list[int] | None = None, parameters: ExtractionParameters = PARAMETERS
) -> Measurements:
    blocks = np.split(frames, cuts or [])
    return measure(blocks, np.arange(len(frames)) * 7_042_254, HEADER, DARK, parameters)


def error(found: Measurements, move: Array) -> Array:
    """What differs from the true motion by more than a constant, px; (T, 2, S, A)."""
    difference = found.slopes / SCALE - move
    return np.asarray(difference - np.nanmedian(difference[:64], axis=0))


def test_a_drift_is_followed_and_stays_in_the_slopes() -> None:
    """Nine pixels, with a search that reaches four and a window that reaches four more."""
    frames, steps = 1024, np.linspace(0, 1, 1024)
    move = np.stack([9 * steps, -3 * steps], axis=1)
    images, truth = record(frames, move, np.ones((frames, 2)))
    small = {"reference_frames": 64, "window_x": "7 pixel", "window_y": "7 pixel"}
    found = measured(images, parameters=ExtractionParameters(**small))
    assert not found.flag.any()
    # Noise 0.04 px; borders of the window in the wings of a spot of 1.1 px leave nothing.
    assert np.abs(error(found, truth)).max() < 0.3
    assert np.abs(error(found, truth)[-200:].mean(axis=0)).max() < 0.02
    still = measured(images, parameters=ExtractionParameters(**small, follow="100 pixel"))
    assert np.isnan(still.slopes[-100:]).mean() > 0.5


@pytest.mark.parametrize("cuts", [[1], [63, 64, 65], [100, 200, 201, 450], list(range(16, 600, 16))])
def test_cuts_of_the_recording_change_no_bit(cuts: list[int]) -> None:
    frames = 600
    steps = np.linspace(0, 1, frames)
    lit = np.stack([np.ones(frames), (np.arange(frames) > 200).astype(float)], axis=1)
    images, _ = record(frames, np.stack([4 * steps, 0 * steps], axis=1), lit)
    whole, cut = measured(images), measured(images, cuts)
    for name in ("slopes", "flux", "flag", "flux_noise", "slope_noise", "centroid_gain"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(whole, name), err_msg=name)


def test_a_source_that_is_dark_at_first_is_found_when_it_is_lit() -> None:
    frames = 640
    lit = np.stack([np.ones(frames), (np.arange(frames) >= 300).astype(float)], axis=1)
    images, truth = record(frames, np.zeros((frames, 2)), lit)
    found = measured(images)
    assert (found.flag[:256, 1] & FLAGS["no_spot"] > 0).all()
    assert np.isnan(found.flux[:256, 1]).all()
    # In the unit in which it appears, dark frames are told from lit ones: two sigma of the noise, as below.
    assert (found.flag[257:299, 1] != 0).mean() > 0.9
    assert not found.flag[300:, 1].any()
    assert not found.flag[:, 0].any()
    difference = (found.slopes / SCALE - truth)[300:]
    assert np.abs(difference - difference.mean(axis=0)).std() < 0.05
    # The one that was lit does not notice: its zero stays.
    alone, _ = record(frames, np.zeros((frames, 2)), np.ones((frames, 2)))
    other = measured(alone).slopes[:, :, 0] / SCALE
    assert np.abs((found.slopes[:, :, 0] / SCALE - other).mean(axis=0)).max() < 0.02


def test_both_sources_dark_at_first() -> None:
    frames = 512
    lit = np.repeat((np.arange(frames) >= 128).astype(float)[:, None], 2, axis=1)
    images, truth = record(frames, np.zeros((frames, 2)), lit)
    found = measured(images)
    assert found.flag[:128].all()
    assert not found.flag[128:].any()
    full = measured(images[128:])
    np.testing.assert_array_equal(found.slopes[128:], full.slopes)
    np.testing.assert_array_equal(found.flux[128:], full.flux)
    assert np.abs((found.slopes / SCALE - truth)[128:]).std() < 0.1


def test_a_source_that_goes_out_while_the_other_drifts_is_found_where_it_was() -> None:
    frames = 768
    steps = np.linspace(0, 1, frames)
    lit = np.ones((frames, 2))
    lit[200:500, 1] = 0
    images, truth = record(frames, np.stack([3.0 * steps, 0 * steps], axis=1), lit)
    found = measured(images)
    # Noise of 170 pixels, 65 counts, now and then passes the floor of 2 % of the light, 150 counts.
    assert (found.flag[200:500, 1] != 0).mean() > 0.95
    assert not found.flag[500:, 1].any()
    assert not found.flag[:, 0].any()
    known = np.delete(error(found, truth), np.s_[200:500], axis=0)
    assert np.nanmax(np.abs(known)) < 0.3


def test_nothing_lit_at_all() -> None:
    images, _ = record(200, np.zeros((200, 2)), np.zeros((200, 2)))
    found = measured(images)
    assert found.flag.all()
    assert np.isnan(found.flux).all()


def test_frames_and_time_stamps_must_agree() -> None:
    images, _ = record(70, np.zeros((70, 2)), np.ones((70, 2)))
    for stamps in (60, 80):
        with pytest.raises(MeasurementError, match=f"{stamps} time stamps"):
            measure([images], np.arange(stamps), HEADER, DARK, PARAMETERS)
    with pytest.raises(MeasurementError, match="no frame"):
        measure([], np.arange(0), HEADER, DARK, PARAMETERS)


def test_gain_is_reported_or_divided_out() -> None:
    """A window of three pixels around the brightest cuts off what moves out of it."""
    images, _ = record(256, np.zeros((256, 2)), np.ones((256, 2)))
    poor = {"reference_frames": 64, "method": "moving_maximum", "window_x": "3 pixel", "window_y": "3 pixel"}
    reported = measured(images, parameters=ExtractionParameters(**poor))
    corrected = measured(images, parameters=ExtractionParameters(**poor, gain="corrected"))
    gain = reported.centroid_gain
    np.testing.assert_array_equal(corrected.centroid_gain, gain)
    assert np.abs(gain - 1).max() > 0.02
    np.testing.assert_allclose(corrected.slopes, reported.slopes / gain[..., None], rtol=1e-12)
    np.testing.assert_allclose(corrected.slope_noise, reported.slope_noise / gain[..., None] ** 2, rtol=1e-12)
