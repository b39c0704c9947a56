"""Profiles beside the scintillometers of a campaign, on a common time base."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ValidationError

from ..pipeline.beam_heights import SightHeights, beam_heights, mean_separation, scaled_weights
from ..pipeline.comparison import Pair, Separation, emulate, on_windows
from ..pipeline.geometry import SliceGrid
from ..pipeline.parameters import Scintillometer
from ..pipeline.scintillometer import saturation_limit, slice_weights
from ..pipeline.timeseries import regular_windows
from ..pipeline.units import QuantityError, parse
from ..pipeline.units import faults as sentences
from .settings import InputError, load
from .surroundings import series_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ..pipeline.timeseries import TimeSeries

    Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Station:
    """A scintillometer of a campaign file.

    Parameters
    ----------
    instrument : Scintillometer
        What it is.
    series : TimeSeries or None
        What it measured.
    """

    instrument: Scintillometer
    series: TimeSeries | None


def stations_of(campaign: Path) -> list[Station]:
    """Scintillometers of a campaign file, with their series.

    Raises
    ------
    InputError
        There is none, or a series cannot be read.
    """
    settings = load(campaign)
    given = settings.header.get("scintillometers", [])
    if not given:
        raise InputError(
            [
                f"{settings.origin}: there is no scintillometer; add a table [[scintillometers]] with name, "
                "wavelength, diameters and series"
            ]
        )
    faults: list[str] = []
    found = []
    for number, item in enumerate(given):
        key = f"scintillometers[{number}]"
        try:
            one = Scintillometer.model_validate(item)
            series = (
                None if one.series is None else series_of(one.series, settings.folder, f"{key}.series", settings.origin)
            )
            found.append(Station(one, series))
        except ValidationError as error:
            faults += sentences(error, settings.origin, key)
        except InputError as error:
            faults += error.faults
    if faults:
        raise InputError(faults)
    return found


@dataclass(frozen=True, eq=False)
class _Batches:
    """Path averages of all batches: bounds, values, errors."""

    bounds: NDArray[np.int64]
    values: Array
    errors: Array
    separation: Separation


def path_of(dataset: Any) -> tuple[float, SliceGrid]:
    """Path length, m, and slices of a product."""
    edges = dataset["z_bounds"].values
    try:
        length = parse(dataset.attrs.get("path_length"), "m", allow_infinite=True)
    except QuantityError:
        length = float(edges[-1, 1])
    return length, SliceGrid((*map(float, edges[:, 0]), float(edges[-1, 1])))


def covariance_of(dataset: Any) -> Array:
    """Covariances of the posterior of each batch, m^(-4/3); NaN in products of older versions, which hold none."""
    if "cn2_posterior_covariance" in dataset:
        return np.asarray(dataset["cn2_posterior_covariance"].values, dtype=np.float64)
    return np.full((*dataset["cn2"].shape, dataset["cn2"].shape[1]), np.nan)


def _sight(dataset: Any) -> SightHeights | None:
    """Heights of the line of sight that a product holds."""
    if "flux_height" not in dataset:  # no heights in its header, or an older product
        return None
    borders = np.asarray(dataset["border_height"].values, dtype=np.float64)
    return SightHeights(
        np.asarray(dataset["flux_height"].values, dtype=np.float64), np.append(borders[:, 0], borders[-1, 1])
    )


def _emulated(datasets: Sequence[Any], one: Scintillometer) -> _Batches:
    parts: list[tuple[NDArray[np.int64], Array, Array]] = []
    vertical = []
    for dataset in datasets:
        length, grid = path_of(dataset)
        try:
            shares = slice_weights(grid, one.ends(length), *one.diameters, one.wavelength)
            sight = _sight(dataset)
            weights = scaled_weights(one, length, grid, shares, sight)
        except ValueError as error:
            raise InputError([f"scintillometer {one.name}: {error}"]) from error
        if sight is not None:
            vertical.append(mean_separation(beam_heights(one, length, grid, sight), sight.effective, shares))
        cn2 = np.asarray(dataset["cn2"].values, dtype=np.float64)
        bounds = dataset["time_bounds"].values.astype("datetime64[ns]").astype(np.int64)
        parts.append((bounds, *emulate(cn2, covariance_of(dataset), weights)))
    bounds, values, errors = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(bounds[:, 0], kind="stable")
    apart = Separation(one.offset, vertical[0] if vertical else float("nan"), one.height_scaling != "none")
    return _Batches(bounds[order], values[order], errors[order], apart)


def pairs_of(
    datasets: Sequence[Any],
    stations: Sequence[Station],
    *,
    average: float | None = None,
    coverage: float = 0.5,
    whole: bool = False,
) -> list[Pair]:
    """Put profiles and scintillometers on a common time base.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products.
    stations : sequence of Station
        Scintillometers; those without a series get their emulated one only.
    average : float, optional
        Length of the windows, s, which begin at whole multiples of it in UTC; the batches where it is absent.
    coverage : float
        Part of a window that values of either must cover.
    whole : bool
        Windows over all that the series hold, not only where there are batches; needs `average`.

    Returns
    -------
    list of Pair
    """
    found = []
    for station in stations:
        batches = _emulated(datasets, station.instrument)
        if average is None:
            windows, ours, ours_error = batches.bounds, batches.values, batches.errors
        else:
            start, stop = int(batches.bounds[0, 0]), int(batches.bounds[-1, 1])
            if whole and station.series is not None and len(station.series):
                start, stop = min(start, int(station.series.start[0])), max(stop, int(station.series.stop[-1]))
            windows = regular_windows(start, stop, round(average * 1e9))
            means = on_windows(batches.bounds, batches.values, batches.errors, windows, coverage)
            ours, ours_error = means.mean, means.error
        blank = np.full(len(windows), np.nan)
        theirs, theirs_error = blank, blank
        if station.series is not None:
            measured = station.series.mean_over(windows, "cn2", coverage)
            own = station.series.mean_over(windows, "cn2_error", coverage)
            theirs = measured.mean
            theirs_error = np.where(np.isfinite(measured.error), measured.error, own.mean)
        found.append(Pair(station.instrument.name, windows, ours, ours_error, theirs, theirs_error, batches.separation))
    return found


def saturated(station: Station, pair: Pair, path_length: float) -> int:
    """How many windows lie beyond the range of the instrument."""
    near, far = station.instrument.ends(path_length)
    limit = saturation_limit(far - near, *station.instrument.diameters, station.instrument.wavelength)
    with np.errstate(invalid="ignore"):
        return int((pair.theirs > limit).sum())
