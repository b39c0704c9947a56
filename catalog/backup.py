"""A copy of a catalog: rows as they were at one moment, and the files that belong to them."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING

import sqlalchemy as sa

from ..pipeline.units import safe
from .database import DATABASE_FILE, Database, is_catalog
from .products import sync_folder, temporary_name
from .rows import PRODUCTS, CatalogError, Fault, ProductRow, product_row
from .tables import metadata, product, schema_version

if TYPE_CHECKING:
    from .store import Catalog

#: File that tells a backup from a catalog in use.
MARK = "backup.json"
_ROWS = 1000


@dataclass(frozen=True)
class Backup:
    """What a backup did.

    Parameters
    ----------
    copied, present : int
        Products that were copied, and that an earlier backup to the same place had copied.
    faults : tuple of Fault
        Products that could not be copied as their rows say; the backup has their rows and not their files.
    """

    copied: int
    present: int
    faults: tuple[Fault, ...]


def backup(catalog: Catalog, destination: str | os.PathLike[str]) -> Backup:
    """Copy a catalog, however many runs are writing to it.

    The copy is a catalog with an SQLite database, wherever the original keeps its own. Done again, it copies what is
    new. Kept correlations and other intermediate results are not copied: they can be computed.

    Parameters
    ----------
    catalog : Catalog
        What to copy.
    destination : path
        Folder for the copy: new, empty, or an earlier backup.

    Returns
    -------
    Backup

    Raises
    ------
    CatalogError
        The folder holds something else.
    OSError
        The folder cannot be written.
    """
    target = Path(destination).absolute()
    inside = target.resolve().is_relative_to(catalog.root.resolve())
    if inside or catalog.root.resolve().is_relative_to(target.resolve()):
        raise CatalogError(f"{safe(str(target))}: a backup and its catalog cannot lie in one another")
    if target.exists() and not (target / MARK).is_file() and (is_catalog(target) or any(target.iterdir())):
        raise CatalogError(f"{safe(str(target))}: this is no backup, and it is not empty; name another folder")
    (target / "products").mkdir(parents=True, exist_ok=True)
    (target / MARK).write_text(json.dumps({"of": str(catalog.root), "begun": time_ns()}) + "\n", encoding="utf-8")
    temporary = target / f"{temporary_name()}.sqlite"
    try:
        rows = _copy_rows(catalog, temporary)
        copied, faults = 0, []
        for row in rows:
            try:
                copied += _copy_file(row, target / row.path.relative_to(catalog.root))
            except (OSError, CatalogError) as error:
                reason = str(error) if isinstance(error, CatalogError) else f"it cannot be copied: {error.strerror}"
                faults.append(Fault(row, reason))
        # Last, so that a backup that is cut off keeps the rows of the one before.
        os.replace(temporary, target / DATABASE_FILE)
        sync_folder(target)
    finally:
        temporary.unlink(missing_ok=True)
    return Backup(copied, len(rows) - copied - len(faults), tuple(faults))


def _copy_rows(catalog: Catalog, file: Path) -> list[ProductRow]:
    """All rows of one moment, into a new SQLite file."""
    copy = Database(sa.URL.create("sqlite", database=str(file)))
    try:
        with catalog.database.snapshot() as source, copy.write() as into:
            for table in metadata.sorted_tables:
                if table is schema_version:
                    continue  # the new file has its own
                found = source.execute(sa.select(table)).mappings()
                for part in found.partitions(_ROWS):
                    into.execute(sa.insert(table), [dict(row) for row in part])
        with copy.read() as connection:
            rows = [product_row(catalog.root, row) for row in connection.execute(PRODUCTS.order_by(product.c.id))]
        with copy.engine.connect() as connection:
            # One file and no journal beside it, so that it can be renamed.
            raw = connection.connection.driver_connection
            assert raw is not None
            raw.execute("PRAGMA journal_mode = delete")
    finally:
        copy.close()
    return rows


def _copy_file(row: ProductRow, target: Path) -> bool:
    """Copy a product unless it is there; False where it was."""
    if target.is_file() and _digest(target) == row.sha256:
        return False
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.parent / temporary_name()
    try:
        shutil.copyfile(row.path, temporary)
        if _digest(temporary) != row.sha256:
            raise CatalogError("the file has changed since it was published")
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
        sync_folder(target.parent)
    finally:
        temporary.unlink(missing_ok=True)
    return True


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
