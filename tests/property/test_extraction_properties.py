"""However a recording is cut into pieces, the same bits come out."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coslidar.pipeline.extraction import Calibration, SpotLayout, extract
from coslidar.pipeline.parameters import ExtractionParameters, Header
from coslidar.pipeline.spot_layout import layout, reference_image

FRAMES = 50
METHODS = {
    "subpixel_window": ExtractionParameters(),
    "moving_maximum": ExtractionParameters(method="moving_maximum"),
}


@cache
def recording() -> tuple[NDArray[np.uint16], Calibration, Header]:
    """Noisy spots, a blank frame, a saturated one, bad pixels."""
    rng = np.random.default_rng(1)
    head = Header.model_validate(
        {
            "format": "shwfs-frames",
            "format_version": 1,
            "campaign": "c",
            "archive": "a",
            "instrument": {
                "wavelength": "3.8 um",
                "frame_rate": "142 Hz",
                "pixel_scale": "27 urad",
                "subaperture_size": "7 cm",
                "subaperture_mask": [[1, 1]],
                "lenslet_origin": [0, 0],
                "lenslet_pitch": [32, 32],
            },
            "path": {"length": "2670 m"},
            "sources": [
                {"name": "a", "position": ["0 m", "-0.4 m"], "fwhm": ["9 cm", "6 cm"], "spot": [9.95, 15.5]},
                {"name": "b", "position": ["0 m", "0.4 m"], "fwhm": ["9 cm", "6 cm"], "spot": [21.05, 15.5]},
            ],
        }
    )
    rows, cols = np.indices((32, 64))
    frames = np.full((FRAMES, 32, 64), 100.0)
    for t in range(FRAMES):
        for box in range(2):
            for row, col in ((9.95, 15.5), (21.05, 15.5)):
                y, x = np.array([row, col + 32 * box]) + rng.normal(0, 0.5, 2)
                frames[t] += rng.uniform(300, 1500) * np.exp(-((rows - y) ** 2 + (cols - x) ** 2) / 2.4)
    frames[7] = 100.0
    frames[9] *= 30
    bad = rng.random((32, 64)) < 0.01
    calibration = Calibration(dark=np.full((32, 64), 100.0), bad_pixel=bad, saturation=16383.0)
    return rng.poisson(frames).astype(np.uint16), calibration, head


@cache
def whole(method: str) -> tuple[SpotLayout, Any]:
    frames, calibration, head = recording()
    found = layout(head, reference_image(frames), calibration, METHODS[method])
    return found, extract(frames, found, calibration, METHODS[method])


@pytest.mark.parametrize("method", METHODS)
@given(cuts=st.sets(st.integers(1, FRAMES - 1), max_size=8))
def test_pieces_equal_the_whole(method: str, cuts: set[int]) -> None:
    frames, calibration, _ = recording()
    found, expected = whole(method)
    borders = [0, *sorted(cuts), FRAMES]
    parts = [extract(frames[a:b], found, calibration, METHODS[method]) for a, b in pairwise(borders)]
    assert np.isnan(expected[0]).any()
    for number, array in enumerate(expected):
        joined = np.concatenate([part[number] for part in parts])
        # Bit for bit, NaN included.
        assert joined.tobytes() == array.tobytes()


@pytest.mark.parametrize("method", METHODS)
@given(order=st.permutations(range(12)))
def test_frames_do_not_know_of_each_other(method: str, order: list[int]) -> None:
    frames, calibration, _ = recording()
    found, expected = whole(method)
    shuffled = extract(np.ascontiguousarray(frames[order]), found, calibration, METHODS[method])
    for array, reference in zip(shuffled, expected, strict=True):
        assert array.tobytes() == reference[order].tobytes()
