"""Correlation maps of slopes and scintillation: the reduced data of the inversion.

The maps of Sauvage et al. 2021 (arXiv:2111.08003), Eqs. (16)-(18), are averages of covariances over all pairs
of subapertures with the same separation. The covariances are kept as sums that can be gathered chunk by chunk
and merged in any order (`accumulate`, `merge`, `finalise`), so the size of a chunk never changes a result.

Channels are numbered (kind, source, subaperture) with the kinds x slope, y slope, intensity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .geometry import MAP_KINDS, Geometry

#: Kinds of signal, in the order of the channels.
SIGNAL_KINDS = ("x", "y", "i")

#: Row of `MAP_KINDS` that holds the auto map and the cross map of each kind of signal.
AUTO_MAP = tuple(MAP_KINDS.index(f"{kind}{kind}_auto") for kind in SIGNAL_KINDS)
CROSS_MAP = tuple(MAP_KINDS.index(f"{kind}{kind}_cross") for kind in SIGNAL_KINDS)

#: Frames whose products are summed at a time.
_BLOCK = 1024


@dataclass(frozen=True, eq=False)
class CorrelationSums:
    """Sufficient statistics of some frames: a commutative monoid under `merge` with `empty` as its identity.

    Attributes
    ----------
    n_sources, n_subapertures : int
        S and A; the number of channels is C = 3 S A.
    n_frames : int
        Frames seen, measured or not.
    count : ndarray of int64, (C, C)
        Frames in which both channels are measured.
    mean : ndarray, (C, C)
        Mean of the row's channel over the frames in which the column's channel is measured too; rad or counts.
    comoment : ndarray, (C, C)
        Sum over those frames of the product of the deviations from these means; rad^2, rad counts or counts^2.
    """

    n_sources: int
    n_subapertures: int
    n_frames: int
    count: NDArray[np.int64]
    mean: NDArray[np.float64]
    comoment: NDArray[np.float64]

    @classmethod
    def empty(cls, n_sources: int, n_subapertures: int) -> CorrelationSums:
        """Sums of no frames: merging them changes nothing."""
        shape = (3 * n_sources * n_subapertures,) * 2
        return cls(n_sources, n_subapertures, 0, np.zeros(shape, np.int64), np.zeros(shape), np.zeros(shape))


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation maps of a record and what goes with them.

    Attributes
    ----------
    maps : ndarray, (6, 2p - 1, 2q - 1)
        Maps in the order of `MAP_KINDS`, indexed [dy, dx]; rad^2 (slopes) or 1 (intensity); NaN where no pair
        is measured.
    pair_count : ndarray of int64, (6, 2p - 1, 2q - 1)
        Pairs of subapertures averaged; an auto map has those of both sources.
    covariance : ndarray, (C, C)
        Covariance of the normalised signals (slopes in rad, i / <i> - 1), detection noise included; NaN where
        two channels are never measured together.
    mean_slope : ndarray, (2, S, A)
        Mean slopes, rad.
    mean_flux : ndarray, (S, A)
        Mean fluxes, counts.
    scintillation_index : ndarray, (S,)
        Mean over subapertures of var(i) / <i>^2, detection noise included.
    valid_fraction : ndarray, (3, S, A)
        Part of the frames in which each channel is measured.
    n_frames : int
        Frames of the record.
    """

    maps: NDArray[np.float64]
    pair_count: NDArray[np.int64]
    covariance: NDArray[np.float64]
    mean_slope: NDArray[np.float64]
    mean_flux: NDArray[np.float64]
    scintillation_index: NDArray[np.float64]
    valid_fraction: NDArray[np.float64]
    n_frames: int


def channels(slopes: NDArray[np.floating], flux: NDArray[np.floating]) -> NDArray[np.float64]:
    """Slopes and fluxes of each frame as one row of channels.

    Parameters
    ----------
    slopes : ndarray, (T, 2, S, A)
        x and y slopes, rad; NaN where not measured.
    flux : ndarray, (T, S, A)
        Fluxes, counts; NaN where not measured.

    Returns
    -------
    ndarray, (T, 3 S A)
        A new array.

    Raises
    ------
    ValueError
        The shapes do not fit each other.
    """
    _check_shapes(slopes, flux)
    frames, _, sources, subapertures = slopes.shape
    samples = np.empty((frames, 3, sources, subapertures))
    samples[:, :2] = slopes
    samples[:, 2] = flux
    return samples.reshape(frames, 3 * sources * subapertures)


def _check_shapes(slopes: NDArray[np.floating], flux: NDArray[np.floating]) -> None:
    if slopes.ndim != 4 or slopes.shape[1] != 2 or flux.shape != (slopes.shape[0], *slopes.shape[2:]):
        raise ValueError(
            "slopes must be (time, 2, source, subaperture) and flux (time, source, subaperture): "
            f"got {slopes.shape} and {flux.shape}"
        )


