"""Intermediate results that later runs can use: correlations of batches, response matrices.

One file of plain arrays under the key of the result, written whole or not at all. A damaged file is no file: the
checksums inside a zip do not cover all of it, so a hash of the whole stands at its end.
"""

from __future__ import annotations

import hashlib
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .products import check_digest, temporary_name

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from ..pipeline.lineage import Key

_DIGEST = hashlib.sha256().digest_size


class Kept:
    """Store of arrays under the key of what made them.

    Safe for any number of threads and processes: writers of one key write the same, and the last one stays.

    Parameters
    ----------
    folder : path
        Made when the first result is saved.
    what : str
        What is kept, for messages.
    """

    def __init__(self, folder: str | os.PathLike[str], what: str = "result") -> None:
        self.folder = Path(folder)
        self._what = what

    def path(self, key: Key | str) -> Path:
        """File of a result."""
        digest = check_digest(str(key), f"key of a {self._what}")
        return self.folder / digest[:2] / f"{digest}.npz"

    def has(self, key: Key | str) -> bool:
        """Whether there is a file, sound or not."""
        return self.path(key).is_file()

    def save(self, key: Key | str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        target = self.path(key)
        packed = io.BytesIO()
        np.savez(packed, allow_pickle=False, **arrays)
        packed.write(hashlib.sha256(packed.getbuffer()).digest())
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.parent / temporary_name()
        try:
            temporary.write_bytes(packed.getvalue())
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)

    def load(self, key: Key | str) -> dict[str, NDArray[Any]] | None:
        """Arrays that were kept earlier; None where they are not there or damaged."""
        try:
            content = self.path(key).read_bytes()
        except OSError:
            return None
        packed, digest = content[:-_DIGEST], content[-_DIGEST:]
        if hashlib.sha256(packed).digest() != digest:
            return None
        with np.load(io.BytesIO(packed), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
