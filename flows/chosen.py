"""Products that a person means: those of a campaign, of a catalog, by name, key or file, within a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..catalog.query_times import TimeError, moment
from ..pipeline.units import safe
from .commands.results import existing, find
from .settings import InputError

if TYPE_CHECKING:
    from xarray import Dataset

    from ..catalog.rows import ProductRow


@dataclass
class Chosen:
    """Products in the order in which they were named, and what they are called together.

    Parameters
    ----------
    datasets : list of Dataset
        Never empty.
    title : str or None
        Name of the campaign, where one was named.
    made : int or None
        When the last of them was published, ns since 1970 UTC; None where the catalog was not asked.
    """

    datasets: list[Dataset] = field(default_factory=list)
    title: str | None = None
    made: int | None = None

    def add(self, rows: Sequence[ProductRow], opened: Any) -> None:
        """Read products of a catalog."""
        self.datasets += [opened.open(row) for row in rows]
        self.made = max([self.made or 0, *(row.published for row in rows)]) or None


def choose(
    inputs: Sequence[str],
    out: Path,
    *,
    since: str | None = None,
    until: str | None = None,
    lineage: str | None = None,
) -> Chosen:
    """Find and read products.

    Parameters
    ----------
    inputs : sequence of str
        Campaign files (for each archive the product of its settings, else the newest), folders of catalogs (the newest
        of each archive), product files, or names and keys in the catalog of `out`.
    out : Path
        Folder of the catalog for names and keys.
    since, until : str, optional
        Times with zone: batches that start at or after the one and before the other.
    lineage : str, optional
        First digits of a lineage key: of campaigns and catalogs, products of that lineage.

    Returns
    -------
    Chosen

    Raises
    ------
    InputError
        Something is not there, a time cannot be read, or nothing is left.
    """
    from ..catalog.products import ProductError, open_product

    window = _window(since, until)
    found = Chosen()
    for item in inputs:
        path = Path(item)
        if item.endswith(".toml"):
            _campaign(path, lineage, found)
        elif path.is_dir():
            with existing(path) as opened:
                found.add(newest(_of_lineage(opened.products(), lineage)), opened)
        elif path.is_file():
            try:
                found.datasets.append(open_product(path))
            except ProductError as error:
                raise InputError([str(error)]) from error
        else:
            with existing(out) as opened:
                found.add([find(opened, item)], opened)
    if not found.datasets:
        what = f" of lineage {safe(lineage)}" if lineage else ""
        raise InputError([f"{', '.join(map(safe, inputs))}: there is no product{what} yet; 'coslidar run' makes them"])
    found.datasets = [part for dataset in found.datasets if (part := _within(dataset, *window)).sizes["time"]]
    if not found.datasets:
        names = ", ".join(map(safe, inputs))
        raise InputError([f"{names}: no batch starts in that time; 'coslidar catalog ls --batches' lists them"])
    return found


def _window(since: str | None, until: str | None) -> tuple[int | None, int | None]:
    faults, times = [], []
    for option, value in (("--from", since), ("--to", until)):
        try:
            times.append(None if value is None else moment(value))
        except TimeError as error:
            times.append(None)
            faults.append(f"{option}: {error}")
    if not faults and None not in times and times[0] >= times[1]:  # type: ignore[operator]
        faults.append(f"--from {since} is not before --to {until}; turn them round")
    if faults:
        raise InputError(faults)
    return times[0], times[1]


def _within(dataset: Dataset, since: int | None, until: int | None) -> Dataset:
    import numpy as np

    start = dataset["time"].values.astype("datetime64[ns]").astype(np.int64)
    keep = np.ones(start.size, bool)
    if since is not None:
        keep &= start >= since
    if until is not None:
        keep &= start < until
    return dataset if keep.all() else dataset.isel(time=np.flatnonzero(keep))


def _of_lineage(rows: Sequence[ProductRow], lineage: str | None) -> list[ProductRow]:
    return [row for row in rows if lineage is None or row.lineage_key.startswith(lineage.lower())]


def newest(rows: Sequence[ProductRow]) -> list[ProductRow]:
    """The newest product of each archive, in the order of their time."""
    found: dict[str, ProductRow] = {}
    for row in sorted(rows, key=lambda row: row.published):
        found[row.archive_identity] = row
    return sorted(found.values(), key=lambda row: row.start)


def _campaign(path: Path, lineage: str | None, found: Chosen) -> None:
    """Products of a campaign file: those of its settings where they are there, else the newest ones."""
    from ..catalog.archive import ArchiveError
    from .plan import plan_archive
    from .settings import load

    settings = load(path)
    found.title = settings.campaign
    with existing(settings.output) as opened:
        rows = _of_lineage(opened.products(campaign_name=settings.campaign), lineage)
        for url in settings.archives:
            try:
                planned = plan_archive(url, settings)
            except (ArchiveError, InputError):
                continue  # 'coslidar run' and 'inspect' say what is wrong with it
            mine = [row for row in rows if row.archive_identity == planned.archive.identity]
            exact = [row for row in mine if row.lineage_key == str(planned.profile_key)]
            found.add(exact or newest(mine), opened)
