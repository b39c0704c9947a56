"""Synthetic data whose truth is known: how well mu is chosen, and how often bars and intervals hold the truth.

The appendix of Sauvage et al. 2021, for any prior and any selector. A profile gives noise-free correlations through
the response matrix; convergence noise is drawn from its theoretical covariance and added; the profile is
reconstructed and compared. The covariance C_conv is that of Gaussian signals (:mod:`.convergence`, Eq. (1)) with

``S(l) = rho(l) S_t + delta_l S_d``,

S_t the theoretical covariance of all slopes and fluxes of both sources, products of x with y slopes and of slopes with
fluxes included (:func:`channel_covariance`), and S_d the detection noise, white in time. One correlation function
rho for all channels of a kind turns the sum over lags into a number of effectively independent frames for that kind,

``C_conv = D Q(S_t) D + [Q(S_t + S_d) - Q(S_t)] / N,   Q(S)_pq = 2 tr(A_p S A_q S),   D = N_eff^(-1/2)``,

which is positive whatever the numbers. That all separations forget at one rate is a simplification: in a frozen flow
the common motion of all spots lives longer than their differences. With N_eff = N it is the paper's formula.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from . import convergence, inversion, posterior, uncertainty
from .correlation import AUTO_MAP, CROSS_MAP
from .geometry import MAP_KINDS, Geometry, SliceGrid

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .protocols import HyperparameterSelector, SourceModel, TurbulenceSpectrum

Floats: TypeAlias = NDArray[np.float64]

FRAMES = 25560
"""Frames of three minutes at 142 Hz."""

EFFECTIVE_FRAMES = {"independent": (25560.0, 25560.0, 25560.0), "measured": (1460.0, 910.0, 4930.0)}
"""Effectively independent frames for x slopes, y slopes and fluxes.

`independent`: as many as there are, the assumption of Sauvage et al. 2021. `measured`: 160, 100 and 540 in the 2800
frames of a wave-optics simulation of the instrument in a wind of 4 m/s, scaled to the number of frames.
"""

DETECTION_NOISE = (1e-13, 1e-13, 1e-5)
"""Variance of x slopes (rad^2), y slopes (rad^2) and relative fluxes by the detector, of the order of Scindar's."""

TRUTHS: dict[str, tuple[float, ...]] = {
    "strong": (3.4e-14,) * 5 + (1.7e-15,) * 2 + (1.02e-13,) * 2 + (3.4e-15,) + (2.04e-13,) * 2,
    "weak": (1.2e-14, 1e-14, 6e-15, 4e-15, 6e-15, 8e-15, 8e-15, 5e-15, 4e-15, 6e-15, 1.2e-14, 1.5e-14),
    "bright-last": (8e-15,) * 11 + (3e-13,),
    "empty": (0.0,) * 12,
    "rough": (3.9e-15, 2.6e-15, 2.8e-14, 3.8e-15, 1.2e-13, 5.9e-14, 1e-15, 3e-14, 3.8e-15, 2.1e-14, 2.1e-14, 1e-15),
    "single": (0.0,) * 4 + (1e-13,) + (0.0,) * 7,
}
"""Cn2 of twelve slices, m^(-2/3): an afternoon as at 14:15 in Sauvage et al. 2021, its end, a bright slice at the
sources, slices that know nothing of each other (log-normal, standard deviation 1.5), nothing, and one slice alone."""

REFERENCE_LEVEL = 8e-15
"""What errors are divided by where the truth is empty, m^(-2/3): the mean of the weak profile."""

POSTERIOR_DRAWS = 2048


def scindar() -> Geometry:
    """The instrument of Sauvage et al. 2021: 20 of 5 x 5 lenslets of 7 cm, two lamps 0.8 m apart at 2670 m, 3.8 um."""
    mask = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))
    return Geometry(mask, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))


# --- covariance of the signals ----------------------------------------------------------------------------------------


