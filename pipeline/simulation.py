"""Slopes and fluxes of a turbulent path whose profile is known, by first-order theory in spherical waves.

The turbulence is a sum of random plane waves (Fourier modes), not a phase screen: each slice is given modes
whose spatial frequencies are drawn at random where the instrument is sensitive, with weights that undo the
choice, so there is no grid, no period, and no lowest frequency. Everything the instrument measures is linear
in the mode amplitudes at first order, hence one matrix product gives the slopes and fluxes of all
subapertures and sources for a block of frames.

A mode of frequency f in the pupil, on the slice at z, has the optical path c exp(2 pi i f.r). A point of the
source at S sees it moved by m S with m = z / (L - z). With H the average of exp(2 pi i m f.s) over the
source, T_l that of s_l exp(2 pi i m f.s), X = pi lambda z L / (L - z) f^2 and k = 2 pi / lambda, a
subaperture at r measures the real part of

    slope_l: W c [-2 pi i f_l cos(X) H + (2 k / L) sin(X) T_l]
    flux:    W c 2 k sin(X) H
    with     W = exp(2 pi i f.(r + m S)) sinc(pi f_x d) sinc(pi f_y d)

whose covariances are the response functions of Sauvage et al. 2021, Eqs. (7)-(13), with the displacement of
the centre of gravity by the scintillation of the single points of the source (the second term of the slope)
added.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numba
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from .geometry import Geometry, SliceGrid
    from .protocols import SourceModel, TurbulenceSpectrum

    Floats = NDArray[np.float64]

#: Frames of one matrix product. Part of the result: a block is always computed whole, so that asking for
#: frames in other portions gives the same bits.
BLOCK_FRAMES = 64

# 1/m; below it the slope spectrum is a pure power law and is drawn as such, down to zero.
_LOWEST_FREQUENCY = 1e-3
_HIGHEST_FREQUENCY = 30.0  # in units of 1/d; the subaperture leaves less than 1e-4 of any variance above
_BINS = 64
_ANGLES = 12
_LAYERS_PER_SLICE = 8
# Generalised golden ratio of two dimensions (the root of g^3 = g + 1): n / g and n / g^2, modulo one, fill a
# square evenly for any number of points.
_GOLDEN = 1.3247179572447460


@dataclass(frozen=True)
class Strength:
    """Turbulence along the path as a function of time.

    Parameters
    ----------
    cn2 : ndarray, shape (k,)
        Profile where the factor is 1, in m^(-2/3).
    time : ndarray, shape (n,)
        Increasing times in s, counted as the frames are, from the start of the recording.
    factor : ndarray, shape (n,) or (n, k)
        Factors at these times, larger than zero; between them the logarithm is interpolated linearly, beyond
        them the nearest one holds.
    """

    cn2: Floats
    time: Floats
    factor: Floats

    @classmethod
    def constant(cls, cn2: Sequence[float] | Floats) -> Strength:
        """Turbulence that does not change.

        Parameters
        ----------
        cn2 : sequence of float
            Profile, (k,), in m^(-2/3).

        Returns
        -------
        Strength
            The profile at any time.
        """
        return cls(np.asarray(cn2, dtype=np.float64), np.zeros(1), np.ones(1))

    def at(self, time: float) -> Floats:
        """Profile at one time.

        Parameters
        ----------
        time : float
            Time in s.

        Returns
        -------
        ndarray, shape (k,)
            Cn2 in m^(-2/3).
        """
        logarithm = np.log(self.factor)
        if logarithm.ndim == 1:
            return np.asarray(self.cn2 * np.exp(np.interp(time, self.time, logarithm)))
        factors = [np.interp(time, self.time, column) for column in logarithm.T]
        return np.asarray(self.cn2 * np.exp(factors))


@dataclass(frozen=True)
class _Modes:
    """Modes of one epoch: what they do to the measurements, their amplitudes, how fast their phases turn."""

    matrix: NDArray[np.float32]  # (channels, 2 modes): conjugated complex responses seen as pairs of floats
    turns: NDArray[np.complex64]  # (BLOCK_FRAMES, modes): motion within a block
    amplitude: NDArray[np.complex128]  # (modes,)
    rate: Floats  # (modes,): turns per second
    flux_variance: NDArray[np.float64]  # (S, A): of delta i, given the frequencies


class TurbulentField:
    """Slopes and relative fluxes of every subaperture and source, frame by frame.

    Each slice moves with its own wind (frozen flow). After its `lifetime` a set of modes is replaced by an
    independent one, the two being blended with weights cos and sin so that all variances stay what they are:
    a long recording thus converges to the theory, and is not limited by the number of modes.

    Parameters
    ----------
    geometry : Geometry
        Pupil, path and sources.
    grid : SliceGrid
        Slices along the path.
    strength : Strength
        Cn2 of the slices, in m^(-2/3), as a function of time.
    wind : array_like, shape (k, 2) or (2,)
        Velocity (x, y) of the air in each slice, in m/s. The pupil sees it enlarged by L / (L - z).
    spectrum : TurbulenceSpectrum
        Power spectral density of the refractive index.
    sources : sequence of SourceModel
        One per source; angles instead of lengths for an infinite path.
    frame_rate : float
        Frames per second.
    seed : int
        Everything random follows from it.
    modes : int
        Modes per slice and epoch, at least 16.
    lifetime : float
        Seconds for which the turbulence is frozen; infinity for one set of modes for ever. In each second at
        least as many modes should be new as there are temporal frequencies to tell apart, some hundred per
        slice: fewer repeat themselves, and correlations scatter more than their covariance says (reduced chi2
        of noise-free maps of 60 s: 1.05 with 512 modes a second, 1.2 with 256, 3 in 12 s with 51). Their number goes
        with wind over the Fresnel scale: 1.55 um, 1.5 km and 3 m/s take 2,048 (1.25 in 20 s with 512, 0.96 then).
    sampling : {"mean", "midpoint"}
        Turbulence all through each slice, or in one thin layer in its middle.
    slope_response : {"centroid", "printed"}
        Whether the scintillation of the single points of a source moves its centre of gravity (it does), or
        not, as in the printed equations.
    statistics : {"linear", "lognormal"}
        Relative flux 1 + delta i, whose covariances are those of the theory at any strength but which would
        go below zero in one of ten thousand samples at a scintillation index of 0.07 (the frames then show
        no light); or the log-normal variable of the same mean and variance, always positive, whose
        covariance between subapertures of correlation rho comes out too small by (1 - rho) / 2 times the
        scintillation index (relative).

    Raises
    ------
    ValueError
        Shapes that do not fit, or too few modes.

    Notes
    -----
    Calls are thread-safe. Frames are instantaneous: motion during the exposure is not averaged.
    """

    def __init__(
        self,
        geometry: Geometry,
        grid: SliceGrid,
        strength: Strength,
        wind: Floats | Sequence[Sequence[float]] | Sequence[float],
        spectrum: TurbulenceSpectrum,
        sources: Sequence[SourceModel],
        *,
        frame_rate: float,
        seed: int,
        modes: int = 512,
        lifetime: float = 1.0,
        sampling: Literal["mean", "midpoint"] = "mean",
        slope_response: Literal["centroid", "printed"] = "centroid",
        statistics: Literal["linear", "lognormal"] = "linear",
    ) -> None:
        velocity = np.asarray(wind, dtype=np.float64)
        if velocity.ndim == 1:
            velocity = np.broadcast_to(velocity, (grid.k, 2))
        if velocity.shape != (grid.k, 2):
            raise ValueError(f"wind has the shape {velocity.shape}; give one (x, y) to each of {grid.k} slices")
        if strength.cn2.shape != (grid.k,):
            raise ValueError(f"the profile has {strength.cn2.size} values, but there are {grid.k} slices")
        if len(sources) != geometry.n_sources:
            raise ValueError(f"{len(sources)} source models for {geometry.n_sources} sources")
        if modes < 16:
            raise ValueError(f"{modes} modes per slice are too few; take 16 or more")
        self.geometry = geometry
        self.grid = grid
        self.strength = strength
        self.frame_rate = float(frame_rate)
        self.epoch_frames = (
            0 if np.isinf(lifetime) else BLOCK_FRAMES * max(1, round(lifetime * self.frame_rate / BLOCK_FRAMES))
        )
        self._wind = velocity
        self._spectrum = spectrum
        self._sources = tuple(sources)
        self._seed = int(seed)
        self._centroid = slope_response == "centroid"
        self._lognormal = statistics == "lognormal"
        self._channels = (3, geometry.n_sources, geometry.n_subapertures)
        self._layers(modes, sampling)
        self._cache: OrderedDict[int, _Modes] = OrderedDict()
        self._lock = threading.Lock()

    def signals(self, start: int, stop: int) -> tuple[Floats, Floats]:
        """Noise-free measurements of the frames start, start + 1, ..., stop - 1.

        Parameters
        ----------
        start, stop : int
            Frame numbers, not negative. The result for a frame does not depend on the others asked for.

        Returns
        -------
        slopes : ndarray, shape (T, 2, S, A)
            Motion of the centre of gravity along x and y, in rad.
        flux : ndarray, shape (T, S, A)
            Flux over its mean.
        """
        first, last = start // BLOCK_FRAMES, -(-stop // BLOCK_FRAMES)
        blocks = [self._block(number) for number in range(first, last)]
        values = (np.concatenate(blocks) if blocks else np.empty((0, *self._channels)))[
            start - first * BLOCK_FRAMES : stop - first * BLOCK_FRAMES
        ]
        return values[:, :2], values[:, 2]

    def _layers(self, modes: int, sampling: str) -> None:
        """Cut the slices into layers and find, for each, where in log f its modes should be drawn."""
        active = np.flatnonzero(self.strength.cn2 > 0.0)
        per_slice = 1 if sampling == "midpoint" else min(_LAYERS_PER_SLICE, modes // 8)
        edges = np.asarray(self.grid.edges)
        cuts = edges[active, None] + np.diff(edges)[active, None] * np.linspace(0.0, 1.0, per_slice + 1)
        centre = ((cuts[:, 1:] + cuts[:, :-1]) / 2).ravel()
        self._slice = np.repeat(active, per_slice)
        self._thickness = np.diff(cuts, axis=1).ravel()
        self._bottom = centre if sampling == "midpoint" else cuts[:, :-1].ravel()
        self._depth = np.zeros_like(centre) if sampling == "midpoint" else self._thickness
        self._per_layer = modes // per_slice

        self._log_edges = np.linspace(
            np.log(_LOWEST_FREQUENCY), np.log(_HIGHEST_FREQUENCY / self.geometry.subaperture_size), _BINS + 1
        )
        frequency = np.exp((self._log_edges[1:] + self._log_edges[:-1]) / 2)
        angle = (np.arange(_ANGLES) + 0.5) * np.pi / _ANGLES
        fx = np.multiply.outer(frequency, np.cos(angle)).ravel()
        fy = np.multiply.outer(frequency, np.sin(angle)).ravel()
        width = self._log_edges[1] - self._log_edges[0]
        self._cumulative = np.empty((centre.size, _BINS + 2))
        for layer, z in enumerate(centre):
            distance = np.full(fx.size, z)
            power = np.zeros((3, _BINS))
            for source in range(len(self._sources)):
                amplitudes = self._amplitudes(fx, fy, distance, source)
                power += (np.abs(amplitudes) ** 2).reshape(3, _BINS, _ANGLES).sum(axis=-1)
            power *= self._density(frequency, np.full(_BINS, z)) * frequency**2
            slope, flux = power[0] + power[1], power[2]
            # Below the lowest bin the slope variance per unit of log f goes as f^(1/3), whose integral is 3
            # times its last value; the even share keeps every weight bounded whatever the spectrum is.
            share = np.concatenate(([3.0 * slope[0] / width], slope)) / (3.0 * slope[0] / width + slope.sum())
            share = 0.5 * share + 0.1 / (_BINS + 1)
            if flux.sum() > 0.0:
                share[1:] += 0.4 * flux / flux.sum()
            self._cumulative[layer] = np.concatenate(([0.0], np.cumsum(share / share.sum())))

    def _scaling(self, z: Floats) -> Floats:
        """L / (L - z)."""
        length = self.geometry.path_length
        return np.ones_like(z) if self.geometry.infinite else length / (length - z)

    def _magnification(self, z: Floats) -> Floats:
        """Displacement of the pattern in the pupil per displacement (or angle) of the source."""
        return z if self.geometry.infinite else z / (self.geometry.path_length - z)

    def _density(self, frequency: Floats, z: Floats) -> Floats:
        """Spectrum of the optical path per m of path and unit Cn2, seen in the pupil."""
        scaling = self._scaling(z)
        return np.asarray(scaling**2 * self._spectrum.psd(scaling * frequency))

    def _amplitudes(self, fx: Floats, fy: Floats, z: Floats, source: int) -> NDArray[np.complex128]:
        """Response (x slope, y slope, flux) of a subaperture at the origin to unit modes, (3, n)."""
        geometry, model = self.geometry, self._sources[source]
        magnification = self._magnification(z)
        wavenumber = 2.0 * np.pi / geometry.wavelength
        phase = np.pi * geometry.wavelength * z * self._scaling(z) * (fx**2 + fy**2)
        pupil = np.sinc(fx * geometry.subaperture_size) * np.sinc(fy * geometry.subaperture_size)
        average = np.conj(model.transfer(magnification * fx, magnification * fy))
        result = np.empty((3, fx.size), dtype=np.complex128)
        result[0] = -2j * np.pi * fx * np.cos(phase) * average
        result[1] = -2j * np.pi * fy * np.cos(phase) * average
        result[2] = 2.0 * wavenumber * np.sin(phase) * average
        if self._centroid:
            # Positions of an infinitely distant source are angles already.
            lever = 1.0 if geometry.infinite else 1.0 / geometry.path_length
            for axis, moment in enumerate(model.moment(magnification * fx, magnification * fy)):
                result[axis] += 2.0 * wavenumber * lever * np.sin(phase) * np.conj(moment)
        return np.asarray(result * pupil)

    def _modes(self, epoch: int) -> _Modes:
        with self._lock:
            if epoch in self._cache:
                self._cache.move_to_end(epoch)
                return self._cache[epoch]
        modes = self._draw(epoch)
        with self._lock:
            self._cache[epoch] = modes
            while len(self._cache) > 4:
                self._cache.popitem(last=False)
        return modes

    def _draw(self, epoch: int) -> _Modes:
        random = np.random.default_rng([self._seed, 1, epoch])
        layers, count = self._slice.size, self._per_layer
        step = np.arange(count)
        # Each variable alone is uniform, so sums over modes are unbiased; together they fill space evenly.
        chance = (step + random.random((layers, count))) / count
        turn = (step / _GOLDEN + random.random((layers, 1))) % 1.0
        depth = (step / _GOLDEN**2 + random.random((layers, 1))) % 1.0

        width = self._log_edges[1] - self._log_edges[0]
        frequency = np.empty((layers, count))
        density = np.empty((layers, count))  # of the draw, per unit of log f
        for layer, cumulative in enumerate(self._cumulative):
            place = np.clip(np.searchsorted(cumulative, chance[layer], side="right") - 1, 0, _BINS)
            share = cumulative[place + 1] - cumulative[place]
            within = (chance[layer] - cumulative[place]) / share
            low = place == 0
            frequency[layer] = np.where(
                low,
                _LOWEST_FREQUENCY * np.maximum(within, 1e-12) ** 3,
                np.exp(self._log_edges[np.maximum(place, 1) - 1] + within * width),
            )
            density[layer] = np.where(low, share * np.cbrt(frequency[layer] / _LOWEST_FREQUENCY) / 3.0, share / width)
        z = (self._bottom[:, None] + depth * self._depth[:, None]).ravel()
        f, angle = frequency.ravel(), np.pi * turn.ravel()
        fx, fy = f * np.cos(angle), f * np.sin(angle)
        index = np.repeat(self._slice, count)
        # Half a turn of directions is all: the real part makes f and -f the same mode. It also makes the
        # variance of a signal half of E |c|^2, so that c has this variance in its real and in its imaginary
        # part.
        variance = (
            self._density(f, z) * 2.0 * np.pi * f**2 / density.ravel()
            * np.repeat(self._thickness, count) / count
        )  # fmt: skip
        variance *= self.strength.at(epoch * self.epoch_frames / self.frame_rate)[index]
        amplitude = np.sqrt(variance) * (random.standard_normal(z.size) + 1j * random.standard_normal(z.size))

        geometry = self.geometry
        position = np.asarray(geometry.subaperture_position)
        magnification = self._magnification(z)
        response = np.empty((*self._channels, z.size), dtype=np.complex64)
        for source, place_of_source in enumerate(geometry.positions):
            seen_x = position[:, 0, None] + magnification * place_of_source[0]
            seen_y = position[:, 1, None] + magnification * place_of_source[1]
            turns = fx * seen_x + fy * seen_y
            wave = np.exp(2j * np.pi * (turns - np.rint(turns)))
            for kind, factor in enumerate(self._amplitudes(fx, fy, z, source)):
                response[kind, source] = factor * wave
        velocity = self._wind[index] * self._scaling(z)[:, None]
        rate = -(fx * velocity[:, 0] + fy * velocity[:, 1])
        turns = np.multiply.outer(np.arange(BLOCK_FRAMES) / self.frame_rate, rate)
        flux_variance = (np.abs(response[2]) ** 2 * variance).sum(axis=-1)
        return _Modes(
            matrix=np.conj(response).reshape(math.prod(self._channels), z.size).view(np.float32),
            turns=np.exp(2j * np.pi * (turns - np.rint(turns))).astype(np.complex64),
            amplitude=amplitude,
            rate=rate,
            flux_variance=flux_variance,
        )

    def _linear(self, number: int, epoch: int) -> tuple[Floats, Floats]:
        """First-order signals (x slope, y slope, delta i) of one block from the modes of one epoch."""
        modes = self._modes(epoch)
        turns = modes.rate * (number * BLOCK_FRAMES / self.frame_rate)
        now = modes.amplitude * np.exp(2j * np.pi * (turns - np.rint(turns)))
        waves = modes.turns * now.astype(np.complex64)
        values = np.zeros((BLOCK_FRAMES, len(modes.matrix)))
        _add_product(waves.view(np.float32), modes.matrix, values)
        return values.reshape(BLOCK_FRAMES, *self._channels), modes.flux_variance

    def _block(self, number: int) -> Floats:
        if self.epoch_frames == 0:
            values, variance = self._linear(number, 0)
        else:
            epoch, frame = divmod(number * BLOCK_FRAMES, self.epoch_frames)
            angle = (np.pi / 2 * (frame + np.arange(BLOCK_FRAMES)) / self.epoch_frames)[:, None, None, None]
            old, old_variance = self._linear(number, epoch)
            new, new_variance = self._linear(number, epoch + 1)
            values = np.cos(angle) * old + np.sin(angle) * new
            variance = np.cos(angle[:, 0]) ** 2 * old_variance + np.sin(angle[:, 0]) ** 2 * new_variance
        if self._lognormal:
            log_variance = np.log1p(variance)
            scale = np.sqrt(log_variance / np.where(variance > 0.0, variance, 1.0))
            values[:, 2] = np.exp(scale * values[:, 2] - log_variance / 2.0)
        else:
            values[:, 2] += 1.0
        return values

    def mean_profile(self, start: int, stop: int) -> Floats:
        """Cn2 that a span of frames contains on average, the blending of epochs included.

        Parameters
        ----------
        start, stop : int
            Frame numbers, stop excluded.

        Returns
        -------
        ndarray, shape (k,)
            Cn2 in m^(-2/3).
        """
        frames = np.arange(start, stop)
        if self.epoch_frames == 0:
            return self.strength.at(0.0)
        epoch, frame = np.divmod(frames, self.epoch_frames)
        new = np.sin(np.pi / 2 * frame / self.epoch_frames) ** 2
        last = int(epoch[-1]) + 1
        weight = np.bincount(epoch, 1.0 - new, last + 1) + np.bincount(epoch + 1, new, last + 1)
        profiles = [self.strength.at(e * self.epoch_frames / self.frame_rate) for e in range(last + 1)]
        # Weights that add up to one: an unchanging profile comes out as it went in.
        return np.asarray((weight / weight.sum()) @ np.asarray(profiles))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _add_product(waves: NDArray[np.float32], matrix: NDArray[np.float32], values: Floats) -> None:
    """Add waves @ matrix.T to values; `waves` has a multiple of four rows.

    A BLAS starts threads of its own below the threads that draw frames, which wait for each other when other
    work goes on (measured: a hundred times slower), and its result depends on their number.
    """
    rows, columns, length = waves.shape[0], matrix.shape[0], waves.shape[1]
    # Stretches of all rows of both factors stay in the second-level cache, and their sums are added in double.
    for start in range(0, length, 1024):
        stop = min(start + 1024, length)
        for c in range(0, columns, 4):
            last = columns - 1
            # Rows cut to the stretch: only then does the compiler see contiguous numbers (three times as fast).
            m0, m1 = matrix[c, start:stop], matrix[min(c + 1, last), start:stop]
            m2, m3 = matrix[min(c + 2, last), start:stop], matrix[min(c + 3, last), start:stop]
            for r in range(0, rows, 4):
                w0, w1 = waves[r, start:stop], waves[r + 1, start:stop]
                w2, w3 = waves[r + 2, start:stop], waves[r + 3, start:stop]
                # Sixteen sums at once: as many as there are registers, so that each number read is used four
                # times.
                s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = np.float32(0.0)
                s20 = s21 = s22 = s23 = s30 = s31 = s32 = s33 = np.float32(0.0)
                for k in range(stop - start):
                    a0, a1, a2, a3 = w0[k], w1[k], w2[k], w3[k]
                    b0, b1, b2, b3 = m0[k], m1[k], m2[k], m3[k]
                    s00 += a0 * b0
                    s01 += a0 * b1
                    s02 += a0 * b2
                    s03 += a0 * b3
                    s10 += a1 * b0
                    s11 += a1 * b1
                    s12 += a1 * b2
                    s13 += a1 * b3
                    s20 += a2 * b0
                    s21 += a2 * b1
                    s22 += a2 * b2
                    s23 += a2 * b3
                    s30 += a3 * b0
                    s31 += a3 * b1
                    s32 += a3 * b2
                    s33 += a3 * b3
                sums = (
                    (s00, s01, s02, s03),
                    (s10, s11, s12, s13),
                    (s20, s21, s22, s23),
                    (s30, s31, s32, s33),
                )
                for i in range(4):
                    for j in range(min(4, columns - c)):
                        values[r + i, c + j] += sums[i][j]
