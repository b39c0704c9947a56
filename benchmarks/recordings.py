"""Recordings and settings that the benchmarks of whole runs share: a small instrument, and batches that cost little."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np
from archives import small_frames, small_header, small_time

from coslidar.catalog.archive_writer import write_archive
from coslidar.flows.settings import Settings, load

#: Frames of a batch, 0.7 s at 100 Hz: a few more than a correlation needs.
FRAMES = 70
#: Batches after which the frames repeat, so that what they must give is known.
PERIOD = 40


@lru_cache(maxsize=4)
def _pictures(seed: int) -> tuple[dict[str, Any], np.ndarray[Any, Any]]:
    header = small_header(instrument__subaperture_mask=[[1, 1, 1]] * 3)
    return header, small_frames(header, PERIOD * FRAMES, seed=seed)


def recording(path: Path, batches: int, *, name: str = "r0", begin: float = 0.0, seed: int = 0) -> Path:
    """Write a recording of 3 x 3 lenslets on 48 x 30 pixels with so many batches of 0.7 s; those repeat.

    Parameters
    ----------
    path : path
        Where to, if it is not there yet.
    batches : int
        Number of batches.
    name : str
        Name of the recording.
    begin : float
        How much later than others it begins, s.
    seed : int
        Of its frames.
    """
    if path.exists():
        return path
    header, pictures = _pictures(seed)
    header = {**header, "archive": name}

    def blocks() -> Iterator[np.ndarray[Any, Any]]:
        for first in range(0, batches, PERIOD):
            yield pictures[: FRAMES * min(PERIOD, batches - first)]

    times = small_time(batches * FRAMES) + round(begin * 1e9)
    dark = np.full(pictures.shape[1:], 100, "f4")
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name("part-" + path.name)
    write_archive(part, header, times, blocks(), dark=dark, chunk_frames=2 * FRAMES)
    part.rename(path)
    return path


def settings_for(archives: list[Path], out: Path, *assignments: str) -> Settings:
    """Settings of a run over such recordings."""
    short = ("batch.duration=0.7 s", "response.slices=6")
    return load(archives=[str(path) for path in archives], output=out, assignments=[*short, *assignments])


def seconds(text: str) -> float:
    """Duration on a command line: ``90s``, ``10m``, ``2h``."""
    return float(text[:-1]) * {"s": 1.0, "m": 60.0, "h": 3600.0}[text[-1]]
