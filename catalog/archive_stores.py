"""Where the bytes of a raw archive lie: a folder, a zip file, or either of them behind a URL.

Three small read-only stores with one interface. They hold no open file and no connection, only what is needed
to find the bytes again, so an archive can be pickled, forked and read from any number of threads.
"""

from __future__ import annotations

import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, BinaryIO, Protocol, TypeVar
from urllib.parse import urlsplit

#: Fixed part of a zip member's local header; name and extra field follow, then the data.
_LOCAL_HEADER = struct.Struct("<4s5H3I2H")
#: Extra field that a remote read allows for, so that one request fetches header and data.
_USUAL_EXTRA = 64
#: Kinds of URL that archives are read from, and what to install for each. An allow list: others of fsspec's read files
#: that name further files, fill in templates, or run in somebody's notebook, and packages add more.
SCHEMES = {
    **dict.fromkeys(("http", "https"), "coslidar[http]"),
    **dict.fromkeys(("s3", "s3a"), "coslidar[s3]"),
    **dict.fromkeys(("gs", "gcs"), "gcsfs"),
    **dict.fromkeys(("abfs", "az"), "adlfs"),
    **dict.fromkeys(("sftp", "ssh"), "paramiko"),
    **dict.fromkeys(("ftp", "webhdfs", "memory"), "fsspec"),
}
#: Exceptions of aiohttp and botocore for a network that fails, which are no OSError.
_NETWORK = frozenset(
    (
        "ServerDisconnectedError",
        "ClientPayloadError",
        "EndpointConnectionError",
        "ConnectTimeoutError",
        "ReadTimeoutError",
    )
)
#: Requests in flight where a server cannot list and each key is asked for.
_CONCURRENT_REQUESTS = 16


#: Where bytes of a given number are to be put, by whoever can; those who cannot return bytes of their own.
Room = Callable[[int], memoryview]
Data = TypeVar("Data", bytes, memoryview)


class StoreError(OSError):
    """The place that a URL names cannot be read as an archive's store; the message says why."""


class UnreachableStore(StoreError):
    """A network or its server fails: what was asked for may be whole, and another try may succeed."""


class Store(Protocol):
    """Read-only map from keys (``"frames/c/0/0/0"``) to bytes."""

    @property
    def checksums(self) -> bool:
        """Whether :meth:`read` of a whole value checks a checksum that the store itself keeps."""

    def sizes(self, prefix: str, keys: Iterable[str]) -> Iterator[int | None]:
        """Stored size in bytes of each key below `prefix`, None where there is no such key."""

    def read(
        self, key: str, start: int = 0, size: int | None = None, *, verify: bool = False, room: Room | None = None
    ) -> bytes | memoryview:
        """Bytes [start, start + size) of a value, all of it where `size` is None; in `room` if they are here.

        Raises
        ------
        FileNotFoundError
            There is no such key.
        OSError
            It cannot be read, or not whole, or (`verify`) it fails the store's own checksum.
        """


def _exact(data: Data, size: int, key: str) -> Data:
    if len(data) != size:
        raise StoreError(f"{key} ends after {len(data)} of {size} bytes")
    return data


def _read(file: BinaryIO, size: int, key: str, room: Room | None) -> bytes | memoryview:
    """The next bytes of a file."""
    if room is None:
        return _exact(file.read(size), size, key)
    place, done = room(size), 0
    while done < size and (more := file.readinto(place[done:])):  # type: ignore[attr-defined]
        done += more
    return _exact(place[:done], size, key)


