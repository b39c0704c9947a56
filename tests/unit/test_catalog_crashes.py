"""Publishers that are killed at any moment leave no row without its file, no wrong hash, nothing twice."""

from __future__ import annotations

import os
import random
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import sqlalchemy as sa
from catalogs import KINDS, database_of
from made_products import key

from coslidar.catalog import tables
from coslidar.catalog.store import Catalog

HELPERS = str(Path(__file__).parents[1])
pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for zombies in /proc")

# Imports once, then forks publishers on command: a round costs milliseconds, not the second of an import.
_PUBLISHERS = """
import json, os, random, sys
sys.path.insert(0, sys.argv[1])
from made_products import key, product
from coslidar.catalog.store import Catalog
import coslidar.pipeline.lineage as lineage

made = product()
def variant(number, note):
    changed = key(number)
    document = json.dumps(lineage.document(changed), sort_keys=True)
    return made.assign_attrs(lineage_key=str(changed), lineage=document, note=note)

for line in sys.stdin:
    seed, count = map(int, line.split())
    for number in range(count):
        child = os.fork()
        if child == 0:
            random.seed(seed * 100 + number)
            with Catalog(sys.argv[2], sys.argv[3]) as catalog:
                while True:
                    # Writers in a range of few numbers: they meet. Now and then one brings other bytes for a product.
                    wanted, again = seed * 10 + random.randrange(20), random.random() < 0.3
                    note = str(random.randrange(3)) if again else ""
                    if catalog.publish(variant(wanted, note), replace=again).new:
                        os.write(1, f"published {wanted}\\n".encode())
        os.write(1, f"pid {child}\\n".encode())
"""


class Nursery:
    """Publishers, and what they said."""

    def __init__(self, root, url):
        self.process = subprocess.Popen(
            [sys.executable, "-c", _PUBLISHERS, HELPERS, str(root), url], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self.acknowledged: list[int] = []
        self.children: list[int] = []
        self._rest = b""

    def start(self, seed, count):
        self.children = []
        self.process.stdin.write(f"{seed} {count}\n".encode())
        self.process.stdin.flush()
        while len(self.children) < count:
            self.listen(60)

    def listen(self, seconds):
        """Read what was said; wait for it so long at most."""
        if not select.select([self.process.stdout], [], [], seconds)[0]:
            return
        said = os.read(self.process.stdout.fileno(), 65536)
        assert said, "the publishers have gone"
        *lines, self._rest = (self._rest + said).split(b"\n")
        for word, value in (line.split() for line in lines):
            (self.children if word == b"pid" else self.acknowledged).append(int(value))

    def kill(self):
        for child in self.children:
            os.kill(child, signal.SIGKILL)
        for child in self.children:
            while state(child) not in ("Z", ""):
                time.sleep(0.002)
        self.listen(0)

    def close(self):
        self.process.stdin.close()
        self.process.terminate()
        self.process.wait()


def state(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def whole(catalog):
    """Every row has its file with its hash and its batches, every file its row, and nothing is there twice."""
    rows = catalog.products()
    assert catalog.verify() == []
    assert len({(row.archive_identity, row.lineage_key) for row in rows}) == len(rows)
    assert {row.path for row in rows} == {p for p in (catalog.root / "products").rglob("*") if p.is_file()}
    counted = sa.select(tables.batch.c.product_id, sa.func.count()).group_by(tables.batch.c.product_id)
    with catalog.database.read() as connection:
        assert dict(map(tuple, connection.execute(counted))) == {row.id: row.batches for row in rows}
    return rows


def kill_rounds(kind, folder, rounds, publishers):
    """Start publishers, kill them all at a random moment, look at what is left; over and over."""
    dice = random.Random(2012)
    orphans = 0
    root = folder / "catalog"
    with database_of(kind, folder) as url:
        Catalog(root, url).close()
        nursery = Nursery(root, url)
        try:
            for number in range(rounds):
                nursery.start(number, publishers)
                # Some way into the work, counted by what was published, so that a busy machine changes nothing.
                enough, deadline = len(nursery.acknowledged) + dice.randrange(6), time.monotonic() + 60
                while len(nursery.acknowledged) < enough and time.monotonic() < deadline:
                    nursery.listen(0.05)
                time.sleep(dice.uniform(0, 0.03))
                nursery.kill()
                with Catalog(root, url) as catalog:
                    orphans += len(catalog.collect(older_than=0))
                    assert catalog.orphans(older_than=0) == []
                    whole(catalog)
        finally:
            nursery.close()
        with Catalog(root, url) as catalog:
            rows = whole(catalog)
            published = {row.lineage_key for row in rows}
            assert catalog.open(rows[-1]).attrs["lineage_key"] == rows[-1].lineage_key
    # What a publisher was told to be there is there.
    assert [number for number in nursery.acknowledged if str(key(number)) not in published] == []
    return len(published), orphans


@pytest.mark.parametrize("kind", KINDS)
def test_killed_publishers(kind, tmp_path):
    published, _ = kill_rounds(kind, tmp_path, rounds=3, publishers=2)
    assert published > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_fifty_rounds_of_killed_publishers(kind, tmp_path, record_property):
    published, orphans = kill_rounds(kind, tmp_path, rounds=50, publishers=4)
    record_property("published", published)
    record_property("orphans", orphans)
    assert published > 50
    # Not one half-written file in 50 rounds would mean that the kills came at harmless moments.
    assert orphans > 0
    print(f"{kind}: {published} published, {orphans} orphans collected")
