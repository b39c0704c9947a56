"""Draws from the positive posterior, their intervals and the positive evidence, against quadrature."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy import stats

from coslidar.pipeline import inversion, posterior
from coslidar.plugins.regularisers import Exponential, Gradient, White

#: Precision matrices of unit diagonal and modes of the untruncated Gaussian: inside, at and far outside the bounds.
CASES = {
    "inside": (np.array([[1.0, 0.3], [0.3, 1.0]]), [3.0, 4.0]),
    "one held": (np.array([[1.0, -0.5], [-0.5, 1.0]]), [-2.0, 1.0]),
    "sum only": (np.array([[1.0, 0.995], [0.995, 1.0]]), [2.0, 1.0]),
    "far outside": (np.array([[1.0, 0.8], [0.8, 1.0]]), [-6.0, -3.0]),
    "three": (np.array([[1.0, 0.9, 0.7], [0.9, 1.0, 0.9], [0.7, 0.9, 1.0]]), [1.0, -2.0, 3.0]),
    "three at zero": (np.array([[1.0, -0.4, 0.2], [-0.4, 1.0, -0.4], [0.2, -0.4, 1.0]]), [0.0, 0.0, -1.0]),
}


def as_problem(precision, mode, unit=1e-14):
    """A whitened problem with this posterior at mu -> 0, in the units of a profile."""
    root = np.linalg.cholesky(precision).T / unit
    return inversion.LinearProblem(root, root @ np.array(mode) * unit, np.eye(len(mode)), len(mode))


def quadrature(precision, mode):
    """Marginals of the truncated Gaussian on a grid of midpoints: nodes (n,), densities (k, n), log integral."""
    k = len(mode)
    n = 3000 if k == 2 else 240
    # Beyond 30 conditional deviations of 1 nothing is left in these cases; most is within 12.
    edge = 14.0 if np.max(mode) > 0 else 8.0
    edge = edge if k == 3 else edge + 20 * (abs(precision[0, 1]) > 0.99)
    nodes = (np.arange(n) + 0.5) * edge / n
    axes = np.meshgrid(*[nodes] * k, indexing="ij", sparse=True)
    shifted = [axis - m for axis, m in zip(axes, mode, strict=True)]
    exponent = sum(precision[i, j] * shifted[i] * shifted[j] for i in range(k) for j in range(k))
    density = np.exp(-0.5 * exponent)
    total = density.sum() * (edge / n) ** k
    marginals = [density.sum(axis=tuple(j for j in range(k) if j != i)) * (edge / n) ** (k - 1) for i in range(k)]
    constant = 0.5 * np.array(mode) @ precision @ np.array(mode)
    return nodes, np.array(marginals) / total, np.log(total) + constant


def exact_interval(nodes, density, probability):
    """Highest-density interval of a unimodal density on a grid: nodes in order of density up to the probability."""
    step = nodes[1] - nodes[0]
    order = np.argsort(-density)
    inside = order[: np.searchsorted(np.cumsum(density[order]) * step, probability) + 1]
    low = 0.0 if inside.min() == 0 else nodes[inside.min()]
    return low, nodes[inside.max()]


@pytest.mark.parametrize("name", CASES)
def test_draws_agree_with_quadrature(name):
    """8192 nearly independent draws: moments to 4 standard errors; intervals hold their share to 2 % (4 standard
    errors) and are no more than 5 % longer than the shortest, which leaves their ends free within some percent."""
    precision, mode = CASES[name]
    nodes, density, _ = quadrature(precision, mode)
    step = nodes[1] - nodes[0]
    mean = (nodes * density).sum(axis=1) * step
    deviation = np.sqrt(((nodes - mean[:, None]) ** 2 * density).sum(axis=1) * step)
    found = posterior.sample(as_problem(precision, mode), 0.0)
    np.testing.assert_allclose(found.mean / 1e-14, mean, atol=4 * np.max(deviation) * np.sqrt(1.5 / 8192))
    np.testing.assert_allclose(found.deviation / 1e-14, deviation, rtol=0.05)
    for probability, intervals in ((0.68, found.interval_68), (0.95, found.interval_95)):
        for marginal, interval in zip(density, intervals / 1e-14, strict=True):
            low, high = exact_interval(nodes, marginal, probability)
            share = marginal[(nodes > interval[0]) & (nodes < interval[1])].sum() * step
            assert share == pytest.approx(probability, abs=0.02)
            assert interval[1] - interval[0] < 1.05 * (high - low)
            if low == 0:
                assert interval[0] < 0.02 * high


@pytest.mark.parametrize("name", CASES)
def test_integral_agrees_with_quadrature(name):
    precision, mode = CASES[name]
    _, _, integral = quadrature(precision, mode)
    found = posterior.log_positive_integral(precision, precision @ np.array(mode))
    # The approximation, not the quadrature, sets this: worst where only the sum of two slices is known.
    assert found == pytest.approx(integral, abs=0.05)


def test_integral_is_exact_for_independent_slices():
    """Products of one-dimensional integrals, over a range in which the probability falls to exp(-5000)."""
    modes = np.array([[5.0, 0.0, -1.0], [-10.0, -30.0, -60.0], [-100.0, 3.0, 40.0]])
    found = posterior.log_positive_integral(np.tile(np.eye(3), (3, 1, 1)), modes)
    exact = (stats.norm.logcdf(modes) + 0.5 * np.log(2 * np.pi) + modes**2 / 2).sum(axis=1)
    np.testing.assert_allclose(found, exact, rtol=1e-8)


def chain(k=12, seed=2):
    """Slices seen ever less well and ever less apart: a response of broad overlapping bumps."""
    rng = np.random.default_rng(seed)
    z, s = np.arange(k) / k, np.linspace(0, 1, 60)
    a = np.exp(-(((s[:, None] - z**0.5) / 0.15) ** 2)) * 10 ** (3 - 3 * z)
    truth = np.array([2, 2, 2, 2, 2, 0.1, 0.1, 6, 6, 0.2, 12, 12]) * 1e-14
    return a / 1e-14, a @ truth / 1e-14 + rng.standard_normal(60)


def test_evidence_changes_with_mu_as_the_draws_say():
    """d(-2 log p)/d ln mu = mu <x^T R x> - rank R, the mean over the positive posterior at mu.

    The mean over 20,000 draws is good to some 0.03; expectation propagation to some 0.1.
    """
    a, y = chain()
    calm = np.random.default_rng(6).standard_normal(60)
    rough = np.diff(np.eye(12), axis=0)
    for data, precision, grid in (
        (y, np.eye(12), (25.0, 26.0, 27.0, 28.0)),
        (y, rough.T @ rough, (25.0, 26.0, 27.0, 28.0)),
        (calm, np.eye(12), (27.0, 29.0, 31.0, 33.0)),
    ):
        problem = inversion.LinearProblem(a, data, precision, 60)
        for log_mu in grid:
            drawn = posterior.sample(problem, 10**log_mu, draws=20_000).draws
            prior = 10**log_mu * np.einsum("ni,ij,nj->n", drawn, precision, drawn)
            expected = np.log(10) * (prior.mean() - np.linalg.matrix_rank(precision))
            low, high = posterior.positive_evidence(problem, [log_mu - 1e-3, log_mu + 1e-3])
            assert (high - low) / 2e-3 == pytest.approx(expected, abs=0.3, rel=0.01)


def test_evidence_without_active_bounds_is_the_gaussian_one():
    a = np.random.default_rng(0).standard_normal((20, 3)) * 100 / 1e-14
    problem = inversion.LinearProblem(a, a @ np.full(3, 1e-14), np.eye(3), 20)
    grid = np.linspace(20, 27, 8)
    difference = posterior.positive_evidence(problem, grid) - inversion.evidence(problem, grid)
    np.testing.assert_allclose(difference, difference[0], atol=1e-6)


def coordinate_sweeps(precision, shift, n, seed=0):
    """Plain Gibbs sampling of one slice after the other."""
    rng = np.random.default_rng(seed)
    x, found = np.ones(len(shift)), np.empty((n, len(shift)))
    uniform = rng.random((n, len(shift)))
    for sweep in range(n):
        for i in range(len(x)):
            mean = x[i] + (shift[i] - precision[i] @ x) / precision[i, i]
            low = stats.norm.cdf(-mean * precision[i, i] ** 0.5)
            x[i] = max(mean + stats.norm.ppf(low + uniform[sweep, i] * (1 - low)) / precision[i, i] ** 0.5, 0)
        found[sweep] = x
    return found


@pytest.mark.parametrize("regulariser", [White(), Gradient(), Exponential(length="1 km")], ids=lambda r: r.name)
@pytest.mark.parametrize("log_mu", [24.0, 26.0, 28.0])
def test_draws_are_nearly_independent(regulariser, log_mu):
    from coslidar.pipeline.geometry import SliceGrid

    problem = inversion.LinearProblem(*chain(), regulariser.precision(SliceGrid.uniform(2670, 12)), 60)
    assert posterior.sample(problem, 10**log_mu).autocorrelation.max() < 3


def test_one_slice_after_the_other_would_not_do():
    """Why the directions are there."""
    a, y = chain()
    scale = 1 / np.linalg.norm(a, axis=0)
    found = coordinate_sweeps((a * scale).T @ (a * scale), (a * scale).T @ y, 400)
    first, second = found[100:250].mean(axis=0), found[250:].mean(axis=0)
    # 150 independent draws would bring the two means within a few tenths of a deviation.
    assert np.abs((first - second) / found[100:].std(axis=0)).max() > 0.5


def test_autocorrelation_time_of_a_known_chain():
    """AR(1) with coefficient r has (1 + r) / (1 - r); 200,000 steps give it to 4 % at r = 0.9."""
    rng = np.random.default_rng(1)
    for r in (0.0, 0.5, 0.9):
        x = np.zeros((200_000, 1))
        noise = rng.standard_normal(200_000)
        for i in range(1, len(x)):
            x[i] = r * x[i - 1] + noise[i]
        assert posterior.autocorrelation_time(x)[0] == pytest.approx((1 + r) / (1 - r), rel=0.13)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (-np.inf, np.inf),
        (0.0, np.inf),
        (0.3, np.inf),
        (0.7, 0.9),
        (6, np.inf),
        (6.0, 6.1),
        (-1, 0.2),
        (-40, -39.9),
        (-np.inf, -3),
        (-0.4, 5),
        (0.6, 4),
        (-8, -0.6),
        (200, np.inf),
    ],
)
def test_truncated_normal_is_one(low, high):
    """Kolmogorov-Smirnov against scipy's distribution; 5,000 draws, probability of failing by chance 1e-4."""
    rng = np.random.Generator(np.random.SFC64(7))
    draws = [posterior._truncated_normal(rng, low, high) for _ in range(5000)]
    assert low <= min(draws) <= max(draws) <= high
    assert stats.kstest(draws, stats.truncnorm(low, high).cdf).pvalue > 1e-4


