"""Fixtures: small recordings, and the program run on them."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from small_clusters import Cluster
from small_runs import ARCHIVES, SETTINGS, Finished, command, environment, family, products, scenario

from coslidar.flows.run import run
from coslidar.flows.settings import load
from coslidar.flows.simulate import simulate
from coslidar.pipeline.lineage import checkout


@pytest.fixture(scope="module", autouse=True)
def _fixed_code() -> Iterator[None]:
    """Keys do not depend on what is being edited in this checkout meanwhile; see :func:`environment`."""
    before = os.environ.get("GIT_DIR")
    os.environ["GIT_DIR"] = "/nonexistent"
    checkout.cache_clear()
    assert str(checkout()) == ""
    if before is None:
        del os.environ["GIT_DIR"]
    else:
        os.environ["GIT_DIR"] = before
    yield
    checkout.cache_clear()


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Cache of the user for these tests: Prefect's database, response matrices."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def _cache(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COSLIDAR_HOME", str(cache))
    monkeypatch.delenv("PREFECT_API_URL", raising=False)


@pytest.fixture(scope="session")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the three recordings, each one zip; not to be changed."""
    folder = tmp_path_factory.mktemp("raw")
    (folder / "scenario.toml").write_text(scenario())
    simulate(folder / "scenario.toml", folder)
    return folder


@pytest.fixture(scope="session")
def recordings(raw: Path) -> list[str]:
    """Paths of the three recordings."""
    return [str(raw / f"{name}.zarr.zip") for name in ARCHIVES]


@pytest.fixture
def coslidar(cache: Path, tmp_path: Path) -> Callable[..., Finished]:
    """Run the program to its end."""

    def call(*arguments: object, timeout: float = 240, **more: str) -> Finished:
        begin = time.monotonic()
        done = subprocess.run(
            command(*arguments),
            capture_output=True,
            text=True,
            timeout=timeout,
            cwd=tmp_path,
            env=environment(cache, **more),
        )
        return Finished(done.returncode, done.stdout, done.stderr, time.monotonic() - begin)

    return call


@pytest.fixture
def started(cache: Path, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start the program, to be interfered with; nothing of it outlives the test."""
    processes: list[subprocess.Popen[str]] = []

    def call(*arguments: object, **more: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            command(*arguments),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            env=environment(cache, **more),
            # A group of its own, as a shell makes one: signals go where a terminal would send them.
            process_group=0,
        )
        processes.append(process)
        return process

    yield call
    for process in processes:
        for one in family(process.pid):
            one.kill()
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
        process.communicate()


@pytest.fixture
def main_here(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., Finished]:
    """Run the program in this process: quicker, and what it needs can be patched."""
    from coslidar.flows.cli import main

    def call(*arguments: object) -> Finished:
        monkeypatch.setattr("sys.argv", ["coslidar", *map(str, arguments)])
        monkeypatch.chdir(tmp_path)
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        begin = time.monotonic()
        capsys.readouterr()
        try:
            with pytest.raises(SystemExit) as leave:
                main()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        said = capsys.readouterr()
        return Finished(int(leave.value.code or 0), said.out, said.err, time.monotonic() - begin)

    return call


@pytest.fixture
def dask(tmp_path: Path, cache: Path) -> Iterator[Cluster]:
    """A scheduler without workers."""
    folder = tmp_path / "dask"
    folder.mkdir()
    made = Cluster(folder, cache)
    yield made
    made.close()


@pytest.fixture(scope="module")
def undisturbed(recordings: list[str], tmp_path_factory: pytest.TempPathFactory, cache: Path) -> dict[str, bytes]:
    """Products of a run on this machine that nobody disturbs."""
    out = tmp_path_factory.mktemp("undisturbed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSLIDAR_HOME", str(cache))
        run(load(archives=recordings, output=out, assignments=SETTINGS), prefect=False)
    return products(out)
