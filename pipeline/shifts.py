"""Images moved by parts of a pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

#: Pixels by which an image is continued beyond its edges; as far as it may be moved, less those that a spline needs.
_MARGIN = 16


def cubic_taps(part: Floats) -> list[Floats]:
    """Weights of four neighbouring coefficients of a cubic B-spline (Unser 1999, DOI 10.1109/79.799930, Eq. (8)).

    Parameters
    ----------
    part : ndarray
        How far behind the second of them the place lies, 0 to 1.
    """
    rest = 1.0 - part
    return [
        rest**3 / 6,
        2 / 3 - part**2 * (2 - part) / 2,
        2 / 3 - rest**2 * (2 - rest) / 2,
        part**3 / 6,
    ]


class Splines:
    """Images as cubic splines, continued by their edge pixels.

    Parameters
    ----------
    images : ndarray, (n, rows, cols)
        The images.
    """

    def __init__(self, images: Floats) -> None:
        padded = np.pad(images, ((0, 0), (_MARGIN, _MARGIN), (_MARGIN, _MARGIN)), mode="edge")
        for axis in (1, 2):
            padded = ndimage.spline_filter1d(padded, order=3, axis=axis, mode="nearest")
        self._coefficients = padded
        self._shape = images.shape[1:]

    def moved(self, number: int, step: Floats) -> Floats:
        """An image moved by (row, col) pixels; no further than its edge pixels continue it.

        The same as ``scipy.ndimage.shift(image, step, order=3, mode="nearest")``.
        """
        reach = _MARGIN - 2.0
        coefficients = self._coefficients[number]
        for axis, move in enumerate(np.clip(step, -reach, reach)):
            begin = -float(move)
            whole = int(np.floor(begin))
            taps = cubic_taps(np.asarray(begin - whole))
            first = _MARGIN + whole - 1
            parts = [coefficients[first + k : first + k + self._shape[axis]] for k in range(4)]
            # Once for rows and once for columns; transposed twice.
            coefficients = sum(tap * part for tap, part in zip(taps, parts, strict=True)).T
        return np.asarray(coefficients)
