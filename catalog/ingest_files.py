"""Frames as cameras and their software leave them: FITS, HDF5, NumPy, TIFF, MATLAB and raw binary files.

Each kind answers three questions: the shape and type of its frames, blocks of them along time, and named values
beside them (time stamps). Files are opened when they are read and closed again: a recording may be ten thousand files
of one frame, or one file larger than the memory.
"""

from __future__ import annotations

import logging
import math
import re
import warnings
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

Kind = Literal["fits", "hdf5", "numpy", "tiff", "matlab", "raw"]

#: Kind of a file -> endings of its name, lower case. A kind may also be named in the header file.
SUFFIXES: dict[Kind, tuple[str, ...]] = {
    "fits": (".fits", ".fit", ".fts", ".fits.gz", ".fit.gz", ".fits.fz"),
    "hdf5": (".h5", ".hdf5", ".hdf", ".he5", ".nxs"),
    "numpy": (".npy", ".npz"),
    "tiff": (".tif", ".tiff"),
    "matlab": (".mat",),
    "raw": (".raw", ".bin", ".dat"),
}
#: MATLAB files before version 7.3 and files packed by gzip cannot be read in parts; up to here they are read whole.
MAX_WHOLE_BYTES = 2**31


class FileFault(ValueError):
    """A file that cannot be used; the message says why and what to do, without naming the file."""


@dataclass(frozen=True)
class Reading:
    """How files are to be read, from the table ``[ingest]`` of a header file.

    Parameters
    ----------
    kind : str or None
        Kind of the files; from their names where it is None.
    dataset : str or None
        Dataset, array, variable or HDU with the frames; the only one where it is None.
    axes : tuple of str
        Order of the axes of three-dimensional data.
    dtype, shape, offset, gap
        Of raw binary: type of a pixel, (rows, cols) as stored, bytes before the first frame, bytes between frames.
    """

    kind: Kind | None = None
    dataset: str | None = None
    axes: tuple[str, ...] = ("time", "row", "col")
    dtype: str | None = None
    shape: tuple[int, int] | None = None
    offset: int = 0
    gap: int = 0


class FrameFile(ABC):
    """One file of frames.

    Parameters
    ----------
    path : Path
        The file.
    reading : Reading
        How to read it.

    Raises
    ------
    FileFault
        It holds no frames, or cannot be read.
    """

    kind: ClassVar[Kind]

    def __init__(self, path: Path, reading: Reading) -> None:
        self.path, self.reading = path, reading
        self.stored: tuple[int, ...]
        self.dtype: np.dtype[Any]
        self.stored, self.dtype, self.step = self._look()
        if len(self.stored) not in (2, 3) or 0 in self.stored:
            raise FileFault(
                f"the data have shape {list(self.stored)}; frames are (time, row, col), or (row, col) for one of them; "
                "name another dataset with ingest.dataset, or save them in three dimensions"
            )
        if self.dtype.kind not in "iufb":
            raise FileFault(f"the data are of type {self.dtype}; counts are whole or floating-point numbers")
        self.axes = reading.axes if len(self.stored) == 3 else tuple(a for a in reading.axes if a != "time")

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.stored[self.axes.index("time")] if "time" in self.axes else 1

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(rows, cols) of a frame."""
        return self.stored[self.axes.index("row")], self.stored[self.axes.index("col")]

    def blocks(self, count: int, every: int = 1, *, start: int = 0, stop: int | None = None) -> Iterator[NDArray[Any]]:
        """Read the frames in blocks of about `count`, as (time, row, col) in the machine's byte order.

        Parameters
        ----------
        count : int
            Frames in a block; whole chunks where the file has such.
        every : int
            Read one of this many blocks only.
        start, stop : int
            First frame, and the frame after the last; all of them by default.

        Yields
        ------
        ndarray
            (time, row, col).

        Raises
        ------
        FileFault
            They cannot be read, or the file is not what it was.
        """
        time = self.axes.index("time") if "time" in self.axes else None
        count = max(count // self.step, 1) * self.step if self.step <= 4 * count else count
        stop = self.n_frames if stop is None else stop
        seen = 0
        for slab in self._slabs(time, list(self._slices(time, count, every, start, stop))):
            block = slab[None] if time is None else slab
            axes = ("time", *self.axes) if time is None else self.axes
            block = block.transpose([axes.index(name) for name in ("time", "row", "col")])
            seen += len(block)
            yield block.astype(block.dtype.newbyteorder("="), copy=False)
        if every == 1 and seen != stop - start:
            raise FileFault(f"{seen} of {stop - start} frames could be read; the file has changed or is damaged")

    def _slices(self, time: int | None, count: int, every: int, first: int, stop: int) -> Iterator[tuple[slice, ...]]:
        whole = tuple(slice(0, n) for n in self.stored)
        if time is None:
            yield whole
            return
        # Blocks end where they would if all were read: chunks of the file are not unpacked twice.
        for start in range(first // count * count, stop, count * every):
            part = slice(max(start, first), min(start + count, stop))
            yield (*whole[:time], part, *whole[time + 1 :])

    @abstractmethod
    def _look(self) -> tuple[tuple[int, ...], np.dtype[Any], int]:
        """Shape and type as stored, and how many frames are best read together."""

    @abstractmethod
    def _slabs(self, time: int | None, parts: list[tuple[slice, ...]]) -> Iterator[NDArray[Any]]:
        """The parts of the data, cut along axis `time`, as stored."""

    def keyword(self, name: str) -> Any:
        """A value of the file's own header."""
        raise FileFault(f"a {self.kind} file has no keywords; give the times in another way")

    def array(self, name: str) -> NDArray[Any]:
        """Another array of the file, in one dimension."""
        raise FileFault(f"a {self.kind} file holds nothing but frames; give the times in another way")


