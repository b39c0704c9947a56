"""Arrays of a raw archive as zarr v3 stores them: what their metadata may say, and how a chunk is decoded.

Only what the archive format allows is understood, and everything is checked before it is believed: metadata
before anything is allocated, checksums before anything is decompressed, and the lengths that a compressed chunk
claims before the decompressor sees it (a truncated blosc chunk can crash the process otherwise). Decoding bytes
directly is also 2.4 times as fast as going through zarr's own pipeline, and works from any thread without an
event loop.
"""

from __future__ import annotations

import errno
import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import google_crc32c
import numpy as np
from numcodecs import blosc, zstd
from numpy.typing import NDArray

from .archive_stores import Room, Store, UnreachableStore

#: One chunk holds at most this many bytes uncompressed.
MAX_CHUNK_BYTES = 256 * 2**20
#: Chunks in one shard; its index is read at once.
_MAX_PER_SHARD = 2**20
#: No axis of a real array is as long.
_LARGEST_SIZE = 2**53
#: Chunk names listed in one message.
_NAMED_CHUNKS = 3

#: ``fault(key, found, what is wrong and what to do)``.
Fault = Callable[[str, Any, str], None]


class DamagedChunk(Exception):
    """A stored chunk that cannot be decoded; the message says why."""


class UnreachableChunk(DamagedChunk):
    """A stored chunk that cannot be fetched now; another try may find it whole."""


#: What a network disk says when it is the network that fails.
_UNREACHABLE = frozenset(
    (errno.ESTALE, errno.ETIMEDOUT, errno.ENETDOWN, errno.ENETUNREACH, errno.EHOSTDOWN, errno.EHOSTUNREACH)
)


class Codec(Protocol):
    """One bytes-to-bytes step of decoding."""

    def decode(self, data: memoryview, size: int | None, limit: int, room: Room | None = None) -> memoryview:
        """Undo the step.

        `size` is the exact result length where it is known, `limit` the largest allowed; `room` is where the result
        may be put.
        """

    def encoded_size(self, size: int | None) -> int | None:
        """Length of what encoding `size` bytes gives, where it does not depend on the data."""


def _space(size: int, room: Room | None) -> memoryview:
    return np.empty(size, np.uint8).data if room is None else room(size)


