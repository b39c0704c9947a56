"""Fixtures that every suite shares."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

# Before numpy: the suite runs several processes on few cores.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import pytest
from hypothesis import HealthCheck, settings

import coslidar.pipeline

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"

_approx = pytest.approx


def approx(expected: Any, rel: float | None = None, abs: float | None = None, nan_ok: bool = False) -> Any:
    """pytest's own without its absolute tolerance of 1e-12, which makes any Cn2 equal to any other."""
    if abs is None:
        return _approx(expected, rel=1e-6 if rel is None else rel, abs=0.0, nan_ok=nan_ok)
    return _approx(expected, rel=rel, abs=abs, nan_ok=nan_ok)


pytest.approx = approx  # type: ignore[assignment]

settings.register_profile(
    "coslidar", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow], print_blob=True
)
settings.load_profile("coslidar")


def pytest_configure(config: pytest.Config) -> None:
    """Refuse to test an installed copy instead of this checkout."""
    found = Path(coslidar.pipeline.__file__).resolve().parent
    if found != ROOT / "pipeline":
        raise pytest.UsageError(f"coslidar is imported from {found}, not from {ROOT}; run: pip install -e {ROOT}")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of recordings that are no part of the distribution."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip(f"no {folder}: this test needs recordings that are not part of the distribution")
    return folder


@pytest.fixture(scope="session")
def shared_sample(shared_data: Path) -> Path:
    """The wave-optics recording."""
    path = shared_data / "lannemezan-sample.zarr.zip"
    if not path.is_file():
        pytest.skip(f"no {path}")
    return path


@pytest.fixture(scope="session")
def shared_truth(shared_data: Path) -> dict[str, object]:
    """The truth of the wave-optics recording."""
    return json.loads((shared_data / "lannemezan-sample.truth.json").read_text())