def library(name: str, purpose: str) -> Any:
    """Import an optional library.

    Raises
    ------
    FileFault
        It is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.split(".")[0]
        raise FileFault(
            f"{purpose} needs the package {package}, which is not installed; run: pip install 'coslidar[ingest]'"
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Turn what a library raises into a fault; its warnings on details of a format are not the user's concern."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except FileFault:
            raise
        except MemoryError as error:
            raise FileFault(
                "the file announces more data than memory can hold; it is damaged, or needs parts"
            ) from error
        except Exception as error:
            # Libraries raise whatever comes to hand over a damaged file.
            raise FileFault(
                f"it cannot be read ({type(error).__name__}: {error}); it may be damaged or cut off"
            ) from error


def kind_of(path: Path) -> Kind | None:
    """Kind of a file, from the ending of its name; None if it says nothing."""
    name = path.name.lower()
    return next((kind for kind, endings in SUFFIXES.items() if name.endswith(endings)), None)


def open_file(path: Path, reading: Reading) -> FrameFile:
    """Look at a file of frames.

    Parameters
    ----------
    path : Path
        The file.
    reading : Reading
        How to read it.

    Returns
    -------
    FrameFile

    Raises
    ------
    FileFault
        It is missing, of no known kind, or holds no frames.
    """
    if not path.exists():
        raise FileFault("there is no such file")
    if path.is_dir():
        raise FileFault(f"this is a folder; name the files in it with a pattern in quotes: '{path}/*.fits'")
    kind = reading.kind or kind_of(path)
    if kind is None:
        endings = ", ".join(ending for known in SUFFIXES.values() for ending in known[:1])
        raise FileFault(
            f'the ending of its name tells no kind ({endings}, ...); write format = "raw" (or another of '
            f"{', '.join(SUFFIXES)}) in the table [ingest] of the header file"
        )
    if path.stat().st_size == 0:
        raise FileFault("the file is empty")
    if kind == "matlab":
        with path.open("rb") as file:
            kind = "hdf5" if b"MATLAB 7.3" in file.read(128) else kind
    return _FILES[kind](path, reading)


# --- FITS --------------------------------------------------------------------------------------------------


class FitsFile(FrameFile):
    """A FITS image or cube, also compressed by tiles."""

    kind = "fits"

    @contextmanager
    def _open(self) -> Iterator[Any]:
        fits = library("astropy.io.fits", "reading FITS")
        # Not memory-mapped: sections are read piece by piece anyhow, and scaled integers (BZERO) cannot be mapped.
        with _quiet(), fits.open(self.path, memmap=False, lazy_load_hdus=True) as units:
            yield units

    def _unit(self, units: Any) -> Any:
        images = [n for n, unit in enumerate(units) if unit.is_image and len(unit.shape or ()) >= 2]
        wanted = self.reading.dataset
        if wanted is not None:
            number = next((n for n, unit in enumerate(units) if wanted in (unit.name, str(n)) and n in images), None)
            if number is None:
                named = ", ".join(f"{n} ({units[n].name or 'no name'})" for n in images) or "none"
                raise FileFault(f"ingest.dataset = {wanted!r}: there is no such image HDU; there are: {named}")
            return units[number]
        if not images:
            raise FileFault("there is no image in this file")
        if len(images) > 1:
            named = ", ".join(f"{n} ({units[n].name or 'no name'}, {list(units[n].shape)})" for n in images)
            raise FileFault(f"there are {len(images)} images, HDU {named}; choose one with ingest.dataset")
        return units[images[0]]

    def _look(self) -> tuple[tuple[int, ...], np.dtype[Any], int]:
        with self._open() as units:
            unit = self._unit(units)
            place = unit.fileinfo()
            # An image packed by tiles lies in a table, whose size is another.
            needed = place["datLoc"] + (place["datSpan"] if hasattr(unit, "compression_type") else unit.size)
            if self.path.suffix != ".gz" and needed > self.path.stat().st_size:
                raise FileFault(
                    f"the file ends after {self.path.stat().st_size} bytes, but its image needs {needed}; copy it again"
                )
            if self.path.suffix == ".gz" and unit.size > MAX_WHOLE_BYTES:
                raise FileFault("a packed FITS file of this size cannot be read in parts; unpack it with gunzip")
            one = unit.section[tuple(slice(0, 1) for _ in unit.shape)]
            return tuple(unit.shape), one.dtype, 1

    def _slabs(self, time: int | None, parts: list[tuple[slice, ...]]) -> Iterator[NDArray[Any]]:
        # What is open is closed before a block is handed on: the reader's warning filters must not reach its user.
        if self.path.suffix == ".gz":
            with self._open() as units:
                whole = np.asarray(self._unit(units).section[...])
            for part in parts:
                yield whole[part]
            return
        for part in parts:
            with self._open() as units:
                block = np.asarray(self._unit(units).section[part])
            yield block

    def keyword(self, name: str) -> Any:
        """A keyword of the image's header, or of the primary header."""
        with self._open() as units:
            for unit in (self._unit(units), units[0]):
                if name in unit.header:
                    return unit.header[name]
        raise FileFault(f"there is no keyword {name} in its header")

    def array(self, name: str) -> NDArray[Any]:
        """A column of a table, or another image."""
        with self._open() as units:
            for unit in units:
                if unit.is_image and unit.name == name and unit.data is not None:
                    return np.asarray(unit.data)
                if not unit.is_image and name in unit.columns.names:
                    return np.asarray(unit.data[name])
        raise FileFault(f"there is no table column and no image HDU called {name}")


