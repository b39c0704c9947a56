"""Parameters of an optical link along the path of products, with the errors of their profiles."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..catalog.query_times import utc_text
from ..pipeline.optical_parameters import optical_intervals, optical_parameters
from ..pipeline.units import safe, text
from .agreement import covariance_of, path_of
from .settings import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..pipeline.optical_parameters import Direction, Wave

#: Parameter -> (heading, unit in tables, SI unit, SI units in one of the table).
COLUMNS = {
    "fried_parameter": ("r0", "cm", "m", 1e-2),
    "isoplanatic_angle": ("isoplanatic", "urad", "rad", 1e-6),
    "coherence_time": ("coherence", "ms", "s", 1e-3),
    "rytov_variance": ("Rytov variance", "", "1", 1.0),
}


@dataclass(frozen=True)
class Link:
    """A link.

    Parameters
    ----------
    wavelength : float
        m.
    direction : {"toward_pupil", "toward_sources"}
        Where its receiver is.
    wave : {"spherical", "plane"}
        Wave.
    wind : float, optional
        Wind across the path, m/s.
    """

    wavelength: float
    direction: Direction
    wave: Wave
    wind: float | None = None


@dataclass(frozen=True)
class Row:
    """What one batch means for a link.

    Parameters
    ----------
    archive : str
        Name of the recording.
    start, stop : int
        The batch, ns since 1970 UTC.
    values : dict of str to (float, float, float)
        Value and ends of its 68 % interval by the names of :data:`COLUMNS`, SI; NaN where it is not known.
    weak : bool
        Whether first-order theory holds.
    """

    archive: str
    start: int
    stop: int
    values: dict[str, tuple[float, float, float]]
    weak: bool


def rows_of(datasets: Sequence[Any], link: Link) -> list[Row]:
    """Parameters of a link for each batch of products.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products.
    link : Link
        Light that is sent along their path.

    Returns
    -------
    list of Row
        In the order of time.

    Raises
    ------
    InputError
        A path is infinite.
    """
    rows = []
    for dataset in datasets:
        length, grid = path_of(dataset)
        archive = str(dataset.attrs.get("archive", ""))
        if not np.isfinite(length):
            raise InputError(
                [f"{safe(archive)}: its path is infinite; a link has two ends, choose products of a finite path"]
            )
        cn2 = np.asarray(dataset["cn2"].values, dtype=np.float64)
        mean = np.asarray(dataset["cn2_posterior_mean"].values) if "cn2_posterior_mean" in dataset else cn2
        wind = None if link.wind is None else np.full(grid.k, link.wind)
        how = (grid, link.wavelength, length)
        found = optical_parameters(cn2, *how, wave=link.wave, direction=link.direction, wind=wind)
        ends = optical_intervals(
            mean, covariance_of(dataset), *how, wave=link.wave, direction=link.direction, wind=wind
        )
        bounds = dataset["time_bounds"].values.astype("datetime64[ns]").astype(np.int64)
        for number, (start, stop) in enumerate(bounds):
            values = {name: (float(getattr(found, name)[number]), *map(float, ends[name][number])) for name in COLUMNS}
            rows.append(Row(archive, int(start), int(stop), values, bool(found.weak[number])))  # type: ignore[arg-type]
    return sorted(rows, key=lambda row: row.start)


def as_table(rows: Sequence[Row], link: Link) -> str:
    """Rows for people: values with their 68 % intervals."""
    names = [name for name in COLUMNS if name != "coherence_time" or link.wind is not None]

    def heading(name: str) -> str:
        label, unit, _, _ = COLUMNS[name]
        return f"{label} ({unit})" if unit else label

    def cell(row: Row, name: str) -> str:
        value, low, high = (x / COLUMNS[name][3] for x in row.values[name])
        if not np.isfinite(value):
            return "-"
        return f"{value:.4g}" + (f" [{low:.4g}, {high:.4g}]" if np.isfinite(low) else "")

    lines = [["start (UTC)", *map(heading, names), ""]]
    for row in rows:
        known = np.isfinite(row.values["rytov_variance"][0])
        lines.append(
            [utc_text(row.start), *(cell(row, name) for name in names), "strong" if known and not row.weak else ""]
        )
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return "\n".join("  ".join(f"{x:<{w}}" for x, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def as_csv(rows: Sequence[Row]) -> str:
    """Rows with SI units in the heading."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    head = [
        f"{name}{end} [{unit}]"
        for name, (_, _, unit, _) in COLUMNS.items()
        for end in ("", "_interval_68_low", "_interval_68_high")
    ]
    writer.writerow(["archive", "time [UTC]", "end [UTC]", *head, "weak"])
    for row in rows:
        cells = [f"{x:.6g}" if np.isfinite(x) else "" for name in COLUMNS for x in row.values[name]]
        writer.writerow([row.archive, utc_text(row.start), utc_text(row.stop), *cells, int(row.weak)])
    return file.getvalue()


def as_json(rows: Sequence[Row], link: Link) -> str:
    """Link and rows, SI, null where a value is not known."""

    def number(x: float) -> float | None:
        return x if np.isfinite(x) else None

    content = {
        "link": {
            "wavelength": text(link.wavelength, "m"),
            "direction": link.direction,
            "wave": link.wave,
            "wind": None if link.wind is None else text(link.wind, "m/s"),
        },
        "units": {name: unit for name, (_, _, unit, _) in COLUMNS.items()},
        "batches": [
            {
                "archive": row.archive,
                "start": utc_text(row.start),
                "end": utc_text(row.stop),
                **{
                    name: {"value": number(value), "interval_68": [number(low), number(high)]}
                    for name, (value, low, high) in row.values.items()
                },
                "weak": row.weak,
            }
            for row in rows
        ],
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"
