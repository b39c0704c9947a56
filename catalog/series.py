"""Readers of the series of other instruments: Scintec main data (.mnd), NetCDF, CSV with units.

All become one :class:`coslidar.pipeline.timeseries.TimeSeries`: intervals in UTC, quantities in SI units. Every fault
of a file is told at once.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from zoneinfo import ZoneInfo

import numpy as np

from ..pipeline.timeseries import QUANTITIES, TimeSeries, joined
from ..pipeline.units import QuantityError, conversion, safe

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from datetime import tzinfo

    from numpy.typing import NDArray

Stamp = Literal["start", "middle", "end"]

#: Columns of .mnd files -> quantities.
_MND = {
    "Cn2": "cn2",
    "CT2": "ct2",
    "H_final": "sensible_heat_flux",
    "H_convection": "sensible_heat_flux_free_convection",
    "H_unstable": "sensible_heat_flux_unstable",
    "H_stable": "sensible_heat_flux_stable",
    "L_final": "obukhov_length",
    "L_unstable": "obukhov_length_unstable",
    "L_stable": "obukhov_length_stable",
    "u*_final": "friction_velocity",
    "u*_unstable": "friction_velocity_unstable",
    "u*_stable": "friction_velocity_stable",
    "stabilityId": "stability",
    "latHeatFlux": "latent_heat_flux",
    "pressure": "pressure",
    "temp": "temperature",
    "humidity": "relative_humidity",
    "tempUp": "temperature_upper",
    "tempLw": "temperature_lower",
    "netRad": "net_radiation",
    "glbRad": "global_radiation",
    "windSpd": "wind_speed",
    "pathLength": "path_length",
    "pathHeight": "path_height",
    "z0": "roughness_length",
    "windHeight": "wind_height",
    "correctCn2Sat": "saturation_correction",
}
#: Other names of columns, in lower case and without a height at their end -> quantities.
_ALIASES = {
    **{name: name for name in QUANTITIES},
    **{"t": "temperature", "ta": "temperature", "temp": "temperature", "air_temperature": "temperature"},
    **{"p": "pressure", "pres": "pressure", "air_pressure": "pressure"},
    **{"rh": "relative_humidity", "humidity": "relative_humidity", "q": "specific_humidity"},
    **{"u": "wind_speed", "spd": "wind_speed", "wind": "wind_speed", "windspeed": "wind_speed", "ws": "wind_speed"},
    **{"rad": "global_radiation", "rg": "global_radiation", "rn": "net_radiation", "h": "sensible_heat_flux"},
    **{"le": "latent_heat_flux", "ustar": "friction_velocity", "u*": "friction_velocity", "beta": "bowen_ratio"},
    **{"c_n2": "cn2", "structparam_cn2": "cn2"},
}
_HEIGHT = re.compile(r"[_ ]\d+(\.\d+)?\s*m$")
_MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--"}


class SeriesError(ValueError):
    """A series that cannot be read; `faults` has one sentence each."""

    def __init__(self, faults: Sequence[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = list(faults)

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.faults,))


@dataclass(frozen=True)
class Reading:
    """How a series is to be read where its file does not say.

    Parameters
    ----------
    columns : mapping of str to str
        Quantity -> name of its column.
    units : mapping of str to str
        Quantity -> unit, where the file has none or a wrong one.
    timezone : str or None
        Time zone of times without an offset, for example ``"Europe/Paris"``.
    interval : float or None
        Length of the intervals, s; the most frequent step of the times where it is absent.
    stamp : {"start", "middle", "end"} or None
        What of its interval a time stamp means; the start where it is absent.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    timezone: str | None = None
    interval: float | None = None
    stamp: Stamp | None = None


@dataclass
class _Table:
    """Columns as a file has them: times in ns, or as text; values; units."""

    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    columns: dict[str, tuple[NDArray[np.float64], str | None]]
    known: Mapping[str, str]
    warnings: list[str] = field(default_factory=list)


