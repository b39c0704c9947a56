"""Slopes and fluxes of the frames of one batch: spots found, measured, and followed.

The frames are taken in units of `reference_frames` frames, counted from the first frame of the batch however the
recording is stored. The spots are found on the mean of the first unit. They are found again, on the mean of the unit
that shows it, when a source that was dark appears, or when the spots of a source have moved by more than `follow` from
where they were found. Window and zero of the slopes stay what they were, so that a drift is in the slopes.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from . import noise
from .extraction import REFINED, extract, response_to_tilt
from .products import Measurements
from .spot_layout import LIT, layout, reference_image
from .spots import FLAGS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from .parameters import ExtractionParameters, Header
    from .spots import Calibration, SpotLayout

    Floats = NDArray[np.float64]

#: Every so many frames of a unit tell where its spots are.
EVERY = 8


class BatchError(ValueError):
    """A batch that cannot be processed, with the reason."""


class MeasurementError(BatchError):
    """Frames that cannot be measured, with the reason."""


class _Reference:
    """Where the spots are now, and where they were when they were first found.

    Parameters
    ----------
    header, calibration, parameters
        As for :func:`measure`.
    frames : list of ndarray
        The first unit.
    """

    def __init__(
        self, header: Header, calibration: Calibration, parameters: ExtractionParameters, frames: list[NDArray[Any]]
    ) -> None:
        self._given = header, calibration, parameters
        found = self._find(frames)
        self._now(found, found.spots)

    def _find(self, frames: list[NDArray[Any]], **known: Any) -> SpotLayout:
        header, calibration, parameters = self._given
        try:
            return layout(header, reference_image(*frames), calibration, parameters, **known)
        except ValueError as error:
            raise MeasurementError(str(error)) from error

    def _now(self, found: SpotLayout, zero: Floats) -> None:
        self.layout, self._zero = found, zero
        #: Sources whose spots are known, (S,).
        self.lit = np.asarray(((found.excluded & FLAGS["no_spot"]) == 0).mean(axis=1) >= LIT)
        #: From the zero of the slopes to the present place of the spots, (2, S, A), rad.
        self.shift = np.asarray((found.spots - zero).transpose(2, 0, 1)[::-1] * found.pixel_scale)

    def find_again(self, frames: list[NDArray[Any]], moved: Floats | float = 0.0) -> None:
        """Find the spots on the mean of a unit; those that were not known have their zero there.

        As long as no source was seen, nothing is kept of what was found before.
        """
        known: dict[str, Any] = {"previous": self.layout, "moved": moved} if self.lit.any() else {}
        unknown = (self.layout.excluded & FLAGS["no_spot"]) > 0
        found = self._find(frames, **known)
        self._now(found, np.where(unknown[..., None], found.spots, self._zero))


def measure(
    blocks: Iterable[NDArray[Any]],
    time: NDArray[np.int64],
    header: Header,
    calibration: Calibration,
    parameters: ExtractionParameters,
) -> Measurements:
    """Slopes and fluxes of the frames of one batch, block by block.

    Parameters
    ----------
    blocks : iterable of ndarray, (n, row, col)
        Consecutive raw frames; how they are cut does not matter.
    time : ndarray of int64, (T,)
        Time stamps of all of them.
    header : Header
        Header of the archive.
    calibration : Calibration
        Dark, flat, bad pixels.
    parameters : ExtractionParameters
        Method and window.

    Returns
    -------
    Measurements

    Raises
    ------
    MeasurementError
        There is no frame, their number is not that of the time stamps, or the window does not fit into a box.
    """
    n_sources = len(header.sources)
    n_boxes = int(np.count_nonzero(header.instrument.subaperture_mask))
    slopes = np.empty((len(time), 2, n_sources, n_boxes))
    flux = np.empty((len(time), n_sources, n_boxes))
    flag = np.empty((len(time), n_sources, n_boxes), dtype=np.uint8)
    reference: _Reference | None = None
    dark = 0.0
    done = 0
    for unit in _units(blocks, parameters.reference_frames):
        start = done
        if reference is None:
            reference = _Reference(header, calibration, parameters, unit)
            few = np.concatenate([piece[: noise.FRAMES] for piece in unit])[: noise.FRAMES]
            dark = noise.pixel_noise_variance(few, reference.layout, calibration)
        elif not reference.lit.all():
            reference.find_again(unit)
        for piece in unit:
            stop = done + len(piece)
            if stop > len(time):
                break
            out = slopes[done:stop], flux[done:stop], flag[done:stop]
            extract(piece, reference.layout, calibration, parameters, out)
            done = stop
        moved = _displacement(slopes[start:done:EVERY]) / header.instrument.pixel_scale
        if reference.shift.any():
            slopes[start:done] += reference.shift
        if np.nanmax(np.abs(moved), initial=0.0) > parameters.follow:
            reference.find_again(unit, np.nan_to_num(moved[::-1].T))
    if reference is None:
        raise MeasurementError("there is no frame")
    if done != len(time):
        raise MeasurementError(f"there are {len(time)} time stamps, but not as many frames")
    return _judged(slopes, flux, flag, time, reference.layout, dark, header, parameters)


def _judged(
    slopes: Floats,
    flux: Floats,
    flag: NDArray[np.uint8],
    time: NDArray[np.int64],
    found: SpotLayout,
    dark: float,
    header: Header,
    parameters: ExtractionParameters,
) -> Measurements:
    """Noise and gain of what was measured."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a spot that is never measured has no mean
        mean = np.nanmean(flux, axis=0)
    height, width = found.window
    electrons = header.instrument.gain
    few = flux[:: noise.EVERY]
    if parameters.method in REFINED:
        slope_noise = noise.refined_noise_variance(found, few, dark, electrons, parameters)
    else:
        recentred = parameters.method != "moving_maximum"
        slope_noise = noise.slope_noise_variance(found, few, dark, electrons, recentred=recentred)
    gain = response_to_tilt(found, parameters)
    if parameters.gain == "corrected":
        # A source that was never lit has no gain, and no slopes.
        known = np.where(gain > 0, gain, np.nan)[..., None]
        slopes /= known
        slope_noise = slope_noise / known**2
    return Measurements(
        time,
        slopes,
        flux,
        flag,
        flux_noise=noise.flux_noise_variance(mean, dark, height * width, electrons),
        slope_noise=slope_noise,
        centroid_gain=gain,
    )


