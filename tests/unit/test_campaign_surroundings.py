"""From the tables of a campaign file to what is known around the path of an archive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coslidar.flows.settings import InputError, load
from coslidar.flows.surroundings import surroundings_of, with_heights
from coslidar.pipeline.beam_heights import sight_heights
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.parameters import Header
from coslidar.pipeline.surroundings import Surroundings

GRID = SliceGrid.uniform(2670.0, 12)
MINUTE = 60 * 10**9
START = int(np.datetime64("2012-09-14T12:00", "ns").astype(int))
WEATHER = '[meteorology]\nfile = "weather.csv"\nwind_height = "10 m"\nroughness_length = "3 cm"\n'
TERRAIN = '[terrain]\nfile = "ground.csv"\npupil_height = "20 m"\nsources_elevation = "625 m"\nrefraction = 1.0\n'
LAS = '[[scintillometers]]\nname = "A"\nwavelength = "0.88 um"\ndiameters = ["5 cm", "14.5 cm"]\n'


def header(path: dict[str, Any], scintillometers: list[dict[str, Any]]) -> Header:
    source = {"fwhm": ["8.9 cm", "6.3 cm"], "spot": [9.95, 15.5]}
    return Header.model_validate(
        {
            "format": "shwfs-frames", "format_version": 1, "campaign": "c", "archive": "a", "path": path,
            "instrument": {
                "wavelength": "3.8 um", "frame_rate": "142 Hz", "pixel_scale": "27 urad", "subaperture_size": "7 cm",
                "subaperture_mask": [[1, 1], [1, 1]], "lenslet_origin": [0, 0], "lenslet_pitch": [32, 32],
            },
            "sources": [
                source | {"name": "b", "position": ["0 m", "0 m"]}, source | {"name": "t", "position": ["0 m", "1 m"]},
            ],
            "scintillometers": scintillometers,
        }
    )  # fmt: skip


def known(folder: Path, campaign: str, path: dict[str, Any] | None = None) -> tuple[Header, Surroundings | None]:
    stamps = [np.datetime64(START + n * MINUTE, "ns").astype("datetime64[s]") for n in range(-5, 30)]
    weather = "time,T [degC],P [hPa],RH [%],wind_speed [m/s],net_radiation [W/m^2],Cn2 [m^(-2/3)]\n"
    (folder / "weather.csv").write_text(weather + "".join(f"{s}Z,20,950,50,3,100,1e-14\n" for s in stamps))
    (folder / "ground.csv").write_text("distance [m],elevation [m]\n0,600\n1335,590\n2670,600\n")
    (folder / "campaign.toml").write_text(campaign)
    settings = load(folder / "campaign.toml")
    made = header(path or {"length": "2670 m"}, settings.header.get("scintillometers", []))
    found = with_heights(made, settings)
    return found, surroundings_of(found, GRID, settings, START, START + 6 * MINUTE)


def test_nothing_said_nothing_known(tmp_path: Path) -> None:
    assert known(tmp_path, "", {"length": "2670 m", "height": "23 m"})[1] is None


def test_everything_said(tmp_path: Path) -> None:
    found, around = known(tmp_path, WEATHER + TERRAIN + LAS + 'series = { file = "weather.csv" }\n')
    assert around is not None
    assert around.heights is not None
    # From 620 m to 625 m, straight, over a ground that falls to 590 m in the middle; h^(-4/3) lies just below the mean.
    z = GRID.centres
    mean = 620 + 5 * z / 2670 - np.where(z < 1335, 600 - 10 * z / 1335, 590 + 10 * (z - 1335) / 1335)
    assert around.heights == pytest.approx(mean, rel=2e-3)
    assert (around.heights < mean).all()
    assert found.path.heights is not None
    assert around.meteorology is not None
    assert len(around.meteorology) == 6  # cut to the archive's time
    assert around.instruments[0].series is not None
    values = around.derive(np.full(12, 2e-14), None, START, START + 3 * MINUTE)
    assert values["cn2_scintillometer"] == pytest.approx([1e-14])
    assert (values["sensible_heat_flux"] > 0).all()
    assert float(values["temperature"]) == pytest.approx(293.15)


def test_heights_of_a_header() -> None:
    level = sight_heights(header({"length": "2670 m", "height": "23 m"}, []).path, GRID)
    assert level is not None
    assert level.effective == pytest.approx(np.full(12, 23.0))
    assert level.borders == pytest.approx(np.full(13, 23.0))
    assert sight_heights(header({"length": "2670 m"}, []).path, GRID) is None
    slope = sight_heights(header({"length": "2670 m", "heights": [["0 m", "8 m"], ["2 km", "28 m"]]}, []).path, GRID)
    assert slope is not None
    assert slope.borders[:9] == pytest.approx(8 + 2.225 * np.arange(9))
    assert np.isnan(slope.borders[9:]).all()
    some = slope.effective
    assert np.isfinite(some).sum() == 8  # the ninth slice reaches beyond the last point
    assert some[:8] == pytest.approx(8 + GRID.centres[:8] / 100, rel=0.01)


@pytest.mark.parametrize(
    ("campaign", "path", "faults"),
    [
        (WEATHER, None, ["heat fluxes need the height above ground"]),
        (
            WEATHER.replace("weather.csv", "none.csv"),
            {"length": "2670 m", "height": "9 m"},
            ["meteorology.file", "no such file"],
        ),
        (WEATHER.replace("weather.csv", "*.dat"), {"length": "2670 m", "height": "9 m"}, ["no file matches"]),
        (
            WEATHER.replace("weather.csv", "ground.csv"),
            {"length": "2670 m", "height": "9 m"},
            ["no column is called 'time'"],
        ),
        (WEATHER.replace("wind_h", "wnd_h"), None, ["meteorology.wnd_height", "there is no such key"]),
        (TERRAIN.replace("20 m", "-1 m"), None, ["terrain.pupil_height"]),
        (TERRAIN.replace("625 m", "580 m"), None, ["below the ground"]),
        (TERRAIN, {"length": "3 km"}, ["the transect runs from 0 m to 2670 m"]),
        (
            LAS + 'offset = "1 s"\nheights = "4 m"\nheight_scaling = "free"\n' + TERRAIN.replace("pupil_h", "pupl_h"),
            None,
            [
                "scintillometers[0].offset = '1 s': 's' is a duration",
                "scintillometers[0].heights = '4 m': it should be a list; write its values in brackets",
                "scintillometers[0].height_scaling = 'free': it should be 'none' or 'free_convection'",
                "terrain.pupl_height",
                "give either pupil_height",
            ],
        ),
        (
            LAS.replace("0.88 um", "0.88") + 'height_scaling = "free_convection"\n',
            None,
            ["the unit is missing", "height_scaling = 'free_convection': it needs heights"],
        ),
        (
            LAS + 'heights = ["2 m", "2 m"]\n',
            {"length": "2670 m", "heights": [["0 m", "20 m"], ["1335 m", "3 m"], ["2670 m", "20 m"]]},
            ["scintillometers[0]: the beam runs", "below the ground"],
        ),
        (
            LAS + 'heights = ["2 m", "9 m"]\nheight_scaling = "free_convection"\n',
            None,
            ["scintillometers[0]: height_scaling needs the height of the line of sight"],
        ),
        (LAS + 'end = "9 km"\n', None, ["scintillometers[0]", "outside the slices"]),
        (LAS + 'series = { file = "weather.csv", columns = { cn2 = "RH" } }\n', None, ["unit of column 'RH'"]),
    ],
)
def test_faults(tmp_path: Path, campaign: str, path: dict[str, Any] | None, faults: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        known(tmp_path, campaign, path)
    for fault in faults:
        assert fault in str(caught.value)
