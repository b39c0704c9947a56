"""The whole chain against reading and decoding the same archive, in one run on as many threads.

Prints the CPU and wall time of both, where the rest goes, and last on its last line the ratio of the chain's time to
the time of reading alone. Usage: python benchmarks/bench_chain.py [--frames 51120] [--repeat 3] [--codec lz4]
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

from coslidar.catalog.archive import open_archive
from coslidar.flows.run import run
from coslidar.flows.settings import load
from coslidar.flows.simulate import simulate_recording

FOLDER = Path(__file__).resolve().parents[1] / "bench-data"


def reading(path: Path, threads: int) -> None:
    """Read and decode every chunk, as many threads as the chain has, each its own part of the archive."""
    archive = open_archive(path)
    edges = [archive.n_chunks * i // threads for i in range(threads + 1)]

    def part(number: int) -> None:
        for chunk in range(edges[number], edges[number + 1]):
            archive.read_chunk(chunk)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(part, range(threads)))


def chain(path: Path, threads: int, minutes: float) -> None:
    """Archive to catalogued profiles, without what an earlier round left."""
    with tempfile.TemporaryDirectory() as folder:
        settings = load(
            archives=[str(path)],
            output=Path(folder),
            assignments=[f"run.threads={threads}", f"batch.duration={minutes} min"],
        )
        (outcome,) = run(settings, prefect=False)
        assert outcome.status == "published", outcome


def timed(work: object, *arguments: object) -> tuple[float, float]:
    """(CPU, wall) seconds of one call."""
    cpu, wall = time.process_time(), time.perf_counter()
    work(*arguments)  # type: ignore[operator]
    return time.process_time() - cpu, time.perf_counter() - wall


def main(argv: list[str] | None = None) -> float:
    """Run the benchmark and return the ratio of wall times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=51_120, help="frames of the recording (142 Hz)")
    parser.add_argument("--batch", type=float, default=3.0, help="length of a batch in minutes")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--codec", choices=["lz4", "zstd"], default="lz4")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    given = parser.parse_args(argv)

    path = FOLDER / f"chain-{given.frames}-{given.codec}.zarr"
    if not path.exists():
        print(f"simulating {given.frames} frames into {path} ...", flush=True)
        shutil.rmtree(path, ignore_errors=True)
        simulate_recording(path, given.frames, codec=given.codec)
    timed(chain, path, given.threads, given.batch)  # compiles what numba has not cached yet
    rounds = []
    for number in range(given.repeat):
        read = timed(reading, path, given.threads)
        done = timed(chain, path, given.threads, given.batch)
        rounds.append((read, done))
        print(
            f"round {number + 1}: reading {read[0]:.2f} s CPU {read[1]:.2f} s wall; "
            f"chain {done[0]:.2f} s CPU {done[1]:.2f} s wall",
            flush=True,
        )
    cpu = statistics.median(done[0] / read[0] for read, done in rounds)
    wall = statistics.median(done[1] / read[1] for read, done in rounds)
    size = given.frames
    print(f"{size} frames, {given.codec}, {given.threads} threads: CPU ratio {cpu:.2f} (median of {given.repeat})")
    print(f"chain / reading, wall time: {wall:.2f}")
    return wall


if __name__ == "__main__":
    main(sys.argv[1:])
