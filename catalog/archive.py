"""Raw frame archives, format 1: open, validate, read.

An archive is one uninterrupted recording of Shack-Hartmann frames with everything that is needed to
interpret them, as a zarr v3 group in a folder, a zip file or behind a URL. :func:`open_archive` reports
everything that is wrong with one, together; what it returns can be read by any number of threads and processes.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from ..pipeline.markup import table
from ..pipeline.parameters import FORMAT, FORMAT_VERSION, Header, overlay, spot_faults, text_faults
from ..pipeline.units import QuantityError, faults, parse, safe
from .archive_codecs import (
    ArraySpec,
    DamagedChunk,
    Missing,
    Rooms,
    StoredArray,
    UnreachableChunk,
    find_chunks,
    parse_array,
)
from .archive_stores import Store, StoreError, UnreachableStore, open_store, shown

#: Data types of frames.
FRAME_DTYPES = ("uint8", "uint16", "int16", "float32")
#: Rows and columns of a frame, at most.
MAX_FRAME = 4096
#: A zarr.json is a few hundred bytes; nothing as large as this is read.
MAX_METADATA_BYTES = 4 * 2**20
#: Nesting of JSON that later stages can rely on.
MAX_DEPTH = 40
#: The median step of time agrees with 1 / frame_rate within this fraction.
RATE_TOLERANCE = 0.01
#: A step longer than this many frame periods is a gap.
GAP = 1.5
#: Faults reported for one archive.
_MAX_FAULTS = 50

#: Data types and dimensions of the arrays, and whether they must be there.
_ARRAYS: dict[str, tuple[tuple[str, ...], tuple[str, ...], bool]] = {
    "frames": (FRAME_DTYPES, ("time", "row", "col"), True),
    "time": (("int64",), ("time",), True),
    "dark": (("float32",), ("row", "col"), False),
    "flat": (("float32",), ("row", "col"), False),
    "bad_pixel": (("bool",), ("row", "col"), False),
}


class ArchiveError(ValueError):
    """An archive that cannot be used.

    Parameters
    ----------
    origin : str
        The archive, as the user named it.
    faults : list of str
        All that is wrong: one sentence each, naming archive, key, what was found and what to do.
    transient : bool
        Whether a network or server failed rather than the archive, so that another try may succeed.
    """

    def __init__(self, origin: str, faults: list[str], transient: bool = False) -> None:
        super().__init__(origin, faults, transient)
        self.origin = origin
        self.faults = faults
        self.transient = transient

    def __str__(self) -> str:
        return "\n".join(self.faults)


class ChunkError(OSError):
    """A chunk of frames that is missing or damaged; the rest of the archive may be good.

    Parameters
    ----------
    archive : str
        The archive.
    chunk : str
        Key of the chunk.
    reason : str
        What is wrong with it.
    transient : bool
        Whether a network or server failed rather than the chunk, so that another try may succeed.
    """

    def __init__(self, archive: str, chunk: str, reason: str, transient: bool = False) -> None:
        super().__init__(archive, chunk, reason, transient)
        self.archive = archive
        self.chunk = chunk
        self.reason = reason
        self.transient = transient

    @classmethod
    def of(cls, archive: str, chunk: str, error: DamagedChunk) -> ChunkError:
        """What to raise for a chunk that could not be fetched or decoded."""
        return cls(archive, chunk, str(error), isinstance(error, UnreachableChunk))

    def __str__(self) -> str:
        if self.transient:
            return (
                f"{self.archive}: {safe(self.chunk)}: this chunk cannot be reached: {safe(self.reason)}; it may be "
                "whole: look at the network, and run again"
            )
        return (
            f"{self.archive}: {safe(self.chunk)}: this chunk is damaged: {safe(self.reason)}; "
            "copy the archive again from where it was recorded"
        )


class Faults:
    """Collects what is wrong with one archive, in the project's sentences."""

    def __init__(self, origin: str) -> None:
        self.origin = origin
        self.sentences: list[str] = []
        #: How many of them say only that something could not be reached.
        self.unreachable = 0

    def __call__(self, key: str, found: Any, message: str) -> None:
        """Add ``<origin>: <key> = <found>: <message>``."""
        written = repr(found)
        self.say(f"{key} = {written if len(written) <= 120 else written[:117] + '...'}: {message}")

    def say(self, sentence: str) -> None:
        """Add ``<origin>: <sentence>``."""
        self.sentences.append(safe(f"{self.origin}: {sentence}"))

    def raise_any(self) -> None:
        """Raise what was collected, if anything.

        Raises
        ------
        ArchiveError
            Something was.
        """
        if not self.sentences:
            return
        transient = self.unreachable == len(self.sentences)
        kept = list(dict.fromkeys(self.sentences))
        if len(kept) > _MAX_FAULTS:
            kept = [*kept[:_MAX_FAULTS], f"{self.origin}: and {len(kept) - _MAX_FAULTS} more"]
        raise ArchiveError(self.origin, kept, transient)


