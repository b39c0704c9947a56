"""Campaigns on a schedule: new archives are picked up; what Prefect's pages show."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from prefect_servers import PrefectServer, prefect_server
from small_runs import (
    ARCHIVES,
    BATCHES,
    FRAMES,
    SETTINGS,
    Finished,
    family,
    products,
    run_arguments,
    wait_for,
)

from coslidar.catalog import open_catalog
from coslidar.flows.run import run
from coslidar.flows.settings import load

Call = Callable[..., Finished]
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def campaigns(recordings: list[str], tmp_path: Path) -> list[Path]:
    """Two campaign files over folders of their own; the second has a fault."""
    made = []
    for name, archives in (("good", "['raw/*.zarr.zip']"), ("bad", "'raw/none-such.zarr'")):
        folder = tmp_path / name
        (folder / "raw").mkdir(parents=True)
        path = folder / "campaign.toml"
        path.write_text(f"archives = {archives}\n[batch]\nduration = '1.5 s'\n[response]\nslices = 6\n")
        made.append(path)
    shutil.copy(recordings[0], made[0].parent / "raw")
    return made


@pytest.fixture
def theirs(request: pytest.FixtureRequest, cache: Path, tmp_path: Path) -> Iterator[PrefectServer]:
    """Somebody's Prefect server; its database is the fixture's parameter."""
    with prefect_server(request.param, tmp_path, cache) as made:
        yield made


def on(*kinds: str) -> pytest.MarkDecorator:
    """With a server on each of these databases."""
    return pytest.mark.parametrize("theirs", kinds, indirect=True)


@pytest.mark.cluster
@pytest.mark.slow
@on("sqlite", "postgresql")
def test_serve_picks_up_what_is_new(
    theirs: PrefectServer,
    started: Start,
    campaigns: list[Path],
    recordings: list[str],
    tmp_path: Path,
) -> None:
    good = campaigns[0].parent
    process = started("serve", *campaigns, "--every", "10 s", PREFECT_API_URL=theirs.url)
    assert wait_for(lambda: len(products(good / "results")) == 1 or process.poll() is not None, 150, 0.2)
    assert process.poll() is None, process.communicate()
    shutil.copy(recordings[1], good / "raw" / "half-written")
    (good / "raw" / "half-written").rename(good / "raw" / "r1.zarr.zip")
    assert wait_for(lambda: len(products(good / "results")) == 2, 150, 0.2)
    # The link is made after the report.
    assert wait_for(lambda: any(one["key"] == "report" for one in theirs.all("artifacts")), 60, 0.2)
    # The bad campaign is told as such, and stopped nothing.
    assert wait_for(lambda: any(one["state_name"] == "Failed" for one in theirs.all("flow_runs")), 60, 0.2)
    failed = next(one for one in theirs.all("flow_runs") if one["state_name"] == "Failed")
    assert "none-such.zarr" in failed["state"]["message"]
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert not family(process.pid)
    assert "Traceback" not in err, err
    assert all("none-such.zarr" in line for line in err.splitlines()[1:]), err
    run(load(archives=recordings[:2], output=tmp_path / "out", assignments=SETTINGS), prefect=False)
    assert products(tmp_path / "out") == products(good / "results")
    report = (good / "results" / "report.html").read_text("utf-8")
    assert "r0" in report
    links = [one["data"] for one in theirs.all("artifacts") if one["key"] == "report"]
    assert any((good / "results" / "report.html").as_uri() in link for link in links)
    tables = [json.loads(one["data"]) for one in theirs.all("artifacts") if one["key"] == "progress"]
    assert any(table[-1]["computed"] == BATCHES and table[-1]["failed"] == 0 for table in tables)
    # Archives are tasks, and have their names.
    assert any(str(good / "raw" / "r0.zarr.zip") in one["name"] for one in theirs.all("task_runs"))


@pytest.mark.cluster
@pytest.mark.slow
@on("sqlite")
def test_deploy_to_a_work_pool(theirs: PrefectServer, coslidar: Call, campaigns: list[Path], cache: Path) -> None:
    arguments = ("deploy", campaigns[0], "--pool", "turbulence", "--every", "never", "--name", "mine")
    missing = coslidar(*arguments, PREFECT_API_URL=theirs.url)
    assert missing.code == 1
    assert "no work pool 'turbulence'" in missing.err
    theirs.prefect(cache, "work-pool", "create", "--type", "process", "turbulence")
    done = coslidar(*arguments, PREFECT_API_URL=theirs.url)
    assert done.code == 0, done.err
    assert "reprocess/mine" in done.out
    theirs.prefect(cache, "deployment", "run", "reprocess/mine")
    theirs.prefect(cache, "worker", "start", "--pool", "turbulence", "--run-once")
    assert len(products(campaigns[0].parent / "results")) == 1


# --- runs that are cancelled on the server -----------------------------------------------------------------


@pytest.fixture
def slowly(tmp_path: Path) -> dict[str, str]:
    """Environment in which every batch takes a second longer."""
    folder = tmp_path / "slowly"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(
        "import time\nfrom coslidar.pipeline import batch\nhonest = batch.retrieve\n"
        "batch.retrieve = lambda *a: (time.sleep(1), honest(*a))[1]\n"
    )
    return {"PYTHONPATH": str(folder)}


def correlations(out: Path) -> int:
    """Batches whose frames have been read."""
    return sum(1 for _ in (out / "correlations").glob("??/*.npz"))


def left_of(folder: Path, server: PrefectServer) -> list[str]:
    """Processes that were started in a folder, the server excepted."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.cwd() == str(folder) and process.pid != server.process.pid:
                found.append(" ".join(process.cmdline()))
    return found


