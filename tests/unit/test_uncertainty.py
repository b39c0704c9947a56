"""Error bars, averaging kernels and degrees of freedom against dense algebra and against draws."""

from __future__ import annotations

import numpy as np
import pytest

from coslidar.pipeline import inversion, uncertainty
from coslidar.pipeline.geometry import SliceGrid

K = 5
SIZE = 1e-14


@pytest.fixture
def problem():
    rng = np.random.default_rng(3)
    a = rng.standard_normal((40, K)) * np.array([300, 100, 30, 3, 0.3]) / SIZE
    rows = np.diff(np.eye(K), axis=0)
    return inversion.LinearProblem(a, a @ np.full(K, SIZE) + rng.standard_normal(40), rows.T @ rows, 40)


def test_bars_are_the_diagonal_of_the_inverse(problem):
    mu = 1e28
    hessian = (problem.matrix.T @ problem.matrix + mu * problem.precision) * SIZE**2
    covariance = np.linalg.inv(hessian) * SIZE**2
    np.testing.assert_allclose(uncertainty.posterior_covariance(problem, mu), covariance, rtol=1e-9)
    np.testing.assert_allclose(uncertainty.map_error(problem, mu), np.sqrt(np.diag(covariance)), rtol=1e-10)
    likelihood = np.linalg.inv(problem.matrix.T @ problem.matrix * SIZE**2)
    np.testing.assert_allclose(uncertainty.ml_error(problem), np.sqrt(np.diag(likelihood)) * SIZE, rtol=1e-10)


def test_bars_shrink_with_mu_and_never_exceed_the_ml_bars(problem):
    bars = np.array([uncertainty.map_error(problem, mu) for mu in (0.0, 1e25, 1e28, 1e31)])
    assert (np.diff(bars, axis=0) < 0).all()
    np.testing.assert_array_equal(bars[0], uncertainty.ml_error(problem))


def test_bars_describe_draws_from_prior_and_noise():
    """Profiles from the prior, data with unit noise: the linear estimate misses by the MAP bars (mu = 1/sigma^2).

    10,000 draws give a standard deviation to 0.7 %; 3 % is four of that.
    """
    rng = np.random.default_rng(5)
    sigma = 2e-14
    a = rng.standard_normal((20, K)) * np.array([30, 10, 3, 1, 0.3]) / sigma
    misses = np.empty((10_000, K))
    base = inversion.LinearProblem(a, np.zeros(20), np.eye(K), 20)
    for miss, x, u in zip(
        misses, sigma * rng.standard_normal((10_000, K)), rng.standard_normal((10_000, 20)), strict=True
    ):
        draw = inversion.LinearProblem(a, a @ x + u, np.eye(K), 20)
        draw.__dict__["factor"] = base.factor
        miss[:] = inversion.solve_linear(draw, sigma**-2) - x
    np.testing.assert_allclose(misses.std(axis=0), uncertainty.map_error(base, sigma**-2), rtol=0.03)


def test_what_nothing_determines_has_an_infinite_error():
    """Slices 2 and 3 are seen only through their sum."""
    a = np.array([[1.0, 0, 0], [1.0, 1, 1], [0, 2, 2], [0.5, -1, -1]])
    problem = inversion.LinearProblem(a, np.ones(4), np.diag([0.0, 1, 0]), 4)
    sums = np.linalg.inv(np.stack([a[:, 0], a[:, 1]]) @ np.stack([a[:, 0], a[:, 1]]).T)
    error = uncertainty.ml_error(problem)
    assert np.isinf(error[1:]).all()
    assert error[0] == pytest.approx(np.sqrt(sums[0, 0]), rel=1e-12)
    assert np.isfinite(uncertainty.map_error(problem, 1.0)).all(), "a prior on one of them settles the other"


def test_a_slice_without_response_has_an_infinite_error():
    problem = inversion.LinearProblem(np.array([[1.0, 0], [2.0, 0]]), np.ones(2), np.zeros((2, 2)), 2)
    np.testing.assert_allclose(uncertainty.ml_error(problem), [5**-0.5, np.inf])
    np.testing.assert_allclose(uncertainty.averaging_kernel(problem, 1.0), [[1, 0], [0, 0]], atol=1e-14)


def test_kernel_is_the_response_of_the_estimate_to_the_truth(problem):
    mu = 3e27
    columns = []
    for j in range(K):
        nudged = inversion.LinearProblem(
            problem.matrix, problem.data + problem.matrix[:, j] * SIZE, problem.precision, problem.n_data
        )
        columns.append((inversion.solve_linear(nudged, mu) - inversion.solve_linear(problem, mu)) / SIZE)
    kernel = uncertainty.averaging_kernel(problem, mu)
    np.testing.assert_allclose(kernel, np.stack(columns, axis=1), atol=1e-9)
    assert uncertainty.degrees_of_freedom(problem, mu) == pytest.approx(np.trace(kernel), rel=1e-12)


def test_kernel_tends_to_the_identity_without_prior(problem):
    np.testing.assert_allclose(uncertainty.averaging_kernel(problem, 1e15), np.eye(K), atol=1e-6)
    # A gradient prior leaves the mean of the profile free however strong it is.
    assert uncertainty.degrees_of_freedom(problem, 1e45) == pytest.approx(1, abs=1e-6)


def test_resolution_is_the_slice_where_it_is_resolved():
    grid = SliceGrid((0.0, 100.0, 300.0, 400.0))
    np.testing.assert_allclose(uncertainty.resolution_length(np.diag([1.0, 0.5, 0.0]), grid), [100, 400, np.nan])
    # Rounding of the kernel neither sharpens a slice nor gives one that answers the wrong way round a length.
    np.testing.assert_allclose(uncertainty.resolution_length(np.diag([1.1, 1.0, -0.2]), grid), [100, 200, np.nan])


@pytest.mark.parametrize(("area", "expected"), [(1.0, 400.0), (0.8, 400.0), (0.51, 400.0), (0.49, np.nan)])
def test_nothing_stands_for_more_than_the_path(area, expected):
    """A mean over the path is the coarsest estimate; with less than half of it from the data it is the prior's."""
    grid = SliceGrid((0.0, 50.0, 100.0, 300.0, 400.0))
    kernel = area * np.tile(grid.thickness / 400.0, (4, 1))
    np.testing.assert_allclose(uncertainty.resolution_length(kernel, grid), expected, rtol=1e-12)


def test_side_lobes_do_not_take_the_resolution_away():
    """A slice that answers to itself is resolved, whatever a uniform profile would do to it."""
    grid = SliceGrid.uniform(300.0, 3)
    kernel = np.array([[0.8, -0.4, -0.1], [0.5, 0.1, 0.4], [0.1, 0.1, 0.2]])
    np.testing.assert_allclose(uncertainty.resolution_length(kernel, grid), [125, 300, np.nan])


def test_lengths_count_the_degrees_of_freedom(problem):
    """Thickness over length sums up to the degrees of freedom, as long as every slice answers to itself."""
    grid = SliceGrid((0.0, 50.0, 500.0, 1000.0, 1700.0, 2670.0))
    for mu in (1e15, 1e26, 1e28):
        length = uncertainty.resolution_length(uncertainty.averaging_kernel(problem, mu), grid)
        assert (np.asarray(grid.thickness) / length).sum() == pytest.approx(
            uncertainty.degrees_of_freedom(problem, mu), rel=1e-6
        )