def accumulate(slopes: NDArray[np.floating], flux: NDArray[np.floating]) -> CorrelationSums:
    """Gather the sums of some consecutive frames.

    Samples that are NaN are left out pair by pair: two channels are compared over the frames that have both.

    Parameters
    ----------
    slopes : ndarray, (T, 2, S, A)
        x and y slopes, rad.
    flux : ndarray, (T, S, A)
        Fluxes, counts.

    Returns
    -------
    CorrelationSums

    Raises
    ------
    ValueError
        The shapes do not fit each other, or a sample is infinite.
    """
    _check_shapes(slopes, flux)
    frames, sources, subapertures = flux.shape
    if frames == 0:
        return CorrelationSums.empty(sources, subapertures)
    kinds = slopes.reshape(frames, -1), flux.reshape(frames, -1)
    parts = slice(None, kinds[0].shape[1]), slice(kinds[0].shape[1], None)
    size = kinds[0].shape[1] + kinds[1].shape[1]
    # The sum of a frame is finite exactly when no sample of it is missing: cheaper than looking at every sample.
    gaps = ~np.isfinite(sum(kind.sum(axis=1) for kind in kinds))
    partial = channels(slopes[gaps], flux[gaps])
    if np.any(np.isinf(partial)):
        raise ValueError("a slope or flux is infinite: NaN alone stands for a sample that was not measured")
    measured = np.isfinite(partial)
    whole = frames - len(partial)
    # Sums are taken about each channel's own mean, so that subtracting the pairwise means below cancels
    # nothing.
    seen = whole + measured.sum(axis=0)
    origin = np.where(measured, partial, 0.0).sum(axis=0)
    for kind, part in zip(kinds, parts, strict=True):
        origin[part] += np.sum(kind, axis=0, dtype=np.float64, where=~gaps[:, None] if gaps.any() else True)
    origin /= np.maximum(seen, 1)
    comoment = np.zeros((size, size))
    total = np.zeros(size)
    room = np.empty((min(frames, _BLOCK), size))
    # Some frames at a time, which stay in the processor's cache.
    for start in range(0, frames, _BLOCK):
        deviation = room[: min(frames - start, _BLOCK)]
        for kind, part in zip(kinds, parts, strict=True):
            np.subtract(kind[start : start + _BLOCK], origin[part], out=deviation[:, part])
        deviation[gaps[start : start + _BLOCK]] = 0.0
        comoment += deviation.T @ deviation
        total += deviation.sum(axis=0)
    presence = measured.astype(np.float64)
    deviation = np.where(measured, partial - origin, 0.0)
    count = whole + presence.T @ presence
    sums = total[:, None] + deviation.T @ presence
    offset = sums / np.maximum(count, 1)
    comoment += deviation.T @ deviation
    return CorrelationSums(
        sources,
        subapertures,
        frames,
        np.rint(count).astype(np.int64),
        np.where(count > 0, origin[:, None] + offset, 0.0),
        comoment - offset * sums.T,
    )


def merge(first: CorrelationSums, second: CorrelationSums) -> CorrelationSums:
    """Sums of the frames of both arguments together.

    The comoments of the two parts refer to different means; the difference of the means contributes
    n1 n2 / (n1 + n2) times its product (Chan, Golub & LeVeque 1983, DOI 10.1080/00031305.1983.10483115).

    Raises
    ------
    ValueError
        The two belong to instruments of different shape.
    """
    if (first.n_sources, first.n_subapertures) != (second.n_sources, second.n_subapertures):
        raise ValueError(
            "sums of different instruments cannot be merged: "
            f"{first.n_sources} sources x {first.n_subapertures} subapertures and "
            f"{second.n_sources} x {second.n_subapertures}"
        )
    count = first.count + second.count
    weight = second.count / np.maximum(count, 1)
    step = second.mean - first.mean
    return CorrelationSums(
        first.n_sources,
        first.n_subapertures,
        first.n_frames + second.n_frames,
        count,
        first.mean + weight * step,
        first.comoment + second.comoment + step * step.T * (first.count * weight),
    )


