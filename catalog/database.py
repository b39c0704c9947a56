"""Tables of the catalog, for SQLite and PostgreSQL from one definition.

Times are integers, ns since 1970-01-01T00:00:00 UTC, because both databases hold those alike. What a query asks for
(time, quality, r0, scintillation) stands in the batch rows, so that no query opens a file.
"""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine, make_url

from ..pipeline.units import safe

#: Version of the tables.
SCHEMA_VERSION = 1
#: How long a writer waits for another, s.
BUSY_TIMEOUT = 60.0
#: File systems on which several hosts see one file, and on which the shared memory of WAL does not work.
NETWORK_FILE_SYSTEMS = frozenset(
    (
        *("9p", "afs", "afpfs", "beegfs", "ceph", "cifs", "coda", "davfs", "fhgfs", "gfs", "gfs2", "glusterfs", "gpfs"),
        *("lustre", "ncpfs", "nfs", "nfs4", "ocfs2", "orangefs", "panfs", "pvfs2", "quobyte", "smb2", "smb3", "smbfs"),
        *("virtiofs", "wekafs", "sshfs", "s3fs", "rclone", "gcsfuse"),
    )
)

metadata = sa.MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)

schema_version = sa.Table("schema_version", metadata, sa.Column("version", sa.Integer, primary_key=True))

campaign = sa.Table(
    "campaign",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("name", sa.String(100), nullable=False, unique=True),
)

archive = sa.Table(
    "archive",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("campaign_id", sa.ForeignKey("campaign.id"), nullable=False, index=True),
    sa.Column("name", sa.String(100), nullable=False, index=True),
    sa.Column("identity", sa.String(64), nullable=False, unique=True),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("header", sa.JSON, nullable=False),
    sa.CheckConstraint("length(identity) = 64", name="identity"),
)

lineage = sa.Table(
    "lineage",
    metadata,
    sa.Column("key", sa.String(64), primary_key=True),
    sa.Column("stage", sa.String(100), nullable=False),
    sa.Column("document", sa.JSON, nullable=False),
    sa.CheckConstraint("length(key) = 64", name="key"),
)

run = sa.Table(
    "run",
    metadata,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("started", sa.BigInteger, nullable=False, index=True),
    sa.Column("finished", sa.BigInteger),
    sa.Column("state", sa.String(20), nullable=False),
    sa.Column("host", sa.Text, nullable=False),
    sa.Column("process", sa.Integer, nullable=False),
    sa.Column("command", sa.Text, nullable=False),
    sa.Column("commit", sa.Text, nullable=False),
    sa.Column("software", sa.JSON, nullable=False),
    sa.Column("configuration", sa.JSON, nullable=False),
    sa.CheckConstraint("state in ('running', 'finished', 'failed', 'cancelled', 'interrupted')", name="state"),
)

product = sa.Table(
    "product",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("archive_id", sa.ForeignKey("archive.id"), nullable=False),
    sa.Column("lineage_key", sa.ForeignKey("lineage.key"), nullable=False, index=True),
    sa.Column("run_id", sa.ForeignKey("run.id"), index=True),
    sa.Column("path", sa.String(400), nullable=False, unique=True),
    sa.Column("sha256", sa.String(64), nullable=False),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("published", sa.BigInteger, nullable=False),
    sa.Column("start", sa.BigInteger, nullable=False, index=True),
    sa.Column("stop", sa.BigInteger, nullable=False),
    sa.Column("batches", sa.Integer, nullable=False),
    sa.UniqueConstraint("archive_id", "lineage_key"),
    sa.CheckConstraint("length(sha256) = 64", name="sha256"),
)

