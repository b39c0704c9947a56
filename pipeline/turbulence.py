"""Quantities integrated along the line of sight: r0, scintillation indices, path averages, ranges.

A profile is constant in each slice, so integrals over the path are sums of Cn2 times the integral of a weight over each
slice, taken in closed form (`sampling="mean"`) or as the weight at mid-slice times the thickness
(`sampling="midpoint"`, for turbulence that sits in thin layers there).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.special import beta, betainc, gamma

from .geometry import MAP_KINDS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from .geometry import Geometry, SliceGrid

    Array = NDArray[np.float64]

Sampling = Literal["mean", "midpoint"]

#: First-order index of one point of the source above which first-order theory is off by 3 % and more: wave optics gives
#: 0.99, 0.95 and 0.88 of the first-order scintillation where that index is 0.11, 0.38 and 0.91 (profiles of one shape
#: whose index averaged over the source is 0.014, 0.05 and 0.12).
WEAK_INDEX = 0.3


def z_max(geometry: Geometry) -> float:
    """Largest distance at which the two sources still see common turbulence (Sauvage et al. 2021, Eq. (3)).

    Parameters
    ----------
    geometry : Geometry
        Pupil, path and sources.

    Returns
    -------
    float
        Distance in m at which the pattern moves by the p - 1 (or q - 1) subapertures of the pupil; NaN with one source.
    """
    p, q = geometry.map_shape
    d = geometry.subaperture_size
    sx, sy = geometry.separation
    return _distance(geometry, [((q - 1) / 2 * d, sx), ((p - 1) / 2 * d, sy)])


def resolution(geometry: Geometry) -> float:
    """Distance of the first slice that triangulation tells from the pupil (Sauvage et al. 2021, Eq. (5)).

    Parameters
    ----------
    geometry : Geometry
        Pupil, path and sources.

    Returns
    -------
    float
        d / (d + s) L in m, where the pattern moves by one subaperture; NaN with one source.
    """
    d = geometry.subaperture_size
    sx, sy = geometry.separation
    return _distance(geometry, [(d, sx), (d, sy)])


def _distance(geometry: Geometry, limits: list[tuple[float, float]]) -> float:
    """Distance at which the shift m s along one of the axes reaches its limit first."""
    if geometry.n_sources == 1:
        return math.nan
    m = min(limit / abs(s) for limit, s in limits if s)
    return m if geometry.infinite else geometry.path_length * m / (1 + m)


def fried_parameter(
    cn2: Array,
    grid: SliceGrid,
    wavelength: float,
    path_length: float,
    *,
    wave: Literal["spherical", "plane"] = "spherical",
    sampling: Sampling = "mean",
) -> float | Array:
    """Fried parameter of a profile, at the pupil.

    r0 = [0.423 k^2 integral of Cn2(z) w(z) dz]^(-3/5), with w = ((L - z) / L)^(5/3) for the spherical wave of a point
    source at L and w = 1 for a plane wave (Fried 1966, https://doi.org/10.1364/JOSA.56.001372).

    Parameters
    ----------
    cn2 : ndarray of float, (..., k)
        Profiles, m^(-2/3).
    grid : SliceGrid
        Their slices.
    wavelength : float
        Wavelength that r0 is meant for, m.
    path_length : float
        Distance L of the source, m; infinite for a plane wave.
    wave : {"spherical", "plane"}
        Weighting of the slices.
    sampling : {"mean", "midpoint"}
        Weight averaged over each slice, or at its middle.

    Returns
    -------
    float or ndarray of float
        r0 in m, infinite without turbulence.
    """
    if wave == "plane" or math.isinf(path_length):
        weights = grid.thickness
    else:

        def integral(z: Array) -> Array:
            return np.asarray(-3 / 8 * path_length * (1 - z / path_length) ** (8 / 3))

        def weight(z: Array) -> Array:
            return np.asarray((1 - z / path_length) ** (5 / 3))

        weights = _slice_weights(grid, weight, integral, sampling)
    strength = 0.423 * (2 * np.pi / wavelength) ** 2 * (np.asarray(cn2) @ weights)
    with np.errstate(divide="ignore"):
        r0 = np.asarray(strength) ** (-3 / 5)
    return float(r0) if r0.ndim == 0 else r0


def _slice_weights(
    grid: SliceGrid, weight: Callable[[Array], Array], integral: Callable[[Array], Array], sampling: Sampling
) -> Array:
    if sampling == "midpoint":
        return np.asarray(weight(grid.centres) * grid.thickness)
    return np.diff(integral(np.asarray(grid.edges)))


def scintillation_index(cn2: Array, matrix: Array, geometry: Geometry) -> float | Array:
    """First-order scintillation index of a profile, averaged over subaperture and source.

    Parameters
    ----------
    cn2 : ndarray of float, (..., k)
        Profiles, m^(-2/3).
    matrix : ndarray of float, (6 (2p - 1)(2q - 1), k)
        Response matrix; its row of zero separation in the scintillation auto map is the index per Cn2.
    geometry : Geometry
        Geometry that the matrix was made for.

    Returns
    -------
    float or ndarray of float
        sigma_I^2, mean of the sources.
    """
    p, q = geometry.map_shape
    row = MAP_KINDS.index("ii_auto") * p * q + (p * q) // 2
    index = np.asarray(np.asarray(cn2) @ matrix[row])
    return float(index) if index.ndim == 0 else index


def point_source_weights(
    grid: SliceGrid, wavelength: float, path_length: float, *, sampling: Sampling = "mean"
) -> Array:
    """Contribution of each slice to the scintillation index of one point of the source seen by a point.

    The first-order index of a spherical wave, 4 k^2 integral of S_n sin^2(pi lambda f^2 z (L - z) / L) d^2f in
    Kolmogorov turbulence, is 2.25 k^(7/6) integral of Cn2(z) [z (L - z) / L]^(5/6) dz (Andrews and Phillips, Laser Beam
    Propagation through Random Media, 2nd ed., Sec. 8.2, https://doi.org/10.1117/3.626196), with the constant
    -4 0.033 pi^2 Gamma(-5/6) cos(5 pi / 12) = 2.25. It is what saturates first, before the source averages it, so it
    tells how far first-order theory holds.

    Parameters
    ----------
    grid : SliceGrid
        Slices of the profile.
    wavelength : float
        Wavelength, m.
    path_length : float
        Distance L of the source, m; infinite for a plane wave.
    sampling : {"mean", "midpoint"}
        Weight averaged over each slice, or at its middle.

    Returns
    -------
    ndarray of float, (k,)
        Index per Cn2 in each slice, m^(2/3).
    """
    constant = -4 * 0.033 * np.pi**2 * gamma(-5 / 6) * np.cos(5 * np.pi / 12)

    def weight(z: Array) -> Array:
        return np.asarray((z if math.isinf(path_length) else z * (1 - z / path_length)) ** (5 / 6))

    def integral(z: Array) -> Array:
        if math.isinf(path_length):
            return np.asarray(6 / 11 * z ** (11 / 6))
        whole = path_length ** (11 / 6) * beta(11 / 6, 11 / 6)
        return np.asarray(whole * betainc(11 / 6, 11 / 6, np.minimum(z / path_length, 1.0)))

    return np.asarray(constant * (2 * np.pi / wavelength) ** (7 / 6) * _slice_weights(grid, weight, integral, sampling))


def point_source_index(
    cn2: Array, grid: SliceGrid, wavelength: float, path_length: float, *, sampling: Sampling = "mean"
) -> float | Array:
    """First-order scintillation index of one point of the source; see :func:`point_source_weights`.

    Parameters
    ----------
    cn2 : ndarray of float, (..., k)
        Profiles, m^(-2/3).
    grid, wavelength, path_length, sampling
        As for :func:`point_source_weights`.

    Returns
    -------
    float or ndarray of float
        sigma_I^2 of a point source on a point aperture.
    """
    index = np.asarray(np.asarray(cn2) @ point_source_weights(grid, wavelength, path_length, sampling=sampling))
    return float(index) if index.ndim == 0 else index


def is_weak(point_index: float | Array, limit: float = WEAK_INDEX) -> bool | NDArray[np.bool_]:
    """Whether first-order (Rytov) theory holds to a few per cent.

    Parameters
    ----------
    point_index : float or ndarray of float
        Scintillation index of one point of the source, from :func:`point_source_index`.
    limit : float
        Index at which it is said to fail.

    Returns
    -------
    bool or ndarray of bool
        True below the limit; False for NaN.
    """
    weak = np.asarray(point_index) < limit
    return bool(weak) if weak.ndim == 0 else weak


def path_average(cn2: Array, weights: Array) -> float | Array:
    """Weighted mean of a profile along the path.

    Parameters
    ----------
    cn2 : ndarray of float, (..., k)
        Profiles, m^(-2/3).
    weights : ndarray of float, (k,)
        Integral of the weight over each slice: the slices' thickness for the plain mean, or
        :func:`coslidar.pipeline.scintillometer.slice_weights`.

    Returns
    -------
    float or ndarray of float
        Mean Cn2, m^(-2/3).

    Raises
    ------
    ValueError
        The weights do not have a positive sum.
    """
    weights = np.asarray(weights)
    if not weights.sum() > 0:
        raise ValueError("the weights of a path average need a positive sum")
    mean = np.asarray(np.asarray(cn2) @ (weights / weights.sum()))
    return float(mean) if mean.ndim == 0 else mean
