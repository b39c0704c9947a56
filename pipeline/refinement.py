"""Positions of spots that a window has found already, measured in another way: threshold, weight, fit.

Each of the compiled loops takes what the window measured as its start, leaves alone what is flagged, and writes
positions in the lenslet box. A position that does not converge, or leaves the box, is flagged.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.interpolate import BSpline

from .mean_spot import fixed_response, mean_spots
from .spots import FLAGS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .parameters import ExtractionParameters
    from .spots import SpotLayout

    Floats = NDArray[np.float64]

#: Steps per pixel at which the fitted spot is tabulated; in between it is expanded to first order.
STEPS = 8
#: The fit looks at pixels so many full widths of the spot around it: its wings beyond hold noise.
FIT_REACH = 1.5
#: Full width of the weight, in units of the spot's.
WEIGHT_WIDTH = 2.0
#: A weight is cut where it has fallen to about e^(-8).
WEIGHT_REACH = 1.7
#: Largest last step of a position that has converged, px.
SETTLED = 0.1

#: The bit with which a measurement is kept.
_KEPT = FLAGS["saturated"]
_WINDOW_LEFT, _NOT_CONVERGED, _NO_LIGHT = (FLAGS[name] for name in ("window_left", "not_converged", "no_light"))
_RELAXED = {"reassoc", "contract", "nsz", "arcp"}


class _Boxes(NamedTuple):
    """How the boxes are read and calibrated; see :class:`coslidar.pipeline.spots.SpotLayout`."""

    corner: NDArray[np.int64]
    pitch: tuple[int, int]
    scale: NDArray[np.float32]
    offset: NDArray[np.float32]
    bad_start: NDArray[np.int64]
    bad_index: NDArray[np.int64]
    bad_neighbour: NDArray[np.int64]
    bad_weight: NDArray[np.float32]


def refine(
    frames: NDArray[Any],
    layout: SpotLayout,
    parameters: ExtractionParameters,
    position: Floats,
    flux: Floats,
    flag: NDArray[np.uint8],
) -> None:
    """Measure positions again, in place.

    Parameters
    ----------
    frames : ndarray, (T, row, col)
        Raw counts.
    layout : SpotLayout
        Spots, calibration, mean spots.
    parameters : ExtractionParameters
        Method and its parameters.
    position : ndarray, (T, 2, S, A)
        Along x and y in the box, px; of the window at first.
    flux : ndarray, (T, S, A)
        Of the window; only a fit changes it.
    flag : ndarray of uint8, (T, S, A)
        Bits of `FLAGS`.
    """
    boxes = _Boxes(
        layout.boxes,
        layout.pitch,
        layout.scale,
        layout.offset,
        layout.bad_start,
        layout.bad_index,
        layout.bad_neighbour,
        layout.bad_weight,
    )
    result = (frames, boxes, position, flux, flag)
    if parameters.method == "thresholded":
        _thresholded(*result, np.array(layout.window) / 2, parameters.threshold, parameters.passes)
    elif parameters.method == "weighted":
        width = _weight_width(layout, parameters)
        steepness, reach = 4 * np.log(2) / width**2, WEIGHT_REACH * width
        _weighted(*result, steepness, reach, *layout.prepared, parameters.passes)  # type: ignore[call-arg]
    elif parameters.method == "template":
        _fitted(*result, *layout.prepared, parameters.passes)  # type: ignore[call-arg]


def prepared(layout: SpotLayout, parameters: ExtractionParameters) -> tuple[NDArray[Any], ...]:
    """What the method of the parameters needs to know of the mean spots; `prepared` of a layout.

    Parameters
    ----------
    layout : SpotLayout
        A layout that is complete but for this.
    parameters : ExtractionParameters
        Method and its parameters.

    Returns
    -------
    tuple of ndarray
    """
    if parameters.method == "weighted":
        return (_weighted_response(mean_spots(layout), _weight_width(layout, parameters)),)
    if parameters.method == "template":
        return _tables(mean_spots(layout), layout.fwhm)
    return ()


def _weight_width(layout: SpotLayout, parameters: ExtractionParameters) -> float:
    return WEIGHT_WIDTH * layout.fwhm if parameters.weight_fwhm is None else parameters.weight_fwhm


@njit(nogil=True, cache=True, fastmath=_RELAXED, error_model="numpy")
def _read(
    frame: Any,
    box: Any,
    a: Any,
    boxes: Any,
) -> None:
    """One calibrated box, its bad pixels predicted."""
    rows, cols = box.shape
    top, start = boxes.corner[a, 0], boxes.corner[a, 1]
    for r in range(rows):
        for k in range(cols):
            raw = np.float32(frame[top + r, start + k])
            box[r, k] = raw * boxes.scale[a, r, k] - boxes.offset[a, r, k]
    flat = box.reshape(-1)
    for b in range(boxes.bad_start[a], boxes.bad_start[a + 1]):
        flat[boxes.bad_index[b]] = np.float32(0)
    for b in range(boxes.bad_start[a], boxes.bad_start[a + 1]):
        value = np.float32(0)
        for m in range(boxes.bad_neighbour.shape[1]):
            value += boxes.bad_weight[b, m] * flat[boxes.bad_neighbour[b, m]]
        flat[boxes.bad_index[b]] = value


@njit(nogil=True, cache=True, fastmath=_RELAXED, error_model="numpy")
def _thresholded(
    frames: Any,
    boxes: Any,
    position: Any,
    flux: Any,
    flag: Any,
    half: Any,
    part: Any,
    passes: Any,
) -> None:
    """Centre of gravity of what exceeds a part of the brightest pixel, in a window re-centred on it."""
    rows, cols = boxes.pitch
    box = np.empty((rows, cols), dtype=np.float32)
    for t in range(len(frames)):
        for a in range(len(boxes.corner)):
            _read(frames[t], box, a, boxes)
            for s in range(flux.shape[1]):
                if flag[t, s, a] & ~_KEPT:
                    continue
                x, y = position[t, 0, s, a], position[t, 1, s, a]
                step = 0.0
                for _ in range(passes):
                    top, bottom = max(int(np.ceil(y - half[0] - 0.5)), 0), min(int(y + half[0] + 0.5), rows - 1)
                    left, right = max(int(np.ceil(x - half[1] - 0.5)), 0), min(int(x + half[1] + 0.5), cols - 1)
                    peak = np.float32(0)
                    for r in range(top, bottom + 1):
                        for k in range(left, right + 1):
                            peak = max(peak, box[r, k])
                    level = np.float32(part) * peak
                    total, moment_y, moment_x = 0.0, 0.0, 0.0
                    for r in range(top, bottom + 1):
                        for k in range(left, right + 1):
                            value = max(box[r, k] - level, np.float32(0))
                            # Part of the pixel that the window covers.
                            high = min(r + 0.5, y + half[0]) - max(r - 0.5, y - half[0])
                            wide = min(k + 0.5, x + half[1]) - max(k - 0.5, x - half[1])
                            value *= max(high, 0.0) * max(wide, 0.0)
                            total += value
                            moment_y += r * value
                            moment_x += k * value
                    step = max(abs(moment_y / total - y), abs(moment_x / total - x))
                    y, x = moment_y / total, moment_x / total
                    if not (0 <= y <= rows - 1 and 0 <= x <= cols - 1):
                        break
                _keep(position, flux, flag, t, s, a, y, x, step, rows, cols)


@njit(nogil=True, cache=True, error_model="numpy")
def _keep(
    position: Any, flux: Any, flag: Any, t: Any, s: Any, a: Any, y: Any, x: Any, step: Any, rows: Any, cols: Any
) -> None:
    """Store a position, or the reason why there is none."""
    if not (0 <= y <= rows - 1 and 0 <= x <= cols - 1):
        flag[t, s, a] |= _WINDOW_LEFT if np.isfinite(y) and np.isfinite(x) else _NO_LIGHT
    elif step > SETTLED:
        flag[t, s, a] |= _NOT_CONVERGED
    if flag[t, s, a] & ~_KEPT:
        y, x = np.nan, np.nan
        flux[t, s, a] = np.nan
    position[t, 0, s, a] = x
    position[t, 1, s, a] = y


# --- weight -------------------------------------------------------------------------------------------------


def _weighted_response(spots: Floats, width: float) -> Floats:
    """Motion of the centre of gravity under the weight, held fixed, per motion of the mean spot, (S, 2)."""
    steps = np.arange(spots.shape[1]) - spots.shape[1] // 2
    line = np.where(np.abs(steps) <= WEIGHT_REACH * width, np.exp(-4 * np.log(2) / width**2 * steps**2), 0.0)
    return fixed_response(spots, line, line)


@njit(nogil=True, cache=True, fastmath=_RELAXED, error_model="numpy")
def _weighted(
    frames: Any,
    boxes: Any,
    position: Any,
    flux: Any,
    flag: Any,
    steepness: Any,
    reach: Any,
    response: Any,
    passes: Any,
) -> None:
    """Centre of gravity under a Gaussian weight that is moved until it lies in the centre of its own picture."""
    rows, cols = boxes.pitch
    box = np.empty((rows, cols), dtype=np.float32)
    line_y, line_x = np.empty(rows, dtype=np.float32), np.empty(cols, dtype=np.float32)
    for t in range(len(frames)):
        for a in range(len(boxes.corner)):
            _read(frames[t], box, a, boxes)
            for s in range(flux.shape[1]):
                if flag[t, s, a] & ~_KEPT:
                    continue
                x, y = position[t, 0, s, a], position[t, 1, s, a]
                step = 0.0
                for _ in range(passes):
                    top, bottom = max(int(np.ceil(y - reach)), 0), min(int(y + reach), rows - 1)
                    left, right = max(int(np.ceil(x - reach)), 0), min(int(x + reach), cols - 1)
                    for r in range(top, bottom + 1):
                        line_y[r] = np.exp(-steepness * (r - y) ** 2)
                    for k in range(left, right + 1):
                        line_x[k] = np.exp(-steepness * (k - x) ** 2)
                    total, moment_y, moment_x = np.float32(0), np.float32(0), np.float32(0)
                    for r in range(top, bottom + 1):
                        light, first = np.float32(0), np.float32(0)
                        for k in range(left, right + 1):
                            value = line_x[k] * box[r, k]
                            light += value
                            first += np.float32(k - x) * value
                        total += line_y[r] * light
                        moment_x += line_y[r] * first
                        moment_y += line_y[r] * np.float32(r - y) * light
                    # Under a fixed weight the centre moves by `response` when the spot moves by 1.
                    dy, dx = moment_y / total / response[s, 0], moment_x / total / response[s, 1]
                    y, x, step = y + dy, x + dx, max(abs(dy), abs(dx))
                    if not (0 <= y <= rows - 1 and 0 <= x <= cols - 1):
                        break
                _keep(position, flux, flag, t, s, a, y, x, step, rows, cols)


# --- fit ----------------------------------------------------------------------------------------------------


def _tables(spots: Floats, fwhm: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean spots at every fraction of a pixel, (S, STEPS, STEPS, n, n), and what fits them, (S, STEPS, STEPS, 3, m, m).

    The latter are the rows of the pseudo-inverse of [spot, its derivatives]: their products with the pixels are the
    least-squares flux, and flux times the displacement along y and x from the tabulated place.
    """
    size = spots.shape[1]
    reach, near = size // 2, int(np.ceil(FIT_REACH * fwhm))
    inner = slice(reach - near, reach + near + 1)
    moved, derived = _moving(size)
    table = np.empty((len(spots), STEPS, STEPS, size, size), dtype=np.float32)
    filters = np.empty((len(spots), STEPS, STEPS, 3, 2 * near + 1, 2 * near + 1), dtype=np.float32)
    for source, spot in enumerate(spots):
        spline = ndimage.spline_filter(spot, order=3)
        for i, j in np.ndindex(STEPS, STEPS):
            image = moved[i] @ spline @ moved[j].T
            table[source, i, j] = image
            slopes = derived[i] @ spline @ moved[j].T, moved[i] @ spline @ derived[j].T
            design = np.stack([part[inner, inner].reshape(-1) for part in (image, *slopes)])
            filters[source, i, j] = np.linalg.solve(design @ design.T, design).reshape(filters.shape[3:])
    return table, filters


