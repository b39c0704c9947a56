"""What a run leaves behind in a process that goes on: a service makes thousands of them."""

from __future__ import annotations

import gc
from pathlib import Path

from distributed import Client, Scheduler, Worker
from small_runs import SETTINGS

from coslidar.flows.run import run
from coslidar.flows.settings import load


def test_a_run_leaves_no_cluster_behind(recordings: list[str], tmp_path: Path) -> None:
    for number in range(2):
        settings = load(archives=recordings[:1], output=tmp_path / str(number), assignments=list(SETTINGS))
        (outcome,) = run(settings, prefect=False)
        assert outcome.status == "published"
    gc.collect()
    left = [one for one in gc.get_objects() if type(one) in (Scheduler, Worker, Client) and one.status != "running"]
    assert not left
