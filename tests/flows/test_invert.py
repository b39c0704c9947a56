"""`coslidar invert` through the command line, against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import optimize, stats

from coslidar.flows.commands.science import invert

OFF = ["--noise-bias", "none", "--slope-offset", "none"]


def run(folder: Path, arrays: dict[str, np.ndarray], *options: str) -> dict[str, np.ndarray]:
    np.savez(folder / "in.npz", **arrays)
    result = CliRunner().invoke(
        invert, [str(folder / "in.npz"), "-o", str(folder / "out.npz"), *options], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    with np.load(folder / "out.npz", allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def one_slice(value: float) -> dict[str, np.ndarray]:
    """One map entry per kind, of response 1e14 and unit noise: six equal measurements of one Cn2."""
    return {"C_mes": np.full(6, value), "C_conv": np.eye(6), "M": np.full((6, 1), 1e14)}


def truncated_normal(value: float, log_mu: float) -> tuple[float, float]:
    """Mean and deviation, before the cut at 0, of the posterior of `one_slice`."""
    precision = 6 * 1e28 + 10**log_mu
    return 6 * 1e14 * value / precision, precision**-0.5


@pytest.mark.parametrize("value", [3.0, 0.3, -0.5])
def test_intervals_and_mean_of_a_truncated_normal(tmp_path: Path, value: float) -> None:
    """Closed form: scipy's truncated normal; 8192 draws leave 1 % of the mean and some percent of the ends."""
    found = run(tmp_path, one_slice(value), *OFF, "--mu", "1e28 m^(4/3)")
    centre, spread = truncated_normal(value, 28)
    exact = stats.truncnorm(-centre / spread, np.inf, centre, spread)
    assert found["posterior_mean"].shape == (1,)
    assert found["posterior_mean"][0] == pytest.approx(exact.mean(), rel=0.03)
    for name, probability in (("hpd68", 0.68), ("hpd95", 0.95)):
        assert found[name].shape == (1, 2)
        start = optimize.minimize_scalar(
            lambda p, share=probability: exact.ppf(p + share) - exact.ppf(p), bounds=(0, 1 - probability - 1e-9),
            method="bounded", options={"xatol": 1e-9},
        ).x  # fmt: skip
        # A density that falls from 0 on has its shortest interval at the bound.
        low = 0.0 if centre <= 0 else exact.ppf(start)
        high = exact.ppf(start + probability) if centre > 0 else exact.ppf(probability)
        np.testing.assert_allclose(found[name][0], [low, high], atol=0.12 * spread)


def test_draws_are_stacked_and_one_draw_is_not(tmp_path: Path) -> None:
    arrays = one_slice(1.0)
    many = run(tmp_path, {**arrays, "C_mes": np.tile([[1.0], [2.0], [4.0]], (1, 6))}, *OFF, "--mu", "1e27 m^(4/3)")
    assert many["cn2"].shape == (3, 1)
    assert many["hpd68"].shape == many["hpd95"].shape == (3, 1, 2)
    assert many["posterior_mean"].shape == (3, 1)
    np.testing.assert_allclose(many["cn2"][:, 0], np.array([1, 2, 4]) * 1e-14 * 6e28 / (6e28 + 1e27), rtol=1e-9)
    assert (many["hpd95"][..., 0] <= many["hpd68"][..., 0]).all()
    assert (many["hpd95"][..., 1] >= many["hpd68"][..., 1]).all()


def test_estimator_chooses_what_cn2_is(tmp_path: Path) -> None:
    """Below zero the most probable profile is 0 and the mean is not."""
    arrays = one_slice(-0.2)
    options = [*OFF, "--mu", "1e27 m^(4/3)"]
    best = run(tmp_path, arrays, *options)
    mean = run(tmp_path, arrays, *options, "--estimator", "posterior_mean")
    assert best["cn2"][0] == 0
    assert [str(best["estimator"]), str(mean["estimator"])] == ["map", "posterior_mean"]
    np.testing.assert_array_equal(mean["cn2"], mean["posterior_mean"])
    np.testing.assert_array_equal(mean["posterior_mean"], best["posterior_mean"])
    centre, spread = truncated_normal(-0.2, 27)
    exact = stats.truncnorm(-centre / spread, np.inf, centre, spread).mean()
    assert mean["cn2"][0] == pytest.approx(exact, rel=0.04)


@pytest.mark.parametrize(
    ("subset", "blocks"),
    [("all", [0, 1, 2, 3, 4, 5]), ("slopes", [0, 1, 2, 3]), ("scintillation", [4, 5]), ("auto", [0, 1, 4]),
     ("cross", [2, 3, 5])],
)  # fmt: skip
def test_subset_uses_those_maps_only(tmp_path: Path, subset: str, blocks: list[int]) -> None:
    """Every block tells another Cn2: the estimate is the mean of those used."""
    told = np.array([1.0, 2, 4, 8, 16, 32])
    arrays = {**one_slice(0.0), "C_mes": told}
    found = run(tmp_path, arrays, *OFF, "--mu", "0 m^(4/3)", "--subset", subset)
    assert found["cn2"][0] == pytest.approx(told[blocks].mean() * 1e-14)
    assert found["error"][0] == pytest.approx(1e-14 / np.sqrt(len(blocks)))
    np.testing.assert_array_equal(found["rows"], blocks)
    assert str(found["subset"]) == subset


def test_profile_that_nothing_bounds(tmp_path: Path) -> None:
    """Two slices of one response without a prior: no posterior, and the file says so instead of failing."""
    arrays = {**one_slice(1.0), "M": np.full((6, 2), 1e14)}
    found = run(tmp_path, arrays, *OFF, "--mu", "0 m^(4/3)")
    assert np.isnan(found["posterior_mean"]).all()
    np.testing.assert_array_equal(found["hpd68"], [[0, np.inf]] * 2)
    options = [str(tmp_path / "in.npz"), "-o", str(tmp_path / "o.npz"), *OFF, "--mu", "0 m^(4/3)"]
    refused = CliRunner().invoke(invert, [*options, "--estimator", "posterior_mean"])
    assert refused.exit_code != 0
    assert "no posterior mean" in str(refused.exception)
