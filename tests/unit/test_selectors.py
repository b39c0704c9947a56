"""Criteria for mu against their definitions, and what the selectors make of them."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from coslidar.pipeline import inversion
from coslidar.plugins.hyperparameter_selectors import (
    GCV,
    UPRE,
    Discrepancy,
    Evidence,
    Fixed,
    LCurve,
    PositiveEvidence,
    Previous,
)

K, N = 6, 30
GRID = inversion.log_mu_grid()
ALL = (GCV(), Evidence(), PositiveEvidence(), UPRE(), Discrepancy(), LCurve(), Previous())


def drawn(seed, log_mu=27.0, precision=None, positive=False):
    """A profile from the white prior at `log_mu`, seen through singular values from 1e3 to 1 per prior spread."""
    rng = np.random.default_rng(seed)
    sigma = 10 ** (-log_mu / 2)
    left, _ = np.linalg.qr(rng.standard_normal((N, K)))
    right, _ = np.linalg.qr(rng.standard_normal((K, K)))
    a = left @ np.diag(np.logspace(3, 0, K)) @ right / sigma
    x = sigma * rng.standard_normal(K)
    y = a @ (np.abs(x) if positive else x) + rng.standard_normal(N)
    return inversion.LinearProblem(a, y, np.eye(K) if precision is None else precision, N)


@pytest.fixture
def problem():
    return drawn(0)


def influence(problem, log_mu):
    scale = 10 ** (-13.5)
    a = problem.matrix * scale
    return a @ np.linalg.solve(a.T @ a + 10**log_mu * scale**2 * problem.precision, a.T)


def test_evidence_is_the_marginal_likelihood(problem):
    """Differences of -2 log p(y | mu), with p from scipy's multivariate normal."""
    direct = []
    for log_mu in GRID:
        covariance = np.eye(N) + problem.matrix @ problem.matrix.T / 10**log_mu
        root = stats.Covariance.from_cholesky(np.linalg.cholesky(covariance))
        direct.append(-2 * stats.multivariate_normal(cov=root).logpdf(problem.data))
    curve = inversion.evidence(problem, GRID)
    # The largest eigenvalues of the covariance, 1e10, leave the direct evaluation 1e-6 of its value.
    np.testing.assert_allclose(np.diff(curve), np.diff(direct), rtol=1e-5, atol=1e-6)


def test_evidence_with_a_free_direction_is_the_limit_of_a_proper_prior():
    rows = np.diff(np.eye(K), axis=0)
    improper = drawn(1, precision=rows.T @ rows)
    proper = drawn(1, precision=rows.T @ rows + 1e-9 * np.eye(K))
    curves = [inversion.evidence(one, GRID) for one in (improper, proper)]
    # log det of the proper prior runs with mu in the free direction too, by ln 10 a decade.
    steps = np.diff(curves[1]) + np.log(10) * 0.25
    np.testing.assert_allclose(np.diff(curves[0]), steps, atol=1e-2)


def test_predictive_risk_and_discrepancy_are_their_definitions(problem):
    for log_mu in GRID:
        g = influence(problem, log_mu)
        misfit = np.sum((g @ problem.data - problem.data) ** 2)
        risk = misfit + 2 * np.trace(g) - N
        assert inversion.misfit(problem, log_mu) == pytest.approx(misfit, rel=1e-9)
        assert inversion.upre(problem, log_mu) == pytest.approx(risk, rel=1e-9, abs=1e-8)
        assert inversion.discrepancy(problem, log_mu, 0.9) == pytest.approx(abs(misfit / N - 0.9), abs=1e-9)


def test_predictive_risk_is_unbiased():
    """Its mean over noise is the mean of ||A x(mu) - A x_true||^2; 400 draws leave both within 10 %."""
    rng = np.random.default_rng(11)
    base = drawn(0)
    truth = inversion.solve_linear(base, 1e25)
    clean = base.matrix @ truth
    risk, loss = [], []
    for noise in rng.standard_normal((400, N)):
        one = inversion.LinearProblem(base.matrix, clean + noise, base.precision, N)
        risk.append(inversion.upre(one, 28.0))
        loss.append(np.sum((base.matrix @ inversion.solve_linear(one, 1e28) - clean) ** 2))
    assert np.mean(risk) == pytest.approx(np.mean(loss), rel=0.1)


