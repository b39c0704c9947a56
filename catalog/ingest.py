"""Make a raw frame archive, format 1, of the files that a camera left.

Everything that can be known without the pixels is checked first, and every fault is told at once: the header file,
each source file, their shapes and types, the time stamps, dark, flat and bad pixels. Then the frames are streamed.
The archive appears at its place when it is whole. Until then it grows beside it (`ingest_resume`), and an ingest that
was interrupted goes on there: chunks that are complete are neither read nor converted again.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from glob import glob
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, field_validator, model_validator

from ..pipeline.parameters import Parameters, TimeZone
from ..pipeline.units import Duration, Frequency, QuantityError, faults, parse, safe, text
from .archive import FRAME_DTYPES, MAX_FRAME, Archive, Faults, check_boxes, check_header, check_time, open_archive
from .archive_codecs import MAX_CHUNK_BYTES
from .archive_writer import create_arrays, cut, replace
from .ingest_files import SUFFIXES, FileFault, FrameFile, Kind, Reading, open_file
from .ingest_resume import Partial, differences, discard, partial_folder, read_journal

#: Bytes of frames read at once.
BLOCK_BYTES = 32 * 2**20
#: Frames in a chunk of the archive, fewer where frames are large.
CHUNK_FRAMES = 256
#: Bytes of a chunk where frames are large.
CHUNK_BYTES = 64 * 2**20
#: Frames that are read at once where only some are looked at.
MEAN_FRAMES = 32
#: Units of numbers that are times -> nanoseconds.
UNITS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "day": 86400 * 10**9}

Progress = Callable[[str, int, int], None]


class IngestError(ValueError):
    """Input that cannot be made an archive; `faults` has one sentence each."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.faults,))


# --- the header file ---------------------------------------------------------------------------------------


class TimeParameters(Parameters):
    """Where the time stamps come from: exactly one of the first six."""

    start: str | None = None
    """Time of the first frame; the others follow at `rate`."""
    per_file: tuple[str, ...] | None = None
    """Time of the first frame of each file, in the order of the files."""
    pattern: str | None = None
    """The file's name with the time in it, as for strptime: ``"rec_%Y%m%dT%H%M%S.%f.fits"``."""
    keyword: str | None = None
    """Keyword (FITS), attribute (HDF5) or tag (TIFF) of each file with the time of its first frame."""
    dataset: str | None = None
    """Dataset, array, variable or table column in each file with one time for each of its frames."""
    file: str | None = None
    """Text file (one time per line) or ``.npy`` with one time per frame; relative to the header file."""
    rate: Frequency | None = Field(default=None, gt=0)
    """Frames per second between given times; `instrument.frame_rate` where it is absent."""
    unit: Literal["ns", "us", "ms", "s", "day"] | None = None
    """Unit of times that are numbers."""
    epoch: str = "1970-01-01T00:00:00Z"
    """Zero of times that are numbers; ``"1858-11-17T00:00:00Z"`` for modified Julian dates."""
    zone: TimeZone | None = None
    """Time zone of times that name none; those of FITS are UTC."""
    shift: Duration = Field(default="0 s")  # type: ignore[assignment]
    """Added to every time: minus the exposure, where a camera stamps its end."""

    @model_validator(mode="after")
    def _one(self) -> TimeParameters:
        given = [name for name in ("start", "per_file", "pattern", "keyword", "dataset", "file") if getattr(self, name)]
        if len(given) != 1:
            raise ValueError(
                f"{len(given)} ways to tell the time are given ({', '.join(given) or 'none'}); give one of start, "
                "per_file, pattern, keyword, dataset, file"
            )
        return self


Range = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)]]


class IngestParameters(Parameters):
    """Table ``[ingest]`` of a header file: how to read the source files."""

    time: TimeParameters
    """Time stamps."""
    format: Kind | None = None
    """Kind of the files; from the endings of their names where it is absent."""
    dataset: str | None = None
    """Dataset, array, variable or HDU with the frames; the only one where it is absent."""
    axes: tuple[Literal["time", "row", "col"], ...] = ("time", "row", "col")
    """Order of the axes of data in three dimensions, as stored."""
    rows: Range | None = None
    """Region of interest: first row, and the row after the last."""
    columns: Range | None = None
    """Region of interest: first column, and the column after the last."""
    dtype: Literal["uint8", "uint16", "int16", "float32"] | None = None
    """Type in the archive; where it is absent that of the files or, if the format has none such, the smallest that
    holds every value exactly, for which the files are read twice."""
    raw_dtype: str | None = None
    """Raw binary: type of a pixel, ``"<u2"``."""
    raw_shape: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = None
    """Raw binary: sizes of a frame as stored, slow axis first."""
    raw_offset: int = Field(default=0, ge=0)
    """Raw binary: bytes before the first frame of each file."""
    raw_gap: int = Field(default=0, ge=0)
    """Raw binary: bytes between frames."""
    dark: str | None = None
    """File with the dark frame; a series of darks is averaged. Relative to the header file, as the next two."""
    flat: str | None = None
    """File with the relative response, mean 1; a series is averaged."""
    bad_pixel: str | None = None
    """File that is not zero where a pixel must not be used."""

    @field_validator("axes")
    @classmethod
    def _all_axes(cls, axes: tuple[str, ...]) -> tuple[str, ...]:
        if sorted(axes) != ["col", "row", "time"]:
            raise ValueError("name 'time', 'row' and 'col' once each, in the order in which they are stored")
        return axes

    @field_validator("rows", "columns")
    @classmethod
    def _ordered(cls, value: Range | None) -> Range | None:
        if value is not None and value[0] >= value[1]:
            raise ValueError("the end must be larger than the start; [0, 160] are the first 160")
        return value

    @field_validator("raw_dtype")
    @classmethod
    def _numbers(cls, value: str | None) -> str | None:
        if value is not None:
            try:
                dtype = np.dtype(value)
            except (TypeError, ValueError, SyntaxError) as error:
                raise ValueError(
                    "no such type; write '<u2' for little-endian 16-bit counts, '>u2', 'u1', '<f4'"
                ) from error
            if dtype.kind not in "iuf" or dtype.shape:
                raise ValueError("counts are whole or floating-point numbers: '<u2', 'u1', '<i4', '<f4'")
        return value

    def reading(self) -> Reading:
        """How to read one file."""
        return Reading(
            self.format, self.dataset, self.axes, self.raw_dtype, self.raw_shape, self.raw_offset, self.raw_gap
        )  # fmt: skip


