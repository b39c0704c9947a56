"""Heat fluxes in the surface layer from the structure parameter of temperature.

Monin-Obukhov similarity ties the structure parameter CT2 at a height z to the temperature scale T* and the friction
velocity u*:

    CT2 z^(2/3) = T*^2 f_T(z / L),   u* = kappa U / [ln(z_u / z_0) - psi_m(z_u / L) + psi_m(z_0 / L)],
    1 / L = kappa g (1 + m) T* / (T u*^2),   H = -rho c_p u* T*

where U is the wind at z_u and m = 0.61 T c_p / (L_v beta) lets humidity carry its part of the buoyancy. One unknown
remains, 1 / L, and one equation, :func:`solve`. Where nothing tells the friction velocity, the limit of strong
convection needs none, :func:`free_convection`. Heights are above the zero plane: the displacement height is off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .air import GRAVITY, KARMAN, heat_capacity, latent_heat

if TYPE_CHECKING:
    from collections.abc import Mapping

Array: TypeAlias = NDArray[np.float64]
_Function: TypeAlias = Callable[[Array], Array]


@dataclass(frozen=True)
class Similarity:
    """A named set of similarity functions.

    Parameters
    ----------
    unstable, stable : callable
        f_T of z / L below and above zero.
    free_convection : float
        c in f_T -> c (-z / L)^(-2/3) for z / L -> -inf.
    source : str
        Where they are from.
    """

    unstable: _Function
    stable: _Function
    free_convection: float
    source: str

    def __call__(self, zeta: ArrayLike) -> Array:
        """f_T(z / L) = CT2 z^(2/3) / T*^2."""
        z = np.asarray(zeta, dtype=np.float64)
        return np.asarray(np.where(z < 0, self.unstable(np.minimum(z, 0.0)), self.stable(np.maximum(z, 0.0))))


def _power_law(unstable: tuple[float, float], stable: tuple[float, float], source: str) -> Similarity:
    """The pair a (1 - b zeta)^(-2/3) below zero and c (1 + d zeta^(2/3)) above."""
    (a, b), (c, d) = unstable, stable
    return Similarity(
        lambda zeta: a * (1 - b * zeta) ** (-2 / 3),
        lambda zeta: c * (1 + d * zeta ** (2 / 3)),
        a * b ** (-2 / 3),
        source,
    )


#: 4 beta_1 kappa^(-2/3) with the Obukhov-Corrsin constant beta_1 = 0.86.
_THIERMANN = 4 * 0.86 * KARMAN ** (-2 / 3)

#: Sets of coefficients of f_T by name.
SIMILARITIES: Mapping[str, Similarity] = {
    "andreas-1988": _power_law(
        (4.9, 6.1),
        (4.9, 2.2),
        "Andreas 1988, J. Opt. Soc. Am. A 5, 481: Wyngaard et al. 1971 (J. Opt. Soc. Am. 61, 1646) for kappa = 0.4",
    ),
    "hartogensis-2005": _power_law(
        (4.9, 9.0),
        (4.7, 1.6),
        "unstable: De Bruin et al. 1993, Boundary-Layer Meteorology 63, 231; stable: Hartogensis and De Bruin 2005, "
        "Boundary-Layer Meteorology 116, 253, https://doi.org/10.1007/s10546-004-2817-1",
    ),
    "li-2012": _power_law((6.7, 14.9), (4.5, 1.3), "Li et al. 2012, Boundary-Layer Meteorology 145"),
    "thiermann-grassl-1992": Similarity(
        lambda zeta: _THIERMANN * (1 - 7 * zeta + 75 * zeta**2) ** (-1 / 3),
        lambda zeta: _THIERMANN * (1 + 7 * zeta + 20 * zeta**2) ** (1 / 3),
        _THIERMANN * 75 ** (-1 / 3),
        "Thiermann and Grassl 1992, Boundary-Layer Meteorology 58, 367; used by the software of Scintec's instruments",
    ),
}


@dataclass(frozen=True)
class WindProfile:
    """A named pair of dimensionless wind shears: (1 - g zeta)^(-1/4) below zero and 1 + b zeta above.

    Parameters
    ----------
    unstable, stable : float
        g and b.
    source : str
        Where they are from.
    """

    unstable: float
    stable: float
    source: str

    def psi(self, zeta: ArrayLike) -> Array:
        """Integral of (1 - shear) / zeta from zero (Paulson 1970, Journal of Applied Meteorology 9, 857)."""
        z = np.asarray(zeta, dtype=np.float64)
        x = (1 - self.unstable * np.minimum(z, 0.0)) ** 0.25
        below = 2 * np.log((1 + x) / 2) + np.log((1 + x**2) / 2) - 2 * np.arctan(x) + np.pi / 2
        return np.asarray(np.where(z < 0, below, -self.stable * z))


#: Wind profiles by name.
WIND_PROFILES: Mapping[str, WindProfile] = {
    "businger-1971": WindProfile(15.0, 4.7, "Businger et al. 1971, Journal of the Atmospheric Sciences 28, 181"),
    "dyer-1974": WindProfile(16.0, 5.0, "Dyer 1974, Boundary-Layer Meteorology 7, 363"),
}


def buoyancy_factor(temperature: ArrayLike, bowen_ratio: ArrayLike = np.inf, humidity: ArrayLike = 0.0) -> Array:
    """1 + m: buoyancy flux over that of sensible heat alone, 1 + 0.61 T c_p / (L_v beta), about 1 + 0.07 / beta.

    Parameters
    ----------
    temperature : array_like
        Temperature, K.
    bowen_ratio : array_like
        Sensible over latent heat flux.
    humidity : array_like
        Specific humidity, kg/kg.

    Returns
    -------
    ndarray of float
    """
    t = np.asarray(temperature, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(1 + 0.61 * t * heat_capacity(humidity) / (latent_heat(t) * np.asarray(bowen_ratio)))


def free_convection(
    ct2: ArrayLike,
    height: ArrayLike,
    temperature: ArrayLike,
    *,
    similarity: Similarity = SIMILARITIES["andreas-1988"],
    buoyancy: ArrayLike = 1.0,
) -> Array:
    """Kinematic heat flux u* |T*| of the limit of free convection.

    f_T -> c (-z / L)^(-2/3) makes the friction velocity drop out: u* |T*| = b z (g (1 + m) / T)^(1/2) CT2^(3/4) with
    b = kappa^(1/2) c^(-3/4), 0.47 for the set of Andreas (1988).

    Parameters
    ----------
    ct2 : array_like
        Structure parameter of temperature, K^2 m^(-2/3).
    height : array_like
        Height above the zero plane, m.
    temperature : array_like
        Temperature, K.
    similarity : Similarity
        Set of similarity functions.
    buoyancy : array_like
        1 + m, see :func:`buoyancy_factor`.

    Returns
    -------
    ndarray of float
        K m/s, positive upward; times rho c_p the sensible heat flux.
    """
    b = KARMAN**0.5 * similarity.free_convection**-0.75
    c, z = np.asarray(ct2, dtype=np.float64), np.asarray(height, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return np.asarray(b * z * np.sqrt(GRAVITY * np.asarray(buoyancy) / np.asarray(temperature)) * c**0.75)


#: What became of a solution, in the order of :data:`STATES`.
CONVERGED, NO_INPUT, NO_SOLUTION, TOO_CONVECTIVE = range(4)
STATES = ("converged", "no_input", "no_solution", "too_convective")


@dataclass(frozen=True)
class Fluxes:
    """Solution of the similarity equations; arrays of one shape.

    Parameters
    ----------
    kinematic : ndarray of float
        Kinematic heat flux -u* T*, K m/s, positive upward; times rho c_p the sensible heat flux.
    friction_velocity, temperature_scale, obukhov_length : ndarray of float
        u* in m/s, T* in K, L in m; NaN where there is no solution.
    state : ndarray of uint8
        Index of :data:`STATES`: `no_input` where an input is missing or outside its domain, `no_solution` where the
        stable equations have none (the wind is too weak for the CT2 that is measured), `too_convective` where -z / L
        is beyond the range that is searched, so that only free convection can be told.
    residual : ndarray of float
        |1 - kappa g (1 + m) T* L / (T u*^2)| of the solution.
    iterations : int
        Steps that the slowest element took.
    """

    kinematic: Array
    friction_velocity: Array
    temperature_scale: Array
    obukhov_length: Array
    state: NDArray[np.uint8]
    residual: Array
    iterations: int


#: -z / L and z / L that are searched, and steps of the search in between.
_LEAST, _MOST, _STEPS = 1e-12, 1e4, 128


def solve(
    ct2: ArrayLike,
    height: ArrayLike,
    temperature: ArrayLike,
    stable: ArrayLike,
    *,
    wind: ArrayLike | None = None,
    wind_height: ArrayLike = np.nan,
    roughness: ArrayLike = np.nan,
    friction_velocity: ArrayLike | None = None,
    similarity: Similarity = SIMILARITIES["andreas-1988"],
    wind_profile: WindProfile = WIND_PROFILES["businger-1971"],
    buoyancy: ArrayLike = 1.0,
) -> Fluxes:
    """Solve the similarity equations for 1 / L.

    The range of z / L is searched from neutral on, and the first solution is refined with Chandrupatla's bracketing
    method. Under unstable conditions there is one; under stable ones none or two, of which the first is the one that
    the surface layer reaches when it cools, while in the other turbulence is about to die out.

    Parameters
    ----------
    ct2 : array_like
        Structure parameter of temperature, K^2 m^(-2/3).
    height : array_like
        Its height above the zero plane, m.
    temperature : array_like
        Temperature, K.
    stable : array_like of bool
        Whether the flux is downward; CT2 does not tell.
    wind, wind_height, roughness : array_like
        Wind speed in m/s, its height above the zero plane and the roughness length, m.
    friction_velocity : array_like, optional
        u*, m/s, where it was measured; instead of the wind.
    similarity : Similarity
        f_T.
    wind_profile : WindProfile
        psi_m.
    buoyancy : array_like
        1 + m, see :func:`buoyancy_factor`.

    Returns
    -------
    Fluxes

    Raises
    ------
    ValueError
        Neither wind nor friction velocity is given.
    """
    from scipy.optimize import elementwise  # slow to import, and every campaign file names a similarity

    if wind is None and friction_velocity is None:
        raise ValueError("the similarity equations need the wind or the friction velocity; free_convection needs none")
    known = friction_velocity is not None
    first = friction_velocity if known else wind
    numbers = [
        np.asarray(a, dtype=np.float64) for a in (ct2, height, temperature, first, wind_height, roughness, buoyancy)
    ]
    *numbers, below = np.broadcast_arrays(*numbers, np.asarray(stable, dtype=bool))
    shape = below.shape
    c, z, t, speed, z_wind, z_rough, lift = (a.ravel() for a in numbers)
    sign = np.where(below.ravel(), 1.0, -1.0)
    with np.errstate(invalid="ignore"):
        usable = (c >= 0) & (z > 0) & (t > 0) & (speed > 0) & (lift > 0)
        usable &= np.isfinite(c) & np.isfinite(z) & np.isfinite(t) & np.isfinite(speed) & np.isfinite(lift)
        if not known:
            usable &= (z_rough > 0) & (z_wind > z_rough) & np.isfinite(z_wind)

    def scales(zeta: Array, at: tuple[Array, ...]) -> tuple[Array, Array]:
        """u* and |T*| for a given z / L."""
        c, z, _, speed, z_wind, z_rough, _ = at
        if known:
            u = speed
        else:
            profile = (
                np.log(z_wind / z_rough) - wind_profile.psi(zeta * z_wind / z) + wind_profile.psi(zeta * z_rough / z)
            )
            u = KARMAN * speed / profile
        return u, np.sqrt(c * z ** (2 / 3) / similarity(zeta))

    def excess(log_zeta: Array, sign: Array, *at: Array) -> Array:
        """Logarithm of the z / L that the scales would give, less that they are given for."""
        u, star = scales(sign * np.exp(log_zeta), at)
        return np.asarray(np.log(KARMAN * GRAVITY * at[6] * star * at[1] / (at[2] * u**2)) - log_zeta)

    whole = (c, z, t, speed, z_wind, z_rough, lift)
    chosen = np.flatnonzero(usable & (c > 0))
    inputs = tuple(a[chosen] for a in whole)
    signs = sign[chosen]
    grid = np.linspace(np.log(_LEAST), np.log(_MOST), _STEPS + 1)
    state = np.where(usable, np.uint8(CONVERGED), np.uint8(NO_INPUT)).astype(np.uint8)
    root = np.full(chosen.size, np.nan)
    iterations = 0
    if chosen.size:
        values = np.stack([excess(np.full(chosen.size, g), signs, *inputs) for g in grid])
        # Positive at neutral, where any heat flux gives a finite L; the first change of sign is the solution.
        change = (values[:-1] > 0) & (values[1:] <= 0)
        found: NDArray[np.bool_] = np.asarray(change.any(axis=0))
        step = np.argmax(change, axis=0)
        # Two solutions closer than a step of the search: look between the lowest value and its neighbours.
        lowest = np.clip(np.argmin(values, axis=0), 1, _STEPS - 1)
        near = ~found & (values[0] > 0) & (signs > 0) & (values.min(axis=0) < 0.5)
        low, high = grid[step], grid[step + 1]
        if near.any():
            where = np.flatnonzero(near)
            least = elementwise.find_minimum(
                excess,
                (grid[lowest[where] - 1], grid[lowest[where]], grid[lowest[where] + 1]),
                args=(signs[where], *(a[where] for a in inputs)),
            )
            deep = np.asarray(least.success & (least.f_x <= 0))
            low[where], high[where] = grid[lowest[where] - 1], np.asarray(least.x)
            found[where] = deep
        # Neutral to better than the smallest z / L that is searched: u* and T* no longer depend on it.
        neutral = values[0] <= 0
        root[neutral] = values[0][neutral] + grid[0]
        solved = np.flatnonzero(found & ~neutral)
        if solved.size:
            result = elementwise.find_root(
                excess,
                (low[solved], high[solved]),
                args=(signs[solved], *(a[solved] for a in inputs)),
                tolerances={"xatol": 1e-14, "xrtol": 1e-15, "fatol": 1e-14, "frtol": 0.0},
            )
            root[solved] = result.x
            iterations = int(np.max(result.nit))
        state[chosen[~found & ~neutral]] = np.where(
            signs[~found & ~neutral] > 0, np.uint8(NO_SOLUTION), np.uint8(TOO_CONVECTIVE)
        )
    outcome = {name: np.full(c.size, np.nan) for name in ("u", "t", "length", "residual")}
    good = np.isfinite(root)
    zeta = signs[good] * np.exp(root[good])
    at = tuple(a[good] for a in inputs)
    u, star = scales(zeta, at)
    index = chosen[good]
    outcome["u"][index], outcome["t"][index] = u, signs[good] * star
    outcome["length"][index] = at[1] / zeta
    outcome["residual"][index] = np.abs(1 - KARMAN * GRAVITY * at[6] * star * np.abs(at[1] / zeta) / (at[2] * u**2))
    # Without turbulence of temperature there is no heat flux, and the air is neutral.
    calm = np.flatnonzero(usable & (c == 0))
    outcome["u"][calm] = scales(np.zeros(calm.size), tuple(a[calm] for a in whole))[0]
    outcome["t"][calm], outcome["residual"][calm] = 0.0, 0.0
    outcome["length"][calm] = np.inf * sign[calm]
    return Fluxes(
        kinematic=(0.0 - outcome["u"] * outcome["t"]).reshape(shape),
        friction_velocity=outcome["u"].reshape(shape),
        temperature_scale=outcome["t"].reshape(shape),
        obukhov_length=outcome["length"].reshape(shape),
        state=state.reshape(shape),
        residual=outcome["residual"].reshape(shape),
        iterations=iterations,
    )


def effective_height(
    heights: Array, weights: Array, *, obukhov_length: float = np.nan, similarity: Similarity | None = None
) -> float:
    """Height at which a homogeneous surface would give a scintillometer its CT2.

    Under free convection CT2 goes as z^(-4/3), so that z_eff^(-4/3) is the mean of z^(-4/3) along the path as the
    scintillometer weights it; for a given Obukhov length it solves z_eff^(-2/3) f_T(z_eff / L) = mean of
    z^(-2/3) f_T(z / L) (Hartogensis et al. 2003, Journal of Atmospheric and Oceanic Technology 20, 811, for free
    convection and for the general case).

    Parameters
    ----------
    heights : ndarray of float, (k,)
        Height of the line of sight above the zero plane in each slice, m.
    weights : ndarray of float, (k,)
        Weights of the slices.
    obukhov_length : float
        L, m; free convection where it is NaN.
    similarity : Similarity, optional
        f_T; needed with `obukhov_length`.

    Returns
    -------
    float
        z_eff in m; NaN where a slice with a weight has no height.
    """
    from scipy.optimize import elementwise

    used = weights != 0
    h, w = heights[used], weights[used] / weights.sum()
    if not (h > 0).all():
        return float("nan")
    if similarity is None or not np.isfinite(obukhov_length):
        return float((w @ h ** (-4 / 3)) ** (-3 / 4))

    def profile(z: Array) -> Array:
        return np.asarray(z ** (-2 / 3) * similarity(z / obukhov_length))

    wanted = float(w @ profile(h))
    # z^(-2/3) f_T falls with height on the unstable side and levels off on the stable one.
    found = elementwise.find_root(
        lambda log_z: np.log(profile(np.exp(log_z)) / wanted), (np.log(h.min()) - 1e-9, np.log(h.max()) + 1e-9)
    )
    return float(np.exp(found.x)) if found.success else float("nan")


def height_model(cn2: ArrayLike, height: ArrayLike, heights: ArrayLike) -> Array:
    """Cn2 along the line of sight as free convection over uniform ground has it: Cn2(h) = Cn2(h_0) (h / h_0)^(-4/3).

    The dashed line of Sauvage et al. 2021, Fig. 14 (a) (Wyngaard, Izumi and Collins 1971).

    Parameters
    ----------
    cn2 : array_like
        Cn2 at the reference height, m^(-2/3).
    height : array_like
        Reference height h_0, m.
    heights : array_like
        Heights h of the line of sight, m.

    Returns
    -------
    ndarray of float
        Cn2, m^(-2/3); NaN at or below the ground.
    """
    h = np.asarray(heights, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(h > 0, h, np.nan) / np.asarray(height)
        return np.asarray(np.asarray(cn2) * ratio ** (-4 / 3))
