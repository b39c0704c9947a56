"""Bias, gain and noise of each way to measure spots, and how well data and model then agree.

Three tables, as they stand in docs/extraction.md:

1. Drawn spots: the image of a Gaussian source by a square lenslet, moved by known amounts; photon and read noise.
2. Structured spots of weak turbulence with known centroids (`wave_frames`), with and without noise: response to the
   true centroid and flux, what remains, and chi2 per datum of the whole chain; the first line is the truth itself.
3. With ``--sample``, a wave-optics recording: chi2 per datum of the whole chain.

    python benchmarks/bench_methods.py [--frames 200] [--keep FILE.npz] [--sample ARCHIVE]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from bench_extraction import MASK, SPOTS, header
from numpy.typing import NDArray
from wave_frames import Truth, draw

from coslidar.catalog import open_archive
from coslidar.pipeline import batch, measurement
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.parameters import CorrelationParameters, ExtractionParameters, InversionParameters
from coslidar.pipeline.products import Measurements
from coslidar.pipeline.response import response_matrix
from coslidar.pipeline.spots import Calibration
from coslidar.plugins.hyperparameter_selectors import GCV
from coslidar.plugins.regularisers import White
from coslidar.plugins.source_models import Gaussian
from coslidar.plugins.turbulence_spectra import Kolmogorov

Array = NDArray[Any]

METHODS = {
    "subpixel_window": ExtractionParameters(),
    "the same, wings kept": ExtractionParameters(wings="kept"),
    "the same, 9 x 9 px": ExtractionParameters(wings="kept", window_x="9 pixel", window_y="9 pixel"),
    "moving_maximum": ExtractionParameters(method="moving_maximum"),
    "thresholded, 10 %": ExtractionParameters(method="thresholded"),
    "thresholded, 2 %": ExtractionParameters(method="thresholded", threshold=0.02),
    "weighted": ExtractionParameters(method="weighted"),
    "template": ExtractionParameters(method="template"),
}
GAIN, READ, BACKGROUND, LIGHT = 12.0, 60.0, 150.0, (10_000.0, 8_500.0)
#: A tenth of the profile of a strongly turbulent afternoon, m^(-2/3).
CN2 = 1e-15 * np.array([3.4, 3.4, 3.4, 3.4, 3.4, 0.17, 0.17, 10.2, 10.2, 0.34, 20.4, 20.4])
HEADER = header(gain="12 electron/count")


def exposed(light: Array, noise: bool, seed: int) -> tuple[Array, Calibration]:
    """Frames and calibration: photon and read noise in each pixel, or none."""
    if not noise:
        return light.astype(np.float32), Calibration(dark=np.zeros(light.shape[1:]))
    rng = np.random.default_rng(seed)
    frames = np.empty(light.shape, dtype=np.uint16)
    for frame, mean in zip(frames, light, strict=True):
        electrons = rng.poisson((mean + BACKGROUND) * GAIN) + READ * rng.standard_normal(mean.shape)
        frame[:] = np.clip(np.round(electrons / GAIN + 500), 0, 16383)
    return frames, Calibration(dark=np.full(light.shape[1:], 500 + BACKGROUND))


def drawn(n_frames: int, seed: int) -> tuple[Array, Array, Array]:
    """Light (T, row, col) of spots of fixed shape, their motion (T, 2, S, A) in px, and their flux (T, S, A)."""
    rng = np.random.default_rng(seed)
    corners = np.argwhere(np.array(MASK)) * 32
    move = 0.4 * rng.standard_normal((n_frames, 2, 2, len(corners)))
    flux = np.array(LIGHT)[:, None] * np.exp(0.2 * rng.standard_normal((n_frames, 2, len(corners))))
    # Image of a line: lenslet, source and pixel, on a fine grid.
    fine = np.arange(-40, 40, 1 / 16)
    image = np.sinc(fine * 27e-6 * 0.07 / 3.8e-6) ** 2
    lines = []
    for width in (0.089, 0.063):
        sigma = width / np.sqrt(8 * np.log(2)) / 2670 / 27e-6
        blurred = np.convolve(image, np.exp(-0.5 * (fine / sigma) ** 2), mode="same")
        pixel = np.convolve(blurred, np.ones(16), mode="same")
        lines.append(pixel / pixel.sum() * 16)
    light = np.zeros((n_frames, 160, 160))
    at = np.arange(32)
    for t, s, a in np.ndindex(*flux.shape):
        r, c = corners[a]
        y, x = (np.interp(at - SPOTS[s][1 - axis] - move[t, axis, s, a], fine, lines[axis]) for axis in (1, 0))
        light[t, r : r + 32, c : c + 32] += flux[t, s, a] * np.outer(y, x)
    return light, move, flux


def line(name: str, *numbers: float) -> None:
    print(f"| {name} | " + " | ".join(f"{number:.4f}" for number in numbers) + " |", flush=True)


def response(found: Array, truth: Array) -> tuple[float, float]:
    """Slope of the regression on the truth, time means removed, and rms of what remains."""
    a, b = truth - truth.mean(axis=0), found - np.nanmean(found, axis=0)
    seen = np.isfinite(b)
    slope = float((a * b)[seen].sum() / (a[seen] ** 2).sum())
    return slope, float((b - slope * a)[seen].std())


def table_of_drawn_spots(n_frames: int) -> None:
    """First table."""
    light, move, flux = drawn(n_frames, 1)
    print("\n| method | gain x | gain y | bias px | noise x px | noise y px | predicted x | predicted y | flux noise |")
    print("|" + "---|" * 9)
    time = np.arange(n_frames) * 7_042_254
    scale = HEADER.instrument.pixel_scale
    for name, parameters in METHODS.items():
        results = []
        for noise in (False, True):
            frames, calibration = exposed(light, noise, 2)
            results.append(measurement.measure([frames], time, HEADER, calibration, parameters))
        clean, noisy = results
        gain = [response(clean.slopes[:, axis] / scale, move[:, axis])[0] for axis in (0, 1)]
        bias = max(response(clean.slopes[:, axis] / scale, move[:, axis])[1] for axis in (0, 1))
        scatter = [np.nanstd((noisy.slopes - clean.slopes)[:, axis]) / scale for axis in (0, 1)]
        predicted = [np.sqrt(np.nanmean(noisy.slope_noise[axis])) / scale for axis in (0, 1)]
        _, rest = response(noisy.flux / np.nanmean(noisy.flux, axis=0), flux / flux.mean(axis=0))
        line(name, *gain, bias, *scatter, *predicted, rest)


def chi2(found: Measurements, matrix: Array, covariance: str) -> float:
    """Misfit per datum of the whole chain."""
    geometry = HEADER.geometry()
    grid = SliceGrid.uniform(geometry.path_length, len(CN2))
    reduced = batch.reduce(
        found,
        geometry,
        142.0,
        len(found.time) / 142.0,
        CorrelationParameters.model_validate({"covariance": covariance}),
    )
    model = batch.Model(geometry, grid, matrix, "midpoint", White(), GCV(), InversionParameters())
    return float(batch.retrieve(reduced, model).values["chi2_reduced"])


def table_of_structured_spots(boxes: Array, truth: Truth, matrix: Array) -> None:
    """Second table."""
    corners = np.argwhere(np.array(MASK)) * 32
    light = np.zeros((len(boxes), 160, 160), dtype=np.float32)
    for a, (r, c) in enumerate(corners):
        light[:, r : r + 32, c : c + 32] = LIGHT[0] * boxes[:, 0, a] + LIGHT[1] * boxes[:, 1, a]
    time = np.arange(len(boxes)) * 7_042_254
    shape = truth.flux.shape
    exact = Measurements(
        time, truth.slopes, truth.flux, np.zeros(shape, np.uint8), np.zeros(shape[1:]), np.zeros((2, *shape[1:])),
        np.ones((2, 2)),
    )  # fmt: skip
    print("\n| method | gain x | gain y | gain flux | rest x px | rest y px | rest flux | chi2 | chi2 with noise |")
    print("|" + "---|" * 9)
    line("true centroids and fluxes", 1, 1, 1, 0, 0, 0, chi2(exact, matrix, "independent"), np.nan)
    scale = HEADER.instrument.pixel_scale
    for name, parameters in METHODS.items():
        results = []
        for noise in (False, True):
            frames, calibration = exposed(light, noise, 3)
            results.append(measurement.measure([frames], time, HEADER, calibration, parameters))
        clean = results[0]
        pairs = [response(clean.slopes[:, axis] / scale, truth.slopes[:, axis] / scale) for axis in (0, 1)]
        pairs.append(response(clean.flux / np.nanmean(clean.flux, axis=0), truth.flux / truth.flux.mean(axis=0)))
        misfits = [chi2(found, matrix, "independent") for found in results]
        line(name, *(pair[0] for pair in pairs), *(pair[1] for pair in pairs), *misfits)


def table_of_recording(path: str, matrix: Array) -> None:
    """Third table."""
    archive = open_archive(path)
    calibration = Calibration(archive.dark, archive.flat, archive.bad_pixel, archive.header.instrument.saturation)
    print("\n| method | chi2 | part measured |\n|---|---|---|")
    for name, parameters in METHODS.items():
        blocks = (block for _, block in archive.chunks(0, archive.n_frames))
        found = measurement.measure(blocks, archive.time, archive.header, calibration, parameters)
        line(name, chi2(found, matrix, "lagged"), float(np.isfinite(found.flux).mean()))


def test_the_default_answers_with_gain_one() -> None:
    """A few drawn frames, without noise."""
    light, move, flux = drawn(64, 1)
    frames, calibration = exposed(light, False, 2)
    found = measurement.measure([frames], np.arange(64), HEADER, calibration, METHODS["subpixel_window"])
    scale = HEADER.instrument.pixel_scale
    for axis in (0, 1):
        assert abs(response(found.slopes[:, axis] / scale, move[:, axis])[0] - 1) < 0.01
    assert abs(response(found.flux, flux)[0] - 0.95) < 0.03


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--drawn", type=int, default=400)
    parser.add_argument("--keep", type=Path, help="file that keeps the structured spots from one run to the next")
    parser.add_argument("--sample", help="wave-optics recording of the 5 x 5 instrument")
    arguments = parser.parse_args()
    table_of_drawn_spots(arguments.drawn)
    geometry = HEADER.geometry()
    grid = SliceGrid.uniform(geometry.path_length, len(CN2))
    source = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")  # type: ignore[arg-type]
    matrix = response_matrix(geometry, grid, Kolmogorov(), [source, source], sampling="midpoint")
    if arguments.keep and arguments.keep.is_file():
        kept = np.load(arguments.keep)
        boxes, truth = kept["boxes"], Truth(kept["slopes"], kept["flux"])
    else:
        boxes, truth = draw(HEADER, CN2, arguments.frames, 7)
        if arguments.keep:
            np.savez(arguments.keep, boxes=boxes, slopes=truth.slopes, flux=truth.flux)
    table_of_structured_spots(boxes, truth, matrix)
    if arguments.sample:
        table_of_recording(arguments.sample, matrix)


if __name__ == "__main__":
    main()
