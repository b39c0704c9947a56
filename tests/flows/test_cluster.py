"""Dask clusters of somebody else: by address, by scheduler file, with faults."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from small_clusters import Cluster
from small_runs import ARCHIVES, BATCHES, SETTINGS, Finished, products, run_arguments, wait_for

from coslidar.catalog import open_catalog
from coslidar.flows import cluster, tasks
from coslidar.flows.run import run
from coslidar.flows.settings import RunParameters, Unavailable, load

TOTAL = len(ARCHIVES) * BATCHES
Call = Callable[..., Finished]


@pytest.mark.cluster
def test_by_address_and_by_file(
    dask: Cluster, coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    dask.worker("--no-nanny")
    dask.worker("--no-nanny")
    for number, scheduler in enumerate((dask.address, dask.file)):
        out = tmp_path / str(number)
        done = coslidar(*run_arguments(recordings, out, "--scheduler", scheduler))
        assert done.code == 0, done.err
        assert products(out) == undisturbed
        assert "3 of 3 archives" in done.out
        assert len(done.err.splitlines()) == 4, done.err
    # The cluster is not ours to stop.
    assert all(process.poll() is None for process in dask.processes)


@pytest.mark.cluster
def test_a_worker_that_dies_costs_nothing_but_its_batch(
    dask: Cluster,
    started: Callable[..., subprocess.Popen[str]],
    recordings: list[str],
    undisturbed: dict[str, bytes],
    tmp_path: Path,
) -> None:
    first, second = dask.worker("--no-nanny"), dask.worker("--no-nanny")
    out = tmp_path / "out"
    process = started(*run_arguments(recordings, out, "--scheduler", dask.address))
    assert wait_for(lambda: any((out / "correlations").glob("??/*.npz")) or process.poll() is not None, 120)
    assert process.poll() is None, process.communicate()
    first.kill()
    _, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert second.poll() is None
    assert products(out) == undisturbed
    assert f"{TOTAL} batches computed" in err


@pytest.mark.cluster
@pytest.mark.slow
def test_a_scheduler_that_dies_is_named_and_the_run_goes_on_elsewhere(
    dask: Cluster,
    started: Callable[..., subprocess.Popen[str]],
    coslidar: Call,
    recordings: list[str],
    undisturbed: dict[str, bytes],
    tmp_path: Path,
) -> None:
    dask.worker("--no-nanny")
    out = tmp_path / "out"
    process = started(*run_arguments(recordings, out, "--scheduler", dask.address))
    assert wait_for(lambda: any((out / "correlations").glob("??/*.npz")) or process.poll() is not None, 120)
    assert process.poll() is None, process.communicate()
    dask.scheduler.kill()
    begin = time.monotonic()
    _, err = process.communicate(timeout=180)
    assert process.returncode == 1, err
    assert time.monotonic() - begin < 90
    assert "Traceback" not in err
    told = [line for line in err.splitlines() if "batches published" not in line]
    assert told == [
        f"coslidar: the Dask scheduler at {dask.address} was lost; what was finished is kept, the same command goes on "
        "from there"
    ], err
    with open_catalog(out) as catalog:
        assert [made.state for made in catalog.runs()] == ["failed"]
    again = coslidar(*run_arguments(recordings, out))
    assert again.code == 0, again.err
    assert products(out) == undisturbed


@pytest.mark.cluster
def test_a_worker_that_cannot_see_the_archive_is_no_fault_of_the_data(
    dask: Cluster, recordings: list[str], tmp_path: Path
) -> None:
    # As on a cluster without a common file system: the path exists here only.
    dask.worker("--no-nanny", "--preload", str(_blind(tmp_path)))
    settings = load(archives=recordings[:1], output=tmp_path / "out", assignments=SETTINGS, scheduler=dask.address)
    (outcome,) = run(settings, prefect=False)
    assert (outcome.status, outcome.input_fault) == ("failed", False)
    assert all(
        "archive cannot be opened there" in fault and "there is no such file" in fault for fault in outcome.faults
    )
    (here,) = run(load(archives=recordings[:1], output=tmp_path / "out", assignments=SETTINGS), prefect=False)
    assert (here.status, here.faults) == ("published", ())


def _blind(folder: Path) -> Path:
    path = folder / "blind.py"
    path.write_text(
        "from coslidar.flows import tasks\n"
        "from coslidar.catalog.archive import open_archive\n"
        "tasks.open_archive = lambda url, **options: open_archive(url + '.elsewhere', **options)\n"
    )
    return path


def test_no_scheduler(main_here: Callable[..., Finished], recordings: list[str], tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
        (tmp_path / "scheduler.json").write_text(f'{{"address": "{address}"}}')
        for scheduler in (address, tmp_path / "scheduler.json"):
            done = main_here(*run_arguments(recordings, tmp_path / "out", "--scheduler", scheduler))
            assert done.code == 1
            (line,) = done.err.splitlines()
            assert f"no Dask scheduler answers at {address}" in line
            assert "Connection refused" in line
            assert "start one with 'dask scheduler'" in line
            assert done.seconds < 10


@pytest.mark.parametrize(
    "scheduler",
    ["nonsense", "tcp://", "there/is/no/file.json", "tcp://127.0.0.1:notaport", "127.0.0.1:8786", "bad.json"],
)
def test_what_is_no_address(
    scheduler: str, main_here: Callable[..., Finished], recordings: list[str], tmp_path: Path
) -> None:
    (tmp_path / "bad.json").write_text('{"id": 3}')
    done = main_here(*run_arguments(recordings, tmp_path / "out", "--scheduler", scheduler))
    assert done.code == 2
    (line,) = done.err.splitlines()
    assert f"run.scheduler = '{scheduler}': this is n" in line
    assert "scheduler file" in line


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:8786", "tls://[::1]:8786", "ucx://node-3.cluster:8786"])
def test_what_is_an_address(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, int]] = []

    def connection(where: tuple[str, int], timeout: float) -> SimpleNamespace:
        asked.append(where)
        return SimpleNamespace(close=lambda: None)

    monkeypatch.setattr(cluster.socket, "create_connection", connection)
    assert cluster.scheduler_address(address) == address
    assert asked in ([], [("127.0.0.1", 8786)], [("::1", 8786)])


class FakeClient:
    """A client whose workers have other versions, or are not there."""

    def __init__(self, changes: dict[str, dict[str, str]], *, present: bool = True) -> None:
        self.changes, self.present = changes, present
        self.scheduler = SimpleNamespace(address="tcp://10.0.0.1:8786")
        self.cluster = None

    def wait_for_workers(self, count: int, timeout: float) -> None:
        if not self.present:
            raise TimeoutError

    def run(self, function: Callable[[], dict[str, str]]) -> dict[str, Any]:
        if "broken" in self.changes:
            raise ModuleNotFoundError("No module named 'coslidar'")
        return {worker: {**function(), **change} for worker, change in self.changes.items()}


def test_versions_are_compared_and_both_named() -> None:
    mine = tasks.versions()
    cluster.check_workers(FakeClient({"tcp://a:1": {}, "tcp://b:1": {}}), "tcp://x")  # type: ignore[arg-type]
    with pytest.raises(Unavailable) as error:
        cluster.check_workers(
            FakeClient({"tcp://a:1": {}, "tcp://b:1": {"numpy": "1.26.0", "python": "3.14.1"}}),  # type: ignore[arg-type]
            "tcp://x",
        )
    text = str(error.value)
    assert f"numpy is 1.26.0 on worker tcp://b:1 and {mine['numpy']} here" in text
    assert f"python is 3.14.1 on worker tcp://b:1 and {mine['python']} here" in text
    assert "tcp://a:1" not in text
    assert "same environment" in text
    # Another checkout of the same release computes other numbers; a plugin that is not there computes none.
    stages, plugin = "stages of coslidar", "coslidar-example-plugin"
    older = {**mine, stages: "0.0.0.0"}
    del older[plugin]
    assert tasks.differences(older, mine, "w") == [
        f"{plugin} is not installed on worker w and {mine[plugin]} here",
        f"{stages} is 0.0.0.0 on worker w and {mine[stages]} here",
    ]


def test_a_cluster_without_workers_or_without_coslidar_is_refused() -> None:
    with pytest.raises(Unavailable, match=r"has no worker; start some with 'dask worker tcp://10\.0\.0\.1:8786'"):
        cluster.check_workers(FakeClient({}, present=False), "x")  # type: ignore[arg-type]
    with pytest.raises(Unavailable, match=r"cannot run coslidar .*No module named 'coslidar'"):
        cluster.check_workers(FakeClient({"broken": {}}), "x")  # type: ignore[arg-type]


def test_a_local_cluster_listens_nowhere_else() -> None:
    with cluster.connect(RunParameters(threads=1)) as client:
        assert client.scheduler.address.startswith("inproc://")
        heard = {c.laddr.ip for c in psutil.Process().net_connections("inet") if c.status == psutil.CONN_LISTEN}
        assert heard <= {"127.0.0.1"}


def test_what_goes_wrong_on_a_worker_does_not_travel(
    recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Unpicklable(Exception):
        def __reduce__(self) -> Any:
            raise TypeError("not me")

    def fail(*_: Any, **__: Any) -> None:
        raise Unpicklable("boom")

    settings = load(archives=recordings[:1], output=tmp_path, assignments=SETTINGS)
    with monkeypatch.context() as patch:
        patch.setattr(tasks.stages, "retrieve", fail)
        (outcome,) = run(settings, prefect=False)
    assert (outcome.status, outcome.input_fault) == ("failed", False)
    assert all("Unpicklable: boom" in fault for fault in outcome.faults)
    # What was computed before it is kept, the failure is not.
    (again,) = run(settings, prefect=False)
    assert (again.status, again.frames_read, again.faults) == ("published", 0, ())
