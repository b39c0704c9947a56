"""Large-aperture scintillometers: path weighting, log-amplitude variance and Cn2, saturation.

The log-amplitude variance of an incoherent disc seen by a disc is the integral of ``w(z) Cn2(z)`` with

    w(z) = 4 pi^2 k^2 0.033 integral of kappa^(-8/3) sin^2(kappa^2 z (L - z) / (2 k L)) A(kappa a) A(kappa b) dkappa,
    A(x) = (2 J1(x) / x)^2,  a = D_near (1 - z / L) / 2,  b = D_far z / (2 L)

(Wang, Ochs and Clifford 1978, https://doi.org/10.1364/JOSA.68.000334). Where the apertures are much wider than the
Fresnel scale the sine may be replaced by its argument, k drops out and only the ratio of the two blurs matters: the
geometric limit, in which the maker's constants alpha of Cn2 = alpha sigma_chi^2 D^(7/3) L^(-3) are given.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.special import j1

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from .geometry import SliceGrid

    Array = NDArray[np.float64]

#: Constant of the Kolmogorov spectrum of the refractive index, 0.033 Cn2 kappa^(-11/3).
KOLMOGOROV = 0.033
#: Cn2 in units of D^(5/3) lambda^(1/3) L^(-8/3) above which a scintillometer saturates (Ochs and Wilson 1993, NOAA
#: Technical Memorandum ERL WPL-232; quoted by Kohsiek et al. 2006, Boundary-Layer Meteorology 121).
SATURATION = 0.18
#: Gauss-Legendre rule of each panel of a quadrature.
_NODES, _RULE = np.polynomial.legendre.leggauss(32)
#: Where airy patterns are replaced by their mean; there cos(2 x) = 0, so that the swing around it drops out.
_FAR = 120.5 * np.pi / 2


def _airy(x: Array) -> Array:
    """(2 J1(x) / x)^2."""
    safe = np.where(x == 0, 1.0, x)
    return np.asarray(np.where(x == 0, 1.0, (2 * j1(safe) / safe) ** 2))


def _panels(edges: Array) -> tuple[Array, Array]:
    """Nodes and weights of a quadrature over panels."""
    half = np.diff(edges)[:, None] / 2
    return ((edges[:-1, None] + half) + half * _NODES).ravel(), (half * _RULE).ravel()


@lru_cache(maxsize=4096)
def _blur_integral(ratio: float) -> float:
    """Integral of x^(4/3) A(x) A(ratio x) over x > 0, for 0 <= ratio <= 1.

    Beyond `_FAR` the first pattern is its mean, 4 / (pi x^3) (1 + 3 / (8 x^2)): without that tail, which decays as
    x^(-2/3) where the other aperture is a point, the ends of the path would come out several per cent too low.
    """
    x, weight = _panels(np.linspace(0, _FAR ** (1 / 3), 129))  # x = u^3 removes the fractional power at zero
    near = float(np.sum(weight * 3 * x**6 * _airy(x**3) * _airy(ratio * x**3)))
    mean, correction = 4 / np.pi, 3 / 8
    if ratio * _FAR < 1e-9:
        return float(near + mean * (1.5 * _FAR ** (-2 / 3) + correction * 3 / 8 * _FAR ** (-8 / 3)))
    # In y = ratio x, on a logarithmic scale up to one and in steps of the pattern beyond.
    start, end = ratio * _FAR, max(ratio * _FAR, _FAR)
    edges = np.concatenate([np.geomspace(start, 1, 33)[:-1] if start < 1 else [], np.linspace(max(start, 1), end, 129)])
    if end > start:
        y, weight = _panels(edges)
        far = np.sum(weight * y ** (-5 / 3) * (1 + correction * (ratio / y) ** 2) * _airy(y)) * mean * ratio ** (2 / 3)
    else:
        far = 0.0
    # Both are their mean: 16 / pi^2 ratio^(-3) integral of x^(4/3 - 6).
    rest = mean**2 * ratio ** (2 / 3) * 3 / 11 * end ** (-11 / 3)
    return near + float(far) + float(rest)


def variance_weight(
    z: Array, path_length: float, near_diameter: float, far_diameter: float, wavelength: float | None = None
) -> Array:
    """Log-amplitude variance per Cn2 and length of path.

    Parameters
    ----------
    z : ndarray of float, (n,)
        Distance from the near aperture, m.
    path_length : float
        Distance L of the apertures, m.
    near_diameter, far_diameter : float
        Their diameters, m; either may emit.
    wavelength : float, optional
        Wavelength, m; the geometric limit where it is absent.

    Returns
    -------
    ndarray of float, (n,)
        w(z) of the module's description, m^(-1/3); zero at both ends.
    """
    z = np.asarray(z, dtype=np.float64)
    u = z / path_length
    near, far = near_diameter * (1 - u) / 2, far_diameter * u / 2
    spread: Array = np.where((u > 0) & (u < 1), z * (1 - u), 0.0)
    if wavelength is None:
        large, small = (np.asarray(f(near, far)) for f in (np.maximum, np.minimum))
        # Ratios to nine digits, so that mirrored paths share their integrals.
        integral = np.array([_blur_integral(round(float(r), 9)) for r in (small / large).ravel()]).reshape(z.shape)
        return np.asarray(np.pi**2 * KOLMOGOROV * spread**2 * large ** (-7 / 3) * integral)
    k = 2 * np.pi / wavelength
    weights = np.zeros(z.shape)
    x, rule = _panels(np.linspace(0, 300 ** (1 / 3), 241))
    x3, measure = x**3, rule * 3 * x**-6
    for index in np.ndindex(z.shape):
        if spread[index] > 0:
            a, b, width = float(near[index]), float(far[index]), float(spread[index])
            scale = max(a, b, math.sqrt(width / k))
            swing = np.sin(x3**2 * (width / (2 * k * scale**2))) ** 2
            blur = _airy(x3 * (a / scale)) * _airy(x3 * (b / scale))
            weights[index] = scale ** (5 / 3) * np.sum(measure * swing * blur)
    return np.asarray(4 * np.pi**2 * k**2 * KOLMOGOROV * weights)


def _integrate(weight: Callable[[Array], Array], start: float, stop: float, panels: int) -> float:
    nodes, rule = np.polynomial.legendre.leggauss(8)
    edges = np.linspace(start, stop, panels + 1)
    half = np.diff(edges)[:, None] / 2
    z = (edges[:-1, None] + half) + half * nodes
    return float(np.sum(half * rule * weight(z)))


def alpha(
    path_length: float,
    near_diameter: float,
    far_diameter: float,
    wavelength: float | None = None,
    *,
    reference: float | None = None,
) -> float:
    """Constant of ``Cn2 = alpha sigma_chi^2 D^(7/3) L^(-3)`` for a uniform path.

    Parameters
    ----------
    path_length, near_diameter, far_diameter, wavelength
        As for :func:`variance_weight`; without a wavelength the geometric limit, which depends on the ratio of the
        diameters alone.
    reference : float, optional
        The diameter D, m; the larger one where it is absent (in Sauvage et al. 2021, Sec. 5.1, the transmitter's).

    Returns
    -------
    float
        alpha: 4.475 for equal apertures and 1.607 for a ratio of 2.9 in the geometric limit.
    """
    diameter = max(near_diameter, far_diameter) if reference is None else reference
    return float(path_length**3 * diameter ** (-7 / 3) / _total(path_length, near_diameter, far_diameter, wavelength))


@lru_cache(maxsize=256)
def _total(path_length: float, near_diameter: float, far_diameter: float, wavelength: float | None) -> float:
    """Log-amplitude variance per Cn2 of a uniform path, m^(2/3)."""

    def weight(z: Array) -> Array:
        return variance_weight(z, path_length, near_diameter, far_diameter, wavelength)

    return _integrate(weight, 0.0, path_length, 24)


def log_amplitude_variance(
    cn2: float | Array, path_length: float, near_diameter: float, far_diameter: float, wavelength: float | None = None
) -> float | Array:
    """Log-amplitude variance that a uniform Cn2 causes; for weak scintillation.

    Parameters
    ----------
    cn2 : float or ndarray of float
        Cn2 of the path, m^(-2/3).
    path_length, near_diameter, far_diameter, wavelength
        As for :func:`variance_weight`.

    Returns
    -------
    float or ndarray of float
        sigma_chi^2.
    """
    return cn2 * _total(path_length, near_diameter, far_diameter, wavelength)


def cn2_of_variance(
    variance: float | Array,
    path_length: float,
    near_diameter: float,
    far_diameter: float,
    wavelength: float | None = None,
) -> float | Array:
    """Cn2 of a log-amplitude variance; the inverse of :func:`log_amplitude_variance`.

    Parameters
    ----------
    variance : float or ndarray of float
        sigma_chi^2.
    path_length, near_diameter, far_diameter, wavelength
        As for :func:`variance_weight`.

    Returns
    -------
    float or ndarray of float
        Cn2, m^(-2/3).
    """
    return variance / _total(path_length, near_diameter, far_diameter, wavelength)


def saturation_limit(path_length: float, near_diameter: float, far_diameter: float, wavelength: float) -> float:
    """Cn2 above which the scintillometer no longer follows the turbulence.

    0.18 D^(5/3) lambda^(1/3) L^(-8/3) (Ochs and Wilson 1993, see :data:`SATURATION`): the disc L / (k rho_0) into which
    the turbulence scatters grows to 0.36 D, rho_0 being the coherence radius. It was found for equal apertures; the
    smaller of unequal ones is taken, which errs on the safe side.

    Parameters
    ----------
    path_length, near_diameter, far_diameter, wavelength
        As for :func:`variance_weight`.

    Returns
    -------
    float
        Cn2, m^(-2/3).
    """
    diameter = min(near_diameter, far_diameter)
    return float(SATURATION * diameter ** (5 / 3) * wavelength ** (1 / 3) * path_length ** (-8 / 3))


def slice_weights(
    grid: SliceGrid,
    path: tuple[float, float],
    near_diameter: float,
    far_diameter: float,
    wavelength: float | None = None,
    *,
    sampling: Literal["mean", "midpoint"] = "mean",
) -> Array:
    """Weight of each slice of a profile in the Cn2 of a scintillometer.

    Parameters
    ----------
    grid : SliceGrid
        Slices of the profile.
    path : (float, float)
        Distances of the near and the far aperture from the pupil, m.
    near_diameter, far_diameter : float
        Their diameters, m.
    wavelength : float, optional
        Wavelength, m; the geometric limit where it is absent.
    sampling : {"mean", "midpoint"}
        Weight averaged over each slice, or at its middle, for turbulence that sits in thin layers there.

    Returns
    -------
    ndarray of float, (k,)
        Weights, normalised to a sum of 1.

    Raises
    ------
    ValueError
        The apertures are not in the order of their distance, or less than 95 % of the weight lies within the slices:
        the profile says nothing about the rest.
    """
    start, stop = path
    if not stop > start:
        raise ValueError(f"the far aperture at {stop:g} m must lie beyond the near one at {start:g} m")
    length = stop - start

    def weight(z: Array) -> Array:
        return variance_weight(z - start, length, near_diameter, far_diameter, wavelength)

    edges = np.clip(np.asarray(grid.edges), start, stop)
    if sampling == "midpoint":
        centres = grid.centres
        inside = (centres > start) & (centres < stop)
        weights = np.where(inside, weight(np.clip(centres, start, stop)), 0.0) * grid.thickness
    else:
        weights = np.array([_integrate(weight, a, b, 4) if b > a else 0.0 for a, b in pairwise(edges)])
        seen = weights.sum() / _total(length, near_diameter, far_diameter, wavelength)
        if seen < 0.95:
            raise ValueError(
                f"{1 - seen:.0%} of the weight lies outside the slices from {grid.edges[0]:g} m to {grid.edges[-1]:g} m"
            )
    if not weights.sum() > 0:
        raise ValueError(f"no slice lies between the apertures at {start:g} m and {stop:g} m")
    return np.asarray(weights / weights.sum())
