"""Slopes and fluxes from Shack-Hartmann frames: one position per source, subaperture and frame.

The ways to measure a position (`ExtractionParameters.method`):

``subpixel_window``
    The brightest pixel within `search` of the spot's mean position is the start. A rectangle whose border
    pixels count by the fraction of them that it covers is then re-centred `passes` times on its own centre of
    gravity. Nothing jumps when a spot crosses from one pixel to the next. What the mean spot of the other source has
    in the rectangle is taken off.
``moving_maximum``
    A rectangle of whole pixels (odd sides) centred on the brightest pixel (Sauvage et al. 2021).
``thresholded``, ``weighted``, ``template``
    See :mod:`coslidar.pipeline.refinement`; they begin where the sub-pixel window ends.

Pixels are calibrated as (frame - dark) / flat. A bad pixel is never read: its value is predicted from its good
neighbours, with the weights that predict it best for the archive's own mean spot at any sub-pixel position.
Where there is no dark, a plane fitted to the mean frame outside the spot windows stands for it, box by box.

Slopes are displacements from the spot's position in the mean frame, times the pixel scale. Their zero is as
arbitrary as the choice of frames that were averaged; only fluctuations are used later. Fluxes are plain sums
over the window, in counts, neither thresholded nor clipped; those of a fit are the fit's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .bad_pixels import no_bad_pixels
from .refinement import refine
from .shifts import Splines
from .spots import FLAGS, Calibration, SpotLayout, eights
from .window_kernel import window_kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .parameters import ExtractionParameters

    Floats = NDArray[np.float64]

__all__ = ["FLAGS", "Calibration", "SpotLayout", "extract", "response_to_tilt"]

#: Changes whenever the numbers that this stage returns for the same input change.
VERSION = 4

#: Part of its mean flux below which a spot is taken to be absent from a frame.
FLUX_FLOOR = 0.02

#: Methods for which the window is but the beginning.
REFINED = ("thresholded", "weighted", "template")

_NUMPY_TYPES = (np.uint8, np.uint16, np.int16, np.float32)


def extract(
    frames: NDArray[Any],
    layout: SpotLayout,
    calibration: Calibration,
    parameters: ExtractionParameters,
    out: tuple[Floats, Floats, NDArray[np.uint8]] | None = None,
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
    out : tuple of ndarray, optional
        Where to put what is returned.

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
    if out is None:
        shape = (len(frames), n_sources, n_boxes)
        out = np.empty((len(frames), 2, n_sources, n_boxes)), np.empty(shape), np.empty(shape, dtype=np.uint8)
    slopes, flux, flag = out
    rows, cols = layout.pitch
    tall, wide = (int(side) for side in layout.window)
    usual, across = layout.usual
    whole = parameters.method == "moving_maximum"
    window_kernel(cols, across, eights(int(2 * parameters.search)), tall, eights(wide + 2))(
        frames.reshape(-1),
        len(frames),
        layout.frame_shape[0] * layout.frame_shape[1],
        layout.frame_shape[1],
        layout.boxes[:, 0] * layout.frame_shape[1] + layout.boxes[:, 1],
        rows,
        usual,
        layout.scale.reshape(-1),
        layout.offset.reshape(-1),
        layout.bad_start,
        layout.bad_index,
        layout.bad_neighbour,
        layout.bad_weight,
        layout.spots,
        layout.search,
        np.array(layout.window, dtype=np.float32),
        1 if whole else parameters.passes,
        np.ones_like(layout.boost) if whole else layout.boost,
        layout.wings,
        layout.wing_start,
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
    if parameters.method in REFINED:
        zero = np.moveaxis(layout.spots, -1, 0)[::-1]
        position = slopes / layout.pixel_scale + zero
        refine(frames, layout, parameters, position, flux, flag)
        slopes[...] = (position - zero) * layout.pixel_scale
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
        spline = Splines(template[None])
        for axis in range(2):
            step = np.array((0.0, 1.0) if axis == 0 else (1.0, 0.0))
            boxes = np.stack([spline.moved(0, step * move) for move in moves])
            spots = np.repeat(layout.centre[:, None, :], len(boxes), axis=1)
            found, _ = measure_boxes(replace(layout, spots=spots), boxes, parameters)
            gain[axis, source] = np.polyfit(moves, found[source, :, 1 - axis] - centre[1 - axis], 1)[0]
    return gain


def search_region(spots: Floats, pitch: tuple[int, int], search: float) -> NDArray[np.int64]:
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
    start, index, neighbour, weight = no_bad_pixels(n_boxes)
    return replace(
        layout,
        boxes=np.stack([rows * np.arange(n_boxes), np.zeros(n_boxes, dtype=np.int64)], axis=1),
        frame_shape=(rows * n_boxes, cols),
        pixel_scale=1.0,
        spots=spots,
        flux=np.zeros((n_sources, n_boxes)),
        search=search_region(spots, layout.pitch, search),
        scale=np.ones((n_boxes, rows, cols), dtype=np.float32),
        offset=np.zeros((n_boxes, rows, cols), dtype=np.float32),
        suspect=np.full(n_boxes, np.inf, dtype=np.float32),
        bad_start=start,
        bad_index=index,
        bad_neighbour=neighbour,
        bad_weight=weight,
        excluded=np.zeros((n_sources, n_boxes), dtype=np.uint8),
    )


def measure_boxes(layout: SpotLayout, boxes: Floats, parameters: ExtractionParameters) -> tuple[Floats, Floats]:
    """Positions (S, A, 2) and fluxes (S, A) on calibrated boxes (A, rows, cols)."""
    bare = _bare(layout, layout.spots, min(parameters.search, max(2.0, 0.5 * layout.fwhm)))
    frame = boxes.astype(np.float32).reshape(1, *bare.frame_shape)
    moved, flux, _ = extract(frame, bare, Calibration(), parameters)
    return layout.spots + moved[0, ::-1].transpose(1, 2, 0), flux[0]


def _half_way(spots: Floats) -> Floats:
    """Vectors, (S, A, 2), whose product with a displacement reaches 1 half way to the other source."""
    if len(spots) == 1:
        return np.zeros_like(spots)
    apart = spots[::-1] - spots
    vectors: Floats = 2.0 * apart / np.maximum((apart**2).sum(axis=-1, keepdims=True), 1e-12)
    return vectors
