"""A cluster of several hosts under faults: what was finished stays, the products are those of an undisturbed run."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hosts import Hosts
from small_runs import ARCHIVES, BATCHES, FRAMES, Finished, products, run_arguments, wait_for

from coslidar.catalog import open_catalog

Call = Callable[..., Finished]
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def hosts(tmp_path: Path, cache: Path) -> Iterator[Hosts]:
    """A scheduler and three workers, each on a host of its own."""
    folder = tmp_path / "hosts"
    folder.mkdir()
    made = Hosts(folder, cache, workers=3)
    yield made
    made.close()


def begun(out: Path, process: subprocess.Popen[str]) -> None:
    """Wait until the first batch is there."""
    assert wait_for(lambda: any((out / "correlations").glob("??/*.npz")) or process.poll() is not None, 400)
    assert process.poll() is None, process.communicate()


def kept(out: Path) -> int:
    """Batches whose correlations are kept."""
    return len(list((out / "correlations").glob("??/*.npz")))


def nothing_twice(hosts: Hosts, before: int) -> None:
    """Every batch was computed, what was finished only once, and what was lost once more."""
    counts = hosts.measured()
    assert set(counts) == {f"demo/{name} {number}" for name in ARCHIVES for number in range(BATCHES)}
    assert max(counts.values()) <= 2, counts
    assert sum(counts.values()) <= 2 * len(counts) - before, counts


@pytest.mark.cluster
@pytest.mark.parametrize("seconds", [4, pytest.param(30, marks=pytest.mark.slow)])
def test_a_host_dies_and_another_is_cut_off(
    hosts: Hosts, started: Start, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path, seconds: float
) -> None:
    out = tmp_path / "out"
    process = started(*run_arguments(recordings, out, "--scheduler", hosts.address))
    begun(out, process)
    before = kept(out)
    hosts.kill("worker0")
    hosts.plug("worker1", connected=False)
    time.sleep(seconds)
    hosts.plug("worker1", connected=True)
    _, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert products(out) == undisturbed
    nothing_twice(hosts, before)
    with open_catalog(out) as catalog:
        assert catalog.verify() == []
        assert len(catalog.products()) == len(ARCHIVES)


@pytest.mark.cluster
@pytest.mark.slow
def test_the_scheduler_is_started_again(
    hosts: Hosts, started: Start, coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = run_arguments(recordings, out, "--scheduler", hosts.address)
    process = started(*arguments)
    begun(out, process)
    hosts.kill("scheduler")
    _, err = process.communicate(timeout=240)
    assert process.returncode == 1, err
    assert f"the Dask scheduler at {hosts.address} was lost" in err
    before = kept(out)
    for name in hosts.names:
        hosts.kill(name)
        hosts.start(name)
    again = coslidar(*arguments)
    assert again.code == 0, again.err
    assert products(out) == undisturbed
    nothing_twice(hosts, before)
    # Those that were under way when the scheduler went are read again, what had come back is not.
    assert f"{(len(ARCHIVES) * BATCHES - before) * FRAMES // BATCHES} frames read" in again.err, again.err


@pytest.mark.cluster
@pytest.mark.slow
def test_the_driver_is_killed_and_the_run_goes_on(
    hosts: Hosts, started: Start, coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = run_arguments(recordings, out, "--scheduler", hosts.address)
    process = started(*arguments)
    begun(out, process)
    process.kill()
    process.communicate()
    before = kept(out)
    again = coslidar(*arguments)
    assert again.code == 0, again.err
    assert products(out) == undisturbed
    nothing_twice(hosts, before)
    assert f"{(len(ARCHIVES) * BATCHES - before) * FRAMES // BATCHES} frames read" in again.err, again.err
    with open_catalog(out) as catalog:
        assert catalog.verify() == []


@pytest.mark.cluster
def test_a_full_disk_loses_nothing(
    coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("a small disk needs root, to mount one")
    out = tmp_path / "disk"
    out.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=700k", "tmpfs", str(out)], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no tmpfs can be mounted here: {mounted.stderr.strip()}")
    try:
        arguments = run_arguments(recordings, out)
        full = coslidar(*arguments)
        assert full.code == 1, full.err
        assert "No space left" in full.err or "disk is full" in full.err, full.err
        assert "Traceback" not in full.err
        before = kept(out)
        subprocess.run(["mount", "-o", "remount,size=64m", str(out)], check=True)
        again = coslidar(*arguments)
        assert again.code == 0, again.err
        assert f"{(len(ARCHIVES) * BATCHES - before) * FRAMES // BATCHES} frames read" in again.err, again.err
        assert products(out) == undisturbed
        with open_catalog(out) as catalog:
            assert catalog.verify() == []
    finally:
        subprocess.run(["umount", "-l", str(out)], check=True)
