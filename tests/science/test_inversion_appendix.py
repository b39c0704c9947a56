"""The appendix of Sauvage et al. 2021 on draws of convergence noise, with the real response functions."""

from __future__ import annotations

import numpy as np
import pytest

from coslidar.pipeline import convergence, inversion, response, uncertainty
from coslidar.pipeline.geometry import Geometry, SliceGrid
from coslidar.plugins.hyperparameter_selectors import GCV, Evidence
from coslidar.plugins.regularisers import White
from coslidar.plugins.source_models import Gaussian
from coslidar.plugins.turbulence_spectra import Kolmogorov

MASK = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))
GEOMETRY = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
GRID = SliceGrid.uniform(2670.0, 12)
#: Strong near the pupil, calm mid-path, bright near the sources, as the profile of 14:15 in the paper.
STRONG = 3.4e-15 * np.array([10, 10, 10, 10, 10, 0.5, 0.5, 30, 30, 1, 60, 60])
DRAWS = 60


@pytest.fixture(scope="module")
def matrix():
    source = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")
    return response.response_matrix(GEOMETRY, GRID, Kolmogorov(), [source, source], sampling="midpoint")


def channel_covariance(matrix, cn2):
    """Covariance of all slopes and fluxes of both sources that goes with a profile, with some detection noise."""
    maps = (matrix @ cn2).reshape(6, 9, 9)
    index = GEOMETRY.subaperture_index
    dy, dx = np.moveaxis(index[:, None] - index, -1, 0)
    covariance = np.zeros((3, 2, 20, 3, 2, 20))
    for kind, (auto, cross, noise) in enumerate(((0, 2, 1e-12), (1, 3, 1e-12), (4, 5, 1e-4))):
        for source in range(2):
            covariance[kind, source, :, kind, source] = maps[auto][dy + 4, dx + 4] + noise * np.eye(20)
        covariance[kind, 0, :, kind, 1] = maps[cross][dy + 4, dx + 4]
        covariance[kind, 1, :, kind, 0] = maps[cross][dy + 4, dx + 4].T
    return covariance.reshape(120, 120)


