"""Zernike variances, log-amplitude and stationarity, against published values, closed forms and drawn numbers."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import jv

from coslidar.pipeline import checks, convergence, correlation
from coslidar.pipeline.geometry import Geometry
from coslidar.pipeline.products import LOG_AMPLITUDES, RADIAL_ORDERS
from coslidar.pipeline.response import response
from coslidar.plugins.source_models import Point
from coslidar.plugins.turbulence_spectra import Kolmogorov

MASK = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))
GEOMETRY = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
A = GEOMETRY.n_subapertures
FRAMES = 12_000

#: Variance of one coefficient by radial order, D = r0, from the mean square residuals of Noll 1976, Table IV: 1.0299,
#: 0.134, 0.0648 and 0.0401 after piston, 3, 6 and 10 modes.
NOLL = {1: (1.0299 - 0.134) / 2, 2: (0.134 - 0.0648) / 3, 3: (0.0648 - 0.0401) / 4}


def correlated(covariance: np.ndarray, frames: int, seed: int) -> np.ndarray:
    """Draws of a normal vector."""
    random = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(covariance)
    return random.standard_normal((frames, len(values))) @ (vectors * np.sqrt(np.maximum(values, 0))).T


def found(slopes: np.ndarray, flux: np.ndarray, geometry: Geometry = GEOMETRY) -> correlation.Correlation:
    return correlation.finalise(correlation.accumulate(slopes, flux), geometry)


# --- Zernike -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", NOLL)
def test_variance_by_order_is_that_of_nolls_table(order: int) -> None:
    """Noll printed three or four decimals: 0.5 % of the first orders, 2 % of the third."""
    assert checks.kolmogorov_variance(order) == pytest.approx(NOLL[order], rel=0.02)


@pytest.mark.parametrize("order", RADIAL_ORDERS)
def test_variance_by_order_is_the_integral_of_the_spectrum(order: int) -> None:
    """Spectrum 0.0229 r0^(-5/3) f^(-11/3) times the squared transform of a mode (Noll 1976, Eq. (8)), u = f^(1/3)."""

    def integrand(u: float) -> float:
        k = u**3  # f times the radius of a disc of diameter 1
        transform = (order + 1) * (jv(order + 1, 2 * np.pi * k) / (np.pi * k)) ** 2
        return float(3 * u**2 * 2 * np.pi * k * transform * checks.SPECTRUM * (2 * k) ** (-11 / 3) * 4)

    panels = np.linspace(1e-6, 4, 81)
    whole = sum(quad(integrand, a, b, limit=500)[0] for a, b in pairwise(panels))
    assert checks.kolmogorov_variance(order) == pytest.approx(whole, rel=1e-4)


def test_constants() -> None:
    """6.88 and 0.0229 of every textbook; 2.246 of Sauvage et al. 2021, Sec. 4.1."""
    found = (checks.STRUCTURE, checks.SPECTRUM, checks.NOLL)
    np.testing.assert_allclose(found, (6.88, 0.0229, 2.246), rtol=1e-3)


def test_modes_are_orthonormal_and_those_of_noll() -> None:
    x, y = np.meshgrid(np.linspace(-1, 1, 801), np.linspace(-1, 1, 801), indexing="ij")
    inside = x**2 + y**2 <= 1
    modes = checks._modes(RADIAL_ORDERS)
    assert [order for order, _ in modes] == [1] * 2 + [2] * 3 + [3] * 4 + [4] * 5 + [5] * 6
    values = np.stack([np.polynomial.polynomial.polyval2d(x[inside], y[inside], p) for _, p in modes])
    np.testing.assert_allclose(values @ values.T / inside.sum(), np.eye(20), atol=0.01)  # rim of the grid
    rho, theta = np.hypot(0.3, -0.4), np.arctan2(-0.4, 0.3)
    at = {n: np.polynomial.polynomial.polyval2d(0.3, -0.4, checks.zernike(*n)) for n in [(2, 0, "cos"), (4, 2, "sin")]}
    assert at[2, 0, "cos"] == pytest.approx(np.sqrt(3) * (2 * rho**2 - 1))
    assert at[4, 2, "sin"] == pytest.approx(np.sqrt(10) * (4 * rho**4 - 3 * rho**2) * np.sin(2 * theta))


def test_fit_returns_what_a_phase_of_these_modes_holds() -> None:
    """Mean gradients of a polynomial over squares, by central differences of its mean over the sides."""
    fit = checks.reconstruction(GEOMETRY)
    wanted = np.random.default_rng(1).normal(size=20)
    radius, d = fit.diameter / 2, GEOMETRY.subaperture_size
    side = (np.arange(2000) + 0.5) / 2000 * d - d / 2

    def phase(x: Any, y: Any) -> Any:
        terms = (p for _, p in checks._modes(RADIAL_ORDERS))
        return sum(c * np.polynomial.polynomial.polyval2d(*np.broadcast_arrays(x / radius, y / radius), p)
                   for c, p in zip(wanted, terms, strict=True))  # fmt: skip

    gradients = [
        [
            (phase(x + d / 2, y + side) - phase(x - d / 2, y + side)).mean() / d
            for x, y in GEOMETRY.subaperture_position
        ],
        [
            (phase(x + side, y + d / 2) - phase(x + side, y - d / 2)).mean() / d
            for x, y in GEOMETRY.subaperture_position
        ],
    ]
    slopes = np.ravel(gradients) * GEOMETRY.wavelength / (2 * np.pi)
    np.testing.assert_allclose(fit.matrix @ slopes, wanted, rtol=1e-6)
    assert fit.diameter == pytest.approx(0.35)


def test_gradient_covariance_is_the_response_of_a_layer_at_the_pupil() -> None:
    """The response functions integrate the spectrum in polar coordinates: nothing in common with this."""
    near = replace(GEOMETRY, positions=((0.0, 0.0),))
    maps = response(near, 0.0, Kolmogorov(), [Point()], slope_response="printed")
    strength = 0.423 * (2 * np.pi / near.wavelength) ** 2  # r0^(-5/3) of Cn2 dz = 1
    wanted = checks._gradient_covariance(near.subaperture_index, near.subaperture_size) * strength
    wanted *= (near.wavelength / (2 * np.pi)) ** 2
    entry = correlation.pair_entry(near)
    for kind in range(2):
        block = wanted[kind * A : (kind + 1) * A, kind * A : (kind + 1) * A]
        # 0.033 and 0.423 have three digits: 2e-3 together.
        np.testing.assert_allclose(block, maps[kind].ravel()[entry], rtol=4e-3, atol=4e-3 * block.max())


def test_covariance_of_x_and_y_gradients_by_brute_force() -> None:
    """All modes of a large periodic square, direct sum: its lowest frequency cuts the same off all lags, 3 %."""
    index = np.array([[0, 0], [1, 1], [1, 2], [0, 3]])
    found = checks._gradient_covariance(index, 1.0)
    size, n = 64.0, 512
    f = np.fft.fftfreq(n, size / n)
    fx, fy = np.meshgrid(f, f, indexing="ij")
    r = np.hypot(fx, fy)
    r[0, 0] = np.inf
    psd = checks.SPECTRUM * r ** (-11 / 3) * (2 * np.pi) ** 2 * fx * fy * np.sinc(fx) ** 2 * np.sinc(fy) ** 2 / size**2
    for a in range(4):
        for b in range(4):
            row, col = index[a] - index[b]
            wanted = (psd * np.cos(2 * np.pi * (fx * col + fy * row))).sum()
            assert found[a, 4 + b] == pytest.approx(wanted, abs=0.03 * np.abs(found[:4, 4:]).max())


def test_r0_of_drawn_slopes() -> None:
    """Slopes of Kolmogorov turbulence of known r0 with noise: r0 to 1 %, orders to 4 %: 12,000 independent frames."""
    r0 = 0.11
    unit = checks._gradient_covariance(GEOMETRY.subaperture_index, GEOMETRY.subaperture_size)
    unit *= r0 ** (-5 / 3) * (GEOMETRY.wavelength / (2 * np.pi)) ** 2
    noise = 0.3 * unit[0, 0]
    random = np.random.default_rng(4)
    slopes = np.stack([correlated(unit, FRAMES, seed).reshape(FRAMES, 2, A) for seed in (1, 2)], axis=2)
    slopes += random.normal(scale=np.sqrt(noise), size=slopes.shape)
    flux = random.normal(100, 1, (FRAMES, 2, A))
    result = checks.zernike_check(found(slopes, flux), np.full((2, 2, A), noise), GEOMETRY)
    assert result.r0 == pytest.approx([r0, r0], rel=0.01)
    np.testing.assert_allclose(result.variance, result.kolmogorov, rtol=0.04)
    assert (result.misfit < 0.04).all()
    # Noise that is not taken off is seen as small r0 with too much in the high orders.
    raw = checks.zernike_check(found(slopes, flux), np.zeros((2, 2, A)), GEOMETRY)
    assert (raw.r0 < 0.95 * r0).all()
    assert (raw.misfit > 0.05).all()


def test_aliasing_is_what_the_plain_formula_lacks() -> None:
    """Fitted orders 4 and 5 hold half and three quarters of Noll's variance: higher modes are mistaken for them."""
    fit = checks.reconstruction(GEOMETRY)
    ratio = np.array([fit.expected[fit.order == n].mean() / checks.kolmogorov_variance(n) for n in RADIAL_ORDERS])
    np.testing.assert_allclose(ratio, [1.003, 1.049, 1.194, 0.527, 0.766], atol=2e-3)  # docs/checks.md
    assert ratio[1:].mean() ** (-3 / 5) == pytest.approx(1.077, abs=2e-3)


