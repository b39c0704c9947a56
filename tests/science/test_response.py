"""The response functions against quadratures and closed forms written apart from them.

Nothing here imports the integrand of the model: the brute-force integral is an adaptive cubature in logarithmic polar
coordinates of the frequency at the layer, with the transforms of the sources written out again.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.integrate import cubature, quad, quad_vec
from scipy.special import gamma

import coslidar.pipeline.response
from coslidar.pipeline.band import Band
from coslidar.pipeline.geometry import MAP_KINDS, Geometry, SliceGrid
from coslidar.pipeline.response import response, response_matrix
from coslidar.plugins.source_models import Gaussian, Image, Point
from coslidar.plugins.turbulence_spectra import Hill, Kolmogorov, PowerLaw, Tatarskii, VonKarman

MASK = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))
SCINDAR = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
NEAR_INFRARED = Geometry(((1,) * 6,) * 6, 0.05, 1500.0, 1.55e-6, ((0.0, -0.3), (0.0, 0.3)))
OBLIQUE = Geometry(((1, 1, 1), (1, 1, 1)), 0.1, 2000.0, 3.8e-6, ((-0.2, 0.1), (0.1, -0.3)))
STARS = Geometry(((1, 1), (1, 1), (1, 1)), 0.06, math.inf, 0.85e-6, ((0.0, -1e-5), (2e-6, 1e-5)))
LAMPS = (Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm"),) * 2
UNEQUAL = (Gaussian(fwhm_x="4 cm", fwhm_y="12 cm"), Gaussian(fwhm_x="9 cm", fwhm_y="5 cm"))
KOLMOGOROV = Kolmogorov()
#: What is promised: error of each map over its maximum.
PROMISE = 1e-6

Transforms = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def gaussian(fwhm_x: float, fwhm_y: float) -> Transforms:
    """P~ and the transforms of x P and y P, from the standard deviations."""
    vx, vy = (fwhm**2 / (8 * math.log(2)) for fwhm in (fwhm_x, fwhm_y))

    def transforms(fx: np.ndarray, fy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        p = np.exp(-2 * np.pi**2 * (vx * fx**2 + vy * fy**2))
        return p, -2j * np.pi * vx * fx * p, -2j * np.pi * vy * fy * p

    return transforms


def point(fx: np.ndarray, fy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A point source."""
    return np.ones_like(fx), np.zeros_like(fx), np.zeros_like(fx)


@dataclass(frozen=True)
class BruteForce:
    """W by adaptive cubature over ln q and the angle, q = f L / (L - z) the frequency at the layer."""

    geometry: Geometry
    z: float
    first: Transforms
    second: Transforms
    printed: bool = False
    q_max: float = 60.0
    q_min: float = 1e-28
    psd: Callable[[np.ndarray], np.ndarray] = lambda q: 0.033 * (2 * np.pi) ** (-2 / 3) * q ** (-11 / 3)
    #: Wavelengths and shares of a quadrature over the detector's band; the geometry's alone without.
    colours: tuple[np.ndarray, np.ndarray] | None = None

    def scales(self) -> tuple[float, float, float]:
        """Pupil over layer frequency, source over layer frequency, and image shift per source displacement."""
        if self.geometry.infinite:
            return 1.0, self.z, 1.0
        length = self.geometry.path_length
        return 1 - self.z / length, self.z / length, 1 / length

    def density(self, qx: np.ndarray, qy: np.ndarray) -> np.ndarray:
        """Spectral density of xx, yy, ii auto and cross, without the phase of the separation, (6, n)."""
        g = self.geometry
        shrink, blur, image = self.scales()
        fx, fy = shrink * qx, shrink * qy
        aperture = np.sinc(fx * g.subaperture_size) * np.sinc(fy * g.subaperture_size)
        wavelengths, shares = self.colours or (np.array([g.wavelength]), np.ones(1))
        x = np.pi * np.multiply.outer(self.z * shrink * (qx**2 + qy**2), wavelengths)
        cos_x, k_sin_x = np.cos(x) @ shares, np.sin(x) @ (shares * 2 * np.pi / wavelengths)
        signals = []
        for transforms in (self.first, self.second):
            p, mx, my = (np.conj(t) for t in transforms(blur * qx, blur * qy))
            glint = 0.0 if self.printed else 2 * image * k_sin_x * aperture
            signals.append(
                (
                    -2j * np.pi * fx * aperture * cos_x * p + glint * mx,
                    -2j * np.pi * fy * aperture * cos_x * p + glint * my,
                    2 * k_sin_x * aperture * p,
                )
            )
        sx, sy = g.separation
        shift = np.exp(-2j * np.pi * blur * (qx * sx + qy * sy))
        auto = [(abs(a) ** 2 + abs(b) ** 2) / 2 for a, b in zip(*signals, strict=True)]
        cross = [a * np.conj(b) * shift for a, b in zip(*signals, strict=True)]
        return self.psd(np.hypot(qx, qy)) * np.stack([*auto, *cross])

    def maps(self, separations: np.ndarray) -> np.ndarray:
        """W of each kind, in the order of the data vector, at separations (n, 2): (6, n)."""
        shrink = self.scales()[0]

        def integrand(nodes: np.ndarray) -> np.ndarray:
            q = np.exp(nodes[:, 0])
            qx, qy = q * np.cos(nodes[:, 1]), q * np.sin(nodes[:, 1])
            turn = np.exp(2j * np.pi * shrink * (np.outer(qx, separations[:, 0]) + np.outer(qy, separations[:, 1])))
            return ((q**2 * self.density(qx, qy)).T[:, :, None] * turn[:, None, :]).real

        # Slopes fall as q^(1/3) toward zero: below 1e-28 lies less than 1e-9 of them.
        edges = [math.log(self.q_min), -20.0, -6.0, *np.log(np.linspace(0.02, 1, 17) * self.q_max)]

        def integral(scale: np.ndarray, **tolerance: float) -> np.ndarray:
            total = np.zeros((6, len(separations)))
            for a, b in pairwise(edges):
                for turn in range(8):
                    corners = [a, turn * np.pi / 4], [b, (turn + 1) * np.pi / 4]
                    total += cubature(
                        lambda nodes: integrand(nodes) / scale[:, None], *corners, rule="gk21", **tolerance
                    ).estimate
            return total

        rough = np.abs(integral(np.ones(6), rtol=1e-2)).max(axis=1)
        xx, yy, ii, xx_cross, yy_cross, ii_cross = integral(rough, rtol=0.0, atol=5e-9) * rough[:, None]
        return np.stack([xx, yy, xx_cross, yy_cross, ii, ii_cross])


