"""Workers in processes of their own: poison, other versions, threads, and what they log."""

from __future__ import annotations

import json
import pickle
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from urllib.request import HTTPCookieProcessor, build_opener

import numpy as np
import pytest
from small_clusters import Cluster
from small_runs import BATCHES, FRAMES, SETTINGS, Finished, command, environment, products, run_arguments, wait_for

from coslidar.catalog import open_catalog
from coslidar.flows import tasks
from coslidar.flows.batches import Batches
from coslidar.flows.options import Options
from coslidar.flows.plan import BatchWindow
from coslidar.flows.run import run
from coslidar.flows.settings import load
from coslidar.pipeline.batch import Model
from coslidar.pipeline.products import QUALITY_FLAGS

Call = Callable[..., Finished]


def preload(folder: Path, name: str, code: str) -> Path:
    """A module that a worker runs before it begins; once, although Dask imports it twice."""
    path = folder / f"{name}.py"
    body = "".join(f"    {line}\n" for line in code.splitlines())
    path.write_text(
        f"from coslidar.flows import tasks\nif not hasattr(tasks, '{name}'):\n    tasks.{name} = True\n{body}"
    )
    return path


@pytest.mark.cluster
def test_a_late_worker_of_other_versions_computes_nothing(
    dask: Cluster,
    started: Callable[..., subprocess.Popen[str]],
    recordings: list[str],
    undisturbed: dict[str, bytes],
    tmp_path: Path,
) -> None:
    """Beside it a good worker, started without a word on threads: it uses one, and its records arrive."""
    begun, late = tmp_path / "begun", tmp_path / "late"
    good = preload(
        tmp_path,
        "good",
        "import time\nfrom pathlib import Path\nfrom threadpoolctl import threadpool_info\n"
        "honest = tasks.stages.retrieve\n"
        "def retrieve(*a):\n"
        f"    Path({str(begun)!r}).touch()\n"
        f"    while not Path({str(late)!r}).exists():\n        time.sleep(0.05)\n"
        "    tasks.log.warning('threads %s', sorted({pool['num_threads'] for pool in threadpool_info()}))\n"
        "    return honest(*a)\n"
        "tasks.stages.retrieve = retrieve\n",
    )
    old = preload(
        tmp_path,
        "old",
        "honest = tasks.versions()\ntasks.versions = lambda: {**honest, 'numpy': '1.26.0'}\n"
        "def retrieve(*a):\n    raise AssertionError('computed')\ntasks.stages.retrieve = retrieve\n",
    )
    dask.worker("--no-nanny", "--preload", str(good), OMP_NUM_THREADS="4", OPENBLAS_NUM_THREADS="4")
    assert dask.ready(1)
    out = tmp_path / "out"
    process = started(*run_arguments(recordings, out, "--scheduler", dask.address, "--log-json"))
    assert wait_for(lambda: begun.exists() or process.poll() is not None, 240)
    dask.worker("--no-nanny", "--preload", str(old))
    # The other worker is at its first batch, and there are more, when this one is ready.
    assert dask.ready(2)
    late.touch()
    _, err = process.communicate(timeout=400)
    assert process.returncode == 0, err
    assert products(out) == undisturbed
    records = [json.loads(line) for line in err.splitlines()]
    refused = [record["message"] for record in records if "a worker is not used" in record["message"]]
    assert len(refused) == 1, err
    assert re.search(rf"numpy is 1\.26\.0 on worker tcp://\S+ and {re.escape(np.__version__)} here", refused[0])
    # What the good worker logged while it computed came here, with the place that it was about.
    told = [record for record in records if record["message"].startswith("threads ")]
    assert {record["message"] for record in told} == {"threads [1]"}
    assert {(record["archive"], record["batch"]) for record in told} == {
        (f"demo/{name}", number) for name in ("r0", "r1", "r2") for number in range(BATCHES)
    }
    with open_catalog(out) as catalog:
        assert {record["run"] for record in records} == {catalog.runs()[-1].id}