def test_intervals_of_known_densities():
    u = (np.arange(100_000) + 0.5) / 100_000
    exponential = posterior.highest_density_interval(-np.log(u)[:, None], 0.68)[0]
    np.testing.assert_allclose(exponential, [0, -np.log(0.32)], rtol=1e-3)
    assert exponential[0] == 0
    normal = posterior.highest_density_interval(10 + stats.norm.ppf(u), 0.95)
    np.testing.assert_allclose(normal, [8.04, 11.96], atol=0.02)
    # Rising from zero: x = 2 density on [0, 1] ends at the top.
    rising = posterior.highest_density_interval(np.sqrt(u), 0.5)
    np.testing.assert_allclose(rising, [np.sqrt(0.5), 1], atol=0.01)


@pytest.mark.parametrize(("n", "probability"), [(99, 0.68), (1000, 0.0), (1000, 1.0)])
def test_intervals_that_make_no_sense_are_refused(n, probability):
    with pytest.raises(ValueError, match=r"at least 100|not between"):
        posterior.highest_density_interval(np.ones(n), probability)


def test_intervals_cover_truths_from_the_prior():
    """Profiles from the positive prior are inside 68 % and 95 % of the time: 400 x 4 of them, to 3.5 sigma."""
    rng = np.random.default_rng(8)
    k, sigma = 4, 1e-14
    a = rng.standard_normal((15, k)) * np.array([10, 3, 1, 0.3]) / sigma
    inside = np.zeros((2, k))
    for truth, noise in zip(np.abs(rng.standard_normal((400, k))) * sigma, rng.standard_normal((400, 15)), strict=True):
        found = posterior.sample(inversion.LinearProblem(a, a @ truth + noise, np.eye(k), 15), sigma**-2, draws=2000)
        for i, interval in enumerate((found.interval_68, found.interval_95)):
            inside[i] += (interval[:, 0] <= truth) & (truth <= interval[:, 1])
    np.testing.assert_allclose(inside[0] / 400, 0.68, atol=0.08)
    np.testing.assert_allclose(inside[1] / 400, 0.95, atol=0.04)


