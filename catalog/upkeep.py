"""Files against rows: what is damaged, what is left over, and a copy of everything."""

from __future__ import annotations

import hashlib
import re
import socket
from pathlib import Path
from time import time
from typing import TYPE_CHECKING

import sqlalchemy as sa

from .database import Database
from .heartbeats import alive
from .rows import PRODUCTS, SUFFIX, Fault, product_row
from .tables import product, schema_version

if TYPE_CHECKING:
    from sqlalchemy.engine import Connection


class Upkeep:
    """What keeps the files of a catalog and its rows in step."""

    root: Path
    database: Database

    def verify(self, *, fast: bool = False) -> list[Fault]:
        """Compare every file with its row.

        Parameters
        ----------
        fast : bool
            Compare sizes only, not hashes.

        Returns
        -------
        list of Fault
            Empty where all is well.
        """
        faults = []
        with self.database.read() as connection:
            rows = [product_row(self.root, row) for row in connection.execute(PRODUCTS.order_by(product.c.id))]
        for row in rows:
            try:
                size = row.path.stat().st_size
                if size != row.size:
                    faults.append(Fault(row, f"the file has {size} bytes instead of {row.size}"))
                elif not fast:
                    with open(row.path, "rb") as file:
                        found = hashlib.file_digest(file, "sha256").hexdigest()
                    if found != row.sha256:
                        faults.append(Fault(row, "the file has changed since it was published"))
            except FileNotFoundError:
                faults.append(Fault(row, "the file is missing"))
            except OSError as error:
                faults.append(Fault(row, f"the file cannot be read: {error.strerror}"))
        return faults

    def orphans(self, *, older_than: float = 3600.0) -> list[Path]:
        """Files that belong to no row and to no living publisher; see :meth:`collect`."""
        with self.database.write() as connection:
            return self._orphans(connection, older_than)

    def collect(self, *, older_than: float = 3600.0) -> list[Path]:
        """Remove files that belong to no row and to no living publisher.

        Parameters
        ----------
        older_than : float
            Age in s from which a half-written file counts as left behind; one minute at most where its process is
            known to be gone.

        Returns
        -------
        list of Path
            What was removed.
        """
        with self.database.write() as connection:
            found = self._orphans(connection, older_than)
            for path in found:
                path.unlink(missing_ok=True)
        return found

    def _orphans(self, connection: Connection, older_than: float) -> list[Path]:
        # No publisher is between naming its file and committing its row while this is held.
        connection.execute(sa.select(schema_version.c.version).with_for_update())
        listed = set(connection.scalars(sa.select(product.c.path)))
        found = []
        for path in sorted((self.root / "products").glob("*/*")):
            if path.is_symlink() or not path.is_file():
                continue
            relative = path.relative_to(self.root).as_posix()
            whole = path.name.endswith(SUFFIX) and not path.name.startswith(".") and relative not in listed
            if whole or _left_behind(path, older_than):
                found.append(path)
        return found


def _left_behind(path: Path, older_than: float) -> bool:
    """Whether a half-written file has lost its writer."""
    match = re.fullmatch(r"\.[0-9a-f]{16}\.([A-Za-z0-9-]*)\.(\d{1,10})\.part", path.name)
    if match is None:
        return False
    here = re.sub(r"[^A-Za-z0-9]", "-", socket.gethostname())[:60]
    # Containers may share a name and not their processes, so even a process that is gone gets a minute.
    gone = match[1] == here and not alive(int(match[2]))
    try:
        return time() - path.stat().st_mtime >= (min(older_than, 60.0) if gone else older_than)
    except FileNotFoundError:
        return False
