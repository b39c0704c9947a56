"""The database of a catalog: where it is, how it is opened, and how old tables become new ones."""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL, Connection, Engine, make_url

from ..pipeline.units import safe
from .tables import SCHEMA_VERSION, metadata, schema_version

#: File in the folder of a catalog that names its database, where that is not the SQLite file beside it.
URL_FILE = "database.url"
DATABASE_FILE = "catalog.sqlite"
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

#: alembic's own record of where the tables are.
_alembic_version = sa.Table("alembic_version", sa.MetaData(), sa.Column("version_num", sa.String(32), primary_key=True))


class DatabaseError(RuntimeError):
    """A database that cannot serve as a catalog."""


class OldTables(DatabaseError):
    """A catalog whose tables an older version made."""


def is_catalog(root: Path) -> bool:
    """Whether a folder has a catalog."""
    return (root / URL_FILE).is_file() or (root / DATABASE_FILE).is_file()


def location(root: Path) -> URL:
    """Where the database of a catalog is.

    Parameters
    ----------
    root : Path
        Folder of the catalog.

    Returns
    -------
    URL
        What its file ``database.url`` says; its own SQLite file where there is none.

    Raises
    ------
    DatabaseError
        The file cannot be read, or holds no URL.
    """
    file = root / URL_FILE
    try:
        text = file.read_text(encoding="utf-8").strip()
    except FileNotFoundError:
        return sa.URL.create("sqlite", database=str(root / DATABASE_FILE))
    except (OSError, UnicodeDecodeError) as error:
        raise DatabaseError(f"{safe(str(file))}: the file cannot be read: {error}") from error
    return database_url(text, safe(str(file)))


def database_url(text: str, origin: str = "the database URL") -> URL:
    """Read the URL of a database.

    Parameters
    ----------
    text : str
        ``postgresql://USER@HOST/NAME`` or ``sqlite:///FILE``.
    origin : str
        Where it stands, for messages.

    Returns
    -------
    URL
        With the driver that coslidar installs.

    Raises
    ------
    DatabaseError
        It is no URL, or that of another kind of database.
    """
    try:
        url = make_url(text)
    except (sa.exc.ArgumentError, ValueError):  # the second where a port is no number
        url = None
    if url is None or url.get_backend_name() not in ("postgresql", "sqlite"):
        # The text is not repeated: it may hold a password.
        raise DatabaseError(f"{origin} cannot be read; write postgresql://USER@HOST/NAME or sqlite:///FILE")
    return url.set(drivername="postgresql+psycopg") if url.drivername == "postgresql" else url


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


def remember(root: Path, url: str) -> None:
    """Note in the folder of a catalog which database it has.

    Raises
    ------
    DatabaseError
        The URL holds a password, which everybody who sees the folder could read, or the file cannot be written.
    """
    read = database_url(url)
    if read.password is not None:
        raise DatabaseError(
            "the URL holds a password, and the folder of a catalog is no place for it; leave it out, and put it into "
            "~/.pgpass or PGPASSWORD"
        )
    try:
        (root / URL_FILE).write_text(read.render_as_string() + "\n", encoding="utf-8")
    except OSError as error:
        raise DatabaseError(f"{safe(str(root / URL_FILE))}: the file cannot be written: {error.strerror}") from error


def keep_copy(url: URL) -> Path | None:
    """Copy an SQLite database to a file beside it; None where it is none.

    Raises
    ------
    DatabaseError
        It cannot be copied.
    """
    if url.get_backend_name() != "sqlite" or not url.database:
        return None
    file = Path(url.database)
    copy = file.with_name(f"{file.name}.{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}")
    try:
        with closing(sqlite3.connect(file, timeout=BUSY_TIMEOUT)) as source, closing(sqlite3.connect(copy)) as target:
            source.backup(target)
    except sqlite3.Error as error:
        raise DatabaseError(
            f"{safe(str(copy))}: the catalog could not be copied before its upgrade: {error}"
        ) from error
    return copy


