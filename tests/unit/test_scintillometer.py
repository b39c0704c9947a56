"""Path weighting of large-aperture scintillometers, against closed forms and quadratures of another kind."""

from __future__ import annotations

import math
from itertools import pairwise

import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gamma, j1

from coslidar.pipeline import scintillometer as las
from coslidar.pipeline.geometry import SliceGrid

L = 2670.0
GRID = SliceGrid.uniform(L, 12)
INSTRUMENTS = {"A": (0.05, 0.145, 0.88e-6), "B": (0.145, 0.145, 0.88e-6), "C": (0.145, 0.05, 0.94e-6)}


@pytest.mark.parametrize(("name", "printed", "finite"), [("A", 1.61, 1.649), ("B", 4.48, 4.493), ("C", 1.61, 1.654)])
def test_alpha_of_the_paper(name: str, printed: float, finite: float) -> None:
    near, far, wavelength = INSTRUMENTS[name]
    # Sauvage et al. 2021, Sec. 5.1, print three digits, of the geometric limit; 0.3 % is their rounding.
    assert las.alpha(L, near, far) == pytest.approx(printed, rel=3e-3)
    assert las.alpha(L, near, far, wavelength) == pytest.approx(finite, rel=3e-4)


def test_alpha_needs_no_length_in_the_geometric_limit() -> None:
    assert las.alpha(500.0, 0.1, 0.1) == pytest.approx(las.alpha(L, 0.145, 0.145), rel=1e-9)
    # The limit is what ever shorter waves come to.
    assert las.alpha(L, 0.05, 0.145, 1e-9) == pytest.approx(las.alpha(L, 0.05, 0.145), rel=1e-5)
    assert las.alpha(L, 0.05, 0.145, reference=0.05) == pytest.approx(
        las.alpha(L, 0.05, 0.145) * (0.145 / 0.05) ** (7 / 3), rel=1e-12
    )


def test_points_scintillate_as_a_spherical_wave() -> None:
    # sigma_chi^2 = 0.124 k^(7/6) L^(11/6) Cn2; the constant in full, from int [z (1 - z / L)]^(5/6) dz = B(11/6, 11/6).
    k = 2 * np.pi / 0.88e-6
    constant = -(np.pi**2) * 0.033 * gamma(-5 / 6) * np.cos(5 * np.pi / 12) * gamma(11 / 6) ** 2 / gamma(11 / 3)
    expected = 1e-15 * constant * k ** (7 / 6) * L ** (11 / 6)
    # The tail beyond 300 Fresnel scales, where the sine averages to one half, is left out: 0.3 x 300^(-5/3) = 2e-5.
    assert las.log_amplitude_variance(1e-15, L, 1e-6, 1e-6, 0.88e-6) == pytest.approx(expected, rel=1e-4)


def test_blur_integral_with_a_point_at_one_end() -> None:
    # Weber and Schafheitlin: int 4 J1(x)^2 x^(-2/3) dx in closed form.
    s = 2 / 3
    closed = 4 * gamma(s) * gamma((3 - s) / 2) / (2**s * gamma((1 + s) / 2) ** 2 * gamma((3 + s) / 2))
    assert las._blur_integral(0.0) == pytest.approx(closed, rel=1e-6)
    assert las._blur_integral(1e-7) == pytest.approx(closed, rel=1e-4)


@pytest.mark.parametrize("ratio", [0.3, 1.0])
def test_blur_integral_in_mpmath(ratio: float) -> None:
    def airy(x: mp.mpf) -> mp.mpf:
        return (2 * mp.besselj(1, x) / x) ** 2 if x else mp.mpf(1)

    with mp.workdps(15):
        nodes = [0, *(mp.pi * n for n in range(1, 24))]
        value = mp.quad(lambda x: x ** mp.mpf(4 / 3) * airy(x) * airy(ratio * x), nodes, maxdegree=4)
    # What lies beyond is 16 / pi^2 ratio^-3 x^(-11/3) 3 / 11 on average.
    rest = 16 / np.pi**2 / ratio**3 * 3 / 11 * (23 * np.pi) ** (-11 / 3)
    assert las._blur_integral(ratio) == pytest.approx(float(value) + rest, rel=5e-6)