@pytest.mark.cluster
@pytest.mark.slow
@on("postgresql")
def test_a_flow_run_that_is_cancelled_stops(
    theirs: PrefectServer,
    started: Start,
    coslidar: Call,
    recordings: list[str],
    undisturbed: dict[str, bytes],
    slowly: dict[str, str],
    cache: Path,
    tmp_path: Path,
) -> None:
    """On the page, or by command, although a person started it at a terminal."""
    out = tmp_path / "out"
    arguments = run_arguments(recordings, out, "--set", "run.threads=1", prefect=True)
    process = started(*arguments, PREFECT_API_URL=theirs.url, **slowly)
    assert wait_for(lambda: correlations(out) >= 2 or process.poll() is not None, 120)
    assert process.poll() is None, process.communicate()
    assert left_of(tmp_path, theirs)
    (flow,) = theirs.all("flow_runs")
    theirs.prefect(cache, "flow-run", "cancel", flow["id"])
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    told = [line for line in err.splitlines() if "batches published" not in line]
    assert told == ["coslidar: interrupted; what was finished is kept, the same command goes on from there"], err
    (flow,) = theirs.all("flow_runs")
    assert flow["state_name"] == "Cancelled"
    assert {one["state_type"] for one in theirs.all("task_runs")} <= {"COMPLETED", "CANCELLED"}
    assert left_of(tmp_path, theirs) == []
    with open_catalog(out) as catalog:
        assert [made.state for made in catalog.runs()] == ["cancelled"]
    kept = correlations(out)
    assert kept < len(ARCHIVES) * BATCHES
    again = coslidar(*run_arguments(recordings, out))
    assert again.code == 0, again.err
    assert f"{(len(ARCHIVES) * BATCHES - kept) * FRAMES // BATCHES} frames read" in again.err
    assert products(out) == undisturbed


@pytest.mark.cluster
@pytest.mark.slow
@on("postgresql")
def test_a_scheduled_run_that_is_cancelled_leaves_nothing_behind(
    theirs: PrefectServer,
    started: Start,
    campaigns: list[Path],
    slowly: dict[str, str],
    cache: Path,
    tmp_path: Path,
) -> None:
    out = campaigns[0].parent / "results"
    process = started("serve", campaigns[0], "--every", "never", PREFECT_API_URL=theirs.url, **slowly)
    assert wait_for(lambda: bool(theirs.all("deployments")) or process.poll() is not None, 120, 0.2)
    theirs.prefect(cache, "deployment", "run", "reprocess/coslidar")
    assert wait_for(lambda: correlations(out) >= 1 or process.poll() is not None, 120)
    assert process.poll() is None, process.communicate()
    (flow,) = theirs.all("flow_runs")
    theirs.prefect(cache, "flow-run", "cancel", flow["id"])
    assert wait_for(lambda: theirs.all("flow_runs")[0]["state_name"] == "Cancelled", 60, 0.2)
    assert wait_for(lambda: not family(process.pid), 30, 0.2), family(process.pid)
    assert process.poll() is None  # and goes on serving
    with open_catalog(out) as catalog:
        assert [made.state for made in catalog.runs()] == ["cancelled"]
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert left_of(tmp_path, theirs) == []


def test_campaigns_are_processed_one_after_the_other(
    main_here: Call, campaigns: list[Path], recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    third = tmp_path / "third"
    (third / "raw").mkdir(parents=True)
    shutil.copy(recordings[1], third / "raw")
    shutil.copy(campaigns[0], third)
    planned = main_here("run", *campaigns, third / "campaign.toml", "--dry-run")
    assert planned.code == 2
    assert [line for line in planned.out.splitlines() if line.endswith(".toml:")] == [
        f"{path}:" for path in (*campaigns, third / "campaign.toml")
    ]
    done = main_here("run", *campaigns, third / "campaign.toml", "--no-prefect")
    # The bad one is told as such, and stopped nothing.
    assert done.code == 2
    assert "none-such.zarr" in done.err
    assert [line for line in done.err.splitlines() if line.endswith(".toml")] == [
        f"coslidar: {path}" for path in (*campaigns, third / "campaign.toml")
    ]
    made = [products(path.parent / "results") for path in (campaigns[0], third / "campaign.toml")]
    assert [len(one) for one in made] == [1, 1]
    assert {**made[0], **made[1]}.items() <= undisturbed.items()
    # Told not to, it begins no other one; and faults of all files are told before anything begins.
    stopped = main_here("run", *reversed(campaigns), "--no-prefect", "--no-keep-going", "--out", tmp_path / "none")
    assert stopped.code == 2
    assert not products(tmp_path / "none")
    for path in campaigns:
        path.write_text("archives = []\n[batch]\nlength = '3 s'\n")
    wrong = main_here("run", *campaigns, "--no-prefect")
    assert wrong.code == 2
    assert [str(path) in line for path, line in zip(campaigns, wrong.err.splitlines(), strict=True)] == [True, True]
    mixed = main_here("run", *campaigns, recordings[0])
    assert "archives go with one campaign file" in mixed.err


def test_mistakes_in_a_schedule(coslidar: Call, campaigns: list[Path]) -> None:
    for arguments, words in (
        (("serve", campaigns[0], "--every", "10"), "the unit is missing"),
        (("serve", campaigns[0], "--every", "0 s"), "at least '1 s'"),
        (("deploy", campaigns[0], "--pool", "p"), "PREFECT_API_URL is not set"),
    ):
        done = coslidar(*arguments)
        assert done.code == 2
        (line,) = done.err.splitlines()
        assert words in line