def test_steeper_spectrum_is_told_from_kolmogorovs() -> None:
    """White slopes instead: the ratio of the orders is off by far."""
    random = np.random.default_rng(5)
    slopes, flux = 1e-5 * random.standard_normal((2000, 2, 2, A)), random.normal(100, 1, (2000, 2, A))
    result = checks.zernike_check(found(slopes, flux), np.zeros((2, 2, A)), GEOMETRY)
    assert (result.misfit > checks.MISFIT).all()


@pytest.mark.parametrize(("size", "orders"), [(1, 0), (2, 2), (3, 3), (4, 4), (6, 5)])
def test_small_pupils_fit_fewer_orders(size: int, orders: int) -> None:
    geometry = replace(GEOMETRY, mask=((1,) * size,) * size, positions=((0.0, 0.0),))
    fit = checks.reconstruction(geometry)
    assert sorted(set(fit.order.tolist())) == list(range(1, orders + 1))
    random = np.random.default_rng(6)
    n = geometry.n_subapertures
    slopes, flux = 1e-5 * random.standard_normal((500, 2, 1, n)), random.normal(100, 1, (500, 1, n))
    result = checks.zernike_check(found(slopes, flux, geometry), np.zeros((2, 1, n)), geometry)
    assert np.isfinite(result.variance[0]).sum() == orders
    assert np.isfinite(result.r0[0]) == (orders >= 2)


