"""Rows into a catalog from four processes, and queries out of it, on SQLite and PostgreSQL.

python benchmarks/bench_catalog.py                 100,000 batches in both databases
python benchmarks/bench_catalog.py --rows 4000     a quick look

Every transaction is that of a publisher: archive, lineage, plugins, product and its batches, held and synchronised to
the disk as any other; only the file of the product is left out, so that the database is what is measured. PostgreSQL
is the server that COSLIDAR_TEST_POSTGRESQL names (its tables stand in a schema that is dropped afterwards), else one
that `.ci/postgresql` starts for the time; without either it is skipped, and the output says so.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import os
import random
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import sqlalchemy as sa
from catalogs import database_of, use_server

from coslidar.catalog.store import Catalog
from coslidar.catalog.tables import archive, batch, campaign, lineage, plugin, product, schema_version

WRITERS = 4
#: Batches of one product: eight hours in batches of 3 min.
BATCHES = 160
#: What was measured with four writers when SQLite was chosen, rows/s.
REFERENCE = 3095
START = 1_347_624_900_000_000_000
STEP = 180 * 10**9
QUERIES = {
    "a night": "t>=2012-09-20T18:00Z t<2012-09-21T06:00Z",
    "a campaign's calm hours": "campaign=site-2 scint<0.02 quality=good",
    "calm and good, of all": "r0>29 cm scint<0.02 quality=good",
    "current products, a day": "current=yes t>=2012-09-18Z t<2012-09-19Z",
    "flag by name, a week": "flag=poor_fit t>=2012-09-16Z t<2012-09-23Z",
    "one moment": "t=2012-09-20T03:04:05Z",
    "one product": "key={key}",
}


def digest(*parts: object) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def publish(catalog: Catalog, writer: int, number: int, dice: random.Random) -> None:
    """The rows of one product, in one transaction."""
    place, identity, key = number % 3, digest("archive", writer, number), digest("key", writer, number)
    with catalog.database.write() as connection:
        connection.execute(sa.select(schema_version.c.version).with_for_update(read=True))
        insert = catalog.database.insert_new
        insert(connection, campaign, {"name": f"site-{place}", "timezone": "Europe/Paris"}, campaign.c.id)
        site = connection.scalar(sa.select(campaign.c.id).where(campaign.c.name == f"site-{place}"))
        name = f"w{writer}-n{number}"
        values = {"campaign_id": site, "name": name, "identity": identity, "url": f"/data/{name}", "header": {"a": 1}}
        recording = insert(connection, archive, values, archive.c.id)
        document = {"key": key, "nodes": {key: {"stage": "profile", "plugins": {}}}}
        insert(connection, lineage, {"key": key, "stage": "profile", "document": document}, lineage.c.key)
        chosen = {"lineage_key": key, "role": "regulariser", "number": 0, "version": 1, "parameters": {}}
        connection.execute(sa.insert(plugin), [{**chosen, "name": dice.choice(["white", "gradient"])}])
        begin = START + (writer * 10_000 + number) * BATCHES * STEP // WRITERS
        values = {
            "archive_id": recording, "lineage_key": key, "path": f"products/site-{place}/{name}.{key[:16]}.zarr.zip",
            "sha256": identity, "size": 100_000, "published": time.time_ns(), "start": begin,
            "stop": begin + BATCHES * STEP, "batches": BATCHES,
        }  # fmt: skip
        made = insert(connection, product, values, product.c.id)
        rows = [
            {
                "product_id": made, "number": i, "start": begin + i * STEP, "stop": begin + (i + 1) * STEP,
                "quality_flag": dice.choice([0, 0, 0, 128, 256]), "quality_level": dice.choice([0, 0, 0, 1, 2]),
                "n_frames": 25560, "r0": dice.uniform(0.02, 0.3), "scintillation_index": dice.uniform(0, 0.5),
                "scintillation_index_profile": dice.uniform(0, 0.5), "scintillation_index_point": dice.uniform(0, 1),
                "mu": 10 ** dice.uniform(24, 30), "chi2": dice.uniform(0.5, 3),
            }
            for i in range(BATCHES)
        ]  # fmt: skip
        connection.execute(sa.insert(batch), rows)


def write(url: str, root: str, writer: int, products: int, ready: object, go: object, spent: object) -> None:
    dice = random.Random(writer)
    with Catalog(root, url) as catalog:
        catalog.releases()  # connected
        ready.release()  # type: ignore[attr-defined]
        go.wait()  # type: ignore[attr-defined]
        begin = time.process_time()
        for number in range(products):
            publish(catalog, writer, number, dice)
        spent.put(time.process_time() - begin)  # type: ignore[attr-defined]


def measure(kind: str, rows: int, repeats: int) -> None:
    products = max(1, round(rows / WRITERS / BATCHES))
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder, database_of(kind, Path(folder)) as url:
        root = f"{folder}/catalog"
        Catalog(root, url).close()
        ready, go, spent = context.Semaphore(0), context.Event(), context.Queue()
        writers = [
            context.Process(target=write, args=(url, root, number, products, ready, go, spent))
            for number in range(WRITERS)
        ]
        for writer in writers:
            writer.start()
        for _ in writers:
            ready.acquire()
        begin = time.perf_counter()
        go.set()
        for writer in writers:
            writer.join()
            assert writer.exitcode == 0
        elapsed = time.perf_counter() - begin
        written = products * WRITERS * BATCHES
        print(f"{kind}: {written} batch rows in {products * WRITERS} transactions from {WRITERS} processes")
        cpu = sum(spent.get() for _ in writers)
        print(
            f"  {written / elapsed:,.0f} rows/s, {written / elapsed / REFERENCE:.2f} of the reference {REFERENCE:,}; "
            f"{1e6 * cpu / written:.0f} us of CPU a row in the writers ({os.cpu_count()} cores, load "
            f"{os.getloadavg()[0]:.0f})"
        )
        with Catalog(root, url) as catalog:
            with catalog.database.read() as connection:
                assert connection.scalar(sa.select(sa.func.count()).select_from(batch)) == written
            if not catalog.database.is_sqlite:
                # What its own housekeeping does within a minute.
                with catalog.database.write() as connection:
                    connection.exec_driver_sql("ANALYZE")
            for name, text in QUERIES.items():
                times = []
                for _ in range(repeats):
                    begin = time.perf_counter()
                    found = catalog.query(text.format(key=digest("key", 0, 0)[:12]))
                    times.append(1e3 * (time.perf_counter() - begin))
                times.sort()
                p50, p95 = times[len(times) // 2], times[int(0.95 * (len(times) - 1))]
                print(f"  {name:<24} {len(found):>6} batches   p50 {p50:7.1f} ms   p95 {p95:7.1f} ms")


@contextmanager
def server():
    """URL of a PostgreSQL server, or None with the reason told."""
    if given := os.environ.get("COSLIDAR_TEST_POSTGRESQL"):
        yield given
        return
    script, folder = ROOT / ".ci" / "postgresql", tempfile.mktemp(prefix="coslidar-postgresql.", dir="/tmp")
    started = subprocess.run([script, "start", folder], stdout=subprocess.PIPE, text=True)
    if started.returncode:
        print("postgresql: skipped, there is no server and none could be started")
        yield None
        return
    try:
        yield started.stdout.strip()
    finally:
        subprocess.run([script, "stop", folder], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=40)
    parser.add_argument("--database", choices=["sqlite", "postgresql"], action="append")
    chosen = parser.parse_args()
    for kind in chosen.database or ["sqlite", "postgresql"]:
        if kind == "sqlite":
            measure(kind, chosen.rows, chosen.repeats)
            continue
        with server() as url:
            if url is not None:
                use_server(url)
                measure(kind, chosen.rows, chosen.repeats)


if __name__ == "__main__":
    main()