def channel_covariance(
    geometry: Geometry,
    grid: SliceGrid,
    cn2: Floats,
    spectrum: TurbulenceSpectrum,
    sources: Sequence[SourceModel],
    *,
    centroid_term: bool = True,
) -> Floats:
    """Theoretical covariance of all slopes and fluxes, turbulence at the middle of each slice.

    The products of the amplitudes in :mod:`.response` for every two kinds, x with y and slopes with fluxes included,
    by quadrature in polar coordinates to about 2e-5 of the variances. That is enough for a covariance of noise; the
    response matrix is made with more care.

    Parameters
    ----------
    geometry : Geometry
        Pupil, path, wavelength and sources.
    grid : SliceGrid
        The k slices.
    cn2 : ndarray, (k,)
        Profile, m^(-2/3).
    spectrum : TurbulenceSpectrum
        Spectrum of the refractive index.
    sources : sequence of SourceModel
        Each source, in the order of the geometry.
    centroid_term : bool
        With or without the motion of the centroid by the scintillation of the source's points.

    Returns
    -------
    ndarray, (3 S A, 3 S A)
        Channels by kind (x, y, relative flux), source, subaperture; rad^2, rad and 1.
    """
    kinds, count, size = 3, geometry.n_sources, geometry.n_subapertures
    maps = np.zeros((kinds, count, kinds, count, *geometry.map_shape))
    for z, strength in zip(grid.centres, np.asarray(cn2) * grid.thickness, strict=True):
        if strength:
            maps += strength * _layer(geometry, float(z), spectrum, sources, centroid_term)
    i, j = geometry.subaperture_index.T
    dy, dx = i[:, None] - i + geometry.p - 1, j[:, None] - j + geometry.q - 1
    pairs = maps[..., dy, dx]  # kind, source, kind, source, subaperture, subaperture
    return pairs.transpose(0, 1, 4, 2, 3, 5).reshape(kinds * count * size, -1)


def _layer(
    geometry: Geometry, z: float, spectrum: TurbulenceSpectrum, sources: Sequence[SourceModel], centroid_term: bool
) -> Floats:
    """Covariance maps of a layer with Cn2 dz = 1, (kind, source, kind, source, 2p - 1, 2q - 1)."""
    m, scaling, d = geometry.magnification(z), geometry.scaling(z), geometry.subaperture_size
    fx, fy, weight = _frequencies(geometry, z, sources)
    f = np.hypot(fx, fy)
    weight = weight * scaling**2 * spectrum.psd(scaling * f)
    diffraction = np.pi * geometry.wavelength * z * scaling * f**2
    wavenumber, length = 2 * np.pi / geometry.wavelength, 1.0 if geometry.infinite else geometry.path_length
    aperture = np.sinc(d * fx) * np.sinc(d * fy)
    amplitudes = []
    for source, (x, y) in zip(sources, geometry.positions, strict=True):
        transfer = np.conj(source.transfer(m * fx, m * fy))
        moments = source.moment(m * fx, m * fy)
        centre = [np.real(one[0]) for one in source.moment(np.zeros(1), np.zeros(1))]
        seen = aperture * np.exp(2j * np.pi * m * (fx * x + fy * y))
        for axis, along in enumerate((fx, fy)):
            slope = -2j * np.pi * along * np.cos(diffraction) * transfer
            if centroid_term:
                glint = np.conj(moments[axis]) - centre[axis] * transfer
                slope = slope + 2 * wavenumber / length * np.sin(diffraction) * glint
            amplitudes.append(seen * slope)
        amplitudes.append(seen * 2 * wavenumber * np.sin(diffraction) * transfer)
    kinds, count = 3, geometry.n_sources
    amplitude = np.array(amplitudes).reshape(count, kinds, -1).transpose(1, 0, 2).reshape(kinds * count, -1)
    lag_y, lag_x = (np.arange(1 - n, n) * d for n in (geometry.p, geometry.q))
    waves_y, waves_x = np.exp(2j * np.pi * lag_y[:, None] * fy), np.exp(2j * np.pi * lag_x[:, None] * fx)
    maps = np.empty((kinds * count, kinds * count, *geometry.map_shape))
    for one, first in enumerate(amplitude):
        for two in range(one, kinds * count):
            density = weight * first * np.conj(amplitude[two])
            # The other half of the frequencies holds the complex conjugate.
            maps[one, two] = 2 * ((waves_y * density) @ waves_x.T).real
            maps[two, one] = maps[one, two, ::-1, ::-1]
    return maps.reshape(kinds, count, kinds, count, *geometry.map_shape)


