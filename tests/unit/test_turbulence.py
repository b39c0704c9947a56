"""Integrated quantities against numbers of the paper, closed forms and plain quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from coslidar.pipeline.geometry import Geometry, SliceGrid
from coslidar.pipeline.turbulence import (
    fried_parameter,
    is_weak,
    path_average,
    point_source_index,
    point_source_weights,
    resolution,
    scintillation_index,
    z_max,
)

MASK = ((1,) * 5,) * 5
SCINDAR = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
GRID = SliceGrid.uniform(2670.0, 12)
RNG = np.random.default_rng(3)
CN2 = RNG.exponential(1e-14, 12)
K = 2 * np.pi / 3.8e-6


def test_range_and_resolution_of_the_paper() -> None:
    assert z_max(SCINDAR) == pytest.approx(692, abs=0.5)
    assert resolution(SCINDAR) == pytest.approx(214.8, abs=0.1)


def test_range_and_resolution_of_other_geometries() -> None:
    tall = Geometry(((1, 1),) * 4, 0.1, 1000.0, 1e-6, ((0.0, 0.0), (0.5, 0.2)))
    # Along x one subaperture and 0.5 m, along y three and 0.2 m: x leaves the pupil first.
    assert z_max(tall) == pytest.approx(1000 * 0.1 / 0.6)
    assert resolution(tall) == pytest.approx(1000 * 0.1 / 0.6)
    stars = Geometry(MASK, 0.1, math.inf, 1e-6, ((0.0, 0.0), (0.0, 5e-5)))
    assert z_max(stars) == pytest.approx(8000)
    one = Geometry(MASK, 0.1, 1000.0, 1e-6, ((0.0, 0.0),))
    assert math.isnan(z_max(one))
    assert math.isnan(resolution(one))


@pytest.mark.parametrize("length", [2670.0, 3000.0])
def test_fried_parameter_by_quadrature(length: float) -> None:
    total = sum(
        c * quad(lambda z: (1 - z / length) ** (5 / 3), a, b)[0]
        for c, a, b in zip(CN2, GRID.edges[:-1], GRID.edges[1:], strict=True)
    )
    assert fried_parameter(CN2, GRID, 3.8e-6, length) == pytest.approx((0.423 * K**2 * total) ** -0.6, rel=1e-9)


def test_fried_parameter_of_plane_waves_and_of_no_turbulence() -> None:
    plane = (0.423 * K**2 * CN2.sum() * 222.5) ** -0.6
    assert fried_parameter(CN2, GRID, 3.8e-6, 2670.0, wave="plane") == pytest.approx(plane)
    assert fried_parameter(CN2, GRID, 3.8e-6, math.inf) == pytest.approx(plane)
    assert fried_parameter(np.zeros(12), GRID, 3.8e-6, 2670.0) == math.inf
    many = fried_parameter(np.stack([CN2, 2 * CN2]), GRID, 3.8e-6, 2670.0)
    assert many[0] / many[1] == pytest.approx(2**0.6)


def test_fried_parameter_of_the_sample(shared_truth: dict[str, object]) -> None:
    found = fried_parameter(np.array(shared_truth["cn2"]), GRID, 3.8e-6, 2670.0, sampling="midpoint")
    assert found == pytest.approx(shared_truth["r0_spherical_m"], rel=1e-6)


def test_point_source_index_of_a_uniform_path() -> None:
    # Andrews and Phillips: 0.4 times the Rytov variance 1.23 Cn2 k^(7/6) L^(11/6) of a plane wave.
    cn2 = np.full(12, 1e-15)
    rytov = 1.23 * 1e-15 * K ** (7 / 6) * 2670 ** (11 / 6)
    assert point_source_index(cn2, GRID, 3.8e-6, 2670.0) == pytest.approx(0.4 * rytov, rel=0.015)
    assert point_source_index(cn2, GRID, 3.8e-6, math.inf) == pytest.approx(rytov, rel=0.005)


@pytest.mark.parametrize("length", [2670.0, math.inf])
def test_point_source_weights_by_quadrature(length: float) -> None:
    found = point_source_weights(GRID, 3.8e-6, length)
    expected = [
        2.2522625 * K ** (7 / 6) * quad(lambda z: (z * (1 - z / length)) ** (5 / 6), a, b)[0]
        for a, b in zip(GRID.edges[:-1], GRID.edges[1:], strict=True)
    ]
    assert np.allclose(found, expected, rtol=1e-6)
    middle = point_source_weights(GRID, 3.8e-6, length, sampling="midpoint")
    z = GRID.centres
    assert np.allclose(middle, 2.2522625 * K ** (7 / 6) * (z * (1 - z / length)) ** (5 / 6) * 222.5, rtol=1e-6)


def test_scintillation_index_reads_the_zero_separation() -> None:
    matrix = RNG.standard_normal((486, 12))
    assert scintillation_index(CN2, matrix, SCINDAR) == pytest.approx(matrix[4 * 81 + 40] @ CN2)
    assert scintillation_index(np.stack([CN2, CN2]), matrix, SCINDAR).shape == (2,)


def test_weak_turbulence() -> None:
    assert is_weak(0.1) is True
    assert is_weak(0.9) is False
    assert is_weak(math.nan) is False
    assert is_weak(np.array([0.1, 0.9])).tolist() == [True, False]
    assert is_weak(0.9, limit=1.0) is True


def test_path_average() -> None:
    assert path_average(CN2, GRID.thickness) == pytest.approx(CN2.mean())
    weights = np.zeros(12)
    weights[3] = 2.0
    assert path_average(np.stack([CN2, 2 * CN2]), weights) == pytest.approx([CN2[3], 2 * CN2[3]])
    with pytest.raises(ValueError, match="positive sum"):
        path_average(CN2, np.zeros(12))
