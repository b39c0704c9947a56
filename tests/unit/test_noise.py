from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from coslidar.pipeline.extraction import Calibration
from coslidar.pipeline.noise import flux_noise_variance, pixel_noise_variance

LAYOUT = SimpleNamespace(boxes=np.array([[0, 0], [0, 20], [20, 0]]), pitch=(20, 20))


def frames(sigma: float, frames: int = 32, seed: int = 1) -> np.ndarray:
    """Dark pattern, drift, one bright flickering spot per box, and noise of known variance."""
    rng = np.random.default_rng(seed)
    dark = rng.uniform(90, 110, (40, 40))
    row, col = np.mgrid[:20, :20]
    spot = 2000 * np.exp(-((row - 9) ** 2 + (col - 9) ** 2) / 8)
    light = np.tile(spot, (2, 2)) * rng.lognormal(0, 0.3, (frames, 1, 1))
    drift = np.linspace(0, 5, frames)[:, None, None]
    noisy = dark + light + drift + rng.normal(0, sigma, (frames, 40, 40))
    noisy[:, 3, 3] += rng.normal(0, 500, frames)  # a flickering pixel
    return noisy.astype(np.float32)


@pytest.mark.parametrize("sigma", [2.0, 6.0])
def test_variance_of_dark_pixels(sigma: float) -> None:
    """300 dark pixels x 31 differences fix the median to 2 %; its bias against the mean is 2 % for 31 differences."""
    found = pixel_noise_variance(frames(sigma), LAYOUT, Calibration())  # type: ignore[arg-type]
    assert found == pytest.approx(sigma**2, rel=0.06)


def test_bad_pixels_and_single_frames() -> None:
    bad = np.ones((40, 40), dtype=bool)
    assert pixel_noise_variance(frames(2.0), LAYOUT, Calibration(bad_pixel=bad)) == 0  # type: ignore[arg-type]
    assert pixel_noise_variance(frames(2.0)[:1], LAYOUT, Calibration()) == 0  # type: ignore[arg-type]


def test_flux_noise_against_drawn_photons() -> None:
    """Photons drawn by Poisson's law plus read noise of each pixel, in counts."""
    rng = np.random.default_rng(2)
    gain, read, area, flux = 12.0, 5.0, 50, 300.0
    drawn = rng.poisson(flux * gain, 200_000) / gain + rng.normal(0, read * np.sqrt(area), 200_000)
    predicted = flux_noise_variance(np.array([flux]), read**2, area, gain)
    assert predicted[0] == pytest.approx(drawn.var(), rel=0.02)  # 200,000 draws: 0.3 %
    assert flux_noise_variance(np.array([flux]), read**2, area, None)[0] == area * read**2
