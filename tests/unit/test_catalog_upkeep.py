"""What keeps a catalog: copies, accepted products, releases, products made again, names and texts of strangers."""

from __future__ import annotations

import os
import random
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import sqlalchemy as sa
from catalogs import KINDS, database_of, version_1
from made_products import IDENTITY, batch, failed, key, product

from coslidar.catalog import tables
from coslidar.catalog.backup import backup
from coslidar.catalog.database import Database, DatabaseError, database_url, is_catalog, keep_copy, location, remember
from coslidar.catalog.products import ProductError
from coslidar.catalog.report import write_report
from coslidar.catalog.store import Catalog, CatalogError


@pytest.fixture(params=KINDS)
def catalog(request, tmp_path):
    with database_of(request.param, tmp_path) as url, Catalog(tmp_path / "catalog", url) as made:
        yield made


def other(number, **changes):
    """A product of another archive."""
    return product(number, archive=f"a{number}", archive_identity=f"{number:064x}", **changes)


# --- made again -------------------------------------------------------------------------------------------


def test_other_bytes_take_the_place_of_a_product(catalog):
    first = catalog.publish(product(results=[batch(0), failed(1)])).row
    assert not catalog.publish(product(), replace=False).new
    again = catalog.publish(product(), replace=True)
    assert again.new
    assert (again.row.id, again.row.batches) == (first.id, 3)
    # A file of its own: whoever died before the commit left the old row with the old file.
    assert again.row.path != first.path
    assert not first.path.exists()
    assert again.row.path.name.startswith(first.path.name.removesuffix(".zarr.zip") + "-")
    assert [row.quality_level for row in catalog.batches()] == [0, 1, 2]
    assert catalog.verify() == []
    assert catalog.find(again.row.path.name) == again.row
    assert not catalog.publish(product(), replace=True).new
    assert catalog.collect(older_than=0) == []


def test_a_death_before_the_commit_leaves_the_old_product(catalog, monkeypatch):
    row = catalog.publish(product(attributes={"note": "first"})).row

    def die(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("coslidar.catalog.store.sync_folder", die)
    with pytest.raises(KeyboardInterrupt):
        catalog.publish(product(attributes={"note": "second"}), replace=True)
    monkeypatch.undo()
    assert catalog.products() == [row]
    assert catalog.verify() == []
    assert len(catalog.collect(older_than=0)) == 1
    assert catalog.open(row).attrs["note"] == "first"


# --- accepted products and releases -----------------------------------------------------------------------


def test_the_accepted_product_counts(catalog):
    first, second = (catalog.publish(product(seed)).row for seed in range(2))
    assert catalog.find(first.archive) == second
    catalog.promote(first)
    assert catalog.find(first.archive).id == first.id
    assert [row.accepted is not None for row in catalog.products()] == [True, False]
    catalog.promote(second)
    assert [row.accepted is not None for row in catalog.products()] == [False, True]
    catalog.promote(second, accepted=False)
    assert {row.accepted for row in catalog.products()} == {None}


def test_never_two_accepted_products_of_one_archive(catalog):
    rows = [catalog.publish(product(seed)).row for seed in range(4)]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(catalog.promote, rows * 3))
    assert sum(row.accepted is not None for row in catalog.products()) == 1
    with pytest.raises(sa.exc.IntegrityError), catalog.database.write() as connection:
        connection.execute(sa.update(tables.product).values(accepted=1))


