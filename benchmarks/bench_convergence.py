"""Cost and accuracy of the convergence noise.

A Gaussian process of known covariance stands for a recording: plane waves of turbulence of all sizes carried by
the wind over both beams, each losing its phase after a while, and white detection noise. The covariance of its
maps over N frames follows exactly, by the sum over all lags and with the mean of the record removed. Records drawn
from it are given to the estimator. Printed are its time, the mean error of its variances, their scatter from record
to record, and how far it whitens the true covariance: the eigenvalues of estimate^-1 truth, all 1 if perfect, whose
mean is the chi2 per datum of data that have the true covariance.

    python benchmarks/bench_convergence.py [--frames 25560] [--records 8] [--bands 8 16 24 48]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, signal

from coslidar.pipeline import convergence, correlation
from coslidar.pipeline.geometry import MAP_KINDS, Geometry

SCINDAR = Geometry(
    ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0)),
    0.07,
    2670.0,
    3.8e-6,
    ((0.0, -0.4), (0.0, 0.4)),
)


def operators(geometry: Geometry) -> NDArray[np.float64]:
    """Symmetric matrices A_p of the independent rows, (m, C, C), by a loop over pairs of subapertures."""
    sources, subapertures = geometry.n_sources, geometry.n_subapertures
    index = geometry.subaperture_index
    size = 3 * sources * subapertures
    matrices = np.zeros((len(MAP_KINDS), *geometry.map_shape, size, size))
    for number, name in enumerate(MAP_KINDS):
        if name.endswith("cross") and sources == 1:
            continue
        pairs = [(0, 1)] if name.endswith("cross") else [(s, s) for s in range(sources)]
        for first, second in pairs:
            for a in range(subapertures):
                for b in range(subapertures):
                    dy, dx = index[a] - index[b] + (geometry.p - 1, geometry.q - 1)
                    row = ("xyi".index(name[0]) * sources + first) * subapertures + a
                    column = ("xyi".index(name[0]) * sources + second) * subapertures + b
                    weight = 1 / (len(pairs) * geometry.pair_count[dy, dx])
                    matrices[number, dy, dx, row, column] += weight / 2
                    matrices[number, dy, dx, column, row] += weight / 2
    return matrices.reshape(-1, size, size)[geometry.independent]


@dataclass(frozen=True, eq=False)
class Process:
    """Sum of complex first-order autoregressions, x_t = Re sum_m c_m u_m(t), and white noise.

    Attributes
    ----------
    pattern : ndarray, (C, M)
        c_m: what a wave of unit power writes into every channel.
    multiplier : ndarray, (M,)
        Factor of its amplitude from one frame to the next.
    noise : ndarray, (C,)
        Standard deviation of the white noise.
    geometry : Geometry
    """

    pattern: NDArray[np.complex128]
    multiplier: NDArray[np.complex128]
    noise: NDArray[np.float64]
    geometry: Geometry

    @classmethod
    def turbulence(cls, geometry: Geometry, waves: int, rng: np.random.Generator) -> Process:
        """Waves of 10 cm to 300 m with the power of a Kolmogorov spectrum in the slopes."""
        frequency = np.geomspace(0.003, 10, waves)
        angle = rng.uniform(0, 2 * np.pi, waves)
        vector = frequency * np.stack([np.cos(angle), np.sin(angle)])
        shift = rng.uniform(0, 1, waves) ** 2  # magnification of the wave's layer
        place = geometry.subaperture_position[None, :, :] + (
            shift[:, None, None, None] * np.asarray(geometry.positions)[:, None, :]
        )
        phase = np.exp(2j * np.pi * np.einsum("lm,msal->sam", vector, place))
        slope = 1j * frequency ** (1 / 6) / (1 + (frequency / 7) ** 2)
        intensity = (frequency / 5) ** 2 / (1 + (frequency / 5) ** 4)
        pattern = np.stack([np.cos(angle) * slope * phase, np.sin(angle) * slope * phase, intensity * phase])
        pattern = pattern.reshape(-1, waves) / np.sqrt(waves)
        wind, decay, rate = np.array([2.0, 1.0]), 0.3, 142.0
        multiplier = np.exp(2 * np.pi / rate * (1j * (wind @ vector) - decay * frequency))
        noise = 0.1 * np.sqrt(np.mean(np.abs(pattern) ** 2, axis=1) * waves)
        return cls(pattern, multiplier, noise, geometry)

    def draw(self, frames: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Slopes (T, 2, S, A), in units of 1e-5 rad, and fluxes (T, S, A) around 1000 counts."""
        waves, size = self.multiplier.size, self.noise.size
        kicks = rng.standard_normal((frames, waves, 2)).view(np.complex128)[..., 0]
        kicks[1:] *= np.sqrt(1 - np.abs(self.multiplier) ** 2)
        amplitude = np.empty_like(kicks)
        for wave, factor in enumerate(self.multiplier):
            amplitude[:, wave] = signal.lfilter([1.0], [1.0, -factor], kicks[:, wave])
        samples = (amplitude @ self.pattern.T).real
        samples += rng.standard_normal((frames, size)) * self.noise
        shape = (frames, 3, self.geometry.n_sources, self.geometry.n_subapertures)
        samples = samples.reshape(shape) * np.array([1e-5, 1e-5, 0.1])[:, None, None]
        return samples[:, :2], 1000 * (1 + samples[:, 2])

    def covariance(self, frames: int, matrices: NDArray[np.float64]) -> NDArray[np.float64]:
        """Exact covariance of the maps x^T A_p x of so many frames with their mean removed, (m, m)."""
        unit = np.repeat([1e-5, 1e-5, 0.1], self.noise.size // 3)
        matrices = matrices * np.outer(unit, unit)
        rows = len(matrices)
        # x has the covariance Re sum_m c_m g_m(t, t') c_m^H. Two waves m, n of the sums over t and t' meet as they
        # are, with tr(g_m g_n) in time, or one of them conjugated.
        total = np.zeros((rows, rows))
        for other in (self.pattern, self.pattern.conj()):
            meeting = (other.conj().T @ (matrices @ self.pattern)).reshape(rows, -1)
            swapped = (self.pattern.conj().T @ (matrices @ other)).swapaxes(1, 2).reshape(rows, -1)
            turn = other is not self.pattern
            total += ((meeting * self._in_time(frames, turn).T.ravel()) @ swapped.T).real
        result = total / frames**2
        kept = 1 - self._sums(frames).sum(axis=0).real / frames**2
        waves = (self.pattern * kept @ self.pattern.conj().T).real
        noise = np.diag(self.noise**2)
        for weight, matrix in ((1, waves + noise), (-1, waves), (-1 / frames, noise)):
            products = matrices @ matrix
            trace = products.reshape(rows, -1) @ products.swapaxes(1, 2).reshape(rows, -1).T
            result += weight * 2 / frames * trace
        return np.asarray(result)

    def _in_time(self, frames: int, turn: bool) -> NDArray[np.float64]:
        """tr(P g_m P g_n), (M, M): P takes away the mean, g(t, t') = lambda^(t - t'); g_n conjugated if `turn`."""
        first = self.multiplier
        second = first.conj() if turn else first
        z = np.outer(first, second.conj())
        plain = frames + 2 * (z * (frames - 1 - frames * z + z**frames) / (1 - z) ** 2).real
        sums = self._sums(frames)
        conjugated = sums.conj() if turn else sums
        whole = np.outer(sums.sum(axis=0).real, sums.sum(axis=0).real)
        # The mean takes its share from either side of the product.
        return np.asarray(plain - 2 / frames * (sums.conj().T @ conjugated).real + whole / frames**2)

    def _sums(self, frames: int) -> NDArray[np.complex128]:
        """Sum over t' of the correlation in time g(t, t') of each wave, (T, M)."""
        after = np.arange(frames)[:, None]
        here, back = self.multiplier, self.multiplier.conj()
        return np.asarray((1 - here ** (after + 1)) / (1 - here) + (back - back ** (frames - after)) / (1 - back))


def cpu(function: Callable[[], object], repeat: int = 5) -> float:
    """Least CPU time of some runs, s."""
    times = []
    for _ in range(repeat):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def main(argv: list[str] | None = None, geometry: Geometry = SCINDAR) -> dict[str, NDArray[np.float64]]:
    """Print the table; return the relative errors of the mean variance of each map by estimator."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=25560)
    parser.add_argument("--records", type=int, default=8)
    parser.add_argument("--bands", type=int, nargs="+", default=[8, 16, 24, 48])
    parser.add_argument("--waves", type=int, default=160)
    options = parser.parse_args(argv)

    rng = np.random.default_rng(1)
    process = Process.turbulence(geometry, options.waves, rng)
    truth = process.covariance(options.frames, operators(geometry))
    draws = [process.draw(options.frames, rng) for _ in range(options.records)]

    slopes, flux = draws[0]
    sums = correlation.accumulate(slopes, flux)
    reduced = correlation.finalise(sums, geometry)
    unit = cpu(lambda: [np.sum(slopes), np.sum(flux)])
    print(f"{options.frames} frames, {options.records} records; time in ms and in np.sum of the samples")
    for name, function in (
        ("accumulate", lambda: correlation.accumulate(slopes, flux)),
        ("finalise", lambda: correlation.finalise(sums, geometry)),
        ("independent", lambda: convergence.independent(reduced.covariance, options.frames, geometry)),
    ):
        spent = cpu(function)
        print(f"{name:>12s}: {1e3 * spent:7.1f} {spent / unit:6.1f}")

    estimators: dict[str, Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]] = {
        "independent": lambda x, i: convergence.independent(
            correlation.finalise(correlation.accumulate(x, i), geometry).covariance, len(x), geometry
        )
    }
    for bands in options.bands:
        estimators[f"{bands} bands"] = lambda x, i, bands=bands: (
            convergence.lagged(x, i, geometry, bands=bands).covariance
        )
    print(f"relative error of the variances, mean of each of {', '.join(MAP_KINDS)}, and scatter of one record |")
    print("    eigenvalues of estimate^-1 truth: mean, 5 %, 50 %, 95 %")
    kind = geometry.independent // geometry.pair_count.size
    deviation = np.sqrt(np.diagonal(truth))
    product = np.outer(deviation, deviation)
    errors = {}
    for name, estimate in estimators.items():
        found = np.stack([estimate(*draw) for draw in draws])
        ratio = np.diagonal(found, axis1=1, axis2=2) / np.diagonal(truth)
        by_map = np.stack([ratio[:, kind == m].mean(axis=1) for m in range(len(MAP_KINDS))], axis=1)
        white = [linalg.eigh(truth / product, one / product, eigvals_only=True) for one in found]
        spent = cpu(lambda: estimate(*draws[0]))  # noqa: B023
        bias, scatter = by_map.mean(axis=0) - 1, by_map.std(axis=0)
        print(
            f"{name:>12s}: {1e3 * spent:7.1f} {spent / unit:6.1f}  "
            + " ".join(f"{e:+.2f}+-{s:.2f}" for e, s in zip(bias, scatter, strict=True))
            + " | "
            + " ".join(f"{w:.2f}" for w in (np.mean(white), *np.percentile(white, [5, 50, 95])))
        )
        errors[name] = bias
    effective = np.mean([convergence.lagged(*draw, geometry).n_effective for draw in draws], axis=0)
    print("effective frames (x, y, i):", np.round(effective, 1))
    return errors


if __name__ == "__main__":
    main()
