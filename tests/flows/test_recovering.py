"""What failed is told apart, told of, and done again: data, machine, network, versions."""

from __future__ import annotations

import json
import re
import socket
import sqlite3
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import catalogs
import fsspec
import pytest
import sqlalchemy as sa
from fsspec.implementations.memory import MemoryFileSystem
from small_runs import BATCHES, FRAMES, SETTINGS, Finished, chunk, products, run_arguments, unpacked

from coslidar.catalog import heartbeats, open_catalog
from coslidar.catalog.database import passing
from coslidar.catalog.store import Catalog, RunRow
from coslidar.flows import batches, patience, tasks
from coslidar.flows.batches import Workers
from coslidar.flows.options import Options
from coslidar.flows.plan import plan_archive
from coslidar.flows.pulse import Pulse
from coslidar.flows.run import Silent, run
from coslidar.flows.settings import Settings, Unavailable, load
from coslidar.pipeline.products import QUALITY_FLAGS

Main = Callable[..., Finished]
FAILED = QUALITY_FLAGS["failed"][0]


def settings_for(urls: list[str], out: Path, *assignments: str) -> Settings:
    return load(archives=urls, output=out, assignments=[*SETTINGS, *assignments])


@pytest.fixture(scope="module")
def whole(recordings: list[str], tmp_path_factory: pytest.TempPathFactory, cache: Path) -> dict[str, bytes]:
    """Products of the recordings."""
    out = tmp_path_factory.mktemp("whole") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSLIDAR_HOME", str(cache))
        run(settings_for(recordings, out), prefect=False)
    return products(out)


# --- batches that failed in products that are there --------------------------------------------------------


def test_retry_failed_mends_a_product(
    main_here: Main, recordings: list[str], whole: dict[str, bytes], tmp_path: Path
) -> None:
    archive, out = unpacked(recordings[0], tmp_path), tmp_path / "out"
    path = chunk(archive, 1)
    content = path.read_bytes()
    path.write_bytes(content[:1000] + bytes([content[1000] ^ 1]) + content[1001:])
    arguments = run_arguments([str(archive)], out)
    assert main_here(*arguments).code == 2
    spoiled = products(out)
    path.write_bytes(content)
    # The archive is the same one as before, for all that its identity tells, and the product is there.
    assert "4 of 4" not in main_here(*arguments).err
    assert products(out) == spoiled
    told = main_here("plan", *arguments[1:-1], "--retry-failed").out
    assert f"2 from kept correlations; {FRAMES // 2} frames to read" in told
    mended = main_here(*arguments, "--retry-failed")
    assert mended.code == 0, mended.err
    (content,) = products(out).values()
    assert content in whole.values()
    assert f"{FRAMES // 2} frames read" in mended.err
    with open_catalog(out) as catalog:
        assert catalog.verify() == []
        rows = catalog.batches()
        assert [row.number for row in rows] == list(range(BATCHES))
        assert not any(row.quality_flag & FAILED for row in rows)
    before = {path: path.stat().st_mtime_ns for path in (out / "products").rglob("*.zip")}
    again = main_here(*arguments, "--retry-failed")
    assert (again.code, "in the catalog already" in again.err) == (0, True)
    assert {path: path.stat().st_mtime_ns for path in (out / "products").rglob("*.zip")} == before


def test_retrying_what_is_not_mended_changes_nothing(recordings: list[str], tmp_path: Path) -> None:
    archive = unpacked(recordings[0], tmp_path)
    chunk(archive, 1).unlink()
    settings = settings_for([str(archive)], tmp_path / "out")
    run(settings, prefect=False)
    before = products(tmp_path / "out")
    (again,) = run(settings, prefect=False, options=Options(retry_failed=True))
    assert (again.failed_batches, again.input_fault, products(tmp_path / "out")) == (2, True, before)


