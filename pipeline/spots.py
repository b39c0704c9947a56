"""What a measurement of spots needs to know: calibration, layout, and the flags of its results."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

#: Bits of a measurement's flag. Slopes and flux are NaN wherever a bit other than `saturated` is set.
FLAGS: dict[str, int] = {
    "no_light": 1,  # flux in the window below the floor, or not a number
    "window_left": 2,  # the window left the lenslet box
    "strayed": 4,  # the centre of gravity is nearer to the other source's spot, or out of reach of its own
    "not_converged": 8,  # the last pass still moved the window by more than CONVERGENCE
    "bad_pixels": 16,  # bad pixels hold too much of this spot's light, in every frame
    "no_spot": 32,  # the mean frame shows no spot here, in every frame
    "saturated": 64,  # a pixel in the window has reached the saturation level; the measurement is kept
}

#: Step of the tables of wings, px.
WING_STEP = 0.5
#: How far from its mean place a window usually is, px.
USUAL = 1.0


def eights(number: int) -> int:
    """The next multiple of eight."""
    return -(-number // 8) * 8


@dataclass(frozen=True)
class Calibration:
    """What is known of the detector.

    Parameters
    ----------
    dark : ndarray of float, (row, col), optional
        Offset and mean background, counts.
    flat : ndarray of float, (row, col), optional
        Relative response, mean 1.
    bad_pixel : ndarray of bool, (row, col), optional
        True where a pixel must not be used.
    saturation : float, optional
        Level of saturation in raw counts.
    """

    dark: NDArray[np.floating[Any]] | None = None
    flat: NDArray[np.floating[Any]] | None = None
    bad_pixel: NDArray[np.bool_] | None = None
    saturation: float | None = None


@dataclass(frozen=True)
class SpotLayout:
    """Where the spots are, and everything the measurement needs that does not change from frame to frame.

    Positions are (row, col) in a lenslet box, 0 at the centre of the box's first pixel.

    Parameters
    ----------
    boxes : ndarray of int, (A, 2)
        First pixel (row, col) of each exploited lenslet's box.
    pitch : tuple of int
        Size (rows, cols) of a box.
    frame_shape : tuple of int
        Size (rows, cols) of a frame.
    pixel_scale : float
        Angle of a pixel, rad.
    spots : ndarray of float, (S, A, 2)
        Mean position of each spot: the zero of the slopes.
    flux : ndarray of float, (S, A)
        Flux of each spot in the mean frame, counts.
    window : tuple of float
        Size (along y, along x) of the window, px.
    fwhm : float
        Full width at half maximum of the mean spot, px.
    template : ndarray of float, (S, rows, cols)
        Mean box without bad pixels, averaged over the subapertures with the source's spots moved to `centre`.
    centre : ndarray of float, (S, 2)
        Position of the source's spot in `template`.
    search : ndarray of int, (S, A, 4)
        First row, last row, first column, last column among which the brightest pixel is looked for.
    scale, offset : ndarray of float32, (A, rows, cols)
        Calibrated pixel = raw * scale - offset; both 0 on bad pixels.
    suspect : ndarray of float32, (A,)
        Calibrated value from which on a pixel of the box may be saturated.
    bad_start : ndarray of int, (A + 1,)
        The bad pixels of box a are `bad_index[bad_start[a]:bad_start[a + 1]]`.
    bad_index : ndarray of int, (B,)
        Pixel of the box, row * cols + col.
    bad_neighbour, bad_weight : ndarray, (B, 12)
        Pixels that predict it, and their weights.
    excluded : ndarray of uint8, (S, A)
        Bits of `FLAGS` that hold for every frame.
    boost : ndarray of float32, (S, 2)
        Motion of the mean spot along y and x, per motion of its centre of gravity in a window that stays where it is.
    wings : ndarray of float32, (S, n, n, 3)
        What a spot of the other source with light 1 has in a window around this source's: light, and first moments
        along y and x around the window's centre. The other lies (row, col) away from there, by `wing_start` and steps
        of `WING_STEP`. Empty where nothing is to be taken off.
    wing_start : ndarray of float32, (S, 2)
        See `wings`.
    prepared : tuple of ndarray
        What the method needs besides; see :func:`coslidar.pipeline.refinement.prepared`.
    """

    boxes: NDArray[np.int64]
    pitch: tuple[int, int]
    frame_shape: tuple[int, int]
    pixel_scale: float
    spots: Floats
    flux: Floats
    window: tuple[float, float]
    fwhm: float
    template: Floats
    centre: Floats
    search: NDArray[np.int64]
    scale: NDArray[np.float32]
    offset: NDArray[np.float32]
    suspect: NDArray[np.float32]
    bad_start: NDArray[np.int64]
    bad_index: NDArray[np.int64]
    bad_neighbour: NDArray[np.int64]
    bad_weight: NDArray[np.float32]
    excluded: NDArray[np.uint8]
    boost: NDArray[np.float32]
    wings: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2, 2, 3), dtype=np.float32))
    wing_start: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.float32))
    prepared: tuple[NDArray[Any], ...] = ()

    @cached_property
    def usual(self) -> tuple[NDArray[np.int64], int]:
        """Part of each box that search and windows are usually in: first row, row behind the last, first column.

        Returns
        -------
        ndarray of int, (A, 3), and the number of its columns.
        """
        half = np.array(self.window) / 2 + USUAL
        # A pixel reaches half a pixel beyond its centre.
        low = np.floor((self.spots + 0.5).min(axis=0) - half)
        high = np.ceil((self.spots + 0.5).max(axis=0) + half)
        low = np.minimum(low, self.search[..., ::2].min(axis=0)).clip(0)
        high = np.maximum(high, self.search[..., 1::2].max(axis=0) + 1) + np.array([1, 0])
        high = np.minimum(high, self.pitch)
        across = min(eights(int((high - low)[:, 1].max())), self.pitch[1])
        left = ((low + high)[:, 1] - across) // 2
        parts = np.stack([low[:, 0], high[:, 0], left.clip(0, self.pitch[1] - across)], axis=1)
        return parts.astype(np.int64), across
