"""The retrieval of a batch: what it records, and intervals of what follows from a profile."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from coslidar.pipeline import batch
from coslidar.pipeline.geometry import Geometry, SliceGrid
from coslidar.pipeline.parameters import InversionParameters
from coslidar.pipeline.products import SCHEMA
from coslidar.pipeline.response import response_matrix
from coslidar.plugins.hyperparameter_selectors import GCV, Fixed, Previous
from coslidar.plugins.regularisers import White
from coslidar.plugins.source_models import Gaussian
from coslidar.plugins.turbulence_spectra import Kolmogorov

MASK = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))
GEOMETRY = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
LENGTH, CN2 = 2670.0, 2e-14
ZERO = [40, 121, 364]
"""Zero separation of the auto maps of x, y and intensity."""


@pytest.fixture(scope="module")
def matrix() -> np.ndarray:
    source = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")
    return response_matrix(GEOMETRY, SliceGrid.uniform(LENGTH, 6), Kolmogorov(), [source] * 2, sampling="midpoint")


def reduced(maps: np.ndarray, flux_variance: float = 0.0) -> batch.ReducedBatch:
    """Correlations with 5 % noise in each entry of each kind, alike in all and independent."""
    size = np.repeat(np.nanmax(np.abs(maps.reshape(6, 81)), axis=1), 81)[GEOMETRY.independent]
    return batch.ReducedBatch(
        start=1_600_000_000_000_000_000,
        stop=1_600_000_180_000_000_000,
        quality_flag=0,
        arrays={
            "maps": maps.reshape(6, 9, 9),
            "noise_covariance": np.diag((0.05 * size) ** 2),
            "weighting_correction": np.zeros(len(size)),
            "n_effective": np.full(3, 1000.0),
            "mean_flux": np.full(2, 1e4),
            "scintillation_index": np.full(2, 0.02),
            "noise_variance_intensity_detector": np.full(2, flux_variance),
            "valid_fraction": np.ones(2),
            "n_frames": np.asarray(25560),
        },
    )


def retrieve(
    matrix: np.ndarray,
    maps: np.ndarray,
    selector: Any = None,
    flux_variance: float = 0.0,
    factors: np.ndarray | None = None,
    **inversion: Any,
) -> batch.BatchResult:
    model = batch.Model(
        geometry=GEOMETRY,
        grid=SliceGrid.uniform(LENGTH, matrix.shape[1]),
        matrix=matrix,
        sampling="midpoint",
        regulariser=White(),
        selector=selector or GCV(),
        inversion=InversionParameters(**inversion),
        scintillometers=np.linspace(1, 2, matrix.shape[1])[None],
        height_factors=factors,
    )
    return batch.retrieve(reduced(maps, flux_variance), model)


def test_every_promised_variable_is_delivered(matrix: np.ndarray) -> None:
    found = retrieve(matrix, matrix @ np.full(6, CN2))
    sizes = {"z": 6, "z_true": 6, "dy": 9, "dx": 9, "bound": 2, "axis": 2, "source": 2, "axis_kind": 3,
             "slope_kind": 4, "intensity_kind": 2, "log_mu_grid": 41, "mu_factor": 2, "scintillometer": 1}  # fmt: skip
    made_here = {
        name for name in SCHEMA if name.startswith(("cn2", "r0_profile", "r0_interval", "slope_", "intensity_"))
    } - {"slope_spectrum", "cn2_height_model"}
    made_here = {name for name in made_here if not name.startswith("cn2_scintillometer")}
    made_here |= {"averaging_kernel", "degrees_of_freedom", "mu", "criterion", "resolution_length", "chi2_reduced",
                  "noise_variance_slope", "noise_variance_slope_error", "noise_variance_intensity",
                  "noise_variance_intensity_error", "scintillation_index_interval_68"}  # fmt: skip
    assert made_here <= set(found.values)
    for name in set(found.values) - {"log_mu_grid"}:
        assert found.values[name].shape == tuple(sizes[dim] for dim in SCHEMA[name].dims if dim != "time"), name


def test_profiles_at_other_mu_are_those_of_that_mu(matrix: np.ndarray) -> None:
    """A selector fixed at a hundred times more or less finds the same, with the same bars."""
    maps = matrix @ np.linspace(0.5 * CN2, 2 * CN2, 6)
    found = retrieve(matrix, maps, Fixed(mu="1e27 m^(4/3)")).values
    for number, mu in enumerate(("1e25 m^(4/3)", "1e29 m^(4/3)")):
        other = retrieve(matrix, maps, Fixed(mu=mu)).values
        np.testing.assert_allclose(found["cn2_other_mu"][number], other["cn2"], rtol=1e-9)
        np.testing.assert_allclose(found["cn2_other_mu_standard_error"][number], other["cn2_standard_error"], rtol=1e-9)
    # A hundred times stronger a prior of zero mean pulls the profile toward zero.
    assert found["cn2_other_mu"][1].sum() < found["cn2"].sum()


def test_average_of_a_scintillometer_is_the_weighted_mean(matrix: np.ndarray) -> None:
    found = retrieve(matrix, matrix @ np.full(6, CN2)).values
    weight = np.linspace(1, 2, 6)
    expected = (found["cn2"] * weight).sum() / weight.sum()
    np.testing.assert_allclose(found["cn2_path_average"], [expected], rtol=1e-12)
    low, high = found["cn2_path_average_interval_68"][0]
    assert low < expected < high


def test_carried_to_another_height_with_all_errors(matrix: np.ndarray) -> None:
    """One factor for all slices multiplies average, error and interval; zero for half of them leaves half."""
    maps = matrix @ np.full(6, CN2)
    plain, twice = (retrieve(matrix, maps, factors=factors).values for factors in (None, np.full((1, 6), 2.0)))
    for name in ("cn2_path_average", "cn2_path_average_standard_error", "cn2_path_average_interval_68"):
        np.testing.assert_allclose(twice[name], 2 * plain[name], rtol=1e-12)
    shares = np.linspace(1, 2, 6) / 9 * np.repeat([0.0, 3.0], 3)
    half = retrieve(matrix, maps, factors=np.repeat([[0.0, 3.0]], 3, axis=1)).values
    np.testing.assert_allclose(half["cn2_path_average"], [shares @ plain["cn2"]], rtol=1e-12)
    np.testing.assert_array_equal(half["cn2"], plain["cn2"])


def test_intervals_hold_68_percent_of_a_known_posterior(matrix: np.ndarray) -> None:
    """One slice far from 0: a normal posterior, and quantities that are monotone in Cn2.

    r0 by Fried's formula for one layer at mid-path; 8192 draws leave 0.5 % of probability, the middle of the nearly
    shortest intervals some percent of it.
    """
    column = matrix.sum(axis=1, keepdims=True)
    found = retrieve(column, column[:, 0] * CN2, Fixed(mu="1e20 m^(4/3)")).values
    normal = stats.norm(found["cn2"][0], found["cn2_standard_error"][0])

    def held(ends: np.ndarray) -> float:
        return float(abs(normal.cdf(ends[1]) - normal.cdf(ends[0])))

    layer = 0.423 * (2 * np.pi / 3.8e-6) ** 2 * 0.5 ** (5 / 3) * LENGTH
    assert found["r0_profile"] == pytest.approx((layer * found["cn2"][0]) ** -0.6, rel=1e-9)
    assert held(found["r0_interval_68"] ** (-5 / 3) / layer) == pytest.approx(0.68, abs=0.02)
    assert held(found["cn2_path_mean_interval_68"]) == pytest.approx(0.68, abs=0.02)
    assert held(found["scintillation_index_interval_68"] / column[ZERO[2], 0]) == pytest.approx(0.68, abs=0.02)
    assert found["cn2_path_mean"] == found["cn2"][0]


def test_path_mean_is_better_known_than_its_slices(matrix: np.ndarray) -> None:
    """Errors of neighbouring slices cancel in the mean: its interval is shorter than the mean of theirs."""
    found = retrieve(matrix, matrix @ np.full(6, CN2)).values
    low, high = found["cn2_path_mean_interval_68"]
    assert low < CN2 < high
    assert high - low < 0.7 * np.diff(found["cn2_interval_68"]).mean()


def test_unknowns_and_their_errors(matrix: np.ndarray) -> None:
    """What is added to the data is found again; an error is at least what the data's noise leaves at known Cn2."""
    maps = matrix @ np.full(6, CN2)
    shifted = maps.reshape(6, 81).copy()
    noise = np.array([3e-13, 4e-13, 2e-3])
    shifted[[0, 1, 4], 40] += noise
    shifted[[0, 2]] += 1e-12
    shifted[[1, 3]] -= 2e-12
    before = retrieve(matrix, maps, flux_noise="joint").values
    after = retrieve(matrix, shifted.ravel(), flux_noise="joint").values
    assert after["noise_variance_slope"] - before["noise_variance_slope"] == pytest.approx(noise[:2], rel=0.02)
    assert after["noise_variance_intensity"] - before["noise_variance_intensity"] == pytest.approx(2e-3, rel=0.02)
    assert after["slope_offset"] - before["slope_offset"] == pytest.approx([1e-12, -2e-12], rel=0.02)
    deviation = 0.05 * np.abs(maps[ZERO])
    assert (before["noise_variance_slope_error"] > deviation[:2]).all()
    assert deviation[2] < before["noise_variance_intensity_error"] < 3 * deviation[2]
    # At known Cn2 the constant of an axis is the mean of its entries: 35 of the auto map and 69 of the cross map.
    assert (before["slope_offset_error"] > deviation[:2] / np.sqrt(104)).all()


