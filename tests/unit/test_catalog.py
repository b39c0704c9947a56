"""The catalog: a row always has its file, whoever dies, hurries or lies."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import sqlite3
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from catalogs import KINDS, database_of
from made_products import IDENTITY, LENGTH, START, batch, failed, key, product
from sqlalchemy.dialects import postgresql
from sqlalchemy.schema import CreateIndex, CreateTable

from coslidar.catalog import database, open_catalog, store, tables
from coslidar.catalog.database import Database, DatabaseError, network_file_system
from coslidar.catalog.products import ProductError, temporary_name
from coslidar.catalog.store import Catalog, CatalogError

HELPERS = str(Path(__file__).parents[1])


@pytest.fixture(params=KINDS)
def catalog(request, tmp_path):
    sqlite = request.param == "sqlite"
    with database_of(request.param, tmp_path) as url, Catalog(tmp_path / "catalog", None if sqlite else url) as made:
        yield made


@pytest.fixture
def on_sqlite(tmp_path):
    with Catalog(tmp_path / "catalog") as made:
        yield made


def files(catalog):
    return sorted(p for p in (catalog.root / "products").rglob("*") if p.is_file())


def whole(catalog):
    """Every row has its file with its hash, and no product is there twice."""
    rows = catalog.products()
    assert catalog.verify() == []
    assert len({(row.archive_identity, row.lineage_key) for row in rows}) == len(rows)
    assert len({row.path for row in rows}) == len(rows)
    counted = sa.select(tables.batch.c.product_id, sa.func.count()).group_by(tables.batch.c.product_id)
    with catalog.database.read() as connection:
        per_product = dict(map(tuple, connection.execute(counted)))
    assert per_product == {row.id: row.batches for row in rows}
    return rows


# --- publishing and asking -------------------------------------------------------------------------------


def test_publish_and_find(catalog):
    made = product()
    assert not catalog.has(IDENTITY, key())
    run = catalog.start_run({"slices": 12}, "coslidar run x")
    published = catalog.publish(made, run, url="/data/x.zarr.zip", header={"campaign": "test-campaign"})
    assert published.new
    row = published.row
    assert catalog.has(IDENTITY, key())
    assert not catalog.has(IDENTITY, key(1))
    assert not catalog.has("f" * 64, key())
    assert row.path == catalog.root / "products" / "test-campaign" / f"2012-09-14T1415.{str(key())[:16]}.zarr.zip"
    assert hashlib.sha256(row.path.read_bytes()).hexdigest() == row.sha256
    assert (row.start, row.stop, row.batches, row.run) == (START, START + 3 * LENGTH, 3, run)
    assert catalog.open(row).equals(made)
    assert catalog.products() == [row]
    assert files(catalog) == [row.path]
    for text in (str(key())[:8], "2012-09-14T1415", "test-campaign/2012-09-14T1415", row.name, row.path.name):
        assert catalog.find(text) == row
    assert catalog.products(campaign_name="test-campaign", lineage_key=str(key())[:4]) == [row]
    assert catalog.products(campaign_name="other") == []
    assert catalog.products(lineage_key="%") == []
    whole(catalog)


@pytest.mark.parametrize("text", ["", "abc", "test-campaign", "2012", "%", "../../etc/passwd", "\x1b[31m"])
def test_find_nothing(catalog, text):
    catalog.publish(product())
    with pytest.raises(CatalogError, match="there is no product") as caught:
        catalog.find(text)
    assert "\x1b" not in str(caught.value)


def test_find_refuses_to_guess(catalog):
    catalog.publish(product(archive="a"))
    catalog.publish(product(archive="a", campaign="other", archive_identity="e" * 64))
    with pytest.raises(CatalogError, match="2 products"):
        catalog.find("a")
    assert catalog.find("other/a").campaign == "other"


def test_find_takes_the_newest_of_an_archive(catalog):
    catalog.publish(product(0))
    last = catalog.publish(product(1)).row
    assert catalog.find("2012-09-14T1415") == last


def test_publish_twice_changes_nothing(catalog):
    first = catalog.publish(product())
    before = first.row.path.stat()
    second = catalog.publish(product())
    assert (first.new, second.new) == (True, False)
    assert second.row == first.row
    assert first.row.path.stat().st_mtime_ns == before.st_mtime_ns
    assert len(files(catalog)) == 1


def test_other_bytes_under_the_same_key_do_not_replace_a_product(catalog):
    row = catalog.publish(product(attributes={"note": "first"})).row
    assert not catalog.publish(product(attributes={"note": "second"})).new
    assert catalog.open(row).attrs["note"] == "first"
    whole(catalog)


def test_a_deleted_file_is_not_there_and_can_be_published_again(catalog):
    row = catalog.publish(product(attributes={"note": "first"})).row
    row.path.unlink()
    assert not catalog.has(IDENTITY, key())
    assert [fault.reason for fault in catalog.verify()] == ["the file is missing"]
    again = catalog.publish(product(attributes={"note": "second"}))
    assert again.new
    assert again.row.id == row.id
    assert again.row.sha256 != row.sha256
    whole(catalog)


def test_an_orphan_of_other_bytes_is_replaced(catalog):
    made = product()
    target = catalog.root / "products" / "test-campaign" / f"2012-09-14T1415.{str(key())[:16]}.zarr.zip"
    target.parent.mkdir(parents=True)
    target.write_bytes(b"left behind by a version that died")
    assert not catalog.has(IDENTITY, key())
    assert catalog.publish(made).new
    whole(catalog)


def test_batch_rows_say_what_queries_need(catalog):
    good, care = batch(0), batch(1, flag=4)
    half = replace(good, values={**good.values, "scintillation_index_direct": np.array([np.nan, 0.25])})
    endless = replace(care, values={**care.values, "r0_profile": np.array(np.inf)})
    catalog.publish(product(results=[half, endless, failed(2)]))
    rows = catalog.batches()
    assert [row.start for row in rows] == [START + i * LENGTH for i in range(3)]
    assert rows[0].r0 == float(good.values["r0_profile"])
    assert rows[0].chi2 == float(good.values["chi2_reduced"])
    assert rows[0].mu == float(good.values["mu"])
    assert rows[0].n_frames == int(good.values["n_frames"])
    assert rows[0].scintillation_index == 0.25
    assert rows[1].r0 is None
    assert (rows[2].r0, rows[2].mu, rows[2].scintillation_index) == (None, None, None)
    assert [row.quality_level for row in rows] == [0, 1, 2]
    assert [row.number for row in catalog.batches(quality_level=1)] == [0, 1]
    assert [row.number for row in catalog.batches(start=START + 1, stop=START + 2 * LENGTH)] == [1]
    assert catalog.batches(campaign_name="other") == []
    assert len(catalog.batches(archive_name="2012-09-14T1415", lineage_key=str(key()))) == 3


def test_runs_and_failures(catalog):
    first = catalog.start_run({"a": [1, 2]}, "coslidar run a")
    catalog.record_failure(first, "b.zarr.zip", "no such file")
    catalog.record_failure(first, "a.zarr.zip", "no light", start=START, stop=START + LENGTH)
    catalog.finish_run(first, "failed")
    second = catalog.start_run()
    rows = catalog.runs()
    assert [(row.id, row.state) for row in rows] == [(first, "failed"), (second, "running")]
    assert rows[0].configuration == {"a": [1, 2]}
    assert rows[0].started < rows[0].finished < time.time_ns()
    assert rows[0].software["numpy"] == np.__version__
    assert [(f.archive, f.reason, f.start) for f in catalog.failures(first)] == [
        ("b.zarr.zip", "no such file", None),
        ("a.zarr.zip", "no light", START),
    ]
    assert catalog.failures(second) == []


def test_a_run_whose_process_is_gone_was_interrupted(catalog):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    first, mine = catalog.start_run(), catalog.start_run()
    with catalog.database.write() as connection:
        connection.execute(sa.update(tables.run).where(tables.run.c.id == first).values(process=gone.pid))
    catalog.start_run()
    states = {row.id: row.state for row in catalog.runs()}
    assert states[first] == "interrupted"
    assert states[mine] == "running"


def test_provenance_joins_the_run(catalog):
    run = catalog.start_run(command="coslidar run x")
    row = catalog.publish(product(), run).row
    catalog.finish_run(run)
    prov = catalog.provenance(row)
    activity = prov["activity"][f"coslidar:run.{run}"]
    assert activity["coslidar:command"] == "coslidar run x"
    assert activity["prov:startTime"].endswith("Z")
    assert activity["prov:startTime"] < activity["prov:endTime"]
    assert prov["wasInformedBy"]["_:i.run"]["prov:informant"] in prov["activity"]
    assert f"coslidar:run.{run}" not in json.loads(catalog.open(row).attrs["provenance"])["activity"]


def test_a_catalog_travels_by_pickle(catalog):
    catalog.publish(product())
    with pickle.loads(pickle.dumps(catalog)) as other:
        assert other.products() == catalog.products()


# --- keeping in order --------------------------------------------------------------------------------------


def test_verify_finds_every_change(catalog):
    rows = [catalog.publish(product(seed)).row for seed in range(3)]
    data = bytearray(rows[0].path.read_bytes())
    data[500] ^= 1
    rows[0].path.write_bytes(bytes(data))
    rows[1].path.write_bytes(b"short")
    rows[2].path.unlink()
    assert {fault.row.id: fault.reason for fault in catalog.verify()} == {
        rows[0].id: "the file has changed since it was published",
        rows[1].id: f"the file has 5 bytes instead of {rows[1].size}",
        rows[2].id: "the file is missing",
    }
    assert {fault.row.id for fault in catalog.verify(fast=True)} == {rows[1].id, rows[2].id}


def test_collect_takes_orphans_and_nothing_else(catalog):
    row = catalog.publish(product()).row
    folder = row.path.parent
    orphan = folder / "x.0123456789abcdef.zarr.zip"
    orphan.write_bytes(b"")
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    host = temporary_name().split(".")[2]
    dead = folder / f".0123456789abcdef.{host}.{gone.pid}.part"
    living = folder / f".1123456789abcdef.{host}.{os.getpid()}.part"
    fresh = folder / f".2123456789abcdef.{host}.{gone.pid}.part"
    elsewhere = folder / f".3123456789abcdef.other-host.{os.getpid()}.part"
    forgotten = folder / f".4123456789abcdef.other-host.{os.getpid()}.part"
    notes, link = folder / "notes.txt", folder / "link.0123456789abcdef.zarr.zip"
    for path in (dead, living, fresh, elsewhere, forgotten, notes):
        path.write_bytes(b"")
    link.symlink_to(notes)
    for path, age in ((dead, 120), (living, 120), (elsewhere, 120), (forgotten, 7200)):
        os.utime(path, (time.time() - age,) * 2)
    assert catalog.orphans() == sorted([dead, forgotten, orphan])
    assert sorted(catalog.collect()) == sorted([dead, forgotten, orphan])
    assert set(files(catalog)) == {row.path, living, fresh, elsewhere, notes, link}
    whole(catalog)


def test_collect_waits_for_a_publisher(catalog, monkeypatch):
    """An orphan hunter that comes between the naming of a file and the commit of its row must wait."""
    named, release = [], []

    def slow(folder):
        named.append(folder)
        while not release:
            time.sleep(0.01)

    made = product()
    with ThreadPoolExecutor(2) as pool:
        monkeypatch.setattr(
            store, "sync_folder", lambda folder: slow(folder) if folder.name == "test-campaign" else None
        )
        publishing = pool.submit(catalog.publish, made)
        while not named:
            time.sleep(0.01)
        collecting = pool.submit(catalog.collect, older_than=0)
        time.sleep(0.2)
        assert not collecting.done()
        release.append(True)
        assert publishing.result().new
        assert collecting.result() == []
    whole(catalog)


# --- hostile texts -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["../../x", "/etc/passwd", "..", ".hidden", "a/b", "a\\b", "a\0b", "", "x" * 101, "a\n"]
)
def test_hostile_names_are_refused(catalog, name):
    for what in ("campaign", "archive"):
        made = product().assign_attrs({what: name})
        with pytest.raises(ProductError, match=what):
            catalog.publish(made)
    assert files(catalog) == []
    assert catalog.products() == []


def test_hostile_texts_are_stored_as_texts(catalog):
    text = "'); DROP TABLE product; --<script>\x00\x1b]0;\ud800" + "x" * 1_000_000
    run = catalog.start_run({"note": text[:100]}, text)
    catalog.record_failure(run, text, text)
    catalog.publish(product(sources=["'; DROP TABLE batch", "<script>"]), run, url=text, header={"note": text[:100]})
    whole(catalog)
    found = catalog.failures()[0]
    assert found.reason.startswith("'); DROP TABLE product; --<script>\\0\x1b]0;\\ud800xxx")
    assert len(found.reason) < 10_100


def test_a_path_in_a_forged_database_stays_inside(on_sqlite):
    row = on_sqlite.publish(product()).row
    on_sqlite.close()
    for path in ("../../etc/passwd", "products/../x", "/etc/passwd", "products/c/../../../x.0123456789abcdef.zarr.zip"):
        with sqlite3.connect(on_sqlite.root / "catalog.sqlite") as connection:
            connection.execute("UPDATE product SET path = ? WHERE id = ?", (path, row.id))
        connection.close()
        with pytest.raises((CatalogError, ProductError)):
            on_sqlite.products()


def test_one_recording_under_two_names_is_refused(catalog):
    catalog.publish(product())
    with pytest.raises(CatalogError, match="same recording under another name"):
        catalog.publish(product(1, archive="copy"))
    assert len(files(catalog)) == 1
    whole(catalog)


def test_a_run_that_does_not_exist_is_refused_without_a_trace(catalog):
    with pytest.raises(sa.exc.IntegrityError):
        catalog.publish(product(), "no such run")
    assert files(catalog) == []
    assert catalog.products() == []


def test_disk_full_leaves_no_row(catalog, monkeypatch):
    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="No space"):
        catalog.publish(product())
    monkeypatch.undo()
    assert catalog.products() == []
    assert files(catalog) == []
    assert catalog.publish(product()).new


# --- several at once, and killed ----------------------------------------------------------------------------


def test_threads_that_publish_the_same(catalog):
    made = product()
    with ThreadPoolExecutor(8) as pool:
        outcomes = list(pool.map(lambda _: catalog.publish(made), range(16)))
    assert sum(outcome.new for outcome in outcomes) == 1
    assert len({outcome.row for outcome in outcomes}) == 1
    assert len(files(catalog)) == 1
    whole(catalog)


# --- database ----------------------------------------------------------------------------------------------


def test_sqlite_settings(on_sqlite):
    with on_sqlite.database.read() as connection:
        settings = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        }
    assert settings == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 60000}


def test_network_disk_gets_a_rollback_journal(tmp_path, monkeypatch):
    url = f"sqlite:///{tmp_path / 'catalog.sqlite'}"
    Database(url).close()
    monkeypatch.setattr(database, "network_file_system", lambda _: "nfs4")
    moved = Database(url)
    with moved.read() as connection:
        assert connection.exec_driver_sql("PRAGMA journal_mode").scalar() == "delete"
    moved.close()


def test_network_file_systems_are_known(tmp_path):
    mounts = tmp_path / "mountinfo"
    mounts.write_text(
        "22 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw\n"
        "30 22 0:40 / /home rw shared:2 - nfs4 server:/home rw\n"
        "31 30 8:2 / /home/local rw - xfs /dev/sdb rw\n"
        "32 22 0:41 / /mnt/with\\040blank rw - cifs //server/share rw\n"
        "33 22 0:42 / /mnt/ssh rw - fuse.sshfs me@host: rw\n"
        "34 22 0:43 / /over rw - nfs server:/x rw\n"
        "35 34 8:3 / /over rw - ext4 /dev/sdc rw\n"
        "broken line\n"
    )
    kinds = {
        path: network_file_system(Path(path), mounts)
        for path in ("/data", "/home/me/x", "/homes", "/home/local/x", "/mnt/with blank/a", "/mnt/ssh", "/over/x")
    }
    assert kinds == {
        "/data": None,
        "/home/me/x": "nfs4",
        "/homes": None,
        "/home/local/x": None,
        "/mnt/with blank/a": "cifs",
        "/mnt/ssh": "fuse.sshfs",
        "/over/x": None,
    }
    assert network_file_system(Path("/"), tmp_path / "nowhere") is None


def test_newer_catalog_is_refused(on_sqlite):
    with on_sqlite.database.write() as connection:
        connection.execute(sa.update(tables.schema_version).values(version=tables.SCHEMA_VERSION + 1))
    with pytest.raises(DatabaseError, match="a newer coslidar wrote this catalog"):
        Catalog(on_sqlite.root)


@pytest.mark.parametrize("content", [b"no database at all, but more than sixteen bytes", b"SQLite format 3\0 damaged"])
def test_file_that_is_no_database(tmp_path, content):
    (tmp_path / "catalog.sqlite").write_bytes(content * 100)
    with pytest.raises(DatabaseError, match="catalog"):
        Catalog(tmp_path)


def test_opening_makes_nothing(tmp_path):
    with pytest.raises(CatalogError, match="there is no catalog"):
        open_catalog(tmp_path / "nowhere")
    with pytest.raises(DatabaseError, match="there is no catalog"):
        open_catalog(tmp_path)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(CatalogError, match="cannot be made"):
        Catalog(tmp_path / "file")


@pytest.mark.parametrize(
    "url", ["nonsense", "sqlite://", "sqlite:///:memory:", "postgresql+nosuchdriver://me:secret@host/x"]
)
def test_database_urls_that_cannot_work(tmp_path, url):
    with pytest.raises(DatabaseError) as caught:
        Catalog(tmp_path, url)
    assert "secret" not in str(caught.value)


_MAKERS = """
import os, sys
from coslidar.catalog.store import Catalog
children = []
for _ in range(6):
    child = os.fork()
    if child == 0:
        Catalog(sys.argv[1]).start_run()
        os._exit(0)
    children.append(child)