def test_retry_failed_looks_again_at_what_the_data_forbade(recordings: list[str], tmp_path: Path) -> None:
    """Of an archive without a product, failures that last are remembered, until one asks otherwise."""
    settings = load(archives=recordings[:1], output=tmp_path, assignments=["batch.duration=0.3 s", "response.slices=6"])
    assert run(settings, prefect=False)[0].frames_read > 0
    assert run(settings, prefect=False)[0].frames_read == 0
    assert run(settings, prefect=False, options=Options(retry_failed=True))[0].frames_read > 0
    with open_catalog(tmp_path) as catalog:
        per_run = [len(catalog.failures(made.id)) for made in catalog.runs()]
    assert len(set(per_run)) == 1  # every run says what failed in it, computed or remembered
    assert per_run[0] > 0


# --- which archives ----------------------------------------------------------------------------------------


def test_since_and_until_choose_archives(main_here: Main, recordings: list[str], tmp_path: Path) -> None:
    """Recordings of 6 s begin at 15:15, 15:16 and 15:17 UTC."""
    chosen = ["--since", "2012-09-14T17:15:30+02:00", "--until", "2012-09-14T15:17Z"]
    done = main_here(*run_arguments(recordings, tmp_path / "out", *chosen))
    assert done.code == 0, done.err
    with open_catalog(tmp_path / "out") as catalog:
        assert [row.archive for row in catalog.products()] == ["r1"]
        assert [made.state for made in catalog.runs()] == ["finished"]
    assert done.err.count("skipped, outside the range of time") == 2
    edge = Options(since=1347635760 * 10**9)  # 15:16:00 exactly, the first frame of r1
    plans = [plan_archive(path, settings_for(recordings, tmp_path)) for path in recordings]
    assert [edge.wants(plan) for plan in plans] == [False, True, True]
    assert [Options(until=edge.since).wants(plan) for plan in plans] == [True, False, False]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--since", "2012-09-14T14:00"], ["--since", "zone"]),
        (["--until", "yesterday"], ["--until", "no time"]),
        (["--since", "2012-09-14T14:00Z", "--until", "2012-09-14T14:00Z"], ["nothing lies between them"]),
    ],
)
def test_a_range_that_is_none(
    options: list[str], words: list[str], main_here: Main, recordings: list[str], tmp_path: Path
) -> None:
    done = main_here(*run_arguments(recordings, tmp_path / "out", *options))
    assert done.code == 2
    assert all(word in done.err for word in words), done.err
    assert not (tmp_path / "out").exists()


def test_keep_going_or_not(main_here: Main, recordings: list[str], tmp_path: Path) -> None:
    urls = [str(tmp_path / "absent.zarr"), *recordings[:1]]
    one = ["--set", "run.archives_at_once=1"]
    stopped = main_here(*run_arguments(urls, tmp_path / "a", *one, "--no-keep-going"))
    assert (stopped.code, products(tmp_path / "a")) == (2, {})
    assert "skipped, not begun, because another archive failed" in stopped.err
    went_on = main_here(*run_arguments(urls, tmp_path / "a", *one))
    assert (went_on.code, len(products(tmp_path / "a"))) == (2, 1)


# --- network and damage ------------------------------------------------------------------------------------


@dataclass
class Network:
    """How many more reads of the second chunk fail, and how many were asked for."""

    url: str
    failing: int = 0
    asked: int = 0


