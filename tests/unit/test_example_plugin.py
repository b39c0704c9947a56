"""A distribution that is not ours: found, checked and used like what is built in."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pytest

from coslidar.pipeline.geometry import SliceGrid
from coslidar.plugins import registry
from coslidar.plugins.conformance import CHECKS

FOLDER = Path(__file__).resolve().parents[1] / "example_plugin"
PIP = f"{sys.executable} -m pip install --no-deps -e {FOLDER}"
GRID = SliceGrid.uniform(2670.0, 12)


@pytest.fixture(autouse=True)
def installed() -> None:
    try:
        distribution("coslidar-example-plugin")
    except PackageNotFoundError:
        pytest.fail(f"the example of a plugin is not installed; run:\n\n    {PIP}\n", pytrace=False)


def run(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True)


def test_it_is_found_under_its_distribution() -> None:
    entry = registry.entries("regulariser")["power_of_distance"]
    assert entry.distribution == "coslidar-example-plugin 1.0"


def test_its_prior_is_what_it_says() -> None:
    """Spread of Cn2 proportional to sqrt(z^2 + floor^2), the mean of its square 1."""
    prior = registry.create("regulariser", "power_of_distance", {"floor": "0.2 km"})
    spread = 1 / np.sqrt(np.diag(prior.precision(GRID)))  # type: ignore[attr-defined]
    np.testing.assert_allclose(spread**2 / (GRID.centres**2 + 200.0**2), spread[0] ** 2 / (111.25**2 + 200.0**2))
    assert np.mean(spread**2) == pytest.approx(1)


def test_command_finds_it_sound(tmp_path: Path) -> None:
    done = run("coslidar", "plugins", "check", "coslidar-example-plugin", folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    # Its defaults and two examples; that those can be built is one check.
    checks = 3 * len(CHECKS["regulariser"]) + 1
    assert done.stdout.endswith(f"coslidar-example-plugin 1.0: 1 plugin, {checks} checks passed, 0 failed, 0 exempt\n")


def test_its_own_tests_pass_on_their_own(tmp_path: Path) -> None:
    """With nothing of this repository's configuration of pytest."""
    empty = tmp_path / "pytest.ini"
    empty.write_text("[pytest]\n")
    done = run(sys.executable, "-m", "pytest", "-q", "-c", str(empty), "--rootdir", str(tmp_path), "-p",
               "no:cacheprovider", "--confcutdir", str(FOLDER), str(FOLDER), folder=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{4 * len(CHECKS['regulariser']) + 1} passed" in done.stdout


def test_it_inverts_like_a_built_in_one(tmp_path: Path) -> None:
    """Without data that tell the slices apart the profile is the prior's: proportional to its variance."""
    total = np.ones((6 * 9, 12))
    np.savez(
        tmp_path / "in.npz", M=total, C_mes=np.full(6 * 9, 12.0), C_conv=np.eye(6 * 9), edges=np.asarray(GRID.edges)
    )
    done = run("coslidar", "invert", "in.npz", "--regulariser", "power_of_distance:exponent=2,floor=1 mm",
               "--mu", "1e-3 m^(4/3)", "--noise-bias", "none", "--slope-offset", "none", "-o", "out.npz",
               folder=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "out.npz") as found:
        np.testing.assert_allclose(found["cn2"] / found["cn2"][0], (GRID.centres / GRID.centres[0]) ** 4, rtol=1e-6)