def _frequencies(geometry: Geometry, z: float, sources: Sequence[SourceModel]) -> tuple[Floats, Floats, Floats]:
    """Nodes (fx, fy) in a half circle and their weights, as far as apertures and sources let anything pass."""
    m = geometry.magnification(z)
    end = 4 / geometry.subaperture_size
    trial = np.linspace(0, end, 400)
    passed = [
        np.abs(transform) > 1e-3
        for source in sources
        for transform in (source.transfer(m * trial, 0 * trial), source.transfer(0 * trial, m * trial))
    ]
    end = float(trial[min(len(trial) - 1, np.flatnonzero(np.any(passed, axis=0))[-1] + 1)])
    reach = math.hypot(
        geometry.q * geometry.subaperture_size + m * abs(geometry.separation[0]),
        geometry.p * geometry.subaperture_size + m * abs(geometry.separation[1]),
    )
    bend = 2 * np.pi * geometry.wavelength * z * geometry.scaling(z)
    # Panels in u = f^(1/3), in which f^(-5/3), what slopes have near zero, is no singularity.
    borders = np.concatenate([[0.0], end * 2.0 ** np.arange(-7, 1)])
    radii, weights = [], []
    for a, b in itertools.pairwise(borders.tolist()):
        phase = 2 * np.pi * reach * (b - a) + bend * (b**2 - a**2)
        nodes, rule = np.polynomial.legendre.leggauss(int(8 + 0.55 * phase))
        low, high = np.cbrt(a), np.cbrt(b)
        u = (low + high) / 2 + (high - low) / 2 * nodes
        radii.append(u**3)
        weights.append((high - low) / 2 * rule * 3 * u**2)
    radius, weight = np.concatenate(radii), np.concatenate(weights)
    turn = 2 * np.pi * reach * end
    angles = int(turn + 6 * np.cbrt(turn) + 12) // 2
    angle = np.pi * (np.arange(angles) + 0.5) / angles
    fx, fy = (radius[:, None] * trigonometric for trigonometric in (np.cos(angle), np.sin(angle)))
    return fx.ravel(), fy.ravel(), np.repeat(weight * radius * np.pi / angles, angles)


def convergence_covariance(
    geometry: Geometry,
    turbulence: Floats,
    *,
    effective_frames: Sequence[float] = EFFECTIVE_FRAMES["measured"],
    frames: int = FRAMES,
    detection_noise: Sequence[float] = DETECTION_NOISE,
) -> Floats:
    """Covariance of the convergence noise, as the module says.

    Parameters
    ----------
    geometry : Geometry
        Pupil and sources.
    turbulence : ndarray, (3 S A, 3 S A)
        S_t, from :func:`channel_covariance`.
    effective_frames : sequence of 3 floats
        Effectively independent frames for x slopes, y slopes and fluxes.
    frames : int
        Number N of frames.
    detection_noise : sequence of 3 floats
        Variances of the detection noise of each kind.

    Returns
    -------
    ndarray, (m, m)
        Rows `geometry.independent`.

    Raises
    ------
    ValueError
        There is neither turbulence nor detection noise.
    """
    channels = geometry.n_sources * geometry.n_subapertures
    noise = np.diag(np.repeat(np.asarray(detection_noise, dtype=float), channels))
    if not (turbulence.any() or noise.any()):
        raise ValueError("without turbulence and detection noise there is no convergence noise")
    both = convergence.independent(turbulence + noise, 1, geometry) if noise.any() else 0.0
    if not turbulence.any():
        return np.asarray(both / frames)
    alone = convergence.independent(turbulence, 1, geometry)
    kind = np.empty(len(MAP_KINDS), dtype=int)
    for number in range(3):
        kind[[AUTO_MAP[number], CROSS_MAP[number]]] = number
    block = geometry.independent // (geometry.map_shape[0] * geometry.map_shape[1])
    shrink = 1 / np.sqrt(np.asarray(effective_frames, dtype=float))[kind[block]]
    drawn = alone * shrink * shrink[:, None]
    return np.asarray(drawn + (both - alone) / frames if noise.any() else drawn)


