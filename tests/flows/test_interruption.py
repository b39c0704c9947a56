"""Runs that are killed or interrupted, as processes of their own."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from small_runs import ARCHIVES, BATCHES, FRAMES, Finished, family, products, run_arguments, wait_for

from coslidar.catalog import open_catalog
from coslidar.catalog.heartbeats import life

BATCH_FRAMES = FRAMES // BATCHES
TOTAL = len(ARCHIVES) * BATCHES
Start = Callable[..., "subprocess.Popen[str]"]
Call = Callable[..., Finished]


def correlations(out: Path) -> int:
    """Batches whose frames have been read and whose correlations are kept."""
    return sum(1 for _ in (out / "correlations").glob("??/*.npz"))


def interrupted_at(process: subprocess.Popen[str], out: Path, batches: int) -> None:
    """Wait until so many batches are done."""
    assert wait_for(lambda: correlations(out) >= batches or process.poll() is not None, 120)
    assert process.poll() is None, process.communicate()


def finish(coslidar: Call, arguments: list[object], out: Path, undisturbed: dict[str, bytes], kept: int) -> None:
    """The same command again ends the work, reads only what was never read, and leaves the same bytes."""
    again = coslidar(*arguments)
    assert again.code == 0, again.err
    assert f"{(TOTAL - kept) * BATCH_FRAMES} frames read" in again.err
    assert products(out) == undisturbed
    with open_catalog(out) as catalog:
        assert catalog.verify() == []
        assert len(catalog.products()) == len(ARCHIVES)
        assert len(catalog.batches()) == TOTAL
    verified = coslidar("catalog", "verify", "--out", out)
    assert (verified.code, verified.out) == (0, "3 of 3 products are sound\n")


@pytest.mark.parametrize(
    "batches", [1, pytest.param(5, marks=pytest.mark.slow), pytest.param(9, marks=pytest.mark.slow)]
)
def test_kill_9(
    batches: int, started: Start, coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = run_arguments(recordings, out, "--set", "run.threads=1")
    process = started(*arguments)
    interrupted_at(process, out, batches)
    process.kill()
    assert process.wait(10) == -signal.SIGKILL
    published = products(out)
    kept = correlations(out)
    assert batches <= kept < TOTAL
    # What stands in the catalog is whole, whenever the kill came.
    assert published.items() <= undisturbed.items()
    told = coslidar("status", "--out", out)
    assert (told.code, ": lost\n" in told.out) == (0, True), told.out
    assert f"cd {tmp_path} && " in told.out.splitlines()[-1]  # how to continue it
    finish(coslidar, arguments, out, undisturbed, kept)
    with open_catalog(out) as catalog:
        assert [run.state for run in catalog.runs()] == ["interrupted", "finished"]
        assert [life(run) for run in catalog.runs()] == ["lost", "finished"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_without_prefect(
    number: signal.Signals,
    started: Start,
    coslidar: Call,
    recordings: list[str],
    undisturbed: dict[str, bytes],
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    arguments = run_arguments(recordings, out, "--set", "run.threads=1")
    process = started(*arguments)
    interrupted_at(process, out, 2)
    begin = time.monotonic()
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert time.monotonic() - begin < 20
    told = [line for line in err.splitlines() if "batches published" not in line]
    assert told == ["coslidar: interrupted; what was finished is kept, the same command goes on from there"], err
    kept = correlations(out)
    assert kept < TOTAL
    with open_catalog(out) as catalog:
        assert [run.state for run in catalog.runs()] == ["cancelled"]
    if number == signal.SIGINT:
        finish(coslidar, arguments, out, undisturbed, kept)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.cluster
@pytest.mark.slow
def test_interrupt_with_prefect(number: signal.Signals, started: Start, recordings: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = started(*run_arguments(recordings, out, "--set", "run.threads=1", prefect=True))
    interrupted_at(process, out, 2)
    children = family(process.pid)
    assert any("coslidar.flows.server" in " ".join(child.cmdline()) for child in children)
    begin = time.monotonic()
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert time.monotonic() - begin < 20
    told = [line for line in err.splitlines() if "batches published" not in line]
    assert told == ["coslidar: interrupted; what was finished is kept, the same command goes on from there"], err
    assert not any(child.is_running() for child in children)
    with open_catalog(out) as catalog:
        assert [run.state for run in catalog.runs()] == ["cancelled"]


@pytest.mark.cluster
def test_kill_9_with_prefect_leaves_no_server(
    started: Start, coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    process = started(*run_arguments(recordings, out, "--set", "run.threads=1", prefect=True))
    interrupted_at(process, out, 2)
    children = family(process.pid)
    assert children
    process.kill()
    process.wait(10)
    _, alive = psutil.wait_procs(children, timeout=15)
    assert alive == []
    finish(coslidar, run_arguments(recordings, out), out, undisturbed, correlations(out))


def test_interrupt_before_anything_began(started: Start, recordings: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = started(*run_arguments(recordings, out))
    assert wait_for(lambda: (out / "catalog.sqlite").exists() or process.poll() is not None, 60)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert err.count("\n") <= 1 + err.count("published")


def test_an_interrupt_that_a_library_swallows_ends_the_run_all_the_same(tmp_path: Path) -> None:
    code = """
import os, signal, sys
from coslidar.flows import cli
from coslidar.flows.commands import process

def swallowing(*arguments):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        signal.pause()
    except KeyboardInterrupt:
        return 0

process._run_one = swallowing
sys.argv = ["coslidar", "run", "some.zarr", "--no-prefect"]
cli.main()
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 130
    assert "interrupted" in done.stderr