def test_weight_by_adaptive_quadrature() -> None:
    near, far, wavelength = INSTRUMENTS["A"]
    k, z = 2 * np.pi / wavelength, 900.0

    def integrand(kappa: float) -> float:
        a, b = kappa * near * (1 - z / L) / 2, kappa * far * z / L / 2
        swing = np.sin(kappa**2 * z * (L - z) / (2 * k * L)) ** 2
        return float(kappa ** (-8 / 3) * swing * (2 * j1(a) / a) ** 2 * (2 * j1(b) / b) ** 2)

    edges = np.linspace(1e-9, 1500, 150)
    value = sum(quad(integrand, a, b, epsrel=1e-9)[0] for a, b in pairwise(edges))
    expected = 4 * np.pi**2 * k**2 * 0.033 * value
    assert las.variance_weight(np.array([z]), L, near, far, wavelength)[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("name", INSTRUMENTS)
@pytest.mark.parametrize("finite", [True, False])
@pytest.mark.parametrize("sampling", ["mean", "midpoint"])
def test_uniform_profiles_and_mirrors(name: str, finite: bool, sampling: str) -> None:
    near, far, wavelength = INSTRUMENTS[name]
    light = wavelength if finite else None
    weights = las.slice_weights(GRID, (0.0, L), near, far, light, sampling=sampling)  # type: ignore[arg-type]
    assert (weights > 0).all()
    assert weights @ np.full(12, 3e-15) == pytest.approx(3e-15, rel=1e-12)
    mirrored = las.slice_weights(GRID, (0.0, L), far, near, light, sampling=sampling)  # type: ignore[arg-type]
    assert mirrored == pytest.approx(weights[::-1], rel=1e-9)
    # The smaller aperture draws the weight to its end; equal ones share it.
    assert np.sign(weights @ GRID.centres - L / 2) == pytest.approx(np.sign(near - far), abs=1e-9) or near == far


def test_slices_add_up_to_the_variance() -> None:
    near, far, wavelength = INSTRUMENTS["C"]
    cn2 = np.linspace(1, 5, 12) * 1e-15
    fine = SliceGrid.uniform(L, 24)
    coarse = las.slice_weights(GRID, (0.0, L), near, far, wavelength)
    whole = las.slice_weights(fine, (0.0, L), near, far, wavelength)
    assert coarse @ cn2 == pytest.approx(whole @ np.repeat(cn2, 2), rel=1e-5)


def test_a_path_within_the_slices() -> None:
    weights = las.slice_weights(GRID, (445.0, 2225.0), 0.1, 0.1)
    assert weights[:2] == pytest.approx([0, 0], abs=0)
    assert weights == pytest.approx(weights[::-1], rel=1e-9)
    with pytest.raises(ValueError, match="outside the slices"):
        las.slice_weights(GRID, (0.0, 4000.0), 0.1, 0.1)
    with pytest.raises(ValueError, match="must lie beyond"):
        las.slice_weights(GRID, (2000.0, 2000.0), 0.1, 0.1)
    with pytest.raises(ValueError, match="no slice"):
        las.slice_weights(SliceGrid.uniform(L, 2), (100.0, 200.0), 0.1, 0.1, sampling="midpoint")


def test_variance_and_back() -> None:
    cn2 = np.array([1e-16, 1e-14])
    path = (L, 0.145, 0.145, 0.88e-6)
    variance = las.log_amplitude_variance(cn2, *path)
    assert las.cn2_of_variance(variance, *path) == pytest.approx(cn2, rel=1e-12)
    # Cn2 = 4.48 sigma_chi^2 D^(7/3) L^(-3), printed with three digits; the finite wavelength makes 0.4 % of it.
    assert 4.48 * variance * 0.145 ** (7 / 3) / L**3 == pytest.approx(cn2, rel=6e-3)


def test_saturation() -> None:
    limit = las.saturation_limit(L, 0.145, 0.145, 0.88e-6)
    assert limit == pytest.approx(0.18 * 0.145 ** (5 / 3) * 0.88e-6 ** (1 / 3) * L ** (-8 / 3), rel=1e-12)
    # At that Cn2 the disc L / (k rho_0) into which the turbulence scatters is the same part of any aperture, with
    # rho_0 = (0.545 Cn2 k^2 L)^(-3/5) of a spherical wave.
    for length, diameter, wavelength in ((500.0, 0.1, 0.9e-6), (L, 0.145, 0.88e-6), (9800.0, 0.31, 1.5e-6)):
        k = 2 * np.pi / wavelength
        at = las.saturation_limit(length, diameter, diameter, wavelength)
        coherence = (0.545 * at * k**2 * length) ** (-3 / 5)
        assert length / (k * coherence) / diameter == pytest.approx(
            (0.545 * 0.18) ** 0.6 * (2 * np.pi) ** 0.2, rel=1e-9
        )
    assert las.saturation_limit(L, 0.05, 0.145, 0.88e-6) < limit


def test_weights_of_slices_by_quadrature() -> None:
    def weight(z: float) -> float:
        def integrand(log_kappa: float) -> float:
            kappa = math.exp(log_kappa)
            x, y = kappa * 0.025 * (1 - z / 2670), kappa * 0.0725 * z / 2670
            phase = kappa**2 * z * (1 - z / 2670) * 0.88e-6 / (4 * np.pi)
            return kappa ** (-5 / 3) * math.sin(phase) ** 2 * (2 * j1(x) / x) ** 2 * (2 * j1(y) / y) ** 2

        return sum(quad(integrand, a, a + 0.25, limit=400)[0] for a in np.arange(-3, 10, 0.25))

    found = las.slice_weights(GRID, (0.0, L), 0.05, 0.145, 0.88e-6, sampling="midpoint")
    expected = np.array([weight(z) for z in GRID.centres])
    assert np.allclose(found, expected / expected.sum(), rtol=1e-5)