def test_curvature_is_that_of_the_curve(problem):
    """Against central differences of log ||A x - y||^2 and log x^T R x at a step of 1e-3 in ln mu."""
    step = 1e-3
    for log_mu in (25.0, 26.5, 28.0, 30.0):
        x, y = [], []
        for shift in (-step, 0, step):
            solution = inversion.solve_linear(problem, np.exp(log_mu * np.log(10) + shift))
            x.append(np.log(np.sum((problem.matrix @ solution - problem.data) ** 2)))
            y.append(np.log(solution @ problem.precision @ solution))
        (x1, y1) = (x[2] - x[0]) / 2 / step, (y[2] - y[0]) / 2 / step
        (x2, y2) = (x[2] - 2 * x[1] + x[0]) / step**2, (y[2] - 2 * y[1] + y[0]) / step**2
        curvature = (x1 * y2 - y1 * x2) / (x1**2 + y1**2) ** 1.5
        assert -inversion.lcurve(problem, log_mu) == pytest.approx(curvature, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("selector", ALL, ids=lambda s: s.name)
def test_choice_is_the_minimum_of_the_curve_returned(selector, problem):
    found = selector.select(problem)
    assert len(found.criterion) == len(found.log_mu_grid) == 41
    assert found.log_mu == pytest.approx(found.log_mu_grid[np.argmin(found.criterion)])
    assert found.at_edge == (np.argmin(found.criterion) in (0, 40))


@pytest.mark.parametrize("selector", [GCV(), Evidence(), UPRE()], ids=lambda s: s.name)
def test_mu_of_the_prior_is_recovered(selector):
    """Median over 100 draws within half a decade of the mu they were drawn with; single draws scatter by more."""
    for log_mu in (26.0, 29.0):
        found = [selector.select(drawn(seed, log_mu)).log_mu for seed in range(100)]
        assert np.median(found) == pytest.approx(log_mu, abs=0.5)


def test_mu_of_a_positive_prior_is_recovered():
    found = [PositiveEvidence().select(drawn(seed, 27.0, positive=True)).log_mu for seed in range(100)]
    assert np.median(found) == pytest.approx(27.0, abs=0.3)
    assert np.std(found) < 0.5


def test_range_is_a_parameter_and_its_edge_is_flagged(problem):
    free = GCV().select(problem)
    assert not free.at_edge
    above = GCV(log_mu_min=free.log_mu + 1, log_mu_step=0.5).select(problem)
    assert above.at_edge
    assert above.log_mu == pytest.approx(free.log_mu + 1)
    np.testing.assert_allclose(np.diff(above.log_mu_grid), 0.5, rtol=1e-12)


def test_fixed_keeps_its_value_and_shows_the_curve(problem):
    found = Fixed(mu="3e26 m^(4/3)").select(problem)
    assert found.mu == 3e26
    assert found.criterion_name == "gcv"
    np.testing.assert_array_equal(found.criterion, GCV().select(problem).criterion)
    assert Fixed(mu="0 m^(4/3)").select(problem).mu == 0


@pytest.mark.parametrize("criterion", ["gcv", "evidence", "positive_evidence", "upre"])
def test_neighbours_steady_the_choice(criterion):
    """Over 30 draws of one prior the choice with 6 neighbours scatters less: 0.3 to 0.7 of the single one."""
    problems = [drawn(seed) for seed in range(210)]
    alone = Previous(criterion=criterion)
    single = [alone.select(one).log_mu for one in problems[::7]]
    joined = []
    for i in range(0, 210, 7):
        one = problems[i]
        joined.append(
            alone.select(
                inversion.LinearProblem(
                    one.matrix, one.data, one.precision, one.n_data, neighbours=tuple(problems[i + 1 : i + 7])
                )
            ).log_mu
        )
    assert np.std(joined) < 0.8 * np.std(single)
    reference = next(one for one in ALL if one.name == criterion)
    assert single == [reference.select(one).log_mu for one in problems[::7]]


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        (GCV, {"log_mu_min": 30, "log_mu_max": 25}, "lies below log_mu_min"),
        (GCV, {"log_mu_step": 0}, "greater than or equal to 0.001"),
        (Fixed, {"mu": 1e27}, "unit is missing"),
        (Fixed, {"mu": "1e27 m"}, "hyperparameter"),
        (Fixed, {"mu": "-1 m^(4/3)"}, "greater than or equal to 0"),
        (Discrepancy, {"tau": 0}, "greater than 0"),
        (Previous, {"criterion": "guess"}, "'positive_evidence' or 'upre'"),
    ],
)
def test_wrong_parameters_are_refused(kind, parameters, message):
    with pytest.raises(ValidationError) as caught:
        kind(**parameters)
    assert message in str(caught.value)