# --- HDF5 --------------------------------------------------------------------------------------------------


class Hdf5File(FrameFile):
    """An HDF5 dataset; MATLAB files of version 7.3 are HDF5."""

    kind = "hdf5"

    @contextmanager
    def _open(self) -> Iterator[Any]:
        h5py = library("h5py", "reading HDF5")
        with _quiet(), h5py.File(self.path, "r") as file:
            yield file

    def _dataset(self, file: Any) -> Any:
        found: dict[str, Any] = {}

        def visit(name: str, item: Any) -> None:
            if hasattr(item, "shape") and len(item.shape) in (2, 3) and item.dtype.kind in "iufb" and item.size:
                found[name] = item

        file.visititems(visit)
        wanted = self.reading.dataset
        if wanted is not None:
            if wanted not in file or not hasattr(file[wanted], "shape"):
                raise FileFault(
                    f"ingest.dataset = {wanted!r}: there is no such dataset; there are: {', '.join(found) or 'none'}"
                )
            return file[wanted]
        cubes = {name: item for name, item in found.items() if len(item.shape) == 3} or found
        if len(cubes) != 1:
            raise FileFault(
                f"there are {len(cubes)} datasets that may be frames ({', '.join(cubes) or 'none'}); name one with "
                "ingest.dataset"
            )
        return next(iter(cubes.values()))

    def _look(self) -> tuple[tuple[int, ...], np.dtype[Any], int]:
        with self._open() as file:
            data = self._dataset(file)
            time = self.reading.axes.index("time") if len(data.shape) == 3 else None
            step = data.chunks[time] if data.chunks and time is not None else 1
            return tuple(data.shape), data.dtype, int(step)

    def _slabs(self, time: int | None, parts: list[tuple[slice, ...]]) -> Iterator[NDArray[Any]]:
        for part in parts:
            with self._open() as file:
                block = self._dataset(file)[part]
            yield block

    def keyword(self, name: str) -> Any:
        """An attribute of the dataset or of the file, or a dataset with one value."""
        with self._open() as file:
            for place in (self._dataset(file).attrs, file.attrs):
                if name in place:
                    return _scalar(place[name])
            if name in file and getattr(file[name], "size", 0) == 1:
                return _scalar(file[name][()])
        raise FileFault(f"there is no attribute and no single value called {name}")

    def array(self, name: str) -> NDArray[Any]:
        """Another dataset."""
        with self._open() as file:
            if name in file and hasattr(file[name], "shape"):
                values = file[name][()]
                return np.asarray(values).reshape(-1)
        raise FileFault(f"there is no dataset called {name}")