@dataclass(frozen=True, eq=False)
class Archive:
    """One recording, validated. Picklable; holds no open file.

    Parameters
    ----------
    url : str
        Where it was opened.
    header : Header
        Its attributes, typed, in SI units.
    attributes : dict
        Its attributes as stored, unknown keys included.
    time : ndarray of int64
        (time,), start of each exposure, ns since 1970-01-01T00:00:00 UTC.
    dark, flat : ndarray of float32 or None
        (row, col), background in counts and relative response; None where the archive has none.
    bad_pixel : ndarray of bool or None
        (row, col), true = never use.
    gaps : ndarray of int64
        (gaps, 2), for each gap the number of the frame before it and how many frames are missing.
    missing_chunks : tuple of str
        Keys of frame chunks that are missing; empty unless the archive was opened with `allow_missing`.
    """

    url: str
    header: Header
    attributes: dict[str, Any] = field(repr=False)
    time: NDArray[np.int64] = field(repr=False)
    dark: NDArray[np.float32] | None = field(repr=False)
    flat: NDArray[np.float32] | None = field(repr=False)
    bad_pixel: NDArray[np.bool_] | None = field(repr=False)
    gaps: NDArray[np.int64] = field(repr=False)
    missing_chunks: tuple[str, ...]
    _frames: StoredArray = field(repr=False)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        content = {key: value for key, value in describe(self).items() if key not in ("attributes", "notes", "mask")}
        return table(f"Archive {self.header.campaign}/{self.header.archive}", (), content.items())

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self._frames.spec.shape[0]

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(row, col) of a frame."""
        _, rows, cols = self._frames.spec.shape
        return rows, cols

    @property
    def dtype(self) -> np.dtype[Any]:
        """Data type of the frames."""
        return self._frames.spec.dtype

    @property
    def chunk_frames(self) -> int:
        """Frames in a chunk (the last one may hold fewer)."""
        return self._frames.spec.chunk_shape[0]

    @property
    def n_chunks(self) -> int:
        """Number of chunks along time."""
        return self._frames.spec.grid[0]

    @property
    def codecs(self) -> tuple[str, ...]:
        """Names of the codecs of the frames, in order of encoding."""
        return self._frames.spec.chain.names

    @property
    def checksums(self) -> bool:
        """Whether a changed bit in a chunk of frames is noticed: by crc32c, or by a zip file's checksums."""
        return "crc32c" in self.codecs or (self._frames.store.checksums and self._frames.spec.sharding is None)

    @property
    def stored_bytes(self) -> int:
        """Bytes that the frames take as stored."""
        return int(np.maximum(self._frames.place[:, 1], 0).sum())

    def read_chunk(self, i: int) -> NDArray[Any]:
        """Read one chunk of frames.

        Parameters
        ----------
        i : int
            Number of the chunk, from 0.

        Returns
        -------
        ndarray
            (frames, row, col), of the archive's `dtype`, C-contiguous and writable; the caller's own.

        Raises
        ------
        ChunkError
            The chunk is missing or damaged.
        IndexError
            There is no such chunk.
        """
        if not 0 <= i < self.n_chunks:
            raise IndexError(f"there is no chunk {i}; the archive has chunks 0 to {self.n_chunks - 1}")
        return self._chunk(i)

    def _chunk(self, i: int, rooms: Rooms | None = None) -> NDArray[Any]:
        return self._frames.plane(i, lambda key, error: ChunkError.of(shown(self.url), key, error), rooms)

    def chunks(
        self, start: int = 0, stop: int | None = None, *, keep: int | None = None
    ) -> Iterator[tuple[int, NDArray[Any]]]:
        """Read a range of frames, one chunk in memory at a time.

        Parameters
        ----------
        start, stop : int
            Frames [start, stop); to the end where `stop` is None.
        keep : int, optional
            How many of the arrays last yielded stay as they are; memory of earlier ones is used again, which makes
            reading much cheaper. By default each is the caller's own.

        Yields
        ------
        first : int
            Number of the first frame.
        frames : ndarray
            (frames, row, col); the parts of the chunks that lie inside the range.

        Raises
        ------
        ChunkError
            A chunk is missing or damaged.
        """
        stop = self.n_frames if stop is None else min(stop, self.n_frames)
        rooms = None if keep is None else Rooms(keep)
        for i in range(max(start, 0) // self.chunk_frames, -(-stop // self.chunk_frames)):
            first = i * self.chunk_frames
            begin, end = max(start, first), min(stop, first + self.chunk_frames)
            if begin < end:
                yield begin, self._chunk(i, rooms)[begin - first : end - first]

    @cached_property
    def identity(self) -> str:
        """Content identity: 64 hexadecimal digits, independent of path and of folder or zip.

        Covers the attributes, the time stamps, dark, flat and bad pixels, the stored size of every chunk of
        frames and the stored bytes of the first and the last of them: enough to tell two recordings apart
        without reading them whole.
        """
        digest = hashlib.sha256()
        spec = self._frames.spec
        described = {
            "attributes": self.attributes,
            "frames": {"shape": spec.shape, "dtype": spec.dtype.name, "chunks": spec.chunk_shape},
        }
        digest.update(json.dumps(described, sort_keys=True, separators=(",", ":"), allow_nan=False).encode())
        for name, array in (
            ("time", self.time),
            ("dark", self.dark),
            ("flat", self.flat),
            ("bad_pixel", self.bad_pixel),
        ):
            if array is not None:
                digest.update(f"\n{name} {array.shape}\n".encode())
                digest.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
        digest.update(b"\nframes\n" + self._frames.place[:, 1].astype("<i8").tobytes())
        for flat in sorted({0, len(self._frames.place) - 1}):
            if self._frames.place[flat, 1] >= 0:
                try:
                    digest.update(self._frames.fetch(flat, verify=False))
                except DamagedChunk as error:
                    raise ChunkError.of(shown(self.url), self._frames.locate(flat)[0], error) from error
        return digest.hexdigest()


def open_archive(
    url: str | os.PathLike[str], *, allow_missing: bool = False, complete: Mapping[str, Any] | None = None
) -> Archive:
    """Open and validate a raw frame archive.

    Parameters
    ----------
    url : str or path
        A folder, a ``.zip``, or a URL of either that fsspec can open (``https://``, ``s3://``, ``memory://``).
    allow_missing : bool
        Open an archive of which some chunks of frames are missing; they are listed in `missing_chunks` and
        reading one raises :class:`ChunkError`. Otherwise a missing chunk is a fault as any other.
    complete : mapping, optional
        Tables that complete or replace those of the header, as a campaign file may hold them.

    Returns
    -------
    Archive
        The recording; its frames are read on demand.

    Raises
    ------
    ArchiveError
        Anything is wrong with it; the error lists everything that is.
    """
    url = os.fspath(url)
    fault = Faults(shown(url))
    try:
        store = open_store(url)
        attributes = _group(store, fault)
        fault.raise_any()
        assert attributes is not None
        if complete:
            attributes = overlay(attributes, complete)
        return _Opening(url, store, attributes, fault, allow_missing).archive()
    except StoreError as error:
        fault.say(str(error))
        fault.unreachable += isinstance(error, UnreachableStore)
    except OSError as error:
        fault.say(f"cannot be read ({type(error).__name__}: {error}); check the path and its permissions")
    fault.raise_any()
    raise AssertionError("unreachable: a fault was recorded")


# --- metadata ----------------------------------------------------------------------------------------------


def _pairs(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key '{key}' appears twice")
        found[key] = value
    return found


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is no finite number")
    return value


def _depth(value: Any) -> int:
    depth = 0
    level = [value]
    while level := [
        item
        for parent in level
        if isinstance(parent, (dict, list))
        for item in (parent.values() if isinstance(parent, dict) else parent)
    ]:
        depth += 1
    return depth


def _json(store: Store, key: str, fault: Faults) -> dict[str, Any] | None:
    """The JSON object under a key; None, and a fault unless it is absent, where there is none."""
    size = next(store.sizes("", [key]))
    if size is None:
        return None
    if size > MAX_METADATA_BYTES:
        fault.say(f"{key} holds {size} bytes, at most {MAX_METADATA_BYTES} are read; it is no metadata of an archive")
        return {}
    try:
        text = bytes(store.read(key, verify=True)).decode()
        found = json.loads(text, object_pairs_hook=_pairs, parse_float=_finite, parse_constant=_finite)
        if _depth(found) > MAX_DEPTH:
            raise ValueError(f"nested more than {MAX_DEPTH} deep")
        # Lone surrogates are legal in JSON, but nothing later can write them.
        json.dumps(found, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        fault.say(f"{key} is no valid JSON ({str(error)[:200]}); copy the archive again or mend the file")
        return {}
    if not isinstance(found, dict):
        fault(key, found, "must be a JSON object; copy the archive again")
        return {}
    return found


def _group(store: Store, fault: Faults) -> dict[str, Any] | None:
    """Attributes of the root group, when it is an archive of a format version that can be read."""
    document = _json(store, "zarr.json", fault)
    if document is None:
        fault.say(f"this is no raw frame archive: {_instead(store)}")
    elif fault.sentences:
        return None
    elif document.get("zarr_format") != 3 or document.get("node_type") != "group":
        found = f"node_type {document.get('node_type')!r}, zarr_format {document.get('zarr_format')!r}"
        fault.say(
            f"this is no raw frame archive: zarr.json has {found}, expected a 'group' of format 3; "
            "name the group that holds the array 'frames'"
        )
    elif not isinstance(attributes := document.get("attributes"), dict) or attributes.get("format") != FORMAT:
        written = attributes.get("format") if isinstance(attributes, dict) else None
        if written is None:
            fault.say(f"this is a zarr group but no raw frame archive: format is missing, expected '{FORMAT}'")
        else:
            fault("format", written, f"this is a zarr group but no raw frame archive, expected '{FORMAT}'")
    elif type(version := attributes.get("format_version")) is not int or version != FORMAT_VERSION:
        fault("format_version", version, f"this version of coslidar reads format {FORMAT_VERSION}")
    else:
        return attributes
    return None


def _instead(store: Store) -> str:
    if next(store.sizes("", [".zgroup"])) is not None:
        return "it is a zarr group of format 2, expected format 3; convert it and write it again"
    members = getattr(store, "members", {})
    nested = min((key for key in members if key.endswith("/zarr.json")), key=len, default=None)
    if nested is not None and nested.removesuffix("/zarr.json") not in _ARRAYS:
        return (
            f"zarr.json must be at the root of the zip, found '{nested}'; "
            "pack the contents of the folder, not the folder"
        )
    return "there is no zarr.json in it that can be read; name the folder, zip or URL that a recording was written to"


# --- validation --------------------------------------------------------------------------------------------


class _Opening:
    """One pass over an archive that collects every fault before anything large is read."""

    def __init__(self, url: str, store: Store, attributes: dict[str, Any], fault: Faults, allow_missing: bool) -> None:
        self.url, self.store, self.attributes, self.fault = url, store, attributes, fault
        self.allow_missing = allow_missing

    def archive(self) -> Archive:
        header = check_header(self.attributes, self.fault)
        specs = {name: spec for name in _ARRAYS if (spec := self._spec(name)) is not None}
        frames_spec = specs.get("frames")
        if frames_spec is not None:
            frame_shape = (frames_spec.shape[1], frames_spec.shape[2])
            _check_shapes(specs, self.fault)
            check_boxes(self.attributes, frame_shape, self.fault)
        found = {name: array for name, spec in specs.items() if (array := self._find(spec)) is not None}
        time = None
        if "time" in found and (frames_spec is None or specs["time"].shape[0] == frames_spec.shape[0]):
            time = self._read(found["time"])
        if time is not None:
            check_time(time, self.attributes, self.fault)
        planes = {
            name: self._read(found[name])
            for name in ("dark", "flat", "bad_pixel")
            if name in found and frames_spec is not None and found[name].spec.shape == frames_spec.shape[1:]
        }
        self.fault.raise_any()
        assert header is not None
        assert time is not None
        return Archive(
            url=self.url,
            header=header,
            attributes=self.attributes,
            time=time,
            dark=planes.get("dark"),
            flat=planes.get("flat"),
            bad_pixel=planes.get("bad_pixel"),
            gaps=find_gaps(time),
            missing_chunks=self.missing_frames,
            _frames=found["frames"],
        )

    missing_frames: tuple[str, ...] = ()

    def _spec(self, name: str) -> ArraySpec | None:
        dtypes, dimensions, required = _ARRAYS[name]
        before = len(self.fault.sentences)
        document = _json(self.store, f"{name}/zarr.json", self.fault)
        if document is None:
            if required:
                self.fault.say(f"{name} is missing (no {name}/zarr.json); an archive needs this array; write it again")
            return None
        if len(self.fault.sentences) > before:
            return None
        spec = parse_array(name, document, dtypes, dimensions, self.fault, dimensions_required=name == "frames")
        if spec is not None and name != "time" and max(spec.shape[-2:]) > MAX_FRAME:
            found = list(spec.shape)
            self.fault(
                f"{name}.shape",
                found,
                f"a frame has at most {MAX_FRAME} x {MAX_FRAME} pixels; cut out the part that is used",
            )
            return None
        return spec

    def _find(self, spec: ArraySpec) -> StoredArray | None:
        try:
            array, missing = find_chunks(spec, self.store)
        except DamagedChunk as error:
            self.fault.say(f"{error}; copy the archive again from where it was recorded")
            return None
        if not missing.keys:
            return array
        if spec.name == "frames" and self.allow_missing and missing.complete and len(missing.keys) < missing.total:
            self.missing_frames = missing.keys
            return array
        self._missing(spec, missing)
        return None

    def _missing(self, spec: ArraySpec, missing: Missing) -> None:
        count = f"{'' if missing.complete else 'at least '}{len(missing.keys)} of {missing.total}"
        self.fault.say(
            f"{spec.name}: {count} chunks are missing or empty: {missing}. A missing chunk is damage, never "
            "zeros; copy the archive again from where it was recorded"
        )

    def _read(self, array: StoredArray) -> NDArray[Any] | None:
        try:
            return array.whole(lambda key, error: ChunkError.of(self.fault.origin, key, error))
        except ChunkError as error:
            self.fault.sentences.append(str(error))
            self.fault.unreachable += error.transient
            return None


def check_header(attributes: dict[str, Any], fault: Faults) -> Header | None:
    """Validate the attributes alone; None, with the faults recorded, if they are not right."""
    try:
        return Header.model_validate(attributes)
    except ValidationError as error:
        # The model looks at texts and spots only once all fields are right; a fault of theirs must not wait for that.
        if any(found["loc"] for found in error.errors(include_url=False)):
            fault.sentences += faults(error, fault.origin)
        for sentence in [*text_faults(attributes), *spot_faults(attributes)]:
            fault.say(sentence)
    return None


def check_boxes(attributes: dict[str, Any], frame_shape: tuple[int, int], fault: Faults) -> None:
    """Check that the box of every exploited lenslet lies on the detector, as far as the header can be read."""
    instrument = attributes.get("instrument")
    if not isinstance(instrument, dict):
        return
    mask, origin, pitch = (instrument.get(f"{k}") for k in ("subaperture_mask", "lenslet_origin", "lenslet_pitch"))
    pairs = (origin, pitch)
    if not all(isinstance(p, list) and len(p) == 2 and all(type(n) is int for n in p) for p in pairs):
        return
    if not isinstance(mask, list) or not all(isinstance(row, list) for row in mask):
        return
    used = [(i, j) for i, row in enumerate(mask) for j, lenslet in enumerate(row) if lenslet == 1]
    assert isinstance(origin, list)
    assert isinstance(pitch, list)
    outside = [
        index
        for index in used
        if any(
            origin[axis] + index[axis] * pitch[axis] < 0
            or origin[axis] + (index[axis] + 1) * pitch[axis] > frame_shape[axis]
            for axis in (0, 1)
        )
    ]
    if outside:
        i, j = outside[0]
        rows, cols = frame_shape
        fault.say(
            f"instrument.lenslet_origin = {origin!r}, instrument.lenslet_pitch = {pitch!r}: the boxes of "
            f"{len(outside)} exploited lenslets reach beyond the frames of {rows} x {cols} pixels (row, col), "
            f"first that of lenslet ({i}, {j}); correct them, or subaperture_mask"
        )


def check_time(time: NDArray[np.int64], attributes: dict[str, Any], fault: Faults) -> None:
    """Check that time increases and agrees with the frame rate."""
    if len(time) < 2:
        fault.say(f"time holds {len(time)} frames; a recording needs at least 2")
        return
    late = np.flatnonzero(time[1:] <= time[:-1])
    if late.size:
        i = int(late[0]) + 1
        fault(
            f"time[{i}]",
            int(time[i]),
            f"not later than time[{i - 1}] = {int(time[i - 1])} ({late.size} such steps); time must increase "
            "strictly: start of each exposure in ns since 1970-01-01T00:00:00 UTC",
        )
        return
    instrument = attributes.get("instrument")
    written = instrument.get("frame_rate") if isinstance(instrument, dict) else None
    try:
        rate = parse(written, "Hz", key="instrument.frame_rate")
    except QuantityError:
        return  # reported with the header
    median = _median_step(time)
    if rate > 0 and abs(median * rate / 1e9 - 1) > RATE_TOLERANCE:
        fault(
            "instrument.frame_rate",
            written,
            f"the median step of time is {median / 1e6:.6g} ms ({1e9 / median:.6g} Hz), but 1 / frame_rate is "
            f"{1e3 / rate:.6g} ms; they must agree within {RATE_TOLERANCE:.0%}; correct frame_rate, or time (ns)",
        )


def find_gaps(time: NDArray[np.int64]) -> NDArray[np.int64]:
    """Dropped frames.

    Parameters
    ----------
    time : ndarray of int64
        (time,), strictly increasing, ns.

    Returns
    -------
    ndarray of int64
        (gaps, 2): number of the frame before each gap, and how many frames are missing in it.
    """
    period = _median_step(time)
    steps = _steps(time)
    before = np.flatnonzero(steps > GAP * period)
    return np.stack([before, np.maximum(np.rint(steps[before] / period) - 1, 1).astype(np.int64)], axis=1)


def _steps(time: NDArray[np.int64]) -> NDArray[np.float64]:
    # Unsigned: the difference of two int64 may not fit one.
    return np.diff(time.view(np.uint64)).astype(np.float64)


def _median_step(time: NDArray[np.int64]) -> float:
    return float(np.median(_steps(time)))


def _check_shapes(specs: dict[str, ArraySpec], fault: Faults) -> None:
    frames = specs["frames"].shape
    for name, spec in specs.items():
        expected = {"frames": frames, "time": frames[:1]}.get(name, frames[1:])
        if spec.shape != expected:
            what = "one time stamp per frame" if name == "time" else "the shape of a frame"
            fault(f"{name}.shape", list(spec.shape), f"must be {list(expected)}, {what}; write it again")


# --- description -------------------------------------------------------------------------------------------


def describe(archive: Archive) -> dict[str, Any]:
    """What is in an archive, as plain values that JSON can hold.

    Parameters
    ----------
    archive : Archive
        An open archive.

    Returns
    -------
    dict
        Names, counts, times and sizes, with units in the text of what has a dimension; under ``"notes"``
        sentences on what is legal but worth knowing.
    """
    from ..pipeline.units import text

    time = archive.time
    steps = _steps(time)
    raw = archive.n_frames * math.prod(archive.frame_shape) * archive.dtype.itemsize
    geometry = archive.header.geometry()
    return {
        "archive": archive.header.archive,
        "campaign": archive.header.campaign,
        "url": shown(archive.url),
        "identity": archive.identity,
        "format_version": FORMAT_VERSION,
        "frames": archive.n_frames,
        "frame_shape": list(archive.frame_shape),
        "dtype": archive.dtype.name,
        "start": _utc(int(time[0])),
        "end": _utc(int(time[-1])),
        "duration": text(round(float(steps.sum()) / 1e9, 6), "s"),
        "frame_rate": text(float(f"{1e9 / _median_step(time):.8g}"), "Hz"),
        "gaps": len(archive.gaps),
        "frames_missing": int(archive.gaps[:, 1].sum()),
        "chunk_frames": archive.chunk_frames,
        "chunks": archive.n_chunks,
        "codecs": list(archive.codecs),
        "bytes_stored": archive.stored_bytes,
        "bytes_raw": raw,
        "dark": archive.dark is not None,
        "flat": archive.flat is not None,
        "bad_pixels": None if archive.bad_pixel is None else int(archive.bad_pixel.sum()),
        "subapertures": geometry.n_subapertures,
        "mask": [list(row) for row in geometry.mask],
        "sources": [source.name for source in archive.header.sources],
        "attributes": archive.attributes,
        "notes": notes(archive),
    }


def _utc(nanoseconds: int) -> str:
    return f"{np.datetime64(nanoseconds, 'ns').astype('datetime64[us]')}Z"


def notes(archive: Archive) -> list[str]:
    """Sentences on what is legal in an archive but worth knowing."""
    said = []
    if len(archive.gaps):
        before, lost = archive.gaps[int(np.argmax(archive.gaps[:, 1]))]
        said.append(
            f"time has {len(archive.gaps)} gaps: {int(archive.gaps[:, 1].sum())} frames were dropped, "
            f"at most {lost} at once (after frame {before})"
        )
    if archive.missing_chunks:
        said.append(f"{len(archive.missing_chunks)} chunks of frames are missing, first {archive.missing_chunks[0]}")
    if not archive.checksums:
        said.append("the frames carry no checksum (codec crc32c): a flipped bit may read as wrong data")
    if archive.dark is None:
        said.append("there is no dark: the background is estimated outside the spot windows")
    good = np.ones(archive.frame_shape, bool) if archive.bad_pixel is None else ~archive.bad_pixel
    for name, plane in (("dark", archive.dark), ("flat", archive.flat)):
        if plane is not None and (unusable := int(np.sum(~np.isfinite(plane) & good))):
            said.append(f"{name} is not finite in {unusable} pixels that bad_pixel does not mark")
    if archive.flat is not None and good.any():
        values = archive.flat[good & np.isfinite(archive.flat)]
        if np.any(values <= 0):
            said.append(f"flat is not positive in {int(np.sum(values <= 0))} pixels that bad_pixel does not mark")
        mean = float(values.mean(dtype=np.float64)) if values.size else 1.0
        if abs(mean - 1) > 0.1:
            said.append(f"the mean of flat is {mean:.3g}, not 1: fluxes are scaled by it")
    if not good.any():
        said.append("bad_pixel marks every pixel")
    return said