def finalise(sums: CorrelationSums, geometry: Geometry) -> Correlation:
    """Turn sums into the six correlation maps and the covariance of the normalised signals.

    Covariances are about the mean of the record and divided by the number of frames. Each map entry is the
    mean over its pairs of subapertures, every pair weighted by the frames it has: with nothing missing this
    is Sauvage et al. 2021, Eqs. (16)-(18), and the auto maps are the mean of those of both sources. A pair
    (a, b) has the separation r_a - r_b, a on the first and b on the second source. With one source the cross
    maps are NaN.

    Parameters
    ----------
    sums : CorrelationSums
        Sums of a whole record.
    geometry : Geometry
        Pupil and sources of the instrument.

    Returns
    -------
    Correlation

    Raises
    ------
    ValueError
        Sums and geometry differ in their numbers of sources or subapertures, or there is no frame.
    """
    sources, subapertures = sums.n_sources, sums.n_subapertures
    if (sources, subapertures) != (geometry.n_sources, geometry.n_subapertures):
        raise ValueError(
            f"the sums hold {sources} sources x {subapertures} subapertures, the geometry "
            f"{geometry.n_sources} x {geometry.n_subapertures}"
        )
    if sums.n_frames == 0:
        raise ValueError("there is no frame to correlate")
    block = sources * subapertures
    own_count = np.diagonal(sums.count)
    mean = np.where(own_count > 0, np.diagonal(sums.mean), np.nan)
    mean_flux = mean[2 * block :]
    norm = np.ones(3 * block)
    norm[2 * block :] = np.where(mean_flux > 0, mean_flux, np.nan)
    comoment = sums.comoment / norm[:, None] / norm[None, :]
    # One frame has no deviation from its own mean: it would enter as a covariance of zero.
    count = np.where(np.isfinite(comoment) & (sums.count > 1), sums.count, 0)
    covariance = np.where(count > 0, comoment / np.maximum(count, 1), np.nan)
    maps, pair_count = _maps(np.where(count > 0, comoment, 0.0), count, geometry)
    variance = np.diagonal(covariance)[2 * block :].reshape(sources, subapertures)
    measured = np.isfinite(variance)
    total = np.where(measured, variance, 0.0).sum(axis=1)
    return Correlation(
        maps=maps,
        pair_count=pair_count,
        covariance=covariance,
        mean_slope=mean[: 2 * block].reshape(2, sources, subapertures),
        mean_flux=mean_flux.reshape(sources, subapertures),
        scintillation_index=np.where(measured.any(axis=1), total / np.maximum(measured.sum(axis=1), 1), np.nan),
        valid_fraction=(own_count / sums.n_frames).reshape(3, sources, subapertures),
        n_frames=sums.n_frames,
    )


def data_vector(maps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Maps (6, 2p - 1, 2q - 1) as the vector C_mes of Sauvage et al. 2021, Eq. (19), (6 (2p - 1)(2q - 1),)."""
    return maps.reshape(-1)


def pair_entry(geometry: Geometry) -> NDArray[np.int64]:
    """Entry of a flattened map, with separation r_a - r_b, of each pair (a, b) of subapertures, (A, A)."""
    row, column = geometry.subaperture_index.T
    dy = row[:, None] - row[None, :] + geometry.p - 1
    dx = column[:, None] - column[None, :] + geometry.q - 1
    return np.asarray(dy * geometry.map_shape[1] + dx)


def _maps(
    comoment: NDArray[np.float64], count: NDArray[np.int64], geometry: Geometry
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Average the pairs of each separation.

    Parameters
    ----------
    comoment, count : ndarray, (C, C)
        Sums over frames of the products of the normalised signals, and frames behind each; both 0 where no
        pair is.
    geometry : Geometry
        Pupil and sources.

    Returns
    -------
    maps : ndarray, (6, 2p - 1, 2q - 1)
    pair_count : ndarray of int64, (6, 2p - 1, 2q - 1)
    """
    sources, subapertures = geometry.n_sources, geometry.n_subapertures
    size = geometry.map_shape[0] * geometry.map_shape[1]
    entry = pair_entry(geometry).ravel()
    shape = (3, sources, subapertures, 3, sources, subapertures)
    comoments, counts = comoment.reshape(shape), count.reshape(shape)
    total, frames, pairs = (np.zeros((len(MAP_KINDS), size)) for _ in range(3))

    def add(number: int, kind: int, first: int, second: int) -> None:
        weight = counts[kind, first, :, kind, second, :].ravel()
        product = comoments[kind, first, :, kind, second, :].ravel()
        total[number] += np.bincount(entry, product, size)
        frames[number] += np.bincount(entry, weight, size)
        pairs[number] += np.bincount(entry, weight > 0, size)

    for kind in range(len(SIGNAL_KINDS)):
        for source in range(sources):
            add(AUTO_MAP[kind], kind, source, source)
        if sources == 2:
            add(CROSS_MAP[kind], kind, 0, 1)
    maps = np.where(pairs > 0, total / np.maximum(frames, 1), np.nan)
    shape_of_maps = (len(MAP_KINDS), *geometry.map_shape)
    return maps.reshape(shape_of_maps), np.rint(pairs).astype(np.int64).reshape(shape_of_maps)
