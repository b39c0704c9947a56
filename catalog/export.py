"""Products in the formats of other tools: CSV with its units beside it, and NetCDF4.

NetCDF follows CF-1.11, with one exception that cannot be helped: UDUNITS, the judge of CF units, has no fractional
exponents. It refuses ``m^(-2/3)`` and reads ``m-2/3`` as something else without a word. The default writes the unit as
it is; `strict` leaves it out of ``units`` and says it in ``comment``.
"""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from ..pipeline.products import SCHEMA
from ..pipeline.units import safe
from .products import TIME_UNITS, temporary_name

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: What UDUNITS cannot read: powers that are no whole number.
_BEYOND_UDUNITS = re.compile(r"\^\([^)]*/")
#: Columns that tell the rows of a table apart.
_IDENTITY = ("campaign", "archive", "lineage_key")


class ExportError(ValueError):
    """Products that cannot be exported as asked."""


def _ordered(datasets: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    if not datasets:
        raise ExportError("there is no product to export")
    return sorted(datasets, key=lambda dataset: (dataset["time"].values[0], str(dataset.attrs["lineage_key"])))


def _write_whole(target: Path, write: Callable[[Path], object]) -> None:
    """Let a file appear under its name only when it is complete."""
    if not target.parent.is_dir():
        raise ExportError(f"{safe(str(target))}: there is no folder to write to")
    temporary = target.parent / temporary_name()
    try:
        write(temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def _table(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    def write(temporary: Path) -> None:
        with open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(rows)

    _write_whole(path, write)


def _cell(value: Any) -> str:
    """A number with all its digits; an unknown one is an empty cell."""
    if isinstance(value, (float, np.floating)):
        return "" if np.isnan(value) else repr(float(value))
    return str(int(value))


def _utc(moment: np.datetime64) -> str:
    return f"{np.datetime_as_string(moment, unit='ns')}Z"


def export_csv(datasets: Sequence[xr.Dataset], path: str | os.PathLike[str]) -> list[Path]:
    """Write products as two tables and their units.

    ``NAME.csv`` has a row for every batch and slice, with everything that has the dimensions (time, z).
    ``NAME.batches.csv`` has a row for every batch, with everything that has the dimension time alone or time and one
    short named dimension (`source`, `axis`, `axis_kind`), one column for each name as ``mean_flux[top]``.
    ``NAME.units.json`` tells file, unit and meaning of every column, and the lineage of every product. Maps, kernels
    and curves have no place in a table; NetCDF has them.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products, in any order.
    path : path
        ``NAME.csv`` or ``NAME``.

    Returns
    -------
    list of Path
        The three files.

    Raises
    ------
    ExportError
        There is no product, or no folder to write to.
    """
    ordered = _ordered(datasets)
    target = Path(path)
    target = target if target.suffix == ".csv" else target.with_name(f"{target.name}.csv")
    files = [target, target.with_suffix(".batches.csv"), target.with_suffix(".units.json")]

    profiles = [n for n, v in SCHEMA.items() if v.dims == ("time", "z") and any(n in d for d in ordered)]
    named = ("source", "axis", "axis_kind")
    scalars: list[tuple[str, str | None, str | None]] = []
    for name, variable in SCHEMA.items():
        if variable.dims == ("time",) and any(name in dataset for dataset in ordered):
            scalars.append((name, None, None))
        elif len(variable.dims) == 2 and variable.dims[1] in named:
            dim = variable.dims[1]
            labels = [str(x) for dataset in ordered if name in dataset for x in dataset[dim].values]
            scalars += [(name, dim, label) for label in dict.fromkeys(labels)]
    columns = [name if label is None else f"{name}[{safe(label)}]" for name, _, label in scalars]

    long_rows: list[list[str]] = []
    batch_rows: list[list[str]] = []
    for dataset in ordered:
        loaded = {name: dataset[name].values for name in profiles if name in dataset}
        series = [_series(dataset, *scalar) for scalar in scalars]
        z = dataset["z"].values if "z" in dataset else np.empty(0)
        slices = [[_cell(x) for x in (z[i], *_edges(dataset, i))] for i in range(len(z))]
        identity = [str(dataset.attrs[name]) for name in _IDENTITY]
        bounds = dataset["time_bounds"].values
        for i in range(dataset.sizes["time"]):
            times = [_utc(bounds[i, 0]), _utc(bounds[i, 1])]
            batch_rows.append([*times, *("" if s is None else _cell(s[i]) for s in series), *identity])
            for j, slice_cells in enumerate(slices):
                cells = [_cell(loaded[name][i, j]) if name in loaded else "" for name in profiles]
                long_rows.append([*times, *slice_cells, *cells, *identity])

    heads = [
        ["time", "time_end", "z", "z_lower", "z_upper", *profiles, *_IDENTITY],
        ["time", "time_end", *columns, *_IDENTITY],
    ]
    about = {
        "time": ("UTC", "start of the batch, ISO 8601"),
        "time_end": ("UTC", "end of the batch, ISO 8601"),
        "z": ("m", "distance of the slice's mid-point from the pupil"),
        "z_lower": ("m", "border of the slice nearer to the pupil"),
        "z_upper": ("m", "border of the slice farther from the pupil"),
        "campaign": ("", "name of the campaign"),
        "archive": ("", "name of the recording"),
        "lineage_key": ("", "sha256 of everything that decided the result"),
        **{name: (SCHEMA[name].unit, SCHEMA[name].long_name) for name in profiles},
        **{
            column: (SCHEMA[name].unit, SCHEMA[name].long_name)
            for column, (name, _, _) in zip(columns, scalars, strict=True)
        },
    }
    sidecar = {
        "missing": "an empty cell",
        "columns": [
            {"file": file.name, "name": column, "unit": about[column][0], "description": about[column][1]}
            for file, head in zip(files, heads, strict=False)
            for column in head
        ],
        "products": [
            {
                **{name: dataset.attrs[name] for name in _IDENTITY},
                "archive_identity": dataset.attrs["archive_identity"],
                "wavelength": dataset.attrs["wavelength"],
                "lineage": json.loads(dataset.attrs["lineage"]),
            }
            for dataset in ordered
        ],
    }
    _table(files[0], heads[0], long_rows)
    _table(files[1], heads[1], batch_rows)
    content = json.dumps(sidecar, indent=1, sort_keys=True, allow_nan=False)
    _write_whole(files[2], lambda temporary: temporary.write_text(content + "\n", encoding="utf-8"))
    return files


def _edges(dataset: xr.Dataset, number: int) -> tuple[float, float]:
    if "z_bounds" not in dataset:
        return float("nan"), float("nan")
    low, high = dataset["z_bounds"].values[number]
    return float(low), float(high)


def _series(dataset: xr.Dataset, name: str, dim: str | None, label: str | None) -> NDArray[Any] | None:
    if name not in dataset:
        return None
    if dim is None:
        return np.asarray(dataset[name].values)
    names = [str(x) for x in dataset[dim].values]
    return np.asarray(dataset[name].values[:, names.index(label)]) if label in names else None


def join(datasets: Sequence[xr.Dataset]) -> xr.Dataset:
    """Put products one after the other in time.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products of one geometry: the same slices, separations and sources. Their grids of mu may differ; the criterion
        is NaN where it was not computed.

    Returns
    -------
    xarray.Dataset
        Attributes that differ are lists in the order of the batches' products; `product` (time) tells which.

    Raises
    ------
    ExportError
        They do not fit together, or two of them cover the same time.
    """
    ordered = _ordered(datasets)
    if len(ordered) == 1:
        return ordered[0]
    first = ordered[0]
    for other in ordered[1:]:
        for name in ("z", "dy", "dx", "source", "z_bounds", "pair_count"):
            same = (name in first.variables) == (name in other.variables)
            if same and name in first.variables:
                same = np.array_equal(first[name].values, other[name].values)
            if not same:
                labels = [f"{d.attrs['campaign']}/{d.attrs['archive']}" for d in (first, other)]
                raise ExportError(f"{labels[0]} and {labels[1]} differ in {name}; export them to a file each")
    marked = [
        dataset.assign(product=("time", np.full(dataset.sizes["time"], number, np.int32)))
        for number, dataset in enumerate(ordered)
    ]
    static = [name for name, variable in SCHEMA.items() if "time" not in variable.dims]
    joined = xr.concat(
        [dataset.drop_vars(static, errors="ignore") for dataset in marked],
        dim="time",
        data_vars="all",
        coords="minimal",
        compat="equals",
        join="outer",
        combine_attrs="override",
    )
    joined = joined.assign({name: first[name] for name in static if name in first}).sortby("time")
    bounds = joined["time_bounds"].values
    if (bounds[1:, 0] < bounds[:-1, 1]).any():
        raise ExportError("two of the products cover the same time; export them to a file each")
    joined["product"].attrs = {"long_name": "number of the product in the lists among the attributes", "units": "1"}
    joined.attrs = dict(first.attrs)
    for name in ("campaign", "archive", "archive_identity", "wavelength", "lineage_key"):
        values = [str(dataset.attrs[name]) for dataset in ordered]
        joined.attrs[name] = values if len(set(values)) > 1 else values[0]
    for name in ("lineage", "provenance"):
        joined.attrs[name] = json.dumps([json.loads(dataset.attrs[name]) for dataset in ordered], sort_keys=True)
    names = joined.attrs["archive"]
    joined.attrs["title"] = f"Cn2 profiles of {names if isinstance(names, str) else ', '.join(names)}"
    return joined


def export_netcdf(datasets: Sequence[xr.Dataset], path: str | os.PathLike[str], *, strict: bool = False) -> Path:
    """Write products as one NetCDF4 file after CF-1.11.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products; several are joined as :func:`join` does.
    path : path
        The file; replaced where it is there.
    strict : bool
        Leave out units that UDUNITS cannot read, and say them in ``comment``.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ExportError
        The package netCDF4 is not installed, or the products do not fit together.
    """
    try:
        import netCDF4  # noqa: F401
    except ImportError as error:
        raise ExportError(
            "export to NetCDF needs the package netCDF4; install it with: pip install 'coslidar[netcdf]'"
        ) from error
    written = join(datasets).copy()
    encoding: dict[str, dict[str, Any]] = {}
    for key, variable in written.variables.items():
        name = str(key)
        # Attributes of one variable must not reach the dataset it was copied from.
        variable.attrs = dict(variable.attrs)
        encoding[name] = {"_FillValue": None}
        if variable.dtype.kind == "M":
            encoding[name] |= {"units": TIME_UNITS, "calendar": "standard", "dtype": "int64"}
        elif variable.dtype.kind == "f" and name not in written.coords and not name.endswith("_bounds"):
            encoding[name] = {"_FillValue": np.nan}
        if variable.dtype.kind not in "UT" and variable.ndim > 1:
            encoding[name] |= {"zlib": True, "complevel": 4}
        for flags in ("flag_masks", "flag_values"):
            if flags in variable.attrs:
                variable.attrs[flags] = np.asarray(variable.attrs[flags], dtype=variable.dtype)
        if strict and _BEYOND_UDUNITS.search(variable.attrs.get("units", "")):
            unit = variable.attrs.pop("units")
            variable.attrs["comment"] = f"in {unit}, a unit that UDUNITS cannot read"
    target = Path(path)
    _write_whole(
        target, lambda temporary: written.to_netcdf(temporary, engine="netcdf4", format="NETCDF4", encoding=encoding)
    )
    return target
