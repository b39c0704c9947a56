"""`coslidar experiment` through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner

from coslidar.flows.commands.experiment import experiment
from coslidar.flows.settings import InputError
from coslidar.plugins.registry import entries


def run(*arguments: str) -> str:
    result = CliRunner().invoke(experiment, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_appendix_as_json_and_figure(tmp_path: Path) -> None:
    figure = tmp_path / "new" / "gcv.svg"
    found = json.loads(run("gcv", "--profile", "weak", "--draws", "6", "--json", "-o", str(figure)))
    weak = found["profiles"]["weak"]
    assert weak["truth"] == [1.2e-14, 1e-14, 6e-15, 4e-15, 6e-15, 8e-15, 8e-15, 5e-15, 4e-15, 6e-15, 1.2e-14, 1.5e-14]
    assert len(found["z"]) == 12
    assert weak["log_mu_grid"][0] == 25
    assert weak["log_mu_grid"][-1] == 33
    # Near the pupil the data decide: a mean of six draws lies within a bar of the truth.
    assert np.abs(np.array(weak["cn2_map"]) - weak["truth"])[:4].max() < np.array(weak["bar_map"])[:4].max()
    assert 0.1 < weak["error_map"] < 1.5
    assert weak["error_best"] <= weak["error_map"]
    for kind in ("map", "ml", "hpd"):
        assert 0.3 < weak[f"coverage_{kind}"][0] <= weak[f"coverage_{kind}"][1] <= 1
        assert len(weak["coverage"][kind]["68"]) == 12
    assert ElementTree.parse(figure).getroot().tag.endswith("svg")
    assert "mean squared gap" in figure.read_text("utf-8")


def test_text_tells_the_same_and_a_seed_repeats_it() -> None:
    options = ["gcv", "--profile", "single", "--draws", "4", "--regulariser", "gradient", "--selector", "upre"]
    text = run(*options, "--seed", "5")
    numbers = json.loads(run(*options, "--seed", "5", "--json"))["profiles"]["single"]
    assert run(*options, "--seed", "5") == text
    assert run(*options, "--seed", "6") != text
    assert f"MAP {numbers['error_map']:.2f}, posterior mean {numbers['error_mean']:.2f}" in text
    assert f"{numbers['squared_gap']:.2f} to the best log mu" in text


def test_every_installed_prior_and_selector_has_its_row() -> None:
    lines = run("compare", "--profile", "empty", "--draws", "2").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert rows[0] == ["prior", "selector", "empty"]
    priors, selectors = entries("regulariser"), [name for name in entries("hyperparameter selector") if name != "fixed"]
    assert [tuple(row[:2]) for row in rows[2:]] == [(prior, selector) for prior in priors for selector in selectors]


def test_chosen_rows_only() -> None:
    rows = json.loads(
        run("compare", "--profile", "weak", "--profile", "single", "--draws", "2", "--json",
            "--regulariser", "white", "--selector", "gcv:log_mu_min=25", "--selector", "fixed:mu=1e27 m^(4/3)")
    )  # fmt: skip
    assert [row["selector"] for row in rows] == ["gcv:log_mu_min=25", "fixed:mu=1e27 m^(4/3)"]
    assert set(rows[1]["profiles"]) == {"weak", "single"}
    weak = rows[1]["profiles"]["weak"]
    assert weak["log_mu"] == pytest.approx(27)
    assert len(weak["errors_map"]) == 2
    assert np.mean(weak["errors_mean"]) == pytest.approx(weak["error_mean"])


def test_documented_row_is_what_comes_out() -> None:
    """The row of the default in docs/experiment.md, for one profile: other BLAS libraries may round a choice of mu."""
    page = (Path(__file__).parents[2] / "docs" / "experiment.md").read_text("utf-8")
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines()]
    head = next(line for line in lines if line[:2] == ["prior", "selector"])
    row = next(line for line in lines if line[:2] == ["white", "gcv"])
    documented = [float(number) for number in row[head.index("weak")].replace(";", ",").split(",")]
    found = run("compare", "--profile", "weak", "--draws", "40", "--regulariser", "white", "--selector", "gcv")
    cell = found.splitlines()[-1].strip("|").split("|")[2]
    assert [float(number) for number in cell.replace(";", ",").split(",")] == pytest.approx(documented, abs=0.03)


def test_faults_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no regulariser 'smooth'; installed"):
        run("gcv", "--regulariser", "smooth")
    with pytest.raises(InputError, match="must end in"):
        run("gcv", "-o", str(tmp_path / "figure.docx"))
    result = CliRunner().invoke(experiment, ["gcv", "--profile", "empty", "--no-noise"])
    assert result.exit_code == 2
    assert "nothing to draw" in result.output
