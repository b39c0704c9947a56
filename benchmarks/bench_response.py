"""Time against error of the response matrix, beside a plain FFT grid of the same cost.

Run: OMP_NUM_THREADS=1 python benchmarks/bench_response.py
CPU seconds for 12 slices (slice means) of the 5 x 5 instrument, and the largest error of each kind of map over its
maximum in the first, the sixth and the last slice, against a run with a tolerance of 1e-8.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time

import numpy as np

import coslidar.pipeline.response as response
from coslidar.pipeline.geometry import MAP_KINDS, Geometry, SliceGrid
from coslidar.plugins.source_models import Gaussian
from coslidar.plugins.turbulence_spectra import Kolmogorov

MASK = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))
SCINDAR = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
GRID = SliceGrid.uniform(2670.0, 12)
LAMPS = (Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm"),) * 2
SHOWN = {"first": 0, "sixth": 5, "last": 11}


def quadrature(tolerance: float) -> np.ndarray:
    """The matrix of the pipeline, with another tolerance."""
    usual = response.TOLERANCE
    response.TOLERANCE = tolerance
    try:
        return response.response_matrix(SCINDAR, GRID, Kolmogorov(), LAMPS)
    finally:
        response.TOLERANCE = usual


def fft_grid(size: int, layers: int) -> np.ndarray:
    """The same integrals by inverse FFTs of `size` x `size` frequencies, pixels of d / 4, f = 0 left out."""
    d, step = SCINDAR.subaperture_size, 4
    f = np.fft.fftfreq(size, d / step)
    fx, fy = np.meshgrid(f, f)
    f2 = fx**2 + fy**2
    k = 2 * np.pi / SCINDAR.wavelength
    aperture = np.sinc(fx * d) * np.sinc(fy * d)
    spectrum = Kolmogorov().psd(np.sqrt(np.where(f2 == 0, 1.0, f2)))
    spectrum[0, 0] = 0.0
    lags = step * np.arange(-4, 5)
    nodes, rule = np.polynomial.legendre.leggauss(layers)
    columns = []
    for z0, z1 in zip(GRID.edges[:-1], GRID.edges[1:], strict=True):
        maps = np.zeros((6, 9, 9))
        for node, weight in zip(nodes, rule, strict=True):
            z = (z0 + z1) / 2 + (z1 - z0) / 2 * node
            m, stretch = SCINDAR.magnification(z), SCINDAR.scaling(z)
            x = np.pi * SCINDAR.wavelength * z * stretch * f2
            seen = aperture * LAMPS[0].transfer(m * fx, m * fy)
            moments = (np.imag(moment) for moment in LAMPS[0].moment(m * fx, m * fy))
            signals = [
                2 * np.pi * axis * np.cos(x) * seen + 2 * k / SCINDAR.path_length * np.sin(x) * aperture * moment
                for axis, moment in zip((fx, fy), moments, strict=True)
            ]
            signals.append(2 * k * np.sin(x) * seen)
            shift = np.exp(-2j * np.pi * m * SCINDAR.separation[1] * fy)
            for number, signal in enumerate(signals):
                density = stretch ** (2 - 11 / 3) * spectrum * signal**2
                for place, turn in (((0, 1, 4)[number], 1.0), ((2, 3, 5)[number], shift)):
                    covariance = np.fft.ifft2(density * turn).real * (step / d) ** 2
                    maps[place] += weight * (z1 - z0) / 2 * covariance[np.ix_(lags, lags)]
        columns.append(maps.ravel())
    return np.stack(columns, axis=1)


def main() -> None:
    """Print the table."""
    quadrature(1e-3)  # caches of numpy, not of the response
    exact = quadrature(1e-8)
    size = np.abs(exact.reshape(6, 81, 12)).max(axis=1)
    print(f"{'method':34s} {'CPU s':>7s}  slice  " + "  ".join(f"{kind:>8s}" for kind in MAP_KINDS))
    runs = [(f"quadrature, tolerance {t:.0e}", quadrature, (t,)) for t in (1e-4, 1e-5, response.TOLERANCE, 1e-7)]
    runs += [
        (f"FFT {n} x {n}, {layers} layers a slice", fft_grid, (n, layers))
        for n, layers in ((256, 1), (256, 4), (512, 2))
    ]
    for name, method, arguments in runs:
        start = time.process_time()
        found = method(*arguments)
        spent = time.process_time() - start
        error = np.abs(found - exact).reshape(6, 81, 12).max(axis=1) / size
        for row, (place, number) in enumerate(SHOWN.items()):
            head = f"{name:34s} {spent:7.2f}" if row == 0 else " " * 42
            print(f"{head}  {place:5s}  " + "  ".join(f"{value:8.1e}" for value in error[:, number]))


if __name__ == "__main__":
    main()
