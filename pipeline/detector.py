"""Frames of a Shack-Hartmann sensor drawn from known slopes and fluxes.

One lenslet makes one spot per source. Its shape is the image of the source by a square subaperture,
integrated over the pixels; it is moved by the slope to a fraction of a pixel, scaled by the flux, and cut at
the border of the lenslet's box. Noise of every frame comes from a generator of its own, so that a frame is
the same whenever and with whatever others it is drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numba
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from .geometry import Geometry
    from .protocols import SourceModel

    Floats = NDArray[np.float64]

#: Steps of the table of a spot profile per pixel; linear interpolation between them errs by less than 1e-5
#: of its maximum for any spot that a detector samples.
PROFILE_STEPS = 64
# Below this many electrons, and with less read noise than this, a normal variable is too poor a Poisson
# variable.
_FEW_ELECTRONS = 200.0
_LITTLE_READ_NOISE = 10.0


@dataclass(frozen=True)
class Detector:
    """Lenslet images, detector and noise.

    Parameters
    ----------
    boxes : ndarray of int64, (A, 2)
        First pixel (row, col) of the box of each exploited lenslet.
    pitch : (int, int)
        Size of a box (rows, cols), pixels.
    spots : ndarray, (S, 2)
        Position (row, col) in the box of each source's spot where its slope is zero, pixels.
    flux : ndarray, (S,)
        Mean flux of one spot, counts, its wings beyond the box included.
    profiles : ndarray of float32, (S, 2, n)
        Fraction of a spot that a row (column) at a distance of (index / PROFILE_STEPS) - pitch - 1 pixels
        takes; see :func:`spot_profile`.
    pixel_scale : float
        Angle of one pixel, rad.
    gain : float
        Electrons per count.
    read_noise : float
        Standard deviation, electrons.
    background : float
        Mean light on every pixel, counts; it carries photon noise.
    saturation : float
        Highest level, counts; at most 65535.
    offset : ndarray of float32, (rows, cols)
        Level without light, counts.
    flat : ndarray of float32, (rows, cols)
        Relative response of the pixels to light.
    bad_pixel : ndarray of uint8, (rows, cols)
        0 good, 1 dead (the offset whatever the light), 2 hot (saturated), 3 noisy (ten times the noise).
    seed : int
        Of the noise.
    """

    boxes: NDArray[np.int64]
    pitch: tuple[int, int]
    spots: Floats
    flux: Floats
    profiles: NDArray[np.float32]
    pixel_scale: float
    gain: float
    read_noise: float
    background: float
    saturation: float
    offset: NDArray[np.float32]
    flat: NDArray[np.float32]
    bad_pixel: NDArray[np.uint8]
    seed: int

    @property
    def dark(self) -> NDArray[np.float32]:
        """What to subtract from a frame: offset and mean background, counts, (rows, cols)."""
        return np.asarray(self.offset + self.flat * np.float32(self.background))

    def render(
        self, slopes: Floats, flux: Floats, index: NDArray[np.int64], *, noise: bool = True
    ) -> NDArray[np.uint16]:
        """Draw frames.

        Parameters
        ----------
        slopes : ndarray, (T, 2, S, A)
            Motion of each spot along x and y, rad.
        flux : ndarray, (T, S, A)
            Flux over its mean; what is below zero gives no light.
        index : ndarray of int64, (T,)
            Number of each frame, which seeds its noise.
        noise : bool
            Whether to add photon and read noise.

        Returns
        -------
        ndarray of uint16, (T, rows, cols)
            Raw counts, rounded and cut at the saturation.
        """
        light = self.expose(slopes, flux)
        frames = np.empty(light.shape, dtype=np.uint16)
        _read_out(
            light,
            self.offset,
            self.flat,
            self.bad_pixel,
            np.float32(self.gain),
            np.float32(self.read_noise),
            np.float32(self.saturation),
            np.uint64(self.seed & 0xFFFFFFFFFFFFFFFF),
            np.ascontiguousarray(index, dtype=np.int64),
            noise,
            *_ZIGGURAT,
            frames,
        )
        return frames

    def expose(self, slopes: Floats, flux: Floats) -> NDArray[np.float32]:
        """Mean light on the pixels, background included and before the flat, in counts.

        Parameters
        ----------
        slopes, flux : ndarray
            As for :meth:`render`.

        Returns
        -------
        ndarray of float32, (T, rows, cols)
            Light in counts.
        """
        light = np.full((len(slopes), *self.offset.shape), self.background, dtype=np.float32)
        centres = np.empty((*flux.shape, 2))
        centres[..., 0] = self.spots[:, 0, None] + slopes[:, 1] / self.pixel_scale
        centres[..., 1] = self.spots[:, 1, None] + slopes[:, 0] / self.pixel_scale
        counts = np.maximum(flux, 0.0) * self.flux[:, None]
        _draw_spots(centres, counts, self.boxes, self.pitch[0], self.pitch[1], self.profiles, light)
        return light


def lenslet_boxes(geometry: Geometry, origin: tuple[int, int], pitch: tuple[int, int]) -> NDArray[np.int64]:
    """First pixel of the box of every exploited lenslet.

    Parameters
    ----------
    geometry : Geometry
        Holds the mask.
    origin, pitch : (int, int)
        First pixel of lenslet (0, 0), and size of a box, as (row, col).

    Returns
    -------
    ndarray of int64, (A, 2)
        (row, col), in the order of the subapertures.
    """
    return np.asarray(np.asarray(origin) + geometry.subaperture_index * np.asarray(pitch), dtype=np.int64)


def spot_profile(
    geometry: Geometry,
    source: SourceModel,
    pixel_scale: float,
    pitch: tuple[int, int],
    shape: Literal["diffraction", "gaussian"] = "diffraction",
) -> NDArray[np.float32]:
    """Profile of a source's spot along y and x, integrated over pixels.

    The image is taken as the product of its two profiles: exact for the diffraction of a square subaperture
    with a source whose intensity is a product too, and with the right profile along the axes for any other.

    Parameters
    ----------
    geometry : Geometry
        Subaperture size, wavelength and path length.
    source : SourceModel
        Intensity of the source.
    pixel_scale : float
        Angle of one pixel, rad.
    pitch : (int, int)
        Size of a box (rows, cols), pixels.
    shape : {"diffraction", "gaussian"}
        Diffraction by the square subaperture, wings included, or a Gaussian core of the same width at half
        maximum without wings.

    Returns
    -------
    ndarray of float32, (2, n)
        Fractions along y (rows) and x (columns), at distances from -(pitch + 1) to pitch + 1 pixels (of the
        longer side) in steps of 1 / PROFILE_STEPS.
    """
    reach = max(pitch) + 1
    distance = np.arange(-reach * PROFILE_STEPS, reach * PROFILE_STEPS + 1) / PROFILE_STEPS
    # The subaperture passes nothing above d / lambda, so that the integral over frequency is finite; the
    # profile is smooth on the scale lambda / d, and a few Gauss-Legendre nodes per oscillation at the
    # longest distance suffice.
    cutoff = geometry.subaperture_size / geometry.wavelength
    nodes, weights = np.polynomial.legendre.leggauss(64 + 8 * math.ceil(reach * pixel_scale * cutoff))
    frequency, weights = cutoff * (nodes + 1.0) / 2.0, cutoff * weights / 2.0
    lever = 1.0 if geometry.infinite else 1.0 / geometry.path_length
    zero = np.zeros_like(frequency)
    result = np.empty((2, distance.size), dtype=np.float32)
    for axis in (0, 1):
        across = (zero, lever * frequency) if axis == 0 else (lever * frequency, zero)
        # The transform of the symmetric part of the profile; the centroid of a source is at its position.
        transfer = np.real(source.transfer(*across))
        if shape == "gaussian":
            image = (1.0 - frequency / cutoff) * transfer
            result[axis] = _gaussian(distance, _half_width(frequency, weights * image) / pixel_scale)
        else:
            image = (1.0 - frequency / cutoff) * transfer * np.sinc(frequency * pixel_scale)
            waves = np.cos(2.0 * np.pi * pixel_scale * np.multiply.outer(distance, frequency))
            result[axis] = 2.0 * pixel_scale * (waves @ (weights * image))
    return result


def _half_width(frequency: Floats, image: Floats) -> float:
    """Half width at half maximum of the even function whose transform is given at quadrature nodes."""
    from scipy.optimize import brentq

    def excess(x: float) -> float:
        return float(np.cos(2.0 * np.pi * x * frequency) @ image - 0.5 * image.sum())

    # Whatever the source, the first fall to one half lies between these.
    mean = float(frequency @ np.abs(image) / np.abs(image).sum())
    trial = np.linspace(0.0, 2.0 / mean, 400)
    below = next(x for x in trial if excess(float(x)) < 0.0)
    return float(brentq(excess, 0.0, float(below)))


def _gaussian(distance: Floats, half_width: float) -> Floats:
    from scipy.special import erf

    scale = half_width / math.sqrt(math.log(2.0))
    return np.asarray((erf((distance + 0.5) / scale) - erf((distance - 0.5) / scale)) / 2.0)


def _ziggurat() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]:
    """Tables of the ziggurat of Marsaglia and Tsang (2000), 128 layers: doi 10.18637/jss.v005.i08."""
    last, area = 3.442619855899, 9.91256303526217e-3
    edge = np.empty(129)
    edge[0], edge[1], edge[128] = area / math.exp(-0.5 * last**2), last, 0.0
    for i in range(2, 128):
        edge[i] = math.sqrt(-2.0 * math.log(area / edge[i - 1] + math.exp(-0.5 * edge[i - 1] ** 2)))
    width = edge[:128] / 2.0**24
    inside = np.floor(edge[1:] / edge[:128] * 2.0**24).astype(np.uint32)
    height = np.exp(-0.5 * edge**2)
    return width.astype(np.float32), height.astype(np.float32), inside


_ZIGGURAT = _ziggurat()


@numba.njit(cache=True, nogil=True, fastmath=True)
def _draw_spots(
    centres: Floats,
    counts: Floats,
    boxes: NDArray[np.int64],
    pitch_row: int,
    pitch_col: int,
    profiles: NDArray[np.float32],
    light: NDArray[np.float32],
) -> None:
    reach = max(pitch_row, pitch_col) + 1
    rows = np.empty(pitch_row, dtype=np.float32)
    cols = np.empty(pitch_col, dtype=np.float32)
    for t in range(centres.shape[0]):
        for source in range(centres.shape[1]):
            for a in range(centres.shape[2]):
                if not counts[t, source, a] > 0.0:
                    continue
                if not _sample(profiles[source, 0], centres[t, source, a, 0], reach, rows):
                    continue
                if not _sample(profiles[source, 1], centres[t, source, a, 1], reach, cols):
                    continue
                top, left = boxes[a, 0], boxes[a, 1]
                for i in range(pitch_row):
                    height = np.float32(counts[t, source, a]) * rows[i]
                    for j in range(pitch_col):
                        light[t, top + i, left + j] += height * cols[j]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _sample(profile: NDArray[np.float32], centre: float, reach: int, out: NDArray[np.float32]) -> bool:
    # All pixels have the same fraction of a step, so that the two weights are shared.
    start = (reach - centre) * PROFILE_STEPS
    first = math.floor(start)
    fraction = np.float32(start - first)
    if first < 0 or first + (out.size - 1) * PROFILE_STEPS + 1 >= profile.size:
        return False  # the spot has left its box altogether
    for i in range(out.size):
        place = first + i * PROFILE_STEPS
        out[i] = profile[place] + fraction * (profile[place + 1] - profile[place])
    return True


@numba.njit(cache=True, nogil=True, inline="always")
def _mix(state: np.uint64) -> np.uint64:
    # Finaliser of splitmix64 (Steele et al. 2014): spreads consecutive numbers over all 64 bits.
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def _tail(
    layer: int,
    bits: np.uint64,
    first: np.float32,
    width: NDArray[np.float32],
    height: NDArray[np.float32],
    inside: NDArray[np.uint32],
) -> np.float32:
    """A normal variable where the first try fell outside the inner rectangle of its layer (one in fifty)."""
    golden = np.uint64(0x9E3779B97F4A7C15)
    scale = 1.0 / 9007199254740992.0
    edge = 3.442619855899
    state = _mix(bits ^ np.uint64(0xD1B54A32D192ED03))
    value = float(first)
    while True:
        state += golden
        uniform = (float(_mix(state) >> np.uint64(11)) + 0.5) * scale
        if layer == 0:
            state += golden
            other = (float(_mix(state) >> np.uint64(11)) + 0.5) * scale
            x = -math.log(uniform) / edge
            y = -math.log(other)
            if 2.0 * y > x * x:
                return np.float32(edge + x if value > 0.0 else -edge - x)
            continue
        if height[layer] + uniform * (height[layer + 1] - height[layer]) < math.exp(-0.5 * value * value):
            return np.float32(value)
        state += golden
        fresh = _mix(state)
        layer = int(fresh & np.uint64(127))
        magnitude = np.uint32((fresh >> np.uint64(8)) & np.uint64(0xFFFFFF))
        value = float(magnitude) * float(width[layer])
        if (fresh >> np.uint64(7)) & np.uint64(1):
            value = -value
        if magnitude < inside[layer]:
            return np.float32(value)


@numba.njit(cache=True, nogil=True)
def _few(mean: float, bits: np.uint64) -> float:
    """A Poisson variable, by counting exponential waiting times."""
    state = bits
    left = mean
    number = -1
    while left > 0.0:
        state += np.uint64(0x9E3779B97F4A7C15)
        left += math.log((float(_mix(state) >> np.uint64(11)) + 0.5) / 9007199254740992.0)
        number += 1
    return float(max(number, 0))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _read_out(
    light: NDArray[np.float32],
    offset: NDArray[np.float32],
    flat: NDArray[np.float32],
    bad_pixel: NDArray[np.uint8],
    gain: np.float32,
    read_noise: np.float32,
    saturation: np.float32,
    seed: np.uint64,
    index: NDArray[np.int64],
    noise: bool,
    width: NDArray[np.float32],
    height: NDArray[np.float32],
    inside: NDArray[np.uint32],
    frames: NDArray[np.uint16],
) -> None:
    golden = np.uint64(0x9E3779B97F4A7C15)
    read = read_noise / gain
    counting = read_noise < np.float32(_LITTLE_READ_NOISE)
    for t in range(light.shape[0]):
        # A counter hashed per pixel: frame and pixel alone decide the number.
        state = _mix(seed + _mix(np.uint64(index[t]) + golden))
        for i in range(light.shape[1]):
            for j in range(light.shape[2]):
                value = flat[i, j] * light[t, i, j]
                state += golden
                kind = bad_pixel[i, j]
                if kind == 1:
                    value = np.float32(0.0)
                if noise:
                    bits = _mix(state)
                    layer = int(bits & np.uint64(127))
                    magnitude = np.uint32((bits >> np.uint64(8)) & np.uint64(0xFFFFFF))
                    normal = np.float32(magnitude) * width[layer]
                    if (bits >> np.uint64(7)) & np.uint64(1):
                        normal = -normal
                    if magnitude >= inside[layer]:
                        normal = _tail(layer, bits, normal, width, height, inside)
                    variance = read * read
                    if counting and value * gain < np.float32(_FEW_ELECTRONS):
                        value = np.float32(_few(float(value * gain), bits)) / gain
                    else:
                        variance += value / gain
                    deviation = np.float32(math.sqrt(variance))
                    if kind == 3:
                        deviation *= np.float32(10.0)
                    value += deviation * normal
                value += offset[i, j]
                if kind == 2 or value > saturation:
                    value = saturation
                frames[t, i, j] = np.uint16(max(value, np.float32(0.0)) + np.float32(0.5))


def bad_pixels(random: np.random.Generator, shape: Sequence[int], fraction: float) -> NDArray[np.uint8]:
    """Draw a map of bad pixels, dead, hot and noisy ones in equal parts.

    Parameters
    ----------
    random : numpy.random.Generator
        Source of randomness.
    shape : sequence of int
        (rows, cols).
    fraction : float
        Share of bad pixels, rounded to a whole number of them.

    Returns
    -------
    ndarray of uint8, (rows, cols)
        As :attr:`Detector.bad_pixel`.
    """
    size = int(np.prod(shape))
    result = np.zeros(size, dtype=np.uint8)
    count = round(fraction * size)
    result[random.choice(size, size=count, replace=False)] = 1 + np.arange(count) % 3
    return result.reshape(tuple(shape))
