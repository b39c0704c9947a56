"""Folders for what can be made again: response matrices, the Prefect server's database, compiled kernels."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path


def cache_folder() -> Path:
    """Folder for what can be made again: COSLIDAR_HOME, or a folder in the user's cache."""
    if given := os.environ.get("COSLIDAR_HOME"):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "coslidar"


def keep_kernels() -> None:
    """Give Numba a folder for compiled kernels where the code cannot be written, as in a container's image.

    Numba keeps them beside the code; where neither that nor the user's cache can be written, it refuses to load the
    code at all. To be called before the kernels are imported.
    """
    beside = Path(__file__).resolve().parents[1] / "pipeline" / "__pycache__"
    if "NUMBA_CACHE_DIR" in os.environ or os.access(beside if beside.is_dir() else beside.parent, os.W_OK):
        return
    folder = cache_folder() / "kernels"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        usable = os.access(folder, os.W_OK)
    except OSError:
        usable = False
    if not usable:
        # Of this process alone: kernels are code, and nobody else is to put some there.
        folder = Path(tempfile.mkdtemp(prefix="coslidar-kernels-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
