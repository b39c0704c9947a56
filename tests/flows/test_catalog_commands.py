"""The commands of the catalog as a user types them, and runs that meet in one catalog."""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path

import pytest
from catalogs import KINDS, database_of, version_1
from click.testing import CliRunner
from made_products import product
from small_runs import BATCHES, command, environment, products, run_arguments

from coslidar.catalog import open_catalog
from coslidar.catalog.store import Catalog
from coslidar.flows.cli import cli
from coslidar.flows.settings import InputError


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A catalog of two products of one recording and one of another; not to be changed."""
    root = tmp_path_factory.mktemp("catalog") / "results"
    with Catalog(root) as catalog:
        header = {"site": {"timezone": "Europe/Paris"}}
        for seed in range(2):
            catalog.publish(product(seed), header=header)
        catalog.publish(product(2, archive="other", archive_identity="e" * 64), header=header)
    return root


def say(*arguments, code=0):
    """Output of a command that ends with `code`."""
    done = CliRunner().invoke(cli, ["catalog", *map(str, arguments)])
    if isinstance(done.exception, InputError):
        assert code == 2
        return "\n".join(done.exception.faults)
    assert done.exit_code == code, (done.output, done.exception)
    return done.output


def test_a_query_as_a_table(filled):
    lines = say("query", "archive=other quality=good", "--out", filled).splitlines()
    assert "start (UTC)" in lines[0]
    assert "r0 (m)" in lines[0]
    assert lines[1].startswith("2012-09-14T12:15:00Z  2012-09-14T14:15:00+02:00  test-campaign")
    assert lines[-1] == f"1 batch in {filled}"
    assert "current=yes asks for one of each" in say("query", "--out", filled)


def test_a_query_in_other_forms(filled, tmp_path):
    rows = open_catalog(filled).query("current=yes quality=good")
    read = list(
        csv.DictReader(say("query", "current=yes", "quality=good", "--out", filled, "--format", "csv").splitlines())
    )
    assert [float(row["r0 [m]"]) for row in read] == [row.r0 for row in rows]
    assert read[0]["start [UTC]"] == "2012-09-14T12:15:00.000000123Z"
    content = json.loads(say("query", "current=yes quality=good", "--out", filled, "--format", "json"))
    assert [row["mu"] for row in content["batches"]] == [row.mu for row in rows]
    assert content["columns"]["mu"]["unit"] == "m^(4/3)"
    parquet = pytest.importorskip("pyarrow.parquet")
    file = tmp_path / "x.parquet"
    say("query", "current=yes quality=good", "--out", filled, "--format", "parquet", "-o", file)
    table = parquet.read_table(file)
    assert table["r0"].to_pylist() == [row.r0 for row in rows]
    assert table.schema.field("r0").metadata[b"unit"] == b"m"
    assert table["start"].cast("int64").to_pylist() == [row.start for row in rows]
    assert "-o FILE.parquet" in say("query", "--out", filled, "--format", "parquet", code=2)


def test_every_fault_of_a_query_is_told(filled):
    told = say("query", "r0>3 qualty=good t>2012-09-14T14:00", "--out", filled, code=2).splitlines()
    assert [line.split(":")[0] for line in told] == ["query, character 1", "query, character 6", "query, character 18"]
    assert "did you mean 'quality'" in told[1]
    assert "scint_point" in say("query", "--fields", "--out", filled)


def test_two_products_side_by_side(filled, tmp_path):
    names = [row.name for row in open_catalog(filled).products() if row.archive != "other"]
    told = say("diff", *names, "--out", filled, "-o", tmp_path / "d.svg")
    assert "profile: seed" in told
    assert "3 batches of both overlap" in told
    assert (tmp_path / "d.svg").read_text().startswith("<?xml")
    assert "same settings" in say("diff", names[0], names[0], "--out", filled)
    assert ".svg, .png or .pdf" in say("diff", *names, "--out", filled, "-o", tmp_path / "d.doc", code=2)


def test_accepted_products_and_releases(tmp_path):
    root = tmp_path / "results"
    with Catalog(root) as catalog:
        first = catalog.publish(product(0)).row
        catalog.publish(product(1))
    say("promote", first.name, "--out", root)
    assert f"{first.name} * " in say("ls", "--out", root)
    assert "paper-v1 names 1 product" in say(
        "alias", "paper-v1", "--query", "current=yes", "--note", "Fig. 5", "--out", root
    )
    assert first.sha256 in say("alias", "paper-v1", "--out", root)
    assert "Fig. 5" in say("alias", "--out", root)
    assert first.lineage_key[:8] in say("query", "alias=paper-v1", "--out", root)
    assert "no release" in say("query", "alias=paper-v2", "--out", root, code=2)
    say("alias", "paper-v1", "--withdraw", "--out", root)
    assert "no release" in say("alias", "paper-v1", "--out", root, code=2)
    say("promote", first.name, "--undo", "--out", root)
    assert " * " not in say("ls", "--out", root)


def test_upgrade_and_backup(tmp_path):
    root = tmp_path / "results"
    root.mkdir()
    version_1(f"sqlite:///{root / 'catalog.sqlite'}")
    assert "catalog upgrade" in say("ls", "--out", root, code=2)
    assert "as it was before" in say("upgrade", "--out", root)
    assert "up to date already" in say("upgrade", "--out", root)
    assert "6 products" in say("ls", "--out", root)
    # The fixture has rows only: a backup says that the files are not there.
    assert "6 not copied" in say("backup", tmp_path / "copy", "--out", root, code=1)
    assert "0 of 6 products are sound" in say("verify", "--fast", "--out", root, code=1)


def test_gc_says_before_it_does(filled, tmp_path):
    root = tmp_path / "results"
    with Catalog(root) as catalog:
        row = catalog.publish(product()).row
    orphan = row.path.with_name("x.0123456789abcdef.zarr.zip")
    orphan.write_bytes(b"")
    assert "1 file would be removed" in say("gc", "--dry-run", "--out", root)
    assert orphan.exists()
    assert "1 file removed" in say("gc", "--out", root)
    assert not orphan.exists()
    assert "the unit is missing" in say("gc", "--older-than", "3", "--out", root, code=2)


def test_texts_of_strangers_on_a_terminal(tmp_path):
    root = tmp_path / "results"
    with Catalog(root) as catalog:
        run = catalog.start_run({}, "coslidar run '\x1b]0;title\x07'")
        catalog.record_failure(run, "\x1b[31mx", "\x1b[2J<script>\r\n")
    told = say("runs", "--failures", "--out", root)
    assert "\\x1b[2J<script>" in told
    assert all(line.isprintable() for line in told.splitlines())


@pytest.mark.parametrize("kind", KINDS)
def test_a_catalog_is_created_where_it_is_said(kind, tmp_path):
    root = tmp_path / "results"
    with database_of(kind, tmp_path) as url:
        say("create", "--out", root, "--database", url)
        assert "already" in say("create", "--out", root, code=2)
        with Catalog(root) as catalog:
            catalog.publish(product())
            assert catalog.database.is_sqlite == (kind == "sqlite")
        assert "1 product in" in say("ls", "--out", root)


# --- with real runs ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_two_runs_at_once(kind, recordings, cache, tmp_path, coslidar):
    """Two processes, the same recordings, one catalog: what one alone would have made, once."""
    alone, both = tmp_path / "alone", tmp_path / "both"
    assert coslidar(*run_arguments(recordings, alone)).code == 0
    with database_of(kind, tmp_path) as url:
        say("create", "--out", both, "--database", url)
        runs = [
            subprocess.Popen(command(*run_arguments(order, both)), env=environment(cache), cwd=tmp_path,
                             stderr=subprocess.PIPE, text=True)
            for order in (recordings, recordings[::-1])
        ]  # fmt: skip
        for process in runs:
            _, told = process.communicate(timeout=280)
            assert process.returncode == 0, told
        assert products(both) == products(alone)
        with Catalog(both) as catalog:
            assert catalog.verify() == []
            assert catalog.orphans(older_than=0) == []
            assert len(catalog.products()) == len(recordings)
            assert len(catalog.batches()) == len(recordings) * BATCHES
            assert [run.state for run in catalog.runs()] == ["finished", "finished"]
            assert catalog.failures() == []


@pytest.mark.slow
def test_damaged_products_are_made_again(recordings, cache, tmp_path, coslidar):
    out = tmp_path / "out"
    assert coslidar(*run_arguments(recordings, out)).code == 0
    before = products(out)
    files = sorted((out / "products").glob("*/*.zarr.zip"))
    files[0].unlink()
    damaged = bytearray(files[1].read_bytes())
    damaged[len(damaged) // 2] ^= 1
    files[1].write_bytes(bytes(damaged))
    assert coslidar("catalog", "verify", "--out", out).code == 1
    mended = coslidar("catalog", "verify", "--repair", "--out", out)
    assert (mended.code, mended.out.count("the same bytes")) == (0, 2), mended.err
    assert products(out) == before
    assert [path.name for path in Path(files[0]).parent.iterdir() if path.name.startswith(".")] == []
    # Of a recording that has gone, nothing can be made; what is left of its product stays.
    files[2].write_bytes(b"damaged")
    with Catalog(out) as catalog:
        from sqlalchemy import update

        from coslidar.catalog.tables import archive

        with catalog.database.write() as connection:
            connection.execute(update(archive).values(url="gone.zarr.zip"))
    refused = coslidar("catalog", "verify", "--repair", "--out", out)
    assert refused.code == 1
    assert "cannot be repaired" in refused.err
    assert files[2].read_bytes() == b"damaged"
