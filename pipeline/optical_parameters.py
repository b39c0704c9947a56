"""What a profile of Cn2 means for an optical link along the path: any wavelength, either direction, both waves.

Light travels from a transmitter to a receiver at distance L. With eta the distance from the receiver, a spherical
wave starts at a point of the transmitter, a plane wave arrives as if from infinity. The turbulence is Kolmogorov's
and weak (Andrews and Phillips, Laser Beam Propagation through Random Media, 2nd ed. 2005,
https://doi.org/10.1117/3.626196, Ch. 8 and 12).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gamma

if TYPE_CHECKING:
    from .geometry import SliceGrid

Array: TypeAlias = NDArray[np.float64]
Wave = Literal["spherical", "plane"]
#: `toward_pupil`: the light of the sources, as the instrument sees it; `toward_sources`: the other way.
Direction = Literal["toward_pupil", "toward_sources"]

#: 2.914 of the structure function of phase, D = 2.914 k^2 r^(5/3) integral of Cn2: 4 pi^2 0.033 6/5 Gamma(1/6) /
#: (2^(5/3) Gamma(11/6)), so that r0 has the constant 2.914 / 6.884 = 0.4233.
PHASE = 2.914
#: 6.884 = 2 (24/5 Gamma(6/5))^(5/6), the structure function of phase at r0.
AT_R0 = 2 * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
#: 2.25 = -4 pi^2 0.033 Gamma(-5/6) cos(5 pi / 12) of the scintillation index 2.25 k^(7/6) int Cn2 (eta x)^(5/6).
INDEX = -4 * np.pi**2 * 0.033 * gamma(-5 / 6) * np.cos(5 * np.pi / 12)


@dataclass(frozen=True)
class OpticalParameters:
    """Integrated parameters of a link; arrays of the shape (...) of the profiles.

    Parameters
    ----------
    fried_parameter : ndarray of float
        r0 at the receiver, m; infinite without turbulence.
    isoplanatic_angle : ndarray of float
        Angle at the receiver within which the phase keeps its shape to 1 rad rms, rad.
    coherence_time : ndarray of float
        Time in which the phase changes by 1 rad rms, s; NaN where no wind is given.
    rytov_variance : ndarray of float
        First-order index of scintillation of a point receiver.
    weak : ndarray of bool
        Whether that is below 0.3, so that first-order theory holds to a few per cent; False where it is NaN.
    """

    fried_parameter: Array
    isoplanatic_angle: Array
    coherence_time: Array
    rytov_variance: Array
    weak: NDArray[np.bool_]


def _moment(edges: Array, length: float, low: float, high: float) -> Array:
    """Integral of eta^low (1 - eta / L)^high over each slice, with eta the distance from the receiver."""
    nodes, rule = np.polynomial.legendre.leggauss(24)
    # eta = L sin^2(t) takes both branch points out: what is left is analytic.
    ends = np.arcsin(np.sqrt(np.clip(edges / length, 0, 1)))
    half = np.diff(ends)[:, None] / 2
    t = ends[:-1, None] + half + half * nodes
    s, c = np.sin(t), np.cos(t)
    value = length ** (low + 1) * s ** (2 * low) * c ** (2 * high) * 2 * s * c
    return np.asarray(np.sum(half * rule * value, axis=1))


def fried_weights(grid: SliceGrid, path_length: float) -> Array:
    """Weight of each slice in r0^(-5/3) of a spherical wave at the pupil, or of a plane one on an infinite path, m.

    Parameters
    ----------
    grid : SliceGrid
        Slices, by their distance from the pupil.
    path_length : float
        Distance of the source, m; may be infinite.

    Returns
    -------
    ndarray of float, (k,)
    """
    if np.isinf(path_length):
        return grid.thickness
    return _moment(np.asarray(grid.edges), path_length, 0, 5 / 3)


#: Parameter -> power of the integral of Cn2 that it is.
_POWERS = {
    "fried_parameter": -3 / 5,
    "isoplanatic_angle": -3 / 5,
    "coherence_time": -3 / 5,
    "rytov_variance": 1.0,
}


def _weights(
    grid: SliceGrid,
    wavelength: float,
    path_length: float,
    wave: Wave,
    direction: Direction,
    wind: ArrayLike | None,
) -> dict[str, Array]:
    """Weights (..., k) of the slices in the integral behind each parameter of :func:`optical_parameters`."""
    if not (0 < wavelength < np.inf and 0 < path_length < np.inf):
        raise ValueError("wavelength and path length must be positive and finite")
    edges = np.minimum(np.asarray(grid.edges), path_length)
    order = slice(None)
    if direction == "toward_sources":
        edges = (path_length - edges)[::-1]
        order = slice(None, None, -1)
    spherical = wave == "spherical"
    k = 2 * np.pi / wavelength
    speed = np.full(grid.k, np.nan) if wind is None else np.asarray(wind, dtype=np.float64)[..., order]
    found = {
        "fried_parameter": PHASE / AT_R0 * k**2 * _moment(edges, path_length, 0, 5 / 3 * spherical),
        "isoplanatic_angle": PHASE * k**2 * _moment(edges, path_length, 5 / 3, 0),
        "coherence_time": PHASE * k**2 * speed ** (5 / 3) * np.diff(edges),
        "rytov_variance": INDEX * k ** (7 / 6) * _moment(edges, path_length, 5 / 6, 5 / 6 * spherical),
    }
    return {name: weights[..., order] for name, weights in found.items()}


def optical_parameters(
    cn2: ArrayLike,
    grid: SliceGrid,
    wavelength: float,
    path_length: float,
    *,
    wave: Wave = "spherical",
    direction: Direction = "toward_pupil",
    wind: ArrayLike | None = None,
) -> OpticalParameters:
    """Fried parameter, isoplanatic angle, coherence time and Rytov variance of profiles.

    With k = 2 pi / lambda, x = 1 - eta / L for a spherical and x = 1 for a plane wave, and integrals over the path:

    - r0 = [2.914 / 6.884 k^2 int Cn2 x^(5/3)]^(-3/5);
    - isoplanatic angle [2.914 k^2 int Cn2 eta^(5/3)]^(-3/5): rays to one point of the receiver that differ by theta in
      direction are theta eta apart, from stars as from points of a transmitter (Fried 1982, Journal of the Optical
      Society of America 72, 52);
    - coherence time [2.914 k^2 int Cn2 v^(5/3)]^(-3/5), v the wind across the path (Greenwood 1977, Journal of the
      Optical Society of America 67, 390, whose frequency is 0.134 / tau), for either wave: the screens move with v, and
      the rays to one point of the receiver do not;
    - Rytov variance 2.25 k^(7/6) int Cn2 (eta x)^(5/6) of a point receiver.

    Parameters
    ----------
    cn2 : array_like, (..., k)
        Profiles, m^(-2/3), constant in each slice; what lies beyond the slices does not count.
    grid : SliceGrid
        Slices, by their distance from the pupil.
    wavelength : float
        Wavelength of the link, m.
    path_length : float
        Length L of the link, m, from the pupil on; it may be shorter than the slices reach.
    wave : {"spherical", "plane"}
        Wave.
    direction : {"toward_pupil", "toward_sources"}
        Where the receiver is.
    wind : array_like, (..., k), optional
        Wind speed across the path in each slice, m/s.

    Returns
    -------
    OpticalParameters

    Raises
    ------
    ValueError
        Wavelength or length is not positive and finite.
    """
    profile = np.asarray(cn2, dtype=np.float64)
    weights = _weights(grid, wavelength, path_length, wave, direction, wind)
    with np.errstate(divide="ignore"):
        found = {name: np.sum(profile * weights[name], axis=-1) ** power for name, power in _POWERS.items()}
    return OpticalParameters(**found, weak=np.asarray(found["rytov_variance"] < 0.3))


def optical_intervals(
    mean: ArrayLike,
    covariance: ArrayLike,
    grid: SliceGrid,
    wavelength: float,
    path_length: float,
    *,
    wave: Wave = "spherical",
    direction: Direction = "toward_pupil",
    wind: ArrayLike | None = None,
) -> dict[str, Array]:
    """Intervals of 68 % of the parameters of :func:`optical_parameters`, from mean and covariance of a posterior.

    Each parameter is a power of one integral over Cn2, which is positive and has a mean and a variance; it is taken as
    log-normal with both, so that the interval of any power of it is the power of its ends.

    Parameters
    ----------
    mean : array_like, (..., k)
        Means of the posterior of the profiles, m^(-2/3).
    covariance : array_like, (..., k, k)
        Its covariances, m^(-4/3).
    grid, wavelength, path_length, wave, direction, wind
        As for :func:`optical_parameters`.

    Returns
    -------
    dict of str to ndarray, (..., 2)
        Lower and upper end, by the name of the parameter; NaN where mean or covariance is, or no wind is given.

    Raises
    ------
    ValueError
        Wavelength or length is not positive and finite.
    """
    profile, spread = np.asarray(mean, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    found = {}
    for name, weights in _weights(grid, wavelength, path_length, wave, direction, wind).items():
        integral = np.sum(profile * weights, axis=-1)
        variance = np.maximum(np.einsum("...k,...kl,...l->...", weights, spread, weights), 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_variance = np.log1p(variance / integral**2)
            middle = np.log(integral) - log_variance / 2
        deviation = np.sqrt(log_variance)
        ends = np.exp(_POWERS[name] * np.stack([middle - deviation, middle + deviation], axis=-1))
        found[name] = np.sort(ends, axis=-1)
    return found
