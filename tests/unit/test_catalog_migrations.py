"""Old catalogs become new ones with everything in them, and tables are the same however they came to be."""

from __future__ import annotations

import json
import sqlite3
from concurrent.futures import ThreadPoolExecutor

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from catalogs import KINDS, database_of, version_1

from coslidar.catalog import tables
from coslidar.catalog.database import Database, OldTables
from coslidar.catalog.migrations.versions import version_1 as first


@pytest.fixture(params=KINDS)
def old(request, tmp_path):
    """A catalog that coslidar 0.1.0 left."""
    with database_of(request.param, tmp_path) as url:
        version_1(url)
        yield url


def content(engine, known):
    """All rows of the tables that are known, as text, so that nothing is lost by comparing."""
    with engine.connect() as connection:
        return {
            table.name: sorted(
                json.dumps({name: row[name] for name in row}, sort_keys=True)
                for row in connection.execute(sa.select(table)).mappings()
            )
            for table in known.sorted_tables
        }


def test_old_tables_are_named_and_left_alone(old):
    with pytest.raises(OldTables, match=r"version 1.*works with 2.*catalog upgrade"):
        Database(old)
    with pytest.raises(OldTables):
        Database(old, create=False, read_only=True)


def test_an_upgrade_keeps_every_row_and_fills_what_is_new(old):
    engine = sa.create_engine(old)
    before = content(engine, first.metadata)
    assert {name: len(rows) for name, rows in before.items()} == {
        "schema_version": 1, "campaign": 1, "archive": 3, "lineage": 6, "run": 4, "product": 6, "batch": 24,
        "failure": 1,
    }  # fmt: skip
    upgraded = Database(old, create=False, upgrade=True)
    after = content(engine, first.metadata)
    assert after.pop("schema_version") == ['{"version": 2}']
    assert after == {name: rows for name, rows in before.items() if name != "schema_version"}
    with upgraded.read() as connection:
        assert connection.scalar(sa.select(tables.campaign.c.timezone)) == "Europe/Paris"
        named = sa.select(tables.plugin.c.name, sa.func.count()).where(tables.plugin.c.role == "regulariser")
        assert dict(map(tuple, connection.execute(named.group_by(tables.plugin.c.name)))) == {"white": 3, "gradient": 3}
        sources = sa.select(tables.plugin.c.number).where(tables.plugin.c.role == "sources").distinct()
        assert sorted(connection.scalars(sources)) == [0, 1]
        assert set(connection.scalars(sa.select(tables.product.c.accepted))) == {None}
    upgraded.close()
    Database(old, create=False).close()
    engine.dispose()


def test_upgraded_tables_are_the_declared_ones(old):
    upgraded = Database(old, create=False, upgrade=True)
    with upgraded.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, tables.metadata) == []
    upgraded.close()


@pytest.mark.parametrize("kind", KINDS)
def test_fresh_tables_are_the_upgraded_ones(kind, tmp_path):
    """Name for name and type for type, with indices, keys, defaults and conditions."""
    described = []
    for number, make in enumerate(
        (lambda url: Database(url), lambda url: (version_1(url), Database(url, upgrade=True))[1])
    ):
        (tmp_path / str(number)).mkdir()
        with database_of(kind, tmp_path / str(number)) as url:
            made = make(url)
            with made.engine.connect() as connection:
                look = sa.inspect(connection)
                described.append(
                    {
                        name: {
                            "columns": sorted(
                                (column["name"], str(column["type"]), column["nullable"])
                                for column in look.get_columns(name)
                            ),
                            "primary": look.get_pk_constraint(name)["constrained_columns"],
                            "indexes": sorted(
                                (i["name"], str(i["column_names"]), i["unique"]) for i in look.get_indexes(name)
                            ),
                            "foreign": sorted(
                                (str(k["name"]), str(k["constrained_columns"]), k["referred_table"], str(k["options"]))
                                for k in look.get_foreign_keys(name)
                            ),
                            "unique": sorted(str(k["name"]) for k in look.get_unique_constraints(name)),
                            "checks": sorted(str(k["name"]) for k in look.get_check_constraints(name)),
                        }
                        for name in look.get_table_names()
                    }
                )
            made.close()
    assert described[0] == described[1]


def test_the_first_migration_makes_the_tables_of_0_1_0(tmp_path):
    """The frozen definition against the tables that the released program made."""
    version_1(f"sqlite:///{tmp_path / 'catalog.sqlite'}")
    engine = sa.create_engine(f"sqlite:///{tmp_path / 'again.sqlite'}")
    first.metadata.create_all(engine)
    engine.dispose()

    def written(file):
        with sqlite3.connect(tmp_path / file) as connection:
            return sorted(row[0] for row in connection.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL"))

    assert written("again.sqlite") == written("catalog.sqlite")


def test_an_upgrade_that_fails_changes_nothing(old, monkeypatch):
    from coslidar.catalog.database import DatabaseError

    engine = sa.create_engine(old)
    before = content(engine, first.metadata)
    with engine.begin() as connection:
        # Something of the same name is in the way of the last of the new tables.
        connection.execute(sa.text("CREATE TABLE alias_product (x INTEGER)"))
    with pytest.raises(DatabaseError, match="could not be brought up to date"):
        Database(old, create=False, upgrade=True)
    assert content(engine, first.metadata) == before
    with engine.connect() as connection:
        assert not sa.inspect(connection).has_table("plugin")
        assert "timezone" not in {column["name"] for column in sa.inspect(connection).get_columns("campaign")}
    engine.dispose()


def test_two_upgrades_at_once(old):
    with ThreadPoolExecutor(4) as pool:
        for made in pool.map(lambda _: Database(old, create=False, upgrade=True), range(4)):
            made.close()
    Database(old).close()
