"""Covariances of simulated slopes and fluxes against theory: the response matrix, and quadrature written here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.integrate import quad

from coslidar.pipeline.geometry import Geometry, SliceGrid
from coslidar.pipeline.response import response_matrix
from coslidar.pipeline.simulation import BLOCK_FRAMES, Strength, TurbulentField
from coslidar.plugins.source_models import Gaussian, Point
from coslidar.plugins.turbulence_spectra import Kolmogorov, VonKarman

if TYPE_CHECKING:
    from numpy.typing import NDArray

MASK = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))


def samples(field: TurbulentField, count: int) -> NDArray[np.float64]:
    """Independent draws of (x slope, y slope, delta i), (count, 3, S, A): one frame of each lifetime."""
    drawn = []
    for epoch in range(count):
        slopes, flux = field.signals(epoch * field.epoch_frames, epoch * field.epoch_frames + 1)
        drawn.append(np.concatenate([slopes[0], flux - 1.0]))
    return np.array(drawn)


def maps_of_each(values: NDArray[np.float64], geometry: Geometry) -> NDArray[np.float64]:
    """Products of all pairs of each draw, averaged over pairs of one separation: (count, 6 (2p-1)(2q-1))."""
    count, size = len(values), geometry.pair_count.size
    i, j = geometry.subaperture_index.T
    place = ((i[:, None] - i + geometry.p - 1) * (2 * geometry.q - 1) + j[:, None] - j + geometry.q - 1).ravel()
    average = np.zeros((place.size, size))
    average[np.arange(place.size), place] = 1.0 / geometry.pair_count.ravel()[place]

    def products(kind: int, first: int, second: int) -> NDArray[np.float64]:
        a, b = values[:, kind, first], values[:, kind, second]
        return (a[:, :, None] * b[:, None, :]).reshape(count, -1) @ average

    last = geometry.n_sources - 1
    auto = [(products(kind, 0, 0) + products(kind, last, last)) / 2 for kind in range(3)]
    cross = [products(kind, 0, last) for kind in range(3)]
    return np.concatenate([auto[0], auto[1], cross[0], cross[1], auto[2], cross[2]], axis=1)


def lannemezan(**changes: Any) -> dict[str, Any]:
    values: dict[str, Any] = {
        "mask": MASK, "subaperture_size": 0.07, "path_length": 2670.0, "wavelength": 3.8e-6,
        "positions": ((0.0, -0.4), (0.0, 0.4)),
    }  # fmt: skip
    return {**values, **changes}


BULB = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")
SMALL = Gaussian(fwhm_x="2 cm", fwhm_y="3 cm")
STAR = Gaussian(fwhm_x="1 urad", fwhm_y="1 urad")

CASES: dict[str, dict[str, Any]] = {
    "slices": {"geometry": lannemezan(), "source": BULB},
    "thin layers, printed slopes": {
        "geometry": lannemezan(), "source": BULB, "sampling": "midpoint", "slope_response": "printed",
    },
    "another instrument": {
        "geometry": lannemezan(
            mask=((1,) * 6,) * 6, subaperture_size=0.05, path_length=1500.0, wavelength=1.55e-6,
            positions=((-0.1, 0.0), (0.2, 0.3)),
        ),
        "source": SMALL,
    },
    "two stars": {
        "geometry": lannemezan(
            path_length=np.inf, wavelength=0.6e-6, subaperture_size=0.05, positions=((0.0, 0.0), (2e-5, -3e-5))
        ),
        "source": STAR, "extent": 8000.0,
    },
    "one source, outer scale": {
        "geometry": lannemezan(positions=((0.1, 0.0),)), "source": BULB,
        "spectrum": VonKarman(outer_scale="2 m"),
    },
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_covariances_are_those_of_the_response_matrix(name: str) -> None:
    case = CASES[name]
    geometry = Geometry(**case["geometry"])
    grid = SliceGrid.uniform(case.get("extent", geometry.path_length), 4)
    spectrum = case.get("spectrum", Kolmogorov())
    model: dict[str, Any] = {
        "sampling": case.get("sampling", "mean"),
        "slope_response": case.get("slope_response", "centroid"),
    }
    sources = [case["source"]] * geometry.n_sources
    cn2 = np.array([1.0, 2.0, 0.5, 3.0]) * 1e-15
    field = TurbulentField(
        geometry, grid, Strength.constant(cn2), (3.0, 1.0), spectrum, sources,
        frame_rate=BLOCK_FRAMES, seed=20, modes=64, lifetime=1.0, **model,
    )  # fmt: skip
    count = 1500
    found = maps_of_each(samples(field, count), geometry)
    rows = geometry.independent
    mean, error = found.mean(axis=0)[rows], found.std(axis=0)[rows] / np.sqrt(count)
    expected = (response_matrix(geometry, grid, spectrum, sources, **model) @ cn2)[rows]
    deviation = (mean - expected) / error
    # Some hundred correlated numbers with normal errors: 5 deviations in none, one deviation on average (the
    # entries of a slope map move together, so that the average is itself uncertain by half).
    assert np.abs(deviation).max() < 5.0
    assert 0.1 < np.mean(deviation**2) < 2.0
    # The test could see an error of a few per cent of each kind of variance.
    zero = np.flatnonzero((geometry.separation_vectors[rows] == 0).all(axis=1))
    block = rows[zero] // geometry.pair_count.size
    autos = zero[np.isin(block, [0, 1, 4])]
    assert (error[autos] < 0.04 * expected[autos]).all()


@pytest.mark.slow
def test_the_centroid_term_is_there_when_it_is_asked_for() -> None:
    geometry, grid = Geometry(**lannemezan()), SliceGrid((1199.0, 1201.0))
    cn2 = np.array([1e-12])
    field = TurbulentField(
        geometry, grid, Strength.constant(cn2), (3.0, 1.0), Kolmogorov(), [BULB] * 2,
        frame_rate=BLOCK_FRAMES, seed=21, modes=128, lifetime=1.0, sampling="midpoint",
    )  # fmt: skip
    found = maps_of_each(samples(field, 1500), geometry)
    size = geometry.pair_count.size
    # Differences of neighbouring entries, where slow waves that move all slopes together fall out: here the term
    # takes a third away.
    row, step = size // 2, 2 * geometry.q - 1
    curvature = found[:, size + row] - found[:, size + row + step]
    mean, error = curvature.mean(), curvature.std() / np.sqrt(len(curvature))
    values = {}
    for slope_response in ("centroid", "printed"):
        maps = response_matrix(
            geometry, grid, Kolmogorov(), [BULB] * 2, sampling="midpoint", slope_response=slope_response
        ) @ cn2  # fmt: skip
        values[slope_response] = maps[size + row] - maps[size + row + step]
    assert abs(mean - values["centroid"]) < 4.0 * error
    assert abs(mean - values["printed"]) > 6.0 * error


def radial_variances(geometry: Geometry, z: float) -> tuple[float, float]:
    """Variances of slope and flux of a point source through unit Cn2 dz at z, by quadrature in polar coordinates."""
    length, d = geometry.path_length, geometry.subaperture_size
    scaling = length / (length - z)
    angle = (np.arange(400) + 0.5) * np.pi / 800
    wavenumber = 2 * np.pi / geometry.wavelength

    def integrand(u: float, what: int) -> float:
        # f = u^3 takes the singularity of the slopes at zero away.
        f = u**3
        pupil = (np.sinc(f * np.cos(angle) * d) * np.sinc(f * np.sin(angle) * d)) ** 2
        psd = scaling**2 * 0.033 * (2 * np.pi) ** (-2 / 3) * (scaling * f) ** (-11 / 3)
        x = np.pi * geometry.wavelength * z * scaling * f**2
        kernel = (2 * np.pi * f * np.cos(angle) * np.cos(x)) ** 2 if what == 0 else (2 * wavenumber * np.sin(x)) ** 2
        return float(np.mean(kernel * pupil) * psd * 2 * np.pi * f * 3 * u**2)

    # The aperture leaves less than 1e-3 of either variance above 8 / d, where the flux oscillates beyond counting.
    top = (8.0 / d) ** (1 / 3)
    first, second = (quad(integrand, 1e-6, top, args=(what,), limit=2000, epsrel=1e-5)[0] for what in (0, 1))
    return first, second


@pytest.mark.parametrize("z", [150.0, 1300.0, 2200.0])
def test_variances_of_one_layer_by_quadrature(z: float) -> None:
    geometry = Geometry(**lannemezan(positions=((0.0, 0.0),), mask=((1, 1), (1, 1))))
    grid = SliceGrid((z - 1.0, z + 1.0))
    field = TurbulentField(
        geometry, grid, Strength.constant([0.5e-12]), (3.0, 1.0), Kolmogorov(), [Point()],
        frame_rate=BLOCK_FRAMES, seed=22, modes=512, lifetime=1.0, sampling="midpoint",
    )  # fmt: skip
    found = samples(field, 800)[:, :, 0]
    slope, flux = radial_variances(geometry, z)
    slopes = (found[:, :2] ** 2).mean(axis=(1, 2))
    fluxes = (found[:, 2] ** 2).mean(axis=1)
    for values, expected in ((slopes, slope), (fluxes, flux)):
        error = values.std() / np.sqrt(values.size)
        assert error < 0.05 * expected * 1e-12
        assert abs(values.mean() - expected * 1e-12) < 4.0 * error


@pytest.mark.slow
def test_a_long_recording_converges_to_the_theory_with_few_modes() -> None:
    geometry, grid = Geometry(**lannemezan()), SliceGrid.uniform(2670.0, 2)
    cn2 = np.array([2e-14, 2e-14])
    field = TurbulentField(
        geometry, grid, Strength.constant(cn2), (3.0, 1.0), Kolmogorov(), [BULB] * 2,
        frame_rate=142.0, seed=23, modes=32, lifetime=0.5,
    )  # fmt: skip
    index = [float(((field.signals(t, t + 640)[1] - 1.0) ** 2).mean()) for t in range(0, 64000, 640)]
    size = geometry.pair_count.size
    expected = (response_matrix(geometry, grid, Kolmogorov(), [BULB] * 2) @ cn2)[4 * size + size // 2]
    # 450 s of wind; parts of 4.5 s, nine lifetimes, are independent but for their edges.
    error = np.std(index) / np.sqrt(len(index))
    assert error < 0.015 * expected
    assert abs(np.mean(index) - expected) < 4.0 * error
