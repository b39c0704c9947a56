"""Scintillation of moderate strength: the filters against the theory's own numbers, and the rounds of the retrieval."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import dblquad

from coslidar.pipeline import batch, turbulence
from coslidar.pipeline.extended_rytov import filters, growth, suppression
from coslidar.pipeline.geometry import Geometry, SliceGrid
from coslidar.pipeline.parameters import InversionParameters, ResponseParameters
from coslidar.pipeline.products import QUALITY_FLAGS
from coslidar.pipeline.response import response_matrix
from coslidar.pipeline.strong_scintillation import LEVELS, STRONGEST, StrongScintillation, from_responses, responses
from coslidar.plugins.hyperparameter_selectors import Fixed
from coslidar.plugins.regularisers import White
from coslidar.plugins.source_models import Gaussian, Point
from coslidar.plugins.turbulence_spectra import Kolmogorov

LENGTH, WAVELENGTH = 2670.0, 3.8e-6
K = 2 * np.pi / WAVELENGTH
PAIR = Geometry(((1, 1), (1, 1)), 0.07, LENGTH, WAVELENGTH, ((0.0, -0.4), (0.0, 0.4)))
GRID = SliceGrid.uniform(LENGTH, 3)
LAMPS = [Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")] * 2
CORRECTED = ResponseParameters(slices=3, sampling="midpoint", scintillation="extended_rytov")


@pytest.fixture(scope="module")
def found() -> dict[str, np.ndarray]:
    return responses(PAIR, GRID, Kolmogorov(), LAMPS, CORRECTED)


@pytest.fixture(scope="module")
def strong(found: dict[str, np.ndarray]) -> StrongScintillation:
    made = from_responses(found, PAIR, GRID, "midpoint")
    assert made is not None
    return made


# ---------------------------------------------------------------------------------------------------- filters


@pytest.mark.parametrize("b2", [0.0, 1.0])
def test_halves_of_the_index_are_those_of_the_theory(b2: float) -> None:
    """0.49 b^2 (1 + 0.56 b^(12/5))^(-7/6) and 0.51 b^2 (1 + 0.69 b^(12/5))^(-5/6) of Andrews et al. 1999.

    From the approximations they are made with: geometrical optics, 1 - cos x = x^2 / 2, for large scales, and its mean
    of 1 for small ones, in 8 pi^2 k^2 times the integral of kappa Phi_n G (1 - cos[kappa^2 z (L - z) / (k L)]) over
    kappa and path. To 2 or 3 %, as 8.56 and 9 are rounded.
    """
    cn2 = 1 / (0.5 * K ** (7 / 6) * LENGTH ** (11 / 6))  # b^2 = 1 where it is uniform
    growing = b2**1.2

    def integral(which: int) -> float:
        def density(x: float, log_kappa: float) -> float:
            kappa = math.exp(log_kappa)
            kept = float(filters(np.array([kappa / (2 * np.pi)]), WAVELENGTH, LENGTH, b2)[which][0])
            phase = kappa**2 * LENGTH * x * (1 - x) / K
            swing = phase**2 / 2 if which == 0 else 1.0
            return kappa**2 * 0.033 * cn2 * kappa ** (-11 / 3) * kept * swing

        limits = (math.log(0.5), math.log(400.0)) if which == 0 else (math.log(3.0), math.log(3e6))
        return 8 * np.pi**2 * K**2 * LENGTH * dblquad(density, *limits, 0, 1, epsrel=1e-3)[0]

    assert integral(0) == pytest.approx(0.49 / (1 + 0.56 * growing) ** (7 / 6), rel=0.03)
    assert integral(1) == pytest.approx(0.51 / (1 + 0.69 * growing) ** (5 / 6), rel=0.02)


def test_suppression_spares_weak_turbulence_and_both_ends_of_the_spectrum() -> None:
    f = np.array([1e-3, 1.0, 5.0, 15.0, 1e5])
    assert np.array_equal(suppression(f, WAVELENGTH, LENGTH, 0.0), np.ones(5))
    weak, moderate = (suppression(f, WAVELENGTH, LENGTH, b2) for b2 in (0.1, 1.0))
    for kept in (weak, moderate):
        assert kept[[0, -1]] == pytest.approx([1, 1], abs=1e-3)
        assert np.all(kept <= 1)
    assert np.all(moderate[1:4] < weak[1:4])
    assert 0.5 < moderate[3] < 0.8


@pytest.mark.parametrize(("b2", "tolerance"), [(0.1, 0.03), (0.5, 0.10), (1.0, 0.20)])
def test_index_of_a_point_source_is_that_of_the_theory(b2: float, tolerance: float) -> None:
    """exp(sigma_x^2 + sigma_y^2) - 1 in uniform turbulence; ours are exact integrals, its are fits."""
    one = Geometry(((1,),), 1e-3, LENGTH, WAVELENGTH, ((0.0, 0.0),))
    grid = SliceGrid.uniform(LENGTH, 4)
    weights = turbulence.point_source_weights(grid, WAVELENGTH, LENGTH, sampling="midpoint")
    row = response_matrix(one, grid, Kolmogorov(), [Point()], sampling="midpoint", point_index=b2)[4]
    covariance = float(row.sum()) * b2 / weights.sum()
    x, y = 0.49 * b2 / (1 + 0.56 * b2**1.2) ** (7 / 6), 0.51 * b2 / (1 + 0.69 * b2**1.2) ** (5 / 6)
    assert math.expm1(covariance) == pytest.approx(math.expm1(x + y), rel=tolerance)


def test_a_strength_needs_a_finite_path() -> None:
    stars = Geometry(((1,),), 0.07, math.inf, 1e-6, ((0.0, 0.0),))
    with pytest.raises(ValueError, match="point_index"):
        response_matrix(stars, GRID, Kolmogorov(), [Point()], point_index=0.5)
    with pytest.raises(ValueError, match="the path is infinite"):
        CORRECTED.options(stars)


# ------------------------------------------------------------------------------------------- response and rounds


def test_without_turbulence_the_response_is_first_order(
    found: dict[str, np.ndarray], strong: StrongScintillation
) -> None:
    np.testing.assert_allclose(strong.matrix(found["M"], np.zeros(3)), found["M"], rtol=1e-12)
    assert from_responses({"M": found["M"]}, PAIR, GRID, "midpoint") is None


def test_the_response_of_a_profile_is_that_of_its_strength(
    found: dict[str, np.ndarray], strong: StrongScintillation
) -> None:
    """Between the levels, against the response of that very strength; slopes are left alone."""
    cn2 = np.array([1.0, 2.0, 0.5])
    for index in (0.15, 0.6, 1.7):
        profile = cn2 * index / (strong.point_weights @ cn2)
        matrix = strong.matrix(found["M"], profile)
        options = CORRECTED.options(PAIR)
        exact = response_matrix(PAIR, GRID, Kolmogorov(), LAMPS, **options, point_index=index)[-18:]
        logarithm = exact @ profile
        assert np.abs(matrix[-18:] @ profile - np.expm1(logarithm)).max() < 2e-4 * logarithm.max()
        assert np.array_equal(matrix[:-18], found["M"][:-18])
    beyond = cn2 * 10 * STRONGEST / (strong.point_weights @ cn2)
    assert np.all(np.isfinite(strong.matrix(found["M"], beyond)))


def test_levels_reach_from_nothing_to_the_strongest() -> None:
    assert LEVELS[0] == 0
    assert LEVELS[-1] == pytest.approx(STRONGEST)
    assert np.all(np.diff(growth(LEVELS)) > 0)


def reduced(maps: np.ndarray) -> batch.ReducedBatch:
    """Correlations with 1 % noise."""
    size = np.repeat(np.abs(maps.reshape(6, 9)).max(axis=1), 9)[PAIR.independent]
    return batch.ReducedBatch(
        start=1_600_000_000_000_000_000,
        stop=1_600_000_180_000_000_000,
        quality_flag=0,
        arrays={
            "maps": maps.reshape(6, 3, 3),
            "noise_covariance": np.diag((0.01 * size) ** 2),
            "weighting_correction": np.zeros(len(size)),
            "n_effective": np.full(3, 1000.0),
            "mean_flux": np.full(2, 1e4),
            "scintillation_index": np.full(2, 0.02),
            "noise_variance_intensity_detector": np.zeros(2),
            "valid_fraction": np.ones(2),
            "n_frames": np.asarray(25560),
        },
    )


def test_rounds_find_the_profile_whose_own_response_made_the_data(
    found: dict[str, np.ndarray], strong: StrongScintillation
) -> None:
    truth = np.array([2e-14, 5e-14, 8e-14])
    index = float(strong.point_weights @ truth)
    assert 0.5 < index < STRONGEST
    maps = strong.matrix(found["M"], truth) @ truth
    made = []
    for correction in (None, strong):
        model = batch.Model(
            geometry=PAIR,
            grid=GRID,
            matrix=found["M"],
            sampling="midpoint",
            regulariser=White(),
            selector=Fixed(mu="1e20 m^(4/3)"),
            inversion=InversionParameters(),
            strong=correction,
        )
        made.append(batch.retrieve(reduced(maps), model))
    first, corrected = (result.values for result in made)
    assert np.abs(corrected["cn2"] / truth - 1).max() < 0.01
    assert np.abs(first["cn2"] / truth - 1).max() > 0.05
    assert first["scintillation_rounds"] == 0
    assert 2 <= corrected["scintillation_rounds"] < 12
    assert not made[1].quality_flag & QUALITY_FLAGS["unsettled_correction"][0]
    # What ends first-order theory is said, slice by slice and in all, corrected or not.
    each = corrected["scintillation_index_point_slice"]
    assert each == pytest.approx(strong.point_weights * corrected["cn2"])
    assert corrected["scintillation_index_point"] == pytest.approx(index, rel=0.01)
    assert corrected["strong_slice"].tolist() == [value >= turbulence.WEAK_INDEX for value in each]
    assert corrected["strong_slice"].any()
    assert made[1].quality_flag & QUALITY_FLAGS["strong_scintillation"][0]