def read_series(paths: Path | Iterable[Path], reading: Reading | None = None) -> TimeSeries:
    """Read one file, or several as one series.

    Parameters
    ----------
    paths : pathlib.Path or iterable of pathlib.Path
        ``.mnd`` (Scintec, format 1.1), ``.nc``/``.nc4``/``.cdf`` (NetCDF), anything else as CSV.
    reading : Reading, optional
        What the files do not say.

    Returns
    -------
    TimeSeries

    Raises
    ------
    SeriesError
        With every fault of all files.
    """
    given = [paths] if isinstance(paths, Path) else list(paths)
    how = reading or Reading()
    faults: list[str] = []
    found = []
    for path in given:
        try:
            found.append(_read(path, how))
        except SeriesError as error:
            faults += error.faults
    if not given:
        faults.append("no file of a series is given")
    if faults:
        raise SeriesError(faults)
    try:
        return joined(found, ", ".join(safe(str(path)) for path in given))
    except ValueError as error:
        raise SeriesError([str(error)]) from error


def _read(path: Path, reading: Reading) -> TimeSeries:
    origin = safe(str(path))
    suffix = path.suffix.lower()
    reader: Callable[[Path, str, Reading], _Table] = (
        _read_mnd if suffix == ".mnd" else _read_netcdf if suffix in (".nc", ".nc4", ".cdf") else _read_csv
    )
    if not path.is_file():
        raise SeriesError([f"{origin}: there is no such file"])
    try:
        table = reader(path, origin, reading)
    except (OSError, UnicodeDecodeError) as error:
        raise SeriesError([f"{origin}: cannot be read: {safe(str(error))}"]) from error
    return _typed(table, origin, reading)


def _typed(table: _Table, origin: str, reading: Reading) -> TimeSeries:
    """Columns as quantities in SI units, in the order of time."""
    faults: list[str] = []
    warnings = list(table.warnings)
    values: dict[str, NDArray[np.float64]] = {}
    chosen: dict[str, list[str]] = {}
    for name in table.columns:
        quantity = table.known.get(name) or _ALIASES.get(_HEIGHT.sub("", name.strip().lower()))
        if quantity is not None and quantity not in reading.columns and name not in reading.columns.values():
            chosen.setdefault(quantity, []).append(name)
    for quantity, names in chosen.items():
        if len(names) > 1:
            warnings.append(
                f"{origin}: {' and '.join(repr(name) for name in names)} could both be {quantity}; neither is read; "
                f"choose one with columns = {{ {quantity} = '{names[0]}' }}"
            )
    wanted = {quantity: names[0] for quantity, names in chosen.items() if len(names) == 1}
    for quantity, name in reading.columns.items():
        if quantity not in QUANTITIES:
            faults.append(f"{origin}: columns.{quantity}: there is no such quantity; known: {', '.join(QUANTITIES)}")
        elif name not in table.columns:
            faults.append(
                f"{origin}: columns.{quantity} = '{safe(name)}': the file has no such column; it has "
                f"{', '.join(safe(column) for column in list(table.columns)[:40])}"
            )
        else:
            wanted[quantity] = name
    faults += [
        f"{origin}: units.{quantity}: there is no column for it; known: {', '.join(wanted) or 'none'}"
        for quantity in reading.units
        if quantity not in wanted
    ]
    for quantity, name in wanted.items():
        numbers, unit = table.columns[name]
        unit = reading.units.get(quantity, unit)
        target = QUANTITIES[quantity].unit
        if unit is None or (unit.strip() == "" and target != "1"):
            faults.append(
                f"{origin}: column '{safe(name)}' has no unit; write it into its heading, '{safe(name)} [{target}]', "
                f"or give units = {{ {quantity} = '{target}' }}"
            )
            continue
        try:
            factor, offset, remark = conversion(unit, target)
        except QuantityError as error:
            faults.append(f"{origin}: unit of column '{safe(name)}': {error}")
            continue
        if remark:
            warnings.append(f"{origin}: unit of column '{safe(name)}': {remark}")
        values[quantity] = numbers * factor + offset
    if not values and not faults:
        faults.append(
            f"{origin}: no column is known; it has {', '.join(safe(column) for column in list(table.columns)[:40])}; "
            "name them with columns = { cn2 = '…' }"
        )
    if "cn2" in values:
        bad = values["cn2"] <= 0
        if bad.any():
            warnings.append(f"{origin}: {int(bad.sum())} values of Cn2 are zero or negative; they count as missing")
            values["cn2"] = np.where(bad, np.nan, values["cn2"])
    order = np.argsort(table.start, kind="stable")
    start, stop = table.start[order], table.stop[order]
    repeated = np.flatnonzero(np.diff(start) == 0)
    if repeated.size:
        faults.append(
            f"{origin}: {repeated.size} times are there twice, the first {_shown(int(start[repeated[0]]))}; in local "
            "time at the end of summer time, say timezone = 'UTC+1' or whatever the instrument kept"
        )
    if faults:
        raise SeriesError(faults)
    # A clock that was set, or an interval longer than a step: values do not count twice.
    stop[:-1] = np.minimum(stop[:-1], start[1:])
    kept = {quantity: np.asarray(value[order], dtype=np.float64) for quantity, value in values.items()}
    return TimeSeries(start, stop, kept, origin, tuple(warnings))


