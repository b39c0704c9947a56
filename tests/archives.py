"""Small valid archives for tests: tiny frames with spots that move and flicker, as a recording has them."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coslidar.catalog.archive_writer import write_archive

#: 2012-09-14T12:15:00 UTC, in ns.
START = 1347624900000000000

_HEADER: dict[str, Any] = {
    "format": "shwfs-frames",
    "format_version": 1,
    "campaign": "test-campaign",
    "archive": "small",
    "site": {
        "name": "somewhere",
        "latitude": "43.1285 deg",
        "longitude": "0.3672 deg",
        "timezone": "Europe/Paris",
    },
    "instrument": {
        "name": "small sensor",
        "wavelength": "3.8 um",
        "frame_rate": "100 Hz",
        "exposure": "1 ms",
        "pixel_scale": "27 urad",
        "gain": "12 electron/count",
        "read_noise": "60 electron",
        "saturation": "16383 count",
        "subaperture_size": "7 cm",
        "subaperture_mask": [[1, 1, 1], [1, 0, 1], [1, 1, 1]],
        "lenslet_origin": [0, 0],
        "lenslet_pitch": [16, 10],
    },
    "path": {"length": "2670 m", "height": "23 m"},
    "sources": [
        {"name": "bottom", "position": ["0 m", "-0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": [3.9, 4.5]},
        {"name": "top", "position": ["0 m", "0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": [11.1, 4.5]},
    ],
}


def small_header(**changes: Any) -> dict[str, Any]:
    """A valid header of 3 x 3 lenslets on 48 x 30 pixels; `changes` are paths with ``__`` for the point.

    ``small_header(archive="b", instrument__frame_rate="50 Hz")``; None removes the key.
    """
    header = copy.deepcopy(_HEADER)
    for path, value in changes.items():
        *parents, leaf = path.split("__")
        place = header
        for parent in parents:
            place = place[parent]
        if value is None:
            place.pop(leaf, None)
        else:
            place[leaf] = value
    return header


def small_time(n_frames: int, rate: float = 100.0) -> NDArray[np.int64]:
    """Times of `n_frames` exposures at `rate` (Hz)."""
    return START + np.rint(np.arange(n_frames) * (1e9 / rate)).astype(np.int64)


def small_frames(header: dict[str, Any], n_frames: int, *, dtype: str = "uint16", seed: int = 0) -> NDArray[Any]:
    """Frames with one Gaussian spot per source and exploited lenslet, whose place and flux vary at random."""
    rng = np.random.default_rng(seed)
    instrument = header["instrument"]
    mask = np.asarray(instrument["subaperture_mask"])
    origin, pitch = np.asarray(instrument["lenslet_origin"]), np.asarray(instrument["lenslet_pitch"])
    peak, background = (150.0, 40.0) if dtype == "uint8" else (1500.0, 100.0)
    shape = tuple(int(n) for n in origin + pitch * mask.shape)
    frames = background + rng.normal(0, 5, (n_frames, *shape))
    for source in header["sources"]:
        for i, j in np.argwhere(mask):
            row, col = origin + (i, j) * pitch
            centre = np.asarray(source["spot"]) + rng.normal(0, 0.2, (n_frames, 2))
            flux = peak * np.exp(rng.normal(0, 0.1, n_frames))
            y = np.exp(-((np.arange(pitch[0]) - centre[:, :1]) ** 2) / 2)
            x = np.exp(-((np.arange(pitch[1]) - centre[:, 1:]) ** 2) / 2)
            frames[:, row : row + pitch[0], col : col + pitch[1]] += flux[:, None, None] * y[:, :, None] * x[:, None, :]
    return (
        frames.astype(dtype)
        if dtype == "float32"
        else np.clip(np.rint(frames), 0, 255 if dtype == "uint8" else 16383).astype(dtype)
    )


def write_small(
    path: Path,
    *,
    n_frames: int = 40,
    chunk_frames: int = 16,
    dtype: str = "uint16",
    seed: int = 0,
    calibrated: bool = True,
    header: dict[str, Any] | None = None,
    **options: Any,
) -> Path:
    """Write a small archive (folder, or zip where the name ends in ``.zip``) and return its path.

    `calibrated`: with dark, flat and bad pixels. Other options go to ``write_archive``.
    """
    header = small_header() if header is None else header
    frames = small_frames(header, n_frames, dtype=dtype, seed=seed)
    shape = frames.shape[1:]
    if calibrated:
        bad = np.zeros(shape, bool)
        bad[0, 0] = True
        background = 40 if dtype == "uint8" else 100
        options = {
            "dark": np.full(shape, background, "f4"),
            "flat": np.ones(shape, "f4"),
            "bad_pixel": bad,
            **options,
        }
    return write_archive(path, header, small_time(n_frames), frames, chunk_frames=chunk_frames, **options)