@dataclass(frozen=True)
class FolderStore:
    """A zarr group in a local folder."""

    path: str
    checksums: bool = field(default=False, init=False)

    def _file(self, key: str) -> str:
        return os.path.join(self.path, *key.split("/"))

    def _size(self, key: str) -> int | None:
        try:
            found = os.stat(self._file(key))
        except (FileNotFoundError, NotADirectoryError):
            return None
        # A pipe or a device would block the reader or never end.
        return found.st_size if stat.S_ISREG(found.st_mode) else None

    def sizes(self, prefix: str, keys: Iterable[str]) -> Iterator[int | None]:
        """See :class:`Store`."""
        return (self._size(key) for key in keys)

    def read(
        self, key: str, start: int = 0, size: int | None = None, *, verify: bool = False, room: Room | None = None
    ) -> bytes | memoryview:
        """See :class:`Store`."""
        whole = self._size(key)
        if whole is None:
            raise FileNotFoundError(f"{key} does not exist")
        size = whole - start if size is None else size
        with open(self._file(key), "rb") as file:
            file.seek(start)
            return _read(file, size, key, room)


@dataclass(frozen=True)
class RemoteStore:
    """A zarr group in a folder behind a URL, through fsspec."""

    url: str
    checksums: bool = field(default=False, init=False)

    def _open(self) -> tuple[Any, str]:
        fs, path = _file_system(self.url)
        return fs, path.rstrip("/")

    def sizes(self, prefix: str, keys: Iterable[str]) -> Iterator[int | None]:
        """See :class:`Store`."""
        fs, root = self._open()
        if _is_http(fs):
            # Plain HTTP has no listing: ask for every key, a few at a time.
            pending = iter(keys)
            with ThreadPoolExecutor(_CONCURRENT_REQUESTS) as pool:
                while batch := list(islice(pending, 4 * _CONCURRENT_REQUESTS)):
                    yield from pool.map(lambda key: _remote_size(fs, f"{root}/{key}"), batch)
            return
        if not prefix:
            for key in keys:
                yield _remote_size(fs, f"{root}/{key}")
            return
        try:
            fs.invalidate_cache()
            listed = fs.find(f"{root}/{prefix}", detail=True)
        except FileNotFoundError:
            listed = {}
        except Exception as error:
            raise _failure(error)(f"{prefix} cannot be listed ({_said(error)})") from error
        found = {path.removeprefix(f"{root}/"): entry.get("size") for path, entry in listed.items()}
        yield from (found.get(key) for key in keys)

    def read(
        self, key: str, start: int = 0, size: int | None = None, *, verify: bool = False, room: Room | None = None
    ) -> bytes | memoryview:
        """See :class:`Store`."""
        fs, root = self._open()
        return _remote_read(fs, f"{root}/{key}", key, start, size)


@dataclass(frozen=True)
class _Member:
    offset: int
    size: int
    checksum: int


@dataclass(frozen=True)
class ZipStore:
    """A zarr group at the root of a zip file, local or behind a URL; members are stored, not compressed."""

    url: str
    remote: bool
    length: int
    members: dict[str, _Member] = field(repr=False)
    checksums: bool = field(default=True, init=False)

    def sizes(self, prefix: str, keys: Iterable[str]) -> Iterator[int | None]:
        """See :class:`Store`."""
        return (self.members[key].size if key in self.members else None for key in keys)

    def read(
        self, key: str, start: int = 0, size: int | None = None, *, verify: bool = False, room: Room | None = None
    ) -> bytes | memoryview:
        """See :class:`Store`."""
        member = self.members.get(key)
        if member is None:
            raise FileNotFoundError(f"{key} does not exist")
        whole = start == 0 and (size is None or size == member.size)
        size = member.size - start if size is None else size
        if start < 0 or size < 0 or start + size > member.size:
            raise StoreError(f"{key} holds {member.size} bytes, not {start + size}")
        data: bytes | memoryview
        if self.remote:
            data = self._remote(key, member, start, size)
        else:
            data = self._local(key, member, start, size, room)
        if verify and whole and zlib.crc32(data) != member.checksum:
            raise StoreError("the zip file's checksum does not match: the stored bytes were changed")
        return data

    def _begin(self, key: str, header: bytes) -> int:
        if len(header) < _LOCAL_HEADER.size or header[:4] != b"PK\x03\x04":
            raise StoreError(f"{key}: the zip file is damaged (no member where its directory says)")
        *_, name, extra = _LOCAL_HEADER.unpack(header[: _LOCAL_HEADER.size])
        return _LOCAL_HEADER.size + int(name) + int(extra)

    def _local(self, key: str, member: _Member, start: int, size: int, room: Room | None) -> bytes | memoryview:
        with open(self.url, "rb") as file:
            file.seek(member.offset)
            begin = self._begin(key, file.read(_LOCAL_HEADER.size))
            file.seek(member.offset + begin + start)
            return _read(file, size, key, room)

    def _remote(self, key: str, member: _Member, start: int, size: int) -> bytes:
        fs, path = _file_system(self.url)
        ahead = _LOCAL_HEADER.size + len(key.encode()) + _USUAL_EXTRA
        if start == 0:
            fetched = min(ahead + size, self.length - member.offset)
            data = _remote_read(fs, path, key, member.offset, fetched)
            begin = self._begin(key, data)
            if begin + size <= len(data):
                return data[begin : begin + size]
        else:
            begin = self._begin(key, _remote_read(fs, path, key, member.offset, _LOCAL_HEADER.size))
        return _remote_read(fs, path, key, member.offset + begin + start, size)