def test_unknowns_left_out_are_nan(matrix: np.ndarray) -> None:
    found = retrieve(matrix, matrix @ np.full(6, CN2), noise_bias="none").values
    assert np.isnan(found["noise_variance_slope"]).all()
    assert np.isnan(found["noise_variance_slope_error"]).all()
    assert np.isnan(found["noise_variance_intensity_error"])
    assert np.isfinite(found["slope_offset_error"]).all()


def test_subset_and_estimator_of_the_configuration(matrix: np.ndarray) -> None:
    """With slope maps a tenth of what the profile gives, only the scintillation tells the truth."""
    maps = (matrix @ np.full(6, CN2)).reshape(6, 81).copy()
    maps[:4] *= 0.1
    flux = retrieve(matrix, maps.ravel(), subset="scintillation").values
    slopes = retrieve(matrix, maps.ravel(), subset="slopes").values
    assert flux["scintillation_index_profile"] == pytest.approx(maps[4, 40], rel=0.03)
    assert slopes["cn2_path_mean"] == pytest.approx(0.1 * CN2, rel=0.2)
    mean = retrieve(matrix, maps.ravel(), subset="scintillation", estimator="posterior_mean").values
    np.testing.assert_array_equal(mean["cn2"], mean["cn2_posterior_mean"])
    np.testing.assert_array_equal(flux["cn2_posterior_mean"], mean["cn2_posterior_mean"])