class Experiment:
    """Draws of data for a profile: 25,560 frames, a third of them independent."""

    def __init__(self, matrix, truth):
        self.truth, self.matrix = truth, matrix
        self.covariance = convergence.independent(channel_covariance(matrix, truth), 25560 // 3, GEOMETRY)
        rows = GEOMETRY.independent
        deviation = np.sqrt(np.diag(self.covariance))
        root = np.linalg.cholesky(self.covariance / deviation / deviation[:, None])
        rng = np.random.default_rng(14)
        self.data = np.tile(matrix @ truth, (DRAWS, 1))
        self.data[:, rows] += (rng.standard_normal((DRAWS, len(rows))) @ root.T) * deviation
        self.reduction = inversion.prepare(self.data, self.covariance, matrix, rows=rows)
        self.problems = [self.reduction.problem(draw, np.eye(12)) for draw in self.data]

    def error(self, cn2):
        """The paper's MSE, a normalised root mean square."""
        return np.sqrt(((cn2 - self.truth) ** 2).mean(axis=-1)) / self.truth.mean()


@pytest.fixture(scope="module")
def strong(matrix):
    return Experiment(matrix, STRONG)


def test_all_312_data_are_independent(strong):
    assert strong.reduction.cholesky
    assert strong.reduction.n_data == 312
    assert strong.reduction.n_nuisance == 5


def test_rows_found_from_the_matrices_are_the_same(strong, matrix):
    """The covariance written out for all 486 rows, NaN where no pair exists, is reduced to the same 312."""
    full = convergence.expand(strong.covariance, GEOMETRY)
    data = np.where(GEOMETRY.valid, strong.data[0][GEOMETRY.mirror], np.nan)
    response_rows = np.where(GEOMETRY.valid[:, None], matrix[GEOMETRY.mirror], np.nan)
    np.testing.assert_array_equal(inversion.independent_rows(data, full, response_rows), GEOMETRY.independent)


def test_noise_free_data_return_the_profile(strong, matrix):
    problem = strong.reduction.problem(matrix @ STRONG, np.eye(12))
    np.testing.assert_allclose(inversion.solve_positive(problem, 1e5), STRONG, rtol=1e-6, atol=1e-8 * STRONG.max())


def test_cross_validation_chooses_close_to_the_best(strong):
    """Squared gap to the best log mu, log mu from 25 as in the paper (0.76 over ten draws of its profile)."""
    selector = GCV(log_mu_min=25)
    gaps, errors, best = [], [], []
    for problem in strong.problems:
        found = selector.select(problem)
        error = strong.error(inversion.solve_positive(problem, 10**found.log_mu_grid))
        gaps.append((found.log_mu - found.log_mu_grid[np.argmin(error)]) ** 2)
        errors.append(error[np.argmin(found.criterion)])
        best.append(error.min())
    assert np.mean(gaps) < 1.5
    assert np.mean(errors) < 2 * np.mean(best)


def test_misfit_is_one_per_datum(strong):
    """chi2 at the mu of the evidence: 307 free data, 60 draws, standard error of the mean 0.010."""
    values = []
    for problem in strong.problems:
        mu = Evidence().select(problem).mu
        misfit = np.sum((problem.matrix @ inversion.solve_positive(problem, mu) - problem.data) ** 2)
        values.append(misfit / (307 - uncertainty.degrees_of_freedom(problem, mu)))
    assert np.mean(values) == pytest.approx(1.0, abs=0.05)


def test_bars_near_the_pupil_are_the_scatter_and_wide_mid_path(strong):
    """The paper: MAP bars are conservative. Scatter over 60 draws is known to 9 %, so a third covers 3.5 of it."""
    mu = 1e26
    found = np.array([inversion.solve_positive(problem, mu) for problem in strong.problems])
    scatter = np.sqrt(((found - STRONG) ** 2).mean(axis=0))
    bars = uncertainty.map_error(strong.problems[0], mu)
    np.testing.assert_allclose(bars[:4], scatter[:4], rtol=0.33)
    assert (bars[4:7] > 0.9 * scatter[4:7]).all()
    # From mid-path on the bars are those of the prior, not of the data.
    assert (uncertainty.ml_error(strong.problems[0])[8:] > 2 * bars[8:]).all()


def test_intervals_are_tighter_than_bars_and_still_cover(strong):
    """Over the slices that the data see, 68 and 95 % intervals hold the truth as often, within 0.1 and 0.07."""
    inside = np.zeros((2, 12))
    lengths, bars = [], []
    for number, draw in enumerate(strong.data[:40]):
        found = inversion.estimate(strong.reduction, draw, White().precision(GRID), GCV(log_mu_min=25), seed=number)
        for i, interval in enumerate((found.interval_68, found.interval_95)):
            inside[i] += (interval[:, 0] <= STRONG) & (interval[:, 1] >= STRONG)
        lengths.append(np.diff(found.interval_68)[:, 0])
        bars.append(2 * found.error_map)
    coverage = inside[:, :9].mean(axis=1) / 40
    assert coverage[0] == pytest.approx(0.68, abs=0.1)
    assert coverage[1] == pytest.approx(0.95, abs=0.07)
    assert (np.mean(lengths, axis=0) < 1.1 * np.mean(bars, axis=0)).all()
    assert (np.mean(lengths, axis=0)[5:7] < 0.7 * np.mean(bars, axis=0)[5:7]).all()


def test_vibration_noise_and_a_short_record_leave_the_profile_alone(strong):
    """Vibration adds 1 and 4e-12 rad^2 to slope maps; a 3-minute record holds 0.93 (x) and 0.88 (y) of their variance.

    With the unknowns on, the profile does not move; without the slope constants it is off by more than a bar, and in
    every record the same way.
    """
    design, names = inversion.nuisance_design(486)
    variance = (strong.matrix @ STRONG)[[40, 121]]
    added = np.array([1e-12, 1e-12, 1e-4, 1e-12 - 0.07 * variance[0], 4e-12 - 0.12 * variance[1]])
    assert names[3:] == ("slope_offset_x", "slope_offset_y")
    draw = strong.data[0]
    before = inversion.estimate(strong.reduction, draw, np.eye(12), GCV())
    after = inversion.estimate(strong.reduction, draw + design @ added, np.eye(12), GCV())
    np.testing.assert_allclose(after.cn2, before.cn2, atol=1e-6 * STRONG.max())
    np.testing.assert_allclose(after.nuisance - before.nuisance, added, rtol=1e-5)
    without = inversion.prepare(
        strong.data, strong.covariance, strong.matrix, rows=GEOMETRY.independent, slope_offset=False
    )
    kept = inversion.estimate(without, draw, np.eye(12), GCV())
    moved = inversion.estimate(without, draw + design @ added, np.eye(12), GCV())
    assert np.abs((moved.cn2 - kept.cn2) / kept.error_map).max() > 1
