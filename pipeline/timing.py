"""What happens to a record in the course of time: time stamps, repeated frames, sources that go out, drifts."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import fft, ndimage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

#: A step of the time stamps longer than this many frame periods is a gap.
GAP = 1.5
#: Part of its usual light, averaged over the pupil, below which a source is out. Twenty subapertures at a scintillation
#: index of 1 get there once in ten thousand frames.
OUT = 0.3
#: Part of its usual light, averaged over the pupil and `WHILE` (s), below which a source is covered.
COVERED, WHILE = 0.5, 1.0
#: Frames to either side of those in which a source is out that are left out too: it may have changed during exposure.
GUARD = 1


class Stamps(NamedTuple):
    """Time stamps of a batch against the frame rate.

    Attributes
    ----------
    rate : float
        Frames per second between gaps, from the stamps, Hz.
    jitter : float
        Scatter of the steps between gaps, s.
    missing : int
        Frames missing in gaps.
    backward : int
        Stamps that are not later than the one before.
    """

    rate: float
    jitter: float
    missing: int
    backward: int


def stamps(time: NDArray[np.int64], frame_rate: float) -> Stamps:
    """Compare time stamps with the frame rate.

    Parameters
    ----------
    time : ndarray of int64, (T,)
        Time stamps, ns.
    frame_rate : float
        Hz, as the header says.

    Returns
    -------
    Stamps
        Rate and jitter are NaN without two frames in a row.
    """
    period = 1e9 / frame_rate
    steps = np.diff(time)
    gaps = steps > GAP * period
    backward = int((steps <= 0).sum())
    regular = steps[~gaps & (steps > 0)].astype(np.float64)
    missing = int(np.round(steps[gaps] / period - 1).sum())
    if not regular.size:
        return Stamps(np.nan, np.nan, missing, backward)
    return Stamps(1e9 / float(regular.mean()), float(regular.std()) / 1e9, missing, backward)


def regular(values: NDArray[np.floating], time: NDArray[np.int64], frame_rate: float) -> NDArray[np.floating]:
    """Put a series with gaps on equally spaced frames, NaN where there is none.

    Parameters
    ----------
    values : ndarray, (T, ...)
        One row per frame.
    time : ndarray of int64, (T,)
        Time stamps, ns.
    frame_rate : float
        Hz.

    Returns
    -------
    ndarray, (T', ...)
        The values themselves where nothing is missing, the stamps are out of order, or the gaps hold more frames than
        the record.
    """
    seen = stamps(time, frame_rate)
    if seen.missing == 0 or seen.backward or seen.missing > len(time):
        return values
    # Counted from gap to gap, so that a rate that is slightly off does not add up.
    steps = np.maximum(np.round(np.diff(time) * (frame_rate / 1e9)), 1).astype(np.int64)
    number = np.concatenate([[0], np.cumsum(steps)])
    result = np.full((number[-1] + 1, *values.shape[1:]), np.nan)
    result[number] = values
    return result


def repeated(slopes: NDArray[np.floating], flux: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Frames that repeat the one before bit by bit: duplicates, or a frozen camera.

    Two exposures with noise never give the same slopes and fluxes in all spots. Only where one spot repeats itself are
    the others looked at.

    Parameters
    ----------
    slopes : ndarray, (T, 2, S, A)
        Slopes; NaN where not measured.
    flux : ndarray, (T, S, A)
        Fluxes.

    Returns
    -------
    ndarray of bool, (T,)
        False for the first frame of a run, and for frames without any measurement.
    """
    frames = len(flux)
    found = np.zeros(frames, dtype=bool)
    if frames < 2 or flux[0].size == 0:
        return found
    some = flux[:: max(frames // 64, 1)].reshape(-1, flux[0].size)
    spot = int(np.argmax(np.isfinite(some).sum(axis=0)))
    series = flux.reshape(frames, -1)[:, spot]
    candidates = np.flatnonzero((series[1:] == series[:-1]) | np.isnan(series[1:])) + 1
    for start in range(0, candidates.size, 1024):
        rows = candidates[start : start + 1024]
        same = np.isfinite(flux[rows]).any(axis=(1, 2))
        for signal in (flux, slopes):
            axes = tuple(range(1, signal.ndim))
            now, before = signal[rows], signal[rows - 1]
            same &= ((now == before) | (np.isnan(now) & np.isnan(before))).all(axis=axes)
        found[rows] = same
    return found


def pupil_mean(values: NDArray[np.floating]) -> Floats:
    """Mean over the last axis of what is measured, NaN where nothing is.

    Parameters
    ----------
    values : ndarray, (..., A)
        Slopes, or fluxes relative to their mean.

    Returns
    -------
    ndarray, (...)
    """
    rows = np.asarray(values, dtype=np.float64).reshape(-1, values.shape[-1])
    mean = rows @ np.full(rows.shape[1], 1 / rows.shape[1])
    holes = np.flatnonzero(~np.isfinite(mean))
    if holes.size:
        finite = np.isfinite(rows[holes])
        count = finite.sum(axis=1)
        total = np.where(finite, rows[holes], 0.0).sum(axis=1)
        mean[holes] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return np.asarray(mean.reshape(values.shape[:-1]))


def outages(light: Floats, frame_rate: float) -> NDArray[np.bool_]:
    """Frames in which a source is out: its light over the whole pupil is far below what it usually is.

    Scintillation fades for less than a second, so what lasts longer is judged by its mean over a second, and more
    strictly.

    Parameters
    ----------
    light : ndarray, (T, S)
        Mean relative flux over the pupil; NaN where no spot was found.
    frame_rate : float
        Hz.

    Returns
    -------
    ndarray of bool, (T, S)
        With `GUARD` frames, or half of `WHILE`, to either side.
    """
    result = np.ones(light.shape, dtype=bool)
    width = min(round(WHILE * frame_rate), len(light)) | 1
    for source, column in enumerate(light.T):
        seen = np.isfinite(column)
        if not seen.any():
            continue
        relative = np.where(seen, column, 0.0) / np.median(column[seen])
        out = _widened(relative < OUT, GUARD)
        mean = ndimage.uniform_filter1d(relative, width, mode="nearest")
        result[:, source] = out | _widened(mean < COVERED, width // 2)
    return result


def _widened(mark: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """A mark with `reach` frames to either side."""
    if not mark.any():
        return mark
    return np.asarray(ndimage.maximum_filter1d(mark.astype(np.uint8), 2 * reach + 1, mode="constant") > 0)


def trend(values: NDArray[np.floating]) -> Floats:
    """Change of a series from its first to its last frame, along the straight line that fits it best.

    Parameters
    ----------
    values : ndarray, (T, ...)
        One row per frame; NaN where there is none.

    Returns
    -------
    ndarray, (...)
        In the unit of the values; NaN with fewer than two.
    """
    series = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
    place = np.linspace(-0.5, 0.5, len(series))
    result = np.full(series.shape[1], np.nan)
    for number, column in enumerate(series.T):
        seen = np.isfinite(column)
        if seen.sum() > 1:
            x = place[seen] - place[seen].mean()
            result[number] = float(x @ column[seen] / (x @ x))
    return result.reshape(values.shape[1:])


def slow_part(light: Floats, frame_rate: float, cut: float) -> Floats:
    """Slow change of a source's light: everything below a frequency.

    Parameters
    ----------
    light : ndarray, (T, S)
        Mean relative flux over the pupil; gaps are bridged by straight lines.
    frame_rate : float
        Hz.
    cut : float
        Highest frequency that counts as slow, Hz.

    Returns
    -------
    ndarray, (T, S)
        Positive, mean 1; ones for a source without light.

    Notes
    -----
    Cosines with an even continuation, so that a drift makes no jump at the ends.
    """
    frames = len(light)
    kept = int(2 * cut * frames / frame_rate) + 1
    result = np.ones_like(light)
    for source, column in enumerate(light.T):
        seen = np.flatnonzero(np.isfinite(column))
        if seen.size < 2:
            continue
        filled = np.interp(np.arange(frames), seen, column[seen])
        cosines = fft.dct(filled, norm="ortho")
        cosines[kept:] = 0.0
        slow = fft.idct(cosines, norm="ortho")
        # The light of a frame is divided by this.
        result[:, source] = np.maximum(slow / slow.mean(), OUT)
    return result