batch = sa.Table(
    "batch",
    metadata,
    sa.Column("product_id", sa.ForeignKey("product.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("start", sa.BigInteger, nullable=False, index=True),
    sa.Column("stop", sa.BigInteger, nullable=False),
    sa.Column("quality_flag", sa.Integer, nullable=False),
    sa.Column("quality_level", sa.SmallInteger, nullable=False, index=True),
    sa.Column("n_frames", sa.BigInteger),
    sa.Column("r0", sa.Double, index=True),
    sa.Column("scintillation_index", sa.Double, index=True),
    sa.Column("scintillation_index_profile", sa.Double),
    sa.Column("scintillation_index_point", sa.Double),
    sa.Column("mu", sa.Double),
    sa.Column("chi2", sa.Double),
    sa.CheckConstraint("stop > start", name="time"),
    sa.CheckConstraint("quality_level between 0 and 2", name="quality_level"),
)

failure = sa.Table(
    "failure",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("run_id", sa.ForeignKey("run.id"), nullable=False, index=True),
    sa.Column("archive", sa.Text, nullable=False),
    sa.Column("start", sa.BigInteger),
    sa.Column("stop", sa.BigInteger),
    sa.Column("reason", sa.Text, nullable=False),
    sa.Column("recorded", sa.BigInteger, nullable=False),
)


class DatabaseError(RuntimeError):
    """A database that cannot serve as a catalog."""


def network_file_system(path: Path, mounts: Path = Path("/proc/self/mountinfo")) -> str | None:
    """Type of the network file system that a path lies on.

    Parameters
    ----------
    path : Path
        Any path; it need not exist.
    mounts : Path
        Table of mounts, as Linux keeps it.

    Returns
    -------
    str or None
        For example ``"nfs4"``; None on a local disk, and where the system does not tell.
    """
    try:
        lines = mounts.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    real, found, longest = path.resolve(), None, -1
    for line in lines:
        before, separator, after = line.partition(" - ")
        fields, kinds = before.split(), after.split()
        if not separator or len(fields) < 5 or not kinds:
            continue
        point = Path(fields[4].replace("\\040", " ").replace("\\011", "\t").replace("\\134", "\\"))
        # Of two mounts on one point the later one is seen.
        if real.is_relative_to(point) and len(point.parts) >= longest:
            longest, found = len(point.parts), kinds[0]
    if found is None:
        return None
    return found if found.removeprefix("fuse.") in NETWORK_FILE_SYSTEMS else None


class Database:
    """Connection to the tables of a catalog.

    Parameters
    ----------
    url : str or URL
        SQLAlchemy URL, ``sqlite:///…`` or ``postgresql+psycopg://…``.
    create : bool
        Make the tables where there are none.

    Raises
    ------
    DatabaseError
        The database cannot be reached, holds no catalog, or one that a newer version wrote.
    """

    def __init__(self, url: str | URL, *, create: bool = True) -> None:
        try:
            self.url = make_url(url)
        except sa.exc.ArgumentError as error:
            raise DatabaseError("the database URL cannot be read; write sqlite:///FILE or postgresql://…") from error
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        self.name = safe(self.url.render_as_string(hide_password=True))
        options: dict[str, Any] = {"connect_args": {"timeout": BUSY_TIMEOUT}} if self.is_sqlite else {}
        try:
            self.engine: Engine = sa.create_engine(self.url, **options)
        except (ImportError, sa.exc.ArgumentError) as error:
            raise DatabaseError(f"{self.name}: the driver of this database cannot be loaded: {error}") from error
        if self.is_sqlite:
            self._prepare_sqlite(create)
        self._open(create)

    def _prepare_sqlite(self, create: bool) -> None:
        if not self.url.database or self.url.database == ":memory:":
            raise DatabaseError("a catalog needs a file: another process must be able to open it")
        file = Path(self.url.database)
        if not create and not file.is_file():
            raise DatabaseError(f"{safe(str(file))}: there is no catalog")
        wanted = "delete" if network_file_system(file.parent) else "wal"

        @sa.event.listens_for(self.engine, "connect")
        def _connect(connection: sqlite3.Connection, _record: object) -> None:
            # The driver must not begin transactions of its own: it does so late, and never IMMEDIATE.
            connection.isolation_level = None
            for pragma in (f"busy_timeout = {int(BUSY_TIMEOUT * 1000)}", "synchronous = FULL", "foreign_keys = ON"):
                connection.execute(f"PRAGMA {pragma}")

        @sa.event.listens_for(self.engine, "begin")
        def _begin(connection: Connection) -> None:
            # A writer that begins as a reader and is overtaken fails at once, however long it is told to wait.
            writes = connection.get_execution_options().get("coslidar_write", False)
            connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

        deadline = time.monotonic() + BUSY_TIMEOUT
        while True:
            try:
                connection = sqlite3.connect(file, timeout=BUSY_TIMEOUT)
                try:
                    if connection.execute("PRAGMA journal_mode").fetchone()[0] != wanted:
                        connection.execute(f"PRAGMA journal_mode = {wanted}")
                finally:
                    connection.close()
                return
            except sqlite3.Error as error:
                # Changing the journal takes the file alone, and SQLite does not wait for that.
                if "locked" not in str(error) or time.monotonic() > deadline:
                    raise DatabaseError(
                        f"{safe(str(file))}: this is no catalog, or it cannot be used: {error}"
                    ) from error
                time.sleep(0.05)

    def _open(self, create: bool) -> None:
        try:
            for attempt in range(3):
                try:
                    with self.read() as connection:
                        present = sa.inspect(connection).has_table("schema_version")
                        version = connection.scalar(sa.select(schema_version.c.version)) if present else None
                    if version is None and create:
                        with self.write() as connection:
                            metadata.create_all(connection)
                            self.insert_new(
                                connection, schema_version, {"version": SCHEMA_VERSION}, schema_version.c.version
                            )
                        continue
                    break
                except (sa.exc.IntegrityError, sa.exc.ProgrammingError):
                    # Two processes made the tables at once; the other one has.
                    if attempt == 2:
                        raise
        except sa.exc.SQLAlchemyError as error:
            reason = safe(str(getattr(error, "orig", None) or error))
            raise DatabaseError(f"{self.name}: the catalog cannot be opened: {reason}") from error
        if version is None:
            raise DatabaseError(f"{self.name}: this database holds no catalog")
        if version > SCHEMA_VERSION:
            raise DatabaseError(
                f"{self.name}: a newer coslidar wrote this catalog (tables version {version}; this one knows "
                f"{SCHEMA_VERSION}); install that version, or use another catalog"
            )
        if version < SCHEMA_VERSION:
            raise DatabaseError(
                f"{self.name}: the catalog has tables of version {version}, this coslidar works with {SCHEMA_VERSION}"
            )

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that changes nothing."""
        with self.engine.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """A transaction that is there wholly once the block ends, and not at all where it raises."""
        with self.engine.connect().execution_options(coslidar_write=True) as connection, connection.begin():
            yield connection

    def insert_new(
        self, connection: Connection, table: sa.Table, values: Mapping[str, Any], returned: sa.Column[Any]
    ) -> Any:
        """Insert a row unless a unique constraint says that it is there.

        Parameters
        ----------
        connection : Connection
            From :meth:`write`.
        table : Table
            Where to.
        values : mapping
            Columns.
        returned : Column
            Column to return.

        Returns
        -------
        object
            `returned` of the new row; None where there was one. (The count of rows cannot be relied on: it is -1 on
            PostgreSQL.)
        """
        insert = sqlite.insert if self.is_sqlite else postgresql.insert
        statement = insert(table).values(**values).on_conflict_do_nothing().returning(returned)
        return connection.execute(statement).scalar()

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


def number(value: Any) -> float | None:
    """A float for the database, which holds an unknown one as NULL and an infinite one not at all."""
    return float(value) if math.isfinite(float(value)) else None


def plain_text(value: object, limit: int = 10_000) -> str:
    """Text that every database takes: no NUL, no half characters, not longer than `limit`."""
    cut = str(value)[:limit]
    return cut.encode("utf-8", "backslashreplace").decode("utf-8").replace("\0", "\\0")
