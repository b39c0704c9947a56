"""Batches as the catalog lists them, as a table for people, CSV, JSON or Parquet."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from ..pipeline.products import QUALITY_FLAGS
from .export.files import missing_package, write_whole
from .query import LEVELS
from .query_times import local_text, utc_text
from .rows import BatchRow


class Column(NamedTuple):
    """A column: its name, unit and meaning, how wide it is in the table and how it is written there, its value."""

    name: str
    unit: str
    meaning: str
    form: str
    value: Callable[[BatchRow], str | int | float | None]


def flag_names(bits: int) -> str:
    """Names of the flags that are set, separated by blanks."""
    return " ".join(name for name, (bit, _, _) in QUALITY_FLAGS.items() if bits & bit)


def _log_mu(row: BatchRow) -> float | None:
    return math.log10(row.mu) if row.mu else None


#: Everything that is listed. What has no form is left out of the table for people.
COLUMNS = (
    Column("start", "UTC", "begin of the batch", "20", lambda row: utc_text(row.start, exact=True)),
    Column("start_local", "", "the same in the time zone of the campaign", "25",
           lambda row: local_text(row.start, row.timezone)),
    Column("stop", "UTC", "end of the batch", "", lambda row: utc_text(row.stop, exact=True)),
    Column("campaign", "", "name of the campaign", "16", lambda row: row.campaign),
    Column("archive", "", "name of the recording", "18", lambda row: row.archive),
    Column("lineage_key", "", "key of the product", "8.8", lambda row: row.lineage_key),
    Column("batch", "1", "number of the batch in its product", ">5", lambda row: row.number),
    Column("frames", "1", "frames in the batch", ">6", lambda row: row.n_frames),
    Column("r0", "m", "Fried parameter, from the profile", ">8.4f", lambda row: row.r0),
    Column("scint", "1", "scintillation index, measured", ">7.4f", lambda row: row.scintillation_index),
    Column("scint_profile", "1", "the same from the profile", "", lambda row: row.scintillation_index_profile),
    Column("scint_point", "1", "index of one point of the source", "", lambda row: row.scintillation_index_point),
    Column("mu", "m^(4/3)", "hyperparameter of the inversion", "", lambda row: row.mu),
    Column("log_mu", "1", "log10 of mu in m^(4/3)", ">6.2f", _log_mu),
    Column("chi2", "1", "misfit per independent datum", ">6.2f", lambda row: row.chi2),
    Column("quality", "", "good, usable or bad", "7", lambda row: LEVELS[row.quality_level]),
    Column("flags", "", "quality flags", "1", lambda row: flag_names(row.quality_flag)),
)  # fmt: skip


def table(rows: Sequence[BatchRow]) -> str:
    """Lines for a terminal, units in the heading."""
    shown = [column for column in COLUMNS if column.form]

    def width(form: str) -> str:
        return form.partition(".")[0]

    def cell(column: Column, row: BatchRow) -> str:
        # People want to see when, programs exactly when.
        value = utc_text(row.start) if column.name == "start" else column.value(row)
        return format("-", width(column.form)) if value is None or value == "" else format(value, column.form)

    names = [
        f"{column.name} ({column.unit})" if column.unit not in ("", "1") else column.name.removeprefix("lineage_")
        for column in shown
    ]
    lines = ["  ".join(format(name, width(column.form)) for name, column in zip(names, shown, strict=True))]
    lines += ["  ".join(cell(column, row) for column in shown) for row in rows]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def as_csv(rows: Sequence[BatchRow]) -> str:
    """One line for each batch; the unit stands in the name of its column, as ``r0 [m]``."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(f"{c.name} [{c.unit}]" if c.unit not in ("", "1") else c.name for c in COLUMNS)
    writer.writerows(["" if (value := c.value(row)) is None else value for c in COLUMNS] for row in rows)
    return text.getvalue()


def as_json(rows: Sequence[BatchRow], query: str) -> str:
    """The query, the unit of each column, and the batches."""
    content = {
        "query": query,
        "columns": {column.name: {"unit": column.unit, "meaning": column.meaning} for column in COLUMNS},
        "batches": [{column.name: column.value(row) for column in COLUMNS} for row in rows],
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def write_parquet(rows: Sequence[BatchRow], path: Path, query: str) -> None:
    """Write a file whose fields have ``unit`` and ``description``; times are timestamps in UTC.

    Raises
    ------
    coslidar.catalog.export.files.ExportError
        The package pyarrow is not installed, or there is no folder to write to.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise missing_package("pyarrow", "parquet", "Parquet") from error
    moment = pyarrow.timestamp("ns", tz="UTC")
    kinds = {"start": moment, "stop": moment, "batch": pyarrow.int64(), "frames": pyarrow.int64()}
    arrays, fields = [], []
    for column in COLUMNS:
        kind = kinds.get(column.name, pyarrow.float64() if column.unit else pyarrow.string())
        values = [getattr(row, column.name) if column.name in ("start", "stop") else column.value(row) for row in rows]
        arrays.append(pyarrow.array(values, kind))
        fields.append(pyarrow.field(column.name, kind, metadata={"unit": column.unit, "description": column.meaning}))
    schema = pyarrow.schema(fields, metadata={"coslidar": json.dumps({"query": query})})
    made = pyarrow.Table.from_arrays(arrays, schema=schema)
    write_whole(path, lambda temporary: pyarrow.parquet.write_table(made, temporary))
