"""Write raw frame archives, format 1, as recorders and the simulation do."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .archive import FRAME_DTYPES, MAX_FRAME, Faults, check_boxes, check_header, check_time
from .archive_codecs import MAX_CHUNK_BYTES

#: What recorders need; the rest is shared with ingest.
__all__ = ["write_archive"]

#: blosc compressor and level: lz4 is read fastest, zstd takes a quarter less room.
_COMPRESSORS: dict[str, tuple[Literal["lz4", "zstd"], int]] = {"lz4": ("lz4", 5), "zstd": ("zstd", 1)}

#: Longest side of a chunk of the arrays beside the frames.
_MAX_SIDE = 2**20


def write_archive(
    path: str | os.PathLike[str],
    header: Mapping[str, Any],
    time: NDArray[np.int64],
    frames: NDArray[Any] | Iterable[NDArray[Any]],
    *,
    dark: NDArray[np.float32] | None = None,
    flat: NDArray[np.float32] | None = None,
    bad_pixel: NDArray[np.bool_] | None = None,
    chunk_frames: int = 256,
    codec: Literal["lz4", "zstd"] = "lz4",
    overwrite: bool = False,
) -> Path:
    """Write one recording; what is at `path` afterwards is the whole archive or what was there before.

    Parameters
    ----------
    path : str or path
        Local folder to make, or a file where the name ends in ``.zip``.
    header : mapping
        Attributes of the group, as the format wants them: text with units. ``format`` and ``format_version``
        may be left out.
    time : ndarray of int64
        (time,), start of each exposure, ns since 1970-01-01T00:00:00 UTC.
    frames : ndarray or iterable of ndarray
        (time, row, col), whole, or in blocks of any number of frames; blocks are written as they come.
    dark, flat : ndarray, optional
        (row, col), background in counts and relative response; converted to float32.
    bad_pixel : ndarray, optional
        (row, col), true = never use.
    chunk_frames : int
        Frames in a chunk.
    codec : {"lz4", "zstd"}
        Compressor inside blosc: ``lz4`` reads fastest, ``zstd`` for cold storage.
    overwrite : bool
        Replace what is at `path`.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    ArchiveError
        The header, the times or the arrays are not right; nothing is written.
    FileExistsError
        There is something at `path` and `overwrite` is false.
    ValueError
        `codec` or `chunk_frames` is not possible, or the blocks of frames do not fit each other or `time`.
    """
    target = Path(path)
    if codec not in _COMPRESSORS:
        raise ValueError(f"codec = {codec!r}: must be one of {', '.join(_COMPRESSORS)}")
    if os.path.lexists(target) and not overwrite:
        raise FileExistsError(f"{target} exists already; choose another name, or say that it may be overwritten")
    attributes = {"format": "shwfs-frames", "format_version": 1, **header}
    time = np.asarray(time)
    blocks = iter([frames] if isinstance(frames, np.ndarray) else frames)
    first = next(blocks, None)
    fault = Faults(str(target))
    check_header(attributes, fault)
    if time.dtype != np.int64 or time.ndim != 1:
        fault("time", f"{time.dtype} {time.shape}", "must be int64 (time,), ns since 1970-01-01T00:00:00 UTC")
    else:
        check_time(time, attributes, fault)
    planes: dict[str, NDArray[Any]] = {}
    if first is None or first.ndim != 3 or first.dtype.name not in FRAME_DTYPES or max(first.shape[1:]) > MAX_FRAME:
        found = None if first is None else f"{first.dtype} {first.shape}"
        fault(
            "frames",
            found,
            f"must be {' or '.join(FRAME_DTYPES)} (time, row, col) of at most {MAX_FRAME} pixels a side",
        )
    else:
        check_boxes(attributes, (first.shape[1], first.shape[2]), fault)
        for name, plane, dtype in (
            ("dark", dark, np.float32),
            ("flat", flat, np.float32),
            ("bad_pixel", bad_pixel, np.bool_),
        ):
            if plane is not None:
                planes[name] = np.asarray(plane, dtype)
                if planes[name].shape != first.shape[1:]:
                    fault(name, planes[name].shape, f"must have the shape of a frame, {first.shape[1:]}")
    fault.raise_any()
    assert first is not None
    chunk_frames = min(chunk_frames, len(time))
    size = chunk_frames * math.prod(first.shape[1:]) * first.dtype.itemsize
    if chunk_frames < 1 or size > MAX_CHUNK_BYTES:
        raise ValueError(f"chunk_frames = {chunk_frames}: a chunk must hold 1 frame to {MAX_CHUNK_BYTES // 2**20} MiB")

    target.parent.mkdir(parents=True, exist_ok=True)
    # In the same folder, so that the last step is a rename; hidden, so that no pattern finds half an archive.
    work = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent))
    try:
        made = work / target.name
        _write(
            made,
            attributes,
            time,
            cut(first, blocks, len(time), chunk_frames),
            first,
            planes,
            chunk_frames,
            codec,
        )
        if os.path.lexists(target) and not overwrite:
            raise FileExistsError(f"{target} was made by something else meanwhile; nothing was replaced")
        replace(made, target, work / "replaced")
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return target


def replace(made: Path, target: Path, aside: Path) -> None:
    """Give `made` the name `target`; a folder that has it is moved to `aside`."""
    # A file replaces a file in one step; a folder that is not empty has to be moved out of the way.
    moved = os.path.lexists(target) and (target.is_dir() or made.is_dir())
    if moved:
        os.rename(target, aside)
    try:
        os.replace(made, target)
    except BaseException:
        if moved:
            os.rename(aside, target)
        raise


def cut(
    first: NDArray[Any], blocks: Iterator[NDArray[Any]], total: int, length: int
) -> Iterator[tuple[int, NDArray[Any]]]:
    """Cut blocks of any length into (first frame, chunk), holding at most one chunk and one block."""
    buffer = np.empty((length, *first.shape[1:]), first.dtype)
    filled = seen = 0
    block: NDArray[Any] | None = first
    while block is not None:
        if block.shape[1:] != first.shape[1:] or block.dtype != first.dtype:
            raise ValueError(
                f"frames from {seen} on are {block.dtype} {block.shape[1:]}, "
                f"those before {first.dtype} {first.shape[1:]}"
            )
        if seen + len(block) > total:
            raise ValueError(f"there are more frames than the {total} times")
        taken = 0
        while taken < len(block):
            n = min(length - filled, len(block) - taken)
            buffer[filled : filled + n] = block[taken : taken + n]
            filled, taken, seen = filled + n, taken + n, seen + n
            if filled == length:
                yield seen - filled, buffer
                filled = 0
        block = next(blocks, None)
    if seen != total:
        raise ValueError(f"there are {seen} frames but {total} times")
    if filled:
        yield seen - filled, buffer[:filled]


def create_arrays(
    store: Any,
    attributes: Mapping[str, Any],
    time: NDArray[np.int64],
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    planes: Mapping[str, NDArray[Any]],
    chunk_frames: int,
    codec: str,
) -> Any:
    """Make an archive of what has been checked, all but the frames.

    Parameters
    ----------
    store : zarr.abc.store.Store
        Empty.
    attributes : mapping
        Attributes of the group.
    time : ndarray of int64
        (time,), ns.
    shape : tuple of int
        (rows, cols) of a frame.
    dtype : numpy.dtype
        Of the frames.
    planes : mapping
        dark, flat, bad_pixel, as far as they are given, in the types of the format.
    chunk_frames : int
        Frames in a chunk.
    codec : {"lz4", "zstd"}
        Compressor.

    Returns
    -------
    zarr.Array
        The frames, to be filled.
    """
    import zarr
    from zarr.codecs import BloscCodec, Crc32cCodec

    name, level = _COMPRESSORS[codec]
    arrays: dict[str, tuple[NDArray[Any], tuple[str, ...]]] = {"time": (time, ("time",))}
    arrays |= {key: (plane, ("row", "col")) for key, plane in planes.items()}
    group = zarr.create_group(store, attributes=dict(attributes))

    def create(
        key: str, shape: tuple[int, ...], chunks: tuple[int, ...], dtype: np.dtype[Any], axes: tuple[str, ...]
    ) -> Any:
        return group.create_array(
            key,
            shape=shape,
            chunks=chunks,
            dtype=dtype,
            filters=(),
            dimension_names=axes,
            compressors=[
                BloscCodec(cname=name, clevel=level, shuffle="shuffle", typesize=dtype.itemsize),
                Crc32cCodec(),
            ],
            config={"write_empty_chunks": True},
        )

    for key, (values, axes) in arrays.items():
        create(key, values.shape, tuple(min(n, _MAX_SIDE) for n in values.shape), values.dtype, axes)[...] = values
    return create("frames", (len(time), *shape), (chunk_frames, *shape), dtype, ("time", "row", "col"))


def _write(
    path: Path,
    attributes: dict[str, Any],
    time: NDArray[np.int64],
    chunks: Iterator[tuple[int, NDArray[Any]]],
    sample: NDArray[Any],
    planes: dict[str, NDArray[Any]],
    chunk_frames: int,
    codec: str,
) -> None:
    from zarr.storage import LocalStore, ZipStore

    store = ZipStore(path, mode="w") if path.suffix == ".zip" else LocalStore(path)
    try:
        stored = create_arrays(store, attributes, time, sample.shape[1:], sample.dtype, planes, chunk_frames, codec)
        for first, chunk in chunks:
            stored[first : first + len(chunk)] = chunk
    finally:
        store.close()
    if path.suffix == ".zip":
        with open(path, "rb+") as file:
            os.fsync(file.fileno())
