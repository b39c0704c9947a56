"""The Prefect server: ours, or that of PREFECT_API_URL."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import psutil
import pytest
from prefect_servers import prefect_server
from small_runs import Finished, environment, products, run_arguments, wait_for

from coslidar.flows import server
from coslidar.flows.settings import Unavailable

Call = Callable[..., Finished]


@pytest.fixture
def no_prefect_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the module sets for the process is put back."""
    for name in (*server.quiet_environment(), "PREFECT_API_URL", "PREFECT_HOME", "NO_PROXY", "no_proxy"):
        monkeypatch.delenv(name, raising=False)


def test_a_server_that_does_not_answer_is_named(
    main_here: Call, recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_prefect_settings: None
) -> None:
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:1/api")
    done = main_here(*run_arguments(recordings, tmp_path / "out", prefect=True))
    assert done.code == 1
    (line,) = done.err.splitlines()
    assert "no Prefect server answers at PREFECT_API_URL = http://127.0.0.1:1/api" in line
    assert "--no-prefect" in line


def test_a_home_that_cannot_be_written_is_named(
    main_here: Call, recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_prefect_settings: None
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("COSLIDAR_HOME", str(tmp_path / "file"))
    done = main_here(*run_arguments(recordings, tmp_path / "out", prefect=True))
    assert done.code == 1
    (line,) = done.err.splitlines()
    assert "COSLIDAR_HOME" in line
    assert "--no-prefect" in line
    # Without Prefect nothing needs it: response matrices are kept nowhere then.
    assert main_here(*run_arguments(recordings[:1], tmp_path / "out")).code == 0


def test_a_server_that_cannot_start_is_named_with_its_log(
    cache: Path, monkeypatch: pytest.MonkeyPatch, no_prefect_settings: None
) -> None:
    monkeypatch.setattr(server.sys, "executable", "/bin/false")
    with server.server() as ready, pytest.raises(Unavailable, match=r"did not start \(its log: .*server\.log\)"):
        ready()
    assert "PREFECT_API_URL" not in os.environ


def test_runs_side_by_side_do_not_share_a_database(cache: Path) -> None:
    first, lock = server.home()
    second, other = server.home()
    assert first != second
    other.close()
    lock.close()
    again, lock = server.home()
    assert again == first
    lock.close()


def test_a_server_ends_with_its_run(tmp_path: Path, cache: Path) -> None:
    """Even when it is killed before it listens."""
    script = (
        "import os, signal\n"
        "from coslidar.flows.server import server\n"
        "context = server()\n"
        "context.__enter__()\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", script], env=environment(cache, COSLIDAR_HOME=str(tmp_path)), timeout=60)

    def left() -> list[psutil.Process]:
        found = []
        for process in psutil.process_iter():
            try:
                if process.environ().get("PREFECT_HOME", "").startswith(str(tmp_path)):
                    found.append(process)
            except psutil.Error:
                continue
        return found

    assert wait_for(lambda: not left(), 30, step=0.2), left()


@pytest.mark.cluster
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_somebody_elses_server(kind: str, coslidar: Call, recordings: list[str], tmp_path: Path, cache: Path) -> None:
    """Two runs at once on the server of PREFECT_API_URL, which sees both and is not stopped."""
    with prefect_server(kind, tmp_path, cache) as theirs:
        with ThreadPoolExecutor(2) as pool:
            both = [
                pool.submit(
                    coslidar,
                    *run_arguments(recordings, tmp_path / f"out{number}", prefect=True),
                    PREFECT_API_URL=theirs.url,
                )
                for number in range(2)
            ]
            for done in (future.result() for future in both):
                assert done.code == 0, done.err
                assert len(done.err.splitlines()) == 4, done.err
        assert products(tmp_path / "out0") == products(tmp_path / "out1")
        assert len(products(tmp_path / "out0")) == 3
        assert theirs.process.poll() is None
        assert (theirs.count("flow_runs", "COMPLETED"), theirs.count("task_runs", "COMPLETED")) == (2, 6)


@pytest.mark.cluster
@pytest.mark.slow
def test_a_limit_on_the_server_holds_for_all_runs_together(
    coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path, cache: Path
) -> None:
    with prefect_server("sqlite", tmp_path, cache) as theirs:
        theirs.prefect(cache, "concurrency-limit", "create", "coslidar-archive", "1")
        with ThreadPoolExecutor(2) as pool:
            runs = [
                pool.submit(
                    coslidar,
                    *run_arguments(recordings, tmp_path / f"out{number}", prefect=True),
                    PREFECT_API_URL=theirs.url,
                )
                for number in range(2)
            ]
            for done in (future.result() for future in runs):
                assert done.code == 0, done.err
        spans = sorted((one["start_time"], one["end_time"]) for one in theirs.all("task_runs"))
        assert len(spans) == 6
        # Although each run may have two archives in flight, there is one at a time in all.
        assert all(before[1] <= after[0] for before, after in pairwise(spans)), spans
    assert products(tmp_path / "out0") == products(tmp_path / "out1") == undisturbed


@pytest.mark.cluster
@pytest.mark.slow
def test_our_server_is_reached_past_a_proxy(coslidar: Call, recordings: list[str], tmp_path: Path) -> None:
    proxies = dict.fromkeys(("HTTP_PROXY", "http_proxy", "ALL_PROXY", "https_proxy"), "http://127.0.0.1:9")
    done = coslidar(*run_arguments(recordings[:1], tmp_path / "out", prefect=True), **proxies)
    assert done.code == 0, done.err
    assert len(done.err.splitlines()) == 2, done.err
