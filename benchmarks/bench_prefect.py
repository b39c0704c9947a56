"""What Prefect and Dask cost on top of a bare loop, on about a minute of work.

The same recordings are processed by a plain loop over their batches (read, measure, correlate, invert, assemble,
publish; one thread), by `coslidar run --no-prefect` with one thread, and with Prefect on top, whose server runs all the
time. The three take turns; wall and CPU time of the process are compared within each round and medians are told. The
last line is the ratio of CPU times of Prefect and Dask to the bare loop: others on the machine disturb that least.

    python benchmarks/bench_prefect.py
    python benchmarks/bench_prefect.py --frames 70 --batches 300     the worst case: batches of 0.7 s, a minute of them
    python benchmarks/bench_prefect.py --archives 1 --batches 10     a quick look
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

from recordings import FRAMES, recording, settings_for

from coslidar.catalog.products import assemble
from coslidar.catalog.store import Catalog
from coslidar.flows.batches import Batches
from coslidar.flows.driver import Work, attributes_of, model_of
from coslidar.flows.plan import plan_archive
from coslidar.flows.run import run
from coslidar.flows.server import server
from coslidar.flows.settings import Settings
from coslidar.flows.tasks import process_batch
from coslidar.pipeline import description, surroundings


class _Nobody:
    """Stands for a cluster, for the loop has none."""

    status = "running"


def bare(settings: Settings) -> None:
    """Every archive and batch one after the other, with nothing around them."""
    with Catalog(settings.output) as catalog:
        identity = catalog.start_run({}, "bare loop")
        work = Work(settings, catalog, identity, _Nobody(), None)  # type: ignore[arg-type]
        for url in settings.archives:
            plan = plan_archive(url, settings)
            model = model_of(plan, work)
            batches = Batches(plan, work)
            outcomes = [process_batch(batches._task(window, model), model) for window in plan.windows]
            results = [outcome.result for outcome in outcomes if outcome.result is not None]
            assert len(results) == len(plan.windows)
            dataset = assemble(
                results,
                description.describe(model, plan.header) | surroundings.compared(results),
                campaign=plan.header.campaign,
                archive=plan.header.archive,
                archive_identity=plan.archive.identity,
                lineage=plan.profile_key,
                wavelength=plan.header.instrument.wavelength,
                sources=plan.source_names,
                attributes=attributes_of(plan, settings),
            )
            catalog.publish(dataset, identity, url=url, header=plan.archive.attributes)


def with_dask(settings: Settings) -> None:
    """As `coslidar run --no-prefect` does."""
    assert all(outcome.status == "published" for outcome in run(settings, prefect=False))


def with_prefect(settings: Settings) -> None:
    """As `coslidar run` does."""
    assert all(outcome.status == "published" for outcome in run(settings, prefect=True))


def main(argv: list[str] | None = None) -> float:
    """Run the benchmark and return the ratio of wall times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--archives", type=int, default=4)
    parser.add_argument("--batches", type=int, default=25, help="batches of an archive")
    parser.add_argument("--frames", type=int, default=180 * FRAMES, help=f"frames of a batch, a multiple of {FRAMES}")
    parser.add_argument("--repeat", type=int, default=3)
    given = parser.parse_args(argv)
    parts = given.frames // FRAMES
    more = ("run.threads=1", f"batch.duration={0.7 * parts:.1f} s")
    ways = {"bare loop": bare, "Dask": with_dask, "Prefect + Dask": with_prefect}
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    with tempfile.TemporaryDirectory() as name, server() as ready:
        folder = Path(name)
        ready()
        archives = [
            recording(folder / f"r{n}.zarr.zip", given.batches * parts, name=f"r{n}", begin=36000.0 * n, seed=n % 2)
            for n in range(given.archives)
        ]
        warm = recording(folder / "warm.zarr.zip", 2 * parts, name="warm", begin=-36000)
        for way, call in ways.items():
            call(settings_for([warm], folder / f"warm {way}", *more))
        for number in range(given.repeat):
            for way, call in ways.items():
                settings = settings_for(archives, folder / f"{way} {number}", *more)
                cpu, wall = time.process_time(), time.perf_counter()
                call(settings)
                spent[way].append((time.perf_counter() - wall, time.process_time() - cpu))
            told = [f"{way} {times[-1][0]:.1f} s wall {times[-1][1]:.1f} s CPU" for way, times in spent.items()]
            print(f"round {number + 1}: {'; '.join(told)}", flush=True)
        products = [
            {path.name: path.read_bytes() for path in (folder / f"{way} 0").rglob("*.zarr.zip")} for way in ways
        ]
        assert products[0] == products[1] == products[2], "the three ways give other products"
    ratio = float("nan")
    for way in ("Dask", "Prefect + Dask"):
        wall, cpu = (
            statistics.median(mine[i] / loop[i] for mine, loop in zip(spent[way], spent["bare loop"], strict=True))
            for i in (0, 1)
        )
        load = os.getloadavg()[0]
        print(f"{way} / bare loop: CPU {cpu:.3f}, wall {wall:.3f} (median of {given.repeat}; load {load:.0f})")
        ratio = cpu
    print(f"Prefect and Dask / bare loop, CPU time of the process: {ratio:.3f}")
    return ratio


if __name__ == "__main__":
    main(sys.argv[1:])