def _scalar(value: Any) -> Any:
    value = np.asarray(value).reshape(-1)[0]
    return value.decode() if isinstance(value, bytes) else value.item() if isinstance(value, np.generic) else value


# --- NumPy -------------------------------------------------------------------------------------------------


class NumpyFile(FrameFile):
    """A ``.npy`` file, or one array of a ``.npz``. Nothing pickled is ever loaded."""

    kind = "numpy"

    @property
    def _packed(self) -> bool:
        return self.path.suffix.lower() == ".npz"

    def _member(self, archive: zipfile.ZipFile) -> str:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        wanted = self.reading.dataset
        if wanted is None:
            found = []
            for name in names:
                shape, _, dtype, _ = self._head(archive, name)
                if len(shape) in (2, 3) and dtype.kind in "iufb":
                    found.append((len(shape), name))
            cubes = [name for dimensions, name in found if dimensions == max(found)[0]]
            if len(cubes) != 1:
                raise FileFault(
                    f"there are {len(cubes)} arrays that may be frames ({', '.join(cubes) or 'none'}); name one with "
                    "ingest.dataset"
                )
            wanted = cubes[0]
        if wanted not in names:
            raise FileFault(f"ingest.dataset = {wanted!r}: there is no such array; there are: {', '.join(names)}")
        return wanted

    @staticmethod
    def _head(
        archive: zipfile.ZipFile, name: str, file: Any = None
    ) -> tuple[tuple[int, ...], bool, np.dtype[Any], Any]:
        stream = file if file is not None else archive.open(f"{name}.npy")
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(stream)
        if file is None:
            stream.close()
        return shape, fortran, dtype, stream

    def _look(self) -> tuple[tuple[int, ...], np.dtype[Any], int]:
        with _quiet():
            if not self._packed:
                mapped = np.load(self.path, mmap_mode="r", allow_pickle=False)
                return mapped.shape, mapped.dtype, 1
            with zipfile.ZipFile(self.path) as archive:
                shape, fortran, dtype, _ = self._head(archive, self._member(archive))
        time_first = self.reading.axes[0] == "time" or len(shape) == 2
        if fortran or not time_first:
            raise FileFault(
                "frames packed in a .npz can be read in parts only if time is their first axis and they are in C "
                "order; save them as .npy, or with np.ascontiguousarray(np.moveaxis(frames, ..., 0))"
            )
        return shape, dtype, 1

    def _slabs(self, time: int | None, parts: list[tuple[slice, ...]]) -> Iterator[NDArray[Any]]:
        if not self._packed:
            for part in parts:
                # Mapped anew each time, so that pages that were read do not count as this program's memory.
                with _quiet():
                    block = np.array(np.load(self.path, mmap_mode="r", allow_pickle=False)[part])
                yield block
            return
        with zipfile.ZipFile(self.path) as archive:
            name = self._member(archive)
            with archive.open(f"{name}.npy") as stream:
                shape, _, dtype, _ = self._head(archive, name, stream)
                start = stream.tell()
                for part in parts:
                    sides = tuple(piece.stop - piece.start for piece in part)
                    size = math.prod(sides) * dtype.itemsize
                    with _quiet():
                        stream.seek(start + part[0].start * math.prod(shape[1:]) * dtype.itemsize)
                        data = stream.read(size)
                    if len(data) != size:
                        raise FileFault(f"the array of shape {list(shape)} is cut off")
                    yield np.frombuffer(data, dtype).reshape(sides)

    def array(self, name: str) -> NDArray[Any]:
        """Another array of a ``.npz``."""
        if not self._packed:
            raise FileFault("a .npy file holds nothing but frames; give the times in another way")
        with _quiet(), np.load(self.path, allow_pickle=False) as arrays:
            if name in arrays:
                return np.asarray(arrays[name]).reshape(-1)
        raise FileFault(f"there is no array called {name}")


