"""Humid air: vapour pressure, density, refractive index, and how the index follows temperature and humidity.

Two formulas cover the wavelengths in use: Ciddor (1996, https://doi.org/10.1364/AO.35.001566) from 0.3 to 1.69 um,
and the fits of Mathar (2007, https://doi.org/10.1088/1464-4258/9/5/008) from 1.3 to 2.5 um and from 2.8 to 4.2 um,
where the resonances of water vapour let it act far more strongly than dispersion formulas of visible light know.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[np.float64]

#: Gas constants of dry air and of water vapour, J/(kg K).
R_DRY, R_VAPOUR = 287.05, 461.5
#: Heat capacity of dry air at constant pressure, and what the specific humidity adds to it, J/(kg K).
HEAT_CAPACITY, HEAT_CAPACITY_VAPOUR = 1005.0, 1846.0
#: Ratio of the molar masses of water and dry air.
MOLAR_RATIO = R_DRY / R_VAPOUR
#: Acceleration of gravity, m/s^2, and von Karman's constant.
GRAVITY, KARMAN = 9.81, 0.4


def saturation_pressure(temperature: ArrayLike) -> Array:
    """Pressure of saturated water vapour over water.

    The formula of Davis (1992) that Ciddor (1996, Appendix A) uses.

    Parameters
    ----------
    temperature : array_like
        Temperature, K.

    Returns
    -------
    ndarray of float
        Pressure, Pa.
    """
    t = np.asarray(temperature, dtype=np.float64)
    return np.asarray(np.exp(1.2378847e-5 * t**2 - 1.9121316e-2 * t + 33.93711047 - 6.3431645e3 / t))


def specific_humidity(temperature: ArrayLike, pressure: ArrayLike, relative_humidity: ArrayLike) -> Array:
    """Mass of water vapour per mass of humid air.

    Parameters
    ----------
    temperature : array_like
        Temperature, K.
    pressure : array_like
        Pressure, Pa.
    relative_humidity : array_like
        Relative humidity, 0 to 1.

    Returns
    -------
    ndarray of float
        q, kg/kg.
    """
    vapour = np.asarray(relative_humidity) * saturation_pressure(temperature)
    return np.asarray(MOLAR_RATIO * vapour / (np.asarray(pressure) - (1 - MOLAR_RATIO) * vapour))


def vapour_pressure(pressure: ArrayLike, humidity: ArrayLike) -> Array:
    """Partial pressure of water vapour, Pa, of air of a given pressure in Pa and specific humidity in kg/kg."""
    q = np.asarray(humidity, dtype=np.float64)
    return np.asarray(q * np.asarray(pressure) / (MOLAR_RATIO + (1 - MOLAR_RATIO) * q))


def density(temperature: ArrayLike, pressure: ArrayLike, humidity: ArrayLike = 0.0) -> Array:
    """Density of humid air, kg/m^3, of temperature in K, pressure in Pa and specific humidity in kg/kg."""
    q = np.asarray(humidity)
    return np.asarray(np.asarray(pressure) / (R_DRY * np.asarray(temperature) * (1 + (1 / MOLAR_RATIO - 1) * q)))


def heat_capacity(humidity: ArrayLike = 0.0) -> Array:
    """Heat capacity of humid air at constant pressure, J/(kg K), of specific humidity in kg/kg."""
    return np.asarray(HEAT_CAPACITY + (HEAT_CAPACITY_VAPOUR - HEAT_CAPACITY) * np.asarray(humidity))


def latent_heat(temperature: ArrayLike) -> Array:
    """Heat of evaporation of water, J/kg, of temperature in K (Stull 1988, Boundary Layer Meteorology, Appendix C)."""
    return np.asarray(2.501e6 - 2370.0 * (np.asarray(temperature) - 273.15))


# --- refractive index --------------------------------------------------------------------------------------


def _compressibility(t: Array, pressure: Array, vapour: Array) -> Array:
    """Compressibility of humid air (Ciddor 1996, Appendix A, Eq. (12)); t in K, mole fraction of vapour."""
    c = t - 273.15
    first = 1.58123e-6 - 2.9331e-8 * c + 1.1043e-10 * c**2
    first = first + (5.707e-6 - 2.051e-8 * c) * vapour + (1.9898e-4 - 2.376e-6 * c) * vapour**2
    ratio = pressure / t
    return np.asarray(1 - ratio * first + ratio**2 * (1.83e-11 - 0.765e-8 * vapour**2))


def _ciddor(wavelength: float, t: Array, pressure: Array, vapour_pressure_: Array, co2: float) -> Array:
    s = (1e-6 / wavelength) ** 2
    dry = 1e-8 * (5792105 / (238.0185 - s) + 167917 / (57.362 - s)) * (1 + 0.534e-6 * (co2 * 1e6 - 450))
    wet = 1.022e-8 * (295.235 + 2.6422 * s - 0.032380 * s**2 + 0.004028 * s**3)
    # Vapour pressure as mole fraction with the enhancement factor left to who measured the humidity.
    x = vapour_pressure_ / pressure
    molar_dry, molar_wet, gas = 1e-3 * (28.9635 + 12.011e-6 * (co2 * 1e6 - 400)), 0.018015, 8.314510
    standard = (
        101325 * molar_dry / (_compressibility(np.array(288.15), np.array(101325.0), np.array(0.0)) * gas * 288.15)
    )
    steam = 1333 * molar_wet / (_compressibility(np.array(293.15), np.array(1333.0), np.array(1.0)) * gas * 293.15)
    here = _compressibility(t, pressure, x) * gas * t
    return np.asarray(
        (1 - x) * pressure * molar_dry / here / standard * dry + x * pressure * molar_wet / here / steam * wet
    )


#: Mathar (2007): (shortest, longest, reference wavelength in um), then a row for each power of the wavenumber with
#: the coefficients of 1, dT, dT^2, dH, dH^2, dp, dp^2, dT dH, dT dp, dH dp: dT = 1/T - 1/290.65 K, dH in %, dp in Pa.
_MATHAR = (
    (
        (1.3, 2.5, 2.25),
        (
            (0.200192e-3, 0.588625e-1, -3.01513, -0.103945e-7, 0.573256e-12,
             0.267085e-8, 0.609186e-17, 0.497859e-4, 0.779176e-6, -0.206567e-15),
            (0.113474e-9, -0.385766e-7, 0.406167e-3, 0.136858e-11, 0.186367e-16,
             0.135941e-14, 0.519024e-23, -0.661752e-8, 0.396499e-12, 0.106141e-20),
            (-0.424595e-14, 0.888019e-10, -0.514544e-6, -0.171039e-14, -0.228150e-19,
             0.135295e-18, -0.419477e-27, 0.832034e-11, 0.395114e-16, -0.149982e-23),
            (0.100957e-16, -0.567650e-13, 0.343161e-9, 0.112908e-17, 0.150947e-22,
             0.818218e-23, 0.434120e-30, -0.551793e-14, 0.233587e-20, 0.984046e-27),
            (-0.293315e-20, 0.166615e-16, -0.101189e-12, -0.329925e-21, -0.441214e-26,
             -0.222957e-26, -0.122445e-33, 0.161899e-17, -0.636441e-24, -0.288266e-30),
            (0.307228e-24, -0.174845e-20, 0.106749e-16, 0.344747e-25, 0.461209e-30,
             0.249964e-30, 0.134816e-37, -0.169901e-21, 0.716868e-28, 0.299105e-34),
        ),
    ),
    (
        (2.8, 4.2, 3.4),
        (
            (0.200049e-3, 0.588431e-1, -3.13579, -0.108142e-7, 0.586812e-12,
             0.266900e-8, 0.608860e-17, 0.517962e-4, 0.778638e-6, -0.217243e-15),
            (0.145221e-9, -0.825182e-7, 0.694124e-3, 0.230102e-11, 0.312198e-16,
             0.168162e-14, 0.461560e-22, -0.112149e-7, 0.446396e-12, 0.104747e-20),
            (0.250951e-12, 0.137982e-9, -0.500604e-6, -0.154652e-14, -0.197792e-19,
             0.353075e-17, 0.184282e-24, 0.776507e-11, 0.784600e-15, -0.523689e-23),
            (-0.745834e-15, 0.352420e-13, -0.116668e-8, -0.323014e-17, -0.461945e-22,
             -0.963455e-20, -0.524471e-27, 0.172569e-13, -0.195151e-17, 0.817386e-26),
            (-0.161432e-17, -0.730651e-15, 0.209644e-11, 0.630616e-20, 0.788398e-25,
             -0.223079e-22, -0.121299e-29, -0.320582e-16, -0.542083e-20, 0.309913e-28),
            (0.352780e-20, -0.167911e-18, 0.591037e-14, 0.173880e-22, 0.245580e-27,
             0.453166e-25, 0.246512e-32, -0.899435e-19, 0.103530e-22, -0.363491e-31),
        ),
    ),
)  # fmt: skip


def _mathar(wavelength: float, t: Array, pressure: Array, vapour_pressure_: Array, number: int) -> Array:
    (_, _, reference), rows = _MATHAR[number]
    dt, dp = 1 / t - 1 / 290.65, pressure - 75000.0
    dh = 100 * vapour_pressure_ / saturation_pressure(t) - 10.0
    terms = np.stack([np.ones_like(dt + dp + dh), *np.broadcast_arrays(
        dt, dt**2, dh, dh**2, dp, dp**2, dt * dh, dt * dp, dh * dp)])  # fmt: skip
    wavenumber = 1e-2 / wavelength - 1e4 / reference
    powers = wavenumber ** np.arange(len(rows))
    return np.asarray(np.tensordot(powers @ np.array(rows), terms, axes=1))


def covered(wavelength: float) -> bool:
    """Whether :func:`refractivity` knows a wavelength, m."""
    return 0.3e-6 <= wavelength <= 1.69e-6 or any(
        1e6 * wavelength <= b and 1e6 * wavelength >= a for (a, b, _), _ in _MATHAR
    )


def refractivity(
    wavelength: float, temperature: ArrayLike, pressure: ArrayLike, humidity: ArrayLike = 0.0, *, co2: float = 370e-6
) -> Array:
    """Refractive index of humid air minus one.

    Parameters
    ----------
    wavelength : float
        Vacuum wavelength, m: 0.3 to 1.69 um (Ciddor 1996), 1.69 to 2.5 um and 2.8 to 4.2 um (Mathar 2007, who fixes
        370 ppm of carbon dioxide).
    temperature : array_like
        Temperature, K.
    pressure : array_like
        Pressure, Pa.
    humidity : array_like
        Specific humidity, kg/kg.
    co2 : float
        Mole fraction of carbon dioxide.

    Returns
    -------
    ndarray of float
        n - 1.

    Raises
    ------
    ValueError
        The wavelength lies outside both.
    """
    t, p, q = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in (temperature, pressure, humidity)))
    vapour = vapour_pressure(p, q)
    if 0.3e-6 <= wavelength <= 1.69e-6:
        return _ciddor(wavelength, t, p, vapour, co2)
    for number, ((low, high, _), _) in enumerate(_MATHAR):
        if low <= 1e6 * wavelength <= high:
            return _mathar(wavelength, t, p, vapour, number)
    raise ValueError(
        f"the refractive index of humid air is known from 0.3 to 2.5 um and from 2.8 to 4.2 um, not at "
        f"{1e6 * wavelength:g} um"
    )


@dataclass(frozen=True)
class IndexSlopes:
    """How the refractive index follows temperature and specific humidity at constant pressure.

    Parameters
    ----------
    per_temperature : ndarray of float
        dn/dT = A_T / T, 1/K.
    per_humidity : ndarray of float
        dn/dq = A_q / q, 1.
    """

    per_temperature: Array
    per_humidity: Array


def index_slopes(
    wavelength: float, temperature: ArrayLike, pressure: ArrayLike, humidity: ArrayLike = 0.0
) -> IndexSlopes:
    """Derivatives of the refractive index: the A_T / T and A_q / q of scintillometry (Andreas 1988).

    Parameters
    ----------
    wavelength, temperature, pressure, humidity
        As for :func:`refractivity`.

    Returns
    -------
    IndexSlopes

    Notes
    -----
    Humidity is the specific one, which a parcel of air keeps when it warms, so that dn/dT holds q and p; see Andreas
    (1988, Journal of the Optical Society of America A 5, 481), whose A_T and A_q are T and q times these.
    """
    t, p, q = (np.asarray(a, dtype=np.float64) for a in (temperature, pressure, humidity))
    # The index is smooth in both: with these steps, central differences are good to 1e-6 of themselves.
    dt, dq = 0.5, 1e-3
    return IndexSlopes(
        (refractivity(wavelength, t + dt, p, q) - refractivity(wavelength, t - dt, p, q)) / (2 * dt),
        (refractivity(wavelength, t, p, q + dq) - refractivity(wavelength, t, p, q)) / dq,
    )


def ct2_factor(
    slopes: IndexSlopes,
    temperature: ArrayLike,
    bowen_ratio: ArrayLike = np.inf,
    humidity: ArrayLike = 0.0,
    *,
    correlation: float = 1.0,
) -> Array:
    """Ratio CT2 / Cn2.

    Cn2 = CT2 [a^2 + 2 R a b s + b^2 s^2], a = dn/dT, b = dn/dq: the sum of Cn2 = a^2 CT2 + 2 a b CTq + b^2 Cq2 (Andreas
    1988, Eq. (5)) with fluctuations of humidity and temperature in the ratio s = c_p / (L_v beta) that the Bowen ratio
    beta sets, and their correlation R. For visible light and R = 1 this is Wesely's (1976, Journal of Applied
    Meteorology 15, 43) factor (1 + 0.03 / beta)^2.

    Parameters
    ----------
    slopes : IndexSlopes
        Of :func:`index_slopes`.
    temperature : array_like
        Temperature, K.
    bowen_ratio : array_like
        Sensible over latent heat flux; infinite where humidity fluctuations are left out.
    humidity : array_like
        Specific humidity, kg/kg.
    correlation : float
        |R|, 0 to 1; its sign is that of the Bowen ratio.

    Returns
    -------
    ndarray of float
        CT2 / Cn2, K^2; NaN where the Bowen ratio is zero or makes Cn2 vanish.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        s = heat_capacity(humidity) / (latent_heat(temperature) * np.asarray(bowen_ratio, dtype=np.float64))
        a, b = slopes.per_temperature, slopes.per_humidity
        whole = a**2 + 2 * correlation * a * b * s + b**2 * s**2
        ratio = 1 / whole
    # Where both effects cancel to a hundredth, Cn2 says nothing about CT2.
    return np.asarray(np.where(np.isfinite(whole) & (whole > 1e-4 * a**2), ratio, np.nan))
