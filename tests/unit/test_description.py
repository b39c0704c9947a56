"""What a product says once: values by hand, and that everything fits the schema."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from coslidar.pipeline import batch, description
from coslidar.pipeline.geometry import MAP_KINDS, Geometry, SliceGrid
from coslidar.pipeline.parameters import Header, InversionParameters
from coslidar.pipeline.products import COORDINATES, SCHEMA
from coslidar.pipeline.units import faults
from coslidar.plugins.hyperparameter_selectors import GCV
from coslidar.plugins.regularisers import White

MASK = [[0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [1, 1, 0, 1, 1], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0]]


def header(**changes: Any) -> Header:
    content = {
        "format": "shwfs-frames",
        "format_version": 1,
        "campaign": "c",
        "archive": "a",
        "instrument": {
            "wavelength": "3.8 um", "frame_rate": "142 Hz", "pixel_scale": "27 urad", "subaperture_size": "7 cm",
            "subaperture_mask": MASK, "lenslet_origin": [0, 0], "lenslet_pitch": [32, 32],
        },
        "path": {"length": "2670 m", "heights": [["0 m", "8 m"], ["2 km", "28 m"]]},
        "sources": [
            {"name": "bottom", "position": ["0 m", "-0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": [9.95, 15.5]},
            {"name": "top", "position": ["0 m", "0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": [21.05, 15.5]},
        ],
        "scintillometers": [
            {"name": "A", "wavelength": "0.88 um", "diameters": ["5 cm", "14.5 cm"]},
            {"name": "B", "wavelength": "0.88 um", "diameters": ["14.5 cm", "14.5 cm"]},
        ],
    }  # fmt: skip
    return Header.model_validate(content | changes)


def described(given: Header, sources: int = 2) -> dict[str, np.ndarray]:
    grid = SliceGrid.uniform(2670.0, 12)
    whole = given.geometry()
    geometry = Geometry(whole.mask, whole.subaperture_size, 2670.0, whole.wavelength, whole.positions[:sources])
    matrix = np.arange(6 * 81 * 12, dtype=float).reshape(-1, 12)
    model = batch.Model(geometry, grid, matrix, "mean", White(), GCV(), InversionParameters(),
                        description.scintillometer_weights(given, grid, "mean"))  # fmt: skip
    return description.describe(model, given)


def test_everything_fits_the_schema() -> None:
    found = described(header())
    sizes = {"z": 12, "dy": 9, "dx": 9, "slope_kind": 4, "intensity_kind": 2, "bound": 2, "scintillometer": 2,
             "frequency": 142}  # fmt: skip
    for name, value in found.items():
        promised = COORDINATES.get(name) or SCHEMA[name]
        assert value.shape == tuple(sizes[dim] for dim in promised.dims), name
        assert value.dtype == promised.dtype, name
    of_surroundings = {name for name in SCHEMA if name.startswith("comparison_")} | {"effective_height"}
    assert {name for name, variable in SCHEMA.items() if "time" not in variable.dims} - of_surroundings <= set(found)


def test_numbers_by_hand() -> None:
    """Sauvage et al. 2021, Eqs. (3) and (5): (D - d) L / (D - d + s) and d L / (d + s), D = 35 cm, s = 80 cm."""
    found = described(header())
    assert found["z_max"] == pytest.approx(0.28 * 2670 / 1.08, rel=1e-12)
    assert found["z_first"] == pytest.approx(0.07 * 2670 / 0.87, rel=1e-12)
    # Half way, at z = 1223.75 and 1446.25 m, lambda z L / (L - z) with lambda = 3.8 um.
    assert found["fresnel_scale"][5] == pytest.approx(np.sqrt(3.8e-6 * 1223.75 * 2670 / 1446.25), rel=1e-12)
    assert (np.diff(found["fresnel_scale"]) > 0).all()
    # 8 m at the pupil, 10 m more per kilometre, unknown beyond 2 km.
    z = found["z"]
    np.testing.assert_allclose(found["height_above_ground"][z < 2000], 8 + z[z < 2000] / 100)
    assert np.isnan(found["height_above_ground"][z > 2000]).all()
    np.testing.assert_allclose(found["scintillometer_weight"].sum(axis=1), 1)
    # Equal apertures weigh symmetrically, a smaller one pulls the weight to its end (Sauvage et al. 2021, Fig. 12).
    np.testing.assert_allclose(found["scintillometer_weight"][1], found["scintillometer_weight"][1][::-1], rtol=1e-5)
    assert found["scintillometer_weight"][0] @ z < 2670 / 2


def test_responses_are_rows_of_the_matrix() -> None:
    found = described(header())
    row = MAP_KINDS.index("ii_auto") * 81 + 40
    np.testing.assert_array_equal(found["response_intensity"][0, 4, 4], row * 12 + np.arange(12))
    row = MAP_KINDS.index("yy_cross") * 81 + 9 * 7 + 1
    np.testing.assert_array_equal(found["response_slope"][3, 7, 1], row * 12 + np.arange(12))


def test_one_source_has_no_triangulation() -> None:
    found = described(header(), sources=1)
    assert np.isnan(found["z_max"])
    assert np.isnan(found["z_first"])


def test_what_the_header_does_not_say_is_left_out() -> None:
    found = described(header(path={"length": "2670 m"}, scintillometers=[]))
    assert not {"height_above_ground", "scintillometer_weight"} & set(found)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"path": {"length": "2670 m", "heights": [["0 m", "8 m"], ["0 m", "9 m"]]}}, "increasing distance"),
        ({"path": {"length": "2670 m", "heights": [["0 m", "8 m"]]}}, "at least two pairs"),
        ({"path": {"length": "2670 m", "heights": [["0 m", "8 m"], ["1 km", "0 m"]]}}, "greater than 0"),
        ({"path": {"length": "2670 m", "heights": [["0 m", 8], ["1 km", "9 m"]]}}, "unit is missing"),
        ({"scintillometers": [{"name": "A", "wavelength": "0.88 um"}]}, "diameters"),
        ({"scintillometers": [{"name": "A", "wavelength": "0.88 um", "diameters": ["5 cm", "5 cm"]}] * 2}, "one name"),
    ],
)
def test_refused_headers(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        header(**changes)
    assert message in " ".join(faults(caught.value, "header"))


def test_what_enters_a_product_is_tracked() -> None:
    tracked = [description.tracked(given) for given in (header(), header(scintillometers=[]), header(
        path={"length": "2670 m"}))]  # fmt: skip
    assert all(a != b for a, b in pairwise(tracked))