def open_store(url: str) -> Store:
    """Find out what a path or URL names, and index it where that takes one look.

    Parameters
    ----------
    url : str
        Local path, or a URL of one of :data:`SCHEMES`.

    Returns
    -------
    Store
        For a file (local) or a name that ends in ``.zip`` (remote) a :class:`ZipStore`.

    Raises
    ------
    StoreError
        It does not exist, is no zip file, or its members are compressed.
    """
    for scheme in ("file://", "local://"):
        url = url.removeprefix(scheme)
    if os.path.lexists(url) or ("://" not in url and "::" not in url):
        if os.path.isdir(url):
            return FolderStore(url)
        if not os.path.exists(url):
            raise StoreError("there is no such file or folder; check the path")
        if not os.path.isfile(url):
            raise StoreError("this is neither a folder nor a file")
        length = os.path.getsize(url)
        try:
            with open(url, "rb") as file:
                return ZipStore(url, False, length, _directory(file, length))
        except StoreError:
            raise
        except Exception as error:  # a hostile directory makes zipfile raise nearly anything
            raise StoreError(f"the zip file cannot be read ({_said(error)}); copy it again") from error
    fs, path = _file_system(url)
    if not (urlsplit(url).path or url).endswith(".zip"):
        return RemoteStore(url)
    size = _remote_size(fs, path)
    if size is None:
        raise StoreError("there is no such file, or its server does not tell its size; check the URL")
    try:
        with fs.open(path, "rb", cache_type="readahead", block_size=2**20) as file:
            return ZipStore(url, True, size, _directory(file, size))
    except StoreError:
        raise
    except Exception as error:
        raise _failure(error)(
            f"the zip file cannot be read where it is ({_said(error)}); its server may not support byte "
            "ranges: download it and open the copy"
        ) from error


def shown(url: str) -> str:
    """The URL without user name, password and query, for messages and products."""
    parts = urlsplit(url)
    if "://" not in url or not (parts.query or parts.username or parts.password):
        return url
    host = parts.hostname or ""
    return f"{parts.scheme}://{host}{f':{parts.port}' if parts.port else ''}{parts.path}"


def _directory(file: Any, length: int) -> dict[str, _Member]:
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
    except zipfile.BadZipFile as error:
        raise StoreError(
            f"this is no zip file, or its end is cut off ({_said(error)}); copy it again, or name the folder"
        ) from error
    members: dict[str, _Member] = {}
    for entry in entries:
        if entry.is_dir():
            continue
        if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 0x1:
            raise StoreError(
                f"member '{entry.filename[:100]}' is {'encrypted' if entry.flag_bits & 0x1 else 'compressed'}, "
                "but members of an archive are stored as they are; unpack it and name the folder, or pack the "
                "contents of the folder with 'zip -0 -r'"
            )
        if entry.header_offset < 0 or entry.header_offset + entry.file_size > length:
            raise StoreError(f"member '{entry.filename[:100]}' ends beyond the end of the file; copy it again")
        # Later entries of one name replace earlier ones, as for every reader of zip files.
        members[entry.filename] = _Member(entry.header_offset, entry.file_size, entry.CRC)
    return members


