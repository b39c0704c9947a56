"""Databases for tests of the catalog: one SQLite file, or a corner of a PostgreSQL server, for each test."""

from __future__ import annotations

import json
import os
import sqlite3
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import sqlalchemy as sa

#: URL of a server on which schemas may be made and dropped; `.ci/postgresql start DIR` prints that of one.
SERVER = os.environ.get("COSLIDAR_TEST_POSTGRESQL")
#: Every kind of database, for pytest's parametrize.
KINDS = [
    "sqlite",
    pytest.param("postgresql", marks=pytest.mark.skipif(not SERVER, reason="COSLIDAR_TEST_POSTGRESQL names no server")),
]


def use_server(url: str) -> None:
    """Take this server instead of the one of the environment."""
    global SERVER
    SERVER = url


@contextmanager
def database_of(kind: str, folder: Path) -> Iterator[str]:
    """URL of an empty database, gone afterwards."""
    if kind == "sqlite":
        yield f"sqlite:///{folder / 'catalog.sqlite'}"
        return
    assert SERVER
    name = f"coslidar_{uuid.uuid4().hex}"
    engine = sa.create_engine(sa.make_url(SERVER).set(drivername="postgresql+psycopg"))
    with engine.begin() as connection:
        connection.execute(sa.schema.CreateSchema(name))
    try:
        # Not of the engine, but of the session: everything that opens the URL sees this schema only.
        url = engine.url.update_query_dict({"options": f"-csearch_path={name}"})
        yield url.render_as_string(hide_password=False)
    finally:
        with engine.begin() as connection:
            connection.execute(sa.schema.DropSchema(name, cascade=True))
        engine.dispose()


def version_1(url: str) -> None:
    """Fill an empty database with the catalog that coslidar 0.1.0 left; see `unit/catalog-version-1.sql`."""
    script = (Path(__file__).parent / "unit" / "catalog-version-1.sql").read_text(encoding="utf-8")
    where = sa.make_url(url)
    file = where.database if where.get_backend_name() == "sqlite" else ":memory:"
    with sqlite3.connect(str(file)) as old:
        old.executescript(script)
        if file != ":memory:":
            return
        from coslidar.catalog.migrations.versions import version_1 as first

        engine = sa.create_engine(where)
        with engine.begin() as connection:
            # The same rows: 0.1.0 made these tables on PostgreSQL with the same definitions.
            first.metadata.create_all(connection)
            for table in first.metadata.sorted_tables:
                names = [column.name for column in table.columns]
                quoted = ", ".join(f'"{name}"' for name in names)
                for row in old.execute(f'SELECT {quoted} FROM "{table.name}"'):
                    values = {
                        name: json.loads(value) if isinstance(table.c[name].type, sa.JSON) else value
                        for name, value in zip(names, row, strict=True)
                    }
                    connection.execute(sa.insert(table).values(**values))
        engine.dispose()
