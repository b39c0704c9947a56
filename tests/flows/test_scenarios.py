"""Every shipped scenario from simulation to product."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coslidar.catalog import open_product
from coslidar.flows.driver import ArchiveOutcome
from coslidar.flows.run import run
from coslidar.flows.settings import load
from coslidar.flows.simulate import shipped, simulate, truth_path
from coslidar.pipeline.products import QUALITY_FLAGS


def simulated_and_run(name: str, folder: Path, duration: float | None, *assignments: str) -> list[ArchiveOutcome]:
    archives = simulate(name, folder / "raw", duration=duration)
    settings = load(archives=[str(path) for path in archives], output=folder / "results", assignments=assignments)
    return run(settings, prefect=False)


def flags(batch: Any) -> set[str]:
    return {name for name, (bit, _, _) in QUALITY_FLAGS.items() if int(batch["quality_flag"]) & bit}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(shipped()) - {"bad-weather"}))
def test_a_scenario_becomes_profiles(name: str, tmp_path: Path) -> None:
    """10 s: some 50 independent frames for slopes, hence 20 % of their variances and 12 % of r0, three times that."""
    assignments = ["response.extent=10 km", "response.slices=10"] if name == "plane-wave" else []
    for outcome in simulated_and_run(name, tmp_path, 10.0, "batch.duration=10 s", *assignments):
        assert outcome.status == "published", outcome.faults
        found = open_product(outcome.product).isel(time=0)
        assert np.isfinite(found["cn2"]).all()
        assert 0.3 < float(found["chi2_reduced"]) < 3
        assert not flags(found) & {"failed", "lost_spots", "gaps", "source_out", "repeated_frames", "irregular_time"}
        archive = outcome.url
        truth = json.loads(truth_path(Path(archive)).read_text("utf-8"))
        if truth["r0_m"] is not None:
            assert float(found["r0_profile"]) == pytest.approx(truth["r0_m"], rel=0.36)


@pytest.mark.slow
def test_bad_weather_leaves_good_batches_and_recorded_failures(tmp_path: Path) -> None:
    """As shipped, cut into batches as `coslidar init` does."""
    outcomes = simulated_and_run("bad-weather", tmp_path, None, "batch.duration=15 s")
    assert [outcome.status for outcome in outcomes] == ["published", "published"]
    assert [outcome.failed_batches for outcome in outcomes] == [1, 0]
    assert "could be measured" in outcomes[0].faults[0]
    first, second = (open_product(outcome.product) for outcome in outcomes)
    raised = [flags(first.isel(time=number)) for number in range(4)]
    # The second source is out from 20 to 32 s.
    assert raised[1] == {"failed"}
    assert np.isnan(first["cn2"].isel(time=1)).all()
    for number in (0, 2, 3):
        assert np.isfinite(first["cn2"].isel(time=number)).all()
        assert {"gaps", "lost_spots", "vibration"} <= raised[number]
        assert int(first["quality_level"].isel(time=number)) <= 1
    assert "source_out" in raised[2]
    assert second.sizes["time"] == 1
    assert np.isfinite(second["cn2"]).all()
