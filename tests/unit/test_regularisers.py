"""Built-in priors against the sums and integrals that define them."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from coslidar.pipeline.geometry import SliceGrid
from coslidar.plugins.regularisers import (
    Exponential,
    Gradient,
    Laplacian,
    WeightedLaplacian,
    White,
    WhiteGradient,
)

GRID = SliceGrid.uniform(2670.0, 12)
UNEVEN = SliceGrid(tuple(2670.0 * (np.arange(401) / 400) ** 1.5))
X = np.random.default_rng(0).uniform(size=12)
ALL = (White(), Gradient(), Laplacian(), WeightedLaplacian(), WhiteGradient(ratio=3), Exponential(length="500 m"))


def energy(regulariser, x, grid=GRID):
    return x @ regulariser.precision(grid) @ x


@pytest.mark.parametrize("regulariser", ALL, ids=lambda r: r.name)
@pytest.mark.parametrize("grid", [GRID, UNEVEN, SliceGrid.uniform(100, 2), SliceGrid.uniform(100, 1)])
def test_precision_is_symmetric_and_not_negative(regulariser, grid):
    precision = regulariser.precision(grid)
    assert precision.shape == (grid.k, grid.k)
    np.testing.assert_allclose(precision, precision.T, atol=1e-14 * max(np.abs(precision).max(), 1))
    values = np.linalg.eigvalsh(precision)
    assert values[0] >= -1e-12 * max(values[-1], 1)


def test_white_is_the_sum_of_squares():
    assert energy(White(), X) == pytest.approx(np.sum(X**2), rel=1e-14)


def test_gradient_is_the_sum_of_squared_steps():
    assert energy(Gradient(), X) == pytest.approx(np.sum((X[1:] - X[:-1]) ** 2), rel=1e-13)
    assert energy(Gradient(), np.ones(12)) == pytest.approx(0, abs=1e-14)


def test_laplacian_is_the_sum_of_squared_bends():
    assert energy(Laplacian(), X) == pytest.approx(np.sum((X[2:] - 2 * X[1:-1] + X[:-2]) ** 2), rel=1e-13)
    assert energy(Laplacian(), 3 + 2 * GRID.centres) == pytest.approx(0, abs=1e-9)


def test_unequal_slices_approximate_the_same_integrals():
    """x = sin(z / a) over 400 uneven slices: h int x'^2 dz and h^3 int x''^2 dz to 1 %, the size of a slice."""
    a, z = 300.0, UNEVEN.centres
    h, fine = np.diff(z).mean(), np.linspace(0, 2670, 100_001)
    first = h * np.trapezoid((np.cos(fine / a) / a) ** 2, fine)
    second = h**3 * np.trapezoid((np.sin(fine / a) / a**2) ** 2, fine)
    assert energy(Gradient(), np.sin(z / a), UNEVEN) == pytest.approx(first, rel=0.01)
    assert energy(Laplacian(), np.sin(z / a), UNEVEN) == pytest.approx(second, rel=0.01)
    assert energy(Laplacian(), z, UNEVEN) == pytest.approx(0, abs=1e-9 * energy(Gradient(), z, UNEVEN))


def test_white_gradient_is_the_sum():
    expected = np.eye(12) + 0.3 * Gradient().precision(GRID)
    np.testing.assert_allclose(WhiteGradient(ratio=0.3).precision(GRID), expected, rtol=1e-14)


@pytest.mark.parametrize("grid", [GRID, SliceGrid((0.0, 100, 150, 900, 1000))])
def test_exponential_is_the_inverse_of_its_covariance(grid):
    z = grid.centres
    covariance = np.exp(-np.abs(z[:, None] - z) / 400.0)
    precision = Exponential(length="400 m").precision(grid)
    np.testing.assert_allclose(precision @ covariance, np.eye(grid.k), atol=1e-12)


def test_exponential_runs_from_white_to_gradient():
    np.testing.assert_allclose(Exponential(length="1 m").precision(GRID), np.eye(12), atol=1e-12)
    long = Exponential(length="2.225e8 m").precision(GRID) * 2 * 222.5 / 2.225e8
    np.testing.assert_allclose(long, Gradient().precision(GRID), atol=3e-6)


def test_weights_let_the_profile_bend_where_the_reference_is_strong():
    weighted = WeightedLaplacian(reference_z=("0 m", "2670 m"), reference_cn2=("1e-13 m^(-2/3)", "1e-15 m^(-2/3)"))
    strength = 10 ** (-13 - 2 * GRID.centres / 2670)
    weight = strength / np.sqrt(np.mean(strength**2))
    bends = (X[2:] - 2 * X[1:-1] + X[:-2]) / weight[1:-1]
    assert energy(weighted, X) == pytest.approx(np.sum(bends**2), rel=1e-12)


def test_level_of_the_reference_does_not_matter():
    def precision(level):
        reference = (f"{level} m^(-2/3)", f"{level / 7} m^(-2/3)")
        return WeightedLaplacian(reference_z=("0 m", "2 km"), reference_cn2=reference).precision(GRID)

    np.testing.assert_allclose(precision(1e-13), precision(1e-17), rtol=1e-10)
    np.testing.assert_array_equal(WeightedLaplacian().precision(GRID), Laplacian().precision(GRID))


@pytest.mark.parametrize("kind", [White, Gradient, Laplacian, WeightedLaplacian, WhiteGradient, Exponential])
def test_scale_divides_the_profile(kind):
    scale = tuple(np.linspace(0.5, 3, 12))
    assert energy(kind(scale=scale), X) == pytest.approx(energy(kind(), X / np.array(scale)), rel=1e-12)
    with pytest.raises(ValueError, match="scale has 12 values, the profile 4 slices"):
        kind(scale=scale).precision(SliceGrid.uniform(100, 4))


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        (White, {"scale": (1.0, 0.0)}, "above 0"),
        (Exponential, {"length": "0 m"}, "greater than 0"),
        (Exponential, {"length": 300}, "unit is missing"),
        (Exponential, {"length": "3 s"}, "duration"),
        (WhiteGradient, {"ratio": -1}, "greater than or equal to 0"),
        (WeightedLaplacian, {"reference_z": ("1 m",)}, "one Cn2 for each distance"),
        (WeightedLaplacian, {"reference_z": ("1 m",), "reference_cn2": ("0 m^(-2/3)",)}, "above 0"),
        (
            WeightedLaplacian,
            {"reference_z": ("2 m", "1 m"), "reference_cn2": ("1 m^(-2/3)", "1 m^(-2/3)")},
            "must increase",
        ),
        (White, {"scales": (1.0,)}, "Extra inputs"),
    ],
)
def test_wrong_parameters_are_refused(kind, parameters, message):
    with pytest.raises(ValidationError) as caught:
        kind(**parameters)
    assert message in str(caught.value)
