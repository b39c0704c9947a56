"""The whole chain against reading and decoding the same archive, in one run on as many threads.

Prints the CPU and wall time of both, then what the CPU time of the chain went into, and on its last line the ratio of
their CPU times. The chain is what `coslidar run --no-prefect` does in a process that is up: plan, read, extract,
correlate, invert, draw the intervals, write the product, keep the books. Its modules are imported and its kernels
loaded before anything is timed; so is the response matrix, which all runs of an instrument share.

    python benchmarks/bench_chain.py [--frames 25560 51120] [--codec lz4 zstd] [--repeat 3]
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

from coslidar.catalog import archive_codecs
from coslidar.catalog.archive import open_archive
from coslidar.flows import driver, run, tasks
from coslidar.flows.settings import load
from coslidar.flows.simulate import simulate_recording
from coslidar.pipeline import batch, checks, convergence, correlation, measurement, posterior, timing, vibration

FOLDER = Path(__file__).resolve().parents[1] / "bench-data"

#: What the CPU time is divided into: a label, and the functions that it is spent in (without those of other labels).
PARTS: dict[str, list[tuple[Any, str]]] = {
    "plan: open, check, plugins, lineage": [(driver, "plan_archive"), (driver, "model_of")],
    "read: file": [(archive_codecs.StoredArray, "fetch")],
    "read: checksum and decoding": [(archive_codecs.Chain, "decode")],
    "measure: spots found": [(measurement._Reference, "_find")],
    "measure: kernel": [(measurement, "extract")],
    "measure: noise, gain, rest": [(tasks, "_measure")],
    "reduce: sums and maps": [(correlation, "accumulate"), (correlation, "finalise")],
    "reduce: lagged covariance": [(convergence, "lagged")],
    "reduce: checks": [
        *((checks, name) for name in ("zernike_check", "log_amplitude", "stationarity")),
        *((timing, name) for name in ("repeated", "pupil_mean", "outages", "regular", "stamps", "trend", "slow_part")),
        *((vibration, name) for name in ("find_line", "spectrum")),
    ],
    "reduce: rest": [(batch, "reduce")],
    "retrieve: inversion": [(batch, "retrieve")],
    "retrieve: intervals": [(posterior, "sample")],
    "product: assembled": [(driver, "assemble")],
    "product and results written": [(driver.Batches, "_take"), (driver, "_process")],
}
REST = "start and end of the run: catalog, Dask, event loop"


class Spent:
    """CPU seconds of each label of :data:`PARTS`, in all threads."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._stack = threading.local()
        self._lock = threading.Lock()

    def _counted(self, label: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def counted(*given: Any, **named: Any) -> Any:
            inner = getattr(self._stack, "inner", None)
            self._stack.inner = 0.0
            start = time.thread_time()
            try:
                return function(*given, **named)
            finally:
                spent = time.thread_time() - start
                with self._lock:
                    self.seconds[label] += spent - self._stack.inner
                self._stack.inner = None if inner is None else inner + spent
                if inner is None:
                    self._stack.inner = 0.0

        return counted

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Count what is spent inside."""
        kept = [(owner, name, owner.__dict__[name], label) for label, them in PARTS.items() for owner, name in them]
        for owner, name, function, label in kept:
            setattr(owner, name, self._counted(label, function))
        try:
            yield
        finally:
            for owner, name, function, _ in kept:
                setattr(owner, name, function)


@dataclass(frozen=True)
class Times:
    """Medians over the rounds, s and ratios."""

    reading: float
    chain: float
    cpu_ratio: float
    wall_ratio: float


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
        (outcome,) = run.run(settings, prefect=False)
        assert outcome.status == "published", outcome


def timed(work: Callable[..., object], *arguments: object) -> tuple[float, float]:
    """(CPU, wall) seconds of one call."""
    cpu, wall = time.process_time(), time.perf_counter()
    work(*arguments)
    return time.process_time() - cpu, time.perf_counter() - wall


def measure(path: Path, threads: int, minutes: float, repeat: int) -> Times:
    """Time both in turns, and print them."""
    timed(chain, path, threads, minutes)  # compiles what numba has not cached yet
    rounds = []
    for number in range(repeat):
        read = timed(reading, path, threads)
        done = timed(chain, path, threads, minutes)
        rounds.append((read, done))
        print(
            f"round {number + 1}: reading {read[0]:.2f} s CPU {read[1]:.2f} s wall; "
            f"chain {done[0]:.2f} s CPU {done[1]:.2f} s wall",
            flush=True,
        )
    median = statistics.median
    return Times(
        reading=median(read[0] for read, _ in rounds),
        chain=median(done[0] for _, done in rounds),
        cpu_ratio=median(done[0] / read[0] for read, done in rounds),
        wall_ratio=median(done[1] / read[1] for read, done in rounds),
    )


def where_it_goes(path: Path, threads: int, minutes: float, reading: float) -> dict[str, float]:
    """CPU seconds of one more round by part, printed in units of reading alone."""
    spent = Spent()
    with spent.watching():
        total, _ = timed(chain, path, threads, minutes)
    found = {label: spent.seconds[label] for label in PARTS}
    found[REST] = total - sum(found.values())
    for label, seconds in found.items():
        print(f"  {label:52s} {seconds * 1e3:7.0f} ms  {seconds / reading:5.2f}")
    print(f"  {'together':52s} {total * 1e3:7.0f} ms  {total / reading:5.2f}")
    return found


def main(argv: Sequence[str] | None = None, folder: Path = FOLDER) -> list[Times]:
    """Run the benchmark on each archive that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[25_560, 51_120], help="of each recording (142 Hz)")
    parser.add_argument("--codec", choices=["lz4", "zstd"], nargs="+", default=["zstd", "lz4"])
    parser.add_argument("--batch", type=float, default=3.0, help="length of a batch in minutes")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    given = parser.parse_args(argv)

    told, found = [], []
    for frames in given.frames:
        for codec in given.codec:
            path = folder / f"chain-{frames}-{codec}.zarr"
            if not path.exists():
                print(f"simulating {frames} frames into {path} ...", flush=True)
                shutil.rmtree(path, ignore_errors=True)
                simulate_recording(path, frames, codec=codec)
            what = f"{frames} frames, {codec}, {given.threads} threads"
            print(f"== {what}")
            times = measure(path, given.threads, given.batch, given.repeat)
            print("where the CPU time goes (right column: in units of reading alone)")
            where_it_goes(path, given.threads, given.batch, times.reading)
            found.append(times)
            told.append(f"{what}: chain / reading {times.cpu_ratio:.2f} CPU time, {times.wall_ratio:.2f} wall time")
    print("\n".join(told))
    return found


if __name__ == "__main__":
    main(sys.argv[1:])
