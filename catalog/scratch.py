"""Finished batches of products that are not finished: what a killed run need not compute again.

One file per batch under the key of its result, written whole or not at all. No waiting for the disk: after a power
cut a file may be damaged, and a damaged file is no file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from time import time
from typing import TYPE_CHECKING

import numpy as np

from ..pipeline.products import COORDINATES, SCHEMA, BatchResult
from .kept import Kept

if TYPE_CHECKING:
    from ..pipeline.lineage import Key

_FORMAT = 1
_META = "__batch__"


class Scratch:
    """Store of finished batches.

    Safe for any number of threads and processes, also on several hosts with a common folder: writers of one key
    write the same, and the last one stays.

    Parameters
    ----------
    folder : path
        Made when the first batch is saved.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self._kept = Kept(folder, "batch")

    def path(self, key: Key | str) -> Path:
        """File of a batch.

        Raises
        ------
        coslidar.catalog.products.ProductError
            The key is not 64 hexadecimal digits.
        """
        return self._kept.path(key)

    def save(self, key: Key | str, result: BatchResult) -> None:
        """Keep a finished batch.

        Parameters
        ----------
        key : Key or str
            Key of the result.
        result : BatchResult
            Also one that failed for a reason in the data; not one that failed for a reason in the machine.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        meta = {
            "format": _FORMAT,
            "key": str(key),
            "start": result.start,
            "stop": result.stop,
            "quality_flag": result.quality_flag,
            "reason": result.reason,
            "names": sorted(result.values),
        }
        arrays = {name: np.asarray(value) for name, value in result.values.items()}
        if _META in arrays or any(value.dtype.hasobject for value in arrays.values()):
            raise ValueError("a batch holds plain arrays only")
        self._kept.save(key, {_META: np.array(json.dumps(meta)), **arrays})

    def load(self, key: Key | str) -> BatchResult | None:
        """A batch that was finished earlier.

        Parameters
        ----------
        key : Key or str
            Key of the result.

        Returns
        -------
        BatchResult or None
            None where it is not there, damaged, of another key, or holds what a product does not know.
        """
        values = self._kept.load(key)
        if values is None:
            return None
        try:
            meta = json.loads(str(values.pop(_META)))
            if meta["format"] != _FORMAT or meta["key"] != str(key):
                return None
            result = BatchResult(
                int(meta["start"]), int(meta["stop"]), values, int(meta["quality_flag"]), str(meta["reason"])
            )
        except (ValueError, KeyError, TypeError):
            return None
        known = all(name in SCHEMA or name in COORDINATES for name in values)
        return result if known and sorted(values) == meta["names"] else None

    def remove(self, keys: Iterable[Key | str]) -> None:
        """Forget batches, as after their product was published; what is not there is no fault."""
        for key in keys:
            self.path(key).unlink(missing_ok=True)

    def sweep(self, older_than: float = 30 * 86400.0) -> int:
        """Remove what nobody came back for.

        Parameters
        ----------
        older_than : float
            Age in s from which a batch is removed. Halves of files go after one day.

        Returns
        -------
        int
            Number of files removed.
        """
        removed, now = 0, time()
        for file in [*self.folder.glob("??/*.npz"), *self.folder.glob("??/.*.part")]:
            limit = min(older_than, 86400.0) if file.suffix == ".part" else older_than
            try:
                if now - file.stat().st_mtime >= limit:
                    file.unlink()
                    removed += 1
            except FileNotFoundError:
                continue
        return removed
