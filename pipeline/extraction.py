"""Slopes and fluxes from Shack-Hartmann frames: one centre of gravity per source, subaperture and frame.

Two ways to place the window (`ExtractionParameters.method`):

``subpixel_window``
    The brightest pixel within `search` of the spot's mean position is the start. A rectangle whose border
    pixels count by the fraction of them that it covers is then re-centred `passes` times on its own centre of
    gravity. Nothing jumps when a spot crosses from one pixel to the next.
``moving_maximum``
    A rectangle of whole pixels (odd sides) centred on the brightest pixel (Sauvage et al. 2021).

Pixels are calibrated as (frame - dark) / flat. A bad pixel is never read: its value is predicted from its good
neighbours, with the weights that predict it best for the archive's own mean spot at any sub-pixel position.
Where there is no dark, a plane fitted to the mean frame outside the spot windows stands for it, box by box.

Slopes are displacements from the spot's position in the mean frame, times the pixel scale. Their zero is as
arbitrary as the choice of frames that were averaged; only fluctuations are used later. Fluxes are plain sums
over the window, in counts: neither thresholded nor clipped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from scipy import ndimage

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from .parameters import ExtractionParameters, Header

    Floats = NDArray[np.float64]

#: Changes whenever the numbers that this stage returns for the same input change.
VERSION = 1

#: Bits of a measurement's flag. Slopes and flux are NaN wherever a bit other than `saturated` is set.
FLAGS: dict[str, int] = {
    "no_light": 1,  # flux in the window below the floor, or not a number
    "window_left": 2,  # the window left the lenslet box
    "strayed": 4,  # the centre of gravity is nearer to the other source's spot, or out of reach of its own
    "not_converged": 8,  # the last pass still moved the window by more than CONVERGENCE
    "bad_pixels": 16,  # bad pixels hold too much of this spot's light, in every frame
    "no_spot": 32,  # the mean frame shows no spot here, in every frame
    "saturated": 64,  # a pixel in the window has reached the saturation level; the measurement is kept
}

#: Largest move of the window in the last of two or more passes, px. A pass leaves about a tenth of an error.
CONVERGENCE = 0.3
#: Part of its mean flux below which a spot is taken to be absent from a frame.
FLUX_FLOOR = 0.02
#: Part of a spot's light on bad pixels above which it is not measured.
BAD_LIGHT = 0.3
#: Along the line of sources, part of their distance that a window may cover.
ALONG = 0.9
#: Across, and for a single source, size of the window in units of the spot's full width at half maximum.
ACROSS = 6.6
#: Pixels (rows, columns away) that predict a bad one.
NEIGHBOURS = tuple((y, x) for y in range(-2, 3) for x in range(-2, 3) if 0 < y * y + x * x <= 4)

_NUMPY_TYPES = (np.uint8, np.uint16, np.int16, np.float32)


@dataclass(frozen=True)
class Calibration:
    """What is known of the detector.

    Parameters
    ----------
    dark : ndarray of float, (row, col), optional
        Offset and mean background, counts.
    flat : ndarray of float, (row, col), optional
        Relative response, mean 1.
    bad_pixel : ndarray of bool, (row, col), optional
        True where a pixel must not be used.
    saturation : float, optional
        Level of saturation in raw counts.
    """

    dark: NDArray[np.floating[Any]] | None = None
    flat: NDArray[np.floating[Any]] | None = None
    bad_pixel: NDArray[np.bool_] | None = None
    saturation: float | None = None


@dataclass(frozen=True)
class SpotLayout:
    """Where the spots are, and everything the measurement needs that does not change from frame to frame.

    Positions are (row, col) in a lenslet box, 0 at the centre of the box's first pixel.

    Parameters
    ----------
    boxes : ndarray of int, (A, 2)
        First pixel (row, col) of each exploited lenslet's box.
    pitch : tuple of int
        Size (rows, cols) of a box.
    frame_shape : tuple of int
        Size (rows, cols) of a frame.
    pixel_scale : float
        Angle of a pixel, rad.
    spots : ndarray of float, (S, A, 2)
        Mean position of each spot: the zero of the slopes.
    flux : ndarray of float, (S, A)
        Flux of each spot in the mean frame, counts.
    window : tuple of float
        Size (along y, along x) of the window, px.
    fwhm : float
        Full width at half maximum of the mean spot, px.
    template : ndarray of float, (S, rows, cols)
        Mean box without bad pixels, averaged over the subapertures with the source's spots moved to `centre`.
    centre : ndarray of float, (S, 2)
        Position of the source's spot in `template`.
    search : ndarray of int, (S, A, 4)
        First row, last row, first column, last column among which the brightest pixel is looked for.
    bands : ndarray of int, (n, 4)
        Rows of lenslets with a box: first row and first column of the detector, width, first box.
    scale, offset : ndarray of float32, (n, rows, columns)
        Calibrated pixel = raw * scale - offset for each band, from its first box to its last; both 0 on bad pixels
        and between boxes.
    suspect : ndarray of float32, (A,)
        Calibrated value from which on a pixel of the box may be saturated.
    bad_start : ndarray of int, (A + 1,)
        The bad pixels of box a are `bad_index[bad_start[a]:bad_start[a + 1]]`.
    bad_index : ndarray of int, (B,)
        Pixel of the box, row * cols + col.
    bad_neighbour, bad_weight : ndarray, (B, 12)
        Pixels that predict it, and their weights.
    excluded : ndarray of uint8, (S, A)
        Bits of `FLAGS` that hold for every frame.
    """

    boxes: NDArray[np.int64]
    pitch: tuple[int, int]
    frame_shape: tuple[int, int]
    pixel_scale: float
    spots: Floats
    flux: Floats
    window: tuple[float, float]
    fwhm: float
    template: Floats
    centre: Floats
    search: NDArray[np.int64]
    bands: NDArray[np.int64]
    scale: NDArray[np.float32]
    offset: NDArray[np.float32]
    suspect: NDArray[np.float32]
    bad_start: NDArray[np.int64]
    bad_index: NDArray[np.int64]
    bad_neighbour: NDArray[np.int64]
    bad_weight: NDArray[np.float32]
    excluded: NDArray[np.uint8]


def reference_image(frames: NDArray[Any]) -> Floats:
    """Mean of frames, from which the spots' positions are taken.

    Parameters
    ----------
    frames : ndarray, (n, row, col)
        Raw counts.

    Returns
    -------
    ndarray of float64, (row, col)

    Raises
    ------
    ValueError
        There are no frames.
    """
    if frames.ndim != 3 or not frames.size:
        raise ValueError(f"frames of shape {frames.shape}: (time, row, col) with at least one frame is needed")
    mean: Floats = np.mean(frames, axis=0, dtype=np.float64)
    return mean


def layout(
    header: Header, mean_frame: ArrayLike, calibration: Calibration, parameters: ExtractionParameters
) -> SpotLayout:
    """Find the spots on a mean frame and prepare the measurement.

    Parameters
    ----------
    header : Header
        Header of the archive: lenslet boxes, nominal spots, pixel scale.
    mean_frame : array_like, (row, col)
        Mean of raw frames, see `reference_image`.
    calibration : Calibration
        Dark, flat, bad pixels, saturation.
    parameters : ExtractionParameters
        Method, window and search.

    Returns
    -------
    SpotLayout

    Raises
    ------
    ValueError
        A lenslet box lies outside the frame, a calibration array differs in shape from the frame, or the window
        does not fit into a box.
    """
    instrument = header.instrument
    mean_frame = np.asarray(mean_frame, dtype=np.float64)
    rows, cols = instrument.lenslet_pitch
    boxes = np.argwhere(np.asarray(instrument.subaperture_mask) != 0) * (rows, cols) + instrument.lenslet_origin
    needed = boxes.max(axis=0) + np.array([rows, cols])
    if (needed > mean_frame.shape).any():
        raise ValueError(
            f"the lenslet boxes need {needed[0]} x {needed[1]} pixels, "
            f"but a frame has {mean_frame.shape[0]} x {mean_frame.shape[1]}"
        )
    nominal = np.array([source.spot for source in header.sources], dtype=np.float64)
    signal, scale, offset, bad = _calibrated_boxes(mean_frame, boxes, (rows, cols), calibration, nominal)

    # First guess: everything at its nominal place, bad pixels as in the typical box.
    typical = _typical_box(signal, bad)
    filled = _fill(signal, bad, typical)
    fwhm = _full_width(_typical_box(filled, np.zeros_like(bad)), nominal)
    window = _window(parameters, nominal, (rows, cols), fwhm)
    spots = np.repeat(nominal[:, None, :], len(boxes), axis=1)
    start, index, neighbour, weight = _no_bad_pixels(len(boxes))
    bands, band_scale, band_offset = _bands(boxes, scale, offset)
    first = SpotLayout(
        boxes=boxes,
        pitch=(rows, cols),
        frame_shape=(mean_frame.shape[0], mean_frame.shape[1]),
        pixel_scale=instrument.pixel_scale,
        spots=spots,
        flux=np.zeros(spots.shape[:2]),
        window=window,
        fwhm=fwhm,
        template=np.repeat(typical[None], len(nominal), axis=0),
        centre=nominal,
        search=_search_region(spots, (rows, cols), parameters.search),
        bands=bands,
        scale=band_scale,
        offset=band_offset,
        suspect=_lowest_saturated(scale, offset, calibration.saturation),
        bad_start=start,
        bad_index=index,
        bad_neighbour=neighbour,
        bad_weight=weight,
        excluded=np.zeros(spots.shape[:2], dtype=np.uint8),
    )
    # Second: positions on the filled mean boxes, then templates of spots brought to one place.
    spots, _ = _measure_boxes(first, filled, parameters)
    spots = np.where(np.isfinite(spots), spots, first.spots)
    template, centre = _templates(filled, bad, spots)
    start, index, neighbour, weight = _predictors(bad, spots, template, centre)
    for box, begin, end in zip(range(len(boxes)), start[:-1], start[1:], strict=True):
        flat_box = filled[box].reshape(-1)
        flat_box[index[begin:end]] = 0.0
        flat_box[index[begin:end]] = np.einsum(
            "bn,bn->b", weight[begin:end], flat_box[neighbour[begin:end]].astype(np.float64)
        )
    spots, flux = _measure_boxes(replace(first, spots=spots), filled, parameters)
    missing: NDArray[np.bool_] = np.logical_not(np.isfinite(spots).all(axis=-1))
    spots = np.where(missing[..., None], first.spots, spots)
    excluded = np.where(missing | ~_has_spot(filled, spots, window), FLAGS["no_spot"], 0) | np.where(
        _light_on(bad, spots, template, centre, window) > BAD_LIGHT, FLAGS["bad_pixels"], 0
    )
    return replace(
        first,
        spots=spots,
        flux=np.nan_to_num(flux),
        template=template,
        centre=centre,
        search=_search_region(spots, (rows, cols), parameters.search),
        bad_start=start,
        bad_index=index,
        bad_neighbour=neighbour,
        bad_weight=weight,
        excluded=excluded.astype(np.uint8),
    )


def extract(
    frames: NDArray[Any], layout: SpotLayout, calibration: Calibration, parameters: ExtractionParameters
) -> tuple[Floats, Floats, NDArray[np.uint8]]:
    """Slopes and fluxes of every source and subaperture in each frame.

    Each frame is measured on its own, so that any cut of a recording into pieces gives the same bits.

    Parameters
    ----------
    frames : ndarray of uint8, uint16, int16 or float32, (T, row, col)
        Raw counts.
    layout : SpotLayout
        Result of `layout` for this archive.
    calibration : Calibration
        The calibration that `layout` was made with.
    parameters : ExtractionParameters
        The parameters that `layout` was made with.

    Returns
    -------
    slopes : ndarray of float64, (T, 2, S, A)
        Displacement of the spot along x and y from its mean position, rad; NaN where it could not be measured.
    flux : ndarray of float64, (T, S, A)
        Background-subtracted sum over the window, counts; NaN likewise.
    flag : ndarray of uint8, (T, S, A)
        Bits of `FLAGS`.

    Raises
    ------
    ValueError
        The frames have another shape than the mean frame, or a type that is not read.
    """
    if frames.ndim != 3 or frames.shape[1:] != layout.frame_shape:
        raise ValueError(f"frames of shape {frames.shape} do not fit the layout's frames of shape {layout.frame_shape}")
    if frames.dtype not in _NUMPY_TYPES:
        raise ValueError(f"frames of type {frames.dtype}: uint8, uint16, int16 or float32 are read")
    frames = np.ascontiguousarray(frames)
    n_sources, n_boxes = layout.flux.shape
    slopes = np.empty((len(frames), 2, n_sources, n_boxes))
    flux = np.empty((len(frames), n_sources, n_boxes))
    flag = np.empty((len(frames), n_sources, n_boxes), dtype=np.uint8)
    columns = layout.pitch[1]
    length = layout.scale.shape[-1]
    tall, wide = (int(side) for side in layout.window)
    first_box = np.append(layout.bands[:, 3], n_boxes)
    column = layout.boxes[:, 1] - np.repeat(layout.bands[:, 1], np.diff(first_box))
    # Pixels of a box, counted in its band.
    behind = np.repeat(column, np.diff(layout.bad_start))
    bad_index = layout.bad_index // columns * length + layout.bad_index % columns + behind
    bad_neighbour = layout.bad_neighbour // columns * length + layout.bad_neighbour % columns + behind[:, None]
    _kernel(_eights(int(2 * parameters.search)), tall, _eights(wide + 2))(
        frames.reshape(-1),
        len(frames),
        layout.frame_shape[0] * layout.frame_shape[1],
        layout.frame_shape[1],
        layout.bands[:, 0] * layout.frame_shape[1] + layout.bands[:, 1],
        layout.bands[:, 2],
        columns,
        length,
        first_box,
        column,
        layout.pitch[0],
        layout.scale.reshape(-1),
        layout.offset.reshape(-1),
        layout.bad_start,
        bad_index,
        bad_neighbour,
        layout.bad_weight,
        layout.spots,
        layout.search,
        np.array(layout.window, dtype=np.float32),
        1 if parameters.method == "moving_maximum" else parameters.passes,
        np.maximum(FLUX_FLOOR * layout.flux, 0.0),
        _half_way(layout.spots),
        layout.excluded,
        layout.suspect,
        np.inf if calibration.saturation is None else float(calibration.saturation),
        layout.pixel_scale,
        slopes,
        flux,
        flag,
    )
    return slopes, flux, flag


def response_to_tilt(
    layout: SpotLayout, parameters: ExtractionParameters, *, reach: float = 0.5, steps: int = 11
) -> Floats:
    """Response of the measured slope to a known tilt, on the archive's own mean spot.

    The template of each source is moved by known amounts (cubic spline interpolation), measured like a frame,
    and a line is fitted to the measured against the known positions. The gain is reported, never applied.

    Parameters
    ----------
    layout : SpotLayout
        Result of `layout`.
    parameters : ExtractionParameters
        Method, window, passes.
    reach : float
        Largest displacement, px.
    steps : int
        Number of displacements between -reach and reach.

    Returns
    -------
    ndarray of float64, (2, S)
        Gain along x and y for each source.
    """
    moves = np.linspace(-reach, reach, steps)
    gain = np.empty((2, len(layout.centre)))
    for source, (template, centre) in enumerate(zip(layout.template, layout.centre, strict=True)):
        for axis in range(2):
            step = (0.0, 1.0) if axis == 0 else (1.0, 0.0)
            boxes = np.stack(
                [ndimage.shift(template, np.multiply(step, move), order=3, mode="nearest") for move in moves]
            )
            spots = np.repeat(layout.centre[:, None, :], len(boxes), axis=1)
            found, _ = _measure_boxes(replace(layout, spots=spots), boxes, parameters)
            gain[axis, source] = np.polyfit(moves, found[source, :, 1 - axis] - centre[1 - axis], 1)[0]
    return gain


# --- preparation --------------------------------------------------------------------------------------------


def _cut(image: NDArray[Any], boxes: NDArray[np.int64], pitch: tuple[int, int]) -> NDArray[Any]:
    return np.stack([image[r : r + pitch[0], c : c + pitch[1]] for r, c in boxes])


def _calibrated_boxes(
    mean_frame: Floats,
    boxes: NDArray[np.int64],
    pitch: tuple[int, int],
    calibration: Calibration,
    nominal: Floats,
) -> tuple[Floats, NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Calibrated mean boxes, scale, offset (A, rows, cols), and which pixels are bad."""
    for name in ("dark", "flat", "bad_pixel"):
        array = getattr(calibration, name)
        if array is not None and np.shape(array) != mean_frame.shape:
            raise ValueError(f"{name} has shape {np.shape(array)}, but a frame has {mean_frame.shape}")
    raw = _cut(mean_frame, boxes, pitch)
    flat = np.ones_like(raw) if calibration.flat is None else _cut(np.asarray(calibration.flat, float), boxes, pitch)
    dark = np.zeros_like(raw) if calibration.dark is None else _cut(np.asarray(calibration.dark, float), boxes, pitch)
    bad = ~(np.isfinite(raw) & np.isfinite(dark) & np.isfinite(flat) & (flat > 0))
    if calibration.bad_pixel is not None:
        bad |= _cut(np.asarray(calibration.bad_pixel, bool), boxes, pitch)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(bad, 0.0, 1.0 / flat)
        offset = np.where(bad, 0.0, dark / flat)
        signal = np.where(bad, 0.0, raw) * scale - offset
    if calibration.dark is None:
        background = np.stack([_plane(box, hole, nominal) for box, hole in zip(signal, bad, strict=True)])
        background = np.where(bad, 0.0, background)
        offset, signal = offset + background, signal - background
    return signal, scale.astype(np.float32), offset.astype(np.float32), bad