sys.exit(sum(os.waitpid(child, 0)[1] for child in children))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="starts many processes at one moment by fork")
def test_many_processes_make_one_catalog(tmp_path):
    made = subprocess.run([sys.executable, "-c", _MAKERS, str(tmp_path / "c")], capture_output=True)
    assert (made.returncode, made.stderr) == (0, b"")
    assert len(Catalog(tmp_path / "c").runs()) == 6


def test_constraints_hold(catalog):
    row = catalog.publish(product()).row
    bad = [
        sa.insert(tables.archive).values(campaign_id=99, name="a", identity="b" * 64, url="", header={}),
        sa.insert(tables.archive).values(campaign_id=1, name="a", identity=IDENTITY, url="", header={}),
        sa.insert(tables.archive).values(campaign_id=1, name="a", identity="short", url="", header={}),
        sa.update(tables.batch).values(quality_level=3),
        sa.update(tables.batch).values(stop=0),
        sa.update(tables.product).values(lineage_key="c" * 64),
        sa.delete(tables.archive),
    ]
    for statement in bad:
        with pytest.raises(sa.exc.IntegrityError), catalog.database.write() as connection:
            connection.execute(statement)
    with catalog.database.write() as connection:
        connection.execute(sa.delete(tables.product).where(tables.product.c.id == row.id))
        assert connection.scalar(sa.select(sa.func.count()).select_from(tables.batch)) == 0


def test_the_tables_are_postgresql_too():
    dialect = postgresql.dialect()
    written = "\n".join(
        [str(CreateTable(table).compile(dialect=dialect)) for table in tables.metadata.sorted_tables]
        + [str(CreateIndex(i).compile(dialect=dialect)) for t in tables.metadata.sorted_tables for i in t.indexes]
    )
    assert "BIGINT" in written
    assert "DOUBLE PRECISION" in written
    lock = sa.select(tables.schema_version.c.version).with_for_update(read=True)
    assert str(lock.compile(dialect=dialect)).endswith("FOR SHARE")