# --- draws ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Setup:
    """Draws of data of one known profile.

    Attributes
    ----------
    name : str
        Which profile.
    truth : ndarray, (k,)
        Cn2, m^(-2/3).
    grid : SliceGrid
        The slices.
    data : ndarray, (draws, n)
        Correlations with convergence noise and the bias of detection noise.
    reduction : Reduction
        Whitening and elimination of unpenalised unknowns.
    """

    name: str
    truth: Floats
    grid: SliceGrid
    data: Floats
    reduction: inversion.Reduction

    @property
    def level(self) -> float:
        """What errors are divided by: the mean of the truth, or of the weak profile where there is nothing."""
        return float(self.truth.mean()) or REFERENCE_LEVEL

    def error(self, cn2: Floats) -> Floats:
        """Root mean square error over the mean of the truth, "MSE" in Sauvage et al. 2021; (...) of (..., k)."""
        return np.asarray(np.sqrt(((cn2 - self.truth) ** 2).mean(axis=-1)) / self.level)


def draw(
    name: str,
    truth: Floats,
    geometry: Geometry,
    grid: SliceGrid,
    matrix: Floats,
    covariance: Floats,
    *,
    draws: int,
    seed: int,
    detection_noise: Sequence[float] = DETECTION_NOISE,
    noise_bias: bool = True,
    slope_offset: bool = True,
) -> Setup:
    """Data of a known profile with drawn convergence noise.

    As in the paper the covariance is diagonalised, here as a correlation matrix: slopes are 1e-8 of fluxes in their
    units and would be lost. White noise is multiplied with the symmetric square root. Draw i of a seed is the same
    however many are drawn, and on every machine but for rounding.

    Parameters
    ----------
    name : str
        Name of the profile.
    truth : ndarray, (k,)
        Profile, m^(-2/3).
    geometry : Geometry
        Pupil and sources.
    grid : SliceGrid
        The slices.
    matrix : ndarray, (n, k)
        Response matrix.
    covariance : ndarray, (m, m)
        C_conv on `geometry.independent`.
    draws : int
        How many.
    seed : int
        Seed.
    detection_noise : sequence of 3 floats
        Variances added to the zero separation of the auto maps of x, y and flux.
    noise_bias, slope_offset : bool
        Unpenalised unknowns of the inversion.

    Returns
    -------
    Setup
    """
    rows = geometry.independent
    deviation = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / deviation / deviation[:, None])
    # The symmetric root is unique: eigenvectors alone change sign, or turn among equals, with the BLAS and its threads.
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    white = np.random.default_rng(seed).standard_normal((draws, len(rows)))
    clean = matrix @ truth
    for kind, variance in enumerate(detection_noise):
        size = geometry.map_shape[0] * geometry.map_shape[1]
        clean[AUTO_MAP[kind] * size + size // 2] += variance
    data = np.tile(clean, (draws, 1))
    data[:, rows] += (white @ root) * deviation
    reduction = inversion.prepare(data, covariance, matrix, rows=rows, noise_bias=noise_bias, slope_offset=slope_offset)
    return Setup(name, np.asarray(truth, dtype=float), grid, data, reduction)


# --- reconstruction ---------------------------------------------------------------------------------------------------


class Coverage(NamedTuple):
    """Shares of draws in which each slice's truth lies within, (k,) each."""

    at_68: Floats
    at_95: Floats


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one prior and one selector make of the draws of a :class:`Setup`.

    Attributes
    ----------
    log_mu_grid : ndarray, (g,)
        log10(mu / m^(4/3)).
    criterion : ndarray, (draws, g)
        Curves that mu was chosen from.
    error_curve : ndarray, (draws, g)
        Error of the MAP profile at every mu.
    log_mu, best_log_mu : ndarray, (draws,)
        Chosen mu, and that of the least error.
    cn2_map, cn2_mean : ndarray, (draws, k)
        MAP profile and posterior mean at the chosen mu, m^(-2/3).
    bar_map, bar_ml : ndarray, (draws, k)
        Standard errors of the linear solution with and without the prior.
    error_map, error_mean, error_best : ndarray, (draws,)
        Errors of the MAP profile, of the posterior mean, and of the MAP profile at the best mu.
    coverage : dict of str to Coverage
        `map`: MAP profile and MAP bars; `ml`: MAP profile and ML bars; `hpd`: highest-density intervals. Bars are
        multiplied by 0.994 and 1.960 for 68 and 95 %.
    """

    log_mu_grid: Floats
    criterion: Floats
    error_curve: Floats
    log_mu: Floats
    best_log_mu: Floats
    cn2_map: Floats
    cn2_mean: Floats
    bar_map: Floats
    bar_ml: Floats
    error_map: Floats
    error_mean: Floats
    error_best: Floats
    coverage: dict[str, Coverage]
    truth: Floats

    @property
    def squared_gap(self) -> float:
        """Mean of the squared difference between chosen and best log mu; 0.76 in Sauvage et al. 2021."""
        return float(np.mean((self.log_mu - self.best_log_mu) ** 2))

    @property
    def bar_empirical(self) -> Floats:
        """Root mean square error of each slice over the draws, (k,): the paper's empirical error bars."""
        return np.asarray(np.sqrt(((self.cn2_map - self.truth) ** 2).mean(axis=0)))


def reconstruct(
    setup: Setup,
    precision: Floats,
    selector: HyperparameterSelector,
    *,
    seed: int = 0,
    draws: int = POSTERIOR_DRAWS,
) -> Outcome:
    """Reconstruct every draw and compare it with the truth.

    Parameters
    ----------
    setup : Setup
        Draws of data.
    precision : ndarray, (k, k)
        R of the prior.
    selector : HyperparameterSelector
        Chooses mu. Where it has an attribute `neighbours`, it is given as many draws before and after each one for
        those of neighbouring batches.
    seed : int
        Seed of the draws from the posterior.
    draws : int
        Draws from each posterior.

    Returns
    -------
    Outcome
    """
    problems = [setup.reduction.problem(one, precision, grid=setup.grid) for one in setup.data]
    reach = int(getattr(selector, "neighbours", 0))
    found: dict[str, list[NDArray[np.float64]]] = {}

    def keep(**values: object) -> None:
        for name, value in values.items():
            found.setdefault(name, []).append(np.asarray(value, dtype=float))

    intervals = []
    for number, problem in enumerate(problems):
        around = (*problems[max(0, number - reach) : number], *problems[number + 1 : number + 1 + reach])
        selection = selector.select(replace(problem, neighbours=around))
        curve = setup.error(inversion.solve_positive(problem, 10.0**selection.log_mu_grid))
        mode = inversion.solve_positive(problem, selection.mu)
        unbounded = np.tile([0.0, np.inf], (problem.k, 1))
        if posterior.proper(problem, selection.mu):
            drawn = posterior.sample(problem, selection.mu, draws=draws, seed=seed + number)
            mean, ends = drawn.mean, (drawn.interval_68, drawn.interval_95)
        else:
            mean, ends = np.full(problem.k, np.nan), (unbounded, unbounded)
        intervals.append(ends)
        keep(
            criterion=selection.criterion,
            error_curve=curve,
            log_mu=selection.log_mu,
            best_log_mu=selection.log_mu_grid[np.argmin(curve)],
            cn2_map=mode,
            cn2_mean=mean,
            bar_map=uncertainty.map_error(problem, selection.mu),
            bar_ml=uncertainty.ml_error(problem),
            error_map=setup.error(mode),
            error_mean=setup.error(mean),
            error_best=curve.min(),
        )
    arrays = {name: np.array(values) for name, values in found.items()}
    away = np.abs(arrays["cn2_map"] - setup.truth)
    coverage = {
        kind: Coverage(*((away <= width * arrays[f"bar_{kind}"]).mean(axis=0) for width in (0.9945, 1.9600)))
        for kind in ("map", "ml")
    }
    ends_of_all = np.array(intervals)  # draws, probability, slices, ends
    inside = (ends_of_all[..., 0] <= setup.truth) & (ends_of_all[..., 1] >= setup.truth)
    coverage["hpd"] = Coverage(*inside.mean(axis=0))
    return Outcome(log_mu_grid=selection.log_mu_grid, coverage=coverage, truth=setup.truth, **arrays)
