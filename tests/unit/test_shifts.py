"""Images moved by parts of a pixel, against scipy's own shift."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.interpolate import BSpline

from coslidar.pipeline.shifts import Splines, cubic_taps


def test_taps_are_the_cubic_spline():
    part = np.array([0.0, 0.2, 0.5, 0.999])
    spline = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    expected = [np.nan_to_num(spline(number - 1 - part)) for number in range(4)]
    # Rounding of a sum of four terms of order one.
    assert np.allclose(cubic_taps(part), expected, rtol=0, atol=4e-16)


@pytest.mark.parametrize("step", [(0.0, 0.0), (0.3, -0.7), (-4.0, 2.5), (9.2, -11.9)])
def test_an_image_is_moved_as_scipy_moves_it(step):
    images = np.random.default_rng(1).random((3, 20, 17))
    splines = Splines(images)
    for number, image in enumerate(images):
        expected = ndimage.shift(image, step, order=3, mode="nearest")
        # The coefficients are those of an image continued by 16 px instead of 12: an edge is forgotten by 0.27 a pixel.
        assert np.allclose(splines.moved(number, np.array(step)), expected, rtol=0, atol=1e-6)
