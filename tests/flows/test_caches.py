"""Compiled kernels where the code cannot be written, as in a container."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from small_runs import environment

#: The code's own folder can be read only; for Numba too, whoever runs this.
READ_ONLY = """
import os
access = os.access
os.access = lambda path, mode: "pipeline" not in str(path) and access(path, mode)
import coslidar.flows
from numba.core import caching
def refuse(self): raise OSError("read-only")
caching.InTreeCacheLocator.ensure_cache_path = refuse
import coslidar.pipeline.window_kernel
print(os.environ.get("NUMBA_CACHE_DIR"))
"""


@pytest.mark.parametrize("home", ["cache", "/dev/null"])
def test_code_that_cannot_be_written_is_loaded(home: str, tmp_path: Path) -> None:
    cache = Path(home) if home.startswith("/") else tmp_path / home
    more = {"XDG_CACHE_HOME": str(cache), "TMPDIR": str(tmp_path)}
    variables = {**environment(cache, **more)}
    variables.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", READ_ONLY], env=variables, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    used = Path(done.stdout.strip())
    if home == "cache":
        assert used == cache / "kernels"
        assert used.is_dir()
    else:
        # No place is left but one of this process's own, and it goes with it.
        assert used.parent == tmp_path
        assert not used.exists()
