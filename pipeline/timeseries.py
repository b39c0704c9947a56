"""Series of other instruments: values over intervals of time, and their means over windows of another time base."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Array: TypeAlias = NDArray[np.float64]
Times: TypeAlias = NDArray[np.int64]


@dataclass(frozen=True)
class Quantity:
    """What a column of a series can be.

    Parameters
    ----------
    unit : str
        SI unit in which it is held; ``"1"`` without dimension.
    long_name : str
        What it is.
    """

    unit: str
    long_name: str


#: Quantities of a series by name.
QUANTITIES: Mapping[str, Quantity] = {
    "cn2": Quantity("m^(-2/3)", "refractive index structure parameter Cn2"),
    "cn2_error": Quantity("m^(-2/3)", "standard error of Cn2"),
    "ct2": Quantity("K^2 m^(-2/3)", "structure parameter of temperature CT2"),
    "log_amplitude_variance": Quantity("1", "variance of the log-amplitude"),
    "sensible_heat_flux": Quantity("W/m^2", "sensible heat flux, upward"),
    "sensible_heat_flux_free_convection": Quantity("W/m^2", "sensible heat flux of free convection"),
    "sensible_heat_flux_unstable": Quantity("W/m^2", "sensible heat flux, if unstable"),
    "sensible_heat_flux_stable": Quantity("W/m^2", "sensible heat flux, if stable"),
    "obukhov_length": Quantity("m", "Obukhov length"),
    "obukhov_length_unstable": Quantity("m", "Obukhov length, if unstable"),
    "obukhov_length_stable": Quantity("m", "Obukhov length, if stable"),
    "friction_velocity": Quantity("m/s", "friction velocity"),
    "friction_velocity_unstable": Quantity("m/s", "friction velocity, if unstable"),
    "friction_velocity_stable": Quantity("m/s", "friction velocity, if stable"),
    "temperature": Quantity("K", "temperature"),
    "temperature_upper": Quantity("K", "temperature at the upper of two heights"),
    "temperature_lower": Quantity("K", "temperature at the lower of two heights"),
    "pressure": Quantity("Pa", "pressure"),
    "relative_humidity": Quantity("1", "relative humidity"),
    "specific_humidity": Quantity("1", "specific humidity"),
    "bowen_ratio": Quantity("1", "Bowen ratio, sensible over latent heat flux"),
    "latent_heat_flux": Quantity("W/m^2", "latent heat flux, upward"),
    "wind_speed": Quantity("m/s", "wind speed"),
    "net_radiation": Quantity("W/m^2", "net radiation, downward"),
    "global_radiation": Quantity("W/m^2", "global radiation, downward"),
    "stability": Quantity("1", "1 unstable, 2 stable"),
    "path_length": Quantity("m", "length of the path"),
    "path_height": Quantity("m", "height of the path"),
    "roughness_length": Quantity("m", "roughness length"),
    "wind_height": Quantity("m", "height of the wind sensor"),
    "saturation_correction": Quantity("1", "factor on Cn2 that corrects for saturation"),
}


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """Values over intervals of time.

    Parameters
    ----------
    start, stop : ndarray of int64, (n,)
        Intervals, ns since 1970-01-01T00:00:00 UTC, in the order of their start and without overlap.
    values : dict of str to ndarray of float, (n,)
        By the names of :data:`QUANTITIES`, in SI units; NaN where there is none.
    origin : str
        Where they are from.
    warnings : tuple of str
        What a reader should know.
    """

    start: Times
    stop: Times
    values: dict[str, Array]
    origin: str
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.start.size and (not (self.stop > self.start).all() or not (self.start[1:] >= self.stop[:-1]).all()):
            raise ValueError(f"{self.origin}: the intervals of a series must follow each other without overlap")

    def __len__(self) -> int:
        return int(self.start.size)

    def within(self, start: int, stop: int) -> TimeSeries:
        """The part whose intervals touch [start, stop)."""
        kept = (self.stop > start) & (self.start < stop)
        return replace(
            self,
            start=self.start[kept],
            stop=self.stop[kept],
            values={name: value[kept] for name, value in self.values.items()},
        )

    def digest(self, names: Sequence[str]) -> str:
        """Sha256 of times and the named values."""
        found = hashlib.sha256()
        for part in (self.start, self.stop, *(self.values[name] for name in sorted(names) if name in self.values)):
            found.update(np.ascontiguousarray(part).tobytes())
        return found.hexdigest()

    def mean_over(self, windows: Times, name: str, coverage: float = 0.5) -> Means:
        """Time-weighted means of a quantity.

        Parameters
        ----------
        windows : ndarray of int64, (m, 2)
            Start and end of each, ns.
        name : str
            Quantity.
        coverage : float
            Part of a window that its values must cover.

        Returns
        -------
        Means
        """
        values = self.values.get(name, np.full(len(self), np.nan))
        good = np.isfinite(values)
        start, stop, values = self.start[good], self.stop[good], values[good]
        found = np.full((3, len(windows)), np.nan)
        found[2] = 0.0
        count = np.zeros(len(windows), dtype=np.int64)
        for number, (low, high) in enumerate(windows):
            a, b = np.searchsorted(stop, low, side="right"), np.searchsorted(start, high, side="left")
            if b <= a:
                continue
            share = (np.minimum(stop[a:b], high) - np.maximum(start[a:b], low)) / (high - low)
            found[2, number] = share.sum()
            count[number] = b - a
            if share.sum() < coverage - 1e-9:
                continue
            weight = share / share.sum()
            mean = weight @ values[a:b]
            found[0, number] = mean
            if b - a > 1:
                # Values as independent of each other: variance of the mean with unequal weights.
                spread = weight @ (values[a:b] - mean) ** 2 / (1 - weight @ weight)
                found[1, number] = np.sqrt(spread * (weight @ weight))
        return Means(found[0], found[1], found[2], count)


@dataclass(frozen=True)
class Means:
    """Means over windows.

    Parameters
    ----------
    mean : ndarray of float, (m,)
        Mean; NaN where too little of the window is covered.
    error : ndarray of float, (m,)
        Standard error of the mean from the scatter in the window; NaN with fewer than two values.
    coverage : ndarray of float, (m,)
        Part of the window that values cover.
    count : ndarray of int, (m,)
        Values in the window.
    """

    mean: Array
    error: Array
    coverage: Array
    count: NDArray[np.int64]


def regular_windows(start: int, stop: int, length: int) -> Times:
    """Windows of one length that begin at whole multiples of it since 1970 and hold [start, stop)."""
    first = start // length
    count = -(-(stop - first * length) // length)
    low = (first + np.arange(max(count, 0), dtype=np.int64)) * length
    return np.stack([low, low + length], axis=1)


def joined(series: Sequence[TimeSeries], origin: str) -> TimeSeries:
    """Several series as one; of intervals that are there twice, the first is kept.

    Raises
    ------
    ValueError
        Intervals overlap without being the same.
    """
    names = sorted({name for one in series for name in one.values})
    start = np.concatenate([one.start for one in series])
    stop = np.concatenate([one.stop for one in series])
    blank = {name: np.full(start.size, np.nan) for name in names}
    at = 0
    for one in series:
        for name, value in one.values.items():
            blank[name][at : at + len(one)] = value
        at += len(one)
    order = np.argsort(start, kind="stable")
    again = np.zeros(start.size, bool)
    again[1:] = (np.diff(start[order]) == 0) & (np.diff(stop[order]) == 0)
    order = order[~again]
    warnings = tuple(dict.fromkeys(warning for one in series for warning in one.warnings))
    return TimeSeries(start[order], stop[order], {n: v[order] for n, v in blank.items()}, origin, warnings)