def _plane(box: Floats, bad: NDArray[np.bool_], nominal: Floats) -> Floats:
    """Plane through the pixels of a box that hold no light, (rows, cols).

    Diffraction wings reach far along the rows and columns through a spot: those are left out; what remains is
    clipped three times at three standard deviations.
    """
    rows, cols = np.indices(box.shape)
    near = np.zeros(box.shape, dtype=bool)
    for row, col in nominal:
        near |= (np.abs(rows - row) < box.shape[0] / 8) | (np.abs(cols - col) < box.shape[1] / 8)
    for row, col in nominal:
        near |= np.hypot(rows - row, cols - col) < min(box.shape) / 4
    used = ~near & ~bad
    if used.sum() < max(12, box.size // 20):
        used = ~bad
        used[1:-1, 1:-1] = False
    if not used.any():
        return np.zeros(box.shape)
    basis = np.stack([np.ones(box.shape), rows - rows.mean(), cols - cols.mean()], axis=-1)
    if used.sum() < 12:
        basis = basis[..., :1]
    for _ in range(4):
        coefficients = np.linalg.lstsq(basis[used], box[used], rcond=None)[0]
        residual = box - basis @ coefficients
        spread = 1.4826 * float(np.median(np.abs(residual[used] - np.median(residual[used]))))
        kept = used & (np.abs(residual) <= 3.0 * spread)
        if spread == 0.0 or kept.sum() < basis.shape[-1] + 3:
            break
        used = kept
    plane: Floats = basis @ coefficients
    return plane


def _typical_box(signal: Floats, bad: NDArray[np.bool_]) -> Floats:
    """Mean over the subapertures of the good pixels; what is bad everywhere comes from its surroundings."""
    count = (~bad).sum(axis=0)
    mean: Floats = np.where(bad, 0.0, signal).sum(axis=0) / np.maximum(count, 1)
    if (count == 0).any():
        weight = ndimage.gaussian_filter((count > 0).astype(float), 1.0)
        smooth = ndimage.gaussian_filter(np.where(count > 0, mean, 0.0), 1.0) / np.maximum(weight, 1e-12)
        mean = np.where(count > 0, mean, smooth)
    return mean


def _fill(signal: Floats, bad: NDArray[np.bool_], typical: Floats) -> Floats:
    """Boxes whose bad pixels hold the typical box, scaled to the good pixels around them."""
    filled = np.where(bad, 0.0, signal)
    for box, row, col in np.argwhere(bad):
        around = (slice(max(row - 2, 0), row + 3), slice(max(col - 2, 0), col + 3))
        good = ~bad[box][around]
        model = float((typical[around] * good * typical[around]).sum())
        ratio = float((filled[box][around] * good * typical[around]).sum()) / model if model > 0 else 0.0
        filled[box, row, col] = typical[row, col] * ratio
    return filled


def _full_width(box: Floats, nominal: Floats) -> float:
    """Diameter of the circle with the area of the spot above half its maximum, mean over the sources, px."""
    fine = 8
    widths = []
    for row, col in nominal:
        reach = min(box.shape) // 4
        offsets = np.arange(-reach, reach + 0.5 / fine, 1.0 / fine)
        patch = ndimage.map_coordinates(
            box, np.stack(np.meshgrid(row + offsets, col + offsets, indexing="ij")), order=3, mode="nearest"
        )
        labels, _ = ndimage.label(patch > 0.5 * patch.max())
        area = (labels == labels.flat[int(np.argmax(patch))]).sum() / fine**2
        widths.append(2.0 * math.sqrt(area / math.pi))
    return float(np.mean(widths))


def _window(
    parameters: ExtractionParameters, nominal: Floats, pitch: tuple[int, int], fwhm: float
) -> tuple[float, float]:
    """Size (along y, along x) of the window, px."""
    # Room for the spot to move: the window must stay inside the box wherever the spot is looked for. Rounded to an
    # odd number, so that the seeing of the moment does not change the window from one batch to the next.
    edge = np.minimum(nominal + 0.5, np.array(pitch) - 0.5 - nominal).min(axis=0)
    room = np.maximum(2.0 * (edge - parameters.search), edge)
    size = np.minimum(2.0 * np.round((ACROSS * fwhm - 1.0) / 2.0) + 1.0, room)
    if len(nominal) == 1:
        size[:] = size.min()
    else:
        distance = np.abs(nominal[1] - nominal[0])
        along = int(np.argmax(distance))
        size[along] = min(room[along], ALONG * distance[along])
    if parameters.method == "moving_maximum":
        size[:] = size.min()
    given = (parameters.window_y, parameters.window_x)
    height, width = (float(g) if g is not None else float(a) for g, a in zip(given, size, strict=True))
    if parameters.method == "moving_maximum":
        # The largest odd number of whole pixels that is not larger.
        height, width = (max(2.0 * math.floor((side - 1.0) / 2.0) + 1.0, 1.0) for side in (height, width))
    if height >= pitch[0] or width >= pitch[1]:
        raise ValueError(f"a window of {height:g} x {width:g} px does not fit into a box of {pitch[0]} x {pitch[1]} px")
    return height, width


def _search_region(spots: Floats, pitch: tuple[int, int], search: float) -> NDArray[np.int64]:
    """First and last row and column to look for the maximum of each spot, (S, A, 4)."""
    low = np.ceil(spots - search)
    high = low + np.floor(2 * search) - 1
    if len(spots) == 2:
        # Never look beyond half way to the other source.
        apart = np.abs(spots[1] - spots[0])
        along = apart[:, 1] > apart[:, 0]
        half = spots.mean(axis=0)
        for own in range(2):
            for axis in range(2):
                mine, limit = spots[own, :, axis], half[:, axis]
                use = along == bool(axis)
                above = use & (mine < limit)
                below = use & (mine > limit)
                high[own, :, axis] = np.where(
                    above, np.minimum(high[own, :, axis], np.ceil(limit) - 1), high[own, :, axis]
                )
                low[own, :, axis] = np.where(
                    below, np.maximum(low[own, :, axis], np.floor(limit) + 1), low[own, :, axis]
                )
    low = np.clip(low, 0, np.array(pitch) - 1)
    high = np.maximum(np.clip(high, 0, np.array(pitch) - 1), low)
    return np.stack([low[..., 0], high[..., 0], low[..., 1], high[..., 1]], axis=-1).astype(np.int64)


def _bare(layout: SpotLayout, spots: Floats, search: float) -> SpotLayout:
    """A layout for boxes that are calibrated and whole already, one box per frame-wide strip."""
    n_sources, n_boxes = spots.shape[:2]
    rows, cols = layout.pitch
    start, index, neighbour, weight = _no_bad_pixels(n_boxes)
    return replace(
        layout,
        boxes=np.stack([rows * np.arange(n_boxes), np.zeros(n_boxes, dtype=np.int64)], axis=1),
        frame_shape=(rows * n_boxes, cols),
        pixel_scale=1.0,
        spots=spots,
        flux=np.zeros((n_sources, n_boxes)),
        search=_search_region(spots, layout.pitch, search),
        bands=np.stack([np.array([rows * box, 0, cols, box]) for box in range(n_boxes)]),
        scale=np.ones((n_boxes, rows, cols), dtype=np.float32),
        offset=np.zeros((n_boxes, rows, cols), dtype=np.float32),
        suspect=np.full(n_boxes, np.inf, dtype=np.float32),
        bad_start=start,
        bad_index=index,
        bad_neighbour=neighbour,
        bad_weight=weight,
        excluded=np.zeros((n_sources, n_boxes), dtype=np.uint8),
    )


def _measure_boxes(layout: SpotLayout, boxes: Floats, parameters: ExtractionParameters) -> tuple[Floats, Floats]:
    """Positions (S, A, 2) and fluxes (S, A) on calibrated boxes (A, rows, cols)."""
    bare = _bare(layout, layout.spots, min(parameters.search, max(2.0, 0.5 * layout.fwhm)))
    frame = boxes.astype(np.float32).reshape(1, *bare.frame_shape)
    moved, flux, _ = extract(frame, bare, Calibration(), parameters)
    return layout.spots + moved[0, ::-1].transpose(1, 2, 0), flux[0]


def _templates(filled: Floats, bad: NDArray[np.bool_], spots: Floats) -> tuple[Floats, Floats]:
    """Mean box of each source with its spots brought to one place, (S, rows, cols), and that place (S, 2)."""
    centre = spots.mean(axis=1)
    # A filled pixel and what the spline makes of its neighbours count for nothing.
    weight = 1.0 - np.stack([ndimage.binary_dilation(hole, iterations=1) for hole in bad]).astype(float)
    weight = np.maximum(weight, 1e-6)
    template = np.empty((len(spots), *filled.shape[1:]))
    for source in range(len(spots)):
        moved = np.stack(
            [
                ndimage.shift(box, centre[source] - spot, order=3, mode="nearest")
                for box, spot in zip(filled, spots[source], strict=True)
            ]
        )
        template[source] = (moved * weight).sum(axis=0) / weight.sum(axis=0)
    return template, centre


def _has_spot(filled: Floats, spots: Floats, window: tuple[float, float]) -> NDArray[np.bool_]:
    """Whether the mean frame shows a spot: a maximum well above the scatter of the box's dark part, (S, A)."""
    found = np.zeros(spots.shape[:2], dtype=bool)
    rows, cols = np.indices(filled.shape[1:])
    for box, image in enumerate(filled):
        inside = [
            (np.abs(rows - row) < window[0] / 2) & (np.abs(cols - col) < window[1] / 2) for row, col in spots[:, box]
        ]
        outside = image[~np.any(inside, axis=0)]
        level = float(np.median(outside))
        scatter = 1.4826 * float(np.median(np.abs(outside - level)))
        for source, (row, col) in enumerate(spots[:, box]):
            core = (np.abs(rows - row) <= 1.0) & (np.abs(cols - col) <= 1.0)
            found[source, box] = float(image[core].mean()) - level > 5.0 * scatter and float(image[core].mean()) > level
    return found


def _no_bad_pixels(
    n_boxes: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    count = len(NEIGHBOURS)
    return (
        np.zeros(n_boxes + 1, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros((0, count), dtype=np.int64),
        np.zeros((0, count), dtype=np.float32),
    )


def _predictors(
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
        return _no_bad_pixels(n_boxes)
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


def _light_on(
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


def _eights(number: int) -> int:
    """The next multiple of eight."""
    return -(-number // 8) * 8


def _half_way(spots: Floats) -> Floats:
    """Vectors, (S, A, 2), whose product with a displacement reaches 1 half way to the other source."""
    if len(spots) == 1:
        return np.zeros_like(spots)
    apart = spots[::-1] - spots
    vectors: Floats = 2.0 * apart / np.maximum((apart**2).sum(axis=-1, keepdims=True), 1e-12)
    return vectors


def _lowest_saturated(
    scale: NDArray[np.float32], offset: NDArray[np.float32], saturation: float | None
) -> NDArray[np.float32]:
    """Lowest calibrated value that a saturated pixel of each box can have, (A,)."""
    if saturation is None:
        return np.full(len(scale), np.inf, dtype=np.float32)
    level = np.where(scale > 0, saturation * scale - offset, np.inf)
    lowest: NDArray[np.float32] = level.min(axis=(1, 2)).astype(np.float32)
    # Rounding of the calibrated value must not hide a saturated pixel.
    lowest -= np.abs(lowest) * np.float32(1e-5)
    return lowest


def _bands(
    boxes: NDArray[np.int64], scale: NDArray[np.float32], offset: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """Rows of lenslets, and scale and offset of the detector rows that they share."""
    rows, first = np.unique(boxes[:, 0], return_index=True)
    last = np.append(first[1:], len(boxes)) - 1
    left, width = boxes[first, 1], boxes[last, 1] - boxes[first, 1] + scale.shape[2]
    bands = np.stack([rows, left, width, first], axis=1).astype(np.int64)
    joined = np.zeros((2, len(rows), scale.shape[1], width.max()), dtype=np.float32)
    for box, (row, column) in enumerate(boxes):
        band = int(np.searchsorted(rows, row))
        columns = slice(column - left[band], column - left[band] + scale.shape[2])
        joined[0, band, :, columns] = scale[box]
        joined[1, band, :, columns] = offset[box]
    return bands, joined[0], joined[1]


# --- the kernel ---------------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def _kernel(lanes: int, tall: int, wide: int) -> Callable[..., None]:
    """Compiled measurement for one size of search and window.

    Parameters
    ----------
    lanes : int
        Width of the search, rounded up to a multiple of 8.
    tall : int
        Whole part of the window's height: it touches tall + 2 rows, and covers all but the first and the last two.
    wide : int
        Columns that a window can touch, rounded up to a multiple of 8.

    Notes
    -----
    These widths are constants of the compiled code: only then are the inner loops unrolled and turned into vector
    instructions. Index arithmetic is unsigned because a signed index is first tested for counting from the end.
    A row of lenslets is calibrated at once: detector rows are then read from end to end, which memory likes best.
    """
    # No nnan and no ninf: a pixel that is not a number must reach the tests below.
    relaxed = {"reassoc", "contract", "nsz", "arcp"}
    single, long, index = np.float32, np.int64, np.uint64
    half, one, none = np.float32(0.5), np.float32(1.0), np.float32(0.0)
    no_light, window_left, strayed = FLAGS["no_light"], FLAGS["window_left"], FLAGS["strayed"]
    not_converged, saturated = FLAGS["not_converged"], FLAGS["saturated"]

    @njit(nogil=True, cache=True, fastmath=relaxed, error_model="numpy")
    def measure(
        frames: Any,
        n_frames: Any,
        frame_size: Any,
        frame_columns: Any,
        first_pixel: Any,
        width: Any,
        columns: Any,
        length: Any,
        first_box: Any,
        column_of: Any,
        rows: Any,
        scale: Any,
        offset: Any,
        bad_start: Any,
        bad_index: Any,
        bad_neighbour: Any,
        bad_weight: Any,
        spots: Any,
        search: Any,
        window: Any,
        passes: Any,
        floor: Any,
        divide: Any,
        excluded: Any,
        suspect: Any,
        saturation: Any,
        pixel_scale: Any,
        slopes: Any,
        flux: Any,
        flag: Any,
    ) -> None:
        n_sources = spots.shape[0]
        half_y = half * window[0]
        half_x = half * window[1]
        # A window's last rows and columns may lie beyond the box: there they have no weight.
        band = np.zeros((rows + 2) * length + wide + lanes, dtype=np.float32)
        peak = np.zeros(lanes, dtype=np.float32)
        at_y = np.zeros(n_sources, dtype=np.float32)
        at_x = np.zeros(n_sources, dtype=np.float32)
        last_y = np.zeros(n_sources, dtype=np.float32)
        last_x = np.zeros(n_sources, dtype=np.float32)
        light_of = np.zeros(n_sources, dtype=np.float32)
        brightest = np.zeros(n_sources, dtype=np.float32)
        states = np.zeros(n_sources, dtype=np.uint8)
        for frame in range(n_frames):
            for n in range(first_pixel.size):
                start_of_band = index(frame) * index(frame_size) + index(first_pixel[n])
                i = start_of_band
                j = index(n) * index(rows * length)
                o = index(0)
                for _ in range(rows):
                    for k in range(index(width[n])):
                        band[o + k] = single(frames[i + k]) * scale[j + k] - offset[j + k]
                    i += index(frame_columns)
                    j += index(length)
                    o += index(length)
                for a in range(first_box[n], first_box[n + 1]):
                    corner = index(column_of[a])
                    for b in range(bad_start[a], bad_start[a + 1]):
                        band[bad_index[b]] = none
                    for b in range(bad_start[a], bad_start[a + 1]):
                        value = none
                        for m in range(bad_neighbour.shape[1]):
                            value += bad_weight[b, m] * band[bad_neighbour[b, m]]
                        band[bad_index[b]] = value
                    for s in range(n_sources):
                        # Brightest pixel: largest of each column, then the column, then its row.
                        top = search[s, a, 0]
                        bottom = search[s, a, 1]
                        left = search[s, a, 2]
                        right = search[s, a, 3]
                        o = corner + index(top * length + left)
                        for k in range(index(lanes)):
                            peak[k] = band[o + k]
                        for _ in range(top, bottom):
                            o += index(length)
                            for k in range(index(lanes)):
                                value = band[o + k]
                                known = peak[k]
                                peak[k] = value if value > known else known
                        best = peak[0]
                        column = long(0)
                        for k in range(1, right - left + 1):
                            larger = peak[k] > best
                            best = peak[k] if larger else best
                            column = long(k) if larger else column
                        row = long(top)
                        o = corner + index(top * length + left + column)
                        for r in range(top, bottom + 1):
                            row = long(r) if band[o] == best else row
                            o += index(length)
                        at_y[s] = single(row)
                        at_x[s] = single(left + column)
                        light_of[s] = none
                        brightest[s] = best
                        states[s] = excluded[s, a]
                    # Both sources in each pass, so that the processor can overlap the two.
                    for _ in range(passes):
                        for s in range(n_sources):
                            y = at_y[s]
                            x = at_x[s]
                            # Borders of the window, counted from the outer border of the box's first pixel.
                            up = y - half_y + half
                            down = y + half_y + half
                            start = x - half_x + half
                            stop = x + half_x + half
                            if not (up >= none and down <= rows and start >= none and stop <= columns):
                                states[s] |= window_left
                                continue
                            row = long(up)
                            column = min(long(start), long(max(columns - wide, 0)))
                            down -= single(row)
                            start -= single(column)
                            stop -= single(column)
                            first = one - (up - single(row))
                            last = min(down - single(tall), one)
                            after = max(down - single(tall + 1), none)
                            o = corner + index(row * length + column)
                            end = o + index(tall * length)
                            light = none
                            moment_x = none
                            moment_y = none
                            for k in range(index(wide)):
                                total = first * band[o + k]
                                moment = none
                                for r in range(index(1), index(tall)):
                                    value = band[o + r * index(length) + k]
                                    total += value
                                    moment += single(np.int32(r)) * value
                                value = last * band[end + k]
                                total += value
                                moment += single(tall) * value
                                value = after * band[end + index(length) + k]
                                total += value
                                moment += single(tall + 1) * value
                                at = single(np.int32(k))
                                part = max(min(at + one, stop) - max(at, start), none)
                                total *= part
                                light += total
                                moment_x += at * total
                                moment_y += part * moment
                            last_y[s] = y
                            last_x[s] = x
                            light_of[s] = light
                            at_y[s] = moment_y / light + single(row)
                            at_x[s] = moment_x / light + single(column)
                    for s in range(n_sources):
                        state = states[s]
                        light = light_of[s]
                        y = at_y[s]
                        x = at_x[s]
                        move_y = y - spots[s, a, 0]
                        move_x = x - spots[s, a, 1]
                        if state & window_left == 0:
                            if not light > floor[s, a]:
                                state |= no_light
                            elif not move_y * divide[s, a, 0] + move_x * divide[s, a, 1] < one:
                                state |= strayed
                            elif passes > 1 and max(abs(y - last_y[s]), abs(x - last_x[s])) > CONVERGENCE:
                                state |= not_converged
                        good = state == 0
                        slopes[frame, 0, s, a] = move_x * pixel_scale if good else np.nan
                        slopes[frame, 1, s, a] = move_y * pixel_scale if good else np.nan
                        flux[frame, s, a] = light if good else np.nan
                        if brightest[s] >= suspect[a]:
                            # Only now is it worth looking at every pixel of the window.
                            low_y = max(long(last_y[s] - half_y + half), long(0))
                            low_x = max(long(last_x[s] - half_x + half), long(0))
                            for r in range(low_y, min(low_y + long(tall + 2), long(rows))):
                                for k in range(low_x, min(low_x + long(wide), long(columns))):
                                    inside = abs(single(r) - last_y[s]) < half_y and abs(single(k) - last_x[s]) < half_x
                                    used = scale[index((n * rows + r) * length + k) + corner] != none
                                    raw = frames[start_of_band + corner + index(r * frame_columns + k)]
                                    if inside and used and raw >= saturation:
                                        state |= saturated
                        flag[frame, s, a] = state

    compiled: Callable[..., None] = measure
    return compiled
