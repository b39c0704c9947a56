"""Simulated fields and frames: identities that hold mode by mode, spots, noise, mishaps, scenarios."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from coslidar.flows.settings import InputError
from coslidar.flows.simulate import load_scenario, recordings, shipped, simulate, simulate_recording
from coslidar.pipeline.detector import Detector, bad_pixels, lenslet_boxes, spot_profile
from coslidar.pipeline.geometry import Geometry, SliceGrid
from coslidar.pipeline.scenario import Realised, Recording, Scenario, ScenarioError, read
from coslidar.pipeline.simulation import Strength, TurbulentField
from coslidar.plugins.source_models import Gaussian, Point
from coslidar.plugins.turbulence_spectra import Kolmogorov

if TYPE_CHECKING:
    from pathlib import Path

LENGTH, D, WAVELENGTH = 2670.0, 0.07, 3.8e-6
MASK = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))
FULL = ((1,) * 5,) * 5


class Smooth:
    """Turbulence of scales above 1 m only, on which a subaperture is a point."""

    version = 1

    def psd(self, f: Any) -> Any:
        return np.exp(-((f / 0.3) ** 2))


class TwoPoints:
    """Two equal points at +-a on the y axis, as one source."""

    version = 1

    def __init__(self, a: float) -> None:
        self.a = a

    def transfer(self, fx: Any, fy: Any) -> Any:
        return np.cos(2 * np.pi * self.a * fy) + 0.0 * fx

    def moment(self, fx: Any, fy: Any) -> Any:
        return 0.0 * fx, -1j * self.a * np.sin(2 * np.pi * self.a * fy)


def geometry(positions: Any = ((0.0, -0.4), (0.0, 0.4)), mask: Any = MASK, length: float = LENGTH) -> Geometry:
    return Geometry(mask, D, length, WAVELENGTH, positions)


def one_layer(geometry: Geometry, z: float, source: Any, **given: Any) -> TurbulentField:
    """Frozen turbulence in one thin layer at z."""
    settings = {"frame_rate": 100.0, "seed": 1, "modes": 256, "lifetime": np.inf, "sampling": "midpoint"}
    settings.update(given)
    spectrum = settings.pop("spectrum", Kolmogorov())
    wind = settings.pop("wind", (0.0, 0.0))
    grid = SliceGrid((z - 5.0, z + 5.0))
    strength = Strength.constant([1e-12])
    return TurbulentField(geometry, grid, strength, wind, spectrum, [source] * geometry.n_sources, **settings)


def at(geometry: Geometry, row: int, col: int) -> int:
    """Index of the subaperture at (row, col)."""
    return geometry.subaperture_index.tolist().index([row, col])


# --- fields ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("wind", "step"), [((1.0, 0.0), (0, 1)), ((0.0, 1.0), (1, 0)), ((-1.0, 0.0), (0, -1))])
def test_the_wind_carries_the_pattern_along_enlarged_by_the_spherical_wave(
    wind: tuple[float, float], step: tuple[int, int]
) -> None:
    geo, z = geometry(mask=FULL), 900.0
    # The pupil pattern moves at v L / (L - z): this speed takes it over one subaperture in 10 frames of 1/100 s.
    speed = D / 0.1 * (LENGTH - z) / LENGTH
    source = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")
    field = one_layer(geo, z, source, wind=(wind[0] * speed, wind[1] * speed))
    slopes, flux = field.signals(0, 30)
    here, there = at(geo, 2, 2), at(geo, 2 + step[0], 2 + step[1])
    # Single precision of a sum of 256 modes.
    assert np.abs(slopes[10:, :, :, there] - slopes[:-10, :, :, here]).max() < 1e-5 * slopes.std()
    assert np.abs(flux[10:, :, there] - flux[:-10, :, here]).max() < 1e-5 * flux.std()
    assert np.abs(flux[10:, :, here] - flux[:-10, :, there]).max() > 0.1 * flux.std()


@pytest.mark.parametrize("axis", [0, 1])
def test_two_sources_see_the_same_air_from_subapertures_apart_by_m_times_their_separation(axis: int) -> None:
    # r_a - r_b = m s, a on the first source, b on the second, which lies at +s.
    z = 600.0
    separation = D * (LENGTH - z) / z
    positions = ((-separation / 2, 0.0), (separation / 2, 0.0)) if axis == 0 else (
        (0.0, -separation / 2), (0.0, separation / 2))  # fmt: skip
    geo = geometry(positions, FULL)
    field = one_layer(geo, z, Gaussian(fwhm_x="5 cm", fwhm_y="5 cm"), wind=(3.0, 1.0))
    slopes, flux = field.signals(0, 64)
    a, b = (at(geo, 2, 3), at(geo, 2, 2)) if axis == 0 else (at(geo, 3, 2), at(geo, 2, 2))
    assert np.abs(flux[:, 0, a] - flux[:, 1, b]).max() < 1e-5 * flux.std()
    assert np.abs(slopes[:, :, 0, a] - slopes[:, :, 1, b]).max() < 1e-5 * slopes.std()
    assert np.abs(flux[:, 0, b] - flux[:, 1, a]).max() > 0.1 * flux.std()


def test_flux_is_distance_times_divergence_of_slopes_in_geometrical_optics() -> None:
    # Transport of intensity: light gathers where rays converge, delta i = z div(slope), to order z f^2 lambda, and
    # here in a plane wave on scales above 1 m; the slope is the apparent direction, opposite to where the ray goes.
    geo, z = geometry(((0.0, 0.0),), FULL, np.inf), 500.0
    field = one_layer(geo, z, Point(), spectrum=Smooth(), wind=(20.0, 5.0))
    slopes, flux = field.signals(0, 192)
    slopes, flux = slopes[:, :, 0], flux[:, 0]
    divergence = (slopes[:, 0, at(geo, 2, 3)] - slopes[:, 0, at(geo, 2, 1)]) / (2 * D) + (
        slopes[:, 1, at(geo, 3, 2)] - slopes[:, 1, at(geo, 1, 2)]
    ) / (2 * D)
    signal = flux[:, at(geo, 2, 2)] - 1.0
    # Second-order difference over 0.14 m of waves above 1 m, some of which the tail of the spectrum holds below.
    assert np.abs(signal - z * divergence).max() < 0.03 * np.abs(signal).max()


def test_an_extended_source_is_the_average_of_its_points_and_of_their_weighted_positions() -> None:
    # I = mean of I_k, slope = mean of (slope_k + delta I_k s_k / L) to first order, whatever the phases.
    a, z = 0.06, 1500.0
    whole = one_layer(geometry(((0.0, 0.0),)), z, TwoPoints(a), wind=(2.0, 3.0))
    points = one_layer(geometry(((0.0, -a), (0.0, a))), z, Point(), wind=(2.0, 3.0))
    # Frequencies are drawn where the source lets the instrument see: give both fields the same law.
    points._cumulative = whole._cumulative
    slopes, flux = whole.signals(0, 64)
    point_slopes, point_flux = points.signals(0, 64)
    assert np.abs(flux[:, 0] - point_flux.mean(axis=1)).max() < 1e-5 * flux.std()
    expected = point_slopes.mean(axis=2)
    assert np.abs(slopes[:, 0, 0] - expected[:, 0]).max() < 1e-5 * slopes.std()
    lever = (point_flux - 1.0) * np.array([-a, a])[:, None] / LENGTH
    assert np.abs(slopes[:, 1, 0] - expected[:, 1] - lever.mean(axis=1)).max() < 1e-5 * slopes.std()
    assert np.abs(lever.mean(axis=1)).max() > 0.01 * slopes.std()


@pytest.mark.parametrize("lifetime", [np.inf, 1.3])
def test_frames_do_not_depend_on_what_else_is_asked_for(lifetime: float) -> None:
    field = one_layer(geometry(), 700.0, Point(), lifetime=lifetime, wind=(3.0, 1.0))
    slopes, flux = field.signals(0, 500)
    again = one_layer(geometry(), 700.0, Point(), lifetime=lifetime, wind=(3.0, 1.0))
    for start, stop in [(499, 500), (63, 65), (128, 320), (7, 7), (1, 400)]:
        part_slopes, part_flux = again.signals(start, stop)
        np.testing.assert_array_equal(part_slopes, slopes[start:stop])
        np.testing.assert_array_equal(part_flux, flux[start:stop])


def test_the_field_is_continuous_where_one_set_of_modes_replaces_another() -> None:
    field = one_layer(geometry(), 300.0, Point(), lifetime=0.64, wind=(0.5, 0.0))
    _, flux = field.signals(0, 640)
    step = np.abs(np.diff(flux, axis=0)).mean(axis=(1, 2))
    edges = np.arange(64, 640, 64) - 1
    assert step[edges].max() < 3.0 * np.median(step)
    # ... and yet nothing is left of it after one lifetime: another sample of the same turbulence.
    samples = flux[::64, 0]
    assert np.abs(np.diff(samples, axis=0)).min(axis=0).max() > 1e-3


def test_seeds_make_different_air() -> None:
    first = one_layer(geometry(), 700.0, Point(), seed=1).signals(0, 4)[1]
    second = one_layer(geometry(), 700.0, Point(), seed=2).signals(0, 4)[1]
    assert np.abs(first - second).max() > 0.1 * first.std()


def test_amplitudes_follow_the_square_root_of_the_strength() -> None:
    geo, grid = geometry(), SliceGrid((500.0, 600.0))
    times = np.array([0.0, 100.0])

    def flux(factor: float, when: int) -> Any:
        strength = Strength(np.array([1e-14]), times, np.array([1.0, factor]))
        field = TurbulentField(
            geo, grid, strength, (0.0, 0.0), Kolmogorov(), [Point()] * 2, frame_rate=64.0, seed=1, lifetime=1.0
        )
        return field.signals(when, when + 1)[1] - 1.0

    # Frame 3200 is at 50 s, half way in the logarithm, and at the start of a lifetime of one second.
    np.testing.assert_allclose(flux(0.01, 3200), flux(1.0, 3200) * np.sqrt(0.1), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(flux(0.01, 64 * 200), flux(1.0, 64 * 200) * 0.1, rtol=1e-5, atol=1e-7)


def test_strength_per_slice_and_mean_profile() -> None:
    strength = Strength(np.array([1.0, 2.0]), np.array([0.0, 10.0]), np.array([[1.0, 1.0], [0.01, 1.0]]))
    np.testing.assert_allclose(strength.at(5.0), [0.1, 2.0])
    np.testing.assert_allclose(strength.at(-3.0), [1.0, 2.0])
    np.testing.assert_allclose(strength.at(99.0), [0.01, 2.0])
    field = TurbulentField(
        geometry(), SliceGrid((0.0, 1.0, 2.0)), strength, (0.0, 0.0), Kolmogorov(), [Point()] * 2,
        frame_rate=64.0, seed=1, lifetime=1.0, modes=16,
    )  # fmt: skip
    # Mean of 0.01^(t / 10) over 0 to 10 s is (1 - 0.01) / ln(100); blending of lifetimes of 1 s is a trapezoid rule.
    np.testing.assert_allclose(field.mean_profile(0, 640), [0.99 / np.log(100), 2.0], rtol=0.03)


def test_lognormal_fluxes_are_positive_with_the_variance_of_the_theory() -> None:
    z = 1200.0
    given: dict[str, Any] = {"lifetime": 0.01, "modes": 32, "frame_rate": 6400.0}
    linear = one_layer(geometry(), z, Point(), **given)
    lognormal = one_layer(geometry(), z, Point(), statistics="lognormal", **given)
    frames = [64 * i for i in range(300)]
    first = np.array([linear.signals(i, i + 1)[1][0] for i in frames])
    second = np.array([lognormal.signals(i, i + 1)[1][0] for i in frames])
    assert second.min() > 0.0
    # 300 draws of 40 correlated channels: 5 % on a variance; its tail makes the log-normal one noisier.
    assert abs(second.mean() - 1.0) < 4.0 * second.std() / np.sqrt(300)
    assert second.var() == pytest.approx(first.var(), rel=0.15)
    logarithm = np.log(second)
    assert abs(stats.skew(logarithm.ravel())) < 0.2


def test_fields_refuse_what_does_not_fit() -> None:
    geo, grid = geometry(), SliceGrid.uniform(LENGTH, 3)
    two: Any = [Point(), Point()]

    def make(cn2: Any = (1.0, 1.0, 1.0), wind: Any = (0.0, 0.0), sources: Any = two, modes: int = 64) -> None:
        TurbulentField(
            geo, grid, Strength.constant(cn2), wind, Kolmogorov(), sources, frame_rate=1.0, seed=1, modes=modes
        )

    with pytest.raises(ValueError, match="profile has 2 values"):
        make(cn2=(1.0, 1.0))
    with pytest.raises(ValueError, match="wind has the shape"):
        make(wind=np.zeros((2, 2)))
    with pytest.raises(ValueError, match="1 source models for 2"):
        make(sources=[Point()])
    with pytest.raises(ValueError, match="too few"):
        make(modes=8)


# --- frames ------------------------------------------------------------------------------------------------

PITCH, SCALE = (32, 32), 27e-6
SPOTS = np.array([[9.95, 15.5], [21.05, 15.5]])


def detector(**given: Any) -> Detector:
    geo = geometry()
    shape = (160, 160)
    sources = [Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")] * 2
    profiles = np.stack([spot_profile(geo, s, SCALE, PITCH, given.pop("core", "gaussian")) for s in sources[:1]] * 2)
    values: dict[str, Any] = {
        "boxes": lenslet_boxes(geo, (0, 0), PITCH), "pitch": PITCH, "spots": SPOTS, "flux": np.array([1e4, 8e3]),
        "profiles": profiles, "pixel_scale": SCALE, "gain": 12.0, "read_noise": 60.0, "background": 150.0,
        "saturation": 65535.0, "offset": np.full(shape, 500, np.float32), "flat": np.ones(shape, np.float32),
        "bad_pixel": np.zeros(shape, np.uint8), "seed": 1,
    }  # fmt: skip
    values.update(given)
    return Detector(**values)


def still(frames: int) -> tuple[Any, Any, Any]:
    return np.zeros((frames, 2, 2, 20)), np.ones((frames, 2, 20)), np.arange(frames)


def test_spots_have_the_flux_and_the_centroid_they_were_given() -> None:
    random = np.random.default_rng(0)
    slopes = random.uniform(-2.0, 2.0, (20, 2, 2, 20)) * SCALE
    flux = random.uniform(0.1, 2.0, (20, 2, 20))
    for source in (0, 1):
        alone = flux.copy()
        alone[:, 1 - source] = 0.0
        light = detector(background=0.0).expose(slopes, alone)
        boxes = light.reshape(20, 5, 32, 5, 32).transpose(0, 1, 3, 2, 4)
        boxes = boxes[:, *geometry().subaperture_index.T]
        total = boxes.sum(axis=(2, 3))
        row = (boxes.sum(axis=3) * np.arange(32)).sum(axis=2) / total
        col = (boxes.sum(axis=2) * np.arange(32)).sum(axis=2) / total
        # A Gaussian core has no wings to lose: all is there to 1e-3 (single precision and the table's steps: 1e-4).
        np.testing.assert_allclose(total, flux[:, source] * (1e4, 8e3)[source], rtol=1e-3)
        np.testing.assert_allclose(row, SPOTS[source, 0] + slopes[:, 1, source] / SCALE, atol=1e-3)
        np.testing.assert_allclose(col, SPOTS[source, 1] + slopes[:, 0, source] / SCALE, atol=1e-3)


def test_the_diffraction_spot_is_the_square_apertures() -> None:
    # A point source: sinc^2 in angle, integrated over the pixel in direct space.
    profile = spot_profile(geometry(), Point(), SCALE, (32, 32))
    scale = D / WAVELENGTH
    for offset in (-17.25, -3.5, -0.3125, 0.0, 1.0, 6.78125, 20.0):
        expected, _ = quad(
            lambda angle: scale * np.sinc(scale * angle) ** 2, (offset - 0.5) * SCALE, (offset + 0.5) * SCALE,
            epsabs=1e-12,
        )  # fmt: skip
        index = round((offset + 33) * 64)
        assert profile[0, index] == pytest.approx(expected, abs=3e-7)
        assert profile[1, index] == profile[0, index]


def test_the_extended_spot_is_the_diffraction_spot_blurred_by_the_source() -> None:
    source = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")
    point, extended = (spot_profile(geometry(), s, SCALE, (32, 32)) for s in (Point(), source))
    distance = np.arange(-33 * 64, 33 * 64 + 1) / 64
    for axis, fwhm in ((0, 0.063), (1, 0.089)):
        sigma = fwhm / 2.354820045 / LENGTH / SCALE
        blur = np.exp(-0.5 * (distance / sigma) ** 2)
        expected = np.convolve(point[axis], blur / blur.sum(), mode="same")
        middle = np.abs(distance) < 20
        np.testing.assert_allclose(extended[axis][middle], expected[middle], atol=2e-5)


def test_gaussian_core_has_the_width_of_the_diffraction_spot() -> None:
    source = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")
    # Pixels of a twentieth, so that integration over them changes nothing.
    fine = SCALE / 20
    widths = []
    for shape in ("diffraction", "gaussian"):
        profile = spot_profile(geometry(), source, fine, (90, 90), shape)  # type: ignore[arg-type]
        widths.append((profile > profile.max(axis=1, keepdims=True) / 2).sum(axis=1) / 64 / 20)
    np.testing.assert_allclose(widths[0], widths[1], rtol=2e-3)


def test_light_stays_in_its_own_box_and_a_spot_may_leave_it() -> None:
    slopes, flux, index = still(1)
    flux[:] = 0.0
    flux[0, 0, 5] = 1.0
    light = detector(background=0.0).expose(slopes, flux)
    row, col = lenslet_boxes(geometry(), (0, 0), PITCH)[5]
    assert light[0, row : row + 32, col : col + 32].sum() == light.sum() > 0.0
    slopes[:] = 500 * SCALE
    assert detector(background=0.0).expose(slopes, flux).sum() == 0.0
    slopes[:] = np.nan
    assert detector().render(slopes, flux, index).dtype == np.uint16


def test_noise_is_photon_and_read_noise() -> None:
    slopes, flux, index = still(3000)
    given = detector(flux=np.zeros(2), flat=np.full((160, 160), 1.3, np.float32))
    frames = given.render(slopes[:300], flux[:300], index[:300]).astype(float)
    # 7.7 million samples: 0.05 % of a variance is one standard deviation, rounding adds 1/12.
    assert frames.var() == pytest.approx(195.0 / 12.0 + 25.0 + 1 / 12, rel=0.003)
    assert frames.mean() == pytest.approx(500.0 + 195.0, abs=0.02)
    np.testing.assert_allclose(given.dark, 695.0)
    bright = detector(background=20000.0, read_noise=0.0, flux=np.zeros(2))
    frames = bright.render(slopes[:50], flux[:50], index[:50]).astype(float)
    assert frames.var() == pytest.approx(20000.0 / 12.0 + 1 / 12, rel=0.01)
    without = given.render(slopes[:1], flux[:1], index[:1], noise=False)
    assert np.unique(without).tolist() == [695]


def test_noise_is_normal_and_independent_from_pixel_to_pixel_and_frame_to_frame() -> None:
    slopes, flux, index = still(60)
    offset = np.full((160, 160), 30000, np.float32)
    given = detector(flux=np.zeros(2), background=0.0, gain=1.0, read_noise=1000.0, offset=offset)
    noise = (given.render(slopes, flux, index).astype(float) - 30000) / 1000
    count = noise.size
    assert stats.kstest(noise.ravel()[::3], "norm").pvalue > 1e-4
    assert abs((noise**4).mean() - 3.0) < 5 * np.sqrt(96 / count)
    for threshold in (2.0, 3.0, 3.6, 4.0):
        expected = 2 * stats.norm.sf(threshold) * count
        assert abs((np.abs(noise) > threshold).sum() - expected) < 5 * np.sqrt(expected)
    for first, second in [(noise[1:], noise[:-1]), (noise[:, 1:], noise[:, :-1]), (noise[..., 1:], noise[..., :-1])]:
        assert abs((first * second).mean()) < 5 / np.sqrt(count)


@pytest.mark.parametrize("mean", [0.4, 5.0, 60.0])
def test_few_photons_are_counted_one_by_one(mean: float) -> None:
    slopes, flux, index = still(20)
    frames = detector(flux=np.zeros(2), background=mean, gain=1.0, read_noise=0.0).render(slopes, flux, index)
    counts = frames.astype(int).ravel() - 500
    levels = np.arange(counts.max() + 1)
    expected = stats.poisson.pmf(levels, mean) * counts.size
    seen = np.bincount(counts)
    often = expected > 20
    chi2 = ((seen - expected)[often] ** 2 / expected[often]).sum()
    assert stats.chi2.sf(chi2, often.sum() - 1) > 1e-4


def test_saturation_flat_and_bad_pixels() -> None:
    slopes, flux, index = still(40)
    bad = np.zeros((160, 160), np.uint8)
    bad[0, :3] = 1, 2, 3
    flat = np.ones((160, 160), np.float32)
    flat[1, 1] = 0.5
    frames = detector(bad_pixel=bad, flat=flat, saturation=900.0).render(slopes, flux, index)
    assert frames.max() == 900
    assert (frames[:, 0, 1] == 900).all()
    assert frames[:, 0, 0].mean() == pytest.approx(500, abs=4)
    assert frames[:, 1, 1].mean() == pytest.approx(575, abs=5)
    assert frames[:, 0, 2].std() > 5 * frames[:, 0, 3].std()
    drawn = bad_pixels(np.random.default_rng(1), (100, 90), 0.01)
    assert drawn.shape == (100, 90)
    assert np.bincount(drawn.ravel()).tolist() == [8910, 30, 30, 30]


def test_frames_depend_on_their_number_only() -> None:
    slopes, flux, index = still(30)
    whole = detector().render(slopes, flux, index)
    np.testing.assert_array_equal(detector().render(slopes[7:9], flux[7:9], index[7:9]), whole[7:9])
    assert (whole[0] != whole[1]).mean() > 0.8
    assert (detector(seed=2).render(slopes, flux, index)[0] != whole[0]).mean() > 0.8


# --- scenarios ---------------------------------------------------------------------------------------------


def table(name: str = "lannemezan-strong", **changes: Any) -> dict[str, Any]:
    content = tomllib.loads((files("coslidar.flows.scenarios") / f"{name}.toml").read_text("utf-8"))
    content.update(changes)
    return content


def small(**changes: Any) -> Recording:
    """First recording of a scenario with few modes."""
    content = table(**changes)
    content["turbulence"]["modes"] = 16
    return recordings(read(content, "test"))[0]


def quiet(**changes: Any) -> dict[str, Any]:
    content = table(**changes)
    content["turbulence"]["cn2"] = ["0 m^(-2/3)"] * 12
    return content


def test_every_shipped_scenario_can_be_read_and_drawn() -> None:
    assert set(shipped()) == {
        "bad-weather", "declining-afternoon", "demo", "lannemezan-strong", "lannemezan-weak", "one-source",
        "plane-wave", "single-layer", "six-by-six-strong", "six-by-six-weak", "uniform",
    }  # fmt: skip
    for name, description in shipped().items():
        assert len(description) > 10
        scenario = load_scenario(name)
        scenario = scenario.model_copy(update={"turbulence": scenario.turbulence.model_copy(update={"modes": 16})})
        last = scenario.model_copy(update={"archives": scenario.archives[-1:]})
        frames = recordings(last)[0].frames(0, 3)
        assert frames.dtype == np.uint16
        assert frames.max() > frames.min()


def test_the_demo_is_small() -> None:
    every = recordings(load_scenario("demo"))
    assert sum(r.n_frames for r in every) <= 20_000
    assert every[0].frame_shape[0] * every[0].frame_shape[1] <= 120 * 120
    profiles = np.array([r.truth()["cn2"] for r in every])
    # Declining everywhere, faster over the grass near the instrument than over the village.
    assert (np.diff(profiles, axis=0) < 0).all()
    assert profiles[-1, 0] / profiles[0, 0] < 0.1 < profiles[-1, -1] / profiles[0, -1]


def test_spots_follow_from_positions_where_none_is_given() -> None:
    # 0.4 m at 2670 m are 5.55 pixels of 27 urad, from the middle of 32 pixels.
    assert [source.spot for source in load_scenario("lannemezan-strong").header.sources] == [
        (9.95, 15.5), (21.05, 15.5),
    ]  # fmt: skip


def test_all_faults_of_a_scenario_are_told_at_once() -> None:
    content = table()
    content["turbulence"]["cn2"][0] = "1 g"
    content["turbulence"]["wnd"] = 3
    content["instrument"]["wavelength"] = "3.8 s"
    content["light"]["background"] = 7
    with pytest.raises(ScenarioError) as caught:
        read(content, "x.toml")
    message = "\n".join(caught.value.faults)
    assert len(caught.value.faults) == 4
    assert "x.toml: turbulence.cn2[0] = '1 g': 'g' is" in message
    assert "turbulence.wnd" in message
    assert "instrument.wavelength = '3.8 s': 's' is a duration" in message
    assert "light.background = 7: the unit is missing" in message


@pytest.mark.parametrize(
    ("place", "key", "value", "said"),
    [
        ("light", "flux", ["1 count"], "light.flux has 1 values"),
        ("turbulence", "wind", [["1 m/s", "1 m/s"]], "wind is given for 1 slices"),
        ("turbulence", "time", ["1 s"], "there are 1 times, but 0 factors"),
        ("turbulence", "extent", "3 km", "lies beyond the sources"),
        ("path", "length", "inf m", "sources"),
        ("instrument", "saturation", "70000 count", "above 65535"),
        ("vibration", "variance", ["-1 rad^2", "1 rad^2"], "not negative"),
        ("detector", "bad_pixels", 2.0, "bad_pixels"),
    ],
)
def test_what_does_not_fit_together_is_refused(place: str, key: str, value: Any, said: str) -> None:
    content = table()
    content[place][key] = value
    with pytest.raises(ScenarioError, match=said):
        read(content, "x.toml")


def test_scenarios_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such scenario; give a TOML file, or one of: bad-weather"):
        load_scenario("nowhere")
    with pytest.raises(InputError, match="cannot be read"):
        load_scenario(tmp_path / "x.toml")
    (tmp_path / "x.toml").write_text("a = ")
    with pytest.raises(InputError, match="no TOML"):
        load_scenario(tmp_path / "x.toml")
    with pytest.raises(InputError, match="give a folder"):
        simulate("demo", tmp_path / "all.zarr.zip")


def test_the_vibration_line_has_its_variance_and_frequency_in_all_spots_alike() -> None:
    recording = recordings(read(quiet(), "test"))[0]
    slopes, flux = recording.signals(0, 1420)
    np.testing.assert_array_equal(flux, 1.0)
    assert recording.truth()["r0_m"] is None
    # 1420 frames of 142 Hz are 500 whole periods of 50 Hz: the variance is that of the line, not of a sample.
    for axis, variance in ((0, 1e-12), (1, 4e-12)):
        assert slopes[:, axis, 1, 7].var() == pytest.approx(variance, rel=1e-9)
        assert np.ptp(slopes[:, axis].reshape(1420, -1), axis=1).max() == 0.0
        power = np.abs(np.fft.rfft(slopes[:, axis, 0, 0])) ** 2
        assert np.fft.rfftfreq(1420, 1 / 142)[power.argmax()] == pytest.approx(50.0)


def test_drift_trend_and_covered_sources() -> None:
    content = quiet(
        disturbances={
            "drift": ["1 urad/s", "-2 urad/s"], "trend": -0.5,
            "cover": [{"source": 1, "start": "2 s", "duration": "3 s", "transmission": 0.25}],
        }
    )  # fmt: skip
    del content["vibration"]
    slopes, flux = recordings(read(content, "test"))[0].signals(0, 1000)
    np.testing.assert_allclose(slopes[710, 0], 5e-6, rtol=1e-9)
    np.testing.assert_allclose(slopes[710, 1], -1e-5, rtol=1e-9)
    np.testing.assert_allclose(flux[500, 0], 1 - 0.5 * 500 / 25560, rtol=1e-9)
    np.testing.assert_allclose(flux[284:710, 1] / flux[284:710, 0], 0.25)
    np.testing.assert_allclose(flux[:284, 1], flux[:284, 0])
    np.testing.assert_allclose(flux[710:, 1], flux[710:, 0])


def test_dropped_frames_leave_gaps_and_frozen_ones_repeat() -> None:
    recording = small(disturbances={"dropped": 0.1, "frozen": 0.05})
    steps = np.diff(recording.time) * 142e-9
    assert recording.n_frames == pytest.approx(0.9 * 25560, rel=0.02)
    assert np.allclose(steps, np.rint(steps), atol=1e-6)
    assert (np.rint(steps) > 1).mean() == pytest.approx(0.1, abs=0.02)
    repeated = int(np.flatnonzero((np.diff(recording.index) == 0) & (np.rint(steps) == 1))[3])
    frames = recording.frames(repeated, repeated + 3)
    np.testing.assert_array_equal(frames[0], frames[1])
    assert (frames[1] != frames[2]).any()
    truth = recording.truth()
    assert truth["frames"] + truth["frames_dropped"] == 25560
    assert truth["frames_repeated"] == (np.diff(recording.index) == 0).sum()


def test_times_are_exact_multiples_in_utc() -> None:
    recording = small()
    assert recording.time[0] == np.datetime64("2012-09-14T12:15:00", "ns").astype(np.int64)
    assert abs(recording.time[-1] - recording.time[0] - 25559e9 / 142) <= 1
    assert set(np.diff(recording.time)) <= {7042253, 7042254}


def test_portions_of_a_recording_are_the_same_frames() -> None:
    recording = small(disturbances={"dropped": 0.1, "frozen": 0.05})
    whole = recording.frames(0, 200)
    other = small(disturbances={"dropped": 0.1, "frozen": 0.05})
    parts = [other.frames(a, b) for a, b in [(150, 200), (1, 3), (0, 1), (3, 150)]]
    np.testing.assert_array_equal(np.concatenate([parts[2], parts[1], parts[3], parts[0]]), whole)


def test_realised_variances_are_those_of_numpy() -> None:
    random = np.random.default_rng(3)
    slopes = 1e-4 + 1e-6 * random.standard_normal((90, 2, 2, 5))
    flux = 7.0 + random.standard_normal((90, 2, 5))
    sums = Realised()
    for start in (0, 13, 60):
        stop = {0: 13, 13: 60, 60: 90}[start]
        sums.add(slopes[start:stop], flux[start:stop])
    found = sums.summary()
    np.testing.assert_allclose(found["slope_variance_xx_rad2"], slopes[:, 0].var(axis=0).mean(axis=1), rtol=1e-10)
    np.testing.assert_allclose(found["slope_variance_yy_rad2"], slopes[:, 1].var(axis=0).mean(axis=1), rtol=1e-10)
    index = (flux.var(axis=0) / flux.mean(axis=0) ** 2).mean(axis=1)
    np.testing.assert_allclose(found["sigma_I2"], index, rtol=1e-10)


def test_written_archives_hold_the_frames_and_their_truth(tmp_path: Path) -> None:
    from coslidar.catalog.archive import open_archive

    content = table("demo")
    content["turbulence"]["modes"] = 16
    scenario = read(content, "test")
    progress: list[tuple[str, int, int]] = []
    written = simulate(
        scenario, tmp_path / "raw", duration=2.5, seed=5, threads=2, progress=lambda *step: progress.append(step)
    )
    assert written[0].name == "2012-09-14T1715.zarr.zip"
    assert len(written) == 8
    assert progress[-1][1] == progress[-1][2] == 355
    archive = open_archive(str(written[1]))
    again = recordings(_short(scenario, 2.5, seed=5))[1]
    np.testing.assert_array_equal(archive.time, again.time)
    np.testing.assert_array_equal(
        np.concatenate([archive.read_chunk(i) for i in range(archive.n_chunks)]), again.frames(0, 355)
    )
    assert archive.header.campaign == "demo"
    assert archive.bad_pixel is not None
    assert archive.bad_pixel.sum() == 5
    np.testing.assert_array_equal(archive.dark, again.detector.dark)
    truth = json.loads((tmp_path / "raw" / "2012-09-14T1730.truth.json").read_text())
    assert truth["cn2"] == again.truth()["cn2"]
    assert len(truth["of_this_record"]["sigma_I2"]) == 2
    with pytest.raises(FileExistsError):
        simulate(scenario, tmp_path / "raw", duration=2.5)
    before = written[0].stat().st_mtime_ns
    (tmp_path / "raw" / "2012-09-14T1730.truth.json").unlink()
    progress.clear()
    simulate(scenario, tmp_path / "raw", duration=2.5, seed=5, keep=True, progress=lambda *step: progress.append(step))
    assert written[0].stat().st_mtime_ns == before
    assert {name for name, _, _ in progress} == {"2012-09-14T1730"}
    assert json.loads((tmp_path / "raw" / "2012-09-14T1730.truth.json").read_text()) == truth


def _short(scenario: Scenario, duration: float, seed: int) -> Scenario:
    plans = tuple(plan.model_copy(update={"duration": duration}) for plan in scenario.archives)
    return scenario.model_copy(update={"archives": plans, "seed": seed})


def test_number_of_threads_changes_no_byte(tmp_path: Path) -> None:
    for threads in (1, 3):
        simulate_recording(tmp_path / f"{threads}.zarr.zip", 600, scenario="demo", threads=threads)
    from coslidar.catalog.archive import open_archive

    first, second = (open_archive(str(tmp_path / f"{threads}.zarr.zip")) for threads in (1, 3))
    assert first.n_frames == 600
    for chunk in range(first.n_chunks):
        np.testing.assert_array_equal(first.read_chunk(chunk), second.read_chunk(chunk))


def test_a_source_alone_makes_an_archive_with_one_source() -> None:
    recording = recordings(load_scenario("one-source"))[0]
    exact = replace(recording, time=recording.time[:8], index=recording.index[:8])
    slopes, flux = exact.signals(0, 8)
    assert slopes.shape == (8, 2, 1, 20)
    assert flux.shape == (8, 1, 20)
    assert recording.attributes["sources"][0]["spot"] == [15.5, 15.5]
