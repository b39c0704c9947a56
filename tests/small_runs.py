"""Small recordings, and helpers to run the program on them in processes of its own."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import psutil

#: Batches of the recordings: 4 of 1.5 s, 213 frames each, which chunks of 256 frames cut across.
BATCH = "1.5 s"
BATCHES = 4
FRAMES = 852
ARCHIVES = ("r0", "r1", "r2")
#: Settings of nearly every run here: few slices, because the response matrix is not what is tested.
SETTINGS = (f"batch.duration={BATCH}", "response.slices=6")


def scenario() -> str:
    """The demo's instrument cut down to 3 x 3 lenslets, with three recordings of 6 s."""
    text = (files("coslidar.flows.scenarios") / "demo.toml").read_text("utf-8").partition("[[archives]]")[0]
    mask = next(line for line in text.splitlines() if line.startswith("subaperture_mask"))
    text = text.replace(mask, "subaperture_mask = [[1,1,1], [1,1,1], [1,1,1]]").replace("seed = 8", "seed = 11")
    for number, name in enumerate(ARCHIVES):
        text += f'[[archives]]\narchive = "{name}"\nstart = 2012-09-14T15:{15 + number}:00Z\nduration = "6 s"\n\n'
    return text


def unpacked(archive: str | Path, folder: Path) -> Path:
    """The archive as a folder, whose chunks can be damaged."""
    target = folder / Path(archive).name.removesuffix(".zip")
    shutil.unpack_archive(archive, target, "zip")
    return target


def chunk(archive: Path, number: int) -> Path:
    """File of a chunk of frames."""
    return archive / "frames" / "c" / str(number) / "0" / "0"


@dataclass
class Finished:
    """What a program left behind."""

    code: int
    out: str
    err: str
    seconds: float


def environment(cache: Path, **more: str) -> dict[str, str]:
    """Environment of the program: no git, so that the keys are those of a clean checkout."""
    mine = {key: value for key, value in os.environ.items() if not key.startswith(("PREFECT_", "COSLIDAR_", "DASK_"))}
    return {**mine, "COSLIDAR_HOME": str(cache), "GIT_DIR": "/nonexistent", **more}


def command(*arguments: object) -> list[str]:
    """Command line of the program, as the entry point runs it."""
    return [sys.executable, "-c", "from coslidar.flows.cli import main; main()", *map(str, arguments)]


def run_arguments(recordings: list[str], out: Path, *more: object, prefect: bool = False) -> list[object]:
    """Arguments of ``coslidar run`` with the settings of these tests."""
    sets = [part for assignment in SETTINGS for part in ("--set", assignment)]
    return ["run", *recordings, "--out", out, *sets, *([] if prefect else ["--no-prefect"]), *more]


def family(pid: int) -> list[psutil.Process]:
    """Descendants of a process that are alive."""
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def wait_for(condition: Callable[[], bool], seconds: float = 60, step: float = 0.005) -> bool:
    """Wait until something holds; False if it never does."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(step)
    return False


def products(out: Path) -> dict[str, bytes]:
    """Bytes of every product by name."""
    return {path.name: path.read_bytes() for path in sorted((out / "products").glob("*/*.zarr.zip"))}