def picked(maps: np.ndarray, geometry: Geometry, lags: list[tuple[int, int]]) -> np.ndarray:
    """Map entries at lags (dx, dy) in subapertures, (6, n)."""
    return np.stack([maps[:, geometry.p - 1 + dy, geometry.q - 1 + dx] for dx, dy in lags], axis=1)


def assert_promise(found: np.ndarray, expected: np.ndarray, maps: np.ndarray, promise: float = PROMISE) -> None:
    """Every kind agrees to `promise` of the maximum of its map."""
    size = np.abs(maps).max(axis=(1, 2))
    error = np.abs(found - expected).max(axis=1) / size
    assert np.all(error < promise), dict(zip(MAP_KINDS, error, strict=True))


LAGS = [(0, 0), (1, 0), (0, 1), (2, 3), (-4, 4)]
BLURRED = gaussian(0.089, 0.063)


@pytest.mark.parametrize("printed", [False, True])
@pytest.mark.parametrize(
    ("z", "q_max"),
    [pytest.param(778.75, 110.0, marks=pytest.mark.slow), (1446.25, 60.0), (2113.75, 45.0), (2558.75, 40.0)],
)
def test_brute_force_along_the_path(z: float, q_max: float, printed: bool) -> None:
    expected = BruteForce(SCINDAR, z, BLURRED, BLURRED, printed, q_max).maps(0.07 * np.array(LAGS))
    maps = response(SCINDAR, z, KOLMOGOROV, LAMPS, "printed" if printed else "centroid")
    assert_promise(picked(maps, SCINDAR, LAGS), expected, maps)


@pytest.mark.slow
def test_brute_force_near_the_pupil() -> None:
    # No source blurs a layer this near: what lies beyond q_max is the tail of the aperture filter, 1e-7 here.
    lags = [(0, 0), (0, 1), (-4, 4)]
    expected = BruteForce(SCINDAR, 333.75, BLURRED, BLURRED, False, 260.0).maps(0.07 * np.array(lags))
    maps = response(SCINDAR, 333.75, KOLMOGOROV, LAMPS)
    assert_promise(picked(maps, SCINDAR, lags), expected, maps)


@pytest.mark.slow
@pytest.mark.parametrize("printed", [False, True])
def test_brute_force_with_two_different_sources_and_a_rectangular_mask(printed: bool) -> None:
    lags = [(0, 0), (1, 0), (-2, 1)]
    sources = gaussian(0.04, 0.12), gaussian(0.09, 0.05)
    expected = BruteForce(OBLIQUE, 1500.0, *sources, printed, 55.0).maps(0.1 * np.array(lags))
    maps = response(OBLIQUE, 1500.0, KOLMOGOROV, UNEQUAL, "printed" if printed else "centroid")
    assert_promise(picked(maps, OBLIQUE, lags), expected, maps)


@pytest.mark.slow
def test_brute_force_in_the_near_infrared() -> None:
    lags = [(0, 0), (0, 2), (5, -5)]
    lamp = gaussian(0.05, 0.05)
    expected = BruteForce(NEAR_INFRARED, 900.0, lamp, lamp, False, 75.0).maps(0.05 * np.array(lags))
    maps = response(NEAR_INFRARED, 900.0, KOLMOGOROV, [Gaussian(fwhm_x="5 cm", fwhm_y="5 cm")] * 2)
    assert_promise(picked(maps, NEAR_INFRARED, lags), expected, maps)


def test_brute_force_for_sources_at_infinity() -> None:
    lags = [(0, 0), (1, 0), (0, -2)]
    star = gaussian(4e-6, 6e-6)
    expected = BruteForce(STARS, 8000.0, star, star, False, 60.0).maps(0.06 * np.array(lags))
    maps = response(STARS, 8000.0, KOLMOGOROV, [Gaussian(fwhm_x="4 urad", fwhm_y="6 urad")] * 2)
    assert_promise(picked(maps, STARS, lags), expected, maps)


