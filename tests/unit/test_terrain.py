"""Heights of the line of sight above the ground, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.terrain import Beam, Transect, beam_above_ground, heights, slice_heights

FLAT = Transect(np.array([-100.0, 3000.0]), np.array([600.0, 600.0]))
GRID = SliceGrid.uniform(2670.0, 12)


def test_flat_ground_and_the_curved_earth() -> None:
    beam = beam_above_ground(FLAT, 2670.0, 23.0, 23.0, refraction=0.0)
    middle = heights(FLAT, beam, np.array([0.0, 1335.0, 2670.0]))
    # The sagitta of an arc, R (1 - cos(L / 2R)), of the mean Earth.
    sagitta = 6.371e6 * (1 - np.cos(1335.0 / 6.371e6))
    assert middle == pytest.approx([23.0, 23.0 - sagitta, 23.0], abs=1e-6)
    assert 23 - heights(FLAT, beam_above_ground(FLAT, 2670.0, 23.0, 23.0), np.array([1335.0]))[0] == pytest.approx(
        0.87 * sagitta, rel=1e-6
    )


def test_slices_of_a_slope() -> None:
    beam = Beam(2670.0, 610.0, 650.0, refraction=1.0)  # straight over the datum
    centre = 610 + 40 * GRID.centres / 2670 - 600
    assert slice_heights(FLAT, beam, GRID) == pytest.approx(centre, rel=1e-12)
    # The mean of h^(-4/3) from a to b in closed form: 3 (a^(-1/3) - b^(-1/3)) / (b - a).
    ends = 10 + 40 * np.array(GRID.edges) / 2670
    a, b = ends[:-1], ends[1:]
    closed = (3 * (a ** (-1 / 3) - b ** (-1 / 3)) / (b - a)) ** (-3 / 4)
    assert slice_heights(FLAT, beam, GRID, exponent=-4 / 3) == pytest.approx(closed, rel=1e-9)
    assert (closed < centre).all()


def test_kinks_of_the_ground_are_kept() -> None:
    ridge = Transect(np.array([0.0, 100.0, 111.25, 122.0, 2670.0]), np.array([0.0, 0.0, 9.0, 0.0, 0.0]))
    beam = Beam(2670.0, 10.0, 10.0, refraction=1.0)
    # A triangle of 22 m by 9 m in a slice of 222.5 m.
    assert slice_heights(ridge, beam, GRID)[0] == pytest.approx(10 - 22 * 9 / 2 / 222.5, rel=1e-12)


def test_what_is_not_known_is_nan() -> None:
    beam = Beam(2670.0, 10.0, 10.0)
    short = Transect(np.array([0.0, 1500.0]), np.array([0.0, 0.0]))
    found = slice_heights(short, beam, GRID)
    assert np.isfinite(found[:6]).all()
    assert np.isnan(found[6:]).all()
    hill = Transect(np.array([0.0, 300.0, 330.0, 360.0, 2670.0]), np.array([0.0, 0.0, 20.0, 0.0, 0.0]))
    assert np.isnan(slice_heights(hill, beam, GRID)).tolist() == [False, True, *[False] * 10]
    assert heights(hill, beam, np.array([330.0]))[0] < 0


@pytest.mark.parametrize(
    ("distance", "elevation", "fault"),
    [
        ([0.0], [1.0], "at least two"),
        ([0.0, 1.0], [1.0], "an elevation for each"),
        ([0.0, 0.0], [1.0, 2.0], "must increase"),
        ([0.0, 1.0], [1.0, np.nan], "finite"),
    ],
)
def test_faults_of_a_transect(distance: list[float], elevation: list[float], fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        Transect(np.array(distance), np.array(elevation))
