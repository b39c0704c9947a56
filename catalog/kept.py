"""Intermediate results that later runs can use: correlations of batches, response matrices.

One file of plain arrays under the key of the result, written whole or not at all. A damaged file is no file.
"""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .products import check_digest, temporary_name

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from ..pipeline.lineage import Key


class Kept:
    """Store of arrays under the key of what made them.

    Safe for any number of threads and processes: writers of one key write the same, and the last one stays.

    Parameters
    ----------
    folder : path
        Made when the first result is saved.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    def path(self, key: Key | str) -> Path:
        """File of a result."""
        digest = check_digest(str(key), "key of a result")
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
            with np.load(self.path(key), allow_pickle=False) as packed:
                return {name: packed[name] for name in packed.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