def _shown(nanoseconds: int) -> str:
    return f"{np.datetime64(nanoseconds, 'ns').astype('datetime64[s]')}Z"


# --- times -------------------------------------------------------------------------------------------------

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_FIXED = re.compile(r"^(?:UTC|GMT)\s*([+-])\s*(\d{1,2})(?::?(\d{2}))?$", re.IGNORECASE)


def _zone(name: str, origin: str) -> tzinfo:
    if match := _FIXED.match(name.strip()):
        minutes = 60 * int(match[2]) + int(match[3] or 0)
        return timezone(timedelta(minutes=-minutes if match[1] == "-" else minutes))
    try:
        return ZoneInfo(name)
    except (ValueError, OSError, KeyError) as error:
        raise SeriesError(
            [f"{origin}: timezone = '{safe(name)}': no such time zone; write 'Europe/Paris', 'UTC' or 'UTC+1'"]
        ) from error


def _nanoseconds(when: datetime) -> int:
    passed = when - _EPOCH
    return (passed.days * 86_400 + passed.seconds) * 1_000_000_000 + passed.microseconds * 1000


def _instants(texts: Sequence[str], zone: tzinfo | None, origin: str, first_line: int) -> NDArray[np.int64]:
    """ISO times as ns since 1970 UTC; the repeated hour at the end of summer time goes on where the one before ends."""
    found = np.empty(len(texts), dtype=np.int64)
    faults: list[str] = []
    before = -(2**62)
    for number, text in enumerate(texts):
        try:
            when = datetime.fromisoformat(text.strip())
        except ValueError:
            faults.append(
                f"{origin}: line {first_line + number}: '{safe(text)}' is no time; write '2012-09-14T12:15:00Z'"
            )
            continue
        if when.tzinfo is None:
            if zone is None:
                raise SeriesError(
                    [
                        f"{origin}: times like '{safe(text)}' have no time zone; add timezone = 'UTC' or the local "
                        "one, 'Europe/Paris'"
                    ]
                )
            early, late = (_nanoseconds(when.replace(tzinfo=zone, fold=fold)) for fold in (0, 1))
            found[number] = late if early <= before < late else early
        else:
            found[number] = _nanoseconds(when)
        before = int(found[number])
    if faults:
        raise SeriesError(faults[:5] + ([f"{origin}: and {len(faults) - 5} more"] if len(faults) > 5 else []))
    return found


