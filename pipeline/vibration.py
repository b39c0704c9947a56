"""The vibration line: the strongest narrow line in the temporal spectrum of the slopes that all spots share.

A shaking instrument moves every spot by the same amount, so the line stands out in the mean slope over subapertures
and sources, in which turbulence and detection noise are small at high frequencies. Its variance is the power above the
continuum to either side. Sauvage et al. 2021 (arXiv:2111.08003), Sec. 4.2, subtract it from every entry of the four
slope maps (50 Hz, the cryocooler of the camera); here the inversion's constant of the slope maps takes it up by
default.

A line above half the frame rate appears at its alias; its variance is the same. The spectrum's floor is no measure of
noise: winds of a few m/s move the scintillation pattern by more than its size from frame to frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import fft, ndimage
from scipy.special import gammaincc

from .products import HARMONICS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

#: Width of the cells of the spectrum among which a peak is looked for, Hz.
CELL = 0.5
#: To either side of a cell, width of the spectrum that its continuum is taken from, Hz.
SURROUNDINGS = 3.0
#: Half the width of the band that a line is summed over, Hz, and at most that part of its frequency. A machine whose
#: phase wanders has wide wings: of the sample recording's line 91 % lies within 0.5 Hz, 95 % within 2 Hz.
HALF_WIDTH, RELATIVE = 2.0, 0.05
#: Gaps are filled with means over this time, s.
BRIDGE = 0.2
#: Lines are looked for from here on, Hz: below, the turbulent tilt has a slope that looks like one.
LOWEST = 5.0
#: Most cells of the spectrum that a product keeps; of fast sensors they are wider than `CELL`.
MOST_CELLS = 400
#: Chance that a spectrum without a line passes as one with.
FALSE_ALARM = 1e-6


class Vibration(NamedTuple):
    """The strongest line.

    Attributes
    ----------
    frequency : float
        Hz, as the frame rate shows it; NaN where there is no line.
    variance : ndarray, (2,)
        Of the x and y slopes by vibration, rad^2; 0 where there is no line.
    significance : float
        Power of the strongest peak over the continuum, in standard deviations of the continuum.
    harmonics : ndarray, (len(HARMONICS), 2)
        Variance of the x and y slopes by the multiples `HARMONICS` of the frequency, rad^2; 0 where there is none,
        or where its alias lies on another line or below `LOWEST`.
    """

    frequency: float
    variance: Floats
    significance: float
    harmonics: Floats


def find_line(tilt: NDArray[np.floating], frame_rate: float) -> Vibration:
    """Look for a vibration line.

    Parameters
    ----------
    tilt : ndarray, (T, 2)
        Mean slopes along x and y, rad, equally spaced in time; NaN where a frame is missing.
    frame_rate : float
        Hz.

    Returns
    -------
    Vibration
        Without a line also where the record is shorter than two seconds or has too low a rate.

    Notes
    -----
    Steps from frame to frame are analysed, not the slopes themselves: the ends of a record do not meet, and the jump
    between them, mostly slow tilt, would hide weak lines; divided by the spectrum of a step the result is that of the
    slopes, with every frame of the same weight. The periodograms of both axes are averaged in cells of `CELL`, relative
    to the running median of their surroundings. In a smooth spectrum such an average follows a gamma distribution; the
    largest of all cells must exceed what it reaches with a chance of `FALSE_ALARM`. The variance is the sum over the
    band of the line, less the mean level of as much spectrum on either side. Harmonics pass the
    same test at the aliases of the multiples of the frequency. A line that stands out the most because the continuum is
    low there may be one itself: of a stronger line at its half or third.
    """
    none = np.zeros((len(HARMONICS), 2))
    nothing = Vibration(np.nan, np.zeros(2), np.nan, none)
    missing = ~np.isfinite(tilt).all(axis=1)
    length = _length(len(tilt))
    per_cell = int(CELL * length / frame_rate)
    if per_cell < 1 or frame_rate / 2 < LOWEST + SURROUNDINGS or missing.mean() > 0.5:
        return nothing
    frequency, power = _periodogram(tilt, missing, frame_rate)

    cells = len(power) // per_cell
    cell = power[: cells * per_cell].reshape(cells, per_cell, 2).mean(axis=1)
    around = 2 * round(SURROUNDINGS / CELL) + 1
    continuum = np.stack([ndimage.median_filter(column, around, mode="nearest") for column in cell.T], axis=1)
    # The median of a gamma distribution lies below its mean (Wilson and Hilferty).
    continuum /= (1 - 1 / (9 * per_cell)) ** 3
    if not (continuum > 0).all():
        return nothing
    searched = (np.arange(cells) + 0.5) * per_cell * frame_rate / length >= LOWEST
    excess = np.where(searched, (cell / continuum).mean(axis=1), 0.0)
    peak = int(np.argmax(excess))
    # A median of n numbers scatters as the mean of n / 1.57 of them; its error adds to that of the cell.
    degrees = 2 * per_cell / (1 + 1.57 / around)
    significance = float((excess[peak] - 1) * np.sqrt(degrees))
    if float(gammaincc(degrees, degrees * excess[peak])) * int(searched.sum()) > FALSE_ALARM:
        return Vibration(np.nan, np.zeros(2), significance, none)

    def strength(peak: int) -> tuple[float, Floats]:
        """Frequency and variance of the line in or beside a cell."""
        # The line may lie on the border of two cells.
        near = np.arange(max((peak - 1) * per_cell, 1), min((peak + 2) * per_cell, len(power)))
        above = (power[near] / continuum[peak]).sum(axis=1)
        reach = np.abs(near - near[np.argmax(above)]) <= per_cell // 2
        centre = float((frequency[near] * above)[reach].sum() / above[reach].sum())
        half = min(HALF_WIDTH, RELATIVE * centre)
        band = np.abs(frequency - centre) <= half
        beside = ~band & (np.abs(frequency - centre) <= 2 * half)
        variance = np.maximum(power[band].sum(axis=0) - band.sum() * power[beside].mean(axis=0), 0.0)
        if missing.any():
            # A line that is cut into pieces is convolved with the spectrum of the cuts: what of it stays in the band.
            cuts = np.abs(fft.rfft((~missing[:length]).astype(np.float64)) / length) ** 2
            inside = int(half * length / frame_rate)
            variance /= cuts[0] + 2 * cuts[1 : inside + 1].sum()
        return centre, variance

    middles = (np.arange(cells) + 0.5) * per_cell * frame_rate / length

    def line_at(expected: float, uncertainty: float) -> tuple[float, Floats] | None:
        """Frequency and variance of a line where one is expected."""
        close = np.flatnonzero(searched & (np.abs(middles - expected) <= CELL + uncertainty))
        if not close.size:
            return None
        peak = int(close[np.argmax(excess[close])])
        chance = float(gammaincc(degrees, degrees * excess[peak])) * close.size
        return strength(peak) if chance <= FALSE_ALARM else None

    centre, variance = strength(peak)
    for divisor in (2, 3):
        below = line_at(centre / divisor, CELL / 2)
        if below is not None and below[1].sum() > variance.sum():
            centre, variance = below
            break
    harmonics, lines = none.copy(), [centre]
    for number, multiple in enumerate(HARMONICS):
        alias = abs((multiple * centre + frame_rate / 2) % frame_rate - frame_rate / 2)
        if min(abs(alias - line) for line in lines) < 2 * HALF_WIDTH:
            continue
        # The frequency is known to half a cell at worst.
        found = line_at(alias, multiple * CELL / 2)
        if found is not None:
            lines.append(found[0])
            harmonics[number] = found[1]
    return Vibration(centre, variance, significance, harmonics)


def cells(frame_rate: float) -> Floats:
    """Middles of the cells of :func:`spectrum`, Hz: equally wide up to half the frame rate, at most `MOST_CELLS`."""
    count = int(frame_rate / 2 / _width(frame_rate))
    return np.asarray((np.arange(max(count, 1)) + 0.5) * _width(frame_rate), dtype=np.float64)


def spectrum(tilt: NDArray[np.floating], frame_rate: float) -> Floats:
    """Temporal power spectral density of the mean slopes.

    Parameters
    ----------
    tilt : ndarray, (T, 2)
        As for :func:`find_line`.
    frame_rate : float
        Hz.

    Returns
    -------
    ndarray, (2, n)
        One-sided density along x and y in each of :func:`cells`, rad^2/Hz: its integral over frequency is the variance.
        NaN where the record is too short to tell a cell from the next, or less than half of it is there. The lowest
        cell also holds what two ends of a record that do not meet make of it.
    """
    centres = cells(frame_rate)
    missing = ~np.isfinite(tilt).all(axis=1)
    found = np.full((2, len(centres)), np.nan)
    length = _length(len(tilt))
    if length < 2 or missing.mean() > 0.5:
        return found
    frequency, power = _periodogram(tilt, missing, frame_rate)
    # Frequency zero holds the mean slope, which is no variance.
    number = (frequency[1:] / _width(frame_rate)).astype(np.int64)
    for axis in range(2):
        total = np.bincount(number, power[1:, axis], minlength=len(centres))[: len(centres)]
        count = np.bincount(number, minlength=len(centres))[: len(centres)]
        found[axis, count > 0] = total[count > 0] / count[count > 0] * length / frame_rate
    return found


def _width(frame_rate: float) -> float:
    """Width of a cell of the recorded spectrum, Hz."""
    return float(CELL * np.ceil(frame_rate / 2 / CELL / MOST_CELLS))


def _length(frames: int) -> int:
    """Steps between frames that are transformed; a length with a large prime factor would take long."""
    return int(fft.prev_fast_len(frames - 1)) if frames > 4096 else frames - 1


def _periodogram(tilt: NDArray[np.floating], missing: NDArray[np.bool_], frame_rate: float) -> tuple[Floats, Floats]:
    """Frequencies in Hz, and the variance of both axes at each of them, from the steps between frames."""
    length = _length(len(tilt))
    values = np.asarray(tilt, dtype=np.float64)
    if missing.any():
        values = _bridged(values, missing, max(round(BRIDGE * frame_rate), 3))
    frequency = np.arange(length // 2 + 1) * frame_rate / length
    power = np.abs(fft.rfft(np.diff(values, axis=0)[:length], axis=0)) ** 2 * (2 / length**2)
    power[1:] /= 4 * np.sin(np.pi * frequency[1:, None] / frame_rate) ** 2
    return frequency, power


def _bridged(values: Floats, missing: NDArray[np.bool_], width: int) -> Floats:
    """Fill gaps with running means of what is there, which know of slow tilt and nothing of a line."""
    known = np.where(missing[:, None], 0.0, values)
    share = ndimage.uniform_filter1d((~missing).astype(np.float64), width, mode="nearest")
    near = share > 0.5 / width
    frames, place = np.arange(len(values)), np.flatnonzero(near)
    filled = values.copy()
    for axis in range(values.shape[1]):
        mean = ndimage.uniform_filter1d(known[:, axis], width, mode="nearest")
        mean = np.interp(frames, place, mean[place] / share[place])
        filled[missing, axis] = mean[missing]
    return filled