class Rooms:
    """Memory that is used again from chunk to chunk: fresh memory costs more than decoding into it.

    Parameters
    ----------
    keep : int
        How many decoded chunks stay as they are; the next is put where the first of them was.
    """

    def __init__(self, keep: int) -> None:
        self._stored = _aligned(0)
        self._decoded = [_aligned(0)] * keep
        self._next = 0

    def stored(self, size: int) -> memoryview:
        """Room for a chunk as stored."""
        if size > len(self._stored):
            self._stored = _aligned(size + size // 8)
        return self._stored[:size].data

    def decoded(self, size: int) -> memoryview:
        """Room for a decoded chunk."""
        number, self._next = self._next, (self._next + 1) % len(self._decoded)
        if size > len(self._decoded[number]):
            self._decoded[number] = _aligned(size)
        return self._decoded[number][:size].data


def _aligned(size: int) -> NDArray[np.uint8]:
    """Bytes that begin at the border of a cache line."""
    space = np.empty(size + 64, np.uint8)
    begin = -space.ctypes.data % 64
    return space[begin : begin + size]


@dataclass(frozen=True)
class Crc32c:
    """Checksum in the last four bytes."""

    def decode(self, data: memoryview, size: int | None, limit: int, room: Room | None = None) -> memoryview:
        """See :class:`Codec`."""
        if len(data) < 4:
            raise DamagedChunk(f"truncated to {len(data)} bytes")
        # The extension takes no memoryview, but a read-only array without a copy.
        content = np.frombuffer(data, np.uint8)[:-4]
        content.flags.writeable = False
        if google_crc32c.value(content) != int.from_bytes(data[-4:], "little"):
            raise DamagedChunk("the crc32c checksum does not match: the stored bytes were changed or cut off")
        return data[:-4]

    def encoded_size(self, size: int | None) -> int | None:
        """See :class:`Codec`."""
        return None if size is None else size + 4


@dataclass(frozen=True)
class Blosc:
    """Blosc 1 container."""

    def decode(self, data: memoryview, size: int | None, limit: int, room: Room | None = None) -> memoryview:
        """See :class:`Codec`."""
        if len(data) < 16:
            raise DamagedChunk(f"truncated to {len(data)} bytes, less than a blosc header")
        version, _, _, typesize, decoded, block, encoded = struct.unpack_from("<4B3I", data)
        if encoded != len(data):
            raise DamagedChunk(f"its blosc header promises {encoded} bytes, but {len(data)} are stored")
        if decoded > limit or (size is not None and decoded != size):
            raise DamagedChunk(f"its blosc header promises {decoded} bytes of data, expected {size or limit}")
        if version not in (1, 2) or typesize == 0 or (block == 0 and decoded):
            raise DamagedChunk("its blosc header makes no sense")
        out = _space(decoded, room)
        if decoded:
            try:
                blosc.decompress(data, out)
            except (RuntimeError, ValueError) as error:
                raise DamagedChunk(f"blosc cannot decode it ({error})") from error
        return out

    def encoded_size(self, size: int | None) -> int | None:
        """See :class:`Codec`."""
        return None


@dataclass(frozen=True)
class Zstd:
    """Zstandard frame."""

    def decode(self, data: memoryview, size: int | None, limit: int, room: Room | None = None) -> memoryview:
        """See :class:`Codec`."""
        promised = _zstd_size(data)
        if promised is None:
            promised = size  # the frame does not say; the decoder stops at the end of the buffer
        if promised is None or promised > limit or (size is not None and promised != size):
            raise DamagedChunk(f"its zstd header promises {promised} bytes of data, expected {size or limit}")
        out = _space(promised, room)
        try:
            zstd.decompress(data, out)
        except (RuntimeError, ValueError) as error:
            raise DamagedChunk(f"zstd cannot decode it ({error})") from error
        return out

    def encoded_size(self, size: int | None) -> int | None:
        """See :class:`Codec`."""
        return None


def _zstd_size(data: memoryview) -> int | None:
    # RFC 8878, section 3.1.1.1: the content size stands in the frame header, in 0, 1, 2, 4 or 8 bytes.
    if len(data) < 6 or bytes(data[:4]) != b"\x28\xb5\x2f\xfd":
        raise DamagedChunk("it does not begin as a zstd frame")
    descriptor = data[4]
    single = bool(descriptor & 0x20)
    width = (1 if single else 0, 2, 4, 8)[descriptor >> 6]
    begin = 5 + (0 if single else 1) + (0, 1, 2, 4)[descriptor & 0x3]
    if width == 0:
        return None
    if len(data) < begin + width:
        raise DamagedChunk("truncated inside the zstd header")
    return int.from_bytes(data[begin : begin + width], "little") + (256 if width == 2 else 0)


@dataclass(frozen=True)
class Gzip:
    """Gzip stream."""

    def decode(self, data: memoryview, size: int | None, limit: int, room: Room | None = None) -> memoryview:
        """See :class:`Codec`."""
        largest = limit if size is None else size
        decoder = zlib.decompressobj(wbits=31)
        try:
            out = decoder.decompress(data, largest + 1)
        except zlib.error as error:
            raise DamagedChunk(f"gzip cannot decode it ({error})") from error
        if not decoder.eof or decoder.unused_data or len(out) > largest:
            raise DamagedChunk(f"its gzip stream does not end after the expected {largest} bytes")
        return memoryview(out)

    def encoded_size(self, size: int | None) -> int | None:
        """See :class:`Codec`."""
        return None


_BYTES_CODECS: dict[str, type[Crc32c | Blosc | Zstd | Gzip]] = {
    "crc32c": Crc32c,
    "blosc": Blosc,
    "zstd": Zstd,
    "gzip": Gzip,
}
#: Every codec that an archive may use.
ALLOWED_CODECS = ("bytes", "transpose", "blosc", "zstd", "gzip", "crc32c", "sharding_indexed")


def largest_encoding(size: int) -> int:
    """Bytes that `size` bytes may take at any stage: no compressor lets data grow by more."""
    return size + size // 8 + 4096


@dataclass(frozen=True)
class Chain:
    """Codecs of one chunk: axis order, byte order, then compression and checksums in order of encoding."""

    axes: tuple[int, ...]
    little_endian: bool
    steps: tuple[Codec, ...]
    names: tuple[str, ...]

    def decode(
        self, data: bytes | memoryview, shape: tuple[int, ...], dtype: np.dtype[Any], room: Room | None = None
    ) -> NDArray[Any]:
        """Decode one chunk.

        Parameters
        ----------
        data : bytes
            The chunk as stored.
        shape : tuple of int
            Shape of the chunk.
        dtype : numpy.dtype
            Native data type.
        room : callable, optional
            Where to put it; `data` is not to be kept then.

        Returns
        -------
        ndarray
            Writable, C-contiguous, of `shape` and `dtype`.

        Raises
        ------
        DamagedChunk
            It cannot be decoded to exactly this shape.
        """
        size = math.prod(shape) * dtype.itemsize
        limit = largest_encoding(size)
        expected: list[int | None] = [size]
        for step in self.steps:
            expected.append(step.encoded_size(expected[-1]))
        view = memoryview(data)
        for step, length in zip(reversed(self.steps), reversed(expected[:-1]), strict=True):
            # What one decompressor has decoded may be what the next one reads.
            view = step.decode(view, length, limit, room if step is self.steps[0] else None)
        if len(view) != size:
            raise DamagedChunk(f"it decodes to {len(view)} bytes, expected {size}")
        values = np.frombuffer(view, dtype.newbyteorder("<" if self.little_endian else ">"))
        if self.axes != tuple(range(len(shape))):
            values = values.reshape([shape[axis] for axis in self.axes]).transpose(np.argsort(self.axes))
        values = values.reshape(shape)
        if dtype == np.bool_:
            values = values.view(np.uint8) != 0  # any other byte would be an invalid bool
        if room is not None and not (self.steps and isinstance(self.steps[0], Blosc | Zstd)):
            values = values.copy()  # it may still lie where the stored bytes do
        # Always the same kind of array: compiled kernels are specialised on memory order and writability.
        return np.require(values, dtype, ["C", "W", "A"])


@dataclass(frozen=True)
class Sharding:
    """How several chunks lie in one stored object."""

    at_end: bool
    little_endian: bool
    checksum: bool

    def index_size(self, count: int) -> int:
        """Bytes of the index of a shard of `count` chunks."""
        return 16 * count + (4 if self.checksum else 0)

    def index(self, data: bytes | memoryview, count: int) -> NDArray[np.uint64]:
        """Decode a shard's index: (count, 2) offsets and sizes, all bits set where a chunk is missing."""
        view = memoryview(data)
        if self.checksum:
            view = Crc32c().decode(view, 16 * count, 16 * count)
        table = np.frombuffer(view, "<u8" if self.little_endian else ">u8").astype(np.uint64)
        return table.reshape(count, 2)


@dataclass(frozen=True)
class ArraySpec:
    """Validated metadata of one array.

    Parameters
    ----------
    name : str
        Name of the array in its group.
    shape : tuple of int
        Shape of the array.
    dtype : numpy.dtype
        Native data type.
    chunk_shape : tuple of int
        Shape of a chunk, the unit that is decoded; of the chunks inside a shard where there are shards.
    chain : Chain
        Codecs of a chunk.
    sharding : Sharding or None
        How shards are laid out, None without shards.
    stored_shape : tuple of int
        Shape of what one key holds: `chunk_shape`, or that of a shard.
    key_prefix, key_separator : str
        How chunk keys are written.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_shape: tuple[int, ...]
    chain: Chain
    sharding: Sharding | None
    stored_shape: tuple[int, ...]
    key_prefix: str
    key_separator: str

    @property
    def grid(self) -> tuple[int, ...]:
        """Chunks along each axis."""
        return tuple(-(-n // c) for n, c in zip(self.shape, self.chunk_shape, strict=True))

    @property
    def stored_grid(self) -> tuple[int, ...]:
        """Stored objects along each axis."""
        return tuple(-(-n // c) for n, c in zip(self.shape, self.stored_shape, strict=True))

    @property
    def per_shard(self) -> tuple[int, ...]:
        """Chunks in a stored object along each axis."""
        return tuple(s // c for s, c in zip(self.stored_shape, self.chunk_shape, strict=True))

    def key(self, stored_index: tuple[int, ...]) -> str:
        """Key of a stored object, with the array's name."""
        written = self.key_separator.join(str(i) for i in stored_index)
        return f"{self.name}/{self.key_prefix}{written}"

    def keys(self) -> Iterator[str]:
        """Keys of all stored objects in C order, one at a time: their number is only a claim yet."""
        grid = self.stored_grid
        for flat in range(math.prod(grid)):
            yield self.key(_unravel(flat, grid))


def _unravel(flat: int, grid: tuple[int, ...]) -> tuple[int, ...]:
    index = []
    for n in reversed(grid):
        flat, i = divmod(flat, n)
        index.append(i)
    return tuple(reversed(index))


@dataclass(frozen=True, eq=False)
class StoredArray:
    """An array whose chunks have been found in a store.

    Parameters
    ----------
    spec : ArraySpec
        Its metadata.
    store : Store
        Where its bytes are.
    place : ndarray of int64
        (chunks, 2), in C order of the grid: offset in the stored object and stored size; size -1 where the
        chunk is missing.
    """

    spec: ArraySpec
    store: Store
    place: NDArray[np.int64] = field(repr=False)

    def locate(self, flat: int) -> tuple[str, int, int]:
        """Key, offset and stored size of a chunk given by its number in C order."""
        index = _unravel(flat, self.spec.grid)
        stored = tuple(i // n for i, n in zip(index, self.spec.per_shard, strict=True))
        offset, size = self.place[flat]
        return self.spec.key(stored), int(offset), int(size)

    def fetch(self, flat: int, *, verify: bool = True, room: Room | None = None) -> bytes | memoryview:
        """The stored bytes of a chunk, in `room` where there is one.

        Raises
        ------
        DamagedChunk
            They are missing or cannot be read.
        """
        key, offset, size = self.locate(flat)
        if size < 0:
            raise DamagedChunk("missing")
        decoded = math.prod(self.spec.chunk_shape) * self.spec.dtype.itemsize
        if size > largest_encoding(decoded):
            raise DamagedChunk(f"{size} bytes are stored, more than {decoded} bytes of data can take")
        # Where a chunk has no checksum of its own, that of the zip file is the only one.
        verify = verify and self.store.checksums and "crc32c" not in self.spec.chain.names
        try:
            return self.store.read(key, offset, size, verify=verify, room=room)
        except FileNotFoundError as error:
            raise DamagedChunk("missing since the archive was opened") from error
        except OSError as error:
            lost = isinstance(error, UnreachableStore) or error.errno in _UNREACHABLE
            raise (UnreachableChunk if lost else DamagedChunk)(str(error)) from error

    def chunk(self, flat: int, rooms: Rooms | None = None) -> NDArray[Any]:
        """Decode a chunk, with its padding beyond the end of the array; in `rooms` where they are given.

        Raises
        ------
        DamagedChunk
            It is missing or damaged.
        """
        stored, decoded = (None, None) if rooms is None else (rooms.stored, rooms.decoded)
        return self.spec.chain.decode(
            self.fetch(flat, room=stored), self.spec.chunk_shape, self.spec.dtype, room=decoded
        )

    def plane(
        self, row: int, fault: Callable[[str, DamagedChunk], Exception], rooms: Rooms | None = None
    ) -> NDArray[Any]:
        """All chunks with index `row` along the first axis, put together and cut to the array's shape.

        Parameters
        ----------
        row : int
            Index of the chunk along the first axis.
        fault : callable
            ``fault(key, error)`` gives the exception to raise for a damaged chunk.
        rooms : Rooms, optional
            Where to put it, if a chunk holds whole frames.
        """
        spec = self.spec
        first = row * spec.chunk_shape[0]
        shape = (min(spec.chunk_shape[0], spec.shape[0] - first), *spec.shape[1:])
        count = math.prod(spec.grid[1:])
        alone = count == 1 and spec.chunk_shape[1:] == spec.shape[1:]
        out: NDArray[Any] | None = None
        for across in range(count):
            flat = row * count + across
            try:
                chunk = self.chunk(flat, rooms if alone else None)
            except DamagedChunk as error:
                raise fault(self.locate(flat)[0], error) from error
            if alone:
                return chunk[: shape[0]]
            if out is None:
                out = np.empty(shape, spec.dtype)
            index = _unravel(across, spec.grid[1:])
            begins = [i * c for i, c in zip(index, spec.chunk_shape[1:], strict=True)]
            region = out[(slice(None), *(slice(b, b + c) for b, c in zip(begins, spec.chunk_shape[1:], strict=True)))]
            region[...] = chunk[tuple(slice(0, n) for n in region.shape)]
        assert out is not None
        return out

    def whole(self, fault: Callable[[str, DamagedChunk], Exception]) -> NDArray[Any]:
        """The whole array; see :meth:`plane`."""
        return np.concatenate([self.plane(row, fault) for row in range(self.spec.grid[0])])


# --- metadata ----------------------------------------------------------------------------------------------

_KNOWN_KEYS = {
    *("zarr_format", "node_type", "shape", "data_type", "chunk_grid", "chunk_key_encoding", "fill_value"),
    *("codecs", "attributes", "storage_transformers", "dimension_names"),
}


def _sizes(value: Any) -> tuple[int, ...] | None:
    if not isinstance(value, list) or not 1 <= len(value) <= 8:
        return None
    if any(isinstance(n, bool) or not isinstance(n, int) or not 1 <= n < _LARGEST_SIZE for n in value):
        return None
    return tuple(value)


def _named(value: Any) -> tuple[str, dict[str, Any]] | None:
    # An extension without configuration may be written as its name alone.
    if isinstance(value, str):
        return value, {}
    if not isinstance(value, dict) or not isinstance(value.get("name"), str):
        return None
    configuration = value.get("configuration", {})
    return (value["name"], configuration) if isinstance(configuration, dict) else None


def parse_array(
    name: str,
    document: dict[str, Any],
    dtypes: tuple[str, ...],
    dimensions: tuple[str, ...],
    fault: Fault,
    *,
    dimensions_required: bool = False,
) -> ArraySpec | None:
    """Validate the ``zarr.json`` of one array; nothing is allocated.

    Parameters
    ----------
    name : str
        Name of the array.
    document : dict
        The parsed ``zarr.json``.
    dtypes : tuple of str
        Data types allowed.
    dimensions : tuple of str
        Names of its dimensions.
    fault : callable
        Called for each thing that is wrong.
    dimensions_required : bool
        Whether `dimension_names` must be present.

    Returns
    -------
    ArraySpec or None
        None if anything is wrong.
    """
    before = [0]

    def wrong(key: str, found: Any, message: str) -> None:
        before[0] += 1
        fault(f"{name}.{key}", found, message)

    if document.get("zarr_format") != 3 or document.get("node_type") != "array":
        wrong("node_type", document.get("node_type"), "must be an 'array' of zarr format 3")
        return None
    for key in sorted(set(document) - _KNOWN_KEYS):
        if not (isinstance(document[key], dict) and document[key].get("must_understand") is False):
            wrong(
                key[:100],
                document[key],
                "this extension of zarr is not part of the archive format; write without it",
            )
    if document.get("storage_transformers"):
        wrong(
            "storage_transformers",
            document["storage_transformers"],
            "must be empty; write the array without them",
        )
    shape = _sizes(document.get("shape"))
    if shape is None or len(shape) != len(dimensions):
        wrong(
            "shape",
            document.get("shape"),
            f"must be {len(dimensions)} positive sizes ({', '.join(dimensions)})",
        )
        shape = None
    data_type = document.get("data_type")
    if data_type not in dtypes:
        wrong("data_type", data_type, f"must be {' or '.join(dtypes)}; convert the array and write it again")
        data_type = None
    names = document.get("dimension_names")
    if (names is None and dimensions_required) or (names is not None and names != list(dimensions)):
        wrong("dimension_names", names, f"must be {list(dimensions)}")
    grid = _named(document.get("chunk_grid"))
    stored = _sizes(grid[1].get("chunk_shape")) if grid is not None and grid[0] == "regular" else None
    if stored is None or len(stored) != len(dimensions):
        wrong(
            "chunk_grid",
            document.get("chunk_grid"),
            f"must be 'regular' with {len(dimensions)} positive chunk sizes",
        )
        stored = None
    encoding = _named(document.get("chunk_key_encoding"))
    prefix, separator = "", "."
    if encoding is None or encoding[0] not in ("default", "v2"):
        wrong("chunk_key_encoding", document.get("chunk_key_encoding"), "must be 'default' or 'v2'")
    else:
        separator = encoding[1].get("separator", "/" if encoding[0] == "default" else ".")
        if separator not in ("/", "."):
            wrong("chunk_key_encoding.separator", separator, "must be '/' or '.'")
        prefix = f"c{separator}" if encoding[0] == "default" else ""
    sharding: Sharding | None = None
    chunk = stored
    codecs, path = document.get("codecs"), "codecs"
    outer = [_named(codec) for codec in codecs] if isinstance(codecs, list) else []
    if any(codec is not None and codec[0] == "sharding_indexed" for codec in outer):
        sharding, chunk, codecs = _parse_sharding(outer, stored, wrong)
        path = "codecs[0].configuration.codecs"
    chain = _parse_chain(codecs, path, data_type, len(dimensions), wrong)
    if chunk is not None and data_type is not None:
        size = math.prod(chunk) * np.dtype(data_type).itemsize
        if size > MAX_CHUNK_BYTES:
            wrong(
                "chunk_grid",
                list(chunk),
                f"a chunk would hold {size / 2**20:.0f} MiB uncompressed, at most "
                f"{MAX_CHUNK_BYTES // 2**20} MiB are allowed; write with smaller chunks (256 frames are usual)",
            )
    if before[0] or shape is None or data_type is None or stored is None or chunk is None or chain is None:
        return None
    return ArraySpec(name, shape, np.dtype(data_type), chunk, chain, sharding, stored, prefix, separator)


def _parse_sharding(
    outer: list[tuple[str, dict[str, Any]] | None], stored: tuple[int, ...] | None, wrong: Fault
) -> tuple[Sharding | None, tuple[int, ...] | None, Any]:
    settings = next(codec[1] for codec in outer if codec is not None and codec[0] == "sharding_indexed")
    if len(outer) != 1:
        names = [codec and codec[0] for codec in outer]
        wrong("codecs", names, "next to sharding no other codec may stand; put it inside the shards")
    inner = _sizes(settings.get("chunk_shape"))
    if stored is not None and (
        inner is None or len(inner) != len(stored) or any(s % c for s, c in zip(stored, inner, strict=True))
    ):
        found = settings.get("chunk_shape")
        wrong("codecs[0].configuration.chunk_shape", found, f"must divide the shape of a shard, {list(stored)}")
        inner = None
    if inner is not None and stored is not None and math.prod(stored) // math.prod(inner) > _MAX_PER_SHARD:
        wrong(
            "codecs[0].configuration.chunk_shape",
            list(inner),
            f"more than {_MAX_PER_SHARD} chunks in a shard",
        )
    location = settings.get("index_location", "end")
    codecs = settings.get("index_codecs")
    index = [_named(codec) for codec in codecs] if isinstance(codecs, list) else []
    names = [codec and codec[0] for codec in index]
    if location not in ("start", "end"):
        wrong("codecs[0].configuration.index_location", location, "must be 'start' or 'end'")
    if names not in (["bytes"], ["bytes", "crc32c"]) or index[0] is None:
        wrong("codecs[0].configuration.index_codecs", codecs, "must be bytes, or bytes and crc32c")
        return None, inner, settings.get("codecs")
    little = index[0][1].get("endian", "little") != "big"
    return Sharding(location == "end", little, len(names) == 2), inner, settings.get("codecs")


def _parse_chain(codecs: Any, path: str, data_type: str | None, ndim: int, wrong: Fault) -> Chain | None:
    if not isinstance(codecs, list) or not 1 <= len(codecs) <= 8:
        wrong(path, codecs, "must be a list of 1 to 8 codecs")
        return None
    axes = tuple(range(ndim))
    little, seen_bytes, good = True, False, True
    steps: list[Codec] = []
    names: list[str] = []
    for number, codec in enumerate(codecs):
        named = _named(codec)
        name, settings = named if named is not None else (None, {})
        where = f"{path}[{number}]"
        names.append(str(name))
        if name == "transpose" and not seen_bytes:
            order = settings.get("order")
            if not isinstance(order, list) or len(order) != ndim or {*map(repr, order)} != {*map(repr, range(ndim))}:
                wrong(f"{where}.configuration.order", order, f"must be a permutation of {list(range(ndim))}")
                good = False
            else:
                axes = tuple(axes[axis] for axis in order)
        elif name == "bytes" and not seen_bytes:
            seen_bytes = True
            endian = settings.get("endian")
            if endian not in ("little", "big") and not (endian is None and data_type in ("uint8", "bool", None)):
                wrong(f"{where}.configuration.endian", endian, "must be 'little' or 'big'")
                good = False
            little = endian != "big"
        elif name in _BYTES_CODECS and seen_bytes:
            steps.append(_BYTES_CODECS[name]())
        elif name in ALLOWED_CODECS:
            wrong(
                where,
                name,
                "this codec cannot stand here; the order is transpose, bytes, compression, crc32c",
            )
            good = False
        else:
            wrong(
                where,
                codec,
                f"this codec is not allowed; allowed: {', '.join(ALLOWED_CODECS)}. Write the array again",
            )
            good = False
    if good and not seen_bytes:
        wrong(path, names, "the codec 'bytes' is missing")
        good = False
    return Chain(axes, little, tuple(steps), tuple(names)) if good else None


# --- chunks ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Missing:
    """Chunks of an array that a store does not hold.

    Parameters
    ----------
    keys : tuple of str
        Keys of those seen, in order.
    complete : bool
        Whether these are all; the search is given up when most of an array is missing.
    total : int
        Stored objects the array should have.
    """

    keys: tuple[str, ...]
    complete: bool
    total: int

    def __str__(self) -> str:
        named = ", ".join(self.keys[:_NAMED_CHUNKS])
        more = len(self.keys) - _NAMED_CHUNKS
        rest = "" if more <= 0 else f" and {more} more" if self.complete else f" and at least {more} more"
        return f"{named}{rest}"


def find_chunks(spec: ArraySpec, store: Store) -> tuple[StoredArray, Missing]:
    """Look for every chunk of an array.

    Parameters
    ----------
    spec : ArraySpec
        Metadata of the array.
    store : Store
        Where to look.

    Returns
    -------
    StoredArray, Missing
        What is there, and what is not.

    Raises
    ------
    DamagedChunk
        The index of a shard cannot be read.
    OSError
        The store cannot be read.
    """
    total = math.prod(spec.stored_grid)
    found: list[int] = []
    missing: list[str] = []
    present = 0
    for key, size in zip(spec.keys(), store.sizes(spec.name, spec.keys()), strict=False):
        if size:
            present += 1
        else:
            missing.append(key)
            # Their number is only what the metadata claims: do not go through billions that never were.
            if len(missing) > 100 and len(missing) > present:
                return StoredArray(spec, store, np.empty((0, 2), np.int64)), Missing(tuple(missing), False, total)
        found.append(size or -1)
    if spec.sharding is None:
        place = np.zeros((total, 2), np.int64)
        place[:, 1] = found
        return StoredArray(spec, store, place), Missing(tuple(missing), True, total)
    place, lost = _shard_places(spec, spec.sharding, store, found)
    return StoredArray(spec, store, place), Missing((*missing, *lost), True, total)


def _shard_places(
    spec: ArraySpec, sharding: Sharding, store: Store, sizes: list[int]
) -> tuple[NDArray[np.int64], list[str]]:
    count = math.prod(spec.per_shard)
    length = sharding.index_size(count)
    for flat, size in enumerate(sizes):
        if 0 <= size < length:
            key = spec.key(_unravel(flat, spec.stored_grid))
            raise DamagedChunk(f"{key} is truncated: {size} bytes are less than its index of {length} bytes")
    if max(sizes) < 0:
        return np.empty((0, 2), np.int64), []
    place = np.zeros((*spec.grid, 2), np.int64)
    place[..., 1] = -1
    lost: list[str] = []
    for flat, size in enumerate(sizes):
        if size < 0:
            continue
        shard = _unravel(flat, spec.stored_grid)
        key = spec.key(shard)
        try:
            table = sharding.index(store.read(key, size - length if sharding.at_end else 0, length), count)
        except DamagedChunk as error:
            raise DamagedChunk(f"{key}: the index of the shard is damaged ({error})") from error
        absent = np.all(table == np.uint64(2**64 - 1), axis=1)
        offset, stored = table[:, 0], table[:, 1]
        bad = ~absent & ((stored > size) | (offset > size) | (offset + stored > size))
        entries = np.where((absent | bad)[:, None], np.array([0, -1], np.int64), table.astype(np.int64))
        entries = entries.reshape(*spec.per_shard, 2)
        begins = [i * n for i, n in zip(shard, spec.per_shard, strict=True)]
        region = place[tuple(slice(b, b + n) for b, n in zip(begins, spec.per_shard, strict=True))]
        region[...] = entries[tuple(slice(0, n) for n in region.shape[:-1])]
        for inner in np.argwhere(region[..., 1] < 0):
            position = tuple(int(b + i) for b, i in zip(begins, inner, strict=True))
            lost.append(f"{key} (chunk {', '.join(map(str, position))} inside)")
    return place.reshape(-1, 2), lost
