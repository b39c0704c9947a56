"""Slopes and fluxes of batches, kept so that other correlations of them read no frame.

One zarr v3 group in a zip for each batch, under the key of what was measured, so that any zarr reader opens it. It is
written whole or not at all; its hash stands in the comment at the end of the zip, and a file that does not have it is
no file. Workers write here, the only place where they do: the frames of a batch become 1 kB each, too much to send.
"""

from __future__ import annotations

import hashlib
import io
import os
import struct
import zipfile
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..pipeline.products import Measurements
from .products import check_digest, group_bytes, temporary_name

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..pipeline.lineage import Key

#: Array -> (dimensions, unit).
ARRAYS: dict[str, tuple[tuple[str, ...], str]] = {
    "time": (("time",), "ns"),
    "slopes": (("time", "axis", "source", "subaperture"), "rad"),
    "flux": (("time", "source", "subaperture"), "count"),
    "flag": (("time", "source", "subaperture"), "1"),
    "flux_noise": (("source", "subaperture"), "count^2"),
    "slope_noise": (("axis", "source", "subaperture"), "rad^2"),
    "centroid_gain": (("axis", "source"), "1"),
}
_MARK = b"sha256:"
_COMMENT = len(_MARK) + 64


class MeasurementStore:
    """Folder of measured batches.

    Safe for any number of threads and processes, also on several hosts: writers of one key write the same.

    Parameters
    ----------
    folder : path
        Must exist where it is written to: a worker that does not see the catalog's disk is to say so, and not to fill
        its own.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    def path(self, key: Key | str) -> Path:
        """File of a batch."""
        digest = check_digest(str(key), "key of measurements")
        return self.folder / digest[:2] / f"{digest}.zarr.zip"

    def has(self, key: Key | str) -> bool:
        """Whether there is a file, sound or not."""
        return self.path(key).is_file()

    def save(self, key: Key | str, measured: Measurements) -> int:
        """Keep a batch.

        Parameters
        ----------
        key : Key or str
            Of the batch.
        measured : Measurements
            Its slopes and fluxes.

        Returns
        -------
        int
            Bytes of the file.

        Raises
        ------
        OSError
            The folder is not there, or the file cannot be written.
        """
        arrays = {
            name: (getattr(measured, name), dimensions, {"units": unit}) for name, (dimensions, unit) in ARRAYS.items()
        }
        content = _sealed(group_bytes(arrays, {"measurements": 1, "key": str(key)}))
        target = self.path(key)
        target.parent.mkdir(exist_ok=True)
        temporary = target.parent / temporary_name()
        try:
            temporary.write_bytes(content)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
        return len(content)

    def load(self, key: Key | str) -> Measurements | None:
        """A batch that was kept earlier; None where it is not there or damaged."""
        try:
            content = _unsealed(self.path(key).read_bytes())
        except OSError:
            return None
        if content is None:
            return None
        arrays = _arrays(content)
        return Measurements(**arrays) if {field.name for field in fields(Measurements)} == set(arrays) else None


def _sealed(zipped: bytes) -> bytes:
    """The zip with the hash of its bytes as its comment."""
    comment = _MARK + hashlib.sha256(zipped).hexdigest().encode()
    return zipped[:-2] + struct.pack("<H", len(comment)) + comment


def _unsealed(content: bytes) -> bytes | None:
    """The zip without its comment; None where it is not what was written."""
    whole, comment = content[:-_COMMENT], content[-_COMMENT:]
    zipped = whole[:-2] + b"\0\0"
    sound = whole[-2:] == struct.pack("<H", _COMMENT) and comment == _MARK + hashlib.sha256(zipped).hexdigest().encode()
    return zipped if sound else None


def _arrays(zipped: bytes) -> dict[str, NDArray[Any]]:
    import zarr
    from zarr.buffer.cpu import Buffer

    with zipfile.ZipFile(io.BytesIO(zipped)) as archive:
        members: dict[str, Any] = {name: Buffer.from_bytes(archive.read(name)) for name in archive.namelist()}
    group = zarr.open_group(zarr.storage.MemoryStore(members), mode="r")
    return {name: np.asarray(array[...]) for name, array in group.arrays()}