@pytest.mark.parametrize(
    ("spectrum", "q_min"),
    [
        (VonKarman(outer_scale="3 m"), 1e-12),
        (Tatarskii(inner_scale="2 cm", outer_scale="20 m"), 1e-12),
        (Hill(inner_scale="7 mm"), 1e-28),
        (PowerLaw(exponent=3.2), 1e-14),
        (PowerLaw(exponent=3.8), 1e-46),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_brute_force_with_other_spectra(spectrum: object, q_min: float) -> None:
    lags = [(0, 0), (0, 1), (3, 2)]
    expected = BruteForce(SCINDAR, 1446.25, BLURRED, BLURRED, q_min=q_min, psd=spectrum.psd).maps(0.07 * np.array(lags))
    maps = response(SCINDAR, 1446.25, spectrum, LAMPS)
    assert_promise(picked(maps, SCINDAR, lags), expected, maps)


def colours_of(band: Band) -> tuple[np.ndarray, np.ndarray]:
    """Sixteen wavelengths of Gauss-Legendre in each piece of a band, and their shares of its light."""
    nodes, rule = np.polynomial.legendre.leggauss(16)
    pieces = list(pairwise(band.wavelengths))
    wavelengths = np.concatenate([(a + b) / 2 + (b - a) / 2 * nodes for a, b in pieces])
    light = np.concatenate([(b - a) / 2 * rule for a, b in pieces])
    light *= np.interp(wavelengths, band.wavelengths, band.weights)
    return wavelengths, light / light.sum()


@pytest.mark.parametrize(
    ("z", "q_max", "printed"),
    [(1446.25, 60.0, False), pytest.param(2558.75, 40.0, True, marks=pytest.mark.slow)],
)
def test_brute_force_over_a_band(z: float, q_max: float, printed: bool) -> None:
    # Far wider and more skewed than that of the instrument, so that an error in it shows.
    band = Band((2e-6, 2.5e-6, 5e-6), (0.2, 3.0, 1.0))
    lags = [(0, 0), (0, 1)]
    brute = BruteForce(SCINDAR, z, BLURRED, BLURRED, printed, q_max, colours=colours_of(band))
    expected = brute.maps(0.07 * np.array(lags))
    maps = response(SCINDAR, z, KOLMOGOROV, LAMPS, "printed" if printed else "centroid", band=band)
    assert_promise(picked(maps, SCINDAR, lags), expected, maps)
    alone = response(SCINDAR, z, KOLMOGOROV, LAMPS, "printed" if printed else "centroid")
    assert np.abs(maps[4] - alone[4]).max() > 30 * PROMISE * maps[4].max()


def test_a_narrow_band_is_its_wavelength() -> None:
    # Widths enter squared: 2 nm of 3.8 um change nothing that is promised.
    narrow = Band((3.799e-6, 3.801e-6), (1.0, 1.0))
    maps = response(SCINDAR, 2113.75, KOLMOGOROV, LAMPS, band=narrow)
    alone = response(SCINDAR, 2113.75, KOLMOGOROV, LAMPS)
    assert_promise(maps.reshape(6, -1), alone.reshape(6, -1), alone)


@pytest.mark.slow
def test_an_asymmetric_source_scintillates_like_its_pixels() -> None:
    """An L-shaped image, off the axes' symmetry, against the sum over its pixels written out."""
    image = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    step = 0.03
    weights = image / image.sum()
    y, x = (places - (weights * places).sum() for places in np.indices(image.shape) * step)

    def transforms(fx: np.ndarray, fy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        # Each pixel by the three-point rule of Gauss along both axes: exact to (pi f h)^6 / 1e5 of its transform.
        offsets, rule = np.polynomial.legendre.leggauss(3)
        p = mx = my = 0.0
        for (i, j), weight in np.ndenumerate(weights):
            for u, a in zip(offsets * step / 2, rule / 2, strict=True):
                for v, b in zip(offsets * step / 2, rule / 2, strict=True):
                    part = weight * a * b * np.exp(-2j * np.pi * (fx * (x[i, j] + u) + fy * (y[i, j] + v)))
                    p, mx, my = p + part, mx + part * (x[i, j] + u), my + part * (y[i, j] + v)
        return p, mx, my

    lags = [(0, 0), (1, 0), (-2, 1)]
    expected = BruteForce(OBLIQUE, 1500.0, transforms, gaussian(0.09, 0.05), q_max=45.0).maps(0.1 * np.array(lags))
    source = Image(pixel_size="3 cm", intensity=tuple(map(tuple, image.tolist())))
    maps = response(OBLIQUE, 1500.0, KOLMOGOROV, [source, UNEQUAL[1]])
    # The rule over a pixel is off by 1e-4 where the image has lost most of its light.
    assert_promise(picked(maps, OBLIQUE, lags), expected, maps, 1e-4)


# ---------------------------------------------------------------------------------------------- closed forms


def structure_constant() -> float:
    """C in D(r) = C r^(5/3), the structure function of the optical path of a layer with Cn2 dz = 1 (2.914)."""
    p = 8 / 3
    bessel = np.pi / (2**p * gamma((p + 1) / 2) ** 2 * np.sin(np.pi * (p - 1) / 2))
    return 4 * np.pi * 0.033 * (2 * np.pi) ** (-2 / 3) * (2 * np.pi) ** (5 / 3) * bessel


@pytest.mark.parametrize(("dx", "dy"), [(0, 0), (1, 0), (0, 1), (2, 1), (4, -3)])
def test_slopes_of_a_layer_at_the_pupil_follow_the_structure_function(dx: int, dy: int) -> None:
    # The mean x-gradient over a square is the difference of its two sides: W_xx is the second difference along x of
    # D(r) / (2 d^2), averaged over the triangle that two sides span along y.
    d = 0.07
    c = structure_constant()
    assert c == pytest.approx(2.914, rel=1e-3)

    def second_difference(v: float, x: int, y: int) -> float:
        r = [np.hypot((x + n) * d, (y + v) * d) ** (5 / 3) for n in (1, -1, 0)]
        return (1 - abs(v)) * c * (r[0] + r[1] - 2 * r[2]) / (2 * d**2)

    maps = response(SCINDAR, 0.0, KOLMOGOROV, LAMPS)
    for kind, x, y in (("xx_auto", dx, dy), ("yy_auto", dy, dx), ("xx_cross", dx, dy)):
        points = [v for v in (-y, 0.0) if -1 <= v <= 1]
        expected = quad(second_difference, -1, 1, args=(x, y), points=points, epsabs=0, epsrel=1e-10, limit=200)[0]
        found = maps[MAP_KINDS.index(kind), 4 + dy, 4 + dx]
        assert abs(found - expected) < PROMISE * maps[0].max()
    assert np.all(maps[4:] == 0)


@pytest.mark.parametrize(("tilt", "sasiela"), [("zernike", 6.08), ("gradient", 5.675)])
def test_tilt_of_a_circular_aperture(tilt: str, sasiela: float) -> None:
    # Sasiela, Electromagnetic Wave Propagation in Turbulence (https://doi.org/10.1117/3.741372): variance over both
    # axes of Zernike and gradient tilt, 6.08 and 5.675 D^(-1/3) integral of Cn2 dz. Given to three or four digits.
    diameter = 0.35
    one = Geometry(((1,),), diameter, math.inf, 3.8e-6, ((0.0, 0.0),))
    maps = response(one, 0.0, KOLMOGOROV, [Point()], aperture="circular", tilt=tilt)
    assert maps[0, 0, 0] + maps[1, 0, 0] == pytest.approx(sasiela * diameter ** (-1 / 3), rel=1.5e-3)


def test_zernike_tilt_of_a_square_aperture() -> None:
    # Plane fitted by least squares to the phase: 12 / d^4 times the integral of x phase. As a double integral of
    # -D(r) / 2 over the aperture, with the weights (12 x / d^4) (12 x' / d^4) gathered over x - x'.
    d = 0.07
    one = Geometry(((1,),), d, math.inf, 3.8e-6, ((0.0, 0.0),))
    nodes, rule = np.polynomial.legendre.leggauss(80)

    def correlation(u: np.ndarray) -> np.ndarray:
        """Integral of x (x + u) over the overlap of two unit intervals, |u| < 1."""
        return (1 - u) ** 3 / 12 - u**2 * (1 - u) / 4

    # r^(5/3) has a cusp at zero only: one quadrant in polar coordinates up to the corner, by symmetry.
    total = 0.0
    for low, high in ((0.0, np.pi / 4), (np.pi / 4, np.pi / 2)):
        for node, weight in zip(nodes, rule, strict=True):
            angle = (low + high) / 2 + (high - low) / 2 * node
            edge = 1 / max(np.cos(angle), np.sin(angle))
            r = edge * (nodes + 1) / 2
            u, v = r * np.cos(angle), r * np.sin(angle)
            total += weight * (high - low) / 2 * np.sum(rule * edge / 2 * r * r ** (5 / 3) * correlation(u) * (1 - v))
    expected = -4 * 144 * structure_constant() / 2 * d ** (5 / 3) / d**2 * total
    maps = response(one, 0.0, KOLMOGOROV, [Point()], tilt="zernike")
    assert maps[0, 0, 0] == pytest.approx(expected, rel=2e-6)


def confluent(a: float, y: np.ndarray) -> np.ndarray:
    """1F1(a; 1; i y): Taylor series in extended precision, asymptotic series beyond y = 22; good to 1e-9."""
    out = np.empty(y.shape, complex)
    far = y > 22
    z = (1j * y[~far]).astype(np.clongdouble)
    term = np.ones_like(z)
    total = term.copy()
    for n in range(1, 140):
        term = term * (np.longdouble(a) + n - 1) * z / np.longdouble(n) ** 2
        total = total + term
    out[~far] = total
    z = 1j * y[far]

    def series(p: float, w: np.ndarray) -> np.ndarray:
        term = np.ones_like(w)
        total = term.copy()
        shrinking = np.ones(w.shape, bool)
        for n in range(1, 24):
            following = term * (p + n - 1) ** 2 / (n * w)
            shrinking &= np.abs(following) < np.abs(term)
            term = np.where(shrinking, following, 0)
            total = total + term
        return total

    out[far] = np.exp(z) * z ** (a - 1) / gamma(a) * series(1 - a, z) + (-z) ** -a / gamma(1 - a) * series(a, -z)
    return out


def point_scintillation(r: np.ndarray, z: float, geometry: Geometry) -> np.ndarray:
    """Covariance of the intensity of a point source at two points r apart: its Hankel transform in closed form."""
    stretch = geometry.scaling(z)
    k = 2 * np.pi / geometry.wavelength
    a = 2 * np.pi * geometry.wavelength * z * stretch
    mu, c = -5 / 3, 2 * np.pi * r
    chirp = gamma(mu / 2) / (2 * (1j * a) ** (mu / 2)) * confluent(mu / 2, c**2 / (4 * a))
    plain = 0.5 * (2 / c) ** mu * gamma(mu / 2) / gamma(1 - mu / 2)
    return 0.033 * (2 * np.pi) ** (-2 / 3) * stretch ** (-5 / 3) * 4 * k**2 * np.pi * (plain - chirp.real)


@pytest.mark.parametrize("z", [111.25, 778.75, 1335.0, 2113.75])
def test_point_sources_scintillate_as_in_closed_form(z: float) -> None:
    # Over square apertures, the covariance between points averaged over the product of two triangles.
    d = SCINDAR.subaperture_size
    nodes, rule = np.polynomial.legendre.leggauss(80)
    offset = np.concatenate([-(nodes + 1) / 2, (nodes + 1) / 2]) * d
    triangle = np.concatenate([rule, rule]) / 2 * (1 - np.abs(offset) / d)
    maps = response(SCINDAR, z, KOLMOGOROV, [Point()] * 2)
    shift = SCINDAR.magnification(z) * 0.8
    # Nearer than 700 m the cusp of the covariance at r = 0 lies inside the cells of this quadrature for the cross map.
    for kind, moved in (("ii_auto", 0.0), ("ii_cross", shift))[: 1 if z < 700 else 2]:
        found = maps[MAP_KINDS.index(kind)]
        for dx, dy in ((0, 0), (1, 0), (0, 1), (0, 4), (-4, 4)):
            r = np.hypot(dx * d + offset, (dy * d - moved + offset)[:, None])
            expected = triangle @ point_scintillation(r, z, SCINDAR) @ triangle
            assert abs(found[4 + dy, 4 + dx] - expected) < PROMISE * np.abs(found).max(), (kind, dx, dy)


@pytest.mark.slow
def test_point_sources_and_a_shift_of_18_m() -> None:
    test_point_sources_scintillate_as_in_closed_form(2558.75)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "turns"), [(8, 18), (9, 32), (10, 95)])
def test_slice_means_of_point_sources_in_closed_form(number: int, turns: int) -> None:
    """The fringe of two points turns many times in these slices, and is taken from their ends.

    The closed form of a layer, over Gauss-Legendre panels in m = z / (L - z), in which the fringe turns evenly: eight
    nodes a turn are good to 1e-9.
    """
    d, length = SCINDAR.subaperture_size, SCINDAR.path_length
    nodes, rule = np.polynomial.legendre.leggauss(24)
    offset = np.concatenate([-(nodes + 1) / 2, (nodes + 1) / 2]) * d
    triangle = np.concatenate([rule, rule]) / 2 * (1 - np.abs(offset) / d)
    z0, z1 = length * number / 12, length * (number + 1) / 12
    edges = np.linspace(z0 / (length - z0), z1 / (length - z1), math.ceil(turns / 2.5) + 1)
    lags = [(0, 0), (0, 3), (2, 4)]
    expected = np.zeros(3)
    nodes, rule = np.polynomial.legendre.leggauss(20)
    for a, b in pairwise(edges):
        for m, weight in zip((a + b) / 2 + (b - a) / 2 * nodes, (b - a) / 2 * rule, strict=True):
            z = length * m / (1 + m)
            for place, (dx, dy) in enumerate(lags):
                r = np.hypot(dx * d + offset, (dy * d - 0.8 * m + offset)[:, None])
                layer = triangle @ point_scintillation(r, z, SCINDAR) @ triangle
                expected[place] += weight * length / (1 + m) ** 2 * layer
    matrix = response_matrix(SCINDAR, SliceGrid((z0, z1)), KOLMOGOROV, [Point()] * 2)
    maps = matrix[:, 0].reshape(6, 9, 9)
    assert np.abs(picked(maps, SCINDAR, lags)[5] - expected).max() < PROMISE * np.abs(maps[5]).max()


@pytest.mark.parametrize("length", [2670.0, math.inf])
def test_scintillation_of_a_vanishing_aperture_is_the_rytov_index(length: float) -> None:
    # 4 k^2 integral of S_n sin^2: 2.25 k^(7/6) [z (1 - z / L)]^(5/6), plane and spherical. The aperture of 10 um
    # takes away a part of the order of (d / Fresnel scale)^(5/3), 7e-7 here.
    z = 1000.0
    one = Geometry(((1,),), 1e-5, length, 3.8e-6, ((0.0, 0.0),))
    k = 2 * np.pi / 3.8e-6
    constant = -4 * 0.033 * np.pi**2 * gamma(-5 / 6) * np.cos(5 * np.pi / 12)
    assert constant == pytest.approx(2.25, rel=2e-3)
    expected = constant * k ** (7 / 6) * (z * (1 - z / length)) ** (5 / 6)
    found = response(one, z, KOLMOGOROV, [Point()])[4, 0, 0]
    assert found == pytest.approx(expected, rel=2e-6)
    assert found < expected


def test_a_large_outer_scale_takes_the_same_from_all_slopes_and_nothing_from_scintillation() -> None:
    # Slopes lose pi (2 pi)^2 c (1 - z/L)^2 integral of f^3 [f^(-11/3) - (f^2 + 1/L0^2)^(-11/6)] df at every separation.
    z, outer = 1001.25, 1e5
    missing = response(SCINDAR, z, KOLMOGOROV, LAMPS) - response(SCINDAR, z, VonKarman(outer_scale="100 km"), LAMPS)
    tail = -0.5 * gamma(-1 / 6) / gamma(11 / 6)
    expected = (
        np.pi * (2 * np.pi) ** 2 * 0.033 * (2 * np.pi) ** (-2 / 3) * tail * outer ** (-1 / 3) * (1 - z / 2670) ** 2
    )
    assert np.allclose(missing[:4], expected, rtol=3e-5, atol=0)
    assert np.abs(missing[4:]).max() < 1e-9 * 1e9


def test_power_law_of_kolmogorov() -> None:
    # Its exact constant is 0.033005; the paper's 0.033 is rounded.
    ratio = response(SCINDAR, 1001.25, PowerLaw(exponent=11 / 3), LAMPS) / response(SCINDAR, 1001.25, KOLMOGOROV, LAMPS)
    assert np.allclose(ratio[:2], 1.000163, atol=2e-6)


# ------------------------------------------------------------------------------------------------- the matrix


@pytest.mark.parametrize("number", [pytest.param(1, marks=pytest.mark.slow), 5, 11])
def test_slice_mean_is_the_integral_over_the_slice(number: int) -> None:
    # Adaptive quadrature of the response of a layer, which the tests above compare with brute force; one of them
    # reaches the sources.
    edges = 2670.0 * number / 12, 2670.0 * (number + 1) / 12
    expected, _ = quad_vec(
        lambda z: response(SCINDAR, z, KOLMOGOROV, LAMPS) / SCALE, *edges, epsrel=1e-8, norm="max", quadrature="gk15"
    )
    matrix = response_matrix(SCINDAR, SliceGrid(edges), KOLMOGOROV, LAMPS)
    found = matrix[:, 0].reshape(expected.shape)
    expected = expected * SCALE
    assert_promise(found.reshape(6, -1), expected.reshape(6, -1), found)


#: Rough size of a response of each kind, so that one norm serves slopes and scintillation.
SCALE = np.array([1.0, 1.0, 1.0, 1.0, 1e9, 1e6])[:, None, None]


@pytest.mark.slow
def test_slice_mean_at_the_pupil() -> None:
    # Two nested-rule panels an eighth as wide, so that neither the panels nor their borders are those of the model.
    edges = np.linspace(0, 222.5, 14)
    fine = response_matrix(SCINDAR, SliceGrid(tuple(edges)), KOLMOGOROV, LAMPS).sum(axis=1).reshape(6, 9, 9)
    whole = response_matrix(SCINDAR, SliceGrid((0.0, 222.5)), KOLMOGOROV, LAMPS).reshape(6, 9, 9)
    assert_promise(whole.reshape(6, -1), fine.reshape(6, -1), fine)


def test_mean_and_midpoint_differ_most_in_the_first_and_last_slice() -> None:
    grid = SliceGrid((0.0, 222.5))
    last = SliceGrid((2447.5, 2670.0))
    for edges, expected in ((grid, 0.28), (last, 0.34)):
        mean = response_matrix(SCINDAR, edges, KOLMOGOROV, LAMPS)[:, 0].reshape(6, 9, 9)[4, 4, 4]
        middle = response_matrix(SCINDAR, edges, KOLMOGOROV, LAMPS, sampling="midpoint")[:, 0].reshape(6, 9, 9)[4, 4, 4]
        assert mean / middle - 1 == pytest.approx(expected, abs=0.01)


def test_midpoint_column_is_the_layer_times_the_thickness() -> None:
    grid = SliceGrid((1000.0, 1300.0))
    column = response_matrix(SCINDAR, grid, KOLMOGOROV, LAMPS, sampling="midpoint")[:, 0]
    assert np.array_equal(column, 300.0 * response(SCINDAR, 1150.0, KOLMOGOROV, LAMPS).ravel())


def test_first_order_values_of_the_sample(shared_truth: dict[str, object]) -> None:
    # Computed elsewhere with the printed slope response, layers at mid-slice and no vibration.
    cn2 = np.array(shared_truth["cn2"])
    grid = SliceGrid.uniform(2670.0, 12)
    maps = (
        response_matrix(SCINDAR, grid, KOLMOGOROV, LAMPS, sampling="midpoint", slope_response="printed") @ cn2
    ).reshape(6, 9, 9)
    variance = shared_truth["slope_variance_rad2"]["first_order_theory"]
    assert maps[4, 4, 4] == pytest.approx(shared_truth["sigma_I2"]["first_order_theory"], rel=1e-6)
    assert maps[0, 4, 4] == pytest.approx(variance["xx"], rel=1e-6)
    assert maps[1, 4, 4] == pytest.approx(variance["yy"], rel=1e-6)


# -------------------------------------------------------------------------------------------- signs and layout


def test_the_ridge_of_the_cross_maps_lies_toward_the_second_source() -> None:
    # m s is one subaperture at 214.8 m, and the second source stands at +y of the first.
    z = 2670.0 * 0.07 / 0.87
    maps = response(SCINDAR, z, KOLMOGOROV, LAMPS)
    for kind in ("xx_cross", "yy_cross", "ii_cross"):
        assert np.unravel_index(np.argmax(maps[MAP_KINDS.index(kind)]), (9, 9)) == (5, 4)
    across = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.4, 0.0), (-0.4, 0.0)))
    maps = response(across, z, KOLMOGOROV, LAMPS)
    assert np.unravel_index(np.argmax(maps[MAP_KINDS.index("ii_cross")]), (9, 9)) == (4, 3)


