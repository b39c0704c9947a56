"""Frames with structured spots and their exact centroids, from first-order theory of weak turbulence.

Spots that are drawn as a shifted picture answer only to shifts. Real ones also change their shape, because the
wavefront is not plane within a subaperture and every point of an extended source scintillates on its own; how far a
method's position then departs from the centre of gravity decides whether the maps agree with the model. The complex
amplitude of each of many points of either source is computed on the subapertures, first order in the refractive index
(Rytov; Fante 1975, Proc. IEEE 63, 1669), and its image through each lenslet added up incoherently. Amplitudes of the
Fourier modes are drawn anew for each frame, so frames are independent. The centroid is known without an image: the mean
direction of arrival, weighted with the intensity over subaperture and source.

Nothing of the pipeline's response, simulation or extraction is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from coslidar.pipeline.parameters import Header

Floats = NDArray[np.float64]

#: Points of a subaperture along each axis where the amplitude is computed, and where its image is integrated.
NODES, FINE = 8, 24
#: Angles per pixel and axis at which the image is computed.
ANGLES = 2
#: Points of a source along x and y, at the nodes of Gauss and Hermite.
POINTS = (7, 7)
#: Waves whose phase runs through more than this over a standard deviation of the source are left out: the source
#: averages them to less than 5 % of their amplitude, which so few points would not.
STEEPEST = 2.5
#: Fourier modes per layer; new frequencies after so many frames.
MODES, BLOCK = 128, 20
#: Frequencies on the pupil, cycles/m: far below 1 / pupil, and well above 1 / subaperture.
LOWEST, HIGHEST = 1e-4, 40.0


@dataclass(frozen=True)
class Truth:
    """Noise-free slopes (T, 2, S, A), rad, and relative fluxes (T, S, A)."""

    slopes: Floats
    flux: Floats


def draw(header: Header, cn2: Floats, n_frames: int, seed: int) -> tuple[NDArray[np.float32], Truth]:
    """Images of both sources through each lenslet, and their centroids.

    Parameters
    ----------
    header : Header
        Geometry, and where the spots lie in a box.
    cn2 : ndarray, (k,)
        Profile, m^(-2/3), in k thin layers at the mid-points of equal slices.
    n_frames : int
        Independent frames.
    seed : int
        Of the turbulence.

    Returns
    -------
    boxes : ndarray of float32, (T, S, A, rows, cols)
        Light of each source alone in each box; a plane wave has 1 in all.
    Truth
    """
    geometry = header.geometry()
    pitch, scale = header.instrument.lenslet_pitch, header.instrument.pixel_scale
    length, wave_number, d = geometry.path_length, 2 * np.pi / geometry.wavelength, geometry.subaperture_size
    layers = (np.arange(len(cn2)) + 0.5) * length / len(cn2)
    strength = cn2 * length / len(cn2)
    place, _ = np.polynomial.legendre.leggauss(NODES)
    fine, weight = np.polynomial.legendre.leggauss(FINE)
    place, fine, weight = place * d / 2, fine * d / 2, weight / 2
    # Polynomials through the nodes, and their slopes.
    basis = np.linalg.inv(np.polynomial.legendre.legvander(2 * place / d, NODES - 1))
    between = np.polynomial.legendre.legvander(2 * fine / d, NODES - 1) @ basis
    derived = np.polynomial.legendre.legder(np.eye(NODES), axis=0)
    slope = np.polynomial.legendre.legvander(2 * fine / d, NODES - 2) @ derived @ basis * (2 / d)
    pupil = np.array([[(x + px, y + py) for py in place for px in place] for x, y in geometry.subaperture_position])
    widths = np.array(header.sources[0].fwhm) / np.sqrt(8 * np.log(2))
    sources, offsets, parts = _points(header, widths)

    n_sources, n_boxes = len(header.sources), len(pupil)
    n_points = len(parts)
    boxes = np.empty((n_frames, n_sources, n_boxes, *pitch), dtype=np.float32)
    slopes = np.empty((n_frames, 2, n_sources, n_boxes))
    flux = np.empty((n_frames, n_sources, n_boxes))
    # exp(i k theta r) from points of the subaperture to angles, those of a source at its spot.
    transforms = []
    for source, point in zip(header.sources, sources, strict=True):
        pair = []
        for axis, size in ((1, pitch[0]), (0, pitch[1])):
            at = (np.arange(size * ANGLES) + 0.5) / ANGLES - 0.5 - source.spot[1 - axis]
            angle = at * scale + point[axis] / length
            pair.append(np.exp(1j * wave_number * np.outer(angle, fine)) * weight)
        transforms.append([part.astype(np.complex64) for part in pair])
    for start in range(0, n_frames, BLOCK):
        stop = min(start + BLOCK, n_frames)
        rng = np.random.default_rng([seed, start])
        waves, exponents = [], []
        for z, power in zip(layers, strength, strict=True):
            shrink = 1 - z / length
            low, high = LOWEST / shrink, min(HIGHEST / shrink, STEEPEST * length / (2 * np.pi * z * min(widths)))
            u, v = qmc.Sobol(2, rng=rng).random(MODES).T
            f, angle = low * (high / low) ** u, 2 * np.pi * v
            # Kolmogorov: 0.023 r0^(-5/3) f^(-11/3), r0^(-5/3) = 0.423 k^2 Cn2 dz (Fried 1966; Noll 1976).
            psd = 0.0229 * 0.423 * wave_number**2 * power * f ** (-11 / 3)
            deviation = np.sqrt(psd * 2 * np.pi * f**2 * np.log(high / low) / MODES)
            vector = f[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            deviation *= np.hypot(*(vector * widths).T) * 2 * np.pi * z / length < STEEPEST
            amplitude = (rng.standard_normal((stop - start, MODES, 2)) @ [1, 1j]) * deviation
            at_pupil = np.exp(2j * np.pi * shrink * pupil.reshape(-1, 2) @ vector.T)
            # Diffraction over z (L - z) / L of the spherical wave.
            x = np.pi * geometry.wavelength * z * shrink * f**2
            points = (sources[:, None] + offsets).reshape(-1, 2)
            at_source = np.exp(2j * np.pi * z / length * points @ vector.T)
            driven = amplitude[:, None, :] * at_source
            waves.append(at_pupil)
            exponents.append(np.stack([driven * np.sin(x), driven * np.cos(x)]))
        field = _real_part(np.concatenate(waves, axis=1), np.concatenate(exponents, axis=-1))
        field = field.reshape(n_boxes, NODES, NODES, 2, stop - start, n_sources, n_points)
        for t in range(stop - start):
            for s in range(n_sources):
                logarithm, phase = np.moveaxis(field[:, :, :, :, t, s], (3, 4), (0, 2))
                everywhere = between @ logarithm @ between.T
                angle = between @ phase @ between.T
                light = np.exp(2 * everywhere) * weight[:, None] * weight * parts[:, None, None]
                tilt_x, tilt_y = between @ phase @ slope.T, slope @ phase @ between.T
                total = light.sum(axis=(1, 2, 3))
                for axis, tilt in enumerate((tilt_x, tilt_y)):
                    own = offsets[:, axis, None, None] / length - tilt / wave_number
                    slopes[start + t, axis, s] = (light * own).sum(axis=(1, 2, 3)) / total
                flux[start + t, s] = total
                tilted = (sources[s] + offsets) * wave_number / length
                ramp = tilted[:, 0, None, None] * fine + tilted[:, 1, None, None] * fine[:, None]
                wave = np.exp((everywhere + 1j * (angle - ramp)).astype(np.complex64))
                boxes[start + t, s] = (
                    _images(wave, transforms[s], parts, pitch) * (scale * d / geometry.wavelength) ** 2
                )
    return boxes, Truth(slopes, flux)


def _points(header: Header, widths: Floats) -> tuple[Floats, Floats, Floats]:
    """Places of the sources (S, 2), of points within a source (n, 2), and their parts of its light (n,)."""
    sources = np.array([source.position for source in header.sources])
    lines = []
    for number, width in zip(POINTS, widths, strict=True):
        node, weight = np.polynomial.hermite_e.hermegauss(number)
        lines.append((node * width, weight / weight.sum()))
    (x, of_x), (y, of_y) = lines
    offsets = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    return sources, offsets, np.outer(of_x, of_y).reshape(-1)


def _real_part(waves: NDArray[np.complex128], exponents: NDArray[np.complex128]) -> NDArray[np.float32]:
    """Real part of the sum over modes, (points of the pupil, columns of the exponents)."""
    flat = exponents.reshape(-1, waves.shape[1])
    left = np.concatenate([waves.real, -waves.imag], axis=1).astype(np.float32)
    right = np.concatenate([flat.real, flat.imag], axis=1).astype(np.float32)
    return np.asarray(left @ right.T)


def _images(
    wave: NDArray[np.complex64], transforms: list[NDArray[np.complex64]], parts: Floats, pitch: tuple[int, int]
) -> Floats:
    """Sum over the points of a source of their images in each box, (A, rows, cols)."""
    rows, cols = transforms
    image = np.zeros((len(wave), len(rows), len(cols)), dtype=np.float32)
    for number, part in enumerate(parts):
        half = np.matmul(rows, wave[:, number])
        amplitude = half.reshape(-1, half.shape[-1]) @ cols.T
        image += (part * (amplitude.real**2 + amplitude.imag**2)).reshape(image.shape)
    return np.asarray(image.reshape(len(wave), pitch[0], ANGLES, pitch[1], ANGLES).mean(axis=(2, 4)), dtype=float)
