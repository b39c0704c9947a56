"""Detection noise of the fluxes, from pixels without light."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .extraction import Calibration, SpotLayout

#: Part of the pixels of the lenslet boxes, those with the least light, that are taken to be dark.
DARK_PART = 0.25
#: Frames that are looked at: some hundred pixels times as many differences fix the median to a few per cent.
FRAMES = 32


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
