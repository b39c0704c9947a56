"""Convergence noise: covariance of correlation maps that are measured over a finite time.

A map entry is a quadratic form, C_p = (1/N) sum_t x_t^T A_p x_t, of the deviations x_t of all channels in
frame t; A_p is symmetric and lives in the block of one kind of signal (both sources). For Gaussian signals
the theorem of Isserlis (1918, DOI 10.1093/biomet/12.1-2.134) gives, with S(l) = <x_t x_{t+l}^T>,

    cov(C_p, C_q) = (2/N) sum_l (1 - |l|/N) tr(A_p S(l) A_q S(l)^T).        (1)

`independent` keeps l = 0 only, as if no frame knew of the next (Sauvage et al. 2021 after Voyez et al. 2014);
at a hundred frames a second this understates the noise of scintillation by a few times and that of slopes by
tens to hundreds. `lagged` evaluates (1) in the frequency domain, where it is a sum over the ordinates of the
record's own Fourier transform: with S(f) the cross-spectral matrix,

    cov(C_p, C_q) = (4/N^2) sum_{0 < k <= N/2} tr(A_p S(f_k) A_q S(f_k)).        (2)

The ordinate 0 is absent because the mean of the record is removed. S(f) is the mean of Z Z^H over bands of
ordinates, narrow at low frequencies where the slopes have their power.

Averaging over n ordinates leaves an error in S(f) that does not average out of a quadratic expression. For n
independent complex Gaussian ordinates of covariance S and their mean S^,

    <tr(A S^ B S^)>       = tr(A S B S) + tr(A S) tr(B S) / n,
    <tr(A S^) tr(B S^)>   = tr(A S) tr(B S) + tr(A S B S) / n,

so that n^2 / (n^2 - 1) [tr(A S^ B S^) - tr(A S^) tr(B S^) / n] has no bias. It is also positive: written with
H = S^1/2 A S^1/2 the first term is the Gram matrix of the H, the second its projection on the identity within
the range of S^, whose dimension is at most n. The estimate therefore never has to be given up for the sake of
positivity.

Turbulence being the same all over the pupil, the cross-spectrum of two subapertures depends on their separation only;
the average over all pairs with one separation has far less noise. It need not be positive; its negative eigenvalues are
cut off and the rest shrunk to the same power, which leaves the covariance too large in those directions in which the
maps hardly vary at all (chi2 about 0.8). So the average is taken for short records only, where the noise of the
estimate is the greater evil.

The error of S^ also correlates with the maps themselves: where the record happened to fluctuate strongly, maps and
predicted noise are both large, and a fit weighted with the inverse of that noise comes out low (Cn2 near the pupil by
4 %, r0 by 2 % in records of 20 s; both go with the inverse of the record's length). No part of the data should be
weighted with a covariance made of itself. The even and the odd ordinates of each band, which are independent, give two
estimates Y_0, Y_1 of the maps y and two covariances C_0, C_1, all scaled to the whole record, and the weighted sums of
a fit should take Y_0 with the inverse of C_1 and Y_1 with that of C_0. To first order in the differences of the halves

    (C_1^-1 Y_0 + C_0^-1 Y_1) / 2 = C^-1 (y + d),    d = (C_0 - C_1) C^-1 (Y_0 - Y_1) / 4,        (3)

so a fit of y + d with the covariance C of the whole record is free of the bias. It is cross-fitting as known for
nuisance estimates of any kind (Chernozhukov et al. 2018, DOI 10.1111/ectj.12097).

The products tr(A_p S A_q S) of all p and q are correlations over pairs of subapertures: with a = b + p and
c = d + q running over the pupil, sum_{b,d} S_ac S_bd* + S_ad S_bc* is a four-dimensional correlation of S with
itself, done by Fourier transforms over the pupil instead of with 40 x 40 matrices for each p and q.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from .correlation import AUTO_MAP, CROSS_MAP, SIGNAL_KINDS, channels, pair_entry
from .geometry import MAP_KINDS, Geometry

#: Fewest ordinates of a band. With two the bias could still be removed, but estimates from a few ordinates are so
#: noisy that their inverse is far too large; with more the slopes' steep rise toward low frequencies is lost.
_FEWEST_ORDINATES = 8

#: Effectively independent frames of scintillation below which cross-spectra are averaged over equal separations.
HOMOGENEOUS_BELOW = 1000

#: Number of the kind of signal of each map.
_SIGNAL = [SIGNAL_KINDS.index(kind[0]) for kind in MAP_KINDS]

#: Smallest eigenvalue kept, relative to the variances. Only records of a few dozen frames come near it.
_FLOOR = 1e-12


class LaggedConvergence(NamedTuple):
    """Convergence noise of frames that are correlated in time.

    Attributes
    ----------
    covariance : ndarray, (m, m)
        Covariance of the rows `geometry.independent` of the data vector.
    n_effective : ndarray, (3,)
        For x slopes, y slopes and intensity: the number of independent frames over which the variance (the zero
        separation of the auto map) would have converged as well.
    correction : ndarray, (m,)
        What a fit weighted with `covariance` has to add to the rows `geometry.independent` of the data, Eq. (3) of
        this module, so that no datum is weighted with a covariance made of itself; 0 in rows without data.
    """

    covariance: NDArray[np.float64]
    n_effective: NDArray[np.float64]
    correction: NDArray[np.float64]


def independent(
    covariance: NDArray[np.float64],
    n_frames: int,
    geometry: Geometry,
    valid_fraction: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Covariance of the maps if all frames are independent, (2/N) tr(A_p S A_q S).

    Parameters
    ----------
    covariance : ndarray, (3 S A, 3 S A)
        Covariance S of the normalised signals, as measured; NaN where a channel has no data.
    n_frames : int
        Number N of frames.
    geometry : Geometry
        Pupil and sources.
    valid_fraction : ndarray, (3, S, A), optional
        Part of the frames in which each channel is measured; all of them by default.

    Returns
    -------
    ndarray, (m, m)
        Symmetric positive definite, for the rows `geometry.independent`; NaN in rows that no pair of channels
        measures.

    Raises
    ------
    ValueError
        The shapes do not fit the geometry, or there is no frame.
    """
    shape = (3, geometry.n_sources, geometry.n_subapertures)
    size = int(np.prod(shape))
    if covariance.shape != (size, size):
        raise ValueError(f"the covariance must be ({size}, {size}) for this geometry: got {covariance.shape}")
    if n_frames < 1:
        raise ValueError("there is no frame")
    present = np.ones(shape) if valid_fraction is None else np.asarray(valid_fraction, dtype=np.float64)
    if present.shape != shape:
        raise ValueError(f"the valid fraction must be {shape} for this geometry: got {present.shape}")
    present = present * np.isfinite(np.diagonal(covariance)).reshape(shape)
    # Maps weight a pair by its frames. A gap leaves the products of different frames or channels unchanged
    # on average apart from that weight, but not the square of a sample.
    weighted = np.where(np.isfinite(covariance), covariance, 0.0) * np.outer(present, present)
    power = np.where(present > 0, np.diagonal(covariance).reshape(shape), 0.0) * present
    np.fill_diagonal(weighted, power)
    scale = _root_mean_square(power, present)
    weighted /= np.outer(_each_channel(scale, shape), _each_channel(scale, shape))
    products = _trace_products(_positive_part(weighted)[None], np.ones((1, 3, 3)), geometry)
    return _assemble(2 / n_frames * products, *_pairs(scale, present, geometry))


