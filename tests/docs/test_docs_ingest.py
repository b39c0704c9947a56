"""The page on bringing recordings in (docs/ingest.md), executed with frames that its header describes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from page_blocks import ROOT, Runner, blocks, environment

PAGE = ROOT / "docs" / "ingest.md"


def frames(path: Path, number: int) -> None:
    """A FITS file of the size that the page's header gives, with two spots where it says they are."""
    fits = pytest.importorskip("astropy.io.fits")
    random = np.random.default_rng(number)
    y, x = np.mgrid[:160, :160] % 32
    mask = np.kron([[0, 1, 1, 1, 0], [1] * 5, [1, 1, 0, 1, 1], [1] * 5, [0, 1, 1, 1, 0]], np.ones((32, 32)))
    spots = sum(np.exp(-((y - row) ** 2 + (x - 15.5) ** 2) / 8) for row in (9.95, 21.05))
    mean = 500 + 3000 * mask * spots
    fits.PrimaryHDU(random.poisson(mean, (40, 160, 160)).astype(np.uint16)).writeto(path)


@pytest.mark.slow
def test_the_page_from_frames_to_an_archive(tmp_path: Path) -> None:
    frames(tmp_path / "frames.fits", 1)
    fits = pytest.importorskip("astropy.io.fits")
    fits.PrimaryHDU(np.full((4, 160, 160), 500, np.uint16)).writeto(tmp_path / "dark.fits")
    runner = Runner(tmp_path, environment(tmp_path / "cache"))
    # The header stands below the commands that use it.
    order = sorted(blocks(PAGE), key=lambda block: block.file is None)
    for block in order:
        runner.run(block)
    said = runner.shell("coslidar inspect raw/evening.zarr.zip")
    assert re.search(r"frames +40\b", said), said
    assert (tmp_path / "grid.png").read_bytes()[:4] == b"\x89PNG"