def test_transposing_everything_transposes_the_maps_and_swaps_the_slopes() -> None:
    turned = Geometry(
        tuple(zip(*OBLIQUE.mask, strict=True)), 0.1, 2000.0, 3.8e-6, tuple((y, x) for x, y in OBLIQUE.positions)
    )
    swapped = tuple(Gaussian(fwhm_x=f"{s.fwhm_y} m", fwhm_y=f"{s.fwhm_x} m") for s in UNEQUAL)
    maps = response(OBLIQUE, 900.0, KOLMOGOROV, UNEQUAL)
    other = response(turned, 900.0, KOLMOGOROV, swapped).transpose(0, 2, 1)[[1, 0, 3, 2, 4, 5]]
    assert np.all(np.abs(maps - other).max(axis=(1, 2)) < PROMISE * np.abs(maps).max(axis=(1, 2)))
    assert abs(maps[0] - maps[1]).max() > 0.01 * maps[0].max()


def test_auto_maps_are_even_and_of_both_sources() -> None:
    both = response(OBLIQUE, 900.0, KOLMOGOROV, UNEQUAL)
    alone = [
        response(Geometry(OBLIQUE.mask, 0.1, 2000.0, 3.8e-6, ((0.0, 0.0),)), 900.0, KOLMOGOROV, [s]) for s in UNEQUAL
    ]
    for kind in (0, 1, 4):
        assert np.allclose(both[kind], both[kind][::-1, ::-1], rtol=1e-12)
        assert np.abs(both[kind] - (alone[0][kind] + alone[1][kind]) / 2).max() < PROMISE * both[kind].max()
    assert all(np.isnan(maps[[2, 3, 5]]).all() for maps in alone)


