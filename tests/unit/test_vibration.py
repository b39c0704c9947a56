"""The vibration line: found where it is, with the variance it has, and not where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from coslidar.pipeline.vibration import LOWEST, MOST_CELLS, cells, find_line, spectrum

RATE = 142.0


def tilt(frames: int, seed: int) -> np.ndarray:
    """Kolmogorov tilt: power as f^(-2/3) up to 2 Hz and f^(-11/3) above (Conan, Rousset and Madec 1995,
    https://doi.org/10.1364/JOSAA.12.001559), variance 1e-10, cut from a longer record so that its ends do not meet."""
    random = np.random.default_rng(seed)
    f = np.fft.rfftfreq(20 * frames, 1 / RATE)
    f[0] = np.inf
    amplitude = np.sqrt(np.where(f < 2, (f / 2) ** (-2 / 3), (f / 2) ** (-11 / 3)))
    noise = random.standard_normal((len(f), 2)) + 1j * random.standard_normal((len(f), 2))
    values = np.fft.irfft(noise * amplitude[:, None], 20 * frames, axis=0)[:frames]
    return 1e-5 * values / values.std(axis=0) + 5e-8 * random.standard_normal((frames, 2))


def line(frames: int, frequency: float, variance: tuple[float, float]) -> np.ndarray:
    phase = 2 * np.pi * frequency * np.arange(frames) / RATE
    return np.sqrt(2 * np.array(variance)) * np.sin(phase[:, None] + [0.3, 1.1])


@pytest.mark.parametrize("frames", [700, 2800, 25_560])
@pytest.mark.parametrize("frequency", [17.3, 50.0, 66.0])
def test_frequency_and_variance_of_a_line(frames: int, frequency: float) -> None:
    """Sidelobes beyond the band hold 1 / (pi^2 half width x duration), 1 % of 5 s."""
    variance = (1e-12, 4e-12)
    found = find_line(tilt(frames, 1) + line(frames, frequency, variance), RATE)
    assert found.frequency == pytest.approx(frequency, abs=0.1)
    # Line and continuum interfere: at 17 Hz by 2 sqrt(1e-12 x 4e-16), 4e-14, for 2800 frames and twice that for 700.
    assert found.variance == pytest.approx(variance, rel=0.03, abs=1.5e-13 if frequency < 20 else 0)
    assert found.significance > 20


def test_line_above_half_the_rate_shows_at_its_alias() -> None:
    found = find_line(tilt(2800, 2) + line(2800, 100.0, (2e-12, 2e-12)), RATE)
    assert found.frequency == pytest.approx(RATE - 100.0, abs=0.05)
    assert found.variance == pytest.approx([2e-12, 2e-12], rel=0.03)


def test_harmonics_are_found_at_their_aliases() -> None:
    """31 Hz and twice that, and four times, which 142 Hz show at 18 Hz; nothing at three and five times."""
    shaken = tilt(2800, 6) + line(2800, 31.0, (4e-12, 4e-12))
    alone = find_line(shaken, RATE)
    found = find_line(shaken + line(2800, 62.0, (1e-12, 2e-12)) + line(2800, 124.0, (5e-13, 1e-12)), RATE)
    assert found.frequency == pytest.approx(31.0, abs=0.05)
    assert found.variance == pytest.approx(alone.variance, rel=0.01)
    assert not alone.harmonics.any()
    assert found.harmonics[0] == pytest.approx([1e-12, 2e-12], rel=0.03)
    # Interference with the continuum at 18 Hz, as above.
    assert found.harmonics[2] == pytest.approx([5e-13, 1e-12], abs=1e-13)
    assert not found.harmonics[[1, 3]].any()


def test_a_harmonic_on_another_line_counts_once() -> None:
    """Half of 142 Hz is 71: the third of 35.5 Hz, at 106.5, is its own alias."""
    found = find_line(tilt(2800, 7) + line(2800, 35.5, (4e-12, 4e-12)), RATE)
    assert found.variance == pytest.approx([4e-12, 4e-12], rel=0.03)
    assert not found.harmonics.any()


def test_wandering_phase() -> None:
    """A phase that walks makes a Lorentzian of half width g: (2 / pi) arctan(2 Hz / g) of it within 2 Hz, less what the
    wings add to the level beside: arctan(4 Hz / g) - arctan(2 Hz / g)."""
    random = np.random.default_rng(3)
    frames, g = 25_560, 0.1
    walk = np.cumsum(random.normal(0, np.sqrt(4 * np.pi * g / RATE), frames))
    phase = 2 * np.pi * 50.0 * np.arange(frames) / RATE + walk
    shaken = np.sqrt(2 * 4e-12) * np.sin(phase)
    found = find_line(tilt(frames, 3) + shaken[:, None], RATE)
    inside, beside = np.arctan(2 / g), np.arctan(4 / g) - np.arctan(2 / g)
    wanted = 4e-12 * 2 / np.pi * (inside - beside)
    assert found.variance == pytest.approx([wanted, wanted], rel=0.02)
    assert found.frequency == pytest.approx(50.0, abs=0.2)


def test_lost_frames_weaken_nothing() -> None:
    """One frame in ten, and a second in one piece."""
    frames = 2800
    values = tilt(frames, 4) + line(frames, 50.0, (1e-12, 4e-12))
    values[np.random.default_rng(4).random(frames) < 0.1] = np.nan
    values[1000:1142] = np.nan
    found = find_line(values, RATE)
    assert found.frequency == pytest.approx(50.0, abs=0.1)
    # Scattered holes leave 0.9^2 of the line's power in its place, a hole in one piece 0.95; nearly all of it is made
    # up for. Twenty seeds gave 0.975 +- 0.030 and 0.981 +- 0.012 of the two variances.
    assert found.variance == pytest.approx([1e-12, 4e-12], rel=0.1)


def test_turbulence_alone_has_no_line() -> None:
    """A chance of 1e-6 a record, were the spectrum flat within 3 Hz; 200 records."""
    for seed in range(200):
        found = find_line(tilt(1400, 100 + seed), RATE)
        assert np.isnan(found.frequency), seed
        assert (found.variance == 0).all()


def test_records_that_cannot_tell() -> None:
    for values, rate in ((tilt(100, 1), RATE), (tilt(1000, 1), 2 * LOWEST), (np.full((1000, 2), np.nan), RATE)):
        found = find_line(values, rate)
        assert np.isnan(found.frequency)
        assert np.isnan(found.significance)
        assert (found.variance == 0).all()
    assert np.isnan(find_line(np.zeros((1000, 2)), RATE).frequency)


def test_spectrum_of_white_noise_is_its_variance_over_the_band() -> None:
    """Variance over half the frame rate; a cell of 90 periodogram values scatters by 1 / sqrt(90), 10.5 %.

    In the first cell the jump between the ends of the record stands beside it: the spectrum is made for turbulence.
    """
    values = np.random.default_rng(5).normal(0, [1e-6, 2e-6], (25_560, 2))
    found = spectrum(values, RATE)
    assert found.shape == (2, len(cells(RATE))) == (2, 142)
    for axis, variance in enumerate((1e-12, 4e-12)):
        assert found[axis, 1:].mean() == pytest.approx(variance / (RATE / 2), rel=0.02)
        assert (np.abs(found[axis, 1:] / (variance / (RATE / 2)) - 1) < 0.5).all()


def test_spectrum_holds_the_variance_of_a_line_in_its_cell() -> None:
    found = spectrum(tilt(25_560, 1) + line(25_560, 50.25, (1e-12, 4e-12)), RATE)
    peak = int(np.argmin(np.abs(cells(RATE) - 50.25)))
    assert cells(RATE)[peak] == pytest.approx(50.25)
    # Turbulence and noise of 5e-8 leave 1e-17 of variance in a cell of 0.5 Hz.
    assert found[:, peak] * 0.5 == pytest.approx([1e-12, 4e-12], rel=0.01)
    assert (found[:, 90:100] * 0.5 < 1e-14).all()


@pytest.mark.parametrize("rate", [0.4, 10.0, 142.0, 1000.0, 1e5])
def test_cells_cover_the_spectrum_and_stay_few(rate: float) -> None:
    middle = cells(rate)
    assert 1 <= len(middle) <= MOST_CELLS
    if rate > 1:
        width = 2 * middle[0]
        assert rate / 2 - width < middle[-1] + width / 2 <= rate / 2
    assert spectrum(np.zeros((300, 2)), rate).shape == (2, len(middle))


def test_spectrum_of_next_to_nothing_is_unknown() -> None:
    assert np.isnan(spectrum(np.zeros((2, 2)), RATE)).all()
    values = np.zeros((300, 2))
    values[:160] = np.nan
    assert np.isnan(spectrum(values, RATE)).all()
    # A second of 142 frames: the periodogram has a value every hertz, every other cell none.
    second = spectrum(np.random.default_rng(0).normal(size=(143, 2)), RATE)
    assert 0.4 < np.isfinite(second).mean() < 0.6
