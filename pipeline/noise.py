"""Detection noise of fluxes and slopes, from pixels without light, the photons of the spots, and the window.

Noise is predicted, not read off the data: a spectrum's floor holds scintillation that moves by more than its size from
frame to frame, and is no measure of noise.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .extraction import measure_boxes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .parameters import ExtractionParameters
    from .spots import Calibration, SpotLayout

#: Part of the pixels of the lenslet boxes, those with the least light, that are taken to be dark.
DARK_PART = 0.25
#: Frames that are looked at: some hundred pixels times as many differences fix the median to a few per cent.
FRAMES = 32
#: Of this many frames one tells how often spots are faint.
EVERY = 8


def pixel_noise_variance(frames: NDArray[Any], layout: SpotLayout, calibration: Calibration) -> float:
    """Variance of a pixel without light: read noise, and photon noise of the background.

    Half the mean squared difference of consecutive frames, so that drifts do not count; the median over the darkest
    quarter of the good pixels in the lenslet boxes, so that neither the wings of a spot nor a flickering pixel do.

    Parameters
    ----------
    frames : ndarray, (T, row, col)
        Consecutive raw frames, at least two.
    layout : SpotLayout
        Lenslet boxes.
    calibration : Calibration
        Dark and bad pixels.

    Returns
    -------
    float
        counts^2; 0 where there are fewer than two frames or no good pixel.
    """
    if len(frames) < 2:
        return 0.0
    frames = frames[:FRAMES]
    rows, cols = layout.pitch
    row = layout.boxes[:, 0, None, None] + np.arange(rows)[:, None]
    col = layout.boxes[:, 1, None, None] + np.arange(cols)
    values = frames[:, row, col].astype(np.float64)
    mean = values.mean(axis=0)
    if calibration.dark is not None:
        mean = mean - calibration.dark[row, col]
    good = np.ones_like(mean, dtype=bool) if calibration.bad_pixel is None else ~calibration.bad_pixel[row, col]
    if not good.any():
        return 0.0
    dark = good & (mean <= np.quantile(mean[good], DARK_PART))
    return float(np.median((np.diff(values[:, dark], axis=0) ** 2).mean(axis=0) / 2))


def flux_noise_variance(
    flux: NDArray[np.float64], pixel_variance: float, area: float, gain: float | None
) -> NDArray[np.float64]:
    """Variance of a flux by detection noise.

    Parameters
    ----------
    flux : ndarray
        Mean flux, counts.
    pixel_variance : float
        From :func:`pixel_noise_variance`, counts^2.
    area : float
        Pixels of the window.
    gain : float or None
        Electrons per count; without it the photon noise of the source itself is left out.

    Returns
    -------
    ndarray
        counts^2: the noise of `area` pixels, and one electron^2 per electron of light.
    """
    photons = np.maximum(flux, 0.0) / gain if gain else np.zeros_like(flux)
    return np.asarray(area * pixel_variance + photons)


def slope_noise_variance(
    layout: SpotLayout, flux: NDArray[np.floating], pixel_variance: float, gain: float | None, *, recentred: bool = True
) -> NDArray[np.float64]:
    """Variance of the slopes by detection noise, averaged over the fluctuations of the flux.

    A centre of gravity c = sum w x v / sum w v moves by sum w (x - c) n / F for noise n of the pixels, so its variance
    is [var sum w^2 (x - c)^2 + sum w^2 (x - c)^2 v / gain] / F^2; w is the part of a pixel that the window covers. A
    window re-centred on its own centroid moves on until its moment vanishes, and as the moment of the mean spot changes
    by 1 - e per pixel of the window's motion (e: light on the borders), all this is divided by (1 - e)^2. Drawn frames
    have 0.95 to 0.97 of it; a window centred on the brightest pixel has 1.2 times as much, because that pixel jumps.

    Parameters
    ----------
    layout : SpotLayout
        Window and mean spots.
    flux : ndarray, (T, S, A)
        Fluxes, counts: faint frames have most of the noise. NaN where not measured; zero and less count as such.
    pixel_variance : float
        From :func:`pixel_noise_variance`, counts^2.
    gain : float or None
        Electrons per count; without it the photon noise is left out.
    recentred : bool
        Whether the window follows its own centroid.

    Returns
    -------
    ndarray, (2, S, A)
        rad^2 along x and y; NaN for a spot that is never measured.
    """
    height, width = layout.window
    shape = layout.template.shape[1:]
    inverse, first, second = _faintness(flux)
    variance = np.empty((2, *layout.flux.shape))
    for source, (template, (row, col)) in enumerate(zip(layout.template, layout.centre, strict=True)):
        for axis in range(2):
            place, side, across, other = (col, width, row, height) if axis == 0 else (row, height, col, width)
            image = template if axis == 0 else template.T
            size, far = (shape[1], shape[0]) if axis == 0 else shape

            def moment(
                move: float,
                image: NDArray[np.float64] = image,
                place: float = place,
                side: float = side,
                across: float = across,
                other: float = other,
                size: int = size,
                far: int = far,
            ) -> float:
                """First moment of the mean spot in a window that is moved along the axis, relative to its light."""
                weight = np.outer(_cover(across, other, far), _cover(place + move, side, size))
                return float((weight * image * (np.arange(size) - place - move)).sum() / (weight * image).sum())

            stiffness = moment(-0.5) - moment(0.5)
            along, beside = _cover(place, side, size), _cover(across, other, far)
            arm = along**2 * (np.arange(size) - place) ** 2
            # The window lies anywhere between pixels, and covers the parts of those at its border accordingly.
            dark = _spread(side, arm=True) * _spread(other, arm=False)
            light = np.outer(beside**2, arm) * image
            photons = max(float(light.sum()), 0.0) / float((np.outer(beside, along) * image).sum())
            variance[axis, source] = pixel_variance * dark * second[source]
            variance[axis, source] += photons / gain * first[source] if gain else 0.0
            if recentred:
                variance[axis, source] /= stiffness**2
    variance *= layout.pixel_scale**2
    return np.where(np.isfinite(inverse).any(axis=0), variance, np.nan)


def refined_noise_variance(
    layout: SpotLayout,
    flux: NDArray[np.floating],
    pixel_variance: float,
    gain: float | None,
    parameters: ExtractionParameters,
) -> NDArray[np.float64]:
    """Variance of the slopes by detection noise, for methods that are no plain centre of gravity.

    To first order a position moves by the sum over pixels of its derivative with respect to a pixel times that pixel's
    noise. The derivatives are measured: each pixel in reach of the mean spot is raised and lowered by a fiftieth of the
    brightest, and the position found by the method itself.

    Parameters
    ----------
    layout, flux, pixel_variance, gain
        As for :func:`slope_noise_variance`.
    parameters : ExtractionParameters
        Method.

    Returns
    -------
    ndarray, (2, S, A)
        rad^2 along x and y; NaN for a spot that is never measured.
    """
    inverse, first, second = _faintness(flux)
    variance = np.empty((2, *layout.flux.shape))
    rows, cols = np.indices(layout.pitch)
    for source, (template, centre) in enumerate(zip(layout.template, layout.centre, strict=True)):
        near = (np.abs(rows - centre[0]) < layout.window[0] / 2 + 1) & (
            np.abs(cols - centre[1]) < layout.window[1] / 2 + 1
        )
        pixels = np.argwhere(near)
        step = template.max() / 50
        boxes = np.repeat(template[None], 2 * len(pixels), axis=0)
        for number, (row, col) in enumerate(pixels):
            boxes[2 * number, row, col] += step
            boxes[2 * number + 1, row, col] -= step
        spots = np.repeat(layout.centre[:, None], len(boxes), axis=1)
        found, light = measure_boxes(replace(layout, spots=spots), boxes, parameters)
        moved = (found[source, ::2] - found[source, 1::2]) / (2 * step)
        total = float(np.nanmedian(light[source]))
        for axis in range(2):
            square = np.nan_to_num(moved[:, 1 - axis] ** 2)
            variance[axis, source] = pixel_variance * square.sum() * total**2 * second[source]
            if gain:
                photons = np.maximum(template[near], 0.0)
                variance[axis, source] += (square * photons).sum() * total * first[source] / gain
    variance *= layout.pixel_scale**2
    return np.where(np.isfinite(inverse).any(axis=0), variance, np.nan)


def _faintness(
    flux: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Inverse of the fluxes, NaN where there is none, and the means over time of it and of its square."""
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.where(flux > 0, 1 / flux, np.nan)
    count = np.maximum(np.isfinite(inverse).sum(axis=0), 1)
    first, second = (np.nansum(inverse**power, axis=0) / count for power in (1, 2))
    return inverse, first, second


def _cover(centre: float, side: float, size: int) -> NDArray[np.float64]:
    """Part of each of `size` pixels in a row that a window covers."""
    left = np.arange(size) - 0.5
    covered = np.minimum(left + 1, centre + side / 2) - np.maximum(left, centre - side / 2)
    return np.asarray(np.clip(covered, 0.0, 1.0))


def _spread(side: float, *, arm: bool) -> float:
    """Mean over the window's place of the sum of squared weights, times the squared arms or not."""
    size = int(side) + 4
    total = 0.0
    places = np.linspace(0, 1, 8, endpoint=False) + size / 2
    for place in places:
        square = _cover(float(place), side, size) ** 2
        total += float((square * (np.arange(size) - place) ** 2).sum() if arm else square.sum())
    return total / len(places)