# --- TIFF --------------------------------------------------------------------------------------------------


_BROKEN_TIFF = re.compile(
    "invalid (page )?offset|invalid circular|corrupted|missing (data|ByteCounts)|does not match page"
)


class _Complaints(logging.Handler):
    """What tifffile writes to its log, instead of raising."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []
        self._log = logging.getLogger("tifffile")

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        self.lines.append(record.getMessage())

    def __enter__(self) -> _Complaints:
        self._log.addHandler(self)
        self._before, self._log.propagate = self._log.propagate, False
        return self

    def __exit__(self, *raised: object) -> None:
        self._log.removeHandler(self)
        self._log.propagate = self._before


class TiffFile(FrameFile):
    """A TIFF of one page or a stack of pages."""

    kind = "tiff"

    @contextmanager
    def _open(self) -> Iterator[Any]:
        tifffile = library("tifffile", "reading TIFF")
        with _quiet(), _Complaints() as said, tifffile.TiffFile(self.path) as file:
            yield file
            # Pages that are cut off would otherwise be missing without a word.
            if broken := next((line for line in said.lines if _BROKEN_TIFF.search(line)), None):
                raise FileFault(f"its pages are damaged or cut off ({broken}); copy it again")

    @staticmethod
    def _series(file: Any) -> tuple[tuple[int, ...], np.dtype[Any], int | None]:
        """Shape, type, and offset of the data if they lie in one piece."""
        series = file.series
        if not series:
            raise FileFault("there is no page in this file")
        first = series[0]
        if "S" in first.axes:
            raise FileFault("the pages are in colour; save the detector's counts, one value per pixel")
        dtype = np.dtype(first.dtype).newbyteorder(file.byteorder)
        if len(series) == 1:
            return tuple(n for n in first.shape if n > 1 or len(first.shape) <= 3), dtype, first.dataoffset
        if any(s.shape != first.shape or s.dtype != first.dtype or len(s.shape) != 2 for s in series):
            raise FileFault(f"its {len(file.pages)} pages differ in size or type; put frames of one kind into one file")
        return (len(series), *first.shape), dtype, None

    def _look(self) -> tuple[tuple[int, ...], np.dtype[Any], int]:
        with self._open() as file:
            shape, dtype, offset = self._series(file)
            needed = 0 if offset is None else offset + math.prod(shape) * dtype.itemsize
            if needed > self.path.stat().st_size:
                raise FileFault(f"the file ends after {self.path.stat().st_size} of {needed} bytes; copy it again")
            if offset is None and len(shape) == 3 and self.reading.axes[0] != "time":
                raise FileFault("the pages of a TIFF are its frames: the first of ingest.axes must be 'time'")
            return shape, dtype, 1

    def _slabs(self, time: int | None, parts: list[tuple[slice, ...]]) -> Iterator[NDArray[Any]]:
        for part in parts:
            with self._open() as file:
                shape, dtype, offset = self._series(file)
                if offset is not None:
                    block = np.array(np.memmap(self.path, dtype, "r", offset, shape)[part])
                elif time is None:
                    block = file.series[0].asarray()
                else:
                    pages = range(part[0].start, part[0].stop)
                    block = np.stack([file.pages[page].asarray() for page in pages])
            yield block

    def keyword(self, name: str) -> Any:
        """A tag of the first page."""
        with self._open() as file:
            tag = file.pages[0].tags.get(name)
            if tag is None:
                raise FileFault(f"there is no tag {name} on its first page")
            value = tag.value
        # TIFF writes dates as 2012:09:14 12:15:00.
        if isinstance(value, str) and (date := re.fullmatch(r"(\d{4}):(\d\d):(\d\d) (.*)", value.strip("\0 "))):
            return f"{date[1]}-{date[2]}-{date[3]}T{date[4]}"
        return value


# --- MATLAB and raw binary ---------------------------------------------------------------------------------


class MatlabFile(FrameFile):
    """A MATLAB file before version 7.3; its arrays cannot be read in parts."""

    kind = "matlab"

    def _name(self) -> tuple[str, tuple[int, ...], str]:
        import scipy.io

        with _quiet():
            known = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(self.path)}
        wanted = self.reading.dataset
        found = [
            name for name, (shape, kind) in known.items() if max(shape) > 1 and kind not in ("char", "cell", "struct")
        ]
        if wanted is None:
            cubes = [name for name in found if len(known[name][0]) == 3] or [n for n in found if min(known[n][0]) > 1]
            if len(cubes) != 1:
                raise FileFault(
                    f"there are {len(cubes)} variables that may be frames ({', '.join(cubes) or 'none'}); name one "
                    "with ingest.dataset"
                )
            wanted = cubes[0]
        if wanted not in known:
            raise FileFault(f"ingest.dataset = {wanted!r}: there is no such variable; there are: {', '.join(known)}")
        return wanted, *known[wanted]

    def _load(self, name: str) -> NDArray[Any]:
        import scipy.io

        with _quiet():
            return np.asarray(scipy.io.loadmat(self.path, variable_names=[name])[name])

    def _look(self) -> tuple[tuple[int, ...], np.dtype[Any], int]:
        name, shape, kind = self._name()
        types = {"single": "float32", "double": "float64", "logical": "bool"}
        try:
            dtype = np.dtype(types.get(kind, kind))
        except TypeError as error:
            raise FileFault(f"the variable {name} is of class {kind}, which holds no counts") from error
        if math.prod(shape) * dtype.itemsize > MAX_WHOLE_BYTES:
            raise FileFault("it is too large to be read at once; save it with save(..., '-v7.3') or as raw binary")
        return shape, dtype, 1

    def _slabs(self, time: int | None, parts: list[tuple[slice, ...]]) -> Iterator[NDArray[Any]]:
        data = self._load(self._name()[0])
        for part in parts:
            yield data[part]

    def array(self, name: str) -> NDArray[Any]:
        """Another variable."""
        import scipy.io

        with _quiet():
            if name not in {known for known, _, _ in scipy.io.whosmat(self.path)}:
                raise FileFault(f"there is no variable called {name}")
        return self._load(name).reshape(-1)


class RawFile(FrameFile):
    """Frames one after the other, as a camera writes them."""

    kind = "raw"

    def _look(self) -> tuple[tuple[int, ...], np.dtype[Any], int]:
        reading = self.reading
        if reading.dtype is None or reading.shape is None:
            raise FileFault(
                "raw binary needs the type and shape of its frames in the table [ingest] of the header file: "
                'raw_dtype = "<u2" and raw_shape = [rows, cols]'
            )
        dtype = np.dtype(reading.dtype)
        if reading.axes[0] != "time":
            raise FileFault("in raw binary one frame follows the other: the first of ingest.axes must be 'time'")
        size = self.path.stat().st_size - reading.offset
        frame = math.prod(reading.shape) * dtype.itemsize
        # The gap belongs before each frame but the first, or behind each: the last one may be missing.
        count, rest = divmod(size + reading.gap, frame + reading.gap)
        if rest not in (0, reading.gap) or count < 1:
            raise FileFault(
                f"{self.path.stat().st_size} bytes are not {reading.offset} and a whole number of frames of {frame} "
                f"bytes ({dtype} {list(reading.shape)}) with {reading.gap} between them: {rest} bytes are left over; "
                "correct ingest.raw_dtype, raw_shape, raw_offset, raw_gap, or cut the file"
            )
        return (int(count), *reading.shape), dtype, 1

    def _slabs(self, time: int | None, parts: list[tuple[slice, ...]]) -> Iterator[NDArray[Any]]:
        reading = self.reading
        frame = math.prod(self.stored[1:]) * self.dtype.itemsize
        pitch = frame + reading.gap
        inner = np.zeros(self.stored[1:], self.dtype).strides
        for part in parts:
            length = part[0].stop - part[0].start
            with _quiet(), self.path.open("rb") as file:
                file.seek(reading.offset + part[0].start * pitch)
                data = file.read(length * pitch - reading.gap)
            if len(data) != length * pitch - reading.gap:
                raise FileFault("the file has become shorter while it was read")
            yield np.ndarray((length, *self.stored[1:]), self.dtype, data, 0, (pitch, *inner))


_FILES: dict[Kind, type[FrameFile]] = {
    "fits": FitsFile,
    "hdf5": Hdf5File,
    "numpy": NumpyFile,
    "tiff": TiffFile,
    "matlab": MatlabFile,
    "raw": RawFile,
}
