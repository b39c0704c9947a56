"""Where the spots lie: found on a mean frame, with windows, mean spots and everything that frames are measured with."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from .bad_pixels import fill, light_on, no_bad_pixels, predictors
from .extraction import REFINED, measure_boxes, search_region
from .mean_spot import mean_spots, window_response, wings
from .refinement import prepared
from .shifts import Splines
from .spots import FLAGS, Calibration, SpotLayout

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from .parameters import ExtractionParameters, Header

    Floats = NDArray[np.float64]

#: Least response of a window that stays where it is: faint or broad spots must not make it jump.
LEAST_RESPONSE = 0.7
#: A source of which this part of the spots is found is lit.
LIT = 0.5
#: Brightness of a spot's core, relative to the brighter source's in the same box, up to which it may be a wing of that.
WING = 0.01
#: Part of a spot's light on bad pixels above which it is not measured.
BAD_LIGHT = 0.3
#: Along the line of sources, part of their distance that a window may cover.
ALONG = 0.9
#: Across, and for a single source, size of the window in units of the spot's full width at half maximum.
ACROSS = 6.6


def reference_image(*frames: NDArray[Any]) -> Floats:
    """Mean of frames, from which the spots' positions are taken.

    Parameters
    ----------
    *frames : ndarray, (n, row, col)
        Raw counts, in any number of pieces.

    Returns
    -------
    ndarray of float64, (row, col)

    Raises
    ------
    ValueError
        There are no frames.
    """
    for piece in frames:
        if piece.ndim != 3 or not piece.size:
            raise ValueError(f"frames of shape {piece.shape}: (time, row, col) with at least one frame is needed")
    if frames[0].dtype.kind in "ui":
        # Sums of integers are exact, however they are cut.
        total = sum(np.sum(piece, axis=0, dtype=np.int64) for piece in frames)
        return np.asarray(total / sum(map(len, frames)))
    whole = frames[0] if len(frames) == 1 else np.concatenate(frames)
    mean: Floats = np.mean(whole, axis=0, dtype=np.float64)
    return mean


def layout(
    header: Header,
    mean_frame: ArrayLike,
    calibration: Calibration,
    parameters: ExtractionParameters,
    *,
    previous: SpotLayout | None = None,
    moved: ArrayLike = 0.0,
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
    previous : SpotLayout, optional
        An earlier layout of this recording. The spots are looked for where it has them, its window is kept, and so is
        its knowledge of spots that the mean frame does not show.
    moved : array_like, broadcast to (S, 2)
        By how much (row, col) the spots have moved since, px.

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
    spots = np.repeat(nominal[:, None, :], len(boxes), axis=1)
    if previous is not None:
        spots = previous.spots + np.broadcast_to(np.asarray(moved), nominal.shape)[:, None]
        nominal = np.median(spots, axis=1)
    signal, scale, offset, bad = _calibrated_boxes(mean_frame, boxes, (rows, cols), calibration, nominal)

    # First guess: everything at its nominal place, bad pixels as in the typical box.
    typical = _typical_box(signal, bad)
    filled = fill(signal, bad, typical)
    if previous is None:
        whole = _typical_box(filled, np.zeros_like(bad))
        shown = _has_spot(whole[None], nominal[:, None], (rows / 3, cols / 3))[:, 0]
        fwhm = _full_width(whole, nominal[shown] if shown.any() else nominal)
        window = _window(parameters, nominal, (rows, cols), fwhm)
    else:
        fwhm, window = previous.fwhm, previous.window
    start, index, neighbour, weight = no_bad_pixels(len(boxes))
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
        search=search_region(spots, (rows, cols), parameters.search),
        scale=scale,
        offset=offset,
        suspect=_lowest_saturated(scale, offset, calibration.saturation),
        bad_start=start,
        bad_index=index,
        bad_neighbour=neighbour,
        bad_weight=weight,
        excluded=np.zeros(spots.shape[:2], dtype=np.uint8),
        boost=np.ones((len(nominal), 2), dtype=np.float32),
    )
    # Second: positions on the filled mean boxes, then templates of spots brought to one place.
    plain = parameters
    if parameters.method in REFINED:
        plain = parameters.model_copy(update={"method": "subpixel_window"})
    spots, _ = measure_boxes(first, filled, plain)
    spots = np.where(np.isfinite(spots), spots, first.spots)
    template, centre = _templates(filled, bad, spots)
    if previous is not None:
        dark = _has_spot(filled, spots, window).mean(axis=1) < LIT
        template[dark], centre[dark] = previous.template[dark], previous.centre[dark]
    start, index, neighbour, weight = predictors(bad, spots, template, centre)
    for box, begin, end in zip(range(len(boxes)), start[:-1], start[1:], strict=True):
        flat_box = filled[box].reshape(-1)
        flat_box[index[begin:end]] = 0.0
        flat_box[index[begin:end]] = np.einsum(
            "bn,bn->b", weight[begin:end], flat_box[neighbour[begin:end]].astype(np.float64)
        )
    spots, flux = measure_boxes(replace(first, spots=spots), filled, plain)
    missing: NDArray[np.bool_] = np.logical_not(np.isfinite(spots).all(axis=-1))
    spots = np.where(missing[..., None], first.spots, spots)
    excluded = np.where(missing | ~_has_spot(filled, spots, window), FLAGS["no_spot"], 0) | np.where(
        light_on(bad, spots, template, centre, window) > BAD_LIGHT, FLAGS["bad_pixels"], 0
    )
    flux = np.nan_to_num(flux)
    if previous is not None:
        gone = (excluded & ~previous.excluded & FLAGS["no_spot"]) > 0
        spots = np.where(gone[..., None], first.spots, spots)
        flux = np.where(gone, previous.flux, flux)
        excluded = np.where(gone, excluded & ~FLAGS["no_spot"], excluded)
    found = replace(
        first,
        spots=spots,
        flux=flux,
        template=template,
        centre=centre,
        search=search_region(spots, (rows, cols), parameters.search),
        bad_start=start,
        bad_index=index,
        bad_neighbour=neighbour,
        bad_weight=weight,
        excluded=excluded.astype(np.uint8),
    )
    alone = mean_spots(found)
    response = np.clip(window_response(alone, found), LEAST_RESPONSE, 1.0)
    found = replace(found, boost=(1 / response).astype(np.float32))
    if parameters.wings == "removed" and parameters.method == "subpixel_window" and len(nominal) == 2:
        table, begin = wings(alone, found, 2 * parameters.search)
        found = replace(found, wings=table, wing_start=begin)
    return replace(found, prepared=prepared(found, parameters))


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


def _templates(filled: Floats, bad: NDArray[np.bool_], spots: Floats) -> tuple[Floats, Floats]:
    """Mean box of each source with its spots brought to one place, (S, rows, cols), and that place (S, 2)."""
    centre = spots.mean(axis=1)
    # A filled pixel and what the spline makes of its neighbours count for nothing.
    cross = ndimage.generate_binary_structure(2, 1)[None]  # in each box by itself
    weight = 1.0 - ndimage.binary_dilation(bad, cross).astype(float)
    weight = np.maximum(weight, 1e-6)
    template = np.empty((len(spots), *filled.shape[1:]))
    splines = Splines(filled)
    for source in range(len(spots)):
        moved = np.stack([splines.moved(box, centre[source] - spot) for box, spot in enumerate(spots[source])])
        template[source] = (moved * weight).sum(axis=0) / weight.sum(axis=0)
    return template, centre


def _has_spot(filled: Floats, spots: Floats, window: tuple[float, float]) -> NDArray[np.bool_]:
    """Whether the mean frame shows a spot, (S, A).

    Its core is well above the scatter of the box's dark part, and brighter than a wing of the other source.
    """
    rows, cols = np.indices(filled.shape[1:])
    away = np.abs(np.stack([rows, cols], axis=-1) - spots[:, :, None, None])  # source, box, row, col, axis
    outside = np.logical_not((away < np.array(window) / 2).all(axis=-1).any(axis=0))
    level = _median(filled, outside)[:, None, None]
    scatter = 1.4826 * _median(np.abs(filled - level), outside)
    near = (away <= 1.0).all(axis=-1)
    core = np.where(near, filled - level, 0.0).sum(axis=(2, 3)) / near.sum(axis=(2, 3))
    found: NDArray[np.bool_] = (core > 5.0 * scatter) & (core > 0.0) & (core > WING * core.max(axis=0))
    return found


def _median(values: Floats, used: NDArray[np.bool_]) -> Floats:
    """Median of the used pixels of each box, (A,)."""
    ordered = np.sort(np.where(used, values, np.inf).reshape(len(values), -1), axis=1)
    count = used.reshape(len(values), -1).sum(axis=1)
    middle = np.stack([(count - 1) // 2, count // 2], axis=1)
    return np.asarray(np.take_along_axis(ordered, middle, axis=1).mean(axis=1))


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
