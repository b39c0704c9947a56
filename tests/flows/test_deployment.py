"""Campaigns on a schedule: new archives are picked up; what Prefect's pages show."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import pytest
from small_runs import BATCHES, SETTINGS, Finished, environment, family, products, wait_for

from coslidar.flows import server
from coslidar.flows.run import run
from coslidar.flows.settings import load

Call = Callable[..., Finished]


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
def theirs(cache: Path, tmp_path: Path) -> Iterator[str]:
    """URL of somebody's Prefect server."""
    port = server._free_port()
    url = f"http://127.0.0.1:{port}/api"
    with (tmp_path / "server.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "prefect", "server", "start", "--no-ui", "--host", "127.0.0.1", "--port", str(port)],
            env=environment(cache, PREFECT_HOME=str(tmp_path / "theirs"), **server.quiet_environment()),
            stdout=log,
            stderr=log,
        )

    def healthy() -> bool:
        try:
            with urlopen(f"{url}/health", timeout=2):
                return True
        except OSError:
            return False

    try:
        assert wait_for(lambda: healthy() or process.poll() is not None, 120, step=0.2)
        yield url
    finally:
        process.terminate()
        process.wait(30)


def asked(url: str, what: str) -> list[dict[str, Any]]:
    request = Request(f"{url}/{what}/filter", b"{}", {"Content-Type": "application/json"})
    with urlopen(request, timeout=20) as answer:
        return json.loads(answer.read())  # type: ignore[no-any-return]


@pytest.mark.cluster
@pytest.mark.slow
def test_serve_picks_up_what_is_new(
    theirs: str,
    started: Callable[..., subprocess.Popen[str]],
    campaigns: list[Path],
    recordings: list[str],
    tmp_path: Path,
) -> None:
    good = campaigns[0].parent
    process = started("serve", *campaigns, "--every", "10 s", PREFECT_API_URL=theirs)
    assert wait_for(lambda: len(products(good / "results")) == 1 or process.poll() is not None, 150, 0.2)
    assert process.poll() is None, process.communicate()
    shutil.copy(recordings[1], good / "raw" / "half-written")
    (good / "raw" / "half-written").rename(good / "raw" / "r1.zarr.zip")
    assert wait_for(lambda: len(products(good / "results")) == 2, 150, 0.2)
    # The link is made after the report.
    assert wait_for(lambda: any(one["key"] == "report" for one in asked(theirs, "artifacts")), 60, 0.2)
    # The bad campaign is told as such, and stopped nothing.
    assert wait_for(lambda: any(one["state_name"] == "Failed" for one in asked(theirs, "flow_runs")), 60, 0.2)
    failed = next(one for one in asked(theirs, "flow_runs") if one["state_name"] == "Failed")
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
    links = [one["data"] for one in asked(theirs, "artifacts") if one["key"] == "report"]
    assert any((good / "results" / "report.html").as_uri() in link for link in links)
    tables = [json.loads(one["data"]) for one in asked(theirs, "artifacts") if one["key"] == "progress"]
    assert any(table[-1]["computed"] == BATCHES and table[-1]["failed"] == 0 for table in tables)
    # Archives are tasks, and have their names.
    assert any(str(good / "raw" / "r0.zarr.zip") in one["name"] for one in asked(theirs, "task_runs"))


@pytest.mark.cluster
@pytest.mark.slow
def test_deploy_to_a_work_pool(theirs: str, coslidar: Call, campaigns: list[Path], cache: Path, tmp_path: Path) -> None:
    def prefect(*arguments: str) -> str:
        more = {"PREFECT_API_URL": theirs, "PREFECT_HOME": str(tmp_path / "mine")}
        done = subprocess.run(
            [sys.executable, "-m", "prefect", *arguments],
            env=environment(cache, **{**server.quiet_environment(), **more}),
            capture_output=True,
            text=True,
            timeout=200,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    arguments = ("deploy", campaigns[0], "--pool", "turbulence", "--every", "never", "--name", "mine")
    missing = coslidar(*arguments, PREFECT_API_URL=theirs)
    assert missing.code == 1
    assert "no work pool 'turbulence'" in missing.err
    prefect("work-pool", "create", "--type", "process", "turbulence")
    done = coslidar(*arguments, PREFECT_API_URL=theirs)
    assert done.code == 0, done.err
    assert "reprocess/mine" in done.out
    prefect("deployment", "run", "reprocess/mine")
    prefect("worker", "start", "--pool", "turbulence", "--run-once")
    assert len(products(campaigns[0].parent / "results")) == 1


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