def lagged(
    slopes: NDArray[np.floating],
    flux: NDArray[np.floating],
    geometry: Geometry,
    *,
    bands: int = 24,
    homogeneous: bool | None = None,
) -> LaggedConvergence:
    """Covariance of the maps of frames that are correlated in time, Eq. (2) of this module.

    Frames are taken as equally spaced. Missing samples are set to the mean of their channel; the maps weight
    each pair by its frames, and the number of samples left enters in the same way here. That is exact for gaps
    that strike channels independently, and too large by at most N / N_valid for frames lost in all channels together
    and for the zero separation.

    Parameters
    ----------
    slopes : ndarray, (T, 2, S, A)
        x and y slopes, rad; NaN where not measured.
    flux : ndarray, (T, S, A)
        Fluxes, counts; NaN where not measured.
    geometry : Geometry
        Pupil and sources.
    bands : int
        Number of frequency bands, at most; logarithmic, of no fewer than eight ordinates each.
    homogeneous : bool, optional
        Average the cross-spectra over all pairs of subapertures with the same separation, or take each pair as it was
        measured. Where it is absent they are averaged if the record holds fewer than `HOMOGENEOUS_BELOW` effectively
        independent frames of scintillation.

    Returns
    -------
    LaggedConvergence
        The covariance is symmetric positive definite; NaN in rows that no pair of channels measures.

    Raises
    ------
    ValueError
        The shapes do not fit each other or the geometry, or the record has fewer than 32 frames.
    """
    shape = (3, geometry.n_sources, geometry.n_subapertures)
    series = channels(slopes, flux)
    frames = series.shape[0]
    if flux.shape[1:] != shape[1:]:
        raise ValueError(
            f"slopes and flux hold {flux.shape[1]} sources x {flux.shape[2]} subapertures, "
            f"the geometry {shape[1]} x {shape[2]}"
        )
    if frames < 32:
        raise ValueError(f"the convergence noise of {frames} frames cannot be estimated: 32 are needed")
    if bands < 1:
        raise ValueError(f"at least one frequency band is needed: got {bands}")

    deviation, present, scale = _deviations(series, shape)
    # Lengths with a large prime factor cost five times more; the spectrum of 99 % of the frames is as good.
    length = int(fft.prev_fast_len(frames)) if frames > 4096 else frames
    # Single precision rounds at 1e-7 of the strongest ordinate, far below the detection noise of any channel.
    spectrum = fft.rfft(deviation[:length].astype(np.float32), axis=0)[1 : (length + 1) // 2]
    edges = _band_edges(spectrum.shape[0], bands)
    curve = _power_curve(spectrum, edges)

    size = deviation.shape[1]
    count = np.diff(edges).astype(np.float64)
    halves = np.empty((2, count.size, size, size), np.complex128)
    counts = np.empty((2, count.size))
    weights = np.empty((count.size, 3, 3))
    amplitude = np.sqrt(curve).astype(np.float32)
    powers = np.empty((count.size, 3))
    for band, (start, stop) in enumerate(pairwise(edges)):
        # Within a band the spectra fall along smooth curves. Divided by these the ordinates are alike and
        # can be averaged; the curves come back, squared, in the weight of the band.
        flat = spectrum[start:stop].reshape(-1, 3, size // 3) / amplitude[start:stop, :, None]
        flat = flat.reshape(-1, size)
        for half in range(2):
            part = flat[half::2]
            counts[half, band] = len(part)
            halves[half, band] = part.T @ part.conj()
            halves[half, band] /= length * len(part)
        weights[band] = curve[start:stop].T @ curve[start:stop]
        powers[band] = curve[start:stop].sum(axis=0)
    share = (counts / count)[:, :, None, None]
    spectra = share[0] * halves[0] + share[1] * halves[1]
    n_effective = _effective(spectra, count, weights, powers, geometry) * (frames / length)
    if homogeneous is None:
        homogeneous = not n_effective[2] >= HOMOGENEOUS_BELOW
    # One set of spectra for the whole, and the difference of two for the halves.
    both, signed = halves.reshape(-1, size, size), np.concatenate([weights, -weights])
    if homogeneous:
        products = _trace_products(_positive(_averaged(spectra, present, geometry)), weights, geometry)
        unlike = _trace_products(_positive(_averaged(both, present, geometry)).astype(np.complex64), signed, geometry)
    else:
        products = _unbiased_products(spectra, count, weights, geometry)
        unlike = _unbiased_products(both.astype(np.complex64), counts.ravel(), signed, geometry)
    # The maps average all frames, whatever the number of them that measured the spectrum.
    norm = 4 / (frames * length)
    pairs, unit = _pairs(scale, present, geometry)
    covariance = _assemble(norm * products, pairs, unit)
    rows = np.flatnonzero(np.isfinite(np.diagonal(covariance)))
    per_pair = unit[rows] / pairs[rows]
    apart = _sums(halves[0] - halves[1], powers, geometry)[rows] * 2 / length
    deviation = np.sqrt(np.diagonal(covariance)[rows])
    inverse = linalg.solve(
        covariance[np.ix_(rows, rows)] / np.outer(deviation, deviation), apart * per_pair / deviation, assume_a="pos"
    )
    correction = np.zeros(len(covariance))
    correction[rows] = norm * per_pair * (unlike[np.ix_(rows, rows)] @ (per_pair * inverse / deviation)) / 4
    return LaggedConvergence(covariance, n_effective, correction)


def expand(matrix: NDArray[np.float64], geometry: Geometry) -> NDArray[np.float64]:
    """Covariance of the whole data vector from that of its independent rows.

    Parameters
    ----------
    matrix : ndarray, (m, m)
        Covariance of the rows `geometry.independent`.
    geometry : Geometry
        Pupil and sources.

    Returns
    -------
    ndarray, (n, n)
        n = 6 (2p - 1)(2q - 1). An auto map has each value twice, at d and -d; rows that no pair measures are
        NaN.

    Raises
    ------
    ValueError
        The matrix does not have the rows `geometry.independent`.
    """
    rows, known = _independent_row(matrix.shape, geometry)
    return np.where(known[:, None] & known[None, :], matrix[np.ix_(rows, rows)], np.nan)


def deviation_maps(matrix: NDArray[np.float64], geometry: Geometry) -> NDArray[np.float64]:
    """Standard deviation of each map entry.

    Parameters
    ----------
    matrix : ndarray, (m, m)
        Covariance of the rows `geometry.independent`.
    geometry : Geometry
        Pupil and sources.

    Returns
    -------
    ndarray, (6, 2p - 1, 2q - 1)
        In the units of the maps; NaN where no pair is measured.

    Raises
    ------
    ValueError
        The matrix does not have the rows `geometry.independent`.
    """
    return on_maps(np.sqrt(np.diagonal(matrix)), geometry)


def on_maps(values: NDArray[np.float64], geometry: Geometry) -> NDArray[np.float64]:
    """Values of the independent data on the maps, where an auto map has each twice.

    Parameters
    ----------
    values : ndarray, (m,)
        One for each of the rows `geometry.independent`.
    geometry : Geometry
        Pupil and sources.

    Returns
    -------
    ndarray, (6, 2p - 1, 2q - 1)
        NaN where no pair is measured.

    Raises
    ------
    ValueError
        There is not one value for each of the rows `geometry.independent`.
    """
    rows, known = _independent_row(values.shape, geometry)
    return np.where(known, values[rows], np.nan).reshape(len(MAP_KINDS), *geometry.map_shape)


def _independent_row(shape: tuple[int, ...], geometry: Geometry) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Row of the independent data that each row of the data vector repeats, and whether there is one."""
    kept = geometry.independent
    wanted = (kept.size,) * len(shape)
    if shape != wanted:
        raise ValueError(f"the shape must be {wanted}, one row for each independent datum: got {shape}")
    position = np.full(geometry.valid.size, -1)
    position[kept] = np.arange(kept.size)
    rows = position[geometry.mirror]
    return np.maximum(rows, 0), rows >= 0


def _each_channel(value: NDArray[np.float64], shape: tuple[int, int, int]) -> NDArray[np.float64]:
    """One value per kind as one value per channel, (3 S A,)."""
    return np.repeat(value, shape[1] * shape[2])


def _root_mean_square(power: NDArray[np.float64], present: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale of each kind, (3,): slopes are 1e-5 of the intensity and would drown in its rounding."""
    total = power.sum(axis=(1, 2)) / np.maximum((present > 0).sum(axis=(1, 2)), 1)
    return np.where(total > 0, np.sqrt(total), 1.0)


def _deviations(
    series: NDArray[np.float64], shape: tuple[int, int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Deviations from the mean, intensities divided by their mean, gaps 0, each kind of unit variance.

    Parameters
    ----------
    series : ndarray, (T, 3 S A)
        Slopes and fluxes; overwritten.
    shape : tuple of int
        (3, S, A).

    Returns
    -------
    deviation : ndarray, (T, 3 S A)
    valid_fraction : ndarray, (3, S, A)
        0 also where the mean flux is not positive.
    scale : ndarray, (3,)
        What each kind was divided by.
    """
    mean = series.mean(axis=0)
    valid = np.ones(mean.size)
    if not np.all(np.isfinite(mean)):
        measured = np.isfinite(series)
        valid = measured.mean(axis=0)
        mean = np.where(measured, series, 0.0).mean(axis=0) / np.where(valid > 0, valid, 1.0)
        series = np.where(measured, series, mean)
    series -= mean
    norm = np.ones(mean.size)
    intensity = slice(2 * shape[1] * shape[2], None)
    lit = mean[intensity] > 0
    valid[intensity] *= lit
    norm[intensity] = np.where(lit, mean[intensity], np.inf)
    power = np.einsum("tc,tc->c", series, series) / series.shape[0] / norm**2
    present = valid.reshape(shape)
    scale = _root_mean_square(power.reshape(shape), present)
    series /= norm * _each_channel(scale, shape)
    return series, present, scale


def _averaged(
    spectra: NDArray[np.complex128], present: NDArray[np.float64], geometry: Geometry
) -> NDArray[np.complex128]:
    """Cross-spectra averaged over all pairs of subapertures with the same separation.

    Turbulence is the same all over the pupil, so the cross-spectrum of two subapertures depends on their separation
    alone. The average over the pairs takes away most of the noise of the estimate.

    Parameters
    ----------
    spectra : ndarray, (B, 3 S A, 3 S A)
        Cross-spectra.
    present : ndarray, (3, S, A)
        Part of the frames in which each channel is measured; channels without any take no part.
    geometry : Geometry
        Pupil and sources.
    """
    bands, size = spectra.shape[:2]
    subapertures = geometry.n_subapertures
    groups = size // subapertures
    entry = pair_entry(geometry).ravel()
    entries = geometry.map_shape[0] * geometry.map_shape[1]
    seen = (present > 0).reshape(groups, subapertures).astype(np.float64)
    pairs = (seen[:, None, :, None] * seen[None, :, None, :]).reshape(groups, groups, -1)
    belongs = np.zeros((entry.size, entries))
    belongs[np.arange(entry.size), entry] = 1.0
    count = np.maximum(pairs @ belongs, 1.0)
    blocks = spectra.reshape(bands, groups, subapertures, groups, subapertures).transpose(0, 1, 3, 2, 4)
    blocks = blocks.reshape(bands, groups, groups, -1) * pairs
    mean = ((blocks @ belongs) / count)[..., entry] * pairs
    mean = mean.reshape(bands, groups, groups, subapertures, subapertures).transpose(0, 1, 3, 2, 4)
    return np.asarray(mean.reshape(bands, size, size))


def _positive(spectra: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Averages without their negative eigenvalues, which are noise, the others shrunk to the power that was there.

    Parameters
    ----------
    spectra : ndarray, (B, n, n)
        Hermitian matrices.
    """
    values, vectors = np.linalg.eigh(spectra)
    kept = np.maximum(values, 0.0)
    kept *= (values.sum(axis=1) / np.maximum(kept.sum(axis=1), np.finfo(float).tiny))[:, None]
    return np.asarray((vectors * kept[:, None, :]) @ vectors.conj().swapaxes(1, 2))


def _unbiased_products(
    spectra: NDArray[np.complex128], count: NDArray[np.float64], weights: NDArray[np.float64], geometry: Geometry
) -> NDArray[np.float64]:
    """Weighted sum of tr(A_p S A_q S), S being known from `count` ordinates only; as `_trace_products`."""
    weights = (count**2 / (count**2 - 1))[:, None, None] * weights
    products = _trace_products(spectra, weights, geometry)
    products -= _squared_traces(spectra, weights / count[:, None, None], geometry)
    return products


def _band_edges(ordinates: int, bands: int) -> NDArray[np.int64]:
    """Borders of logarithmic bands of at least `_FEWEST_ORDINATES` of the ordinates 1, 2, ..., (bands + 1,)."""
    edges = [0]
    for left in range(bands, 0, -1):
        here = edges[-1]
        # From each border on, what is left is divided evenly again: bands widened at the start narrow the
        # others.
        there = round((here + 1) * ((ordinates + 1) / (here + 1)) ** (1 / left)) - 1
        there = max(there, here + _FEWEST_ORDINATES)
        if left == 1 or there + _FEWEST_ORDINATES > ordinates:
            break
        edges.append(there)
    return np.asarray([*edges, ordinates])


def _power_curve(spectrum: NDArray[np.complexfloating], edges: NDArray[np.int64]) -> NDArray[np.float64]:
    """Smooth mean power of each kind at each ordinate: band means joined by power laws.

    Parameters
    ----------
    spectrum : ndarray, (F, 3 S A)
        Ordinates 1 to F of all channels.
    edges : ndarray of int
        Borders of the bands.

    Returns
    -------
    ndarray, (F, 3)
        Positive; only its form within each band matters.
    """
    ordinates = spectrum.shape[0]
    parts = spectrum.reshape(ordinates, 3, -1)
    power = np.einsum("fkc,fkc->fk", parts.real, parts.real) + np.einsum("fkc,fkc->fk", parts.imag, parts.imag)
    mean = np.add.reduceat(power.astype(np.float64), edges[:-1], axis=0) / np.diff(edges)[:, None]
    level = np.log(np.where(mean > 0, mean, 1.0))
    centre = (np.log(edges[:-1] + 1) + np.log(edges[1:])) / 2
    place = np.log(np.arange(1, ordinates + 1))
    return np.exp(np.stack([np.interp(place, centre, level[:, kind]) for kind in range(3)], axis=1))


def _effective(
    spectra: NDArray[np.complex128],
    count: NDArray[np.float64],
    weights: NDArray[np.float64],
    powers: NDArray[np.float64],
    geometry: Geometry,
) -> NDArray[np.float64]:
    """Independent frames over which the zero separation of each auto map would have converged as well, (3,).

    The operator of that separation is the identity of its kind, so both traces of Eqs. (1) and (2) are sums of squares.

    Parameters
    ----------
    spectra : ndarray, (B, 3 S A, 3 S A)
        Cross-spectra of the flattened ordinates.
    count : ndarray, (B,)
        Ordinates of each band.
    weights : ndarray, (B, 3, 3)
        Sum over the ordinates of a band of the products of the curves that flattened them.
    powers : ndarray, (B, 3)
        Sum over the ordinates of a band of the curves.
    geometry : Geometry
        Pupil and sources.
    """
    block = geometry.n_sources * geometry.n_subapertures
    found = np.full(3, np.nan)
    for kind in range(3):
        part = spectra[:, kind * block : (kind + 1) * block, kind * block : (kind + 1) * block]
        alone = np.sum(np.tensordot(powers[:, kind], part.real, 1) ** 2)
        trace = np.trace(part, axis1=1, axis2=2).real
        square = np.sum(part.real**2 + part.imag**2, axis=(1, 2)) - trace**2 / count
        together = np.sum(count**2 / (count**2 - 1) * weights[:, kind, kind] * square)
        if together > 0:
            found[kind] = 2 * alone / together
    return found


def _sums(spectra: NDArray[np.complex128], powers: NDArray[np.float64], geometry: Geometry) -> NDArray[np.float64]:
    """Sums over the pairs of each separation, and over the ordinates of positive frequency, (m,).

    Parameters
    ----------
    spectra : ndarray, (B, 3 S A, 3 S A)
        Cross-spectra of the flattened ordinates.
    powers : ndarray, (B, 3)
        Sum over the ordinates of a band of the curve that flattened them.
    geometry : Geometry
        Pupil and sources.
    """
    traces = _traces(spectra, geometry)
    return np.concatenate([powers[:, kind] @ trace for kind, trace in zip(_SIGNAL, traces, strict=True)])


def _positive_part(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest positive semidefinite matrix: covariances over different frames need not form one."""
    values, vectors = linalg.eigh(matrix)
    if values[0] >= 0:
        return matrix
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _map_rows(geometry: Geometry) -> list[NDArray[np.int64]]:
    """For each map, those of its entries that are independent data."""
    entries = geometry.map_shape[0] * geometry.map_shape[1]
    number, entry = np.divmod(geometry.independent, entries)
    return [entry[number == kind] for kind in range(len(MAP_KINDS))]


def _trace_products(
    spectra: NDArray[np.number], weights: NDArray[np.float64], geometry: Geometry
) -> NDArray[np.float64]:
    """Weighted sum over spectra of tr(A_p S A_q S), A_p summing (not averaging) the pairs of a separation.

    Parameters
    ----------
    spectra : ndarray, (B, 3 S A, 3 S A)
        Hermitian (or real symmetric) matrices S.
    weights : ndarray, (B, 3, 3)
        Weight, of either sign, of each matrix for a p of one kind of signal and a q of another.
    geometry : Geometry
        Pupil and sources.

    Returns
    -------
    ndarray, (m, m)
        For the rows `geometry.independent`.
    """
    sources, subapertures = geometry.n_sources, geometry.n_subapertures
    rows, columns = geometry.map_shape
    precision = np.result_type(spectra, np.complex64)
    i, j = geometry.subaperture_index.T
    u, v = np.divmod(np.arange(rows * columns), columns)
    # Transform over the pupil, padded to the size of a map so that no correlation wraps around.
    pupil = np.exp(-2j * np.pi * (np.outer(u, i) / rows + np.outer(v, j) / columns)).astype(precision)
    blocks = spectra.reshape(-1, 3, sources, subapertures, 3, sources, subapertures)
    kept = _map_rows(geometry)
    starts = np.concatenate([[0], np.cumsum([entry.size for entry in kept])])
    products = np.empty((starts[-1], starts[-1]))

    def correlation(product: NDArray[np.number], mirrored: NDArray[np.number]) -> NDArray[np.float64]:
        """Sum over (b, d) of the first argument's pair at (p, q) and the second one's at (p, -q)."""
        shape = (rows, columns, rows, columns)
        direct = fft.fftshift(fft.ifftn(product.reshape(shape)).real)
        swapped = fft.fftshift(fft.ifftn(mirrored.reshape(shape)).real)
        return np.asarray((direct + swapped[:, :, ::-1, ::-1]).reshape(rows * columns, rows * columns)) / 2

    def put(first: int, second: int, values: NDArray[np.float64]) -> None:
        chosen = values[np.ix_(kept[first], kept[second])]
        left, top = slice(starts[first], starts[first + 1]), slice(starts[second], starts[second + 1])
        products[left, top] = chosen
        products[top, left] = chosen.T

    for one in range(3):
        for other in range(one, 3):
            power = np.zeros((pupil.shape[0],) * 2)
            swapped, upper, straight, crossed = np.zeros((4, *power.shape), np.complex128)
            # One spectrum at a time stays in the processor's cache, and small for instruments with many lenslets.
            for matrix, weight in zip(blocks, weights[:, one, other], strict=True):
                block = matrix[one, :, :, other].transpose(0, 2, 1, 3)  # source, source, a, c
                transform = pupil @ block.astype(precision) @ pupil.T
                conjugate = weight * transform.conj()
                power += np.sum((transform * conjugate).real, axis=(0, 1))
                if sources == 2:
                    swapped += transform[0, 1] * conjugate[0, 0] + transform[1, 1] * conjugate[1, 0]
                    upper += transform[0, 0] * conjugate[1, 0] + transform[0, 1] * conjugate[1, 1]
                    straight += transform[0, 0] * conjugate[1, 1]
                    crossed += transform[0, 1] * conjugate[1, 0]
            put(AUTO_MAP[one], AUTO_MAP[other], correlation(power, power))
            if sources == 2:
                put(AUTO_MAP[one], CROSS_MAP[other], correlation(swapped.conj(), swapped))
                put(CROSS_MAP[one], AUTO_MAP[other], correlation(upper, upper))
                put(CROSS_MAP[one], CROSS_MAP[other], correlation(straight, crossed))
    return products


def _traces(spectra: NDArray[np.number], geometry: Geometry) -> list[NDArray[np.float64]]:
    """Trace of A_p S, the sum over the pairs of a separation, of each spectrum; for each map, (B, its rows).

    Parameters
    ----------
    spectra : ndarray, (B, 3 S A, 3 S A)
        Hermitian (or real symmetric) matrices S.
    geometry : Geometry
        Pupil and sources.
    """
    sources, subapertures = geometry.n_sources, geometry.n_subapertures
    entries = geometry.map_shape[0] * geometry.map_shape[1]
    entry = pair_entry(geometry).ravel()
    bands = spectra.shape[0]
    blocks = spectra.real.reshape(bands, 3, sources, subapertures, 3, sources, subapertures)
    # One histogram for all bands: those of a band fall into a range of their own.
    place = (entry[None, :] + entries * np.arange(bands)[:, None]).ravel()
    kept = _map_rows(geometry)
    traces = [np.zeros((bands, entry.size)) for entry in kept]

    def trace(kind: int, first: int, second: int) -> NDArray[np.float64]:
        pairs = blocks[:, kind, first, :, kind, second, :].ravel()
        return np.asarray(np.bincount(place, pairs, entries * bands).reshape(bands, entries), np.float64)

    for kind in range(3):
        auto = np.sum([trace(kind, source, source) for source in range(sources)], axis=0)
        traces[AUTO_MAP[kind]] = auto[:, kept[AUTO_MAP[kind]]]
        if sources == 2:
            traces[CROSS_MAP[kind]] = trace(kind, 0, 1)[:, kept[CROSS_MAP[kind]]]
    return traces


def _squared_traces(
    spectra: NDArray[np.complex128], weights: NDArray[np.float64], geometry: Geometry
) -> NDArray[np.float64]:
    """Weighted sum over spectra of tr(A_p S) tr(A_q S); arguments and result as in `_trace_products`."""
    traces = _traces(spectra, geometry)
    return np.block(
        [
            [(first * weights[:, _SIGNAL[one], _SIGNAL[other], None]).T @ second for other, second in enumerate(traces)]
            for one, first in enumerate(traces)
        ]
    )


def _pairs(
    scale: NDArray[np.float64], present: NDArray[np.float64], geometry: Geometry
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Number of pairs that each of the rows `geometry.independent` averages, gaps taken off, and its unit.

    Parameters
    ----------
    scale : ndarray, (3,)
        Unit of each kind of signal.
    present : ndarray, (3, S, A)
        Part of the frames in which each channel is measured.
    geometry : Geometry
        Pupil and sources.

    Returns
    -------
    pairs, unit : ndarray, (m,)
    """
    traces = _traces(np.outer(present, present)[None], geometry)
    units = [np.full(trace.shape[1], scale[kind] ** 2) for kind, trace in zip(_SIGNAL, traces, strict=True)]
    return np.concatenate([trace[0] for trace in traces]), np.concatenate(units)


def _assemble(
    products: NDArray[np.float64], pairs: NDArray[np.float64], unit: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariance of the map averages in their units from that of the sums over pairs.

    Parameters
    ----------
    products : ndarray, (m, m)
        Covariance of sums over pairs of the signals in units of `scale`, gaps counting zero.
    pairs, unit : ndarray, (m,)
        Of :func:`_pairs`.

    Returns
    -------
    ndarray, (m, m)
        NaN in rows without a pair.
    """
    rows = np.flatnonzero((pairs > 0) & (np.diagonal(products) > 0))
    deviation = np.sqrt(np.diagonal(products)[rows])
    correlation = products[np.ix_(rows, rows)] / np.outer(deviation, deviation)
    correlation = (correlation + correlation.T) / 2
    try:
        linalg.cholesky(correlation)
    except linalg.LinAlgError:
        values, vectors = linalg.eigh(correlation)
        correlation = (vectors * np.maximum(values, _FLOOR)) @ vectors.T
        correlation = (correlation + correlation.T) / 2
    error = deviation * unit[rows] / pairs[rows]
    covariance = np.full(products.shape, np.nan)
    covariance[np.ix_(rows, rows)] = correlation * np.outer(error, error)
    return covariance