def test_dead_subaperture_is_left_out_of_the_fit() -> None:
    unit = checks._gradient_covariance(GEOMETRY.subaperture_index, GEOMETRY.subaperture_size)
    unit *= 0.11 ** (-5 / 3) * (GEOMETRY.wavelength / (2 * np.pi)) ** 2
    slopes = np.stack([correlated(unit, FRAMES, seed).reshape(FRAMES, 2, A) for seed in (1, 2)], axis=2)
    flux = np.random.default_rng(7).normal(100, 1, (FRAMES, 2, A))
    slopes[:, :, 1, 4], flux[:, 1, 4] = np.nan, np.nan
    result = checks.zernike_check(found(slopes, flux), np.zeros((2, 2, A)), GEOMETRY)
    assert result.r0 == pytest.approx([0.11, 0.11], rel=0.01)


# --- log-amplitude -----------------------------------------------------------------------------------------


def test_lognormal_flux_has_a_gaussian_log_amplitude() -> None:
    """sigma_I^2 = exp(4 sigma^2) - 1 and mean -sigma^2; 8000 x 20 samples: sigma to 0.2 %, distance to 0.3 %."""
    random = np.random.default_rng(8)
    sigma = 0.17
    flux = 500 * np.exp(2 * (random.normal(0, sigma, (24_000, 2, A)) - sigma**2))
    result = checks.log_amplitude(flux, flux.mean(axis=0))
    assert result.deviation == pytest.approx([sigma, sigma], rel=0.01)
    assert result.mean == pytest.approx([-(sigma**2)] * 2, abs=0.001)
    assert (result.distance < 0.005).all()
    assert (result.histogram.sum(axis=1) == 8000 * A).all()
    centre = (result.histogram @ LOG_AMPLITUDES) / (8000 * A)
    assert centre == pytest.approx(result.mean, abs=2e-4)


