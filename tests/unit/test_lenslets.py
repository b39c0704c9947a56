"""The lenslet grid found on images that are drawn here, spot by spot, from a known grid."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from coslidar.pipeline.lenslets import NoGrid, boxes, find_grid

Floats = NDArray[np.float64]


def draw(
    shape: tuple[int, int],
    places: Floats,
    *,
    fwhm: float = 3.0,
    peak: float | Floats = 1000.0,
    background: float = 100.0,
    noise: float = 3.0,
    seed: int = 0,
) -> Floats:
    """Image with a Gaussian spot at each of `places` (n, 2)."""
    rng = np.random.default_rng(seed)
    rows, cols = np.arange(shape[0])[:, None], np.arange(shape[1])
    image = background + rng.normal(0, noise, shape)
    sigma = fwhm / 2.3548
    for (row, col), height in zip(places, np.broadcast_to(peak, len(places)), strict=True):
        image += height * np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / (2 * sigma**2))
    return image


def places_of(
    mask: NDArray[Any], origin: tuple[float, float], pitch: tuple[float, float], spots: list[tuple[float, float]]
) -> Floats:
    """Spots of boxes as format 1 defines them."""
    boxed = np.argwhere(mask) * pitch + origin
    return np.concatenate([boxed + spot for spot in spots])


RING = np.array([[0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [1, 1, 0, 1, 1], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0]])
FULL = np.ones((6, 8), int)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("mask", "origin", "pitch", "spots", "fwhm"),
    [
        (RING, (0, 0), (32, 32), [(9.95, 15.5), (21.05, 15.5)], 3.0),
        (RING, (0, 0), (20, 20), [(5.34, 9.5), (13.66, 9.5)], 2.3),
        (RING, (7, 11), (24, 24), [(11.5, 11.5)], 4.0),
        (FULL, (3, 0), (16, 10), [(3.9, 4.5), (11.1, 4.5)], 2.0),
        (FULL, (5, 9), (18, 22), [(8.5, 5.2), (8.5, 15.8)], 3.0),  # sources side by side
        (FULL, (0, 0), (40, 40), [(12.0, 14.0), (27.0, 25.0)], 8.0),  # oblique, wide spots
        (np.ones((2, 3), int), (4, 4), (30, 30), [(9.5, 14.5), (19.5, 14.5)], 3.0),
        (np.ones((20, 20), int), (1, 2), (12, 12), [(5.5, 5.5)], 2.5),
    ],
)
def test_what_was_drawn_is_found(
    mask: NDArray[Any], origin: Any, pitch: Any, spots: list[tuple[float, float]], fwhm: float, seed: int
) -> None:
    shape = (origin[0] + mask.shape[0] * pitch[0] + 3, origin[1] + mask.shape[1] * pitch[1] + 5)
    image = draw(shape, places_of(mask, origin, pitch, spots), fwhm=fwhm, seed=seed)
    grid = find_grid(image)
    found = boxes(grid, shape)
    assert not found.faults
    assert found.origin == origin
    assert found.pitch == pitch
    np.testing.assert_array_equal(found.mask, mask)
    # Peaks of noise 3 on a height of 1000 are good to a few hundredths of a pixel; the parabola through an undersampled
    # spot adds some.
    np.testing.assert_allclose(found.spots, spots, atol=0.1)
    assert grid.pitch == pytest.approx(pitch, abs=0.03)
    assert grid.fwhm == pytest.approx(fwhm, rel=0.25, abs=0.6)
    assert found.misfit < 0.1


def test_level_slope_and_scale_of_the_background_change_nothing() -> None:
    shape = (160, 160)
    image = draw(shape, places_of(RING, (0, 0), (32, 32), [(9.95, 15.5), (21.05, 15.5)]))
    rows, cols = np.indices(shape)
    before = boxes(find_grid(image), shape)
    for other in (
        3.7 * image - 2000,
        image + 10.0 * rows - 6.0 * cols,
        image + 3000 * np.exp(-((rows - 80) ** 2 + (cols - 60) ** 2) / 5000),
    ):
        found = boxes(find_grid(other), shape)
        assert (found.origin, found.pitch) == (before.origin, before.pitch)
        np.testing.assert_array_equal(found.mask, before.mask)
        np.testing.assert_allclose(found.spots, before.spots, atol=0.15)


def test_hot_dead_and_missing_pixels_do_not_matter() -> None:
    shape = (160, 160)
    image = draw(shape, places_of(RING, (0, 0), (32, 32), [(9.95, 15.5), (21.05, 15.5)]))
    rng = np.random.default_rng(1)
    at = tuple(rng.integers(0, 160, (2, 120)))
    bad = np.zeros(shape, bool)
    image[at[0][:40], at[1][:40]] += 20000
    image[at[0][40:80], at[1][40:80]] = 0
    image[at[0][80:], at[1][80:]] = np.nan
    image[:, 77] += 5000
    bad[:, 77] = True
    image[100, 20:23] = 60000
    bad[100, 20:23] = True
    found = boxes(find_grid(image, bad_pixel=bad), shape)
    assert (found.origin, found.pitch) == ((0, 0), (32, 32))
    np.testing.assert_array_equal(found.mask, RING)


def test_dim_lenslets_are_not_illuminated() -> None:
    places = places_of(FULL, (0, 0), (20, 20), [(9.5, 9.5)])
    peak = np.full(len(places), 1000.0)
    peak[:8] = 120  # the first row of lenslets gets a tenth
    peak[8:16] = 700
    shape = (120, 160)
    found = boxes(find_grid(draw(shape, places, peak=peak)), shape)
    assert found.origin == (20, 0)
    assert found.mask.shape == (5, 8)
    assert found.mask.all()
    everything = boxes(find_grid(draw(shape, places, peak=peak), illuminated=0.05), shape)
    assert everything.mask.shape == (6, 8)


def turned(angle: float, pitch: tuple[float, float] = (24.0, 24.0), size: int = 10) -> tuple[Floats, tuple[int, int]]:
    index = np.argwhere(np.ones((size, size))) - (size - 1) / 2
    a = np.array([math.cos(angle), math.sin(angle)]) * pitch[0]
    b = np.array([-math.sin(angle), math.cos(angle)]) * pitch[1]
    side = int(size * max(pitch) * 1.3)
    return index[:, :1] * a + index[:, 1:] * b + side / 2, (side, side)


@pytest.mark.parametrize("degrees", [-20.0, -1.5, 0.0, 0.4, 3.0, 30.0])
def test_a_turned_grid_is_measured_and_refused(degrees: float) -> None:
    places, shape = turned(math.radians(degrees))
    grid = find_grid(draw(shape, places))
    assert grid.kind == "rectangular"
    assert math.degrees(grid.rotation) == pytest.approx(degrees, abs=0.03)
    assert grid.pitch == pytest.approx((24, 24), abs=0.01)
    found = boxes(grid, shape)
    # A lenslet at the corner of a grid of 10 is sqrt(2) 4.5 pitches from its centre.
    expected = 2 * math.sin(abs(math.radians(degrees)) / 2) * math.sqrt(2) * 4.5 * 24
    if expected > 1:
        assert "the grid is turned by" in found.faults[0]
    else:
        assert not found.faults
        assert found.misfit == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(("pitch", "fits"), [(20.0, True), (20.15, True), (20.4, False), (21.5, False)])
def test_a_pitch_that_is_no_whole_number_is_told(pitch: float, fits: bool) -> None:
    places, shape = turned(0.0, (pitch, 20.0))
    found = boxes(find_grid(draw(shape, places)), shape)
    # The error grows from the middle of 10 lenslets to 4.5 of them.
    assert found.misfit == pytest.approx(4.5 * abs(pitch - round(pitch)), abs=0.05)
    assert (not found.faults) == fits
    if not fits:
        assert "the pitch is" in found.faults[0]
        assert "resample" in found.faults[0]


def test_a_hexagonal_array_is_named_and_refused() -> None:
    index = np.argwhere(np.ones((10, 10)))
    places = index @ np.array([[26.0 * math.sqrt(3) / 2, 13.0], [0.0, 26.0]]) + 20
    shape = (260, 420)
    grid = find_grid(draw(shape, places))
    assert grid.kind == "hexagonal"
    assert grid.pitch == pytest.approx((26, 26), abs=0.02)
    assert "a hexagonal array" in boxes(grid, shape).faults[0]


def test_three_spots_in_a_box_are_refused() -> None:
    places = places_of(FULL, (0, 0), (40, 40), [(8.0, 20.0), (21.0, 9.0), (27.0, 29.0)])
    grid = find_grid(draw((240, 320), places))
    assert grid.n_sources == 3
    assert "3 spots in each box" in boxes(grid, (240, 320)).faults[0]


def test_boxes_off_the_detector_are_left_out() -> None:
    places = places_of(np.ones((6, 6), int), (-12, 0), (30, 30), [(14.5, 14.5)])
    shape = (180, 180)
    found = boxes(find_grid(draw(shape, places)), shape)
    assert found.origin == (18, 0)
    assert found.mask.shape == (5, 6)
    assert "reach beyond the detector" in found.notes[0]


def test_a_box_that_overlaps_the_border_by_less_than_a_pixel_is_moved_onto_the_detector() -> None:
    places = places_of(FULL, (0, 0), (20, 20), [(8.8, 10.1)])  # the mean tilt moves all spots
    found = boxes(find_grid(draw((120, 160), places)), (120, 160))
    assert found.origin == (0, 0)
    np.testing.assert_allclose(found.spots, [(8.8, 10.1)], atol=0.1)


def test_spots_without_order_are_no_grid() -> None:
    rng = np.random.default_rng(4)
    with pytest.raises(NoGrid, match="no regular grid"):
        find_grid(draw((300, 300), rng.uniform(5, 295, (80, 2))))


def test_evenly_lit_lenslets_are_no_spots() -> None:
    rows, cols = np.indices((240, 240))
    inside = (np.abs(rows % 24 - 11.5) < 10) & (np.abs(cols % 24 - 11.5) < 10)
    image = 1000.0 + 300 * inside + np.random.default_rng(0).normal(0, 30, rows.shape)
    with pytest.raises(NoGrid):
        find_grid(image)


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.full((64, 64), 7.0), "all pixels are alike"),
        (np.full((64, 64), np.nan), "no pixel is good"),
        (np.random.default_rng(0).normal(100, 5, (200, 200)), "no grid|needs 4"),
        (np.add.outer(np.arange(100.0), np.arange(100.0)), "needs 4"),
        (draw((100, 100), np.array([[50.0, 50.0]])), "needs 4"),
    ],
)
def test_images_without_spots_are_refused_with_a_reason(image: Floats, reason: str) -> None:
    with pytest.raises(NoGrid, match=reason):
        find_grid(image)


@pytest.mark.parametrize("shape", [(3, 3), (50,), (4, 50, 50)])
def test_what_is_no_image_is_an_error(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="is no frame"):
        find_grid(np.zeros(shape))
