"""coslidar link: numbers against closed forms and draws, what it writes, and what it refuses."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import made_products
import numpy as np
import pytest
from click.testing import CliRunner, Result

from coslidar.catalog.products import write_product
from coslidar.flows.cli import cli
from coslidar.flows.settings import InputError
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.optical_parameters import optical_intervals, optical_parameters
from coslidar.pipeline.products import BatchResult

LENGTH, CN2 = 2670.0, 2e-15
K = 2 * np.pi / 1.55e-6
GRID = SliceGrid.uniform(LENGTH, 4)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A uniform profile, fully correlated errors of 10 %, and a batch that failed."""
    one = made_products.batch(0)
    uniform = np.full(4, CN2)
    values = {
        "cn2": uniform, "cn2_posterior_mean": uniform, "cn2_posterior_covariance": np.full((4, 4), (0.1 * CN2) ** 2)
    }  # fmt: skip
    results = [BatchResult(one.start, one.stop, one.values | values), made_products.failed(1)]
    write_product(made_products.product(results=results), tmp_path / "p.zarr.zip")
    return tmp_path


def run(folder: Path, *options: str) -> Result:
    return CliRunner().invoke(cli, ["link", str(folder / "p.zarr.zip"), *options])


def test_closed_forms_with_their_errors(folder: Path) -> None:
    """Andrews and Phillips 2005: r0 = (0.423 3/8 k^2 Cn2 L)^(-3/5), Rytov variance 0.404 1.23 Cn2 k^(7/6) L^(11/6)."""
    done = run(folder, "--wavelength", "1.55 um", "--wind", "3 m/s", "--format", "json")
    assert done.exit_code == 0, done.output
    content = json.loads(done.output)
    assert content["link"] == {
        "wavelength": "1.55e-06 m", "direction": "toward_pupil", "wave": "spherical", "wind": "3 m/s"
    }  # fmt: skip
    good, bad = content["batches"]
    r0 = (0.423 * 3 / 8 * K**2 * CN2 * LENGTH) ** (-3 / 5)
    assert good["fried_parameter"]["value"] == pytest.approx(r0, rel=1e-3)
    rytov = 0.404 * 1.23 * CN2 * K ** (7 / 6) * LENGTH ** (11 / 6)
    assert good["rytov_variance"]["value"] == pytest.approx(rytov, rel=5e-3)
    # 0.314 r0 / v, with r0 of a plane wave (Roddier 1981).
    plane = (0.423 * K**2 * CN2 * LENGTH) ** (-3 / 5)
    assert good["coherence_time"]["value"] == pytest.approx(0.314 * plane / 3, rel=2e-3)
    # 10 % of Cn2 are 10 % of the Rytov variance and 6 % of r0, to the square of that.
    low, high = good["rytov_variance"]["interval_68"]
    assert (high - low) / 2 / good["rytov_variance"]["value"] == pytest.approx(0.1, rel=0.02)
    low, high = good["fried_parameter"]["interval_68"]
    assert (high - low) / 2 / good["fried_parameter"]["value"] == pytest.approx(0.06, rel=0.02)
    assert low < good["fried_parameter"]["value"] < high
    assert bad["fried_parameter"] == {"value": None, "interval_68": [None, None]}


def test_intervals_against_draws() -> None:
    """68 % of draws of a correlated, positive posterior lie between the ends, for every parameter and direction."""
    random = np.random.default_rng(3)
    logs = random.multivariate_normal(np.zeros(4), 0.16 * (np.eye(4) - 0.2), 20_000)
    draws = CN2 * np.array([1, 2, 4, 8]) * np.exp(logs)
    for direction in ("toward_pupil", "toward_sources"):
        how = {"direction": direction, "wind": np.array([1.0, 2.0, 3.0, 4.0])}
        ends = optical_intervals(draws.mean(0), np.cov(draws, rowvar=False), GRID, 1.55e-6, LENGTH, **how)  # type: ignore[arg-type]
        found = optical_parameters(draws, GRID, 1.55e-6, LENGTH, **how)  # type: ignore[arg-type]
        for name, (low, high) in ends.items():
            inside = np.mean((getattr(found, name) > low) & (getattr(found, name) < high))
            # A sum of four log-normals of 40 % each is not quite one: 3 %; 20 000 draws tell the fraction to 0.3 %.
            assert inside == pytest.approx(0.683, abs=0.03), name


def test_direction_and_wave(folder: Path) -> None:
    def first(*options: str) -> dict[str, float]:
        done = run(folder, "--wavelength", "1.55 um", "--format", "csv", *options)
        assert done.exit_code == 0, done.output
        row = next(csv.DictReader(io.StringIO(done.output)))
        return {key: float(value) for key, value in row.items() if "[m]" in key or "[1]" in key or "[rad]" in key}

    # A uniform path is the same from both ends.
    assert first("--direction", "away") == pytest.approx(first())
    plane, spherical = first("--wave", "plane"), first()
    assert spherical["fried_parameter [m]"] / plane["fried_parameter [m]"] == pytest.approx((3 / 8) ** -0.6, rel=1e-4)


def test_table_and_file(folder: Path) -> None:
    done = run(folder, "--wavelength", "1.55 um")
    head, good, bad = done.output.splitlines()
    assert head.split("  ")[0] == "start (UTC)"
    assert "coherence" not in head  # without a wind
    assert good.startswith("2012-09-14T12:15:00Z")
    assert "[" in good
    assert bad.split()[1:] == ["-", "-", "-"]
    written = run(folder, "--wavelength", "1.55 um", "--format", "csv", "-o", str(folder / "deep" / "link.csv"))
    assert written.exit_code == 0, written.output
    assert (folder / "deep" / "link.csv").read_text().startswith("archive,time [UTC],end [UTC],fried_parameter [m]")


def test_all_faults_at_once(folder: Path) -> None:
    done = run(folder, "--wavelength", "1.55", "--wind", "3 m")
    assert isinstance(done.exception, InputError)
    first, second = done.exception.faults
    assert first.startswith("--wavelength 1.55: ")
    assert "unit is missing" in first
    assert second.startswith("--wind 3 m: ")
    done = run(folder, "--wavelength", "0 um", "--wind", "-1 m/s", "--from", "2012-09-14T14:00Z")
    assert isinstance(done.exception, InputError)
    assert all("must be greater than 0" in fault for fault in done.exception.faults)
    assert len(done.exception.faults) == 2