@pytest.fixture
def remote(recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    """The first recording behind a network that can fail; nobody waits between tries."""
    fs = fsspec.filesystem("memory")
    fs.put(str(unpacked(recordings[0], tmp_path)), "/far/r0.zarr", recursive=True)
    network = Network("memory://far/r0.zarr")
    honest = MemoryFileSystem.cat_file

    def cat_file(self: MemoryFileSystem, path: str, *arguments: Any, **more: Any) -> Any:
        if "frames/c/1/" in path:
            network.asked += 1
            if network.failing:
                network.failing -= 1
                raise ConnectionResetError("connection reset by peer")
        return honest(self, path, *arguments, **more)

    monkeypatch.setattr(MemoryFileSystem, "cat_file", cat_file)
    monkeypatch.setattr(patience, "PAUSES", (0.0, 0.0, 0.0))
    yield network
    fs.rm("/far", recursive=True)


def test_a_network_that_fails_for_a_moment_costs_nothing(
    remote: Network, whole: dict[str, bytes], tmp_path: Path
) -> None:
    remote.failing = 3
    (outcome,) = run(settings_for([remote.url], tmp_path / "out", "run.threads=1"), prefect=False)
    assert (outcome.status, outcome.failed_batches, outcome.frames_read) == ("published", 0, FRAMES)
    assert remote.asked == 3 + 2  # chunk 1 is of two batches
    (content,) = products(tmp_path / "out").values()
    assert content in whole.values()


def test_a_network_that_is_down_is_no_damage_and_is_tried_again_by_the_next_run(
    remote: Network, tmp_path: Path
) -> None:
    remote.failing = 10**6
    settings = settings_for([remote.url], tmp_path / "out", "run.threads=1")
    (outcome,) = run(settings, prefect=False)
    assert (outcome.status, outcome.input_fault, outcome.failed_batches) == ("failed", False, 2)
    assert remote.asked == 2 * (1 + len(patience.PAUSES))
    assert all("cannot be reached" in fault and "connection reset by peer" in fault for fault in outcome.faults)
    with open_catalog(tmp_path / "out") as catalog:
        reasons = [failure.reason for failure in catalog.failures()]
        assert len(reasons) == 2
        assert all(reason.startswith("transient: ") for reason in reasons)
        assert catalog.products() == []
    remote.failing = 0
    (again,) = run(settings, prefect=False)
    assert (again.status, again.failed_batches, again.reused) == ("published", 0, 2)
    assert again.frames_read == 2 * FRAMES // BATCHES


def test_damage_behind_a_network_is_not_tried_again(remote: Network, tmp_path: Path) -> None:
    fs = fsspec.filesystem("memory")
    content = bytearray(fs.cat_file("/far/r0.zarr/frames/c/1/0/0"))
    content[1000] ^= 1
    fs.pipe_file("/far/r0.zarr/frames/c/1/0/0", bytes(content))
    remote.asked = 0
    (outcome,) = run(settings_for([remote.url], tmp_path / "out", "run.threads=1"), prefect=False)
    assert (outcome.status, outcome.failed_batches, outcome.input_fault) == ("published", 2, True)
    assert remote.asked == 2
    assert all("damaged" in fault for fault in outcome.faults)
    with open_catalog(tmp_path / "out") as catalog:
        assert not any(failure.reason.startswith("transient") for failure in catalog.failures())


@pytest.fixture
def answers(remote: Network, monkeypatch: pytest.MonkeyPatch) -> list[Exception]:
    """Exceptions with which the store of the recording meets those who open it, one each."""
    coming: list[Exception] = []
    honest = MemoryFileSystem.info

    def info(self: MemoryFileSystem, path: str, **more: Any) -> Any:
        if coming:
            raise coming.pop(0)
        return honest(self, path, **more)

    monkeypatch.setattr(MemoryFileSystem, "info", info)
    return coming


def test_a_store_that_hiccups_when_an_archive_is_opened_costs_nothing(
    remote: Network, answers: list[Exception], whole: dict[str, bytes], tmp_path: Path
) -> None:
    answers += [ConnectionResetError("reset"), TimeoutError("too slow"), OSError("no route")]
    (outcome,) = run(settings_for([remote.url], tmp_path / "out"), prefect=False)
    assert (outcome.status, outcome.failed_batches, answers) == ("published", 0, [])
    (content,) = products(tmp_path / "out").values()
    assert content in whole.values()


def test_a_store_that_is_down_or_closed_to_us_is_told_apart(
    remote: Network, answers: list[Exception], recordings: list[str], main_here: Main, tmp_path: Path
) -> None:
    arguments = run_arguments([remote.url], tmp_path / "out")
    answers += [ConnectionResetError("reset")] * (1 + len(patience.PAUSES))
    down = main_here(*arguments)
    assert (down.code, answers) == (1, []), down.err
    assert "does not answer as it should (ConnectionResetError: reset)" in down.err
    with open_catalog(tmp_path / "out") as catalog:
        (failure,) = catalog.failures()
    assert failure.reason.startswith("transient: ")
    assert "is tried again by" in main_here("status", "--out", tmp_path / "out").out
    # Nobody is let in for asking again.
    answers += [PermissionError("who are you?")] * 4
    closed = main_here(*arguments)
    assert (closed.code, len(answers)) == (2, 3), closed.err


def test_a_database_that_is_lost_for_a_moment_costs_nothing(
    recordings: list[str], whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(patience, "PAUSES", (0.0, 0.0, 0.0))
    honest, tries = Catalog.publish, []

    def publish(self: Catalog, *arguments: Any, **more: Any) -> Any:
        tries.append(1)
        if len(tries) % 2:
            raise sa.exc.OperationalError("INSERT", {}, Exception("server closed the connection unexpectedly"))
        return honest(self, *arguments, **more)

    monkeypatch.setattr(Catalog, "publish", publish)
    outcomes = run(settings_for(recordings[:2], tmp_path / "out"), prefect=False)
    assert [(outcome.status, outcome.frames_read, outcome.faults) for outcome in outcomes] == [
        ("published", 0, ()),  # in the second try: what was computed in the first one was kept
        ("published", 0, ()),
    ]
    assert products(tmp_path / "out").items() <= whole.items()
    # A file is not lost for a moment: that the disk is full is told at once.
    assert not passing(sa.exc.OperationalError("INSERT", {}, sqlite3.OperationalError("database or disk is full")))


@pytest.mark.skipif(not catalogs.SERVER, reason="COSLIDAR_TEST_POSTGRESQL names no server")
def test_a_postgresql_server_that_drops_its_connections_costs_nothing(
    main_here: Main, recordings: list[str], whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(patience, "PAUSES", (0.0, 0.0, 0.0))
    out = tmp_path / "out"
    drop = sa.text(
        "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity WHERE application_name = 'coslidar-dropped'"
    )
    dropped = []
    with catalogs.database_of("postgresql", tmp_path) as database:
        url = sa.make_url(database)
        mine = url.update_query_dict({"application_name": "coslidar-dropped"}).render_as_string(hide_password=False)
        made = main_here("catalog", "create", "--out", out, "--database", mine)
        assert made.code == 0, made.err
        server = sa.create_engine(url)

        class Watcher(Silent):
            def advanced(self, archive: str, index: int, reason: str) -> None:
                with server.connect() as connection:
                    dropped.append(connection.scalar(drop))

        outcomes = run(settings_for(recordings, out), Watcher(), prefect=False)
        server.dispose()
        assert [outcome.status for outcome in outcomes] == ["published"] * 3
        assert sum(dropped) > 0
        # From a machine that sees the catalog only.
        told = main_here("status", "--out", out)
        assert told.out.splitlines()[0].endswith(": finished")
    assert products(out) == whole


# --- the state of runs -------------------------------------------------------------------------------------

NOW = 10**18
ROW = RunRow(
    id="a" * 32, started=NOW, finished=None, state="running", host="elsewhere", pid=1, command="", commit="",
    software={}, configuration={}, heartbeat=NOW, progress=None,
)  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "seconds", "expected"),
    [
        ({}, 1, "running"),
        ({}, heartbeats.SILENCE - 1, "running"),
        ({}, heartbeats.SILENCE + 1, "lost"),
        ({"heartbeat": None}, heartbeats.SILENCE + 1, "lost"),
        ({"heartbeat": NOW + 500 * 10**9}, 501, "running"),
        ({"host": socket.gethostname(), "pid": 2**22 + 1}, 1, "lost"),  # no process has this number
        ({"state": "interrupted"}, 1, "lost"),
        ({"state": "finished"}, 10**6, "finished"),
        ({"state": "cancelled"}, 10**6, "cancelled"),
    ],
)
def test_life_of_a_run(changes: dict[str, Any], seconds: float, expected: str) -> None:
    assert heartbeats.life(replace(ROW, **changes), NOW + int(seconds * 1e9)) == expected


def test_a_heart_beats_while_a_run_lives(
    recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from coslidar.flows import pulse

    monkeypatch.setattr(pulse, "EVERY", 0.02)
    seen: list[tuple[int, Any]] = []

    class Watcher(Silent):
        def advanced(self, archive: str, index: int, reason: str) -> None:
            time.sleep(0.1)
            with open_catalog(tmp_path) as catalog:
                (made,) = catalog.runs()
                assert made.state == "running"
                assert made.heartbeat is not None
                seen.append((made.heartbeat, made.progress))

    run(settings_for(recordings[:1], tmp_path, "run.threads=1"), Watcher(), prefect=False)
    assert len({beat for beat, _ in seen}) == BATCHES
    assert [progress["batches"]["done"] for _, progress in seen] == [1, 2, 3, 4]
    with open_catalog(tmp_path) as catalog:
        (made,) = catalog.runs()
    assert made.progress is not None
    assert made.progress["outcomes"] == {"published": 1}
    assert made.progress["current"] == {}
    assert made.progress["batches"] == {"todo": 4, "done": 4, "failed": 0}


def test_a_catalog_that_does_not_take_a_heartbeat_ends_no_run() -> None:
    class Broken:
        beats = 0

        def beat(self, run_id: str, progress: Any) -> None:
            self.beats += 1
            raise OSError("disk full")

    broken = Broken()
    with Pulse(broken, "a", Silent(), 1, 1):  # type: ignore[arg-type]
        pass
    assert broken.beats == 1  # the last one, at the end


def test_status_tells_what_failed_and_what_to_do(main_here: Main, recordings: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    archive = unpacked(recordings[0], tmp_path)
    chunk(archive, 1).unlink()
    assert main_here(*run_arguments([str(archive), recordings[1]], out)).code == 2
    told = main_here("status", "--out", out)
    assert told.code == 0, told.err
    lines = told.out.splitlines()
    assert re.fullmatch(r"run [0-9a-f]{8}: finished", lines[0])
    assert "  archives   2 in all: 2 published" in lines
    assert any(line.startswith("  batches    8 of 8 computed so far, 2 failed;") for line in lines)
    assert sum(line.startswith("  failed  ") and "frames/c/1/0/0" in line for line in lines) == 2
    about = json.loads(main_here("status", about_run(out), "--out", out, "--json").out)
    assert (about["state"], about["seconds_left"], about["frames_read"]) == ("finished", None, 2 * FRAMES)
    assert [failure["transient"] for failure in about["failures"]] == [False, False]
    campaign = tmp_path / "campaign.toml"
    campaign.write_text(f"archives = []\noutput = '{out}'\n")
    assert main_here("status", campaign).out.splitlines()[0] == lines[0]
    none = main_here("status", "ffffffff", "--out", out)
    assert (none.code, "no run begins with 'ffffffff'" in none.err) == (2, True)


def about_run(out: Path) -> str:
    with open_catalog(out) as catalog:
        return catalog.runs()[-1].id[:12]


def test_status_of_a_run_whose_driver_is_gone(
    main_here: Main, recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rate and time left follow from what the driver said last: 4 batches in 2 s, 2 + 6 are left of two archives."""
    with open_catalog(tmp_path / "out", create=True) as catalog:
        made = catalog.start_run({"archives": 3, "folder": "/data/my campaign"}, "coslidar run c.toml")
        monkeypatch.setattr(socket, "gethostname", lambda: "elsewhere")
        progress = {
            "archives": 3, "outcomes": {"published": 1}, "current": {"demo/r1": {"todo": 4, "done": 2, "failed": 0}},
            "batches": {"todo": 6, "done": 4, "failed": 0}, "frames": 800, "threads": 2, "seconds": 2.0,
        }  # fmt: skip
        catalog.beat(made, progress)
        about = json.loads(main_here("status", "--out", tmp_path / "out", "--json").out)
        assert about["state"] == "running"
        assert about["batches_per_minute"] == pytest.approx(120)
        # Two batches of r1, and one archive to come, taken for as long as the mean of those that have begun, 3.
        assert about["seconds_left"] == pytest.approx((2 + 3) / 2)
        monkeypatch.setattr(heartbeats, "SILENCE", -1.0)
        told = main_here("status", "--out", tmp_path / "out").out
    assert ": lost" in told
    assert "Continue it with:  cd '/data/my campaign' && coslidar run c.toml" in told


def test_status_where_there_is_nothing(main_here: Main, tmp_path: Path) -> None:
    assert main_here("status", "--out", tmp_path / "nowhere").code == 2
    open_catalog(tmp_path / "out", create=True).close()
    empty = main_here("status", "--out", tmp_path / "out")
    assert (empty.code, "there has been no run yet" in empty.err) == (2, True)


# --- workers -----------------------------------------------------------------------------------------------


class FakeClient:
    def __init__(self, **threads: int) -> None:
        self.threads = threads

    def nthreads(self) -> dict[str, int]:
        return self.threads


def test_workers_come_and_go_and_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [1000.0]
    monkeypatch.setattr(batches.time, "monotonic", lambda: clock[0])
    client = FakeClient(a=2, b=1)
    workers = Workers(client)
    assert workers.known() == {"a": 2, "b": 1}
    assert workers.refuse("b", "numpy is 1 on worker b and 2 here")
    assert not workers.refuse("b", "again")
    assert workers.known() == {"a": 2}
    client.threads = {"b": 1, "c": 4}
    assert workers.known() == {"a": 2}  # asked a moment ago
    clock[0] += 3
    assert workers.known() == {"c": 4}
    client.threads = {"b": 1}
    clock[0] += Workers.EMPTY - 1
    assert not workers.missing()
    clock[0] += 2
    assert workers.missing()
    client.threads = {"c": 1}
    assert not workers.missing()


def test_a_run_without_usable_workers_names_both_versions(recordings: list[str], tmp_path: Path) -> None:
    from coslidar.flows.run import session

    with session(settings_for(recordings, tmp_path)) as work:
        assert work.usable_workers() is None
        for worker in work.workers.known().copy():
            work.refuse(worker, f"numpy is 1.26.0 on worker {worker} and 2.4.6 here")
        with pytest.raises(
            Unavailable, match=r"numpy is 1\.26\.0 on worker inproc\S+ and 2\.4\.6 here; install the same"
        ):
            work.usable_workers()


def test_a_worker_of_other_versions_computes_nothing(recordings: list[str], tmp_path: Path) -> None:
    """As it sees it itself, before its first batch."""
    origin = replace(tasks.Origin.here(), process=-1, versions={**tasks.versions(), "numpy": "9.9.9"})
    task = tasks.BatchTask.__new__(tasks.BatchTask)
    for name, value in {"origin": origin, "run": "r", "name": "n", "window": type("W", (), {"index": 0})}.items():
        object.__setattr__(task, name, value)
    outcome = tasks.process_batch(task, None)
    assert outcome.result is None
    assert re.fullmatch(rf"numpy is {tasks.versions()['numpy']} on worker \S+ and 9\.9\.9 here", outcome.refused)


def test_numerical_libraries_of_a_run_use_one_thread_and_get_theirs_back(
    recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from threadpoolctl import threadpool_info, threadpool_limits

    found: list[int] = []
    honest = tasks.stages.retrieve

    def retrieve(*arguments: Any) -> Any:
        found.extend(pool["num_threads"] for pool in threadpool_info())
        return honest(*arguments)

    monkeypatch.setattr(tasks.stages, "retrieve", retrieve)
    with threadpool_limits(limits=2):
        before = [pool["num_threads"] for pool in threadpool_info()]
        run(settings_for(recordings[:1], tmp_path), prefect=False)
        assert [pool["num_threads"] for pool in threadpool_info()] == before
    assert found
    assert set(found) == {1}