def _units(blocks: Iterable[NDArray[Any]], size: int) -> Iterator[list[NDArray[Any]]]:
    """Pieces of the blocks, `size` frames at a time; fewer at the end."""
    waiting: list[NDArray[Any]] = []
    missing = size
    for block in blocks:
        rest = block
        while len(rest) >= missing:
            yield [*waiting, rest[:missing]]
            rest = rest[missing:]
            waiting, missing = [], size
        if len(rest):
            waiting.append(rest)
            missing -= len(rest)
    if waiting:
        yield waiting


@njit(cache=True, nogil=True)
def _displacement(slopes: Any) -> Any:
    """Median over the spots of each source of their mean displacement, (2, S); NaN where half of them are not seen."""
    n_frames, n_axes, n_sources, n_boxes = slopes.shape
    result = np.full((n_axes, n_sources), np.nan)
    mean = np.empty(n_boxes)
    for axis in range(n_axes):
        for source in range(n_sources):
            often = 0
            for box in range(n_boxes):
                total, count = 0.0, 0
                for frame in range(n_frames):
                    slope = slopes[frame, axis, source, box]
                    if np.isfinite(slope):
                        total += slope
                        count += 1
                if count and count >= 0.5 * n_frames:
                    mean[often] = total / count
                    often += 1
            if often and often >= LIT * n_boxes:
                result[axis, source] = np.median(mean[:often])
    return result
