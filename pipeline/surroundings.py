"""What is known of the air and the ground around the path, and what a profile says with it: heat fluxes, comparisons.

The campaign file says where the knowledge is (:class:`SurroundingsParameters`); :class:`Surroundings` holds it as
arrays; :meth:`Surroundings.derive` adds to the profile of a batch what follows. Errors are carried by doing the same
with draws of the profile's posterior.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator

from . import air, surface_layer
from .comparison import compare
from .parameters import Parameters, SeriesFile
from .scintillometer import log_amplitude_variance, saturation_limit
from .timeseries import TimeSeries
from .units import Angle, Length

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .products import BatchResult

Array: TypeAlias = NDArray[np.float64]

#: Version of what is derived here; raise it whenever the same input gives other numbers.
VERSION = 2
#: Draws of the posterior that are carried through the similarity equations: intervals to 3 % of their length.
DRAWS = 1024
#: Global radiation in W/m^2 above which the sun warms the ground, where net radiation is not measured.
DAYLIGHT = 20.0


class Meteorology(SeriesFile):
    """Weather on the path."""

    bowen_ratio: float | None = None
    """Sensible over latent heat flux, where the series has none; without it humidity does not fluctuate."""
    humidity_correlation: float = Field(default=1.0, ge=0, le=1)
    """|correlation| of the fluctuations of temperature and humidity."""
    wind_height: Length | None = Field(default=None, gt=0)
    """Height of the wind sensor above ground; the series may have it."""
    roughness_length: Length | None = Field(default=None, gt=0)
    """Roughness length for momentum; the series may have it."""
    displacement_height: Length = Field(default="0 m", ge=0)  # type: ignore[assignment]
    """Height of the zero plane above ground, two thirds of the height of what grows there."""
    coefficients: str = "andreas-1988"
    """Similarity functions of CT2."""
    wind_profile: str = "businger-1971"
    """Similarity functions of the wind."""
    stability: Literal["series", "radiation", "temperature", "unstable", "stable"] | None = None
    """What tells day from night: the `stability` of the series, the sign of net radiation (else daylight), the sign of
    the temperature difference of two heights, or one for all; the first that the series has where it is absent."""
    coverage: float = Field(default=0.5, gt=0, le=1)
    """Part of a batch that values of a series must cover."""

    @field_validator("bowen_ratio")
    @classmethod
    def _not_zero(cls, value: float | None) -> float | None:
        if value is not None and (value == 0 or not np.isfinite(value)):
            raise ValueError("a Bowen ratio must be finite and not zero; leave it out for dry air")
        return value

    @field_validator("coefficients")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in surface_layer.SIMILARITIES:
            raise ValueError(f"there are no such coefficients; known: {', '.join(surface_layer.SIMILARITIES)}")
        return value

    @field_validator("wind_profile")
    @classmethod
    def _known_profile(cls, value: str) -> str:
        if value not in surface_layer.WIND_PROFILES:
            raise ValueError(f"there is no such wind profile; known: {', '.join(surface_layer.WIND_PROFILES)}")
        return value


class Terrain(Parameters):
    """Ground below the line of sight."""

    file: str = Field(min_length=1, max_length=1000)
    """CSV with the columns `distance` and `elevation` and their units, or a GeoTIFF; beside the campaign file."""
    pupil_height: Length | None = Field(default=None, gt=0)
    """Height of the pupil above the ground."""
    sources_height: Length | None = Field(default=None, gt=0)
    """Height of the sources above the ground."""
    pupil_elevation: Length | None = None
    """Elevation of the pupil on the datum of the file, instead of `pupil_height`."""
    sources_elevation: Length | None = None
    """Elevation of the sources on the datum of the file, instead of `sources_height`."""
    pupil: tuple[Angle, Angle] | None = None
    """Latitude and longitude of the pupil; needed with a GeoTIFF."""
    sources: tuple[Angle, Angle] | None = None
    """Latitude and longitude of the sources; needed with a GeoTIFF."""
    refraction: float = Field(default=0.13, ge=-3, le=3)
    """Curvature of the light over that of the Earth."""

    @field_validator("pupil_elevation", "sources_elevation")
    @classmethod
    def _one_of_each(cls, elevation: float | None, info: ValidationInfo) -> float | None:
        end = str(info.field_name).removesuffix("_elevation")
        # A height that is wrong is not in data, and has its own message.
        if f"{end}_height" in info.data and (info.data[f"{end}_height"] is None) == (elevation is None):
            raise ValueError(f"give either {end}_height (above the ground) or {end}_elevation (on the file's datum)")
        return elevation


class SurroundingsParameters(Parameters):
    """Tables of a campaign file about the surroundings."""

    meteorology: Meteorology | None = None
    terrain: Terrain | None = None


@dataclass(frozen=True, eq=False)
class Instrument:
    """A scintillometer that measured on the path.

    Parameters
    ----------
    name : str
        Its name.
    series : TimeSeries or None
        What it measured; None for an emulated one only.
    path_length : float
        Distance of its apertures, m.
    diameters : (float, float)
        At the pupil's end and at the sources' end, m.
    wavelength : float
        m.
    """

    name: str
    series: TimeSeries | None
    path_length: float
    diameters: tuple[float, float]
    wavelength: float


@dataclass(frozen=True, eq=False)
class Conditions:
    """Mean conditions of a batch, SI; NaN where nothing is known.

    Parameters
    ----------
    temperature, pressure, humidity, bowen_ratio, wind, friction_velocity, wind_height, roughness : float
        Air temperature, pressure, specific humidity, Bowen ratio (infinite for dry air), wind speed, friction velocity,
        height of the wind sensor above ground, roughness length.
    stability : int
        -1 unstable, 1 stable, 0 unknown.
    """

    temperature: float
    pressure: float
    humidity: float
    bowen_ratio: float
    wind: float
    friction_velocity: float
    wind_height: float
    roughness: float
    stability: int


def conditions(series: TimeSeries, parameters: Meteorology, start: int, stop: int) -> Conditions:
    """Mean conditions over a batch.

    Parameters
    ----------
    series : TimeSeries
        Weather.
    parameters : Meteorology
        What the series does not say.
    start, stop : int
        The batch, ns since 1970 UTC.

    Returns
    -------
    Conditions
    """
    window = np.array([[start, stop]], dtype=np.int64)

    def mean(name: str) -> float:
        return float(series.mean_over(window, name, parameters.coverage).mean[0])

    temperature, pressure = mean("temperature"), mean("pressure")
    humidity = mean("specific_humidity")
    if np.isnan(humidity):
        # Without any, air is as humid as it mostly is: it changes density and index by less than a per cent.
        relative = mean("relative_humidity")
        humidity = float(air.specific_humidity(temperature, pressure, 0.5 if np.isnan(relative) else relative))
    bowen = mean("bowen_ratio")
    if np.isnan(bowen):
        bowen = np.inf if parameters.bowen_ratio is None else parameters.bowen_ratio
    heights = {
        name: getattr(parameters, name) if getattr(parameters, name) is not None else mean(name)
        for name in ("wind_height", "roughness_length")
    }
    return Conditions(
        temperature,
        pressure,
        humidity,
        bowen,
        mean("wind_speed"),
        mean("friction_velocity"),
        heights["wind_height"],
        heights["roughness_length"],
        _stability(mean, parameters.stability),
    )


def _stability(mean: Any, way: str | None) -> int:
    """-1 unstable, 1 stable, 0 unknown."""
    if way in ("unstable", "stable"):
        return -1 if way == "unstable" else 1
    for one in ("series", "radiation", "temperature") if way is None else (way,):
        if one == "series":
            known = mean("stability") - 1.5
        elif one == "radiation":
            known = -mean("net_radiation")
            if np.isnan(known):
                known = DAYLIGHT - mean("global_radiation")
        else:
            known = mean("temperature_upper") - mean("temperature_lower")
        if np.isfinite(known) and known != 0:
            return 1 if known > 0 else -1
    return 0


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is known around the path, for the slices of one profile.

    Parameters
    ----------
    wavelength : float
        Of the profiler, m: Cn2 is that of its light.
    heights : ndarray of float, (k,), or None
        Height of the line of sight above ground in each slice, m.
    meteorology : TimeSeries or None
        Weather.
    parameters : Meteorology or None
        How to use it.
    instruments : tuple of Instrument
        Scintillometers, in the order of the weights.
    model_weights : ndarray of float, (k,)
        Weights of the slices that fix the strength of the height model: those of the Fried parameter.
    """

    wavelength: float
    heights: Array | None = None
    meteorology: TimeSeries | None = None
    parameters: Meteorology | None = None
    instruments: tuple[Instrument, ...] = ()
    model_weights: Array = field(default_factory=lambda: np.empty(0))

    def tracked(self) -> dict[str, Any]:
        """What enters the key of a product."""
        found: dict[str, Any] = {"version": VERSION}
        if self.heights is not None:
            # Metres to micrometres: what a transect was resampled to must not hang on rounding.
            found["heights"] = [round(float(height), 6) if np.isfinite(height) else None for height in self.heights]
        if self.meteorology is not None and self.parameters is not None:
            found["meteorology"] = self.parameters.model_dump(exclude={"file", "columns", "units", "timezone"})
            found["weather"] = self.meteorology.digest(list(self.meteorology.values))
        found["instruments"] = [
            [one.name, None if one.series is None else one.series.digest(["cn2", "cn2_error"])]
            for one in self.instruments
        ]
        return found

    def derive(self, cn2: Array, draws: Array | None, start: int, stop: int) -> dict[str, NDArray[Any]]:
        """What follows for a batch, under the names of :data:`coslidar.pipeline.products.SCHEMA`.

        Parameters
        ----------
        cn2 : ndarray of float, (k,)
            Profile, m^(-2/3).
        draws : ndarray of float, (n, k), or None
            Draws of its posterior.
        start, stop : int
            The batch, ns since 1970 UTC.

        Returns
        -------
        dict of str to ndarray
        """
        found: dict[str, NDArray[Any]] = {}
        if any(one.series is not None for one in self.instruments):
            found |= self._measured(start, stop)
        if self.heights is not None:
            found["cn2_height_model"] = self._height_model(cn2)
        if self.meteorology is not None and self.parameters is not None and self.heights is not None:
            at = conditions(self.meteorology, self.parameters, start, stop)
            few = None if draws is None else draws[:: max(1, len(draws) // DRAWS)]
            found |= heat_fluxes(cn2, few, self.heights, self.wavelength, at, self.parameters)
        return found

    def _height_model(self, cn2: Array) -> Array:
        assert self.heights is not None
        known = np.isfinite(self.heights)
        shape = surface_layer.height_model(1.0, 1.0, self.heights)
        weights = np.where(known, self.model_weights, 0.0)
        total = float(weights @ np.where(known, shape, 0.0))
        return shape * float(weights @ cn2) / total if total > 0 else np.full(cn2.shape, np.nan)

    def _measured(self, start: int, stop: int) -> dict[str, NDArray[Any]]:
        window = np.array([[start, stop]], dtype=np.int64)
        rows = []
        for one in self.instruments:
            if one.series is None:
                rows.append((np.nan, np.nan, 0.0, np.nan, 0))
                continue
            means = one.series.mean_over(window, "cn2")
            own = one.series.mean_over(window, "cn2_error")
            value = float(means.mean[0])
            error = float(means.error[0]) if np.isfinite(means.error[0]) else float(own.mean[0])
            path = (one.path_length, *one.diameters, one.wavelength)
            rows.append(
                (
                    value,
                    error,
                    float(means.coverage[0]),
                    float(log_amplitude_variance(value, *path)),
                    int(value > saturation_limit(*path)),
                )
            )
        values, errors, coverage, variance, saturated = (np.array(column) for column in zip(*rows, strict=True))
        return {
            "cn2_scintillometer": values,
            "cn2_scintillometer_standard_error": errors,
            "cn2_scintillometer_coverage": coverage,
            "scintillometer_log_amplitude_variance": variance,
            "scintillometer_saturated": saturated.astype(np.uint8),
        }


#: States of a slice's heat flux beyond those of :data:`coslidar.pipeline.surface_layer.STATES`.
FLUX_STATES = (*surface_layer.STATES, "no_weather", "no_height", "unknown_stability", "free_convection", "no_index")
_NO_WEATHER, _NO_HEIGHT, _UNKNOWN, _FREE, _NO_INDEX = range(len(surface_layer.STATES), len(FLUX_STATES))


def heat_fluxes(
    cn2: Array,
    draws: Array | None,
    heights: Array,
    wavelength: float,
    at: Conditions,
    parameters: Meteorology,
) -> dict[str, NDArray[Any]]:
    """Structure parameter of temperature and sensible heat flux in each slice.

    Parameters
    ----------
    cn2 : ndarray of float, (k,)
        Profile, m^(-2/3).
    draws : ndarray of float, (n, k), or None
        Draws of its posterior.
    heights : ndarray of float, (k,)
        Height above ground, m.
    wavelength : float
        Of the light that Cn2 is of, m.
    at : Conditions
        Weather of the batch.
    parameters : Meteorology
        Coefficients, displacement height, correlation of humidity.

    Returns
    -------
    dict of str to ndarray
        `ct2`, `sensible_heat_flux`, their 68 % intervals, `sensible_heat_flux_free_convection`, `friction_velocity`,
        `temperature_scale`, `obukhov_length`, `flux_state` (index of :data:`FLUX_STATES`), `flux_solved_fraction` (part
        of the draws that have a solution), and the conditions.
    """
    # Every command reads a campaign file, few compute: numba is slow to import.
    from .posterior import highest_density_interval

    k = cn2.size
    similarity = surface_layer.SIMILARITIES[parameters.coefficients]
    z = heights - parameters.displacement_height
    state = np.zeros(k, dtype=np.uint8)
    slopes = None
    if air.covered(wavelength) and np.isfinite(at.temperature) and np.isfinite(at.pressure):
        slopes = air.index_slopes(wavelength, at.temperature, at.pressure, at.humidity)
    factor = (
        float("nan")
        if slopes is None
        else float(
            air.ct2_factor(
                slopes, at.temperature, at.bowen_ratio, at.humidity, correlation=parameters.humidity_correlation
            )
        )
    )
    lift = float(surface_layer.buoyancy_factor(at.temperature, at.bowen_ratio, at.humidity))
    capacity = float(air.density(at.temperature, at.pressure, at.humidity) * air.heat_capacity(at.humidity))
    known = np.isfinite(z) & (z > 0)
    stable = at.stability > 0
    bare = np.isnan(at.friction_velocity) and not (
        at.wind > 0 and at.roughness > 0 and at.wind_height - parameters.displacement_height > at.roughness
    )

    def fluxes(ct2: Array) -> tuple[Array, surface_layer.Fluxes]:
        found = surface_layer.solve(
            ct2,
            z,
            at.temperature,
            stable,
            wind=at.wind,
            wind_height=at.wind_height - parameters.displacement_height,
            roughness=at.roughness,
            friction_velocity=None if np.isnan(at.friction_velocity) else at.friction_velocity,
            similarity=similarity,
            wind_profile=surface_layer.WIND_PROFILES[parameters.wind_profile],
            buoyancy=lift,
        )
        heat = capacity * found.kinematic
        if not stable:
            # Without wind, or with hardly any, convection stirs the air for itself.
            heat = np.where(np.isnan(heat) & known, free(ct2), heat)
        return heat, found

    def free(ct2: Array) -> Array:
        return capacity * surface_layer.free_convection(
            ct2, np.where(known, z, np.nan), at.temperature, similarity=similarity, buoyancy=lift
        )

    ct2 = cn2 * factor
    heat, found = fluxes(ct2)
    state[:] = found.state
    state[(found.state != surface_layer.CONVERGED) & np.isfinite(heat)] = _FREE
    convective = free(ct2)
    if stable:
        convective = np.full(k, np.nan)
        if bare:
            state[:] = _NO_WEATHER
    solved = np.full(k, np.nan)
    intervals = {name: np.full((k, 2), np.nan) for name in ("ct2", "heat")}
    if draws is not None and np.isfinite(factor):
        intervals["ct2"] = highest_density_interval(draws * factor, 0.68)
        drawn = np.abs(fluxes(draws * factor)[0])
        solved = np.isfinite(drawn).mean(axis=0)
        for number in range(k):
            usable = drawn[np.isfinite(drawn[:, number]), number]
            if usable.size >= 100 and solved[number] >= 0.5:
                ends = highest_density_interval(usable[:, None], 0.68)[0]
                intervals["heat"][number] = ends if not stable else -ends[::-1]
    for hidden, code in (
        (~known, _NO_HEIGHT),
        (np.full(k, at.stability == 0), _UNKNOWN),
        (np.full(k, slopes is not None and not np.isfinite(factor)), _NO_INDEX),
        (np.full(k, not (np.isfinite(at.temperature) and np.isfinite(at.pressure))), _NO_WEATHER),
        (np.full(k, not air.covered(wavelength)), _NO_INDEX),
    ):
        state[hidden] = code
        heat = np.where(hidden, np.nan, heat)
        convective = np.where(hidden, np.nan, convective)
        intervals["heat"][hidden] = np.nan
    gone = ~np.isfinite(heat)

    def of_solution(values: Array) -> Array:
        return np.where(gone, np.nan, values)

    return {
        "ct2": ct2,
        "ct2_interval_68": intervals["ct2"],
        "sensible_heat_flux": heat,
        "sensible_heat_flux_interval_68": intervals["heat"],
        "sensible_heat_flux_free_convection": convective,
        "friction_velocity": of_solution(found.friction_velocity),
        "temperature_scale": of_solution(found.temperature_scale),
        "obukhov_length": of_solution(found.obukhov_length),
        "flux_state": state,
        "flux_solved_fraction": solved,
        "temperature": np.asarray(at.temperature),
        "pressure": np.asarray(at.pressure),
        "specific_humidity": np.asarray(at.humidity),
        "bowen_ratio": np.asarray(at.bowen_ratio),
        "wind_speed": np.asarray(at.wind),
        "stability": np.asarray(at.stability, dtype=np.int8),
    }


def compared(results: Sequence[BatchResult]) -> dict[str, NDArray[Any]]:
    """Statistics of all batches per scintillometer, for a product.

    Parameters
    ----------
    results : sequence of BatchResult
        Batches of one archive; those that failed, or without a measurement, do not count.

    Returns
    -------
    dict of str to ndarray, (scintillometer,)
        `comparison_…` of :data:`coslidar.pipeline.products.SCHEMA`; empty where no scintillometer measured.
    """
    names = (
        "cn2_path_average",
        "cn2_path_average_standard_error",
        "cn2_scintillometer",
        "cn2_scintillometer_standard_error",
    )
    usable = [result.values for result in results if all(name in result.values for name in names)]
    if not usable:
        return {}
    columns = (np.array([values[name] for values in usable], dtype=np.float64).T for name in names)
    rows = [asdict(compare(*series)) for series in zip(*columns, strict=True)]
    return {
        f"comparison_{name}": np.array([row[name] for row in rows], dtype=np.int64 if name == "count" else np.float64)
        for name in rows[0]
    }
