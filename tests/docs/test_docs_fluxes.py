"""The page on scintillometers and heat fluxes (docs/fluxes.md), executed with the records that it names."""

from __future__ import annotations

from pathlib import Path

import pytest
from page_blocks import ROOT, Runner, blocks, environment

PAGE = ROOT / "docs" / "fluxes.md"


@pytest.mark.slow
def test_the_page_from_series_to_fluxes(shared_data: Path, tmp_path: Path) -> None:
    records = shared_data / "real"
    for name in ("read-mnd/2017-04-01.mnd", "read-mnd/2017-04-03.mnd", "otbench/usna_cn2_sm.nc"):
        if not (records / name).is_file():
            pytest.skip(f"no {records / name}: it is not part of the distribution")
    (tmp_path / "records").symlink_to(records)
    runner = Runner(tmp_path, environment(tmp_path / "cache"))
    for block in blocks(PAGE):
        try:
            runner.run(block)
        except AssertionError as error:
            raise AssertionError(f"docs/fluxes.md, line {block.line}:\n{error}") from None
    assert (tmp_path / "season.svg").read_text().startswith("<?xml")
    head, *rows = (tmp_path / "season.csv").read_text().splitlines()
    assert head.startswith("scintillometer,time [UTC]")
    # Three months of hours.
    assert sum(row.startswith("B,") for row in rows) > 2000
    assert "Do profiles and scintillometers agree?" in (tmp_path / "report.html").read_text()