def test_exponential_flux_is_no_lognormal_one() -> None:
    """Saturated speckle: ln of an exponential variable is a Gumbel variable of deviation pi / sqrt(6) and mean -0.577,
    whose cumulative distribution exp(-exp(-x)), mirrored, is 0.07 off a Gaussian's at most."""
    random = np.random.default_rng(9)
    flux = 500 * random.exponential(1, (24_000, 1, A))
    result = checks.log_amplitude(flux, flux.mean(axis=0))
    assert result.deviation[0] == pytest.approx(np.pi / np.sqrt(6) / 2, rel=0.01)
    assert result.mean[0] == pytest.approx(-0.5772 / 2, rel=0.02)
    assert result.distance[0] > checks.DISTANCE


def test_no_light_no_histogram() -> None:
    flux = np.full((100, 2, A), np.nan)
    flux[:, 0] = np.random.default_rng(1).normal(0.0, 1.0, (100, A))
    result = checks.log_amplitude(flux, np.array([np.full(A, 1.0), np.full(A, np.nan)]))
    assert np.isnan(result.deviation[1])
    assert result.histogram[1].sum() == 0
    assert result.histogram[0].sum() == (flux[::3, 0] > 0).sum()


# --- stationarity ------------------------------------------------------------------------------------------


def record(factor: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Slopes and fluxes of a known covariance, correlated over some 8 frames, whose variance goes as `factor`."""
    frames = len(factor)
    unit = checks._gradient_covariance(GEOMETRY.subaperture_index, GEOMETRY.subaperture_size)
    kernel = np.exp(-(np.arange(-12, 13) ** 2) / 18)
    kernel /= np.sqrt((kernel**2).sum())

    def smooth(values: np.ndarray) -> np.ndarray:
        return np.apply_along_axis(np.convolve, 0, values, kernel, "same")

    slopes = np.stack([smooth(correlated(unit, frames, 10 * seed + s)).reshape(frames, 2, A) for s in (1, 2)], axis=2)
    flux = smooth(np.random.default_rng(seed).standard_normal((frames, 2 * A))).reshape(frames, 2, A)
    root = np.sqrt(factor)
    return 1e-6 * slopes * root[:, None, None, None], 100 * (1 + 0.1 * flux * root[:, None, None])


def steadiness(slopes: np.ndarray, flux: np.ndarray) -> checks.Stationarity:
    noise = convergence.lagged(slopes, flux, GEOMETRY).covariance
    return checks.stationarity(slopes, flux, found(slopes, flux), noise, GEOMETRY)


def test_thirds_of_steady_records_differ_as_said() -> None:
    """The largest of three deviations that add up to zero has a root mean square of 1.25 (drawn), 20 records: 16 %."""
    results = [steadiness(*record(np.ones(3000), seed)) for seed in range(20)]
    pull = np.array([result.deviation / result.error for result in results])
    drawn = np.random.default_rng(3).standard_normal((100_000, 3))
    drawn = (drawn - drawn.mean(axis=1, keepdims=True)) / np.sqrt(2 / 3)
    wanted = np.sqrt((np.abs(drawn).max(axis=1) ** 2).mean())
    np.testing.assert_allclose(np.sqrt((pull**2).mean(axis=0)), wanted, rtol=0.35)
    assert pull.max() < 4


def test_changing_turbulence_is_seen() -> None:
    """Variances of 1, 2 and 3: the last third is 50 % above the mean."""
    slopes, flux = record(np.repeat([1.0, 2.0, 3.0], 1000), 3)
    result = steadiness(slopes, flux)
    np.testing.assert_allclose(result.deviation, 0.5, atol=0.12)
    assert (result.deviation > 4 * result.error).all()
    assert (result.deviation > checks.UNSTEADY).all()


def test_missing_samples_do_not_look_like_change() -> None:
    slopes, flux = record(np.ones(3000), 4)
    whole = steadiness(slopes, flux)
    lost = np.zeros(3000, dtype=bool)
    lost[2300:2700] = True
    slopes[lost, :, 1], flux[lost, 1] = np.nan, np.nan
    result = steadiness(slopes, flux)
    assert np.isfinite(result.deviation).all()
    np.testing.assert_allclose(result.deviation, whole.deviation, atol=2 * whole.error.max())
