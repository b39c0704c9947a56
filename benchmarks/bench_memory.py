"""Memory of what computes against the length of the archive: threads of one process, and a worker of a cluster.

Archives of 160 x 160 pixels of growing length are processed in a fresh process each, batch by batch of 3 min, and the
peak of its resident memory is told, with what the imports alone take; then the same by a worker process of a cluster.
The frames are those of one simulated recording, repeated. On its last line the largest peak of all, MB.

    python benchmarks/bench_memory.py [--frames 25560 51120 102240] [--threads 2]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import recordings  # noqa: F401  (finds the helpers of the tests)
from small_clusters import Cluster

from coslidar.catalog.archive import open_archive
from coslidar.catalog.archive_writer import write_archive
from coslidar.flows.simulate import simulate_recording

FOLDER = Path(__file__).resolve().parents[1] / "bench-data"

_CODE = """
import json, sys
from pathlib import Path
import psutil
from coslidar.flows.run import run
from coslidar.flows.settings import load
import coslidar.flows.tasks, coslidar.flows.driver, coslidar.flows.cluster, distributed
given = json.loads(sys.argv[1])
imported = psutil.Process().memory_info().rss / 1e6
settings = load(archives=[given["path"]], output=Path(given["out"]), assignments=given["assignments"])
(outcome,) = run(settings, prefect=False)
assert outcome.status == "published", outcome
# Not ru_maxrss, which knows the memory of the process that started this one.
highest = float(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0]) / 1e3
print(json.dumps([imported, highest]))
"""


def longer(short: Path, target: Path, frames: int) -> Path:
    """An archive with the frames of another one, again and again."""
    if target.exists():
        return target
    archive = open_archive(short)
    pictures = [block for _, block in archive.chunks()]

    def blocks() -> Iterator[np.ndarray[Any, Any]]:
        left = frames
        while left > 0:
            for block in pictures:
                if left > 0:
                    yield block[:left]
                    left -= len(block)

    period = round(1e9 / archive.header.instrument.frame_rate)
    times = int(archive.time[0]) + period * np.arange(frames, dtype=np.int64)
    attributes = {**archive.attributes, "archive": f"frames-{frames}"}
    given = {"dark": archive.dark, "flat": archive.flat, "bad_pixel": archive.bad_pixel}
    return write_archive(target, attributes, times, blocks(), chunk_frames=archive.chunk_frames, **given)


def peak(path: Path, out: Path, *assignments: str) -> tuple[float, float]:
    """Memory after the imports, and the peak of a process that runs an archive, MB."""
    given = json.dumps({"path": str(path), "out": str(out), "assignments": assignments})
    done = subprocess.run([sys.executable, "-c", _CODE, given], stdout=subprocess.PIPE, text=True, check=True)
    imported, highest = json.loads(done.stdout.splitlines()[-1])
    return imported, highest


def high_water(pid: int) -> float:
    """Peak of the resident memory of a process and of each of its children so far, the largest of them, MB."""
    every = [pid, *(child.pid for child in psutil.Process(pid).children(recursive=True))]
    texts = [Path(f"/proc/{one}/status").read_text() for one in every]
    return max(float(text.partition("VmHWM:")[2].split()[0]) / 1e3 for text in texts)


def main(argv: list[str] | None = None) -> float:
    """Run the benchmark and return the largest peak, MB."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[25_560, 51_120, 102_240])
    parser.add_argument("--base", type=int, default=12_780, help="frames that are simulated, and repeated")
    parser.add_argument("--batch", default="3 min")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    given = parser.parse_args(argv)
    base = FOLDER / f"chain-{given.base}-lz4.zarr"
    if not base.exists():
        print(f"simulating {given.base} frames into {base} ...", flush=True)
        simulate_recording(base, given.base, codec="lz4")
    batch, highest = f"batch.duration={given.batch}", []
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=FOLDER) as name:
        folder = Path(name)
        for frames in given.frames:
            path = longer(base, folder / f"{frames}.zarr", frames)
            driver = [batch, f"run.threads={given.threads}"]
            imported, threads = peak(path, folder / f"threads-{frames}", *driver)
            (home := folder / f"cluster-{frames}").mkdir()
            cluster = Cluster(home, home / "cache")
            try:
                worker = cluster.worker()
                assert cluster.ready(1)
                _, there = peak(path, folder / f"out-{frames}", batch, f"run.scheduler={cluster.address}")
                at_worker = high_water(worker.pid)
            finally:
                cluster.close()
            print(
                f"{frames:>8} frames: {given.threads} threads {threads:.0f} MB (imports alone {imported:.0f} MB); "
                f"worker of a cluster {at_worker:.0f} MB, its driver {there:.0f} MB",
                flush=True,
            )
            highest += [threads, at_worker, there]
    print(f"largest peak of resident memory: {max(highest):.0f} MB")
    return max(highest)


if __name__ == "__main__":
    main(sys.argv[1:])
