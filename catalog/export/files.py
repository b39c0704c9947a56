"""What every export shares: order and days of products, names of files, and writing them whole."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...pipeline.units import safe
from ..products import temporary_name

if TYPE_CHECKING:
    import xarray as xr

#: Longest site in the name of a file.
MAX_SITE = 60


class ExportError(ValueError):
    """Products that cannot be exported as asked."""


def ordered(datasets: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Products by the time of their first batch; ExportError without any."""
    if not datasets:
        raise ExportError("there is no product to export")
    return sorted(datasets, key=lambda dataset: (dataset["time"].values[0], str(dataset.attrs["lineage_key"])))


def by_day(datasets: Sequence[xr.Dataset]) -> dict[str, list[xr.Dataset]]:
    """Batches by the day (UTC) on which they start.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products.

    Returns
    -------
    dict of str to list of xarray.Dataset
        Day as ``2012-09-14`` -> what of each product belongs to it, both in the order of time.
    """
    found: dict[str, list[xr.Dataset]] = {}
    for dataset in ordered(datasets):
        days = dataset["time"].values.astype("datetime64[D]")
        for day in np.unique(days):
            found.setdefault(str(day), []).append(dataset.isel(time=np.flatnonzero(days == day)))
    return dict(sorted(found.items()))


def file_name(site: str, quantity: str, day: str, ending: str) -> str:
    """Name of a file by site, quantity and day.

    Parameters
    ----------
    site : str
        Any text; letters, digits and dashes are left of it.
    quantity : str
        What is in the file, as ``cn2``.
    day : str
        ``2012-09-14``.
    ending : str
        Without the dot.

    Returns
    -------
    str
        ``site_quantity_2012-09-14.ending``: never a path, whatever the site is called.
    """
    plain = unicodedata.normalize("NFKD", site).encode("ascii", "ignore").decode()
    plain = re.sub(r"[^a-z0-9]+", "-", plain.lower()).strip("-")[:MAX_SITE].strip("-")
    return f"{plain or 'site'}_{quantity}_{day}.{ending}"


def write_whole(target: Path, write: Callable[[Path], object]) -> None:
    """Let a file appear under its name only when it is complete."""
    if not target.parent.is_dir():
        raise ExportError(f"{safe(str(target))}: there is no folder to write to")
    temporary = target.parent / temporary_name()
    try:
        write(temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def missing_package(package: str, extra: str, what: str) -> ExportError:
    """The error for a format whose package is not installed."""
    return ExportError(
        f"export to {what} needs the package {package}; install it with: pip install 'coslidar[{extra}]'"
    )
