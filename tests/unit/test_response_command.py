"""The command that writes a response matrix: its options reach the model, and its faults say what to write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from archives import small_header, write_small
from click.testing import CliRunner

from coslidar.flows.commands.science import response
from coslidar.flows.settings import InputError
from coslidar.pipeline.band import Band
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.parameters import Header
from coslidar.pipeline.response import response_matrix
from coslidar.plugins.contract import SourceModelBase
from coslidar.plugins.source_models import Disc, Image
from coslidar.plugins.turbulence_spectra import Hill

COMMON = ["--slices", "1", "--sampling", "midpoint", "-o", "response.npz"]


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    return str(write_small(tmp_path / "small.zarr"))


LAMP = ((1.0, 2.0), (0.0, 3.0))


@pytest.mark.parametrize(
    ("written", "source"),
    [
        ("disc:diameter=10 cm", Disc(diameter="10 cm")),
        pytest.param(
            "image:file=lamp.npy,pixel_size=3 cm", Image(pixel_size="3 cm", intensity=LAMP), marks=pytest.mark.slow
        ),
    ],
)
def test_every_option_reaches_the_matrix(archive: str, written: str, source: SourceModelBase) -> None:
    np.save("lamp.npy", LAMP)
    options = ["--archive", archive, *COMMON, "--spectrum", "hill:inner_scale=5 mm", "--band", "3.4 um:4.2 um",
               "--aperture", "circular", "--tilt", "zernike", "--slope-response", "printed",
               "--source", written]  # fmt: skip
    result = CliRunner().invoke(response, options, catch_exceptions=False)
    assert result.exit_code == 0
    made = np.load("response.npz")
    geometry = Header.model_validate(small_header()).geometry()
    expected = response_matrix(
        geometry,
        SliceGrid.uniform(geometry.path_length, 1),
        Hill(inner_scale="5 mm"),
        [source] * geometry.n_sources,
        sampling="midpoint",
        slope_response="printed",
        aperture="circular",
        tilt="zernike",
        band=Band((3.4e-6, 4.2e-6), (1.0, 1.0)),
    )
    np.testing.assert_array_equal(made["M"], expected)
    assert {name: str(made[name]) for name in ("aperture", "tilt", "band", "slope_response")} == {
        "aperture": "circular",
        "tilt": "zernike",
        "band": "3.4 um to 4.2 um, flat",
        "slope_response": "printed",
    }


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (["--band", "3.4:4.2"], "the unit is missing"),
        (["--band", "1 um:2 um"], "does not hold instrument"),
        (["--spectrum", "hill:inner_scale=5 s"], "'s' is a duration"),
        (["--spectrum", "hill"], "inner_scale is missing"),
        (["--source", "image:file=none.npy,pixel_size=1 cm"], "none.npy"),
    ],
)
def test_faults_are_told_and_nothing_is_written(archive: str, option: list[str], message: str) -> None:
    result = CliRunner().invoke(response, ["--archive", archive, *COMMON, *option])
    assert isinstance(result.exception, InputError)
    assert any(message in fault for fault in result.exception.faults)
    assert not Path("response.npz").exists()
