"""Products as two flat tables, in CSV with their units beside them and in Parquet with them inside."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...pipeline.products import SCHEMA
from ...pipeline.units import safe
from .files import ExportError, missing_package, ordered, write_whole

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

#: Columns that tell the rows of a table apart.
_IDENTITY = {
    "campaign": "name of the campaign",
    "archive": "name of the recording",
    "lineage_key": "sha256 of everything that decided the result",
}
#: Dimensions beside time that make a column for each of their names.
_NAMED = ("source", "axis", "axis_kind", "scintillometer")
#: How a boundary is called in the name of a column.
_BOUND = ("lower", "upper")


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Parameters
    ----------
    name, unit, meaning : str
        Unit as in the product; ``UTC`` for times, empty for text.
    values : ndarray, (rows,)
        datetime64[ns] for times, str for text; masked where a product has no such number.
    """

    name: str
    unit: str
    meaning: str
    values: Any


@dataclass(frozen=True)
class Table:
    """Rows with the same columns.

    Parameters
    ----------
    name : str
        ``profiles`` or ``batches``.
    columns : tuple of Column
        All of one length.
    """

    name: str
    columns: tuple[Column, ...]


def tables(datasets: Sequence[xr.Dataset]) -> list[Table]:
    """Products as tables.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products, in any order.

    Returns
    -------
    list of Table
        ``profiles`` has a row for every batch and slice, with everything that has the dimensions (time, z) or (time, z,
        bound). ``batches`` has a row for every batch, with everything that has the dimension time alone, or with it one
        short named dimension (`source`, `axis`, ...), one column for each name as ``mean_flux[top]``, or a bound, as
        ``r0_interval_68[lower]``. Maps, kernels and curves have no place in a table.

    Raises
    ------
    ExportError
        There is no product.
    """
    products = ordered(datasets)
    batches, slices = _selected(products)
    rows = [dataset.sizes["time"] for dataset in products]
    # A product of nothing but failures may have no slices; it has no rows in the table of profiles then.
    depths = [dataset.sizes.get("z", 0) for dataset in products]
    bounds = [dataset["time_bounds"].values for dataset in products]

    def of_batches(values: Sequence[Any], repeat: bool) -> NDArray[Any]:
        parts = [np.repeat(v, depth) if repeat else v for v, depth in zip(values, depths, strict=True)]
        return np.concatenate(parts)

    def shared(repeat: bool) -> tuple[list[Column], list[Column]]:
        times = [
            Column(name, "UTC", meaning, of_batches([bound[:, end] for bound in bounds], repeat))
            for end, (name, meaning) in enumerate((("time", "start of the batch"), ("time_end", "end of the batch")))
        ]
        names = [
            Column(name, "", meaning,
                   of_batches([np.full(n, str(d.attrs[name])) for n, d in zip(rows, products, strict=True)], repeat))
            for name, meaning in _IDENTITY.items()
        ]  # fmt: skip
        return times, names

    def column(name: str, label: str, pick: Mapping[str, Any]) -> Column:
        parts = [_values(dataset, name, pick) for dataset in products]
        values = np.ma.masked_array(
            np.concatenate([part.data for part in parts]), np.concatenate([np.ma.getmaskarray(part) for part in parts])
        )
        return Column(f"{name}[{label}]" if label else name, SCHEMA[name].unit, SCHEMA[name].long_name, values)

    z = []
    for name, meaning, at in (
        ("z", "distance of the slice's mid-point from the pupil", None),
        ("z_lower", "border of the slice nearer to the pupil", 0),
        ("z_upper", "border of the slice farther from the pupil", 1),
    ):
        parts = [np.tile(_slices(dataset, at), n) for n, dataset in zip(rows, products, strict=True)]
        z.append(Column(name, "m", meaning, np.concatenate(parts)))
    (start, names), (start_repeated, names_repeated) = shared(False), shared(True)
    return [
        Table("profiles", (*start_repeated, *z, *(column(*item) for item in slices), *names_repeated)),
        Table("batches", (*start, *(column(*item) for item in batches), *names)),
    ]


_Selection = list[tuple[str, str, Mapping[str, Any]]]


def _selected(products: Sequence[xr.Dataset]) -> tuple[_Selection, _Selection]:
    """Variable, label and where to look for it, for every column of the batches' and of the slices' table."""
    batches: _Selection = []
    slices: _Selection = []
    for name, variable in SCHEMA.items():
        dims = variable.dims
        if dims[:1] != ("time",) or name == "time_bounds" or not any(name in dataset for dataset in products):
            continue
        rest = dims[1:]
        target = slices if rest[:1] == ("z",) else batches
        rest = rest[1:] if target is slices else rest
        picks: _Selection = [(name, "", {})]
        for dim in rest:
            if dim == "bound":
                picks = [(n, f"{label},{end}".strip(","), {**pick, dim: i})
                         for n, label, pick in picks for i, end in enumerate(_BOUND)]  # fmt: skip
            elif dim in _NAMED and target is batches:
                labels = [str(x) for dataset in products if dim in dataset.coords for x in dataset[dim].values]
                picks = [(n, f"{label},{safe(x)}".strip(","), {**pick, dim: x})
                         for n, label, pick in picks for x in dict.fromkeys(labels)]  # fmt: skip
            else:
                picks = []
        target += picks
    return batches, slices