def read_header(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a header file without judging its content.

    Parameters
    ----------
    path : Path
        TOML or (``.json``) JSON: the attributes of an archive, and a table ``ingest``.

    Returns
    -------
    attributes, ingest : dict
        The two parts; ``ingest`` is empty where there is no such table.

    Raises
    ------
    IngestError
        The file is missing or cannot be parsed.
    """
    origin = safe(str(path))
    try:
        content = path.read_bytes().decode("utf-8")
        table = json.loads(content) if path.suffix.lower() == ".json" else tomllib.loads(content)
    except OSError as error:
        raise IngestError(
            [f"{origin}: cannot be read ({error.strerror}); 'docs/ingest.md' shows a header file"]
        ) from error
    except (ValueError, RecursionError) as error:  # both decoders and UTF-8
        kind = "JSON" if path.suffix.lower() == ".json" else "TOML"
        raise IngestError([f"{origin}: this is no {kind} file: {error}"]) from error
    if not isinstance(table, dict):
        raise IngestError([f"{origin}: a header file is a table of keys, this is a {type(table).__name__}"])
    table = _plain(table)
    ingest = table.pop("ingest", {})
    if not isinstance(ingest, dict):
        raise IngestError([f"{origin}: ingest = {ingest!r}: it must be a table"])
    return table, ingest


def _plain(value: Any) -> Any:
    """Dates of TOML as the text that an archive's attributes hold."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return value.isoformat() if isinstance(value, (datetime, date)) else value


# --- source files ------------------------------------------------------------------------------------------


def _natural(name: str) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", name)]


def find_sources(sources: Iterable[str], *, given_order: bool = False) -> list[Path]:
    """Files that sources name: patterns in natural order (``frame_2`` before ``frame_10``), others as they stand.

    Parameters
    ----------
    sources : iterable of str
        Paths and patterns.
    given_order : bool
        The order of paths is meant, also where it looks like that of a shell.

    Returns
    -------
    list of Path

    Raises
    ------
    IngestError
        A pattern matches nothing, a file is named twice, or the files stand in the order in which a shell lists
        them (``frame_10`` before ``frame_2``), which is not that of the frames.
    """
    found: list[str] = []
    wrong = []
    plain: list[str] = []
    for source in sources:
        if os.path.lexists(source) or not any(character in source for character in "*?["):
            found.append(source)
            plain.append(source)
            continue
        matches = sorted(glob(source, recursive=True), key=_natural)
        if not matches:
            wrong.append(f"{safe(source)}: no file matches this pattern")
        found += matches
    if len(set(found)) != len(found):
        twice = next(name for name in found if found.count(name) > 1)
        wrong.append(f"{safe(twice)}: this file is named twice")
    if not given_order and plain == sorted(plain) != sorted(plain, key=_natural):
        late, early = next((a, b) for a, b in zip(plain, sorted(plain, key=_natural), strict=True) if a != b)
        wrong.append(
            f"command line: {safe(late)} comes before {safe(early)}: this is the alphabet's order, not that of the "
            "numbers; put the pattern in quotes, and it is put in order here, or say --given-order if it is meant"
        )
    if not found and not wrong:
        wrong.append("command line: no source file is given")
    if wrong:
        raise IngestError(wrong)
    return [Path(name) for name in found]


def open_sources(sources: Sequence[Path], reading: Reading, wrong: list[str]) -> list[FrameFile]:
    """Look at every file; those that cannot be used are told in `wrong`."""
    files: list[FrameFile] = []
    for path in sources:
        try:
            files.append(open_file(path, reading))
        except (FileFault, OSError) as error:
            wrong.append(safe(f"{path}: {error}"))
    if files:
        first = files[0]
        for file in files[1:]:
            if (file.frame_shape, file.dtype) != (first.frame_shape, first.dtype):
                wrong.append(
                    safe(
                        f"{file.path}: frames of {file.dtype.name} {list(file.frame_shape)}, but those of "
                        f"{first.path.name} are {first.dtype.name} {list(first.frame_shape)}; "
                        "one archive is one recording"
                    )
                )
    return files


# --- time --------------------------------------------------------------------------------------------------

_INSTANT = re.compile(r"(\d{4}-\d\d-\d\d)(?:[T ](\d\d:\d\d(?::\d\d)?)(?:\.(\d{1,12}))?)?\s*(Z|UTC|[+-]\d\d:?\d\d)?")


def instant(value: str, zone: str | None = None) -> int:
    """Nanoseconds since 1970-01-01T00:00:00 UTC of a written time.

    Parameters
    ----------
    value : str
        ``2012-09-14T12:15:00.123456789Z``, or with ``+02:00``, or with neither where `zone` is given.
    zone : str, optional
        Time zone of a time that names none.

    Returns
    -------
    int

    Raises
    ------
    FileFault
        It is no time, or of no known zone.
    """
    match = _INSTANT.fullmatch(value.strip())
    if match is None:
        raise FileFault(f"{value!r} is no time; write 2012-09-14T12:15:00Z")
    day, clock, fraction, offset = match.groups()
    try:
        moment = datetime.fromisoformat(f"{day}T{clock or '00:00'}")
    except ValueError as error:
        raise FileFault(f"{value!r} is no time ({error})") from error
    if offset is None and zone is None:
        raise FileFault(f"{value!r} names no time zone; append Z if it is UTC, or set ingest.time.zone")
    if offset is None:
        moment = moment.replace(tzinfo=ZoneInfo(str(zone)))
    elif offset in ("Z", "UTC"):
        moment = moment.replace(tzinfo=UTC)
    else:
        moment = datetime.fromisoformat(f"{moment.isoformat()}{offset}")
    seconds = moment - datetime(1970, 1, 1, tzinfo=UTC)
    whole = (seconds.days * 86400 + seconds.seconds) * 10**9 + int((fraction or "0")[:9].ljust(9, "0"))
    if not -(2**63) <= whole < 2**63:
        raise FileFault(f"{value!r} is beyond the times that an archive can hold (1678 to 2262)")
    return whole


def _instants(values: Any, parameters: TimeParameters, zone: str | None) -> NDArray[np.int64]:
    """Nanoseconds of times that are text, or numbers in the unit and from the epoch of the parameters."""
    values = np.asarray(values).reshape(-1)
    if values.dtype.kind in "SUO":
        written = [item.decode() if isinstance(item, bytes) else str(item) for item in values.tolist()]
        if all(re.fullmatch(r"[+-]?\d+", item.strip()) for item in written):
            values = np.array([int(item) for item in written])
        else:
            try:
                values = np.array([float(item) for item in written])
            except ValueError:
                return np.array([instant(item, zone) for item in written], np.int64)
    if values.dtype.kind == "M":
        return np.asarray(values.astype("datetime64[ns]").astype(np.int64))
    if parameters.unit is None:
        raise FileFault("the times are numbers; say their unit with ingest.time.unit: ns, us, ms, s or day")
    factor, zero = UNITS[parameters.unit], instant(parameters.epoch)
    # A file's integers may be unsigned, and whole nanoseconds do not fit a float: split before multiplying.
    if values.dtype.kind in "iu":
        exact = [int(value) * factor + zero for value in values.tolist()]
    elif values.dtype.kind == "f" and np.isfinite(values).all():
        wide = values.astype(np.longdouble)
        whole = np.floor(wide)
        rest = np.rint((wide - whole) * factor)
        exact = [int(w) * factor + int(r) + zero for w, r in zip(whole.tolist(), rest.tolist(), strict=True)]
    else:
        raise FileFault(f"times of type {values.dtype} that are not all finite numbers")
    if any(not -(2**63) <= value < 2**63 for value in (min(exact, default=0), max(exact, default=0))):
        raise FileFault(f"in unit {parameters.unit} they lie beyond the years 1678 to 2262; correct unit or epoch")
    return np.array(exact, np.int64)


def _times(
    files: Sequence[FrameFile],
    parameters: TimeParameters,
    rate: float | None,
    folder: Path,
    origin: str,
    wrong: list[str],
) -> NDArray[np.int64] | None:
    """Time of every frame; None, with the faults told, if they cannot be made."""
    total = sum(file.n_frames for file in files)
    before = len(wrong)

    def say(place: str, error: Exception) -> None:
        wrong.append(safe(f"{place}: ingest.time: {error}"))

    def paced(start: int, count: int) -> NDArray[np.int64]:
        if count == 1:
            return np.array([start], np.int64)
        if rate is None:
            raise FileFault("the frame rate is missing: write instrument.frame_rate, or ingest.time.rate")
        steps: NDArray[np.int64] = np.rint(np.arange(count) * (1e9 / rate)).astype(np.int64)
        return start + steps

    parts: list[NDArray[np.int64]] = []
    try:
        if parameters.start is not None:
            parts = [paced(instant(parameters.start, parameters.zone), total)]
        elif parameters.file is not None:
            parts = [_listed(folder / parameters.file, parameters, total)]
        elif parameters.per_file is not None and len(parameters.per_file) != len(files):
            raise FileFault(f"per_file lists {len(parameters.per_file)} times, but there are {len(files)} files")
        else:
            for number, file in enumerate(files):
                try:
                    parts.append(_of_file(file, number, parameters, paced))
                except (FileFault, OSError) as error:
                    say(str(file.path), error)
    except (FileFault, OSError) as error:
        say(origin, error)
    if len(wrong) > before or not parts:
        return None
    return np.concatenate(parts) + round(parameters.shift * 1e9)


def _of_file(
    file: FrameFile, number: int, parameters: TimeParameters, paced: Callable[[int, int], NDArray[np.int64]]
) -> NDArray[np.int64]:
    zone = parameters.zone or ("UTC" if file.kind == "fits" else None)
    if parameters.dataset is not None:
        found = _instants(file.array(parameters.dataset), parameters, zone)
        if len(found) != file.n_frames:
            raise FileFault(f"{parameters.dataset} holds {len(found)} times for {file.n_frames} frames")
        return found
    if parameters.keyword is not None:
        value = file.keyword(parameters.keyword)
        try:
            start = int(_instants([value], parameters, zone)[0])
        except FileFault as error:
            raise FileFault(f"{parameters.keyword} = {value!r}: {error}") from error
    elif parameters.pattern is not None:
        try:
            moment = datetime.strptime(file.path.name, parameters.pattern)
        except (ValueError, re.error) as error:
            raise FileFault(f"pattern = {parameters.pattern!r} does not fit the name of this file: {error}") from error
        start = instant(moment.isoformat(), parameters.zone)
    else:
        assert parameters.per_file is not None
        start = instant(parameters.per_file[number], parameters.zone)
    return paced(start, file.n_frames)


def _listed(path: Path, parameters: TimeParameters, total: int) -> NDArray[np.int64]:
    if path.suffix.lower() == ".npy":
        try:
            values = np.load(path, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise FileFault(f"{path}: this is no .npy file of times ({error})") from error
    else:
        lines = [line.split("#")[0].strip() for line in path.read_text("utf-8", errors="replace").splitlines()]
        # The time is the first column; a space may stand inside a written time.
        values = np.array([re.split(r"[,;\t]", line)[0].strip() for line in lines if line])
    if np.size(values) != total:
        raise FileFault(f"{path} holds {np.size(values)} times for {total} frames")
    return _instants(values, parameters, parameters.zone)


# --- the plan ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Plan:
    """An archive that can be made: everything but the pixels.

    Parameters
    ----------
    attributes : dict
        Header of the archive.
    files : tuple of FrameFile
        The source files, in order.
    time : ndarray of int64
        (time,), ns.
    region : tuple of slice
        Rows and columns that are kept.
    dtype : numpy.dtype or None
        Type in the archive; None if the pixels must tell.
    planes : dict
        dark, flat, bad_pixel, as far as they are given.
    fingerprint : str
        The same for the same sources and header.
    inputs : list of [str, int, int]
        Path, bytes and time of the last change (ns) of each source file.
    """

    attributes: dict[str, Any]
    files: tuple[FrameFile, ...]
    time: NDArray[np.int64] = field(repr=False)
    region: tuple[slice, slice]
    dtype: np.dtype[Any] | None
    planes: dict[str, NDArray[Any]] = field(repr=False)
    fingerprint: str
    inputs: list[list[Any]] = field(repr=False)

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.time)

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(rows, cols) of a frame of the archive."""
        rows, cols = (piece.stop - piece.start for piece in self.region)
        return rows, cols

    @property
    def source_dtype(self) -> np.dtype[Any]:
        """Type of the source files."""
        return self.files[0].dtype.newbyteorder("=")

    def blocks(self, start: int = 0, stop: int | None = None) -> Iterator[NDArray[Any]]:
        """Frames of the region in blocks, as they are stored.

        Parameters
        ----------
        start, stop : int
            First frame, and the one after the last; all of them by default. Files with none of them are not opened.

        Raises
        ------
        IngestError
            A file cannot be read.
        """
        stored = math.prod(self.files[0].frame_shape) * self.source_dtype.itemsize
        stop = self.n_frames if stop is None else stop
        before = 0
        for file in self.files:
            first, last = max(start - before, 0), min(stop - before, file.n_frames)
            before += file.n_frames
            if first >= last:
                continue
            try:
                for block in file.blocks(max(BLOCK_BYTES // stored, 1), start=first, stop=last):
                    yield block[:, self.region[0], self.region[1]]
            except (FileFault, OSError) as error:
                raise IngestError([safe(f"{file.path}: {error}")]) from error


@dataclass(frozen=True)
class Survey:
    """What the pixels hold.

    Parameters
    ----------
    dtype : str
        Type in the archive.
    low, high : float
        Smallest and largest count.
    not_finite : int
        Pixels that are not finite.
    at_top : int
        Pixels at the highest value, in all frames: many of them are saturation.
    """

    dtype: str
    low: float
    high: float
    not_finite: int
    at_top: int


def plan_ingest(
    sources: Sequence[Path],
    header_file: Path,
    *,
    changes: Mapping[str, Any] | None = None,
    archive: str | None = None,
) -> Plan:
    """Look at everything but the pixels.

    Parameters
    ----------
    sources : sequence of Path
        Files of frames, in order.
    header_file : Path
        Attributes and table ``ingest``, see :func:`read_header`.
    changes : mapping, optional
        Keys of the table ``ingest`` that replace those of the file; a mapping replaces its own keys only.
    archive : str, optional
        Name of the archive instead of the header's.

    Returns
    -------
    Plan

    Raises
    ------
    IngestError
        With every fault of header, files, times and calibration.
    """
    origin = safe(str(header_file))
    table, given = read_header(header_file)
    for key, value in (changes or {}).items():
        below = given.get(key)
        given[key] = {**below, **value} if isinstance(below, dict) and isinstance(value, dict) else value
    if changes and changes.get("time"):
        # A way to tell the time on the command line stands for that of the file.
        kept = ("rate", "unit", "epoch", "zone", "shift")
        before = given["time"]
        given["time"] = {key: value for key, value in before.items() if key in changes["time"] or key in kept}
    attributes = {"format": "shwfs-frames", "format_version": 1, **table}
    if archive is not None:
        attributes["archive"] = archive
    fault = Faults(origin)
    check_header(attributes, fault)
    wrong: list[str] = []
    try:
        parameters, timed = IngestParameters.model_validate(given), True
    except ValidationError as error:
        wrong += _ingest_faults(error, origin)
        parameters, timed = _usable(given)
    told = len(wrong)
    files = open_sources(sources, parameters.reading(), wrong)
    if not files:
        # Without files nothing that follows can be judged.
        raise IngestError(_distinct([*fault.sentences, *wrong]))
    rate = parameters.time.rate
    if rate is None:
        rate = _rate(attributes)
    time = None
    # Where files are missing, so are their times; only a start does not depend on them.
    if timed and (len(wrong) == told or parameters.time.start is not None):
        time = _times(files, parameters.time, rate, header_file.parent, origin, wrong)
        if time is not None and len(files) == len(sources):
            check_time(time, attributes, fault)
    region = _region(parameters, files[0].frame_shape, origin, wrong)
    shape = (region[0].stop - region[0].start, region[1].stop - region[1].start)
    if max(shape) > MAX_FRAME:
        wrong.append(
            f"{origin}: a frame of {shape[0]} x {shape[1]} pixels is larger than {MAX_FRAME} x {MAX_FRAME}; keep a "
            "part of it with ingest.rows and ingest.columns"
        )
    check_boxes(attributes, shape, fault)
    planes = _planes(parameters, files[0].frame_shape, region, header_file.parent, wrong)
    source = files[0].dtype.newbyteorder("=")
    dtype = np.dtype(parameters.dtype) if parameters.dtype else source if source.name in FRAME_DTYPES else None
    if fault.sentences or wrong:
        raise IngestError(_distinct([*fault.sentences, *wrong]))
    assert time is not None
    inputs = _inputs(files)
    fingerprint = _fingerprint(attributes, parameters, inputs, planes, time)
    attributes["ingest"] = {
        "files": len(files),
        "first_file": files[0].path.name[:1000],
        "last_file": files[-1].path.name[:1000],
        "rows": [region[0].start, region[0].stop],
        "columns": [region[1].start, region[1].stop],
        "source_dtype": source.name,
        "fingerprint": fingerprint,
    }
    return Plan(attributes, tuple(files), time, region, dtype, planes, fingerprint, inputs)


def _distinct(sentences: list[str]) -> list[str]:
    kept = list(dict.fromkeys(sentences))
    return kept if len(kept) <= 50 else [*kept[:50], f"and {len(kept) - 50} more faults"]


def _ingest_faults(error: ValidationError, origin: str) -> list[str]:
    found = []
    for sentence, fault in zip(faults(error, origin, "ingest"), error.errors(include_url=False), strict=True):
        if fault["type"] == "missing" and fault["loc"] == ("time",):
            sentence = (
                f"{origin}: ingest.time is missing; say where the time stamps come from, for example "
                '[ingest.time] start = "2012-09-14T12:15:00Z"'
            )
        found.append(sentence)
    return found


def _usable(given: Mapping[str, Any]) -> tuple[IngestParameters, bool]:
    """As much of the table as is right, so that what else is wrong is told with it; and whether its time is."""
    good: dict[str, Any] = {"time": {"start": "2000-01-01T00:00:00Z"}}
    timed = False
    for key, value in given.items():
        try:
            IngestParameters.model_validate({**good, key: value})
        except ValidationError:
            continue
        good[key] = value
        timed = timed or key == "time"
    return IngestParameters.model_validate(good), timed


def _rate(attributes: Mapping[str, Any]) -> float | None:
    try:
        return parse(attributes["instrument"]["frame_rate"], "Hz") or None
    except (KeyError, TypeError, QuantityError):
        return None  # told with the header


def _region(parameters: IngestParameters, shape: tuple[int, int], origin: str, wrong: list[str]) -> tuple[slice, slice]:
    pieces = []
    for name, wanted, size in (("rows", parameters.rows, shape[0]), ("columns", parameters.columns, shape[1])):
        if wanted is not None and wanted[1] > size:
            wrong.append(f"{origin}: ingest.{name} = {list(wanted)}: the frames have {size} {name}")
            wanted = None
        pieces.append(slice(*wanted) if wanted is not None else slice(0, size))
    return pieces[0], pieces[1]


def _planes(
    parameters: IngestParameters, full: tuple[int, int], region: tuple[slice, slice], folder: Path, wrong: list[str]
) -> dict[str, NDArray[Any]]:
    planes: dict[str, NDArray[Any]] = {}
    shape = (region[0].stop - region[0].start, region[1].stop - region[1].start)
    for name in ("dark", "flat", "bad_pixel"):
        given = getattr(parameters, name)
        if given is None:
            continue
        path = folder / given
        try:
            # The frames' own dataset and raw layout need not be those of a file beside them.
            file = open_file(path, Reading(axes=parameters.axes, dtype=parameters.raw_dtype, shape=parameters.raw_shape,
                                           offset=parameters.raw_offset, gap=parameters.raw_gap))  # fmt: skip
            if name == "bad_pixel" and file.n_frames != 1:
                raise FileFault(f"it holds {file.n_frames} frames; bad pixels are one image")
            if file.frame_shape not in (full, shape):
                raise FileFault(f"it is {list(file.frame_shape)}, but the frames are {list(full)}")
            plane = _mean(file)
        except (FileFault, OSError) as error:
            wrong.append(safe(f"{path}: ingest.{name}: {error}"))
            continue
        if plane.shape == full:
            plane = plane[region]
        planes[name] = plane != 0 if name == "bad_pixel" else plane.astype(np.float32)
    return planes


def _mean(file: FrameFile) -> NDArray[np.float64]:
    total = np.zeros(file.frame_shape)
    for block in file.blocks(max(BLOCK_BYTES // (math.prod(file.frame_shape) * 8), 1)):
        total += block.sum(axis=0, dtype=np.float64)
    return total / file.n_frames


def _inputs(files: Sequence[FrameFile]) -> list[list[Any]]:
    found = []
    for file in files:
        known = file.path.stat()
        found.append([str(file.path.absolute()), known.st_size, known.st_mtime_ns])
    return found


def _fingerprint(
    attributes: Mapping[str, Any],
    parameters: IngestParameters,
    inputs: Sequence[Sequence[Any]],
    planes: Mapping[str, NDArray[Any]],
    time: NDArray[np.int64],
) -> str:
    digest = hashlib.sha256(json.dumps([attributes, parameters.model_dump(mode="json")], sort_keys=True).encode())
    for path, size, modified in inputs:
        # Where the files lie may differ: the same recording on another machine.
        digest.update(f"{Path(path).name}\0{size}\0{modified}\n".encode())
    for name, plane in sorted(planes.items()):
        digest.update(name.encode() + np.ascontiguousarray(plane).tobytes())
    digest.update(time.astype("<i8").tobytes())
    return digest.hexdigest()


# --- pixels ------------------------------------------------------------------------------------------------


def survey(plan: Plan, progress: Progress | None = None) -> Survey:
    """Read every pixel: their range, and the type that holds them exactly.

    Parameters
    ----------
    plan : Plan
        What to read.
    progress : callable, optional
        Called with ("reading", frames done, frames in all).

    Returns
    -------
    Survey

    Raises
    ------
    IngestError
        A file cannot be read, or no type of the format holds what is in them.
    """
    low, high, whole, single, not_finite, at_top = math.inf, -math.inf, True, True, 0, 0
    done = 0
    for block in plan.blocks():
        done += len(block)
        if progress is not None:
            progress("reading", done, plan.n_frames)
        good = np.isfinite(block) if block.dtype.kind == "f" else None
        values = block if good is None else block[good]
        not_finite += block.size - values.size
        if not values.size:
            continue
        top = values.max().item()
        low, at_top = min(low, values.min().item()), at_top * (top <= high) + int(np.sum(values == top)) * (top >= high)
        high = max(high, top)
        if block.dtype.kind == "f":
            whole = whole and bool(np.all(values == np.rint(values)))
            single = single and _exact(values, np.dtype(np.float32))
        elif block.dtype.kind in "iu" and block.dtype.itemsize > 2:
            single = single and _exact(values, np.dtype(np.float32))
    if plan.dtype is not None:
        return Survey(plan.dtype.name, low, high, not_finite, at_top)
    if whole and not not_finite:
        for name in ("uint16", "int16"):
            if np.iinfo(name).min <= low and high <= np.iinfo(name).max:
                return Survey(name, low, high, not_finite, at_top)
    if single and math.isfinite(low):
        return Survey("float32", low, high, not_finite, at_top)
    if not math.isfinite(low):
        raise IngestError([f"{plan.files[0].path}: no pixel is a finite number"])
    kind = "whole numbers" if whole else "fractions"
    raise IngestError(
        [
            safe(
                f"{plan.files[0].path}: the frames are {plan.source_dtype.name}, {kind} from {low:g} to {high:g}, and "
                f"no type of the format ({', '.join(FRAME_DTYPES)}) holds them exactly; nothing is rounded here: if a "
                "relative error of 6e-8 does not matter, save them as float32, or scale them back to the detector's "
                "counts"
            )
        ]
    )


def _exact(values: NDArray[Any], dtype: np.dtype[Any]) -> bool:
    """Whether `dtype` holds every value exactly; what is not a number stays that."""
    if dtype.kind in "iu":
        if values.dtype.kind == "f" and not (np.isfinite(values).all() and (values == np.rint(values)).all()):
            return False
        bounds = np.iinfo(dtype)
        return not values.size or (bounds.min <= values.min().item() and values.max().item() <= bounds.max)
    if values.dtype.kind in "iub" and (not values.size or (values.min() >= -(2**24) and values.max() <= 2**24)):
        return True
    with np.errstate(over="ignore"):
        there = values.astype(dtype)
    # A double holds everything but 64-bit integers, and floats that are wider still.
    wide = np.float64 if values.dtype.itemsize <= (8 if values.dtype.kind == "f" else 4) else np.longdouble
    same = there.astype(wide) == values.astype(wide)
    return bool(np.all(same | ((values != values) & (there != there))))


class _InexactError(IngestError):
    """The wanted type does not hold the pixels: nothing that was written is of use."""


def _converted(plan: Plan, dtype: np.dtype[Any], start: int, stop: int) -> Iterator[NDArray[Any]]:
    for block in plan.blocks(start, stop):
        if block.dtype != dtype:
            if not _exact(block, dtype):
                finite = block[np.isfinite(block)] if block.dtype.kind == "f" else block
                span = f"{finite.min():g} to {finite.max():g}" if finite.size else "nothing finite"
                raise _InexactError(
                    [
                        f"frames {start} to {start + len(block) - 1}: {block.dtype.name} values ({span}) are not all "
                        f"exact in {dtype.name}; leave ingest.dtype out to have a type chosen"
                    ]
                )
            block = block.astype(dtype)
        yield block
        start += len(block)


def chunk_frames(frame_shape: tuple[int, int], dtype: np.dtype[Any], wanted: int | None = None) -> int:
    """Frames in a chunk of the archive.

    Raises
    ------
    IngestError
        More are wanted than the format allows.
    """
    frame = math.prod(frame_shape) * dtype.itemsize
    if wanted is None:
        return max(1, min(CHUNK_FRAMES, CHUNK_BYTES // frame))
    if not 1 <= wanted <= MAX_CHUNK_BYTES // frame:
        raise IngestError(
            [f"--chunk-frames = {wanted}: a chunk must hold 1 to {MAX_CHUNK_BYTES // frame} frames of {frame} bytes"]
        )
    return wanted


def ingest(
    plan: Plan,
    output: Path,
    *,
    codec: Literal["lz4", "zstd"] = "lz4",
    chunk: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> Archive:
    """Write the archive, or what is missing of it since an interruption.

    Parameters
    ----------
    plan : Plan
        What to write.
    output : Path
        Folder, or a file where the name ends in ``.zip``.
    codec : {"lz4", "zstd"}
        Compressor: quick, or small.
    chunk : int, optional
        Frames in a chunk.
    overwrite : bool
        Replace what is there.
    progress : callable, optional
        Called with ("reading" or "writing", frames done, frames in all).
    tell : callable, optional
        Called with a sentence on what an interrupted ingest has left: whether it is continued, or why not.

    Returns
    -------
    Archive
        The archive as it was read back. One that the same sources and header have made before is left as it is.

    Raises
    ------
    IngestError
        There is something else at `output`, a file cannot be read or has changed meanwhile, or a value has no exact
        place in the type.
    OSError
        The disk is full, or does not answer; what is complete is kept.
    """
    folder = partial_folder(output)
    if not overwrite and not folder.exists() and (made := made_before(plan, output)) is not None:
        return made
    with _alone(output):
        replaced = folder / "replaced"
        if os.path.lexists(replaced) and not os.path.lexists(output):
            os.rename(replaced, output)  # killed between the two steps of putting one folder in place of another
        if overwrite or made_before(plan, output) is None:
            try:
                partial = _grown(plan, output, codec, chunk, progress, tell or (lambda sentence: None))
            except _InexactError:
                discard(folder)
                raise
            finished = partial.finished(output.suffix == ".zip")
            if not overwrite:
                made_before(plan, output)
            replace(finished, output, replaced)
        discard(folder)
    return open_archive(output)


def _grown(
    plan: Plan,
    output: Path,
    codec: Literal["lz4", "zstd"],
    chunk: int | None,
    progress: Progress | None,
    tell: Callable[[str], None],
) -> Partial:
    """The whole archive, in the folder beside its place."""
    import zarr
    from zarr.storage import LocalStore

    folder = partial_folder(output)
    made_of: dict[str, Any] = {
        "inputs": plan.inputs,
        "fingerprint": plan.fingerprint,
        # Other versions may write other bytes.
        "versions": {name: version(name) for name in ("coslidar", "zarr", "numcodecs")},
    }
    before = read_journal(folder)
    dtype = plan.dtype
    if dtype is None and before is not None and not differences(before.made_of, made_of):
        dtype = np.dtype(before.made_of["dtype"])  # that every frame was read for
    elif dtype is None:
        dtype = np.dtype(survey(plan, progress).dtype)
    length = min(chunk_frames(plan.frame_shape, dtype, chunk), plan.n_frames)
    made_of |= {"dtype": dtype.name, "chunk_frames": length, "codec": codec}
    n_chunks = -(-plan.n_frames // length)
    partial = Partial(folder, made_of)

    changed = [] if before is None else differences(before.made_of, made_of)
    damaged = None if before is None or changed else partial.go_on(before)
    if damaged is None:
        if folder.exists():
            why = "; ".join(changed) or "it had not come to the frames, or is damaged"
            tell(safe(f"{output}: what an interrupted ingest has left is not used, all begins anew ({why})"))
        partial.begin(
            lambda path: create_arrays(
                LocalStore(path), plan.attributes, plan.time, plan.frame_shape, dtype, plan.planes, length, codec
            )
        )
    else:
        again = f"; damaged and made again: {damaged}" if damaged else ""
        tell(
            safe(
                f"{output}: goes on where an interrupted ingest stopped, with {len(partial.chunks)} of "
                f"{n_chunks} chunks complete{again}"
            )
        )

    # Chunks of nothing but zeros are written as well; an array that is opened has forgotten that.
    with zarr.config.set({"array.write_empty_chunks": True}):
        stored = zarr.open_array(LocalStore(partial.archive), path="frames", mode="r+")
    runs = partial.missing(n_chunks)
    done = plan.n_frames - sum(min(end * length, plan.n_frames) - first * length for first, end in runs)
    if done and progress is not None:
        progress("writing", done, plan.n_frames)
    for first, end in runs:
        start, stop = first * length, min(end * length, plan.n_frames)
        blocks = _converted(plan, dtype, start, stop)
        for offset, frames in cut(next(blocks), blocks, stop - start, length):
            stored[start + offset : start + offset + len(frames)] = frames
            partial.complete((start + offset) // length)
            done += len(frames)
            if progress is not None:
                progress("writing", done, plan.n_frames)
    try:
        changed = differences(made_of, {"inputs": _inputs(plan.files), "fingerprint": plan.fingerprint})
    except OSError as error:
        changed = [str(error)]
    if changed:
        raise IngestError(
            [safe(f"{name} while it was read; run the command again when it is complete") for name in changed]
        )
    return partial


def made_before(plan: Plan, output: Path) -> Archive | None:
    """The archive, if the same sources and header have made it before.

    Parameters
    ----------
    plan : Plan
        What is to be written.
    output : Path
        Where.

    Returns
    -------
    Archive or None
        None where there is nothing.

    Raises
    ------
    IngestError
        There is something else.
    """
    if not os.path.lexists(output):
        return None
    try:
        archive = open_archive(output)
        made = archive.attributes.get("ingest")
        if isinstance(made, dict) and made.get("fingerprint") == plan.fingerprint:
            return archive
    except (ValueError, OSError):
        pass  # whatever it is, it is not what these sources make
    raise IngestError([f"{safe(str(output))} is there already and is not of these sources; replace it with --force"])


@contextmanager
def _alone(output: Path) -> Iterator[None]:
    """Keep other ingests of the same archive out."""
    import fcntl

    output.parent.mkdir(parents=True, exist_ok=True)
    lock = output.parent / f".{output.name}.ingest"
    handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise IngestError([f"{safe(str(output))}: another ingest is writing this archive"]) from error
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
    finally:
        os.close(handle)


def describe(plan: Plan, found: Survey | None, output: Path, chunk: int | None = None) -> dict[str, Any]:
    """What would be written, as plain values.

    Parameters
    ----------
    plan : Plan
        The plan.
    found : Survey or None
        What the pixels hold, if they were read.
    output : Path
        Where it would go.
    chunk : int, optional
        Frames in a chunk.

    Returns
    -------
    dict
    """
    time = plan.time
    dtype = np.dtype(found.dtype) if found is not None else plan.dtype
    files = plan.files
    step = float(np.median(np.diff(time)))
    described: dict[str, Any] = {
        "output": str(output),
        "campaign": plan.attributes["campaign"],
        "archive": plan.attributes["archive"],
        "files": len(files),
        "first_file": str(files[0].path),
        "last_file": str(files[-1].path),
        "kind": files[0].kind,
        "stored": f"{' '.join(files[0].axes)} = {list(files[0].stored)} {files[0].dtype.name}",
        "frames": plan.n_frames,
        "frame_shape": list(plan.frame_shape),
        "rows": [plan.region[0].start, plan.region[0].stop],
        "columns": [plan.region[1].start, plan.region[1].stop],
        "dtype": None if dtype is None else dtype.name,
        "start": f"{np.datetime64(int(time[0]), 'ns')}Z",
        "end": f"{np.datetime64(int(time[-1]), 'ns')}Z",
        "frame_rate": text(float(f"{1e9 / step:.8g}"), "Hz"),
        "longest_step": text(float(np.diff(time).max()) / 1e9, "s"),
        "dark": "dark" in plan.planes,
        "flat": "flat" in plan.planes,
        "bad_pixels": int(plan.planes["bad_pixel"].sum()) if "bad_pixel" in plan.planes else None,
    }
    if dtype is not None:
        described["bytes_raw"] = plan.n_frames * math.prod(plan.frame_shape) * dtype.itemsize
        described["chunk_frames"] = min(chunk_frames(plan.frame_shape, dtype, chunk), plan.n_frames)
    if found is not None:
        described |= {
            "lowest_count": found.low,
            "highest_count": found.high,
            "pixels_at_highest": found.at_top,
            "pixels_not_finite": found.not_finite,
        }
    return described


def mean_frame(files: Sequence[FrameFile], limit: int = 512) -> NDArray[np.float64]:
    """Mean of at most about `limit` frames from all over the files, for looking at.

    Parameters
    ----------
    files : sequence of FrameFile
        Files of equal frames.
    limit : int
        Frames that are averaged.

    Returns
    -------
    ndarray of float64, (row, col)

    Raises
    ------
    FileFault
        A file cannot be read.
    """
    total = np.zeros(files[0].frame_shape)
    count = np.zeros(files[0].frame_shape, np.int64)
    every = -(-sum(file.n_frames for file in files) // limit)
    for file in files[::every] if files[0].n_frames == 1 else files:
        for block in file.blocks(MEAN_FRAMES, every if file.n_frames > MEAN_FRAMES else 1):
            good = np.isfinite(block)
            total += np.where(good, block, 0).sum(axis=0, dtype=np.float64)
            count += good.sum(axis=0)
    mean: NDArray[np.float64] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean


__all__ = [
    "SUFFIXES",
    "IngestError",
    "IngestParameters",
    "Plan",
    "Survey",
    "TimeParameters",
    "describe",
    "find_sources",
    "ingest",
    "instant",
    "made_before",
    "mean_frame",
    "open_sources",
    "plan_ingest",
    "read_header",
    "survey",
]
