"""Does a run of many batches take longer per batch, or more memory, than one of few?

Runs one recording of 10, 100 and 1,000 batches of 70 small frames, each in a process of its own, and prints CPU time
and memory on the way; on its last line the slope of log time against log batches from the second count on (the first
one pays for the start), which is 1 where time is linear. With --cluster a scheduler and a worker are processes of their
own, and the scheduler's memory is told too.

    python benchmarks/bench_scaling.py
    python benchmarks/bench_scaling.py --counts 10000 --cluster
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from recordings import recording, settings_for

from coslidar.flows.run import Silent, run


@dataclass(frozen=True)
class Point:
    """Where a run is after some batches: CPU of the driver's process, s, and resident memory, MB."""

    batches: int
    cpu: float
    wall: float
    driver: float
    scheduler: float


class Watcher(Silent):
    """Notes memory and time ten times in a run."""

    def __init__(self, batches: int, scheduler: psutil.Process | None) -> None:
        self.every, self.scheduler, self.done = max(1, batches // 10), scheduler, 0
        self.points: list[Point] = []
        self.begin = (time.process_time(), time.perf_counter())

    def advanced(self, archive: str, index: int, reason: str) -> None:
        """Count a batch."""
        assert not reason, reason
        self.done += 1
        if self.done % self.every == 0:
            self.note(self.done)

    def note(self, done: int) -> None:
        """Note where the run is."""
        memory = [one.memory_info().rss / 1e6 if one else np.nan for one in (psutil.Process(), self.scheduler)]
        spent = (time.process_time() - self.begin[0], time.perf_counter() - self.begin[1])
        self.points.append(Point(done, *spent, *memory))


def measure(batches: int, folder: Path, *, scheduler: str | None = None, pid: int | None = None) -> list[Point]:
    """Run one recording and note memory and time on the way, and last after the product was published."""
    path = recording(folder / f"{batches}.zarr", batches)
    more = ["correlation.covariance=independent", *([f"run.scheduler={scheduler}"] if scheduler else [])]
    settings = settings_for([path], folder / f"results-{batches}", *more)
    watcher = Watcher(batches, psutil.Process(pid) if pid else None)
    (outcome,) = run(settings, watcher, prefect=False)
    assert outcome.status == "published", outcome
    assert outcome.batches == batches
    watcher.note(batches)
    return watcher.points


def in_a_process(batches: int, folder: Path, **more: Any) -> list[Point]:
    """The same in a process of its own, so that memory is that of this run."""
    code = (
        "import sys, json; sys.path.insert(0, sys.argv[1]); from pathlib import Path; from dataclasses import asdict; "
        "from bench_scaling import measure; given = json.loads(sys.argv[2]); "
        "print(json.dumps([asdict(p) for p in measure(given.pop('batches'), Path(given.pop('folder')), **given)]))"
    )
    arguments = json.dumps({"batches": batches, "folder": str(folder), **more})
    here = str(Path(__file__).resolve().parent)
    done = subprocess.run([sys.executable, "-c", code, here, arguments], stdout=subprocess.PIPE, text=True, check=True)
    return [Point(**point) for point in json.loads(done.stdout.splitlines()[-1])]


def show(points: list[Point]) -> None:
    """Print a table."""
    for point in points:
        scheduler = "" if np.isnan(point.scheduler) else f"   scheduler {point.scheduler:6.1f} MB"
        print(
            f"  {point.batches:>6} batches   {point.cpu:7.1f} s CPU ({1e3 * point.cpu / point.batches:6.1f} ms each) "
            f"  {point.wall:7.1f} s wall   driver {point.driver:6.1f} MB{scheduler}",
            flush=True,
        )


def main(argv: list[str] | None = None) -> float:
    """Run the benchmark and return the slope (nan for fewer than three counts)."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--cluster", action="store_true", help="scheduler and worker as processes of their own")
    given = parser.parse_args(argv)
    from small_clusters import Cluster

    spent = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measure(2, folder)  # compiles, and computes the response, where neither is kept
        cluster = Cluster(folder, folder / "home") if given.cluster else None
        if cluster is not None:
            cluster.worker()
            assert cluster.ready(1)
        where: dict[str, Any] = {"scheduler": cluster.address, "pid": cluster.scheduler.pid} if cluster else {}
        try:
            for count in given.counts:
                points = in_a_process(count, folder, **where)
                show(points)
                spent.append(points[-1].cpu)
        finally:
            if cluster is not None:
                cluster.close()
    if len(spent) < 3:
        return float("nan")
    slope = float(np.polyfit(np.log(given.counts[1:]), np.log(spent[1:]), 1)[0])
    print(f"slope of log CPU time against log batches: {slope:.2f}")
    return slope


if __name__ == "__main__":
    main(sys.argv[1:])
