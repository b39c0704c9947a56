"""Properties the inversion has for any problem."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize

from coslidar.pipeline import inversion, uncertainty


@st.composite
def problems(draw):
    k = draw(st.integers(1, 8))
    n = draw(st.integers(k + 1, 30))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spread = draw(st.floats(0, 4))
    a = rng.standard_normal((n, k)) * 10 ** (rng.uniform(-spread, 0, k)) * 1e14
    truth = 1e-14 * np.clip(rng.standard_normal(k), 0, None) * 10 ** draw(st.floats(-1, 2))
    rows = rng.standard_normal((draw(st.integers(0, k)), k))
    precision = rows.T @ rows + (draw(st.booleans())) * np.eye(k)
    return inversion.LinearProblem(a, a @ truth + rng.standard_normal(n), (precision + precision.T) / 2, n)


@settings(deadline=None, max_examples=150)
@given(problems(), st.floats(23, 33))
def test_positive_solution_is_optimal(problem, log_mu):
    mu = 10**log_mu
    x = inversion.solve_positive(problem, mu)
    slope = problem.matrix.T @ (problem.matrix @ x - problem.data) + mu * problem.precision @ x
    # Rounding in each term of the gradient, of which the two parts cancel.
    size = (
        np.linalg.norm(problem.matrix, axis=0) * (np.linalg.norm(problem.data) + np.linalg.norm(problem.matrix @ x))
        + mu * np.abs(problem.precision) @ x
    )
    assert (x >= 0).all()
    assert (np.abs(slope[x > 0]) <= 1e-11 * size[x > 0]).all()
    assert (slope[x == 0] >= -1e-11 * size[x == 0]).all()


@settings(deadline=None, max_examples=60)
@given(problems(), st.floats(24, 30))
def test_positive_solution_is_that_of_bounded_least_squares(problem, log_mu):
    values, vectors = np.linalg.eigh(problem.precision)
    factor = (vectors * np.sqrt(np.clip(values, 0, None))).T
    unit = 1 / np.linalg.norm(np.concatenate([problem.matrix, 10 ** (log_mu / 2) * factor]), axis=0)
    stacked = np.concatenate([problem.matrix, 10 ** (log_mu / 2) * factor]) * unit
    target = np.concatenate([problem.data, np.zeros(problem.k)])
    reference = optimize.lsq_linear(stacked, target, (0, np.inf), method="bvls", tol=1e-15)
    found = inversion.solve_positive(problem, 10**log_mu) / unit
    condition = np.linalg.cond(stacked)
    np.testing.assert_allclose(found, reference.x, atol=1e-14 * condition**2 * max(np.abs(found).max(), 1e-3) + 1e-12)


@settings(deadline=None, max_examples=60)
@given(problems(), st.floats(24, 30), st.floats(-3, 3))
def test_units_of_the_profile_only_move_mu(problem, log_mu, shift):
    factor = 10.0**shift
    other = inversion.LinearProblem(problem.matrix / factor, problem.data, problem.precision, problem.n_data)
    moved = log_mu - 2 * shift
    a, b = inversion.solve_positive(problem, 10**log_mu), inversion.solve_positive(other, 10**moved) / factor
    np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9 * a.max(initial=1e-20))
    for curve in (inversion.gcv, inversion.evidence, inversion.upre):
        np.testing.assert_allclose(curve(problem, log_mu), curve(other, moved), rtol=1e-6, atol=1e-6)


@settings(deadline=None, max_examples=60)
@given(problems())
def test_misfit_grows_and_freedom_shrinks_with_mu(problem):
    grid = inversion.log_mu_grid(20, 36)
    misfit = inversion.misfit(problem, grid)
    freedom = [uncertainty.degrees_of_freedom(problem, mu) for mu in 10**grid]
    assert (np.diff(misfit) >= -1e-10 * misfit[1:]).all()
    assert (np.diff(freedom) <= 1e-10).all()
    assert -1e-10 <= freedom[-1] <= freedom[0] <= problem.k + 1e-10


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.permutations(range(18)))
def test_order_of_rows_does_not_matter(seed, order):
    rng = np.random.default_rng(seed)
    matrix, data = rng.uniform(size=(18, 3)), rng.standard_normal(18)
    root = rng.standard_normal((18, 18))
    covariance = root @ root.T + np.eye(18)
    order = np.array(order)
    profiles = []
    for rows in (np.arange(18), order):
        reduction = inversion.prepare(
            data[rows], covariance[np.ix_(rows, rows)], matrix[rows], noise_bias=False, slope_offset=False
        )
        assert reduction.n_data == 18
        profiles.append(inversion.solve_positive(reduction.problem(data[rows], np.eye(3)), 0.1))
    np.testing.assert_allclose(profiles[0], profiles[1], rtol=1e-8, atol=1e-10)
