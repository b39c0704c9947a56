"""coslidar compare: what it prints and writes, and what it refuses."""

from __future__ import annotations

import csv
from pathlib import Path

import made_products
import numpy as np
import pytest
from click.testing import CliRunner, Result

from coslidar.catalog.products import write_product
from coslidar.flows.cli import cli
from coslidar.flows.settings import InputError
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.products import BatchResult
from coslidar.pipeline.scintillometer import slice_weights

LAS = """
[[scintillometers]]
name = "A"
wavelength = "0.88 um"
diameters = ["5 cm", "14.5 cm"]
series = { file = "las.csv" }
"""
CN2 = np.array([[1.0, 2.0, 3.0, 4.0], [2.0, 2.0, 2.0, 2.0]]) * 1e-14


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A product of two batches of known profiles, and a scintillometer that reads half of a uniform 2e-14."""
    results = []
    for number, cn2 in enumerate(CN2):
        one = made_products.batch(number)
        covariance = np.diag((0.1 * cn2) ** 2)
        results.append(
            BatchResult(one.start, one.stop, one.values | {"cn2": cn2, "cn2_posterior_covariance": covariance})
        )
    write_product(made_products.product(results=results), tmp_path / "p.zarr.zip")
    stamps = [np.datetime64(results[0].start + k * 60 * 10**9, "ns").astype("datetime64[s]") for k in range(-2, 30)]
    rows = "".join(f"{stamp}Z,1e-14\n" for stamp in stamps)
    (tmp_path / "las.csv").write_text("time,Cn2 [m^-2/3]\n" + rows)
    (tmp_path / "campaign.toml").write_text('campaign = "test-campaign"\n' + LAS)
    return tmp_path


def run(folder: Path, *options: str) -> Result:
    campaign = ["--campaign", str(folder / "campaign.toml")]
    return CliRunner().invoke(cli, ["compare", str(folder / "p.zarr.zip"), *campaign, *options])


def refused(result: Result) -> str:
    assert isinstance(result.exception, InputError), result.exception
    return "\n".join(result.exception.faults)


def test_batches_beside_a_scintillometer(folder: Path) -> None:
    done = run(folder, "--csv", str(folder / "out.csv"), "-o", str(folder / "out.png"))
    assert done.exit_code == 0, done.output
    assert "'m^-2/3' says another thing than is meant" in done.output
    with (folder / "out.csv").open() as file:
        rows = list(csv.DictReader(file))
    weights = slice_weights(SliceGrid.uniform(2670.0, 4), (0.0, 2670.0), 0.05, 0.145, 0.88e-6)
    ours = [float(row["emulated [m^(-2/3)]"]) for row in rows]
    assert ours == pytest.approx(CN2 @ weights, rel=1e-5)
    errors = [float(row["emulated error [m^(-2/3)]"]) for row in rows]
    assert errors == pytest.approx(0.1 * np.sqrt((CN2 * weights) ** 2 @ np.ones(4)), rel=1e-5)
    assert [float(row["measured [m^(-2/3)]"]) for row in rows] == pytest.approx([1e-14, 1e-14])
    ratio = np.exp(np.mean(np.log(np.array(ours) / 1e-14)))
    assert f"A                      2  {ratio:.3f} ±" in done.output
    assert (folder / "out.png").read_bytes()[:4] == b"\x89PNG"


def test_beside_the_line_of_sight(folder: Path) -> None:
    """Twice the height all along, so 2^(-4/3) of Cn2 and of its errors; the product says 10 to 30 m."""
    heights = 'offset = "-120 m"\nheights = ["18 m", "62 m"]\n'  # twice those at the borders, 9 m and 31 m
    values = []
    for scaling in ("none", "free_convection"):
        (folder / "campaign.toml").write_text(f'{LAS}{heights}height_scaling = "{scaling}"\n')
        done = run(folder, "--csv", str(folder / "out.csv"))
        assert done.exit_code == 0, done.output
        line = next(line for line in done.output.splitlines() if line.startswith("A  "))
        assert "120 m left, " in line
        assert " m above" in line
        assert ("carried as h^(-4/3)" in line) == (scaling == "free_convection")
        with (folder / "out.csv").open() as file:
            rows = list(csv.DictReader(file))
        values.append([[float(row[f"emulated{what} [m^(-2/3)]"]) for what in ("", " error")] for row in rows])
    # The made heights of slices are not those of their borders: 20 % of a height that counts little.
    assert np.array(values[1]) / np.array(values[0]) == pytest.approx(2 ** (-4 / 3), rel=0.05)


def test_windows_of_their_own(folder: Path) -> None:
    done = run(folder, "--average", "10 min", "--coverage", "0.1", "--whole", "--csv", str(folder / "out.csv"))
    assert done.exit_code == 0, done.output
    with (folder / "out.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert all(row["time [UTC]"].endswith("0:00Z") for row in rows)
    assert sum(bool(row["measured [m^(-2/3)]"]) for row in rows) >= 3
    assert any(row["emulated [m^(-2/3)]"] for row in rows)


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (["--average", "10"], "unit is missing"),
        (["--average", "1 ms"], "less than a second"),
        (["--whole"], "say how long the windows are"),
        (["-o", "x.jpg"], "write .svg, .png or .pdf"),
        (["--from", "2030-01-01T00:00Z"], "no batch starts in that time"),
    ],
)
def test_options_that_make_no_sense(folder: Path, options: list[str], fault: str) -> None:
    assert fault in refused(run(folder, *options))


@pytest.mark.parametrize(
    ("campaign", "faults"),
    [
        ("", ["there is no scintillometer; add a table"]),
        (LAS.replace("las.csv", "none.csv"), ["scintillometers[0].series.file", "there is no such file"]),
        (LAS.replace("0.88 um", "0.88 s"), ["scintillometers[0].wavelength", "is a duration"]),
        (LAS.replace('name = "A"', ""), ["scintillometers[0].name is missing"]),
        (LAS + 'end = "9 km"\n', []),
        (LAS.replace("series", "serie"), ["scintillometers[0].serie", "there is no such key"]),
        (LAS.replace('"5 cm", ', 'start = "1 m", '), []),
    ],
)
def test_campaigns_that_make_no_sense(folder: Path, campaign: str, faults: list[str]) -> None:
    (folder / "campaign.toml").write_text(campaign)
    said = refused(run(folder))
    for fault in faults:
        assert fault in said


def test_without_a_campaign(folder: Path) -> None:
    done = CliRunner().invoke(cli, ["compare", str(folder / "p.zarr.zip")])
    assert "no campaign file names scintillometers" in refused(done)