def test_same_seed_same_draws_and_rounding_stays_rounding():
    a, y = chain()
    problem = inversion.LinearProblem(a, y, np.eye(12), 60)
    first = posterior.sample(problem, 1e26, seed=3)
    np.testing.assert_array_equal(first.draws, posterior.sample(problem, 1e26, seed=3).draws)
    assert np.abs(first.draws - posterior.sample(problem, 1e26, seed=4).draws).max() > 0
    nudged = inversion.LinearProblem(a, y * (1 + 1e-14), np.eye(12), 60)
    np.testing.assert_allclose(posterior.sample(nudged, 1e26, seed=3).mean, first.mean, rtol=1e-7)


def test_threads_do_not_disturb_each_other():
    problem = inversion.LinearProblem(*chain(), np.eye(12), 60)
    alone = [posterior.sample(problem, 1e26, seed=seed).mean for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda seed: posterior.sample(problem, 1e26, seed=seed).mean, range(8)))
    np.testing.assert_array_equal(alone, together)


def test_compiled_code_survives_the_cache():
    """A second process loads what the first compiled; numba crashes there on functions that call themselves."""
    code = (
        "import numpy as np; from coslidar.pipeline import posterior as p;"
        "print(p._truncated_normal(np.random.Generator(np.random.SFC64(0)), -9.0, -8.0))"
    )
    runs = [
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=120).stdout
        for _ in range(2)
    ]
    assert runs[0] == runs[1]
    assert -9 <= float(runs[0]) <= -8


def test_no_posterior_without_bounds():
    """Two slices of which only the difference is seen: both may grow together."""
    a = np.array([[1.0, -1.0], [2.0, -2.0]])
    problem = inversion.LinearProblem(a, np.ones(2), np.array([[1.0, -1.0], [-1.0, 1.0]]), 2)
    assert not posterior.proper(problem, 1.0)
    with pytest.raises(ValueError, match="neither the data nor the prior"):
        posterior.sample(problem, 1.0)
    assert np.isnan(posterior.positive_evidence(problem, [0.0, 1.0])).all()
