"""Arrays that pass from one stage to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Measurements:
    """Slopes and fluxes of consecutive frames.

    Parameters
    ----------
    time : ndarray of int64, (T,)
        Start of exposure, ns since 1970-01-01T00:00:00 UTC.
    slopes : ndarray of float64, (T, 2, S, A)
        Slopes along x and y for each source and subaperture, rad; NaN where there is none.
    flux : ndarray of float64, (T, S, A)
        Background-subtracted sum, counts; NaN where there is none.
    flag : ndarray of uint8, (T, S, A)
        Bits of :data:`coslidar.pipeline.extraction.FLAGS`.
    """

    time: NDArray[np.int64]
    slopes: NDArray[np.float64]
    flux: NDArray[np.float64]
    flag: NDArray[np.uint8]

    @staticmethod
    def join(parts: list[Measurements]) -> Measurements:
        """Put consecutive pieces together in time."""
        return Measurements(
            np.concatenate([part.time for part in parts]),
            np.concatenate([part.slopes for part in parts]),
            np.concatenate([part.flux for part in parts]),
            np.concatenate([part.flag for part in parts]),
        )
