"""Detection noise judged from the data alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import fft

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Bands into which the upper half of the temporal spectrum is cut; the emptiest is taken for noise.
_BANDS = 8


def white_noise_variance(series: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Variance of the white part of each series, from the floor of its temporal spectrum.

    Turbulence is carried past an aperture by the wind and leaves the fast end of the spectrum nearly empty,
    detection noise fills all of it alike. The upper half of the spectrum is cut into bands and the mean power of
    the emptiest one, so that a line of vibration does no harm, is taken for the level of the noise. What
    turbulence is left in that band makes this an upper bound.

    Parameters
    ----------
    series : ndarray, (T, ...)
        Equally spaced samples; NaN are replaced by the mean of the series.

    Returns
    -------
    ndarray of float64, (...)
        Variance in the squared unit of the series; NaN where a series has fewer than 64 samples.
    """
    if len(series) < 64:
        return np.full(series.shape[1:], np.nan)
    values = np.asarray(series, dtype=np.float32)
    mean = np.nanmean(values, axis=0)
    deviation = np.where(np.isnan(values), 0, values - mean)
    length = int(fft.prev_fast_len(len(deviation)))
    spectrum = fft.rfft(deviation[:length], axis=0)
    half = spectrum[len(spectrum) // 2 : -1]
    edges = np.linspace(0, len(half), _BANDS + 1).astype(int)
    power = np.stack([(np.abs(half[a:b]) ** 2).mean(axis=0) for a, b in zip(edges[:-1], edges[1:], strict=True)])
    present = 1 - np.isnan(values).mean(axis=0)
    # Parseval: white noise of variance s^2 has E|X_k|^2 = n s^2 at every frequency.
    return np.asarray(power.min(axis=0) / (length * present), dtype=np.float64)