@pytest.mark.cluster
@pytest.mark.slow
def test_a_batch_that_kills_its_workers_is_recorded_and_the_others_are_done(
    dask: Cluster, coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    poison = preload(
        tmp_path,
        "poison",
        "import os\nhonest = tasks._process\n"
        "def process(task, model):\n"
        "    if task.name == 'demo/r1' and task.window.index == 2:\n        os._exit(9)\n"
        "    return honest(task, model)\n"
        "tasks._process = process\n",
    )
    for _ in range(2):
        dask.worker("--preload", str(poison))  # under a nanny, which starts another where one dies
    assert dask.ready(2)
    out = tmp_path / "out"
    done = coslidar(*run_arguments(recordings, out, "--scheduler", dask.address), timeout=400)
    assert done.code == 2, done.err
    assert "demo/r1: batch 2: every worker that computed it died (4 tries by itself alone)" in done.err
    assert "--retry-failed" in done.err
    kept = products(out)
    assert len(kept) == 3
    assert sum(content in undisturbed.values() for content in kept.values()) == 2
    with open_catalog(out) as catalog:
        (failure,) = catalog.failures()
        assert failure.archive == recordings[1]
        lost = [
            row.number for row in catalog.batches(archive_name="r1") if row.quality_flag & QUALITY_FLAGS["failed"][0]
        ]
        assert lost == [2]
        assert catalog.verify() == []
    # On a machine that it does not kill, it is computed, and nothing else is.
    (_, mended, _) = run(
        load(archives=recordings, output=out, assignments=SETTINGS), prefect=False, options=Options(retry_failed=True)
    )
    assert (mended.status, mended.failed_batches, mended.frames_read) == ("published", 0, FRAMES // BATCHES)
    assert set(products(out).values()) >= set(undisturbed.values())


def test_what_travels_is_small_however_long_a_batch_is(
    recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In bytes, as Dask sends them: frames stay where they are, and so do slopes."""
    sent: list[int] = []
    back: list[int] = []
    task, take = Batches._task, Batches._take

    def sending(self: Batches, window: BatchWindow, model: Model | None) -> tasks.BatchTask:
        made = task(self, window, model)
        sent.append(len(pickle.dumps((made, model))))
        return made

    def taking(self: Batches, outcome: tasks.BatchOutcome) -> None:
        back.append(len(pickle.dumps(outcome)))
        take(self, outcome)

    monkeypatch.setattr(Batches, "_task", sending)
    monkeypatch.setattr(Batches, "_take", taking)
    most = {}
    for length in ("1.5 s", "6 s"):
        sets = [*SETTINGS, f"batch.duration={length}"]
        (outcome,) = run(load(archives=recordings[:1], output=tmp_path / length, assignments=sets), prefect=False)
        assert outcome.status == "published"
        most[length] = (max(sent), max(back))
        sent.clear()
        back.clear()
    assert most["6 s"][0] < 64 * 2**10
    # Four times the frames, whose slopes alone would be 852 x 9 lenslets x 3 numbers x 2 sources x 8 bytes more.
    assert most["6 s"][1] < most["1.5 s"][1] + 2**10
    assert most["6 s"][1] < 256 * 2**10


# --- records -----------------------------------------------------------------------------------------------


def test_every_record_is_one_json_object_with_its_place(coslidar: Call, recordings: list[str], tmp_path: Path) -> None:
    absent = str(tmp_path / "absent\n{.zarr")
    done = coslidar(*run_arguments([*recordings[:1], absent], tmp_path / "out", "--log-json"))
    assert done.code == 2
    records = [json.loads(line) for line in done.err.splitlines()]
    with open_catalog(tmp_path / "out") as catalog:
        (made,) = catalog.runs()
    keys = ["time", "level", "logger", "host", "run", "archive", "batch", "message"]
    assert all(list(record) == keys for record in records), done.err
    assert {record["run"] for record in records} == {made.id}
    assert all(re.fullmatch(r"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", record["time"]) for record in records)
    batches = [record for record in records if record["batch"] is not None]
    assert {(record["archive"], record["batch"]) for record in batches} == {("demo/r0", i) for i in range(BATCHES)}
    (error,) = [record for record in records if record["level"] == "error"]
    assert "there is no such file or folder" in error["message"]


def test_the_same_records_as_text(coslidar: Call, recordings: list[str], tmp_path: Path) -> None:
    done = coslidar(*run_arguments(recordings[:1], tmp_path / "out", "--log-level", "info"))
    lines = done.err.splitlines()
    assert done.code == 0
    form = r"20\d\d-\S+Z (info|warning) run=[0-9a-f]{32}( archive=demo/r0( batch=[0-3])?)?: .+"
    assert all(re.fullmatch(form, line) for line in lines), done.err
    assert sum(" batch=" in line for line in lines) == BATCHES


def test_from_python_nothing_is_written_unless_asked(recordings: list[str], tmp_path: Path, cache: Path) -> None:
    code = (
        "import sys\nfrom pathlib import Path\nfrom coslidar.flows.run import run\n"
        "from coslidar.flows.settings import load\n"
        f"run(load(archives=[sys.argv[1]], output=Path(sys.argv[2]), assignments={list(SETTINGS)!r}), prefect=False)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "absent.zarr"), str(tmp_path / "out")],
        capture_output=True, text=True, timeout=400, env=environment(cache), check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_worker_sends_few_records_of_few_words(monkeypatch: pytest.MonkeyPatch) -> None:
    from coslidar.flows import logs

    level = tasks.log.level
    try:
        with logs.collected(20) as records, logs.about(run="r", batch=3):
            for number in range(1000):
                tasks.log.info("%d %s", number, "x" * 10_000)
            tasks.log.debug("not wanted")
        tasks.log.info("after")
    finally:
        tasks.log.removeHandler(logs._collector)
        tasks.log.setLevel(level)
    assert len(records) == logs.MAX_RECORDS
    assert all(len(record["msg"]) <= logs.MAX_MESSAGE for record in records)
    assert records[0]["place"] == {"run": "r", "batch": 3}


# --- nothing leaves the machine ----------------------------------------------------------------------------

AUDIT = """
import os, socket, sys
def hook(event, arguments, file=os.environ["CONNECTIONS"]):
    if event == "socket.connect":
        address = arguments[1]
        # Dask learns the address of this machine so: of the routing table, with a datagram socket that never sends.
        if arguments[0].type == socket.SOCK_DGRAM and address == ("8.8.8.8", 80):
            return
    elif event == "socket.getaddrinfo":
        address = arguments[0]
    elif event == "socket.sendto":
        address = arguments[1]
    else:
        return
    with open(file, "a") as out:
        out.write(f"{event} {address!r}\\n")
sys.addaudithook(hook)
"""


def audited(tmp_path: Path, cache: Path) -> tuple[dict[str, str], Path]:
    """Environment whose programs write down every connection and every name they look up; the file of it."""
    (tmp_path / "audit").mkdir()
    (tmp_path / "audit" / "sitecustomize.py").write_text(AUDIT)
    file = tmp_path / "connections.txt"
    file.touch()
    return environment(cache, PYTHONPATH=str(tmp_path / "audit"), CONNECTIONS=str(file)), file


def connections(tmp_path: Path, cache: Path, *arguments: object) -> list[str]:
    """Every connection that a run and all its children ask the system for, and every name they look up."""
    variables, file = audited(tmp_path, cache)
    done = subprocess.run(
        command(*arguments), capture_output=True, text=True, timeout=400, check=False, cwd=tmp_path, env=variables
    )
    assert done.returncode == 0, done.stderr
    return file.read_text().splitlines()


#: This machine, and the sockets of its own processes.
HERE = re.compile(r"""socket\.\w+ (\('(127\.0\.0\.1|::1)', .*|'(127\.0\.0\.1|::1|localhost|)'|b?'/.*|None)""")


def test_the_audit_sees_what_it_should(tmp_path: Path, cache: Path) -> None:
    """A hook that hears nothing would pass everything."""
    variables, file = audited(tmp_path, cache)
    code = (
        "import socket\nfor address in (('127.0.0.1', 9), ('192.0.2.1', 9)):\n"
        "    s = socket.socket()\n    s.settimeout(0.01)\n    s.connect_ex(address)\n"
        "try: socket.getaddrinfo('telemetry.invalid', 443)\nexcept OSError: pass\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env=variables)
    seen = file.read_text().splitlines()
    assert [bool(HERE.fullmatch(line)) for line in seen] == [True, False, False], seen


ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+\S*")


def test_no_telemetry(recordings: list[str], tmp_path: Path, cache: Path) -> None:
    found = connections(tmp_path, cache, *run_arguments(recordings[:1], tmp_path / "out"))
    assert [line for line in found if not HERE.fullmatch(line)] == []


@pytest.mark.cluster
def test_no_telemetry_of_prefect_and_its_server(recordings: list[str], tmp_path: Path, cache: Path) -> None:
    found = connections(tmp_path, cache, *run_arguments(recordings[:1], tmp_path / "out", prefect=True))
    assert any("127.0.0.1" in line for line in found)  # flow and server speak with each other
    assert [line for line in found if not HERE.fullmatch(line)] == []


@pytest.mark.cluster
@pytest.mark.slow
def test_no_telemetry_of_reports_pages_and_schedules(recordings: list[str], tmp_path: Path, cache: Path) -> None:
    variables, file = audited(tmp_path, cache)
    (tmp_path / "campaign.toml").write_text(
        f"archives = ['{recordings[0]}']\n[batch]\nduration = '1.5 s'\n[response]\nslices = 6\n"
    )
    arguments = {
        "serve": ("campaign.toml", "--every", "never"),
        "run": ("campaign.toml", "--no-prefect"),
        "report": ("campaign.toml", "-o", "report.html"),
        "export": ("campaign.toml", "-o", "profiles.csv"),
        "browse": ("campaign.toml", "--port", "0"),
    }
    for name, more in arguments.items():
        with (tmp_path / f"{name}.txt").open("w") as said:
            process = subprocess.Popen(
                command(name, *more), stdout=said, stderr=said, cwd=tmp_path, env=variables, process_group=0
            )
        if name not in ("serve", "browse"):
            assert process.wait(240) == 0, (tmp_path / f"{name}.txt").read_text()
            continue
        try:
            assert wait_for(lambda log=tmp_path / f"{name}.txt": bool(ADDRESS.search(log.read_text())), 120, 0.1)
            found = ADDRESS.search((tmp_path / f"{name}.txt").read_text())
            assert found
            if name == "browse":
                reader = build_opener(HTTPCookieProcessor())  # the token of the address becomes a cookie
                with reader.open(found[0], timeout=60) as answer:
                    assert b"r0" in answer.read()
            else:
                time.sleep(3)  # what a server sends home it sends when it has come up
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()
    seen = file.read_text().splitlines()
    assert any("127.0.0.1" in line for line in seen)
    assert [line for line in seen if not HERE.fullmatch(line)] == []
