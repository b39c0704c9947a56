"""Two workers against one: threads of one process, and processes of a cluster.

The same recording is processed by one and by two threads, and by one and by two worker processes of a Dask cluster, in
turns. The gain is the ratio of wall times, and at most the number of cores that nobody else uses: the load of the
machine is told with it, and the CPU time, which should not grow. On its last line the gain of two threads.

    python benchmarks/bench_workers.py [--batches 40] [--frames 2100] [--repeat 3]
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

import psutil
from recordings import FRAMES, recording, settings_for
from small_clusters import Cluster

from coslidar.flows.run import run


def spent(pids: list[int]) -> float:
    """CPU seconds of processes and their children."""
    every = [one for pid in pids for one in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True))]
    return sum(sum(one.cpu_times()[:2]) for one in every)


def main(argv: list[str] | None = None) -> float:
    """Run the benchmark and return the gain of two threads."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", type=int, default=40)
    parser.add_argument("--frames", type=int, default=30 * FRAMES, help=f"frames of a batch, a multiple of {FRAMES}")
    parser.add_argument("--repeat", type=int, default=3)
    given = parser.parse_args(argv)
    parts = given.frames // FRAMES
    times: dict[tuple[str, int], list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = recording(folder / "r.zarr", given.batches * parts)
        short = f"batch.duration={0.7 * parts:.1f} s"
        clusters = {}
        for number in (1, 2):
            (folder / f"cluster-{number}").mkdir()
            clusters[number] = Cluster(folder / f"cluster-{number}", folder / "home")
        try:
            for number, cluster in clusters.items():
                for _ in range(number):
                    cluster.worker()
                assert cluster.ready(number)
            for turn in range(-1, given.repeat):  # the first turn compiles and imports
                for kind in ("threads", "processes"):
                    for number in (1, 2):
                        where = (
                            f"run.threads={number}"
                            if kind == "threads"
                            else f"run.scheduler={clusters[number].address}"
                        )
                        settings = settings_for([path], folder / f"out-{kind}-{number}-{turn}", short, where)
                        pids = [os.getpid()]
                        if kind == "processes":
                            pids += [process.pid for process in clusters[number].processes]
                        cpu, wall = spent(pids), time.perf_counter()
                        (outcome,) = run(settings, prefect=False)
                        assert outcome.status == "published", outcome
                        if turn >= 0:
                            one = (time.perf_counter() - wall, spent(pids) - cpu)
                            times.setdefault((kind, number), []).append(one)
        finally:
            for cluster in clusters.values():
                cluster.close()
    gains = {}
    for kind in ("processes", "threads"):
        one, two = times[kind, 1], times[kind, 2]
        gains[kind] = statistics.median(a[0] / b[0] for a, b in zip(one, two, strict=True))
        more = statistics.median(b[1] / a[1] for a, b in zip(one, two, strict=True))
        print(
            f"{kind}: 1 takes {statistics.median(a[0] for a in one):.1f} s, 2 take "
            f"{statistics.median(b[0] for b in two):.1f} s; gain {gains[kind]:.2f}, CPU time {more:.2f} "
            f"({len(os.sched_getaffinity(0))} cores, load {os.getloadavg()[0]:.0f})",
            flush=True,
        )
    print(f"gain of two threads over one, wall time: {gains['threads']:.2f}")
    return gains["threads"]


if __name__ == "__main__":
    main(sys.argv[1:])
