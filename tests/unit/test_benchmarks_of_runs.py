"""Benchmarks of whole runs, on sizes at which their figures mean nothing; and what the soak calls growth."""

from __future__ import annotations

import math
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
#: Script -> small sizes, and a part of the last line. Each starts processes that import everything.
RUNS = {
    "bench_scaling": (["--counts", "4", "8", "12"], "slope of log CPU time"),
    "bench_prefect": (
        ["--archives", "1", "--batches", "2", "--frames", "70", "--repeat", "1"],
        "Prefect and Dask /",
    ),
    "bench_workers": (["--batches", "2", "--frames", "70", "--repeat", "1"], "gain of two threads"),
    "bench_memory": (["--frames", "568", "--base", "284", "--batch", "2 s"], "largest peak of resident memory"),
    "bench_startup": (["--tiny", "--no-prefect", "--repeat", "1"], "start to end without Prefect"),
}


@pytest.fixture(autouse=True)
def beside(monkeypatch: pytest.MonkeyPatch) -> None:
    """Benchmarks import each other as scripts of one folder do."""
    monkeypatch.syspath_prepend(str(FOLDER))


@pytest.mark.slow
@pytest.mark.cluster
@pytest.mark.parametrize("name", RUNS)
def test_runs_on_small_sizes(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = import_module(name)
    if hasattr(bench, "FOLDER"):
        monkeypatch.setattr(bench, "FOLDER", tmp_path)
    monkeypatch.setenv("COSLIDAR_HOME", str(tmp_path / "home"))
    arguments, said = RUNS[name]
    figure = bench.main(arguments)
    assert said in capsys.readouterr().out.splitlines()[-1]
    assert math.isfinite(figure)


@pytest.mark.slow
def test_a_few_runs_of_the_soak(capsys: pytest.CaptureFixture[str]) -> None:
    import_module("soak").main(["--for", "1s", "--no-prefect"])  # so few only warm up: no verdict is asked for
    said = capsys.readouterr().out
    assert "faults: 0; files left in the scratch store: 0" in said
    assert "16 runs" in said


def _samples(memory: Any, files: int = 20) -> list[Any]:
    sample = import_module("soak").Sample
    return [sample(float(value), files, 9) for value in memory]


def test_the_soak_tells_growth_from_noise() -> None:
    soak = import_module("soak")
    dice = np.random.default_rng(1)
    noise = 5e5 + 300 * dice.standard_normal(400)
    assert soak.judge("flat", _samples(noise))[0]
    # 100 kB a run grow; 60 kB more and back again within ten runs do not.
    assert not soak.judge("grows", _samples(noise + 100 * np.arange(400)))[0]
    assert soak.judge("breathes", _samples(noise + 60 * (np.arange(400) % 10)))[0]
    # What is filled in the first quarter is no growth either.
    assert soak.judge("warms up", _samples(noise + 1e5 * np.minimum(np.arange(400) / 90, 1)))[0]
    leaking = _samples(noise[:200]) + _samples(noise[200:], files=40)
    steady, words = soak.judge("files", leaking)
    assert not steady
    assert "open files 20 early, 40 late" in words