def test_a_release_is_a_promise(catalog):
    rows = [catalog.publish(other(number)).row for number in range(3)]
    made = catalog.release("paper-v1", rows[:2], "Figs. 5 and 6")
    assert catalog.releases() == [made]
    assert (made.products, made.note) == (2, "Figs. 5 and 6")
    assert catalog.released("paper-v1") == rows[:2]
    assert catalog.released("paper-v2") == []
    with pytest.raises(CatalogError, match="names of releases do not change"):
        catalog.release("paper-v1", rows)
    with pytest.raises(CatalogError, match="release 'paper-v1' names this product"):
        catalog.publish(other(0, attributes={"note": "other bytes"}), replace=True)
    assert catalog.publish(other(2, attributes={"note": "other bytes"}), replace=True).new
    with pytest.raises(sa.exc.IntegrityError), catalog.database.write() as connection:
        connection.execute(sa.delete(tables.product).where(tables.product.c.id == rows[0].id))
    # The same bytes may come back.
    rows[0].path.unlink()
    assert catalog.publish(other(0)).new
    assert catalog.verify() == []
    catalog.withdraw("paper-v1")
    assert catalog.releases() == []
    assert len(catalog.products()) == 3
    with pytest.raises(CatalogError, match="there is no release"):
        catalog.withdraw("paper-v1")


def test_releases_that_cannot_be(catalog):
    rows = [catalog.publish(product(seed)).row for seed in range(2)]
    with pytest.raises(CatalogError, match="are of one archive"):
        catalog.release("x", rows)
    with pytest.raises(CatalogError, match="at least one product"):
        catalog.release("x", [])
    for name in ("../x", "a b", "", "<script>", "x" * 101):
        with pytest.raises(ProductError, match="release"):
            catalog.release(name, rows[:1])
    assert catalog.releases() == []


# --- copies -----------------------------------------------------------------------------------------------


def test_a_backup_is_a_catalog(catalog, tmp_path):
    run = catalog.start_run({"a": 1}, "coslidar run x")
    rows = [
        catalog.publish(other(number), run, header={"site": {"timezone": "Europe/Paris"}}).row for number in range(3)
    ]
    catalog.promote(rows[1])
    catalog.release("paper-v1", rows[:2])
    catalog.record_failure(run, "x", "no light")
    done = backup(catalog, tmp_path / "copy")
    assert (done.copied, done.present, done.faults) == (3, 0, ())
    with Catalog(tmp_path / "copy", create=False) as copy:
        assert copy.database.is_sqlite
        assert copy.verify() == []
        assert [row.name for row in copy.products()] == [row.name for row in catalog.products()]
        assert copy.query("") == catalog.query("")
        assert copy.runs() == catalog.runs()
        assert copy.failures() == catalog.failures()
        assert copy.releases() == catalog.releases()
        assert [row.accepted for row in copy.products()] == [row.accepted for row in catalog.products()]
        assert copy.collect(older_than=0) == []
        # It goes on where the original was.
        assert copy.publish(other(7)).new
    catalog.publish(other(3))
    again = backup(catalog, tmp_path / "copy")
    assert (again.copied, again.present, again.faults) == (1, 3, ())
    with Catalog(tmp_path / "copy", create=False) as copy:
        assert len(copy.products()) == 4
        assert copy.verify() == []
    assert not list((tmp_path / "copy").glob(".*"))


def test_a_backup_while_others_publish(catalog, tmp_path):
    """Whenever it is taken, every row of the copy has its file and its batches."""
    numbers = list(range(9))
    random.Random(3).shuffle(numbers)
    with ThreadPoolExecutor(3) as pool:
        published = [pool.submit(lambda n: catalog.publish(other(n)), number) for number in numbers]
        for _ in range(3):
            assert backup(catalog, tmp_path / "copy").faults == ()
            with Catalog(tmp_path / "copy", create=False) as copy:
                assert copy.verify() == []
                assert len(copy.batches()) == 3 * len(copy.products())
        assert all(outcome.result().new for outcome in published)


def test_a_backup_says_what_it_could_not_copy(catalog, tmp_path):
    rows = [catalog.publish(other(number)).row for number in range(3)]
    rows[0].path.unlink()
    rows[1].path.write_bytes(b"damaged")
    done = backup(catalog, tmp_path / "copy")
    assert done.copied == 1
    assert {fault.row.id for fault in done.faults} == {rows[0].id, rows[1].id}
    with Catalog(tmp_path / "copy", create=False) as copy:
        assert len(copy.verify()) == 2


