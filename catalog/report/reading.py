"""What the panels need of a product, read with tolerance for what an older or a partial product lacks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...pipeline.geometry import MAP_KINDS
from ...pipeline.products import INTENSITY_KINDS, QUALITY_FLAGS, SLOPE_KINDS
from .words import clean

if TYPE_CHECKING:
    from xarray import Dataset

Floats = NDArray[np.float64]

#: Words of the quality levels.
LEVELS = ("good", "usable with care", "bad")

#: Days as matplotlib counts them, in ns.
DAY = 86_400e9


def listed(datasets: Dataset | Iterable[Dataset]) -> list[Dataset]:
    """The datasets that hold at least one batch, in the order of their first batch."""
    from xarray import Dataset

    several = [datasets] if isinstance(datasets, Dataset) else list(datasets)
    filled = [dataset for dataset in several if dataset.sizes.get("time", 0)]
    return sorted(filled, key=lambda dataset: int(nanoseconds(dataset["time"].values).min()))


def nanoseconds(values: NDArray[np.generic]) -> NDArray[np.int64]:
    """Times as ns since 1970 UTC, from datetime64 of any unit or from integers."""
    values = np.asarray(values)
    if values.dtype.kind == "M":
        values = values.astype("datetime64[ns]")
    return values.astype(np.int64)


def bounds(dataset: Dataset) -> NDArray[np.int64]:
    """Start and end of every batch, (time, 2), ns since 1970 UTC."""
    if "time_bounds" in dataset:
        return nanoseconds(dataset["time_bounds"].values).reshape(-1, 2)
    start = nanoseconds(dataset["time"].values)
    step = int(np.median(np.diff(start))) if start.size > 1 else 1_000_000_000
    return np.stack([start, np.append(start[1:], start[-1] + step)], axis=1)


def edges(dataset: Dataset) -> Floats:
    """The k + 1 borders of the slices, m."""
    if "z_bounds" in dataset:
        pairs = np.asarray(dataset["z_bounds"].values, dtype=np.float64)
        # Bounds of a dataset that was joined along time may have been repeated for every batch.
        pairs = pairs.reshape(-1, *pairs.shape[-2:])[0]
        return np.append(pairs[:, 0], pairs[-1, 1])
    return borders(np.asarray(dataset["z"].values, dtype=np.float64))


def borders(centres: Floats) -> Floats:
    """Borders half way between `centres`, (k,) to (k + 1,)."""
    if centres.size < 2:
        return np.array([centres[0] - 0.5, centres[0] + 0.5])
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])


def values(dataset: Dataset, name: str) -> Floats | None:
    """A variable of all batches as float64, None where the product has no such variable."""
    return np.asarray(dataset[name].values, dtype=np.float64) if name in dataset else None


def of_batch(dataset: Dataset, name: str, batch: int) -> Floats | None:
    """A variable of one batch as float64, None where the product has no such variable."""
    if name not in dataset:
        return None
    # Without coordinates: a page asks for thousands of single numbers.
    variable = dataset.variables[name]
    return np.asarray((variable.isel(time=batch) if "time" in variable.dims else variable).values, dtype=np.float64)


def scalar(dataset: Dataset, name: str, batch: int) -> float:
    """Mean over what the variable of a batch holds beside time, NaN where there is nothing."""
    found = of_batch(dataset, name, batch)
    if found is None or not np.isfinite(found).any():
        return float("nan")
    return float(np.mean(found[np.isfinite(found)]))


def log_mu(mu: float) -> float:
    """log10 of the hyperparameter, NaN where it is not positive."""
    return float(np.log10(mu)) if mu > 0 and np.isfinite(mu) else float("nan")


def flags(dataset: Dataset) -> NDArray[np.int64]:
    """Quality flags of every batch, (time,)."""
    found = values(dataset, "quality_flag")
    return np.zeros(dataset.sizes["time"], np.int64) if found is None else np.nan_to_num(found).astype(np.int64)


def levels(dataset: Dataset) -> NDArray[np.int64]:
    """Quality level of every batch, (time,): 0 good, 1 usable with care, 2 bad."""
    found = values(dataset, "quality_level")
    if found is None:
        raised = flags(dataset)
        found = np.zeros(raised.size)
        for bit, level, _ in QUALITY_FLAGS.values():
            found = np.where(raised & bit, np.maximum(found, level), found)
    return np.clip(np.nan_to_num(found, nan=2), 0, 2).astype(np.int64)


def flag_names(raised: int) -> list[str]:
    """Names of the flags raised, and a number for each bit that this version does not know."""
    names = [name.replace("_", " ") for name, (bit, _, _) in QUALITY_FLAGS.items() if raised & bit]
    unknown = raised & ~sum(bit for bit, _, _ in QUALITY_FLAGS.values())
    return names + [f"unknown flag {1 << i}" for i in range(unknown.bit_length()) if unknown >> i & 1]


@dataclass(frozen=True)
class Maps:
    """One kind of correlation map of one batch, [dy, dx]; rad^2 for slopes.

    Parameters
    ----------
    kind : str
        One of :data:`coslidar.pipeline.geometry.MAP_KINDS`.
    measured, model, error : ndarray of float64
        Measured map, the map of the profile, convergence noise (1 sigma); NaN where there is none.
    """

    kind: str
    measured: Floats
    model: Floats
    error: Floats

    @cached_property
    def residual(self) -> Floats:
        """Measured minus model, in units of its error."""
        with np.errstate(divide="ignore", invalid="ignore"):
            residual = (self.measured - self.model) / self.error
        return np.where(np.isfinite(residual), residual, np.nan)

    @property
    def rms(self) -> float:
        """Root mean square of the residual, NaN without any."""
        finite = self.residual[np.isfinite(self.residual)]
        return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")

    @property
    def is_slope(self) -> bool:
        """Slopes rather than scintillation."""
        return self.kind in SLOPE_KINDS


def maps(dataset: Dataset, batch: int) -> list[Maps]:
    """The kinds of map that a batch has; cross maps are absent with one source."""
    found = []
    for prefix, kinds in (("slope", SLOPE_KINDS), ("intensity", INTENSITY_KINDS)):
        measured = of_batch(dataset, f"{prefix}_correlation", batch)
        if measured is None:
            continue
        blank = np.full_like(measured, np.nan)
        model = of_batch(dataset, f"{prefix}_correlation_model", batch)
        error = of_batch(dataset, f"{prefix}_correlation_error", batch)
        for i, kind in enumerate(kinds):
            here = np.isfinite(measured[i])
            if here.any():
                # A profile has a correlation at every separation; without a pair there is nothing to compare it with.
                shown = np.where(here, (blank if model is None else model)[i], np.nan)
                found.append(Maps(kind, measured[i], shown, (blank if error is None else error)[i]))
    return sorted(found, key=lambda item: MAP_KINDS.index(item.kind))


def has_profile(dataset: Dataset) -> NDArray[np.bool_]:
    """Whether each batch has a profile, (time,)."""
    cn2 = values(dataset, "cn2")
    return np.zeros(dataset.sizes["time"], bool) if cn2 is None else np.asarray(np.isfinite(cn2).any(axis=1))


@dataclass(frozen=True)
class Series:
    """One number per batch over time, with NaN put in where the recording was interrupted.

    Parameters
    ----------
    days : ndarray of float64
        Middle of each batch, days since 1970 UTC.
    values : ndarray of float64
        The number.
    half : ndarray of float64
        Half the length of each batch, days.
    """

    days: Floats
    values: Floats
    half: Floats

    def mapped(self, function: Callable[[Floats], Floats]) -> Series:
        """The same over time with each number replaced, NaN where the result is not finite."""
        with np.errstate(divide="ignore", invalid="ignore"):
            found = function(self.values)
        return Series(self.days, np.where(np.isfinite(found), found, np.nan), self.half)


def series(datasets: Sequence[Dataset], name: str, component: int | None = None) -> Series | None:
    """Follow a variable over time, None where no product has it.

    Parameters
    ----------
    datasets : sequence of Dataset
        Products.
    name : str
        Variable with one number per batch, or one per batch and component.
    component : int, optional
        Which component; the mean over them where it is not given.
    """
    limits, numbers = [], []
    for dataset in datasets:
        found = values(dataset, name)
        if found is None:
            continue
        found = found.reshape(found.shape[0], -1)
        if component is None:
            count = np.isfinite(found).sum(axis=1)
            column = np.where(count, np.nansum(found, axis=1) / np.maximum(count, 1), np.nan)
        elif component < found.shape[1]:
            column = found[:, component]
        else:
            continue
        limits.append(bounds(dataset))
        numbers.append(column)
    if not numbers:
        return None
    limit, value = np.concatenate(limits), np.concatenate(numbers)
    order = np.argsort(limit[:, 0], kind="stable")
    limit, value = limit[order], value[order]
    middle = limit.mean(axis=1) / DAY
    interrupted = np.flatnonzero(limit[1:, 0] - limit[:-1, 1] > 0.5 * np.median(limit[:, 1] - limit[:, 0])) + 1
    half = (limit[:, 1] - limit[:, 0]) / 2 / DAY
    return Series(
        np.insert(middle, interrupted, middle[interrupted]),
        np.insert(value, interrupted, np.nan),
        np.insert(half, interrupted, 0.0),
    )


def source_names(datasets: Sequence[Dataset]) -> list[str]:
    """Names of the sources, ``source 1`` and ``source 2`` where the product has none."""
    count = max(dataset.sizes.get("source", 0) for dataset in datasets)
    names = [f"source {i + 1}" for i in range(count)]
    for dataset in datasets:
        if "source" in dataset.coords and dataset.sizes["source"] == count:
            # Dollar signs would start a formula in a figure; a name of 1,000 characters would leave it.
            found = [clean(name)[:24] for name in dataset["source"].values]
            return [name.replace("$", r"\$") or names[i] for i, name in enumerate(found)]
    return names


def span(datasets: Sequence[Dataset]) -> tuple[int, int]:
    """First start and last end, ns since 1970 UTC."""
    limit = np.concatenate([bounds(dataset) for dataset in datasets])
    return int(limit[:, 0].min()), int(limit[:, 1].max())