def _intervals(stamps: NDArray[np.int64], reading: Reading, origin: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Start and end of each interval."""
    if reading.interval is not None:
        length = round(reading.interval * 1e9)
    else:
        steps = np.diff(np.sort(stamps))
        steps = steps[steps > 0]
        if not steps.size:
            raise SeriesError([f"{origin}: one time tells no interval; add interval = '1 min'"])
        sizes, counts = np.unique(steps, return_counts=True)
        length = int(sizes[np.argmax(counts)])
    before = {"start": 0, "middle": length // 2, "end": length}[reading.stamp or "start"]
    return stamps - before, stamps - before + length


# --- Scintec main data ---------------------------------------------------------------------------------------

_DURATION = re.compile(r"^P(?:(\d+)D)?T?(?:(\d+)H)?(?:(\d+)M)?(?:(\d+(?:\.\d+)?)S)?$")


def _duration(text: str) -> int | None:
    match = _DURATION.match(text)
    if match is None or not any(match.groups()):
        return None
    days, hours, minutes, seconds = (float(part or 0) for part in match.groups())
    return round((86_400 * days + 3600 * hours + 60 * minutes + seconds) * 1e9)


def _read_mnd(path: Path, origin: str, reading: Reading) -> _Table:
    """Scintec main data: four lines, header, `Main Data`, a line for each column, records separated by tabs."""
    lines = path.read_bytes().decode("latin-1").splitlines()
    if not lines or not lines[0].strip().startswith("FORMAT-1"):
        raise SeriesError([f"{origin}: the first line is no 'FORMAT-1.1'; this is no Scintec main data file"])
    if lines[0].strip() != "FORMAT-1.1":
        raise SeriesError([f"{origin}: format '{safe(lines[0].strip())}' is unknown; FORMAT-1.1 can be read"])
    try:
        count = int(lines[3].split()[1]) + 1  # the time is not counted
        at = next(number for number, line in enumerate(lines) if line.strip() == "Main Data") + 1
        heads = [line.split("#") for line in lines[at : at + count]]
        names = [head[1].strip() for head in heads]
        units = [head[2].strip() for head in heads]
    except (IndexError, ValueError, StopIteration) as error:
        raise SeriesError([f"{origin}: the header is damaged: it does not describe its columns"]) from error
    faults: list[str] = []
    warnings: list[str] = []
    records: list[list[str]] = []
    start: list[int] = []
    stop: list[int] = []
    last = len(lines) - 1
    for number in range(at + count, len(lines)):
        fields = lines[number].split("\t")
        if not lines[number].strip():
            continue
        interval = _mnd_interval(fields[0], origin, reading) if len(fields) == count else None
        if interval is not None:
            records.append(fields)
            start.append(interval[0])
            stop.append(interval[1])
        elif number == last:
            warnings.append(f"{origin}: the last record is incomplete; it is left out")
        else:
            faults.append(
                f"{origin}: line {number + 1}: {len(fields)} fields, of {count}, that begin with "
                f"'{safe(fields[0][:60])}'"
            )
    if not records and not faults:
        faults.append(f"{origin}: there are no records")
    columns: dict[str, tuple[NDArray[np.float64], str | None]] = {}
    for index, (name, unit) in enumerate(zip(names, units, strict=True)):
        if name in _MND or name in reading.columns.values():
            columns[name] = (numbers_of([record[index] for record in records], name, origin, faults), unit)
    if faults:
        raise SeriesError(faults[:5] + ([f"{origin}: and {len(faults) - 5} more"] if len(faults) > 5 else []))
    return _Table(np.array(start, dtype=np.int64), np.array(stop, dtype=np.int64), columns, _MND, warnings)


def _mnd_interval(text: str, origin: str, reading: Reading) -> tuple[int, int] | None:
    """duration/end or start/duration, as ISO 8601 has them."""
    first, _, second = text.partition("/")
    zone = None if reading.timezone is None else _zone(reading.timezone, origin)
    try:
        if (length := _duration(first)) is not None:
            end = int(_instants([second], zone, origin, 0)[0])
            return end - length, end
        if (length := _duration(second)) is not None:
            begin = int(_instants([first], zone, origin, 0)[0])
            return begin, begin + length
    except SeriesError:
        pass
    return None


def numbers_of(texts: Sequence[str], name: str, origin: str, faults: list[str]) -> NDArray[np.float64]:
    """Numbers of a column of text, NaN where there is none; what is no number is added to `faults`."""
    found = np.full(len(texts), np.nan)
    for number, text in enumerate(texts):
        if text.strip().lower() not in _MISSING:
            try:
                found[number] = float(text)
            except ValueError:
                comma = "; use a point as decimal sign" if re.fullmatch(r"\s*[+-]?\d+,\d+\s*", text) else ""
                faults.append(
                    f"{origin}: column '{safe(name)}', record {number + 1}: '{safe(text[:40])}' is no number{comma}"
                )
    found[~np.isfinite(found)] = np.nan
    return found


# --- CSV ---------------------------------------------------------------------------------------------------

_HEADING = re.compile(r"^\s*(.*?)\s*(?:\[(.*)\]|\((.*)\))?\s*$")
_TIMES = ("time", "timestamp", "datetime", "date_time", "date", "utc")


def _read_csv(path: Path, origin: str, reading: Reading) -> _Table:
    """A heading with `name [unit]` for each column, one of them the time; lines that begin with # are remarks."""
    raw = path.read_text("utf-8-sig").splitlines()
    kept = [(number + 1, line) for number, line in enumerate(raw) if line.strip() and not line.lstrip().startswith("#")]
    if len(kept) < 2:
        raise SeriesError([f"{origin}: a heading and at least one line of values are needed"])
    delimiter = max(",;\t", key=kept[0][1].count)
    heading, *body = csv.reader([line for _, line in kept], delimiter=delimiter)
    # A unit may hold brackets of its own: "Cn2 (m^(-2/3))".
    parts = [heading_of(cell) for cell in heading]
    names = [name for name, _ in parts]
    times = [index for index, name in enumerate(names) if name.lower() in _TIMES]
    if not times:
        raise SeriesError([f"{origin}: no column is called 'time'; it has {', '.join(safe(name) for name in names)}"])
    faults = [
        f"{origin}: line {line}: {len(row)} fields, but the heading has {len(names)}"
        + ("; is the decimal sign a comma?" if delimiter == "," and len(row) > len(names) else "")
        for (line, _), row in zip(kept[1:], body, strict=True)
        if len(row) != len(names)
    ]
    if faults:
        raise SeriesError(faults[:5] + ([f"{origin}: and {len(faults) - 5} more"] if len(faults) > 5 else []))
    # 'time (UTC)' says its zone where its values do not.
    named = reading.timezone or parts[times[0]][1]
    zone = _zone(named, origin) if named else None
    stamps = _instants([row[times[0]] for row in body], zone, origin, kept[1][0])
    start, stop = _intervals(stamps, reading, origin)
    columns = {}
    for index, (name, unit) in enumerate(parts):
        if index not in times and _is_wanted(name, reading):
            columns[name] = (numbers_of([row[index] for row in body], name, origin, faults), unit)
        elif index not in times:
            columns[name] = (np.full(len(body), np.nan), unit)
    if faults:
        raise SeriesError(faults[:5] + ([f"{origin}: and {len(faults) - 5} more"] if len(faults) > 5 else []))
    return _Table(start, stop, columns, {})


def heading_of(cell: str) -> tuple[str, str | None]:
    """Name and unit of a column headed `name [unit]` or `name (unit)`."""
    match = _HEADING.match(cell)
    assert match is not None  # the pattern matches anything
    unit = match[2] if match[2] is not None else match[3]
    return match[1], unit


def _is_wanted(name: str, reading: Reading) -> bool:
    return name in reading.columns.values() or _HEIGHT.sub("", name.strip().lower()) in _ALIASES


# --- NetCDF ------------------------------------------------------------------------------------------------


def _read_netcdf(path: Path, origin: str, reading: Reading) -> _Table:
    """Variables along `time`, with CF times and `units`."""
    import xarray as xr

    try:
        with xr.open_dataset(path, engine="netcdf4", decode_timedelta=False) as opened:
            dataset = opened.load()
    except (ImportError, ModuleNotFoundError) as error:
        raise SeriesError(
            [f"{origin}: NetCDF needs netCDF4; install it with pip install 'coslidar[netcdf]'"]
        ) from error
    except (OSError, ValueError) as error:
        raise SeriesError([f"{origin}: this is no NetCDF file that can be read: {safe(str(error))}"]) from error
    if "time" not in dataset or dataset["time"].dims != ("time",) or dataset["time"].dtype.kind != "M":
        raise SeriesError(
            [f"{origin}: there is no coordinate 'time' with CF units; it has {', '.join(map(str, dataset.dims))}"]
        )
    stamps = dataset["time"].values.astype("datetime64[ns]").astype(np.int64)
    if reading.timezone is not None:
        zone = _zone(reading.timezone, origin)
        stamps = _instants(
            [str(np.datetime64(int(stamp), "ns").astype("datetime64[us]")) for stamp in stamps], zone, origin, 0
        )
    start, stop = _intervals(stamps, reading, origin)
    if (
        reading.stamp is None
        and reading.interval is None
        and (bounds := dataset["time"].attrs.get("bounds")) in dataset
    ):
        start, stop = dataset[bounds].values.astype("datetime64[ns]").astype(np.int64).T.copy()
    columns: dict[str, tuple[NDArray[np.float64], str | None]] = {}
    for key, variable in dataset.data_vars.items():
        if variable.dims == ("time",) and variable.dtype.kind in "fiu":
            unit = variable.attrs.get("units")
            columns[str(key)] = (np.asarray(variable.values, dtype=np.float64), None if unit is None else str(unit))
    return _Table(start, stop, columns, {})