def test_a_backup_spoils_nothing(catalog, tmp_path):
    catalog.publish(product())
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    Catalog(tmp_path / "other").close()
    for place in (tmp_path / "mine", tmp_path / "other", catalog.root / "copy", catalog.root, tmp_path):
        with pytest.raises(CatalogError):
            backup(catalog, place)
    assert os.listdir(tmp_path / "mine") == ["thesis.tex"]


# --- where the database is --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_remembers_its_database(kind, tmp_path):
    root = tmp_path / "shared"
    with database_of(kind, tmp_path) as url:
        assert not is_catalog(root)
        Catalog(root, url).close()
        remember(root, url)
        assert is_catalog(root)
        with Catalog(root, create=False) as first, Catalog(root, create=False, read_only=True) as second:
            first.publish(product())
            assert second.products() == first.products()
            with pytest.raises(sa.exc.DBAPIError):
                second.promote(first.products()[0])
            assert first.database.is_sqlite == (kind == "sqlite")


def test_passwords_stay_out_of_the_folder(tmp_path):
    with pytest.raises(DatabaseError, match="pgpass") as caught:
        remember(tmp_path, "postgresql://me:secret@host/x")
    assert "secret" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "text", ["", "nonsense", "mysql://host/x", "/data/catalog.sqlite", "postgresql://me:secret@ho st:x/y"]
)
def test_urls_that_are_none(tmp_path, text):
    (tmp_path / "database.url").write_text(text)
    with pytest.raises(DatabaseError, match=r"database\.url.*write postgresql://") as caught:
        location(tmp_path)
    assert "secret" not in str(caught.value)
    assert database_url("postgresql://me@host/x").drivername == "postgresql+psycopg"


def test_a_copy_is_kept_of_what_is_upgraded(tmp_path):
    url = f"sqlite:///{tmp_path / 'catalog.sqlite'}"
    version_1(url)
    copy = keep_copy(sa.make_url(url))
    Database(url, upgrade=True).close()
    with pytest.raises(DatabaseError, match="version 1"):
        Database(f"sqlite:///{copy}")
    assert keep_copy(sa.make_url("postgresql+psycopg://me@host/x")) is None


# --- names and texts of strangers -------------------------------------------------------------------------

HOSTILE = "../../x\x00\x1b]0;title\x07\x1b[31m<script>alert(1)</script>'; DROP TABLE product; --\u202e\ud800"


def test_a_hostile_header_is_stored_as_text(catalog, tmp_path):
    header = {
        "site": {"name": HOSTILE, "timezone": "../../etc/passwd"},
        HOSTILE: [HOSTILE, {"deep": "x" * 10_000_000}],
        "sources": [{"name": HOSTILE}],
    }
    before = set(tmp_path.rglob("*"))
    attributes = {"site_name": HOSTILE.replace("\ud800", "").replace("\0", ""), "note": "y" * 1_000_000}
    row = catalog.publish(
        product(sources=["<script>", "../../x"], attributes=attributes), url=HOSTILE, header=header
    ).row
    run = catalog.start_run({HOSTILE: HOSTILE}, HOSTILE)
    catalog.record_failure(run, HOSTILE, HOSTILE)
    assert catalog.verify() == []
    new = {path for path in tmp_path.rglob("*") if path.is_file()} - before
    assert {path for path in new if "sqlite" not in path.name} == {row.path}
    assert all(path.resolve().is_relative_to(catalog.root) or "sqlite" in path.name for path in new)
    with catalog.database.read() as connection:
        url, stored = connection.execute(sa.select(tables.archive.c.url, tables.archive.c.header)).one()
    assert "\0" not in url
    assert "DROP TABLE product" in url
    assert len(str(stored)) < 100_000
    page = tmp_path / "report.html"
    write_report([catalog.open(row)], page)
    assert "<script>alert(1)" not in page.read_text(encoding="utf-8")
    assert Path(row.path).parent == catalog.root / "products" / "test-campaign"
    assert (row.archive_identity, row.lineage_key) == (IDENTITY, str(key()))
