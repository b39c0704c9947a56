"""Runs for hours, as a service makes them: does memory grow, do files stay open?

One process runs a campaign again and again into one catalog, under one Prefect server of its own: now a recording
is new, now none is; every tenth new recording is begun by another process that is killed in the middle, and taken up
again. After each run the resident memory and the open files of the driver and of the server are noted. At the end all
products must be there and sound, and the growth per run of the later three quarters is told with its error.
It fails (exit code 1) where a growth is larger than the tolerance beyond its error, or files stay open.

    make soak                 two hours
    make soak SOAK=10m        as long as you like
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
from recordings import recording, seconds, settings_for

from coslidar.catalog import open_catalog
from coslidar.flows.run import run
from coslidar.flows.server import server

#: Growth per run that is none, kB: what a run leaves behind by design (a name, a log line of a bounded log).
TOLERANCE = 20.0
#: Share of the runs after which everything has been imported, compiled and filled.
WARM = 0.25
BATCHES = 4
KILL_EVERY = 10


@dataclass(frozen=True)
class Sample:
    """One process after one run."""

    memory: float  # kB
    files: int
    threads: int


def sample(process: psutil.Process) -> Sample:
    """Memory, open files and threads of a process now."""
    return Sample(process.memory_info().rss / 1e3, process.num_fds(), process.num_threads())


def slope(values: Sequence[float]) -> tuple[float, float]:
    """Growth per run and its standard error.

    Neighbouring runs are alike, so the error comes from means over twelfths of the series, not from single runs.
    """
    parts = np.array_split(np.asarray(values, float), min(12, max(4, len(values) // 4)))
    centre = np.cumsum([len(part) for part in parts]) - [len(part) / 2 for part in parts]
    (rise, _), covariance = np.polyfit(centre, [part.mean() for part in parts], 1, cov=True)
    return float(rise), float(np.sqrt(covariance[0, 0]))


def judge(name: str, samples: Sequence[Sample], tolerance: float = TOLERANCE) -> tuple[bool, str]:
    """Whether a process stays as it is, and a sentence with the numbers."""
    later = samples[int(WARM * len(samples)) :]
    rise, error = slope([one.memory for one in later])
    thirds = max(1, len(later) // 3)
    early, late = (max(one.files for one in part) for part in (later[:thirds], later[-thirds:]))
    steady = rise - 2 * error <= tolerance and late <= early + 2
    return steady, (
        f"{name}: {later[0].memory / 1e3:.1f} MB after warming up, {later[-1].memory / 1e3:.1f} MB at the end, "
        f"{rise:+.1f} +- {error:.1f} kB a run (tolerance {tolerance:g}); open files {early} early, {late} late; "
        f"threads {statistics.median(one.threads for one in later):g}"
    )


def killed(archive: Path, out: Path, dice: random.Random) -> None:
    """Begin a run in a process of its own, and kill it somewhere."""
    code = (
        "import sys; from pathlib import Path; sys.path.insert(0, sys.argv[1]); "
        "from recordings import settings_for; from coslidar.flows.run import run; print('go', flush=True); "
        "run(settings_for([Path(sys.argv[2])], Path(sys.argv[3])), prefect=False)"
    )
    here = str(Path(__file__).resolve().parent)
    with subprocess.Popen(
        [sys.executable, "-c", code, here, str(archive), str(out)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            process.wait(dice.uniform(0.2, 3.0))
        except subprocess.TimeoutExpired:
            process.kill()


def soak(folder: Path, duration: float, prefect: bool, pause: float, notes: Path | None) -> tuple[bool, str]:
    """Run until the time is over.

    Returns
    -------
    bool
        Whether everything stayed as it was.
    str
        What was seen.
    """
    dice, out, raw = random.Random(1), folder / "results", folder / "raw"
    drivers: list[Sample] = []
    servers: list[Sample] = []
    made = kills = 0
    newest: Path | None = None
    begin = time.monotonic()
    told = begin
    mine = psutil.Process()
    with server() as ready:
        if prefect:
            ready()
            (theirs,) = mine.children()
        while time.monotonic() - begin < duration or len(drivers) < 16:
            if newest is None or dice.random() < 0.7:
                if newest is not None:
                    newest.unlink()
                newest = recording(raw / f"r{made}.zarr.zip", BATCHES, name=f"r{made}", begin=60.0 * made)
                made += 1
                if made % KILL_EVERY == 0:
                    kills += 1
                    killed(newest, out, dice)
            (outcome,) = run(settings_for([newest], out), prefect=prefect)
            assert outcome.status in ("published", "present"), outcome
            with open_catalog(out) as catalog:
                assert len(catalog.query("quality=good,usable,bad")) == BATCHES * made
            drivers.append(sample(mine))
            if prefect:
                servers.append(sample(theirs))
            if notes is not None:
                line = {"t": time.monotonic() - begin, "driver": vars(drivers[-1])}
                line |= {"server": vars(servers[-1])} if prefect else {}
                with notes.open("a") as sink:
                    sink.write(json.dumps(line) + "\n")
            if time.monotonic() - told > 300:
                told = time.monotonic()
                print(f"{(told - begin) / 60:.0f} min, {len(drivers)} runs: {drivers[-1]}", flush=True)
            time.sleep(pause)
    spent = time.monotonic() - begin
    with open_catalog(out) as catalog:
        faults = catalog.verify()
        rows = catalog.products()
    sound = not faults and len(rows) == made
    left = len(list((out / "scratch").glob("??/*")))
    verdicts = [judge("driver", drivers)] + ([judge("Prefect server", servers)] if prefect else [])
    lines = [sentence for _, sentence in verdicts]
    lines.append(
        f"products: {len(rows)} of {made} recordings, {kills} of them begun by a process that was killed; "
        f"faults: {len(faults)}; files left in the scratch store: {left}"
    )
    flat = all(steady for steady, _ in verdicts) and sound and left == 0
    lines.append(f"{len(drivers)} runs in {spent / 60:.1f} min: {'flat' if flat else 'NOT FLAT'}")
    return flat, "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Run the soak and say what came of it; 0 where all stayed as it was."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--for", dest="duration", type=seconds, default="2h", help="90s, 10m, 2h")
    parser.add_argument("--pause", type=seconds, default="0s", help="time between two runs")
    parser.add_argument("--no-prefect", action="store_true")
    parser.add_argument("--notes", type=Path, help="file that gets a line of JSON after each run")
    given = parser.parse_args(argv)
    folder = Path(tempfile.mkdtemp(prefix="coslidar-soak-"))
    before = os.environ.get("COSLIDAR_HOME")
    os.environ["COSLIDAR_HOME"] = str(folder / "home")
    try:
        flat, words = soak(folder, given.duration, not given.no_prefect, given.pause, given.notes)
    finally:
        os.environ.pop("COSLIDAR_HOME")
        if before is not None:
            os.environ["COSLIDAR_HOME"] = before
        shutil.rmtree(folder, ignore_errors=True)
    print(words)
    return 0 if flat else 1


if __name__ == "__main__":
    sys.exit(main())