def test_swapping_the_sources_mirrors_the_cross_maps() -> None:
    backward = Geometry(OBLIQUE.mask, 0.1, 2000.0, 3.8e-6, OBLIQUE.positions[::-1])
    maps = response(OBLIQUE, 900.0, KOLMOGOROV, UNEQUAL)
    other = response(backward, 900.0, KOLMOGOROV, UNEQUAL[::-1])
    assert np.all(np.abs(maps - other[:, ::-1, ::-1]).max(axis=(1, 2)) < PROMISE * np.abs(maps).max(axis=(1, 2)))


def test_a_layer_at_the_sources_does_nothing() -> None:
    assert np.all(response(SCINDAR, 2670.0, KOLMOGOROV, LAMPS) == 0)


def test_one_source_leaves_the_cross_blocks_empty() -> None:
    one = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, 0.0),))
    matrix = response_matrix(one, SliceGrid((1000.0, 1200.0)), KOLMOGOROV, LAMPS[:1])
    assert matrix.shape == (486, 1)
    assert np.array_equal(np.isnan(matrix[:, 0]), np.repeat([kind.endswith("cross") for kind in MAP_KINDS], 81))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sampling": "end"}, "sampling must be"),
        ({"slope_response": "paper"}, "slope_response must be"),
        ({"aperture": "hexagonal"}, "aperture must be"),
        ({"tilt": "mean"}, "tilt must be"),
        ({"sources": LAMPS[:1]}, "2 sources, but 1"),
        ({"grid": SliceGrid((0.0, 3000.0))}, "beyond the sources"),
    ],
)
def test_wrong_options_are_refused(change: dict[str, object], message: str) -> None:
    options = {"geometry": SCINDAR, "grid": SliceGrid((0.0, 100.0)), "spectrum": KOLMOGOROV, "sources": LAMPS} | change
    with pytest.raises(ValueError, match=message):
        response_matrix(**options)


