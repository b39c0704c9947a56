"""The posterior of the profile under a Gaussian prior held positive: draws, intervals, and its evidence.

With data ``||T x - c||^2`` and prior ``mu x^T R x`` the posterior is a Gaussian of precision ``H = T^T T +
mu R`` cut off at ``x >= 0``. Its mean and intervals describe what the data say of a quantity that cannot be
negative, which the error bars of the linear solution do not: far from the pupil these are dominated by
values below zero.

*Draws.* Drawing one slice after the other from its conditional distribution does not move: neighbouring
slices far from the pupil are told apart so badly that only their sum is known, and each is then pinned by
the other (autocorrelation of several hundred sweeps for twelve slices). Any fixed direction v can be drawn
along just as exactly, x + t v having a truncated normal distribution in t, so a sweep also visits the
direction of least curvature of every contiguous range of slices, 66 of them for twelve slices, which trade
neighbours against each other at all scales while few bounds stop them, and the eigenvectors of H. Sweeps are
then nearly independent of each other. All directions are fixed beforehand, so each step leaves the posterior
unchanged.

*Evidence.* The integral of the truncated Gaussian has no closed form beyond three slices. Expectation
propagation (Minka 2001; Cunningham, Hennig & Lacoste-Julien 2011, arXiv:1111.6832) replaces each bound x_i
>= 0 by the Gaussian factor that gives x_i the same mean and variance; the result is smooth in mu and takes a
millisecond, where sequential importance sampling (Genz 1992) needs tens of thousands of points and still
fails in weak turbulence, when the linear solution lies far outside the positive region.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy import special

if TYPE_CHECKING:
    from .inversion import LinearProblem

Floats: TypeAlias = NDArray[np.float64]

N_DRAWS = 8192
"""Sweeps kept."""
N_WARM_UP = 256
"""Sweeps dropped at the start, which is the MAP solution."""

IMPROPER = 1e-13
"""Least eigenvalue of the unit-diagonal precision, times 1 / k, that is told from zero."""

SLACK = 0.02
"""Relative excess length within which an interval counts as the shortest: what the draws can tell."""


# --- draws ------------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _truncated_normal(rng: np.random.Generator, low: float, high: float) -> float:
    """Standard normal variate in [low, high] by rejection (Robert 1995, https://doi.org/10.1007/BF00143942)."""
    # Not by calling itself: numba crashes on recursive functions that it loads from its cache (numba issue 6061).
    sign = 1.0
    if high < -0.5:
        sign, low, high = -1.0, -high, -low
    if low > 0.5:
        rate = 0.5 * (low + math.sqrt(low * low + 4.0))
        span = high - low
        if span * rate < 0.7:
            while True:
                x = low + span * rng.random()
                if rng.random() <= math.exp(0.5 * (low * low - x * x)):
                    return sign * x
        kept = 1.0 - math.exp(-rate * span)
        while True:
            x = low - math.log(1.0 - rng.random() * kept) / rate
            if x <= high and rng.random() <= math.exp(-0.5 * (x - rate) ** 2):
                return sign * x
    if high - low < 1.5:
        nearest = 0.0 if low < 0.0 < high else min(abs(low), abs(high))
        while True:
            x = low + (high - low) * rng.random()
            if rng.random() <= math.exp(0.5 * (nearest * nearest - x * x)):
                return x
    while True:
        x = rng.standard_normal()
        if low <= x <= high:
            return x


@njit(cache=True, nogil=True)
def _sweeps(
    rng: np.random.Generator,
    precision: Floats,
    shift: Floats,
    directions: Floats,
    start: Floats,
    warm_up: int,
    draws: Floats,
) -> None:
    """Fill `draws` (n, k) with sweeps over coordinates and directions of exp(-x^T H x / 2 + h^T x), x >= 0."""
    k = shift.size
    x = start.copy()
    gradient = shift - precision @ x
    images = directions @ precision
    curvature = np.empty(len(directions))
    for r in range(len(directions)):
        curvature[r] = directions[r] @ images[r]
    for sweep in range(-warm_up, len(draws)):
        for i in range(k):
            spread = 1.0 / math.sqrt(precision[i, i])
            mean = x[i] + gradient[i] / precision[i, i]
            step = mean + spread * _truncated_normal(rng, -mean / spread, np.inf) - x[i]
            x[i] += step
            for j in range(k):
                gradient[j] -= precision[j, i] * step
        for r in range(len(directions)):
            low, high, slope = -np.inf, np.inf, 0.0
            for i in range(k):
                v = directions[r, i]
                slope += v * gradient[i]
                if v > 0:
                    low = max(low, -x[i] / v)
                elif v < 0:
                    high = min(high, -x[i] / v)
            if not high > low:
                continue
            spread = 1.0 / math.sqrt(curvature[r])
            mean = slope / curvature[r]
            step = mean + spread * _truncated_normal(rng, (low - mean) / spread, (high - mean) / spread)
            for i in range(k):
                x[i] = max(x[i] + step * directions[r, i], 0.0)
                gradient[i] -= step * images[r, i]
        if sweep >= 0:
            draws[sweep] = x
        if sweep % 64 == 0:
            # Rounding and the cut at zero leave the running gradient slightly behind.
            gradient[:] = shift - precision @ x


def _scaled_system(problem: LinearProblem, mu: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Precision of unit diagonal, linear term and scale D of x = D t, for each mu; (..., k, k), (..., k),
    (..., k).
    """
    triangle, target, _ = problem.triangle
    precision = triangle.T @ triangle + np.asarray(mu, dtype=float)[..., None, None] * problem.precision
    diagonal = np.diagonal(precision, axis1=-2, axis2=-1)
    with np.errstate(divide="ignore"):
        scale = np.where(diagonal > 0, 1 / np.sqrt(diagonal), 1.0)
    return precision * scale[..., :, None] * scale[..., None, :], (triangle.T @ target) * scale, scale


def _directions(precision: Floats) -> Floats:
    """Softest direction of every contiguous range of slices, and all eigenvectors; (r, k)."""
    k = len(precision)
    found = [*np.linalg.eigh(precision)[1].T[1:]]
    for i in range(k):
        for j in range(i + 2, k + 1):
            direction = np.zeros(k)
            direction[i:j] = np.linalg.eigh(precision[i:j, i:j])[1][:, 0]
            found.append(direction)
    return np.array(found).reshape(-1, k)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws from the positive posterior and what they say.

    Attributes
    ----------
    draws : ndarray, (n, k)
        Profiles, m^(-2/3).
    mean, deviation : ndarray, (k,)
        Posterior mean and standard deviation, m^(-2/3).
    interval_68, interval_95 : ndarray, (k, 2)
        Highest-density intervals, m^(-2/3).
    autocorrelation : ndarray, (k,)
        Integrated autocorrelation time in sweeps; 1 for independent draws. The error of `mean` that comes
        from drawing is ``deviation * sqrt(autocorrelation / n)``.
    """

    draws: Floats
    mean: Floats
    deviation: Floats
    interval_68: Floats
    interval_95: Floats
    autocorrelation: Floats


def proper(problem: LinearProblem, mu: float) -> bool:
    """Whether data and prior together bound every combination of slices.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    mu : float
        Hyper-parameter, m^(4/3), >= 0.

    Returns
    -------
    bool
    """
    precision, _, _ = _scaled_system(problem, float(mu))
    return bool(np.linalg.eigvalsh(precision)[0] >= IMPROPER * problem.k)


def sample(problem: LinearProblem, mu: float, *, draws: int = N_DRAWS, seed: int = 0) -> Posterior:
    """Draw profiles from the posterior truncated to x >= 0.

    The same problem and seed give the same draws. The stream of random numbers does not depend on the
    problem, so that rounding in the data changes the result by as little.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    mu : float
        Hyper-parameter, m^(4/3), >= 0.
    draws : int
        Number of draws.
    seed : int
        Seed; a different one for each batch makes their sampling errors independent.

    Returns
    -------
    Posterior

    Raises
    ------
    ValueError
        If some combination of slices is bounded neither by the data nor by the prior, which leaves no
        distribution to draw from.
    """
    from .inversion import solve_positive

    precision, shift, scale = _scaled_system(problem, float(mu))
    if not proper(problem, mu):
        raise ValueError("neither the data nor the prior bound the profile: there is no posterior to draw from")
    found = np.empty((draws, problem.k))
    start = np.asarray(solve_positive(problem, mu)) / scale
    rng = np.random.Generator(np.random.SFC64(seed))
    _sweeps(rng, precision, shift, _directions(precision), start, N_WARM_UP, found)
    found *= scale
    return Posterior(
        draws=found,
        mean=found.mean(axis=0),
        deviation=found.std(axis=0),
        interval_68=highest_density_interval(found, 0.68),
        interval_95=highest_density_interval(found, 0.95),
        autocorrelation=autocorrelation_time(found),
    )


def highest_density_interval(draws: Floats, probability: float) -> Floats:
    """Shortest intervals that hold a given share of draws of non-negative quantities.

    Marginals of a truncated Gaussian are log-concave, so the region of highest density is an interval, and
    one that begins at exactly 0 where the density falls from there. The shortest interval of a finite number
    of draws is ill defined within some percent of its length; the middle of all that are longer by no more
    than 2 % is taken, or 0 as lower end if it is among them.

    Parameters
    ----------
    draws : ndarray, (n, ...)
        Draws of one or several quantities, >= 0.
    probability : float
        Share of the draws, between 0 and 1.

    Returns
    -------
    ndarray, (..., 2)
        Lower and upper ends.

    Raises
    ------
    ValueError
        If the probability is not between 0 and 1, or there are fewer than 100 draws.
    """
    n = len(draws)
    if not 0 < probability < 1:
        raise ValueError(f"probability {probability:g} is not between 0 and 1")
    if n < 100:
        raise ValueError(f"{n} draws are too few for an interval; at least 100 are needed")
    ordered = np.sort(draws.reshape(n, -1), axis=0)
    inside = math.ceil(probability * n)
    # The lowest draw stands for zero: between them lies 1 / n of the probability.
    low = np.concatenate([np.zeros((1, ordered.shape[1])), ordered[: n - inside]])
    high = ordered[inside - 1 :]
    length = high - low
    intervals = np.empty((ordered.shape[1], 2))
    for column in range(ordered.shape[1]):
        short = np.flatnonzero(length[:, column] <= (1 + SLACK) * length[:, column].min())
        chosen = 0 if short[0] <= 1 else (short[0] + short[-1]) // 2
        intervals[column] = low[chosen, column], high[chosen, column]
    return intervals.reshape(*draws.shape[1:], 2)


def autocorrelation_time(draws: Floats) -> Floats:
    """Integrated autocorrelation time, 1 + 2 sum of the autocorrelation, in a window of five times itself.

    Sokal 1997, https://doi.org/10.1007/978-1-4899-0319-8_6, section 3.

    Parameters
    ----------
    draws : ndarray, (n, k)
        Consecutive draws.

    Returns
    -------
    ndarray, (k,)
        In draws, >= 1 for chains that do not alternate; NaN where nothing varies.
    """
    n = len(draws)
    deviation = draws - draws.mean(axis=0)
    power = np.abs(np.fft.rfft(deviation, 2 * n, axis=0)) ** 2
    correlation = np.fft.irfft(power, axis=0)[:n]
    with np.errstate(invalid="ignore", divide="ignore"):
        times = 2 * np.cumsum(correlation / correlation[0], axis=0) - 1
    window = np.argmax(np.arange(n)[:, None] >= 5 * times, axis=0)
    return np.asarray(np.take_along_axis(times, window[None], axis=0)[0])


# --- evidence ---------------------------------------------------------------------------------------------------------


def _truncated_moments(z: Floats) -> tuple[Floats, Floats, Floats]:
    """Log probability, mean and variance of N(z, 1) cut off at zero."""
    log_probability = special.log_ndtr(z)
    ratio = np.exp(-0.5 * z**2 - log_probability) / math.sqrt(2 * math.pi)
    mean = z + ratio
    variance = 1 - ratio * mean
    # Deep in the tail both are differences of nearly equal numbers; their series in 1 / z^2 take over.
    tail = z < -50
    inverse = np.where(tail, -1 / np.where(tail, z, -1.0), 0.0)
    mean = np.where(tail, inverse * (1 - 2 * inverse**2), mean)
    variance = np.where(tail, inverse**2 * (1 - 6 * inverse**2), variance)
    return log_probability, mean, variance


def log_positive_integral(precision: Floats, shift: Floats) -> Floats:
    """Log of the integral of exp(-x^T H x / 2 + h^T x) over x >= 0, by expectation propagation.

    Parameters
    ----------
    precision : ndarray, (..., k, k)
        H, positive definite, diagonal near 1.
    shift : ndarray, (..., k)
        h.

    Returns
    -------
    ndarray, (...)
        Within 0.1 for the problems at hand, of values that range over hundreds; NaN where the iteration does
        not settle.
    """
    k = shift.shape[-1]
    diagonal = np.arange(k)
    tau, nu = np.zeros_like(shift), np.zeros_like(shift)
    settled = np.zeros(shift.shape[:-1], dtype=bool)
    for _ in range(1000):
        joined = precision.copy()
        joined[..., diagonal, diagonal] += tau
        covariance = np.linalg.inv(joined)
        mean = (covariance @ (shift + nu)[..., None])[..., 0]
        variance = np.diagonal(covariance, axis1=-2, axis2=-1)
        # Leave one bound out, put the exact one in, and match mean and variance.
        cavity_precision = 1 / variance - tau
        cavity_mean = (mean / variance - nu) / cavity_precision
        root = np.sqrt(cavity_precision)
        log_probability, tilted_mean, tilted_variance = _truncated_moments(cavity_mean * root)
        new_tau = np.maximum(cavity_precision * (1 / tilted_variance - 1), 0.0)
        new_nu = root * tilted_mean / tilted_variance - cavity_mean * cavity_precision
        settled = np.abs(tilted_mean / root - mean).max(axis=-1) < 1e-9 * (1 + np.abs(mean).max(axis=-1))
        if settled.all():
            break
        tau, nu = tau + 0.8 * (new_tau - tau), nu + 0.8 * (new_nu - nu)
    # Normalisation of each factor: exact integral against the bound over integral against its Gaussian.
    sites = (
        log_probability
        + 0.5 * np.log1p(tau / cavity_precision)
        + 0.5 * (cavity_mean**2 * tau - 2 * cavity_mean * nu - nu**2 / cavity_precision) / (1 + tau / cavity_precision)
    ).sum(axis=-1)
    gaussian = 0.5 * (k * math.log(2 * math.pi) - np.linalg.slogdet(joined)[1] + ((shift + nu) * mean).sum(axis=-1))
    return np.asarray(np.where(settled, gaussian + sites, np.nan))


def positive_evidence(problem: LinearProblem, log_mu: ArrayLike) -> Floats:
    """-2 log of the marginal likelihood of the data when the prior is held positive, up to a constant.

    The Gaussian prior of precision mu R, cut off at x >= 0 and normalised there. The probability it has
    there before the cut does not depend on mu, which only scales x; with an R that leaves directions free it
    is part of the constant.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    log_mu : array_like, (...)
        log10(mu / m^(4/3)).

    Returns
    -------
    ndarray, (...)
        NaN where the posterior is improper or the integral is not found.
    """
    grid = np.asarray(log_mu, dtype=float)
    precision, shift, scale = _scaled_system(problem, 10.0**grid)
    rank = len(problem.factor)
    bounded = np.linalg.eigvalsh(precision)[..., 0] >= IMPROPER * problem.k
    values = np.full(grid.shape, np.nan)
    if bounded.any():
        integral = log_positive_integral(precision[bounded], shift[bounded]) + np.log(scale[bounded]).sum(axis=-1)
        _, target, misfit = problem.triangle
        values[bounded] = misfit + target @ target - 2 * integral - rank * math.log(10) * grid[bounded]
    return values
