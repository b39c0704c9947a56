"""Bad pixels: what they would hold, predicted from their neighbours so that spots are measured without bias."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

#: Pixels (rows, columns away) that predict a bad one.
NEIGHBOURS = tuple((y, x) for y in range(-2, 3) for x in range(-2, 3) if 0 < y * y + x * x <= 4)


def fill(signal: Floats, bad: NDArray[np.bool_], typical: Floats) -> Floats:
    """Boxes whose bad pixels hold the typical box, scaled to the good pixels around them."""
    filled = np.where(bad, 0.0, signal)
    for box, row, col in np.argwhere(bad):
        around = (slice(max(row - 2, 0), row + 3), slice(max(col - 2, 0), col + 3))
        good = ~bad[box][around]
        model = float((typical[around] * good * typical[around]).sum())
        ratio = float((filled[box][around] * good * typical[around]).sum()) / model if model > 0 else 0.0
        filled[box, row, col] = typical[row, col] * ratio
    return filled


def no_bad_pixels(
    n_boxes: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """What `predictors` returns for boxes without bad pixels."""
    count = len(NEIGHBOURS)
    return (
        np.zeros(n_boxes + 1, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros((0, count), dtype=np.int64),
        np.zeros((0, count), dtype=np.float32),
    )


def predictors(
    bad: NDArray[np.bool_], spots: Floats, template: Floats, centre: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Weights that predict each bad pixel from its good neighbours.

    Trained on each source's template moved to a grid of sub-pixel positions around its mean position, so that
    the prediction holds for a spot of any brightness anywhere near its place. A ridge of half a per cent of the
    template's peak stands for the noise.
    """
    n_boxes, rows, cols = bad.shape
    start = np.concatenate([[0], np.cumsum(bad.reshape(n_boxes, -1).sum(axis=1))]).astype(np.int64)
    if start[-1] == 0:
        return no_bad_pixels(n_boxes)
    index = np.zeros(start[-1], dtype=np.int64)
    neighbour = np.zeros((start[-1], len(NEIGHBOURS)), dtype=np.int64)
    weight = np.zeros((start[-1], len(NEIGHBOURS)), dtype=np.float32)
    splines = [ndimage.spline_filter(image, order=3, mode="nearest") for image in template]
    steps = np.linspace(-1.5, 1.5, 13)
    shift = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    likely = np.exp(-0.5 * (shift**2).sum(axis=-1) / 0.7**2)
    for number, (box, row, col) in enumerate(np.argwhere(bad)):
        index[number] = row * cols + col
        usable = [
            slot
            for slot, (dy, dx) in enumerate(NEIGHBOURS)
            if 0 <= row + dy < rows and 0 <= col + dx < cols and not bad[box, row + dy, col + dx]
        ]
        pixels = np.array([(row, col), *((row + NEIGHBOURS[slot][0], col + NEIGHBOURS[slot][1]) for slot in usable)])
        neighbour[number, : len(usable)] = pixels[1:, 0] * cols + pixels[1:, 1]
        normal = np.zeros((len(usable), len(usable)))
        right = np.zeros(len(usable))
        for source, spline in enumerate(splines):
            at = pixels[None] - shift[:, None] + (centre[source] - spots[source, box])
            values = ndimage.map_coordinates(spline, at.reshape(-1, 2).T, order=3, mode="nearest", prefilter=False)
            values = values.reshape(at.shape[:2]) / template[source].max()
            normal += (values[:, 1:].T * likely) @ values[:, 1:]
            right += (values[:, 1:].T * likely) @ values[:, 0]
        normal += np.eye(len(usable)) * 0.005**2 * likely.sum()
        weight[number, : len(usable)] = np.linalg.solve(normal, right) if usable else 0.0
    return start, index, neighbour, weight


def light_on(
    bad: NDArray[np.bool_], spots: Floats, template: Floats, centre: Floats, window: tuple[float, float]
) -> Floats:
    """Part of each spot's light that falls on bad pixels, (S, A)."""
    light = np.zeros(spots.shape[:2])
    rows, cols = np.indices(bad.shape[1:])
    for source, box in np.ndindex(light.shape):
        hole = bad[box]
        if hole.any():
            row, col = spots[source, box]
            near = (np.abs(rows - row) < window[0] / 2) & (np.abs(cols - col) < window[1] / 2)
            image = ndimage.shift(template[source], spots[source, box] - centre[source], order=1, mode="nearest")
            total = float(image[near].sum())
            light[source, box] = float(image[near & hole].sum()) / total if total > 0 else 1.0
    return light
