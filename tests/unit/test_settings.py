from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coslidar.flows.settings import InputError, load, overlay, plugin_text, with_plugin
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.parameters import Header

GOOD = """
campaign = "lannemezan-2012"
archives = ["raw/a.zarr.zip", "s3://bucket/b.zarr"]
output = "out"

[batch]
duration = "1 min"

[response]
slices = 10

[source]
name = "gaussian"
fwhm_x = "8.9 cm"

[selector]
name = "fixed"
mu = "1e27 m^(4/3)"
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "campaign.toml"
    path.write_text(text)
    return path


def faults(folder: Path, text: str, **options: object) -> list[str]:
    with pytest.raises(InputError) as error:
        load(write(folder, text), **options)  # type: ignore[arg-type]
    return [fault.removeprefix(f"{folder}/") for fault in error.value.faults]


def test_reads_a_campaign(tmp_path: Path) -> None:
    settings = load(write(tmp_path, GOOD))
    assert settings.campaign == "lannemezan-2012"
    assert settings.archives == (str(tmp_path / "raw/a.zarr.zip"), "s3://bucket/b.zarr")
    assert settings.output == tmp_path / "out"
    assert settings.configuration.batch.duration == 60
    assert settings.configuration.response.slices == 10
    assert settings.plugins["selector"] == {"name": "fixed", "mu": "1e27 m^(4/3)"}
    assert settings.plugins["regulariser"] == {"name": "white"}


def test_command_line_wins(tmp_path: Path) -> None:
    settings = load(
        write(tmp_path, GOOD),
        archives=["c.zarr"],
        output=tmp_path / "else",
        assignments=["batch.duration=2 min", "regulariser=gradient", "response.sampling=midpoint", "response.slices=6"],
        scheduler="tcp://127.0.0.1:1",
    )
    assert settings.archives == ("c.zarr",)
    assert settings.configuration.batch.duration == 120
    assert settings.configuration.response.slices == 6
    assert settings.plugins["regulariser"]["name"] == "gradient"
    assert settings.run.scheduler == "tcp://127.0.0.1:1"


def test_every_fault_of_a_file_at_once(tmp_path: Path) -> None:
    text = """