@pytest.mark.parametrize("z", [-1.0, 2671.0, math.inf, math.nan])
def test_a_layer_must_lie_on_the_path(z: float) -> None:
    with pytest.raises(ValueError, match="not between pupil and sources"):
        response(SCINDAR, z, KOLMOGOROV, LAMPS)


def test_a_spectrum_without_finite_slopes_is_refused() -> None:
    class Steep:
        version = 1

        def psd(self, f: np.ndarray) -> np.ndarray:
            return f**-4.2

    with pytest.raises(ValueError, match="no finite variance"):
        response(SCINDAR, 100.0, Steep(), LAMPS)


# ------------------------------------------------------------------------------------ centroids by Monte-Carlo


@pytest.mark.slow
def test_centroids_of_an_extended_source_by_monte_carlo() -> None:
    """Centroids of images formed point by point from random screens, against both slope responses.

    Each screen is a periodic field with an outer scale far below its size and an inner scale far above its mesh. Every
    point of the source sees its own pattern of tilt and intensity; the centroid is the mean of their image positions
    weighted with their intensities, without linearisation. The mean gradient of the brightness-averaged phase is
    what the printed response describes.
    """
    z, length, wavelength, d = 1500.0, 2670.0, 3.8e-6, 0.07
    spectrum = Tatarskii(inner_scale="5 cm", outer_scale="20 cm")
    one = Geometry(((1,),), d, length, wavelength, ((0.0, 0.0),))
    lamp = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")
    full = response(one, z, spectrum, [lamp])[:, 0, 0]
    printed = response(one, z, spectrum, [lamp], "printed")[:, 0, 0]

    rng = np.random.default_rng(7)
    mesh, n = 0.01, 128
    f = np.fft.fftfreq(n, mesh)
    qx, qy = np.meshgrid(f, f)
    q2 = qx**2 + qy**2
    q2[0, 0] = 1.0
    density = spectrum.psd(np.sqrt(q2))
    density[0, 0] = 0.0
    k, shrink = 2 * np.pi / wavelength, 1 - z / length
    aperture = np.sinc(shrink * qx * d) * np.sinc(shrink * qy * d)
    x = np.pi * wavelength * z * shrink * q2
    # Points so close together that the finest structure left, 2.5 cm, does not tell them from a continuous source.
    nodes = np.linspace(-3.6, 3.6, 17)
    weights = np.exp(-(nodes**2) / 2)
    sx, sy = (fwhm / math.sqrt(8 * math.log(2)) * nodes for fwhm in (0.089, 0.063))
    light = np.outer(weights, weights) / weights.sum() ** 2
    scale = 1e-8  # Cn2 dz: point scintillation of a few per cent, so that first order is all there is
    sums = np.zeros(3)
    screens = 60
    for _ in range(screens):
        noise = rng.standard_normal((n, n)) + 1j * rng.standard_normal((n, n))
        path = noise * np.sqrt(density * scale * 1e-6) / (n * mesh) * n**2
        flux = np.zeros((n, n), complex)
        first_x, first_y = np.zeros((n, n), complex), np.zeros((n, n), complex)
        for i, y in enumerate(sy):
            for j, u in enumerate(sx):
                moved = path * np.exp(2j * np.pi * z / length * (qx * u + qy * y)) * aperture
                # Real and imaginary part of one transform are two independent screens.
                both = [
                    np.fft.ifft2(moved * part)
                    for part in (
                        2j * np.pi * shrink * qx * np.cos(x),
                        2j * np.pi * shrink * qy * np.cos(x),
                        2 * k * np.sin(x),
                    )
                ]
                intensity = light[i, j] * (1 + both[2].real) + 1j * light[i, j] * (1 + both[2].imag)
                # Tilt is the direction of arrival, minus the gradient; the image of the point lies at s / L.
                angle_x = -both[0] + u / length * (1 + 1j)
                angle_y = -both[1] + y / length * (1 + 1j)
                flux += intensity
                first_x += intensity.real * angle_x.real + 1j * intensity.imag * angle_x.imag
                first_y += intensity.real * angle_y.real + 1j * intensity.imag * angle_y.imag
        for part in (np.real, np.imag):
            sums += [np.var(part(first_x) / part(flux)), np.var(part(first_y) / part(flux)), np.var(part(flux))]
    # 120 screens of about 40 independent patches: 2 % of a variance.
    found = sums / (2 * screens) / (scale * 1e-6)
    expected = full[[0, 1, 4]]
    assert np.allclose(found, expected, rtol=0.06), found / expected
    assert np.all(printed[:2] / expected[:2] > 1.5)


