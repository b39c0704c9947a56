"""The mean spot of each source alone, out of a mean image that shows both."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from .shifts import cubic_taps
from .spots import WING_STEP

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .spots import SpotLayout

    Floats = NDArray[np.float64]

#: How often the light of the other source is estimated and removed. Its wing holds a few per mille of the light of a
#: spot, so what it changes in the other's wing is nothing.
ROUNDS = 2


def mean_spots(layout: SpotLayout) -> Floats:
    """Mean spot of each source without the light of the other.

    Half of the box belongs to either source. In the other half, and beyond the box, a spot's wings are taken from
    where they are seen: a quarter turn, or half a turn, around its centre, as the lenslets are square.

    Parameters
    ----------
    layout : SpotLayout
        Mean boxes with the spots of a source in one place.

    Returns
    -------
    ndarray of float64, (S, 2 r + 1, 2 r + 1)
        r is the longer side of a box. The spot is in the middle; the sum over the layout's window is 1.
    """
    reach = max(layout.pitch)
    steps = np.arange(-reach, reach + 1.0)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"))
    light = [max(float(flux.mean()), 1e-30) for flux in layout.flux]
    seen = []
    for source, centre in enumerate(layout.centre):
        at = grid + centre[:, None, None]
        own = ((at >= 0) & (at <= np.array(layout.pitch)[:, None, None] - 1)).all(axis=0)
        if len(layout.centre) == 2:
            apart = layout.centre[1 - source] - centre
            own &= np.tensordot(apart, grid, 1) < 0.5 * (apart @ apart)
        seen.append(own)
    spots = np.zeros((len(layout.centre), *grid.shape[1:]))
    for _ in range(ROUNDS if len(spots) == 2 else 1):
        alone = np.empty_like(spots)
        for source, (image, centre) in enumerate(zip(layout.template, layout.centre, strict=True)):
            at = grid + centre[:, None, None]
            values = ndimage.map_coordinates(image, at, order=3, mode="nearest")
            if len(spots) == 2:
                apart = layout.centre[1 - source] - centre
                other = ndimage.shift(spots[1 - source], apart, order=3, mode="constant")
                values -= light[1 - source] * other
            alone[source] = _completed(values / light[source], seen[source])
            alone[source] /= (alone[source] * np.outer(*(_cover(steps, side) for side in layout.window))).sum()
        spots = alone
    return spots


def _completed(values: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Values where they are seen, else those after a quarter turn to either side, half a turn, and at last nothing."""
    result, known = np.where(seen, values, 0.0), seen.copy()
    quarters = [(np.rot90(values, turn), np.rot90(seen, turn)) for turn in (1, 3)]
    both = np.sum([there for _, there in quarters], axis=0)
    mean = np.sum([np.where(there, value, 0.0) for value, there in quarters], axis=0) / np.maximum(both, 1)
    for value, there in ((mean, both > 0), (np.rot90(values, 2), np.rot90(seen, 2))):
        result = np.where(~known & there, value, result)
        known |= there
    return np.asarray(result)


def wings(spots: Floats, layout: SpotLayout, reach: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Light and first moments of the other source's spot in the window of each source.

    Parameters
    ----------
    spots : ndarray, (2, n, n)
        From :func:`mean_spots`.
    layout : SpotLayout
        Window, and where the spots of either source lie.
    reach : float
        How far the spots may move from there, relative to each other, px.

    Returns
    -------
    ndarray of float32, (2, m, m, 3), and ndarray of float32, (2, 2)
        `wings` and `wing_start` of a layout.
    """
    middle = spots.shape[1] // 2
    steps = np.arange(-middle, middle + 1.0)
    places = np.arange(-reach, reach + WING_STEP / 2, WING_STEP)
    covers = [_cover(steps, side) for side in layout.window]
    weights = [np.stack([cover, cover * steps]) for cover in covers]
    table = np.empty((2, len(places), len(places), 3), dtype=np.float32)
    start = np.empty((2, 2), dtype=np.float32)
    for source in range(2):
        apart = layout.centre[1 - source] - layout.centre[source]
        start[source] = apart + places[0]
        spline = ndimage.spline_filter(spots[1 - source], order=3)
        rows, cols = (_under(weight, middle + places) for middle, weight in zip(apart, weights, strict=True))
        sums = np.tensordot(rows @ spline, cols, (2, 2))  # place, moment of rows, place, moment of columns
        table[source] = np.stack([sums[:, 0, :, 0], sums[:, 1, :, 0], sums[:, 0, :, 1]], axis=-1)
    return table, start


def _under(weight: Floats, shift: Floats) -> Floats:
    """Sums of weights (2, n) under the cubic B-spline of each coefficient that is moved by each shift, (m, 2, n)."""
    size = weight.shape[1]
    at = np.arange(size) + shift[:, None]
    first = np.floor(at).astype(np.int64) - 1
    taps = cubic_taps(at - np.floor(at))
    padded = np.pad(weight, ((0, 0), (1, 1)))  # nothing beyond the ends
    total = np.zeros((2, *at.shape))
    for number, tap in enumerate(taps):
        total += tap * padded[:, np.clip(first + number, -1, size) + 1]
    return np.asarray(total.transpose(1, 0, 2))


def window_response(spots: Floats, layout: SpotLayout) -> Floats:
    """Motion of the centre of gravity in a window that stays in place, per motion of the spot, (S, 2) along y and x."""
    middle = spots.shape[1] // 2
    steps = np.arange(-middle, middle + 1.0)
    return fixed_response(spots, *(_cover(steps, side) for side in layout.window))


def fixed_response(spots: Floats, weight_y: Floats, weight_x: Floats) -> Floats:
    """Motion of the centre of gravity under a fixed weight, per motion of the spot.

    Parameters
    ----------
    spots : ndarray, (S, n, n)
        From :func:`mean_spots`.
    weight_y, weight_x : ndarray, (n,)
        The weight is their product.

    Returns
    -------
    ndarray, (S, 2)
        Along y and x, from motions of a quarter of a pixel to either side.
    """
    middle = spots.shape[1] // 2
    steps = np.arange(-middle, middle + 1.0)
    response = np.empty((len(spots), 2))
    for source, axis in np.ndindex(*response.shape):
        moment = []
        for move in (-0.25, 0.25):
            shift = [move, 0.0] if axis == 0 else [0.0, move]
            light = np.outer(weight_y, weight_x) * ndimage.shift(spots[source], shift, order=3)
            moment.append(float((light.sum(axis=1 - axis) * steps).sum() / light.sum()))
        response[source, axis] = (moment[1] - moment[0]) / 0.5
    return response


def _cover(steps: Floats, side: float) -> Floats:
    """Part of each pixel that a window of this size around the middle covers."""
    return np.asarray(np.clip(side / 2 + 0.5 - np.abs(steps), 0.0, 1.0))