def _moving(size: int) -> tuple[Floats, Floats]:
    """Matrices, (STEPS, size, size), that turn spline coefficients into values moved by each fraction of a pixel.

    And those for the derivative of the values with respect to the motion.
    """
    place = (np.arange(STEPS) + 0.5) / STEPS - 0.5
    away = np.arange(size)[:, None] - np.arange(size) - place[:, None, None]
    cubic = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    return np.nan_to_num(cubic(away)), -np.nan_to_num(cubic.derivative()(away))


@njit(nogil=True, cache=True, fastmath=_RELAXED, error_model="numpy")
def _fitted(
    frames: Any,
    boxes: Any,
    position: Any,
    flux: Any,
    flag: Any,
    table: Any,
    filters: Any,
    passes: Any,
) -> None:
    """Least-squares fit of the mean spots of both sources, each with the other's removed in turn."""
    rows, cols = boxes.pitch
    n_sources = flux.shape[1]
    middle, near = table.shape[3] // 2, filters.shape[4] // 2
    steps = table.shape[1]
    box = np.empty((rows, cols), dtype=np.float32)
    y, x, light, step = np.empty(n_sources), np.empty(n_sources), np.empty(n_sources), np.empty(n_sources)
    for t in range(len(frames)):
        for a in range(len(boxes.corner)):
            _read(frames[t], box, a, boxes)
            for s in range(n_sources):
                x[s], y[s], light[s] = position[t, 0, s, a], position[t, 1, s, a], flux[t, s, a]
                step[s] = 0.0
            for _ in range(passes):
                for s in range(n_sources):
                    if flag[t, s, a] & ~_KEPT or not (0 <= y[s] <= rows - 1 and 0 <= x[s] <= cols - 1):
                        continue
                    row, col = int(y[s] + 0.5), int(x[s] + 0.5)
                    i = min(int((y[s] - row + 0.5) * steps), steps - 1)
                    j = min(int((x[s] - col + 0.5) * steps), steps - 1)
                    o = 1 - s
                    other = n_sources == 2 and flag[t, o, a] & ~_KEPT == 0
                    other = other and 0 <= y[o] <= rows - 1 and 0 <= x[o] <= cols - 1
                    away_row, away_col, m, n, of_other = 0, 0, 0, 0, np.float32(0)
                    if other:
                        away_row, away_col = int(y[o] + 0.5), int(x[o] + 0.5)
                        m = min(int((y[o] - away_row + 0.5) * steps), steps - 1)
                        n = min(int((x[o] - away_col + 0.5) * steps), steps - 1)
                        of_other = np.float32(light[o])
                    total, along_y, along_x = np.float32(0), np.float32(0), np.float32(0)
                    top, bottom = max(row - near, 0), min(row + near, rows - 1)
                    left, right = max(col - near, 0), min(col + near, cols - 1)
                    for r in range(top, bottom + 1):
                        for k in range(left, right + 1):
                            value = box[r, k]
                            if other:
                                value -= of_other * table[o, m, n, r - away_row + middle, k - away_col + middle]
                            total += filters[s, i, j, 0, r - row + near, k - col + near] * value
                            along_y += filters[s, i, j, 1, r - row + near, k - col + near] * value
                            along_x += filters[s, i, j, 2, r - row + near, k - col + near] * value
                    # Beyond a pixel the expansion says the direction, not the distance.
                    dy = min(max(along_y / total, -1.0), 1.0)
                    dx = min(max(along_x / total, -1.0), 1.0)
                    new_y = row - 0.5 + (i + 0.5) / steps + dy
                    new_x = col - 0.5 + (j + 0.5) / steps + dx
                    step[s] = max(abs(new_y - y[s]), abs(new_x - x[s]))
                    y[s], x[s], light[s] = new_y, new_x, total
            for s in range(n_sources):
                if flag[t, s, a] & ~_KEPT == 0:
                    flux[t, s, a] = light[s]
                    _keep(position, flux, flag, t, s, a, y[s], x[s], step[s], rows, cols)