# ---------------------------------------------------------------------------------------------------- mutations


def mutant(old: str, new: str) -> ModuleType:
    """Response functions with one line of their source replaced."""
    source = Path(coslidar.pipeline.response.__file__).read_text()
    assert source.count(old) == 1, f"{old!r} stands {source.count(old)} times in response.py"
    module = ModuleType("coslidar.pipeline.mutant")
    module.__package__ = "coslidar.pipeline"
    sys.modules[module.__name__] = module
    exec(compile(source.replace(old, new), "mutant", "exec"), module.__dict__)
    return module


@pytest.fixture(scope="module")
def brute_force() -> np.ndarray:
    return BruteForce(SCINDAR, 1446.25, BLURRED, BLURRED).maps(0.07 * np.array(LAGS))


def assert_right(module: ModuleType, expected: np.ndarray) -> None:
    """What the tests above assert of one layer and one slice."""
    maps = module.response(SCINDAR, 1446.25, KOLMOGOROV, LAMPS)
    assert_promise(picked(maps, SCINDAR, LAGS), expected, maps)
    last = SliceGrid((2447.5, 2670.0))
    both = [module.response_matrix(SCINDAR, last, KOLMOGOROV, LAMPS, sampling=s)[:, 0] for s in ("mean", "midpoint")]
    assert both[0][4 * 81 + 40] / both[1][4 * 81 + 40] - 1 == pytest.approx(0.34, abs=0.01)