def _values(dataset: xr.Dataset, name: str, pick: Mapping[str, Any]) -> Any:
    """A column's part from one product, masked where the product has no such thing."""
    depth = dataset.sizes.get("z", 0) if "z" in SCHEMA[name].dims else 1
    rows = dataset.sizes["time"] * depth
    blank = np.ma.masked_array(np.zeros(rows, SCHEMA[name].dtype), np.ones(rows, bool))
    if name not in dataset:
        return blank
    found = dataset[name]
    for dim, at in pick.items():
        if isinstance(at, str):
            labels = [str(x) for x in found[dim].values]
            if at not in labels:
                return blank
            at = labels.index(at)
        found = found.isel({dim: at})
    return np.ma.masked_array(found.values.reshape(-1))


def _slices(dataset: xr.Dataset, bound: int | None) -> NDArray[np.float64]:
    if "z" not in dataset:
        return np.empty(0)
    if bound is None:
        return np.asarray(dataset["z"].values)
    if "z_bounds" not in dataset:
        return np.full(dataset.sizes["z"], np.nan)
    return np.asarray(dataset["z_bounds"].values[:, bound])


def _about(datasets: Sequence[xr.Dataset]) -> list[dict[str, Any]]:
    """What tells the products of a table apart, for people and programs."""
    return [
        {
            **{name: dataset.attrs[name] for name in _IDENTITY},
            "archive_identity": dataset.attrs["archive_identity"],
            "wavelength": dataset.attrs["wavelength"],
            "lineage": json.loads(dataset.attrs["lineage"]),
        }
        for dataset in ordered(datasets)
    ]


def _cells(column: Column) -> list[str]:
    """A number with all its digits; an unknown one is an empty cell."""
    values = column.values
    if values.dtype.kind == "M":
        return [f"{moment}Z" for moment in np.datetime_as_string(values, unit="ns")]
    if values.dtype.kind == "U":
        return [str(value) for value in values]
    known = ~_unknown(values)
    return [
        (repr(float(value)) if values.dtype.kind == "f" else str(int(value))) if here else ""
        for value, here in zip(np.ma.getdata(values), known, strict=True)
    ]


def _unknown(values: Any) -> NDArray[np.bool_]:
    """Where a column has no value: what a product lacks, and NaN. Infinity is a value."""
    unknown = np.ma.getmaskarray(values)
    return np.asarray(unknown | np.isnan(np.ma.getdata(values)) if values.dtype.kind == "f" else unknown)


def _named(path: str | os.PathLike[str], ending: str) -> tuple[Path, Path]:
    """Files of the profiles and of the batches."""
    target = Path(path)
    target = target if target.suffix == ending else target.with_name(f"{target.name}{ending}")
    return target, target.with_suffix(f".batches{ending}")


def export_csv(datasets: Sequence[xr.Dataset], path: str | os.PathLike[str]) -> list[Path]:
    """Write products as two tables (see :func:`tables`) and their units.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products, in any order.
    path : path
        ``NAME.csv`` or ``NAME``.

    Returns
    -------
    list of Path
        ``NAME.csv`` with the profiles, ``NAME.batches.csv``, and ``NAME.units.json`` with file, unit and meaning of
        every column and the lineage of every product.

    Raises
    ------
    ExportError
        There is no product, or no folder to write to.
    """
    made = tables(datasets)
    files = [*_named(path, ".csv")]
    sidecar = {
        "missing": "an empty cell",
        "columns": [
            {"file": file.name, "name": column.name, "unit": column.unit, "description": column.meaning}
            for file, table in zip(files, made, strict=True)
            for column in table.columns
        ],
        "products": _about(datasets),
    }
    for file, table in zip(files, made, strict=True):
        rows = zip(*(_cells(column) for column in table.columns), strict=True)

        def write(temporary: Path, table: Table = table, rows: Any = rows) -> None:
            with open(temporary, "w", newline="", encoding="utf-8") as opened:
                writer = csv.writer(opened, lineterminator="\n")
                writer.writerow([column.name for column in table.columns])
                writer.writerows(rows)

        write_whole(file, write)
    content = json.dumps(sidecar, indent=1, sort_keys=True, allow_nan=False)
    units = files[0].with_suffix(".units.json")
    write_whole(units, lambda temporary: temporary.write_text(content + "\n", encoding="utf-8"))
    return [*files, units]


def export_parquet(datasets: Sequence[xr.Dataset], path: str | os.PathLike[str]) -> list[Path]:
    """Write products as two Parquet files (see :func:`tables`) that know their units.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products, in any order.
    path : path
        ``NAME.parquet`` or ``NAME``.

    Returns
    -------
    list of Path
        ``NAME.parquet`` with the profiles and ``NAME.batches.parquet``. Each field has the metadata ``unit`` and
        ``description``; the schema has ``coslidar``, JSON with names, keys and lineage of the products.

    Raises
    ------
    ExportError
        The package pyarrow is not installed, there is no product, or no folder to write to.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise missing_package("pyarrow", "parquet", "Parquet") from error
    about = json.dumps({"products": _about(datasets)}, sort_keys=True, allow_nan=False)
    files = [*_named(path, ".parquet")]
    for file, table in zip(files, tables(datasets), strict=True):
        arrays, fields = [], []
        for column in table.columns:
            values = column.values
            kind = pyarrow.timestamp("ns", tz="UTC") if values.dtype.kind == "M" else None
            if values.dtype.kind == "U":
                array = pyarrow.array(values.tolist(), pyarrow.string())
            else:
                array = pyarrow.array(np.ma.getdata(values), kind, mask=_unknown(values))
            arrays.append(array)
            metadata = {"unit": column.unit, "description": column.meaning}
            fields.append(pyarrow.field(column.name, array.type, metadata=metadata))
        made = pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(fields, metadata={"coslidar": about}))
        write_whole(file, lambda temporary, made=made: pyarrow.parquet.write_table(made, temporary))  # type: ignore[misc]
    return files


__all__ = ["Column", "ExportError", "Table", "export_csv", "export_parquet", "tables"]