campaign = "../x"
archives = ["*.nothing"]
[path]
length = "2670 s"
[source]
fwhm_x = "8,9 cm"
[batch]
duration = 180
lenght = "3 min"
[regulariser]
name = "tvv"
[response]
slices = 0
"""
    found = faults(tmp_path, text)
    assert any(f.startswith("campaign.toml: campaign = '../x': use 1 to 100 letters") for f in found)
    assert any("no file or folder matches" in f for f in found)
    assert (
        "campaign.toml: path.length = '2670 s': 's' is a duration, but path.length must be a length (SI unit m), "
        "for example '2670 m', '2.67 km'"
    ) in found
    assert (
        "campaign.toml: source.fwhm_x = '8,9 cm': use a point as decimal sign, not a comma; write '8.9 cm'"
    ) in found
    assert (
        "campaign.toml: batch.duration = 180: the unit is missing. batch.duration is a duration; write '180 s'" in found
    )
    assert "campaign.toml: batch.lenght = '3 min': there is no such key; check its spelling" in found
    assert any(
        f.startswith("campaign.toml: regulariser.name = 'tvv': no regulariser 'tvv'; installed: ")
        and "gradient" in f
        and "white" in f
        for f in found
    )
    assert any(f.startswith("campaign.toml: response.slices = 0: ") for f in found)
    assert len(found) == 8


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("archives = [", "this is no TOML file"),
        ("[regulariser]\nname = 'os:system'\n", "must be the name of an installed plugin"),
        ("[selector]\nname = 'fixed'\nmu = '1e27 m'\n", "'m' is a length, but selector.mu must be a hyperparameter"),
        ("spectrum = 'von_karman:outer_scale'\n", "has no value"),
        ("archives = [1]\n", "must be a list of paths"),
        ("[run]\nthreads = 0\n", "run.threads = 0"),
        ("colour = 'red'\n", "colour = 'red': there is no such key"),
    ],
)
def test_refuses(tmp_path: Path, text: str, message: str) -> None:
    found = faults(tmp_path, text)
    assert len(found) == 1
    assert message in found[0]


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load(tmp_path / "none.toml")


@pytest.mark.parametrize("assignment", ["batch.duration", "=3", "batch..x=1", "campaign.x=1"])
def test_bad_assignments(tmp_path: Path, assignment: str) -> None:
    assert faults(tmp_path, GOOD, assignments=[assignment])


def test_plugin_text() -> None:
    assert plugin_text("hill:inner_scale=5 mm,x=3") == {"name": "hill", "inner_scale": "5 mm", "x": 3}
    with pytest.raises(InputError):
        with_plugin(load(), "spectrum", "von_karman:outer_scale=5 s")


def test_overlay_merges_tables_and_lists_of_tables() -> None:
    base = {"path": {"length": "1 m", "height": "2 m"}, "sources": [{"name": "a", "spot": [1, 2]}, {"name": "b"}]}
    merged = overlay(base, {"path": {"length": "3 m"}, "sources": [{"spot": [3, 4]}, {}]})
    assert merged == {
        "path": {"length": "3 m", "height": "2 m"},
        "sources": [{"name": "a", "spot": [3, 4]}, {"name": "b"}],
    }
    assert base["path"]["length"] == "1 m"  # type: ignore[index]


HEADER = {
    "format": "shwfs-frames",
    "format_version": 1,
    "campaign": "c",
    "archive": "a",
    "instrument": {
        "wavelength": "3.8 um",
        "frame_rate": "142 Hz",
        "pixel_scale": "27 urad",
        "subaperture_size": "7 cm",
        "subaperture_mask": [[1, 1], [1, 1]],
        "lenslet_origin": [0, 0],
        "lenslet_pitch": [32, 32],
    },
    "path": {"length": "2670 m"},
    "sources": [
        {"name": "bottom", "position": ["0 m", "-0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": [9.95, 15.5]},
        {"name": "top", "position": ["0 m", "0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": [21.05, 15.5]},
    ],
}


def test_source_extent_comes_from_the_header_unless_given(tmp_path: Path) -> None:
    header = Header.model_validate(HEADER)
    from_header = load().source_models(header, "a")
    assert [(m.fwhm_x, m.fwhm_y) for m in from_header] == [(0.089, 0.063)] * 2  # type: ignore[attr-defined]
    given = load(assignments=["source.fwhm_y=1 cm"]).source_models(header, "a")
    assert [(m.fwhm_x, m.fwhm_y) for m in given] == [(0.089, 0.01)] * 2  # type: ignore[attr-defined]


def test_sources_at_infinity_are_angles() -> None:
    far = overlay(HEADER, {"path": {"length": "inf m"}})
    far["sources"] = [
        {"name": "star", "position": ["0 rad", "0 rad"], "fwhm": ["2 arcsec", "2 arcsec"], "spot": [9, 9]}
    ]
    (model,) = load().source_models(Header.model_validate(far), "a")
    assert model.fwhm_x == pytest.approx(2 * 4.84814e-6, rel=1e-5)  # type: ignore[attr-defined]


def test_campaign_tables_lie_on_top_of_headers() -> None:
    settings = load(assignments=["path.length=3 km"])
    assert settings.effective_header(HEADER, "a").path.length == 3000
    assert settings.header == {"path": {"length": "3 km"}}


def test_preset_of_the_paper(tmp_path: Path) -> None:
    """Sauvage et al. 2021: moving window, printed slopes, independent frames, white prior, GCV from log mu 25, MAP."""
    settings = load(write(tmp_path, 'preset = "sauvage-2021"'))
    configuration = settings.configuration
    assert configuration.batch.duration == 180
    assert configuration.extraction.method == "moving_maximum"
    assert configuration.correlation.covariance == "independent"
    assert configuration.response.slope_response == "printed"
    assert configuration.response.slices == 12
    assert configuration.inversion.estimator == "map"
    assert configuration.inversion.noise_bias == "joint"
    np.testing.assert_array_equal(settings.regulariser().precision(SliceGrid.uniform(100, 3)), np.eye(3))
    selector = settings.selector()
    assert selector.name == "gcv"
    np.testing.assert_array_equal(selector.log_mu, np.arange(25, 33.25, 0.5))


def test_a_file_wins_over_its_preset(tmp_path: Path) -> None:
    text = """
preset = "sauvage-2021"
selector = "upre"
[response]
sampling = "mean"
[inversion]
slope_offset = "none"
"""
    settings = load(write(tmp_path, text), assignments=["response.slices=8"])
    assert settings.configuration.response.sampling == "mean"
    assert settings.configuration.response.slices == 8
    assert settings.configuration.response.slope_response == "printed"
    assert settings.configuration.inversion.slope_offset == "none"
    assert settings.plugins["selector"] == {"name": "upre"}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ('selector = "gcv"', {"name": "gcv", "log_mu_min": 25.0, "log_mu_max": 33.0, "log_mu_step": 0.5}),
        ('selector = "gcv:log_mu_step=1"', {"name": "gcv", "log_mu_min": 25.0, "log_mu_max": 33.0, "log_mu_step": 1}),
        ("selector = {log_mu_min = 24}", {"name": "gcv", "log_mu_min": 24, "log_mu_max": 33.0, "log_mu_step": 0.5}),
        ('selector = {name = "upre", log_mu_min = 24}', {"name": "upre", "log_mu_min": 24}),
    ],
)
def test_plugin_of_a_preset_keeps_what_is_not_said_anew(tmp_path: Path, given: str, expected: dict[str, Any]) -> None:
    assert load(write(tmp_path, f'preset = "sauvage-2021"\n{given}')).plugins["selector"] == expected


def test_preset_from_the_command_line() -> None:
    settings = load(assignments=["preset=sauvage-2021"])
    assert settings.configuration.correlation.covariance == "independent"


def test_unknown_preset_is_named(tmp_path: Path) -> None:
    assert faults(tmp_path, 'preset = "sauvage"') == [
        "campaign.toml: preset = 'sauvage': there is no such preset; known: sauvage-2021"
    ]