def test_mu_of_a_batch_and_its_neighbours(matrix: np.ndarray) -> None:
    """A weak batch between strong ones is given the mu of most: near 1 / Cn2^2 of the strong ones."""
    model = batch.Model(
        geometry=GEOMETRY, grid=SliceGrid.uniform(LENGTH, 6), matrix=matrix, sampling="midpoint", regulariser=White(),
        selector=Previous(criterion="evidence"), inversion=InversionParameters(),
    )  # fmt: skip
    rng = np.random.default_rng(3)

    def noisy(cn2: float) -> batch.ReducedBatch:
        maps = matrix @ np.full(6, cn2)
        found = reduced(maps)
        deviation = np.zeros(486)
        deviation[GEOMETRY.independent] = np.sqrt(np.diag(found.arrays["noise_covariance"]))
        found.arrays["maps"] = (maps + deviation * rng.standard_normal(486))[GEOMETRY.mirror].reshape(6, 9, 9)
        return found

    weak, strong = noisy(1e-15), [noisy(1e-13) for _ in range(4)]
    broken = batch.ReducedBatch(0, 1, 0, {**weak.arrays, "maps": np.full((6, 9, 9), np.nan)})
    alone = batch.retrieve(weak, model).values["mu"]
    among = batch.retrieve(weak, model, [*strong, broken]).values["mu"]
    assert np.log10(alone) == pytest.approx(30, abs=0.6)
    assert np.log10(among) == pytest.approx(26, abs=0.6)
    assert batch.retrieve(weak, model, [broken]).values["mu"] == alone


def test_measured_flux_noise_is_taken_off_the_zero_separation(matrix: np.ndarray) -> None:
    """Noise that is measured leaves the truth, noise that is not known of does not, and no unknown takes it up.

    The noise is 2 % of the scintillation map's centre, so that the covariance made of the maps stays nearly the same.
    """
    noisy = matrix @ np.full(6, CN2)
    noise = 0.02 * noisy[ZERO[2]]
    noisy[ZERO[2]] += noise
    cleaned = retrieve(matrix, noisy, flux_variance=noise).values
    # Scaled to order 1: approx takes everything below 1e-12 for equal. The prior alone costs 1e-3.
    assert cleaned["cn2"] / CN2 == pytest.approx(np.ones(6), rel=5e-3)
    assert np.isnan(cleaned["noise_variance_intensity"])
    assert np.abs(retrieve(matrix, noisy).values["cn2"] / CN2 - 1).max() > 0.02