class Database:
    """Connection to the tables of a catalog.

    Parameters
    ----------
    url : str or URL
        SQLAlchemy URL, ``sqlite:///…`` or ``postgresql+psycopg://…``.
    create : bool
        Make the tables where there are none.
    read_only : bool
        Let the database itself refuse every change.
    upgrade : bool
        Bring old tables up to date instead of refusing them.

    Raises
    ------
    OldTables
        An older version made the tables, and they are not to be changed.
    DatabaseError
        The database cannot be reached, holds no catalog, or one that a newer version wrote.
    """

    def __init__(self, url: str | URL, *, create: bool = True, read_only: bool = False, upgrade: bool = False) -> None:
        self.url = database_url(url) if isinstance(url, str) else url
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        self.name = safe(self.url.render_as_string(hide_password=True))
        # A server that was started anew has forgotten our connections.
        options: dict[str, Any] = (
            {"connect_args": {"timeout": BUSY_TIMEOUT}} if self.is_sqlite else {"pool_pre_ping": True}
        )
        try:
            self.engine: Engine = sa.create_engine(self.url, **options)
        except (ImportError, sa.exc.ArgumentError) as error:
            raise DatabaseError(f"{self.name}: the driver of this database cannot be loaded: {error}") from error
        if self.is_sqlite:
            self._prepare_sqlite(create, read_only)
        elif read_only:

            @sa.event.listens_for(self.engine, "connect")
            def _connect(connection: Any, _record: object) -> None:
                connection.execute("SET SESSION CHARACTERISTICS AS TRANSACTION READ ONLY")
                connection.commit()

        self._open(create, upgrade)

    def _prepare_sqlite(self, create: bool, read_only: bool) -> None:
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
            if read_only:
                connection.execute("PRAGMA query_only = ON")

        @sa.event.listens_for(self.engine, "begin")
        def _begin(connection: Connection) -> None:
            # A writer that begins as a reader and is overtaken fails at once, however long it is told to wait.
            writes = connection.get_execution_options().get("coslidar_write", False)
            connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

        if read_only:
            return
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

    def _open(self, create: bool, upgrade: bool) -> None:
        try:
            for attempt in range(3):
                try:
                    with self.read() as connection:
                        present = sa.inspect(connection).has_table("schema_version")
                        version = connection.scalar(sa.select(schema_version.c.version)) if present else None
                    if version is None and create:
                        with self.write() as connection:
                            metadata.create_all(connection)
                            _alembic_version.create(connection, checkfirst=True)
                            new = {"version": SCHEMA_VERSION}
                            if self.insert_new(connection, schema_version, new, schema_version.c.version) is not None:
                                connection.execute(_alembic_version.insert().values(version_num=str(SCHEMA_VERSION)))
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
        if version < SCHEMA_VERSION and upgrade:
            self._upgrade()
        elif version < SCHEMA_VERSION:
            raise OldTables(
                f"{self.name}: the catalog has tables of version {version}, this coslidar works with "
                f"{SCHEMA_VERSION}; 'coslidar catalog upgrade --out FOLDER' brings them up to date"
            )

    def _upgrade(self) -> None:
        """Run the migrations that these tables lack, in one transaction: wholly, or not at all."""
        from alembic import command
        from alembic.config import Config

        try:
            with self.write() as connection:
                # Publishers hold this row, and so does another upgrade; what was true before may not be any more.
                version = connection.scalar(sa.select(schema_version.c.version).with_for_update())
                config = Config(attributes={"connection": connection})
                config.set_main_option("script_location", "coslidar.catalog:migrations")
                if not sa.inspect(connection).has_table(_alembic_version.name):
                    # Version 1 was made without alembic.
                    command.stamp(config, str(version))
                command.upgrade(config, str(SCHEMA_VERSION))
        except sa.exc.SQLAlchemyError as error:
            reason = safe(str(getattr(error, "orig", None) or error))
            raise DatabaseError(f"{self.name}: the tables could not be brought up to date: {reason}") from error

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that changes nothing."""
        with self.engine.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def snapshot(self) -> Iterator[Connection]:
        """A transaction that changes nothing and sees the same, however often it looks and whoever writes."""
        # SQLite's own transactions are so; on PostgreSQL every statement sees the newest rows unless told otherwise.
        options = {} if self.is_sqlite else {"isolation_level": "REPEATABLE READ"}
        with self.engine.connect().execution_options(**options) as connection, connection.begin():
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


def passing(error: Exception) -> bool:
    """Whether a database server was lost, so that another try may find it again; a file is not lost like that."""
    return (
        isinstance(error, sa.exc.DBAPIError)
        and (isinstance(error, sa.exc.OperationalError) or error.connection_invalidated)
        and not isinstance(error.orig, sqlite3.Error)
    )


def number(value: Any) -> float | None:
    """A float for the database, which holds an unknown one as NULL and an infinite one not at all."""
    return float(value) if math.isfinite(float(value)) else None


def plain_text(value: object, limit: int = 10_000) -> str:
    """Text that every database takes: no NUL, no half characters, not longer than `limit`."""
    cut = str(value)[:limit]
    return cut.encode("utf-8", "backslashreplace").decode("utf-8").replace("\0", "\\0")


def plain_json(value: Any) -> Any:
    """JSON whose texts every database takes, and none of them long; see :func:`plain_text`."""
    if isinstance(value, str):
        return plain_text(value)
    if isinstance(value, Mapping):
        return {plain_text(key, 200): plain_json(item) for key, item in value.items()}
    return [plain_json(item) for item in value] if isinstance(value, (list, tuple)) else value
