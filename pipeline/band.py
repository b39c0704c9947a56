r"""Detector band: what a spectral weight makes of the diffraction factors of the response.

A detector counts the light of all wavelengths of its band, so flux fluctuation and centroid are means of the
monochromatic ones, weighted with the counts of each wavelength. Turbulence is the same at every wavelength (the
dispersion of air is neglected), so to first order these means stand inside the amplitude of a signal, before it is
squared: cos X and k sin X with X = pi lambda zeta, zeta = f^2 z L / (L - z), become

    integral of w(lambda) cos(pi lambda zeta)    and    integral of w(lambda) (2 pi / lambda) sin(pi lambda zeta)

over the normalised weight w. Averaging the responses of single wavelengths instead would be right for detectors whose
signals at different wavelengths are independent, which they are not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import eigh_tridiagonal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


@dataclass(frozen=True)
class Band:
    """Spectral weight of a detector, linear between the given wavelengths and zero beyond.

    Parameters
    ----------
    wavelengths : tuple of float
        Increasing, m; a single one stands for monochromatic light.
    weights : tuple of float
        Counts per wavelength interval at each of them, in any unit: source radiance times transmissions times quantum
        efficiency per photon.

    Raises
    ------
    ValueError
        Wavelengths that are not positive and increasing, or weights that are negative, not finite or all zero.
    """

    wavelengths: tuple[float, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        wavelengths, weights = np.asarray(self.wavelengths), np.asarray(self.weights)
        if wavelengths.size == 0 or wavelengths.shape != weights.shape:
            raise ValueError(f"{wavelengths.size} wavelengths and {weights.size} weights: give one weight for each")
        if not np.all(np.isfinite(wavelengths)) or wavelengths[0] <= 0 or np.any(np.diff(wavelengths) <= 0):
            raise ValueError("the wavelengths of a band must be positive and increase")
        if not np.all(np.isfinite(weights)) or np.any(weights < 0) or not np.any(weights > 0):
            raise ValueError("the weights of a band must be finite, none negative, and not all zero")

    @property
    def limits(self) -> tuple[float, float]:
        """Shortest and longest wavelength, m."""
        return self.wavelengths[0], self.wavelengths[-1]

    @cached_property
    def centre(self) -> float:
        """Mean wavelength, m."""
        nodes, weights = self.rule(2)
        return float(nodes @ weights)

    def rule(self, n: int) -> tuple[Array, Array]:
        """Gauss rule of this weight: at most `n` wavelengths (m) and their shares, which sum to 1.

        From a composite Gauss-Legendre rule over the pieces of the weight, by Lanczos' recurrence and the eigenvalues
        of its tridiagonal matrix (Golub and Welsch 1969, https://doi.org/10.1090/S0025-5718-69-99647-1).
        """
        return _gauss(self, n)

    def envelopes(self, zeta: Array) -> tuple[Any, Any]:
        r"""Slow parts of the diffraction factors at zeta = f^2 z L / (L - z), in 1/m.

        Parameters
        ----------
        zeta : ndarray of float
            1/m, not negative.

        Returns
        -------
        (float or ndarray of complex, float or ndarray of complex)
            C and S with mean cos X = Re(C exp(i X_0)) and mean k sin X = Im(S exp(i X_0)), X_0 = pi lambda_0 zeta at
            the mean wavelength lambda_0: 1 and k for monochromatic light.
        """
        if len(self.wavelengths) == 1:
            return 1.0, 2 * math.pi / self.wavelengths[0]
        low, high = self.limits
        swing = math.pi * (high - low) * float(zeta.max(initial=0.0))
        # A rule of n nodes over a phase of 2a is in error by about (a / 2)^(2n) / (2n)!, here below 1e-9.
        n = 8 * math.ceil((0.36 * swing + 9) / 8)
        nodes, weights = self.rule(n)
        flat = zeta.ravel()
        turns = np.exp(1j * math.pi * np.outer(nodes - self.centre, flat))
        cosine, sine = np.stack([weights, weights * 2 * math.pi / nodes]) @ turns
        return cosine.reshape(zeta.shape), sine.reshape(zeta.shape)


@lru_cache(maxsize=64)
def _gauss(band: Band, n: int) -> tuple[Array, Array]:
    edges, values = np.asarray(band.wavelengths), np.asarray(band.weights)
    if edges.size == 1:
        return edges.astype(float), np.ones(1)
    low, width = edges[0], edges[-1] - edges[0]
    fine: list[Array] = []
    light: list[Array] = []
    for a, b, wa, wb in zip(edges[:-1], edges[1:], values[:-1], values[1:], strict=True):
        x, rule = np.polynomial.legendre.leggauss(math.ceil(n * (b - a) / width) + 8)
        share = (1 + x) / 2
        fine.append((a + share * (b - a) - low) / width * 2 - 1)
        light.append((b - a) * rule * (wa + share * (wb - wa)))
    x, w = np.concatenate(fine), np.concatenate(light)
    x, w = x[w > 0], w[w > 0] / w.sum()
    n = min(n, x.size)
    basis = np.zeros((n, x.size))
    diagonal, beside = np.zeros(n), np.zeros(n)
    vector = np.sqrt(w)
    for j in range(n):
        basis[j] = vector / np.linalg.norm(vector)
        diagonal[j] = basis[j] @ (x * basis[j])
        vector = x * basis[j]
        for _ in range(2):  # once leaves what rounding puts back along the earlier vectors
            vector = vector - basis[: j + 1].T @ (basis[: j + 1] @ vector)
        beside[j] = np.linalg.norm(vector)
    places, vectors = eigh_tridiagonal(diagonal, beside[:-1])
    return low + width * (places + 1) / 2, vectors[0] ** 2