MUTATIONS = {
    "cross maps flipped": ("{_COS_COS: y[0], _SIN_COS: y[1]}", "{_COS_COS: y[0], _SIN_COS: -y[1]}"),
    "x and y swapped": ("[*slopes, (np.zeros(1)", "[slopes[1], slopes[0], (np.zeros(1)"),
    "L / (L - z) dropped": (
        "power = scaling**2 * spectrum * measure",
        "power = spectrum * measure",
    ),
    "L / (L - z) dropped in the spectrum": ("psd(float(a) * shell.f)", "psd(shell.f)"),
    "L / (L - z) dropped in diffraction": ("z[:, None] * scaling * shell.f**2", "z[:, None] * shell.f**2"),
    "f for 2 pi f": (
        "return mean, 2 * np.pi * fx * mean, 2 * np.pi * fy * mean",
        "return mean, fx * mean, fy * mean",
    ),
    "k^2 lost": ("= (c.real, s.imag)", "= (c.real, turn.imag)"),
    "sign of the centroid term": ("glint * about", "-glint * about"),
    "midpoint for mean": ("_slice_integral(model, z0, z1)", "(z1 - z0) * _at(model, (z0 + z1) / 2)"),
}


def test_the_guards_pass_without_mutation(brute_force: np.ndarray) -> None:
    assert_right(mutant("import itertools\n", "import itertools\n"), brute_force)


@pytest.mark.parametrize("name", MUTATIONS)
def test_each_mutation_is_noticed(name: str, brute_force: np.ndarray) -> None:
    module = mutant(*MUTATIONS[name])
    with pytest.raises(AssertionError):
        assert_right(module, brute_force)