def _said(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:200]}" if lines else type(error).__name__


def _file_system(url: str) -> tuple[Any, str]:
    scheme = urlsplit(url).scheme.lower()
    if scheme not in SCHEMES or "::" in url:
        raise StoreError(
            f"archives are not read from this kind of URL; write one of {', '.join(f'{name}://' for name in SCHEMES)}, "
            "or download the archive and name the copy"
        )
    import fsspec

    try:
        fs, path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise StoreError(
            f"{scheme}:// needs a package that is not installed: pip install '{SCHEMES[scheme]}', on every worker too "
            f"({_said(error)})"
        ) from error
    except Exception as error:
        raise _failure(error)(f"this URL cannot be opened ({_said(error)})") from error
    return fs, str(path)


def _is_http(fs: Any) -> bool:
    protocol = fs.protocol if isinstance(fs.protocol, (tuple, list)) else (fs.protocol,)
    return "http" in protocol or "https" in protocol


def _absent(fs: Any, error: BaseException) -> bool:
    if not isinstance(error, FileNotFoundError):
        return False
    # fsspec reports every failure of an HTTP request for information as "not found"; only these mean it.
    # Object stores answer 403 for a key that is not there when listing is not permitted.
    return not _is_http(fs) or getattr(error.__cause__, "status", None) in (403, 404, 410)


def _failure(error: BaseException) -> type[StoreError]:
    """What an exception of a remote file system amounts to: a network or server that may be back soon, or not."""
    status = getattr(error, "status", None)
    if isinstance(status, int):
        return UnreachableStore if status in (408, 429) or status >= 500 else StoreError
    # Names that nobody has, and places that want to know who we are, are no better in a second.
    lasting = isinstance(error, (PermissionError, FileNotFoundError)) or "NONAME" in str(error)
    network = isinstance(error, (OSError, TimeoutError)) or type(error).__name__ in _NETWORK
    return UnreachableStore if network and not lasting else StoreError


def _access(error: BaseException) -> str:
    """What to do where a store wants to know who asks."""
    if type(error).__name__ != "NoCredentialsError":
        return ""
    return "; set AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, here and on every worker"


def _remote_size(fs: Any, path: str) -> int | None:
    try:
        entry = fs.info(path)
    except Exception as error:
        if _absent(fs, error):
            return None
        cause = error.__cause__ or error
        raise _failure(cause)(f"the server does not answer as it should ({_said(cause)}){_access(cause)}") from error
    if entry.get("type") == "directory":
        return None
    if entry.get("size") is None:
        raise StoreError("the server does not tell the size of its files; download the archive and open the copy")
    return int(entry["size"])


def _remote_read(fs: Any, path: str, key: str, start: int, size: int | None) -> bytes:
    if size == 0:
        return b""
    whole = start == 0 and size is None
    if size is None and start:
        total = _remote_size(fs, path)
        size = (total or 0) - start
    try:
        data = bytes(fs.cat_file(path) if whole else fs.cat_file(path, start=start, end=start + (size or 0)))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{key} does not exist") from error
    except Exception as error:
        raise UnreachableStore(f"{key} cannot be read ({_said(error)})") from error
    if size is not None and len(data) > size:
        raise StoreError("the server ignores byte ranges; download the archive and open the copy")
    if size is not None and len(data) < size:
        # The file was as long as it should be when the archive was opened.
        raise UnreachableStore(f"{key} ended after {len(data)} of {size} bytes")
    return data
