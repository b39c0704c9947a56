"""Whitening, elimination of the biases, positive solution and cross-validation, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg, optimize

from coslidar.pipeline import inversion
from coslidar.pipeline.geometry import Geometry, SliceGrid

MASK = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))
GEOMETRY = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
K = 12
GRID = SliceGrid.uniform(2670.0, K)
TRUTH = 1e-14 * np.array([5, 3, 1, 1, 0.5, 0, 0, 1, 2, 1, 0, 8.0])
#: Entries of M for slopes (rad^2) and scintillation: what makes unscaled factorisations fail.
SLOPE, SCINTILLATION = 1e2, 1e12


def smooth_response(geometry, k=K):
    """Maps that narrow, move and fade with distance as the real ones do, made up from Gaussians."""
    z = (np.arange(k) + 0.5) / k
    block = np.repeat(np.arange(6), len(geometry.valid) // 6)
    d = geometry.separation_vectors
    matrix = np.empty((len(d), k))
    for j, fraction in enumerate(z):
        shift = np.where(np.isin(block, (2, 3, 5)), 0.8 * fraction / (1 - fraction), 0.0)
        stretch = np.where(block % 2 == 0, 0.8, 1.3)
        width = np.where(block < 4, 0.1 + 0.2 * fraction, 0.03 + 0.08 * fraction)
        size = np.where(
            block < 4, SLOPE * (1 - fraction) ** (5 / 3), SCINTILLATION * (fraction * (1 - fraction)) ** (5 / 6)
        )
        matrix[:, j] = size * np.exp(-(d[:, 0] ** 2 + (d[:, 1] - shift) ** 2 / stretch) / width**2 / 2)
    return matrix


def correlated_noise(geometry, matrix, level=0.03):
    """Covariance of the independent rows: correlated within and between maps."""
    rows = geometry.independent
    d = geometry.separation_vectors[rows]
    block = rows // (len(matrix) // 6)
    correlation = np.exp(-((d[:, None] - d) ** 2).sum(-1) / 0.1**2 / 2)
    correlation = correlation * (0.3 + 0.7 * (block[:, None] == block)) + 1e-3 * np.eye(len(rows))
    largest = np.abs(matrix @ TRUTH[: matrix.shape[1]]).reshape(6, -1).max(axis=1)
    deviation = level * largest[block]
    return correlation * deviation * deviation[:, None]


def as_file(geometry, data, covariance, matrix):
    """The same with rows as they come: both of each +-d, NaN where no pair exists."""
    position = {row: i for i, row in enumerate(geometry.independent)}
    valid = np.flatnonzero(geometry.valid)
    source = np.array([position[row] for row in geometry.mirror[valid]])
    full = np.full((len(matrix), len(matrix)), np.nan)
    full[np.ix_(valid, valid)] = covariance[np.ix_(source, source)]
    values = np.full(len(matrix), np.nan)
    values[valid] = data[geometry.mirror[valid]]
    response = np.full(matrix.shape, np.nan)
    response[valid] = matrix[geometry.mirror[valid]]
    return values, full, response


@pytest.fixture(scope="module")
def case():
    matrix = smooth_response(GEOMETRY)
    covariance = correlated_noise(GEOMETRY, matrix)
    deviation = np.sqrt(np.diag(covariance))
    draw = linalg.cholesky(covariance / deviation / deviation[:, None], lower=True)
    data = matrix @ TRUTH
    rows = GEOMETRY.independent
    data[rows] += deviation * (draw @ np.random.default_rng(1).standard_normal(len(rows)))
    return as_file(GEOMETRY, data, covariance, matrix)


class Fixed:
    version = 1

    def __init__(self, mu):
        self.mu = mu

    def select(self, problem):
        grid = inversion.log_mu_grid()
        return inversion.Selection("gcv", self.mu, grid, inversion.gcv(problem, grid), False)


class White:
    version = 1

    def precision(self, grid):
        return np.eye(grid.k)


def invert(case, mu=1e27, **options):
    return inversion.invert(*case, grid=GRID, regulariser=White(), selector=Fixed(mu), **options)


def gradient(k=K):
    rows = np.diff(np.eye(k), axis=0)
    return rows.T @ rows


# --- rows ---------------------------------------------------------------------------------------------------


def test_rows_of_the_files_are_those_of_the_geometry(case):
    rows = inversion.independent_rows(*case)
    assert len(case[0]) == 486
    assert len(rows) == 312
    np.testing.assert_array_equal(rows, GEOMETRY.independent)


def test_zero_rows_mean_no_pair_as_well_as_nan(case):
    zeroed = [np.nan_to_num(part, nan=0.0) for part in case]
    np.testing.assert_array_equal(inversion.independent_rows(*zeroed), GEOMETRY.independent)


def test_rows_absent_in_any_draw_are_dropped(case):
    data, covariance, matrix = case
    draws = np.stack([data, data])
    draws[1, GEOMETRY.independent[7]] = np.nan
    kept = inversion.independent_rows(draws, covariance, matrix)
    assert len(kept) == 312
    assert GEOMETRY.independent[7] not in kept, "its mirror image carries the datum instead"


def test_equal_rows_with_independent_noise_are_kept():
    matrix = np.ones((6, 2))
    np.testing.assert_array_equal(inversion.independent_rows(np.ones(6), np.eye(6), matrix), np.arange(6))


def test_shapes_that_disagree_are_named():
    with pytest.raises(ValueError, match=r"C_mes \(1, 5\), C_conv \(6, 6\), M \(6, 2\)"):
        inversion.independent_rows(np.ones(5), np.eye(6), np.ones((6, 2)))


def test_nothing_to_invert_is_an_error():
    with pytest.raises(ValueError, match="no row has"):
        inversion.independent_rows(np.full(6, np.nan), np.eye(6), np.ones((6, 2)))


def test_file_and_geometry_paths_agree(case):
    data, covariance, matrix = case
    rows = GEOMETRY.independent
    by_rows = inversion.invert(
        data, covariance[np.ix_(rows, rows)], matrix, grid=GRID, regulariser=White(), selector=Fixed(1e27), rows=rows
    )
    np.testing.assert_allclose(by_rows.cn2, invert(case).cn2, rtol=1e-12)
    assert by_rows.n_data == 312


# --- unpenalised unknowns -----------------------------------------------------------------------------------


def test_noise_bias_sits_at_zero_separation_of_auto_maps_only():
    design, names = inversion.nuisance_design(486, slope_offset=False)
    assert names == ("noise_bias_x", "noise_bias_y", "noise_bias_i")
    rows, columns = np.nonzero(design)
    zero = (GEOMETRY.separation_vectors[rows] == 0).all(axis=1)
    assert zero.all()
    np.testing.assert_array_equal(rows // 81, [0, 1, 4])
    np.testing.assert_array_equal(columns, [0, 1, 2])


def test_slope_offset_covers_auto_and_cross_maps_of_one_axis():
    design, names = inversion.nuisance_design(486, noise_bias=False)
    assert names == ("slope_offset_x", "slope_offset_y")
    np.testing.assert_array_equal(np.unique(np.flatnonzero(design[:, 0]) // 81), [0, 2])
    np.testing.assert_array_equal(np.unique(np.flatnonzero(design[:, 1]) // 81), [1, 3])


@pytest.mark.parametrize("n", [485, 12])
def test_unknown_order_of_the_data_is_refused(n):
    with pytest.raises(ValueError, match="six times an odd number"):
        inversion.nuisance_design(n)
    design, names = inversion.nuisance_design(n, noise_bias=False, slope_offset=False)
    assert design.shape == (n, 0)
    assert names == ()


def test_profile_does_not_see_noise_nor_vibration(case):
    """Adding any multiple of the unknowns changes their estimates by it, and nothing else."""
    data, covariance, matrix = case
    design, _ = inversion.nuisance_design(486)
    added = np.array([3e-12, -1e-12, 0.02, 5e-12, -4e-12])
    before, after = invert(case), invert((data + design @ added, covariance, matrix))
    # The additions are hundreds of standard deviations, which leaves 1e-16 / 1e-3 of them as rounding.
    np.testing.assert_allclose(after.cn2, before.cn2, atol=1e-10 * TRUTH.max())
    np.testing.assert_allclose(after.nuisance - before.nuisance, added, rtol=1e-8)
    np.testing.assert_allclose(after.criterion, before.criterion, rtol=1e-8)


@pytest.mark.parametrize("options", [{"noise_bias": False}, {"slope_offset": False}])
def test_switching_an_unknown_off_lets_it_into_the_profile(case, options):
    data, covariance, matrix = case
    design, _ = inversion.nuisance_design(486)
    added = np.array([3e-12, 3e-12, 0.02, 0, 0]) if "noise_bias" in options else np.array([0, 0, 0, 3e-12, 3e-12])
    before, after = invert(case, **options), invert((data + design @ added, covariance, matrix), **options)
    assert np.abs(after.cn2 - before.cn2).max() > 0.1 * TRUTH.max()


def dense(case, precision, mu):
    """Joint whitened system [M B] without elimination, columns scaled, and its penalty; 312 x 17."""
    data, covariance, matrix = (np.asarray(part) for part in case)
    rows = GEOMETRY.independent
    deviation = np.sqrt(np.diag(covariance))[rows]
    correlation = covariance[np.ix_(rows, rows)] / deviation / deviation[:, None]
    values, vectors = np.linalg.eigh(correlation)
    root = vectors / np.sqrt(values) @ vectors.T
    design, _ = inversion.nuisance_design(486)
    joint = root @ (np.concatenate([matrix[rows], design[rows]], axis=1) / deviation[:, None])
    scale = np.linalg.norm(joint, axis=0)
    scale[:K] = 1 / 1e-14
    penalty = np.zeros((17, 17))
    penalty[:K, :K] = mu * precision / scale[:K] ** 2
    return joint / scale, root @ (data[rows] / deviation), penalty, scale


@pytest.mark.parametrize("precision", [np.eye(K), gradient()], ids=["white", "gradient"])
def test_gcv_is_the_printed_formula_of_the_joint_problem(case, precision):
    """V = ||A x - y||^2 / trace(I - G)^2 with n = 312 and the five unknowns inside G."""
    problem = inversion.prepare(*case).problem(case[0], precision)
    assert (problem.n_data, problem.n_nuisance) == (312, 5)
    grid = inversion.log_mu_grid()
    for log_mu, value in zip(grid, inversion.gcv(problem, grid), strict=True):
        a, y, penalty, _ = dense(case, precision, 10.0**log_mu)
        influence = a @ np.linalg.solve(a.T @ a + penalty, a.T)
        direct = np.sum((influence @ y - y) ** 2) / np.trace(np.eye(312) - influence) ** 2
        assert value == pytest.approx(direct, rel=1e-10)


def test_elimination_is_the_joint_solution(case):
    """Profile, unknowns and errors of the joint problem with b free, solved by bounded least squares."""
    mu = 1e27
    a, y, penalty, scale = dense(case, np.eye(K), mu)
    stacked = np.concatenate([a, np.sqrt(penalty)])
    low = np.where(np.arange(17) < K, 0.0, -np.inf)
    joint = optimize.lsq_linear(stacked, np.concatenate([y, np.zeros(17)]), (low, np.inf), method="bvls", tol=1e-15)
    found = invert(case, mu)
    np.testing.assert_allclose(found.cn2, joint.x[:K] / scale[:K], atol=1e-9 * TRUTH.max())
    np.testing.assert_allclose(found.nuisance, joint.x[K:] / scale[K:], rtol=1e-6)
    error = np.sqrt(np.diag(np.linalg.inv(a.T @ a + penalty))) / scale
    np.testing.assert_allclose(found.error_map, error[:K], rtol=1e-9)
    np.testing.assert_allclose(found.nuisance_error, error[K:], rtol=1e-9)
    assert found.chi2 == pytest.approx(np.sum((a @ joint.x - y) ** 2), rel=1e-10)


def test_unknowns_at_a_known_profile_have_smaller_errors(case):
    reduction = inversion.prepare(*case)
    found = invert(case)
    values, errors = reduction.nuisance(case[0], found.cn2)
    np.testing.assert_allclose(values, found.nuisance, rtol=1e-12)
    assert (errors < found.nuisance_error).all()


def test_unknowns_the_rows_cannot_fix_are_reported_so(case):
    found = invert(case, subset="scintillation")
    known = np.array([name == "noise_bias_i" for name in found.nuisance_names])
    assert np.isfinite(found.nuisance[known]).all()
    assert np.isnan(found.nuisance[~known]).all()
    assert np.isinf(found.nuisance_error[~known]).all()
    assert found.n_data == 35 + 69


# --- whitening ----------------------------------------------------------------------------------------------


def test_units_of_the_data_do_not_matter(case):
    """Slopes in other units give the same profile: nothing is lost beside the scintillation entries."""
    data, covariance, matrix = case
    factor = np.where(np.arange(486) // 81 < 4, 1e-6, 1.0)
    scaled = (data * factor, covariance * factor * factor[:, None], matrix * factor[:, None])
    np.testing.assert_allclose(invert(scaled).cn2, invert(case).cn2, rtol=1e-9, atol=1e-12 * TRUTH.max())
    assert np.diag(scaled[1])[GEOMETRY.independent[0]] < 1e-30


def test_a_redundant_combination_of_data_adds_nothing(case):
    """A row that is the mean of two others makes C_conv singular; the rank counts, and the profile stays."""
    rows = GEOMETRY.independent
    extra = np.setdiff1d(np.flatnonzero(GEOMETRY.valid), rows)[0]
    combine = np.eye(486)
    combine[extra] = (combine[rows[0]] + combine[rows[1]]) / 2
    data, covariance, matrix = (np.nan_to_num(part) for part in case)
    singular = (combine @ data, combine @ covariance @ combine.T, combine @ matrix)
    options = {"rows": np.append(rows, extra), "noise_bias": False, "slope_offset": False}
    reduction = inversion.prepare(*singular, **options)
    assert not reduction.cholesky
    assert reduction.n_data == 312
    found = invert(singular, **options)
    # The eigenvector of the lost direction is known to 1e-16 over the gap to the next eigenvalue, some 1e-4.
    expected = invert(case, noise_bias=False, slope_offset=False)
    np.testing.assert_allclose(found.cn2, expected.cn2, atol=1e-8 * TRUTH.max())


def test_an_indefinite_covariance_loses_what_it_cannot_tell():
    """With an eigenvalue of -0.05 those below 0.05 are not trusted either."""
    rng = np.random.default_rng(0)
    q, _ = np.linalg.qr(rng.standard_normal((8, 8)))
    covariance = q @ np.diag([-0.05, 0.01, 0.04, 0.1, 1, 1, 2, 3]) @ q.T
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / scale / scale[:, None]
    values = np.linalg.eigvalsh(correlation)
    reduction = inversion.prepare(
        np.ones(8), covariance, np.ones((8, 1)), rows=np.arange(8), noise_bias=False, slope_offset=False
    )
    assert reduction.n_data == np.sum(values > -values[0]) < 7


@pytest.mark.parametrize(
    ("data", "covariance", "matrix", "rows", "message"),
    [
        (np.ones(4), np.eye(3), np.ones((4, 1)), np.arange(4), r"C_conv has shape \(3, 3\)"),
        (np.ones(4), np.diag([1.0, 1, 0, 1]), np.ones((4, 1)), np.arange(4), "variance that is not positive"),
        (np.ones(5), np.eye(4), np.ones((4, 1)), np.arange(4), "5 rows, the response matrix 4"),
        (np.ones(4), np.eye(4), np.full((4, 1), np.nan), np.arange(4), "not finite"),
        (np.full(4, np.nan), np.eye(4), np.ones((4, 1)), np.arange(4), "no finite datum"),
    ],
)
def test_what_cannot_be_inverted_says_why(data, covariance, matrix, rows, message):
    with pytest.raises(ValueError, match=message):
        inversion.prepare(data, covariance, matrix, rows=rows, noise_bias=False, slope_offset=False)


def test_biases_that_take_all_data_are_an_error():
    """One lenslet: each map is one number."""
    with pytest.raises(ValueError, match="no more than the unpenalised unknowns"):
        inversion.prepare(np.ones(6), np.eye(6), np.ones((6, 1)), subset="slopes")


# --- solutions ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", [np.eye(K), gradient()], ids=["white", "gradient"])
def test_positive_solution_agrees_with_bounded_least_squares(case, precision):
    problem = inversion.prepare(*case).problem(case[0], precision)
    grid = inversion.log_mu_grid()
    values, vectors = np.linalg.eigh(precision)
    factor = (vectors * np.sqrt(np.clip(values, 0, None))).T
    unit = 1e-14
    for log_mu, found in zip(grid, inversion.solve_positive(problem, 10.0**grid), strict=True):
        stacked = np.concatenate([problem.matrix, 10 ** (log_mu / 2) * factor]) * unit
        target = np.concatenate([problem.data, np.zeros(K)])
        reference = optimize.lsq_linear(stacked, target, (0, np.inf), method="bvls", tol=1e-15).x * unit
        np.testing.assert_allclose(found, reference, atol=1e-10 * found.max())


def test_positive_solution_meets_the_optimality_conditions(case):
    """Gradient zero where x > 0, not negative where x = 0 (Karush, Kuhn, Tucker)."""
    problem = inversion.prepare(*case).problem(case[0], np.eye(K))
    bound = 0
    for mu in 10.0 ** inversion.log_mu_grid():
        x = inversion.solve_positive(problem, mu)
        slope = problem.matrix.T @ (problem.matrix @ x - problem.data) + mu * x
        size = np.abs(problem.matrix.T @ problem.data)
        assert (x >= 0).all()
        assert (np.abs(slope[x > 0]) < 1e-10 * size[x > 0]).all()
        assert (slope[x == 0] > -1e-10 * size[x == 0]).all()
        bound += np.sum(x == 0)
    assert bound > 10, "a test of the constraint needs slices it holds"


def test_noise_free_data_return_the_truth(case):
    """With next to no prior; slices the data hardly see are conditioned 1e5 times worse than the best."""
    _, covariance, matrix = case
    found = invert((matrix @ TRUTH, covariance, matrix), mu=1e10)
    np.testing.assert_allclose(found.cn2, TRUTH, atol=1e-8 * TRUTH.max())
    assert found.chi2 < 1e-12
    residual = (found.residual / np.sqrt(np.diag(covariance)))[GEOMETRY.valid]
    np.testing.assert_allclose(residual, 0, atol=1e-6)


def test_model_covers_redundant_rows_and_leaves_out_missing_pairs(case):
    found = invert(case)
    np.testing.assert_array_equal(np.isfinite(found.model), GEOMETRY.valid)
    np.testing.assert_allclose(found.model + found.residual, case[0], rtol=1e-12)
    np.testing.assert_array_equal(found.at_bound, found.cn2 == 0)


def test_linear_solution_is_the_normal_equations(case):
    problem = inversion.prepare(*case).problem(case[0], gradient())
    for mu in (1e23, 1e27, 1e31):
        a, scale = problem.matrix, 1e-14
        hessian = (a.T @ a + mu * gradient()) * scale**2
        expected = np.linalg.solve(hessian, a.T @ problem.data * scale) * scale
        np.testing.assert_allclose(inversion.solve_linear(problem, mu), expected, atol=1e-8 * np.abs(expected).max())


def test_a_slice_nobody_sees_and_no_prior_holds_is_zero():
    problem = inversion.LinearProblem(
        matrix=np.array([[1.0, 0.0], [2.0, 0.0], [0.5, 0.0]]),
        data=np.array([1.0, 2.0, 0.4]),
        precision=np.diag([1.0, 0.0]),
        n_data=3,
    )
    x = inversion.solve_positive(problem, 1.0)
    assert x[1] == 0
    np.testing.assert_allclose(x[0], 5.2 / (5.25 + 1), rtol=1e-14)
    np.testing.assert_allclose(inversion.solve_linear(problem, 1.0), x, rtol=1e-13)


@pytest.mark.parametrize("mu", [-1.0, np.nan, np.inf])
def test_mu_must_be_a_number_that_is_not_negative(mu):
    problem = inversion.LinearProblem(np.eye(2), np.ones(2), np.eye(2), 2)
    with pytest.raises(ValueError, match="mu must be"):
        inversion.solve_positive(problem, mu)


def test_fewer_data_than_slices(case):
    """Eight data for twelve slices: the prior decides the rest, and the curves still hold."""
    rng = np.random.default_rng(4)
    a, y = rng.standard_normal((8, 12)), rng.standard_normal(8)
    problem = inversion.LinearProblem(a, y, np.eye(12), 8)
    for log_mu in (-2.0, 0.0, 2.0):
        influence = a @ np.linalg.solve(a.T @ a + 10**log_mu * np.eye(12), a.T)
        direct = np.sum((influence @ y - y) ** 2) / np.trace(np.eye(8) - influence) ** 2
        assert inversion.gcv(problem, log_mu) == pytest.approx(direct, rel=1e-10)


# --- subsets and sources ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("subset", "blocks"), inversion.SUBSETS.items())
def test_subsets_use_their_maps_only(case, subset, blocks):
    reduction = inversion.prepare(*case, subset=subset)
    np.testing.assert_array_equal(np.unique(reduction.rows // 81), sorted(blocks))


def test_unknown_subset_lists_the_known_ones(case):
    with pytest.raises(ValueError, match="no data subset 'intensity'; there are: all, slopes"):
        inversion.prepare(*case, subset="intensity")


def test_one_source_has_no_cross_maps(case):
    data, covariance, matrix = (part.copy() for part in case)
    cross = np.isin(np.arange(486) // 81, (2, 3, 5))
    data[cross], matrix[cross] = np.nan, np.nan
    found = invert((data, covariance, matrix))
    expected = invert(case, subset="auto")
    assert found.n_data == 105
    np.testing.assert_allclose(found.cn2, expected.cn2, rtol=1e-12)


def test_draws_share_one_reduction(case):
    reduction = inversion.prepare(np.stack([case[0], 2 * case[0]]), *case[1:])
    one = inversion.estimate(reduction, 2 * case[0], np.eye(K), Fixed(1e27))
    np.testing.assert_allclose(one.cn2, 2 * invert(case).cn2, rtol=1e-12)


# --- selection and checks -----------------------------------------------------------------------------------


def test_grid_keeps_its_step():
    np.testing.assert_allclose(inversion.log_mu_grid(), np.arange(41) / 4 + 23, rtol=1e-15)
    assert inversion.log_mu_grid(25, 25).tolist() == [25]
    np.testing.assert_allclose(inversion.log_mu_grid(25, 26, 0.3), [25, 25.3, 25.6, 25.9], rtol=1e-14)
    assert len(inversion.log_mu_grid(23, 33, 0.1)) == 101
    with pytest.raises(ValueError, match="LOW <= HIGH"):
        inversion.log_mu_grid(30, 25)


@pytest.mark.parametrize(
    ("curve", "log_mu", "edge"),
    [
        ([3, 2, 1, 2], 25, False),
        ([1, 2, 3, 4], 23, True),
        ([4, 3, 2, 1], 26, True),
        ([np.nan, 1, 2, 0.5], 26, True),
        ([np.nan, 1, 2, 3], 24, True),
        ([3, 1, 2, np.nan], 24, False),
    ],
)
def test_minimum_of_a_curve(curve, log_mu, edge):
    found = inversion.select_minimum("x", [23, 24, 25, 26], curve)
    assert (found.log_mu, found.at_edge) == (pytest.approx(log_mu), edge)


def test_a_curve_without_a_finite_value_is_an_error():
    with pytest.raises(ValueError, match="x is finite nowhere"):
        inversion.select_minimum("x", [23, 24], [np.nan, np.nan])


@pytest.mark.parametrize(
    ("precision", "message"),
    [
        (np.eye(3), r"shape \(3, 3\), not \(2, 2\)"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "not symmetric"),
        (np.array([[1.0, 0.0], [0.0, np.nan]]), "not finite"),
        (np.diag([1.0, -1.0]), "not positive semi-definite"),
    ],
)
def test_a_wrong_precision_is_refused(precision, message):
    with pytest.raises(ValueError, match=message):
        inversion.solve_positive(inversion.LinearProblem(np.eye(2), np.ones(2), precision, 2), 1.0)


def test_inputs_stay_writable_and_untouched(case):
    copies = [part.copy() for part in case]
    precision = np.eye(K)
    problem = inversion.prepare(*copies).problem(copies[0], precision)
    with pytest.raises(ValueError, match="read-only"):
        problem.data[0] = 0
    precision[0, 0] = 1.0
    for before, after in zip(case, copies, strict=True):
        np.testing.assert_array_equal(before, after)
        assert after.flags.writeable


# --- estimators ---------------------------------------------------------------------------------------------


def test_estimators_share_everything_but_the_profile(case):
    mode, mean = invert(case), invert(case, estimator="posterior_mean")
    np.testing.assert_array_equal(mean.cn2, mean.posterior.mean)
    np.testing.assert_array_equal(mode.interval_95, mean.interval_95)
    np.testing.assert_array_equal(mode.error_map, mean.error_map)
    np.testing.assert_array_equal(mode.at_bound, mean.at_bound)
    assert (mean.cn2 > 0).all()
    assert (mode.interval_68[:, 0] >= mode.interval_95[:, 0]).all()
    assert mode.chi2 < mean.chi2, "the mode is the best fit but for the prior"
    assert (mode.estimator, mean.estimator) == ("map", "posterior_mean")


def test_no_posterior_means_no_bound(case):
    """Two slices with equal responses and no prior: nothing tells one from the other."""

    class Nothing:
        version = 1

        def precision(self, grid):
            return np.zeros((grid.k, grid.k))

    data, covariance, matrix = case
    matrix = matrix.copy()
    matrix[:, 1] = matrix[:, 0]
    options = {"grid": GRID, "regulariser": Nothing(), "selector": Fixed(1e27)}
    found = inversion.invert(data, covariance, matrix, **options)
    assert found.posterior is None
    np.testing.assert_array_equal(found.interval_95, np.tile([0, np.inf], (12, 1)))
    with pytest.raises(ValueError, match="no posterior mean"):
        inversion.invert(data, covariance, matrix, estimator="posterior_mean", **options)


def test_unknown_estimator_lists_the_known_ones(case):
    with pytest.raises(ValueError, match="no estimator 'median'; there are: map, posterior_mean"):
        invert(case, estimator="median")
