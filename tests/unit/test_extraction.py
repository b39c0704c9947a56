"""Centroids and fluxes of drawn spots, whose positions and fluxes are known, and of a slow reading of the method."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray
from scipy.special import erf

from coslidar.pipeline.extraction import FLAGS, Calibration, SpotLayout, extract, response_to_tilt
from coslidar.pipeline.parameters import ExtractionParameters, Header
from coslidar.pipeline.spot_layout import layout, reference_image
from coslidar.pipeline.window_kernel import window_kernel

Array = NDArray[Any]

SCALE = 27e-6
TWO = ((9.95, 15.5), (21.05, 15.5))
DEFAULT = ExtractionParameters()
KEPT = ExtractionParameters(wings="kept")
WHOLE = ExtractionParameters(method="moving_maximum", window_x="9 pixel", window_y="9 pixel")
NO_CALIBRATION = Calibration(dark=np.zeros((64, 96)))


def header(spots: tuple[tuple[float, float], ...] = TWO, mask: Any = None, pitch: tuple[int, int] = (32, 32)) -> Header:
    positions = [["0 m", "-0.4 m"], ["0 m", "0.4 m"]]
    return Header.model_validate(
        {
            "format": "shwfs-frames",
            "format_version": 1,
            "campaign": "test",
            "archive": "test",
            "instrument": {
                "wavelength": "3.8 um",
                "frame_rate": "142 Hz",
                "pixel_scale": "27 urad",
                "subaperture_size": "7 cm",
                "subaperture_mask": mask if mask is not None else [[1, 1, 1], [1, 0, 1]],
                "lenslet_origin": [0, 0],
                "lenslet_pitch": list(pitch),
            },
            "path": {"length": "2670 m"},
            "sources": [
                {"name": f"s{n}", "position": positions[n], "fwhm": ["8.9 cm", "6.3 cm"], "spot": list(spot)}
                for n, spot in enumerate(spots)
            ],
        }
    )


def gaussian(shape: tuple[int, int], row: float, col: float, flux: float, sigma: float) -> Array:
    """Gaussian spot integrated over each pixel."""

    def edge(n: int, centre: float) -> Array:
        steps = erf((np.arange(n + 1) - 0.5 - centre) / (sigma * np.sqrt(2)))
        return np.diff(steps) / 2

    return flux * np.outer(edge(shape[0], row), edge(shape[1], col))


def airy(shape: tuple[int, int], row: float, col: float, flux: float, width: float) -> Array:
    """Image through a square lenslet, integrated over each pixel on a fine grid; wings fall with the square."""

    def edge(n: int, centre: float) -> Array:
        fine = (np.arange(16 * n) + 0.5) / 16 - 0.5
        return np.sinc((fine - centre) / width).reshape(n, 16).__pow__(2).sum(axis=1) / (16 * width)

    return flux * np.outer(edge(shape[0], row), edge(shape[1], col))


def recording(
    head: Header,
    n_frames: int,
    seed: int,
    *,
    wander: float = 0.5,
    twinkle: float = 0.3,
    sigma: float = 1.1,
    spot: Any = gaussian,
    flux: float = 10000.0,
) -> tuple[Array, Array, Array]:
    """Frames without noise, true displacements (T, 2, S, A) in px (x, y), true fluxes (T, S, A)."""
    rng = np.random.default_rng(seed)
    pitch = head.instrument.lenslet_pitch
    mask = np.array(head.instrument.subaperture_mask)
    boxes = np.argwhere(mask) * pitch
    shape = (n_frames, len(head.sources), len(boxes))
    light = flux * np.exp(twinkle * rng.standard_normal(shape))
    move = wander * rng.standard_normal((n_frames, 2, *shape[1:]))
    frames = np.zeros((n_frames, *(np.array(mask.shape) * pitch)))
    for t, s, a in np.ndindex(*shape):
        row, col = np.array(head.sources[s].spot) + move[t, ::-1, s, a]
        r, c = boxes[a]
        frames[t, r : r + pitch[0], c : c + pitch[1]] += spot(pitch, row, col, light[t, s, a], sigma)
    return frames, move, light


def prepare(head: Header, frames: Array, calibration: Calibration, parameters: ExtractionParameters) -> SpotLayout:
    return layout(head, reference_image(frames), calibration, parameters)


def absolute(slopes: Array, found: SpotLayout) -> Array:
    """Positions (T, 2, S, A) in a box, as (x, y)."""
    return slopes / SCALE + np.moveaxis(found.spots, -1, 0)[None, ::-1]


def by_hand(
    box: Array, found: SpotLayout, s: int, a: int, parameters: ExtractionParameters
) -> tuple[float, float, float]:
    """Row, column and flux of one spot, as the method is described: pixel by pixel, in float64."""
    top, bottom, left, right = found.search[s, a]
    part = box[top : bottom + 1, left : right + 1]
    row, col = np.add(np.unravel_index(np.argmax(part), part.shape), (top, left)).astype(float)
    whole = parameters.method == "moving_maximum"
    light = 0.0
    boost_y, boost_x = (1.0, 1.0) if whole else found.boost[s].astype(float)
    for _ in range(1 if whole else parameters.passes):
        weights = []
        for centre, side, n in zip((row, col), found.window, box.shape, strict=True):
            low, high = centre - side / 2, centre + side / 2
            weights.append([max(min(i + 0.5, high) - max(i - 0.5, low), 0.0) for i in range(n)])
        weighted = np.outer(*weights) * box
        light = weighted.sum()
        rows, cols = np.indices(box.shape)
        row += ((weighted * rows).sum() / light - row) * boost_y
        col += ((weighted * cols).sum() / light - col) * boost_x
    return row, col, light


@pytest.mark.parametrize(
    "parameters", [KEPT, WHOLE, ExtractionParameters(window_x="7.3 pixel", passes=5, wings="kept")]
)
def test_agrees_with_the_method_written_out(parameters: ExtractionParameters) -> None:
    head = header()
    frames, _, _ = recording(head, 5, seed=1)
    frames = np.random.default_rng(2).poisson(frames + 30).astype(np.float32)
    calibration = Calibration(dark=np.full(frames.shape[1:], 30.0))
    found = prepare(head, frames, calibration, parameters)
    slopes, flux, flag = extract(frames, found, calibration, parameters)
    assert not flag.any()
    position = absolute(slopes, found)
    for t, s, a in np.ndindex(*flux.shape):
        r, c = found.boxes[a]
        box = frames[t, r : r + 32, c : c + 32].astype(float) - 30
        row, col, light = by_hand(box, found, s, a, parameters)
        # The kernel sums some 200 pixels in float32: 1e-5 px and 1e-6 of the flux are its rounding.
        assert position[t, 1, s, a] == pytest.approx(row, abs=2e-5)
        assert position[t, 0, s, a] == pytest.approx(col, abs=2e-5)
        assert flux[t, s, a] == pytest.approx(light, rel=2e-6)


def test_finds_known_positions_and_fluxes() -> None:
    head = header()
    frames, move, light = recording(head, 40, seed=3)
    frames = frames.astype(np.float32)
    found = prepare(head, frames, NO_CALIBRATION, DEFAULT)
    slopes, flux, flag = extract(frames, found, NO_CALIBRATION, DEFAULT)
    assert not flag.any()
    nominal = np.array(TWO).T[::-1, :, None]
    # Nine sigma from border to border: nothing is cut off, so what remains is the light of the other Gaussian
    # (5 sigma away), and that two passes end a few thousandths of a pixel short of the third.
    np.testing.assert_allclose(absolute(slopes, found) - nominal, move, atol=5e-3)
    np.testing.assert_allclose(flux, light, rtol=1e-3)
    assert slopes.dtype == flux.dtype == np.float64
    assert flag.dtype == np.uint8
    assert slopes.shape == (40, 2, 2, 5)


def test_gain_with_diffraction_wings() -> None:
    head = header()
    frames, move, light = recording(head, 60, seed=4, spot=airy, sigma=2.0, twinkle=0.2)
    frames = frames.astype(np.float32)
    for parameters, worst in ((DEFAULT, 0.01), (WHOLE, 0.06)):
        found = prepare(head, frames, NO_CALIBRATION, parameters)
        slopes, flux, flag = extract(frames, found, NO_CALIBRATION, parameters)
        assert not flag.any()
        for s, axis in np.ndindex(2, 2):
            a, b = move[:, axis, s].ravel(), slopes[:, axis, s].ravel() / SCALE
            # A window that follows the spot sees all of its motion. Some 2 % of the light in it belong to the wing of
            # the other source, which here moves on its own; the sub-pixel window takes them off.
            gain = 1.0 if parameters is DEFAULT else 0.98
            assert np.polyfit(a, b, 1)[0] == pytest.approx(gain, abs=0.015 + worst)
        # Wings outside the window: about 1 / (pi^2 n) of the light per side, n = half window / width.
        ratio = flux / light
        assert 0.85 < ratio.mean() < 1.0
        assert ratio.std() < 0.05


def test_wings_of_the_other_source_are_taken_off() -> None:
    """A source that twinkles by 50 % leaves a trace in flux and position of a steady one beside it, or none."""
    head = header()
    frames, move, _ = recording(head, 80, seed=40, spot=airy, sigma=2.0, twinkle=0.0, wander=0.3)
    bright, _, more = recording(header(spots=TWO[1:]), 80, seed=41, spot=airy, sigma=2.0, twinkle=0.5, wander=0.3)
    frames = (frames + bright).astype(np.float32)
    traces = []
    for parameters in (KEPT, DEFAULT):
        found = prepare(head, frames, NO_CALIBRATION, parameters)
        slopes, flux, flag = extract(frames, found, NO_CALIBRATION, parameters)
        assert not flag.any()
        error = slopes[:, 1, 0] / SCALE - move[:, 1, 0]
        traces.append([np.polyfit(more[:, 0].ravel(), part.ravel(), 1)[0] * 1e4 for part in (error, flux[:, 0] / 1e4)])
    kept, removed = np.abs(traces)
    # Wings hold some 1.5 % of a spot's light.
    assert kept[0] > 0.01
    assert kept[1] > 0.01
    assert (removed < 0.3 * kept).all(), (kept, removed)


def test_sub_pixel_window_is_smooth_where_the_maximum_jumps() -> None:
    head = header(spots=((15.5, 15.5),))
    steps = np.linspace(-1, 1, 81)
    frames = np.zeros((81, 64, 96), dtype=np.float32)
    for frame, step in zip(frames, steps, strict=True):
        for r, c in np.argwhere(np.array(head.instrument.subaperture_mask)) * 32:
            frame[r : r + 32, c : c + 32] = airy((32, 32), 15.5 + step, 15.5, 10000, 2.0)
    errors = []
    for parameters in (ExtractionParameters(window_x="9 pixel", window_y="9 pixel"), WHOLE):
        found = prepare(head, frames, NO_CALIBRATION, parameters)
        slopes, _, _ = extract(frames, found, NO_CALIBRATION, parameters)
        error = absolute(slopes, found)[:, 1, 0, 0] - (15.5 + steps)
        errors.append(np.abs(np.diff(error)).max())
    smooth, jumping = errors
    assert smooth < 0.004
    assert jumping > 0.02


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32])
def test_every_type_of_frame(dtype: type) -> None:
    head = header()
    frames, _, _ = recording(head, 4, seed=5, flux=900.0, twinkle=0.1)
    frames = np.round(frames)
    assert frames.max() < 256
    found = prepare(head, frames, NO_CALIBRATION, DEFAULT)
    expected = extract(frames.astype(np.float32), found, NO_CALIBRATION, DEFAULT)
    got = extract(frames.astype(dtype), found, NO_CALIBRATION, DEFAULT)
    for a, b in zip(expected, got, strict=True):
        np.testing.assert_array_equal(a, b)


def test_negative_counts_are_kept() -> None:
    head = header()
    frames, _, light = recording(head, 200, seed=6, wander=0.0, twinkle=0.0, flux=5000.0)
    noisy = np.round(frames + np.random.default_rng(7).normal(0, 20, frames.shape)).astype(np.int16)
    assert (noisy < 0).mean() > 0.3
    found = prepare(head, noisy, NO_CALIBRATION, DEFAULT)
    _, flux, flag = extract(noisy, found, NO_CALIBRATION, DEFAULT)
    assert not flag.any()
    # Clipped at zero, the 170 pixels would add 170 * 20 / sqrt(2 pi) = 1356 counts. The scatter of the mean
    # of 2,000 windows is 20 * sqrt(170) / sqrt(2000) = 6 counts; re-centring on noise adds about as much, and what
    # the mean frame tells of the other source's wing has 1.4 * sqrt(170) = 18 counts of noise.
    assert flux.mean() == pytest.approx(light.mean(), abs=40)


def test_dark_and_flat_leave_no_trace() -> None:
    head = header()
    frames, _, _ = recording(head, 6, seed=8)
    rng = np.random.default_rng(9)
    dark = (600 + 30 * rng.standard_normal(frames.shape[1:])).astype(np.float32)
    flat = (1 + 0.05 * rng.standard_normal(frames.shape[1:])).astype(np.float32)
    calibration = Calibration(dark=dark, flat=flat)
    raw = (frames * flat + dark).astype(np.float32)
    plain = extract(frames.astype(np.float32), prepare(head, frames, NO_CALIBRATION, DEFAULT), NO_CALIBRATION, DEFAULT)
    found = prepare(head, raw, calibration, DEFAULT)
    slopes, flux, flag = extract(raw, found, calibration, DEFAULT)
    # float32 frames of 600 counts hold 6e-5 counts of rounding per pixel.
    np.testing.assert_allclose(slopes / SCALE, plain[0] / SCALE, atol=1e-4)
    np.testing.assert_allclose(flux, plain[1], rtol=1e-5)
    assert not flag.any()
    # Left out, the flat alone is worth more than that.
    wrong = extract(raw, prepare(head, raw, Calibration(dark=dark), DEFAULT), Calibration(dark=dark), DEFAULT)
    assert np.abs(wrong[1] / plain[1] - 1).max() > 0.01


def test_background_is_estimated_where_there_is_no_dark() -> None:
    head = header()
    frames, move, light = recording(head, 30, seed=10)
    rows, cols = np.indices(frames.shape[1:])
    raw = np.random.default_rng(11).poisson(frames + 200 + 0.5 * rows - 0.3 * cols).astype(np.uint16)
    nothing = Calibration()
    found = prepare(head, raw, nothing, DEFAULT)
    slopes, flux, flag = extract(raw, found, nothing, DEFAULT)
    assert not flag.any()
    # Photon noise of 200 counts in 170 pixels: 190 counts in the flux and 0.08 px (x), 0.05 px (y).
    assert (flux / light).mean() == pytest.approx(1.0, abs=0.005)
    centred = slopes / SCALE - move
    assert np.abs(centred.mean(axis=0) - centred.mean(axis=(0,), keepdims=True)).max() < 1e-9
    assert centred.std(axis=0).mean() < 0.12
    for axis in range(2):
        assert np.polyfit(move[:, axis].ravel(), slopes[:, axis].ravel() / SCALE, 1)[0] == pytest.approx(1, abs=0.02)


def test_bad_pixels_are_not_seen() -> None:
    head = header()
    frames, move, light = recording(head, 60, seed=12)
    bad = np.zeros(frames.shape[1:], dtype=bool)
    # One beside the core, one on a shoulder, one in the wing, in boxes of their own; the rest is whole.
    for r, c in ((10, 17), (20, 32 + 14), (11, 64 + 19)):
        bad[r, c] = True
    raw = frames.astype(np.float32)
    raw[:, bad] = 4000.0
    raw[::2, bad] = np.nan
    calibration = Calibration(dark=np.zeros(bad.shape), bad_pixel=bad)
    found = prepare(head, np.nan_to_num(raw), calibration, DEFAULT)
    slopes, flux, flag = extract(raw, found, calibration, DEFAULT)
    assert not flag.any()
    nominal = np.array(TWO).T[::-1, :, None]
    error = absolute(slopes, found) - nominal - move
    # The replaced pixel beside the core holds 8 % of the light; it is predicted to about a tenth of that.
    assert np.abs(error).max() < 0.02
    assert np.abs(error.mean(axis=0)).max() < 0.006
    np.testing.assert_allclose(flux, light, rtol=0.015)
    # Slopes must not lean with the motion either.
    for s, a in ((0, 0), (1, 1), (0, 2)):
        for axis in range(2):
            gain = np.polyfit(move[:, axis, s, a], slopes[:, axis, s, a] / SCALE, 1)[0]
            assert gain == pytest.approx(1.0, abs=0.01)


def test_one_bad_pixel_in_a_single_subaperture() -> None:
    head = header(mask=[[1]])
    frames, move, light = recording(head, 60, seed=13)
    bad = np.zeros(frames.shape[1:], dtype=bool)
    bad[11, 17] = True
    raw = frames.astype(np.float32)
    raw[:, bad] = 0.0
    calibration = Calibration(dark=np.zeros(bad.shape), bad_pixel=bad)
    slopes, flux, flag = extract(raw, prepare(head, raw, calibration, DEFAULT), calibration, DEFAULT)
    assert not flag.any()
    # No other subaperture shows what this pixel should hold: less exact, but no more than a few hundredths.
    error = slopes / SCALE - move
    assert np.abs(error - error.mean(axis=0)).max() < 0.06
    np.testing.assert_allclose(flux, light, rtol=0.04)


def test_too_many_bad_pixels() -> None:
    head = header()
    frames, _, _ = recording(head, 10, seed=14)
    bad = np.zeros(frames.shape[1:], dtype=bool)
    bad[8:12, 14:18] = True
    calibration = Calibration(dark=np.zeros(bad.shape), bad_pixel=bad)
    raw = frames.astype(np.float32)
    slopes, flux, flag = extract(raw, prepare(head, raw, calibration, DEFAULT), calibration, DEFAULT)
    assert (flag[:, 0, 0] & FLAGS["bad_pixels"] > 0).all()
    assert np.isnan(slopes[:, :, 0, 0]).all()
    assert np.isnan(flux[:, 0, 0]).all()
    flag[:, 0, 0] = 0
    assert not flag.any()


def test_blank_frames_and_blank_boxes() -> None:
    head = header()
    frames, _, _ = recording(head, 20, seed=15)
    rng = np.random.default_rng(16)
    frames[3] = 0.0
    frames[:, 32:, :32] = 0.0
    raw = np.round(frames + 100 + rng.normal(0, 3, frames.shape)).astype(np.uint16)
    calibration = Calibration(dark=np.full(frames.shape[1:], 100.0))
    slopes, flux, flag = extract(raw, prepare(head, raw, calibration, DEFAULT), calibration, DEFAULT)
    gone = np.zeros(flux.shape, dtype=bool)
    gone[3], gone[..., 3] = True, True
    np.testing.assert_array_equal(np.isnan(flux), gone)
    np.testing.assert_array_equal(np.isnan(slopes), np.broadcast_to(gone[:, None], slopes.shape))
    assert (flag[..., 3] & FLAGS["no_spot"] > 0).all()
    assert (flag[3][:, [0, 1, 2, 4]] & (FLAGS["no_light"] | FLAGS["not_converged"] | FLAGS["window_left"]) > 0).all()
    assert (flag[~gone] == 0).all()


def test_frames_without_any_spot() -> None:
    head = header()
    raw = np.random.default_rng(17).normal(100, 3, (10, 64, 96)).astype(np.float32)
    for calibration in (Calibration(), Calibration(dark=np.full((64, 96), 100.0))):
        slopes, flux, flag = extract(raw, prepare(head, raw, calibration, DEFAULT), calibration, DEFAULT)
        assert np.isnan(slopes).all()
        assert np.isnan(flux).all()
        assert (flag & FLAGS["no_spot"] > 0).all()


def test_not_a_number_never_passes() -> None:
    head = header()
    frames, _, _ = recording(head, 4, seed=18)
    raw = frames.astype(np.float32)
    found = prepare(head, raw, NO_CALIBRATION, DEFAULT)
    clean = extract(raw, found, NO_CALIBRATION, DEFAULT)
    raw[1, 9, 13] = np.nan
    raw[2, 21, 32 + 15] = np.inf
    slopes, flux, flag = extract(raw, found, NO_CALIBRATION, DEFAULT)
    assert np.isnan(slopes[1, :, 0, 0]).all()
    assert np.isnan(flux[2, 1, 1])
    assert flag[1, 0, 0]
    assert flag[2, 1, 1]
    # Other frames and boxes do not notice.
    for t in (0, 3):
        np.testing.assert_array_equal(slopes[t], clean[0][t])
    np.testing.assert_array_equal(slopes[1:3, ..., 2:], clean[0][1:3, ..., 2:])


def test_saturated_spots_are_flagged_and_kept() -> None:
    head = header()
    frames, _, _ = recording(head, 10, seed=19, twinkle=0.0)
    flat = 1 + 0.05 * np.random.default_rng(20).standard_normal(frames.shape[1:])
    dark = np.full(frames.shape[1:], 50.0)
    raw = np.round(frames * flat + dark)
    level = 1200.0
    raw = np.minimum(raw, level).astype(np.uint16)
    calibration = Calibration(dark=dark, flat=flat, saturation=level)
    found = prepare(head, raw, calibration, DEFAULT)
    slopes, flux, flag = extract(raw, found, calibration, DEFAULT)
    expected = np.zeros(flux.shape, dtype=bool)
    for t, s, a in np.ndindex(*flux.shape):
        r, c = found.boxes[a]
        half = raw[t, r + 16 * s : r + 16 * (s + 1), c : c + 32]
        expected[t, s, a] = half.max() >= level
    assert 0.2 < expected.mean() < 1.0
    np.testing.assert_array_equal(flag, np.where(expected, FLAGS["saturated"], 0))
    assert np.isfinite(slopes).all()
    assert np.isfinite(flux).all()


def test_a_hot_pixel_that_is_declared_bad_does_not_saturate() -> None:
    head = header()
    frames, _, _ = recording(head, 5, seed=21)
    raw = frames.astype(np.uint16)
    bad = np.zeros(raw.shape[1:], dtype=bool)
    bad[12, 17] = True
    raw[:, bad] = 60000
    calibration = Calibration(dark=np.zeros(bad.shape), bad_pixel=bad, saturation=50000.0)
    _, _, flag = extract(raw, prepare(head, raw, calibration, DEFAULT), calibration, DEFAULT)
    assert not flag.any()


@pytest.mark.parametrize(
    "spots", [((9.95, 15.5), (21.05, 15.5)), ((15.5, 11.0), (15.5, 20.0)), ((11.0, 11.0), (20.0, 21.0))]
)
def test_a_bright_source_does_not_capture_a_faint_one(spots: tuple[tuple[float, float], ...]) -> None:
    head = header(spots=spots)
    bright, move, light = recording(head, 30, seed=22, wander=0.4)
    boxes = np.argwhere(np.array(head.instrument.subaperture_mask)) * 32
    for t, a in np.ndindex(30, len(boxes)):
        r, c = boxes[a]
        row, col = np.array(spots[1]) + move[t, ::-1, 1, a]
        bright[t, r : r + 32, c : c + 32] += gaussian((32, 32), row, col, 4 * light[t, 1, a], 1.1)
    raw = bright.astype(np.float32)
    found = prepare(head, raw, NO_CALIBRATION, DEFAULT)
    slopes, flux, flag = extract(raw, found, NO_CALIBRATION, DEFAULT)
    assert not flag.any()
    assert np.abs(slopes / SCALE - move - (slopes / SCALE - move).mean(axis=0)).max() < 0.05
    np.testing.assert_allclose(flux[:, 1], 5 * light[:, 1], rtol=0.01)
    np.testing.assert_allclose(flux[:, 0], light[:, 0], rtol=0.05)


def test_a_source_that_goes_out_is_not_replaced_by_the_other() -> None:
    head = header()
    frames, _, _ = recording(head, 12, seed=23)
    alone, _, _ = recording(header(spots=TWO[1:]), 1, seed=24)
    found = prepare(head, frames, NO_CALIBRATION, DEFAULT)
    slopes, flux, flag = extract(alone.astype(np.float32), found, NO_CALIBRATION, DEFAULT)
    assert flag[0, 0].all()
    assert np.isnan(flux[0, 0]).all()
    assert np.isnan(slopes[0, :, 0]).all()
    assert not flag[0, 1].any()


def test_a_window_that_leaves_the_box() -> None:
    head = header(spots=((15.5, 15.5),))
    frames, _, _ = recording(head, 8, seed=25, wander=0.1)
    parameters = ExtractionParameters(window_x="15 pixel", window_y="15 pixel", search="12 pixel")
    found = prepare(head, frames, NO_CALIBRATION, parameters)
    far = np.zeros((1, 64, 96), dtype=np.float32)
    far[0, :32, :32] = gaussian((32, 32), 4.0, 15.5, 10000, 1.1)
    far[0, :32, 32:64] = gaussian((32, 32), 15.5, 8.5, 10000, 1.1)
    slopes, flux, flag = extract(far, found, NO_CALIBRATION, parameters)
    assert flag[0, 0, 0] & FLAGS["window_left"]
    assert np.isnan(slopes[0, :, 0, 0]).all()
    assert np.isnan(flux[0, 0, 0])
    assert flag[0, 0, 1] == 0
    assert slopes[0, 0, 0, 1] / SCALE == pytest.approx(8.5 - found.spots[0, 1, 1], abs=1e-3)


def test_light_without_a_centre_is_not_measured() -> None:
    head = header(spots=((15.5, 15.5),))
    frames, _, _ = recording(head, 8, seed=26, wander=0.1)
    found = prepare(head, frames, NO_CALIBRATION, DEFAULT)
    slope = np.zeros((1, 64, 96), dtype=np.float32)
    # Brightness that grows exponentially along x has no centre: the window runs away, or keeps moving.
    slope[0] = np.exp(0.5 * (np.arange(96) % 32))
    slopes, _, flag = extract(slope, found, NO_CALIBRATION, DEFAULT)
    assert flag.all()
    assert np.isnan(slopes).all()
    assert (flag & (FLAGS["not_converged"] | FLAGS["window_left"]) > 0).all()


def test_automatic_window() -> None:
    frames, _, _ = recording(header(), 10, seed=27, sigma=1.0, wander=0.4)
    found = prepare(header(), frames, NO_CALIBRATION, DEFAULT)
    # The spot, the wander of 0.4 px within the mean frame, and the pixel (1 / sqrt(12) px) add in squares.
    assert found.fwhm == pytest.approx(2.355 * np.sqrt(1 + 0.4**2 + 1 / 12), rel=0.05)
    assert found.window == pytest.approx((0.9 * 11.1, 17.0))
    for spots, order in ((((15.5, 9.95), (15.5, 21.05)), 1), (((15.5, 15.5),), None)):
        frames, _, _ = recording(header(spots=spots), 10, seed=28)
        window = prepare(header(spots=spots), frames, NO_CALIBRATION, DEFAULT).window
        if order is None:
            assert window[0] == window[1] > 14
        else:
            assert window[order] == pytest.approx(0.9 * 11.1)
            assert window[0] > 14
    whole = prepare(
        header(), recording(header(), 4, seed=29)[0], NO_CALIBRATION, ExtractionParameters(method="moving_maximum")
    )
    assert whole.window == (9.0, 9.0)


def test_spots_are_found_within_a_pixel_of_their_nominal_place() -> None:
    head = header()
    frames, _, _ = recording(head, 4, seed=30, wander=0.0, twinkle=0.0)
    shifted = header(spots=tuple((row + 0.8, col - 0.9) for row, col in TWO))
    found = prepare(shifted, frames, NO_CALIBRATION, DEFAULT)
    np.testing.assert_allclose(found.spots, np.broadcast_to(np.array(TWO)[:, None], found.spots.shape), atol=0.003)
    np.testing.assert_allclose(found.flux, 10000, rtol=1e-3)


def test_response_to_a_known_tilt() -> None:
    head = header()
    frames, _, _ = recording(head, 30, seed=31, spot=airy, sigma=2.0, wander=0.3)
    found = prepare(head, frames, NO_CALIBRATION, DEFAULT)
    gain = response_to_tilt(found, DEFAULT)
    assert gain.shape == (2, 2)
    assert np.abs(gain - 1).max() < 0.01
    # Between its jumps the gain of a window around the brightest pixel is below one, as its borders cut off what moves
    # out. Moves of a third of a pixel around a pixel's centre never leave it.
    whole = ExtractionParameters(method="moving_maximum", window_x="5 pixel", window_y="5 pixel")
    frames, _, _ = recording(header(spots=((16.0, 16.0),)), 2, seed=32, sigma=1.4, wander=0.0)
    poor = response_to_tilt(prepare(header(spots=((16.0, 16.0),)), frames, NO_CALIBRATION, whole), whole, reach=0.3)
    moves = np.linspace(-0.3, 0.3, 11)
    positions = []
    for move in moves:
        box = gaussian((32, 32), 16.0 + move, 16.0, 1.0, 1.4)
        weight = np.zeros((32, 32))
        weight[14:19, 14:19] = 1
        positions.append((box * weight * np.arange(32)[:, None]).sum() / (box * weight).sum())
    assert poor[1, 0] == pytest.approx(np.polyfit(moves, positions, 1)[0], abs=0.01)
    assert poor[1, 0] < 0.9


def test_lenslet_origin_and_lenslets_that_are_not_exploited() -> None:
    head = header()
    frames, _, _ = recording(head, 6, seed=33)
    plain = extract(frames.astype(np.float32), prepare(head, frames, NO_CALIBRATION, DEFAULT), NO_CALIBRATION, DEFAULT)
    wider = np.full((6, 80, 111), 7.0)
    wider[:, 5:69, 9:105] = frames
    wider[:, 5 + 32 : 69, 9 + 32 : 9 + 64] = 5000.0
    moved = head.model_copy(update={"instrument": head.instrument.model_copy(update={"lenslet_origin": (5, 9)})})
    calibration = Calibration(dark=np.zeros((80, 111)))
    found = prepare(moved, wider, calibration, DEFAULT)
    got = extract(wider.astype(np.float32), found, calibration, DEFAULT)
    for a, b in zip(plain, got, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("pitch", [(32, 32), (24, 19), (41, 50)])
def test_boxes_of_any_size(pitch: tuple[int, int]) -> None:
    spots = ((pitch[0] / 2 - 0.2, pitch[1] / 2 - 0.7),)
    head = header(spots=spots, pitch=pitch)
    frames, move, light = recording(head, 20, seed=34)
    calibration = Calibration(dark=np.zeros(frames.shape[1:]))
    found = prepare(head, frames, calibration, DEFAULT)
    slopes, flux, flag = extract(frames.astype(np.float32), found, calibration, DEFAULT)
    assert not flag.any()
    error = slopes / SCALE - move
    assert np.abs(error - error.mean(axis=0)).max() < 5e-3
    np.testing.assert_allclose(flux, light, rtol=2e-3)


def test_refuses_what_does_not_fit() -> None:
    head = header()
    frames, _, _ = recording(head, 2, seed=35)
    found = prepare(head, frames, NO_CALIBRATION, DEFAULT)
    with pytest.raises(ValueError, match="int32"):
        extract(frames.astype(np.int32), found, NO_CALIBRATION, DEFAULT)
    with pytest.raises(ValueError, match="do not fit"):
        extract(frames[:, :-1].astype(np.float32), found, NO_CALIBRATION, DEFAULT)
    with pytest.raises(ValueError, match="64 x 96"):
        layout(head, frames[0, :, :-3], Calibration(), DEFAULT)
    with pytest.raises(ValueError, match="flat has shape"):
        layout(head, frames[0], Calibration(flat=np.ones((3, 3))), DEFAULT)
    with pytest.raises(ValueError, match="does not fit into a box"):
        layout(head, frames[0], NO_CALIBRATION, ExtractionParameters(window_x="40 pixel"))
    with pytest.raises(ValueError, match="at least one frame"):
        reference_image(frames[:0])


def test_inputs_are_left_alone() -> None:
    head = header()
    frames, _, _ = recording(head, 2, seed=36)
    raw = frames.astype(np.uint16)
    raw.flags.writeable = False
    dark = np.zeros(raw.shape[1:], dtype=np.float32)
    dark.flags.writeable = False
    calibration = Calibration(dark=dark)
    found = prepare(head, raw, calibration, DEFAULT)
    first = extract(raw, found, calibration, DEFAULT)
    second = extract(raw[:, :, :], replace(found), calibration, DEFAULT)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("method", "worst", "spread"),
    # A threshold makes pixels come and go as a spot moves; a fit with the mean spot, which is broader by the wander of
    # the spots, loses light.
    [("thresholded", 0.06, 0.002), ("weighted", 0.03, 0.002), ("template", 0.03, 0.03)],
)
def test_other_methods_on_everything_a_detector_does(method: Any, worst: float, spread: float) -> None:
    head = header()
    frames, move, light = recording(head, 60, seed=50, wander=0.3)
    rng = np.random.default_rng(51)
    dark = (600 + 30 * rng.standard_normal(frames.shape[1:])).astype(np.float32)
    flat = (1 + 0.05 * rng.standard_normal(frames.shape[1:])).astype(np.float32)
    bad = np.zeros(frames.shape[1:], dtype=bool)
    bad[11, 18] = bad[20, 32 + 13] = True
    raw = (frames * flat + dark).astype(np.float32)
    raw[:, bad] = np.nan
    parameters = ExtractionParameters(method=method)
    calibration = Calibration(dark=dark, flat=flat, bad_pixel=bad, saturation=3500.0)
    found = prepare(head, np.nan_to_num(raw), calibration, parameters)
    spoilt = raw.copy()
    spoilt[3, :32, :32] = dark[:32, :32]
    spoilt[4, 9, 15] = np.nan
    spoilt[5, 10, 15] = 4000.0
    slopes, flux, flag = extract(spoilt, found, calibration, parameters)
    others = sum(FLAGS.values()) - FLAGS["saturated"]
    assert flag[3, :, 0].all()
    assert flag[4, 0, 0] & others
    assert np.isnan(slopes[3:5, :, 0, 0]).all()
    assert np.isnan(flux[3:5, 0, 0]).all()
    assert flag[5, 0, 0] & FLAGS["saturated"]
    slopes, flux, flag = extract(raw, found, calibration, parameters)
    assert not (flag & others).any()
    error = slopes / SCALE - move
    error -= error.mean(axis=0)
    # The replaced pixels are worth 0.02 px, as in the sub-pixel window.
    assert np.abs(error).max() < worst
    ratio = flux / light
    assert (ratio / ratio.mean()).std() < spread + 0.005
    for part in (slice(0, 7), slice(7, 60)):
        for whole, cut in zip((slopes, flux, flag), extract(raw[part], found, calibration, parameters), strict=True):
            np.testing.assert_array_equal(whole[part], cut)


# --- how it is computed changes nothing --------------------------------------------------------------------


@pytest.mark.parametrize("margin", [-4.0, 0.0, 8.0])
def test_the_part_that_is_calibrated_first_does_not_matter(margin: float, monkeypatch: pytest.MonkeyPatch) -> None:
    head = header()
    frames, _, _ = recording(head, 60, 5, wander=1.2)
    frames = frames.round().astype(np.uint16)
    bad = np.random.default_rng(2).random(frames.shape[1:]) < 0.01
    calibration = Calibration(dark=np.zeros(frames.shape[1:]), bad_pixel=bad)
    found = prepare(head, frames, calibration, DEFAULT)
    usual = extract(frames, found, calibration, DEFAULT)
    monkeypatch.setattr("coslidar.pipeline.spots.USUAL", margin)
    other = extract(frames, replace(found), calibration, DEFAULT)
    assert not np.array_equal(replace(found).usual[0], found.usual[0])
    # Sums in another order: float32 of a position of some 16 px.
    np.testing.assert_allclose(other[0], usual[0], rtol=0, atol=1e-5 * SCALE)
    np.testing.assert_allclose(other[1], usual[1], rtol=1e-5)
    np.testing.assert_array_equal(other[2], usual[2])


@pytest.mark.parametrize("width", [13, 20, 27])
def test_boxes_of_any_width_are_calibrated_whole(width: int) -> None:
    spot = ((10.2, (width - 1) / 2),)
    head = header(spot, pitch=(21, width))
    frames, _, _ = recording(head, 20, 3, wander=0.3, sigma=0.8)
    flat = 1 + 0.1 * np.random.default_rng(1).standard_normal(frames.shape[1:])
    calibration = Calibration(dark=np.full(flat.shape, 100.0), flat=flat)
    raw = (frames * flat + 100).astype(np.float32)
    found = prepare(head, raw, calibration, DEFAULT)
    slopes, flux, flag = extract(raw, found, calibration, DEFAULT)
    assert not flag.any()
    place = absolute(slopes, found)
    for t, a in ((0, 0), (7, 2), (19, 4)):
        r, c = found.boxes[a]
        row, col, light = by_hand(frames[t, r : r + 21, c : c + width], found, 0, a, DEFAULT)
        assert place[t, :, 0, a] == pytest.approx([col, row], rel=1e-5)
        assert flux[t, 0, a] == pytest.approx(light, rel=1e-4)


def test_results_are_put_where_they_are_asked_for() -> None:
    head = header()
    frames, _, _ = recording(head, 10, 4)
    found = prepare(head, frames.astype(np.float32), NO_CALIBRATION, DEFAULT)
    own = extract(frames.astype(np.float32), found, NO_CALIBRATION, DEFAULT)
    out = tuple(np.empty_like(array) for array in own)
    assert extract(frames.astype(np.float32), found, NO_CALIBRATION, DEFAULT, out)[0] is out[0]
    for one, other in zip(own, out, strict=True):
        np.testing.assert_array_equal(one, other)


def test_another_process_finds_the_kernel_in_the_cache() -> None:
    # Numba's key holds what a closure refers to; of a compiled function that differs from process to process.
    kernel: Any = window_kernel(32, 24, 8, 9, 24)
    held = [cell.cell_contents for cell in kernel.py_func.__closure__]
    assert not [value for value in held if isinstance(value, Dispatcher)]
