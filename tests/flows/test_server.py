"""The Prefect server: ours, or that of PREFECT_API_URL."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
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
Start = Callable[..., "subprocess.Popen[str]"]


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
    coslidar: Call, started: Start, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path, cache: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(
        "import time\nfrom coslidar.pipeline import batch\nhonest = batch.retrieve\n"
        "batch.retrieve = lambda *a: (time.sleep(10), honest(*a))[1]\n"
    )
    with prefect_server("sqlite", tmp_path, cache) as theirs:
        theirs.prefect(cache, "gcl", "create", "coslidar-archive", "--limit", "1")
        first = tmp_path / "out0"
        running = started(
            *run_arguments(recordings, first, "--log-json", prefect=True),
            PREFECT_API_URL=theirs.url,
            PYTHONPATH=str(tmp_path),
        )
        assert wait_for(lambda: any((first / "correlations").glob("??/*.npz")) or running.poll() is not None, 120)
        waiting = started(*run_arguments(recordings, tmp_path / "out1", prefect=True), PREFECT_API_URL=theirs.url)
        # Two archives of each are on their way: one at work, three that wait for their turn.
        assert wait_for(lambda: len(theirs.all("task_runs")) >= 4 or waiting.poll() is not None, 120, 0.2)
        time.sleep(6)
        waiting.send_signal(signal.SIGINT)
        _, err = waiting.communicate(timeout=60)
        assert waiting.returncode == 130, err
        told = [line for line in err.splitlines() if "batches published" not in line]
        assert told == ["coslidar: interrupted; what was finished is kept, the same command goes on from there"], err
        done = coslidar(
            *run_arguments(recordings, tmp_path / "out1", "--log-json", prefect=True), PREFECT_API_URL=theirs.url
        )
        assert done.code == 0, done.err
        _, err = running.communicate(timeout=240)
        assert running.returncode == 0, err
    spans = sorted(_spans(done.err) + _spans(err))
    assert len(spans) == 2 * len(recordings)
    # Although each run may have two archives in flight, there is one at a time in all.
    assert all(before[1] <= after[0] for before, after in pairwise(spans)), spans
    assert products(first) == products(tmp_path / "out1") == undisturbed


def _spans(log: str) -> list[tuple[str, str]]:
    """When each archive of a run began and ended, of its records."""
    times: dict[str, list[str]] = {}
    for record in map(json.loads, log.splitlines()):
        if record["archive"] is not None and record["archive"].startswith("demo/"):
            times.setdefault(record["archive"], []).append(record["time"])
    return [(min(one), max(one)) for one in times.values()]


@pytest.mark.cluster
@pytest.mark.slow
def test_our_server_is_reached_past_a_proxy(coslidar: Call, recordings: list[str], tmp_path: Path) -> None:
    proxies = dict.fromkeys(("HTTP_PROXY", "http_proxy", "ALL_PROXY", "https_proxy"), "http://127.0.0.1:9")
    done = coslidar(*run_arguments(recordings[:1], tmp_path / "out", prefect=True), **proxies)
    assert done.code == 0, done.err
    assert len(done.err.splitlines()) == 2, done.err
