"""Start-up: `coslidar run` on one small archive from a warm installation, and where the time goes.

A fresh process each time, compiled kernels and response matrix kept from an earlier run, the first archive of the demo
(12 s, 1,704 frames, one batch). Wall and CPU time are told with Prefect (its server is counted) and without, then the
parts: each is what the process spent from one step to the next, and the server beside. On a machine with other work CPU
time is the figure to go by; the last line is the CPU time of a run with --no-prefect, s.

    python benchmarks/bench_startup.py [--repeat 5]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from recordings import recording

_PARTS = """
import json, os, sys, time
from contextlib import ExitStack
steps, last = [], [time.perf_counter(), 0.0]

def children():
    import psutil
    return sum(sum(child.cpu_times()[:2]) for child in psutil.Process().children(recursive=True))

def step(name):
    now = time.perf_counter(), time.process_time()
    steps.append((name, now[0] - last[0], now[1] - last[1], children() if given["prefect"] else 0.0))
    last[:] = time.perf_counter(), time.process_time()

given = json.loads(sys.argv[1])
from pathlib import Path
import coslidar.flows.cli
from coslidar.flows.settings import load
step("Python, command line, settings and units imported")
settings = load(archives=[given["path"]], output=Path(given["out"]), assignments=given["assignments"])
step("settings read, plugins found")
from coslidar.flows.server import server
with ExitStack() as stack:
    ready = stack.enter_context(server()) if given["prefect"] else None
    from coslidar.flows import cluster, driver, tasks
    from coslidar.flows.run import session
    import distributed
    step("numerics, zarr, xarray and Dask imported")
    work = stack.enter_context(session(settings))
    step("catalog opened, workers started")
    if ready:
        from coslidar.flows.campaign import processing_flow
        step("Prefect imported")
        ready()
        step("waiting for the Prefect server")
    plan = driver.plan_archive(settings.archives[0], settings)
    step("archive opened and planned")
    work.responses_of(plan)
    step("response matrix loaded")
    windows = plan.windows
    batches = driver.Batches(plan, work)
    model = driver.model_of(plan, work)
    tasks.process_batch(batches._task(windows[0], model), model)
    step("kernels loaded, first batch")
    tasks.process_batch(batches._task(windows[0], model), model)
    step("of which the batch itself")
    if ready:
        outcomes = processing_flow(settings, work)
    else:
        outcomes = driver.execute(work, settings.archives, driver.in_threads)
    step("the run: batch, product, catalog" + (", Prefect's records" if ready else ""))
step("all closed")
assert outcomes[0].status == "published", outcomes
print(json.dumps(steps))
"""


def whole(arguments: list[str], environment: dict[str, str]) -> tuple[float, float]:
    """(wall, CPU of the process and all it started) of one command, s."""
    command = [sys.executable, "-c", "from coslidar.flows.cli import main; main()", *arguments]
    before, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == 0, done.stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - wall, spent


def parts(given: dict[str, object], environment: dict[str, str]) -> list[tuple[str, float, float, float]]:
    """(name, wall, CPU, CPU of the server so far) of each step."""
    command = [sys.executable, "-c", _PARTS, json.dumps(given)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return [tuple(one) for one in json.loads(done.stdout.splitlines()[-1])]


def demo(folder: Path, environment: dict[str, str]) -> Path:
    """The first recording of the demo."""
    command = [
        sys.executable,
        "-c",
        "from coslidar.flows.cli import main; main()",
        "init",
        "demo",
        "--scenario",
        "demo",
    ]
    subprocess.run(
        command, env=environment, cwd=folder, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    return sorted((folder / "demo" / "raw").glob("*.zarr.zip"))[0]


def main(argv: list[str] | None = None) -> float:
    """Run the benchmark and return the CPU time of a run without Prefect, s."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--tiny", action="store_true", help="another recording, quicker to make")
    parser.add_argument("--no-prefect", action="store_true", help="only without Prefect")
    given = parser.parse_args(argv)
    found: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    ways = (False,) if given.no_prefect else (False, True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = {key: value for key, value in os.environ.items() if not key.startswith("PREFECT_")}
        environment |= {"COSLIDAR_HOME": str(folder / "home"), "GIT_DIR": "/nonexistent"}
        path = recording(folder / "r.zarr.zip", 4) if given.tiny else demo(folder, environment)
        sets = ["batch.duration=0.7 s", "response.slices=6"] if given.tiny else []
        options = [part for assignment in sets for part in ("--set", assignment)]
        for turn in range(-1, given.repeat):  # the first turn fills the caches
            for prefect in ways:
                out = str(folder / f"out-{turn}-{prefect}")
                more = [] if prefect else ["--no-prefect"]
                spent = whole(["run", str(path), "--out", out, *options, *more], environment)
                if turn >= 0:
                    found[prefect].append(spent)
        for prefect in ways:
            wall, cpu = (statistics.median(one[i] for one in found[prefect]) for i in (0, 1))
            least = min(one[0] for one in found[prefect])
            print(
                f"coslidar run{'' if prefect else ' --no-prefect'}: {cpu:.1f} s CPU, {wall:.1f} s wall "
                f"(shortest {least:.1f} s; median of {given.repeat}, load {os.getloadavg()[0]:.0f})",
                flush=True,
            )
            request = {
                "path": str(path),
                "out": str(folder / f"parts-{prefect}"),
                "assignments": sets,
                "prefect": prefect,
            }
            for step, wall, cpu, server in parts(request, environment):
                beside = f"   server so far {server:5.2f} s" if prefect else ""
                print(f"    {step:<58} {cpu:5.2f} s CPU {wall:6.2f} s wall{beside}", flush=True)
    figure = statistics.median(one[1] for one in found[False])
    print(f"start to end without Prefect, CPU time: {figure:.2f} s")
    return figure


if __name__ == "__main__":
    main(sys.argv[1:])
