"""Whether a batch looks like what the model assumes: Kolmogorov phase, log-normal flux, weak and steady turbulence.

**Zernike variances.** The slopes of a source are fitted with the gradients of the first 20 Zernike polynomials without
piston, radial orders 1 to 5 (Noll 1976, https://doi.org/10.1364/JOSA.66.000207), averaged over the area of each
exploited subaperture. Kolmogorov turbulence gives a coefficient of radial order n the variance

    sigma_n^2 = K (n + 1) Gamma(n - 5/6) / [Gamma(17/6)^2 Gamma(n + 23/6)] (D/r0)^(5/3),                  (1)

with K = 2.2461 from the constants of the Kolmogorov spectrum, as in Sauvage et al. 2021 (arXiv:2111.08003), who
estimate D/r0 from orders 2 to 5. A fit to few slopes does not return these variances: the gradients of all higher modes
are mistaken for those of the fitted ones (aliasing), and the exploited subapertures are not a disc. What Kolmogorov
turbulence leaves in the fitted coefficients is known without simulation, R C R^T with R the fit and C the covariance of
mean phase gradients that follows from the structure function; measured variances are compared with that.

**Log-amplitude.** In weak turbulence the flux is log-normal: chi = ln(i / <i>) / 2 is a Gaussian variable.

**Stationarity.** Variances in thirds of a batch differ by chance, and by how much is known from the convergence noise
of the correlation maps. Slopes are taken relative to their mean over the pupil: the common tilt of a record of minutes
is dominated by a few slow swings, whose variance says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.polynomial import polynomial
from scipy.special import gamma, ndtr

from .correlation import AUTO_MAP
from .products import LOG_AMPLITUDE_STEP, LOG_AMPLITUDES, RADIAL_ORDERS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from .correlation import Correlation
    from .geometry import Geometry

    Floats = NDArray[np.float64]

#: Structure function of Kolmogorov phase in units of (r / r0)^(5/3), 6.88.
STRUCTURE = 2 * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
#: Power spectral density of Kolmogorov phase in units of r0^(-5/3) f^(-11/3), 0.0229.
SPECTRUM = (24 / 5 * gamma(6 / 5)) ** (5 / 6) * gamma(11 / 6) ** 2 / (2 * np.pi ** (11 / 3))
#: K of Eq. (1), 2.2461. Rounding the spectrum to 0.023 instead gives the 2.2698 found in the literature, 1 % more.
NOLL = SPECTRUM * np.pi ** (8 / 3) * 2 ** (-5 / 3) * gamma(14 / 3)
#: First radial order that D/r0 is taken from: tip and tilt hold vibration, wind shake and the finite record.
FIRST_ORDER = 2
#: Largest noise of a coefficient, in units of that of a tilt, with which a radial order is fitted.
WORST_CONDITION = 30.0
#: Nodes of Gauss-Legendre quadrature over the side of a subaperture: 1e-6 of the variance of a slope.
NODES = 24

#: Of this many frames one is looked at where more would be the same again: at a hundred frames per second neighbours
#: hardly differ.
EVERY = 3
#: Largest misfit of the Zernike variances, and largest distance of the log-amplitude from a Gaussian, without a flag.
MISFIT, DISTANCE = 0.35, 0.05
#: Scintillation index up to which perturbations are called weak (Sauvage et al. 2021, Sec. 4.1).
RYTOV = 1.2
#: Change of a variance within a batch that is no longer called steady, if it is more than chance.
UNSTEADY = 0.3
#: Parts of a batch that are compared with each other.
PARTS = 3


# --- Zernike modes ------------------------------------------------------------------------------------------


def kolmogorov_variance(order: int) -> float:
    """Variance of one Zernike coefficient of Kolmogorov turbulence over a disc with D = r0, Eq. (1).

    Parameters
    ----------
    order : int
        Radial order n, 1 or more.

    Returns
    -------
    float
        rad^2 of phase; times (D/r0)^(5/3) for another r0.
    """
    return float(NOLL * (order + 1) * gamma(order - 5 / 6) / (gamma(17 / 6) ** 2 * gamma(order + 23 / 6)))


def zernike(order: int, frequency: int, part: str) -> Floats:
    """A Zernike polynomial in Cartesian coordinates, normalised to unit variance over the unit disc.

    Parameters
    ----------
    order, frequency : int
        Radial order n and azimuthal frequency m, n - m even and not negative.
    part : {"cos", "sin"}
        Dependence on azimuth; "cos" where m = 0.

    Returns
    -------
    ndarray, (n + 1, n + 1)
        Coefficients of x^i y^j.
    """
    # R(rho) e^(i m theta) = sum_s c_s (x^2 + y^2)^((n - m)/2 - s) (x + i y)^m
    total = np.zeros((order + 1, order + 1), dtype=complex)
    for s in range((order - frequency) // 2 + 1):
        power = (order - frequency) // 2 - s
        factor = (-1) ** s * gamma(order - s + 1)
        factor /= gamma(s + 1) * gamma((order + frequency) // 2 - s + 1) * gamma(power + 1)
        term = np.ones((1, 1), dtype=complex)
        for _ in range(power):
            term = _product(term, np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]]))
        for _ in range(frequency):
            term = _product(term, np.array([[0, 1j], [1, 0]]))
        total[: term.shape[0], : term.shape[1]] += factor * term
    norm = np.sqrt(order + 1) * (np.sqrt(2) if frequency else 1.0)
    return np.asarray(norm * (total.real if part == "cos" else total.imag))


def _product(first: NDArray[Any], second: NDArray[Any]) -> NDArray[Any]:
    """Product of two polynomials of x and y."""
    rows, cols = first.shape[0] + second.shape[0] - 1, first.shape[1] + second.shape[1] - 1
    result = np.zeros((rows, cols), dtype=complex)
    for (i, j), value in np.ndenumerate(second):
        result[i : i + first.shape[0], j : j + first.shape[1]] += value * first
    return result


def _modes(orders: Sequence[int]) -> list[tuple[int, Floats]]:
    """Radial order and polynomial of every mode of some radial orders."""
    return [
        (n, zernike(n, m, part))
        for n in orders
        for m in range(n % 2, n + 1, 2)
        for part in (("cos", "sin") if m else ("cos",))
    ]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Least-squares fit of Zernike modes to the slopes of one source.

    Parameters
    ----------
    matrix : ndarray, (J, 2 A)
        Coefficients, rad of phase, from the slopes (all x, then all y), rad.
    order : ndarray of int, (J,)
        Radial order of each mode.
    expected : ndarray, (J,)
        Variance that Kolmogorov turbulence with r0 equal to `diameter` leaves in each coefficient, aliasing
        included; rad^2.
    diameter : float
        Diameter of the disc that the modes are defined on, m.
    """

    matrix: Floats
    order: NDArray[np.int64]
    expected: Floats
    diameter: float


@lru_cache(maxsize=16)
def reconstruction(geometry: Geometry, measured: tuple[bool, ...] | None = None) -> Reconstruction:
    """Fit of as many of the radial orders 1 to 5 as the exploited subapertures can tell apart.

    The disc is centred on the mask, its diameter the mask's larger extent. Subapertures with their centre on it take
    part: in the corners of a square mask Zernike modes grow without bound and would decide the fit. A slope is the mean
    gradient over the subaperture's square, and reaches beyond the disc where the square does.

    Parameters
    ----------
    geometry : Geometry
        Pupil and wavelength.
    measured : tuple of bool, (A,), optional
        Subapertures that deliver slopes; all of them by default.

    Returns
    -------
    Reconstruction
        No mode where not even tip and tilt can be told apart; subapertures without a part have columns of zeros.
    """
    used = np.ones(geometry.n_subapertures, dtype=bool) if measured is None else np.array(measured, dtype=bool)
    index = geometry.subaperture_index
    diameter = float(np.ptp(index, axis=0).max() + 1) * geometry.subaperture_size
    middle = (index.min(axis=0) + index.max(axis=0)) / 2
    used &= np.hypot(*(index - middle).T) * geometry.subaperture_size <= diameter / 2 * (1 + 1e-9)
    place = (index - middle)[used][:, ::-1] * geometry.subaperture_size
    modes = _modes(RADIAL_ORDERS)
    order = np.array([n for n, _ in modes])
    gradients = np.stack([_mean_gradient(p, place, geometry.subaperture_size, diameter / 2) for _, p in modes], axis=1)
    covariance = _gradient_covariance(index[used], geometry.subaperture_size) * diameter ** (-5 / 3)
    fit: Floats = np.zeros((0, len(gradients)))
    for last in RADIAL_ORDERS:
        some = gradients[:, order <= last]
        # As many slopes as modes would fit anything.
        if some.shape[1] > 0.75 * some.shape[0] or np.linalg.matrix_rank(some, rtol=1e-6) < some.shape[1]:
            break
        trial: Floats = np.asarray(np.linalg.pinv(some), dtype=np.float64)
        if np.linalg.norm(trial, axis=1).max() > WORST_CONDITION * np.linalg.norm(trial, axis=1)[:2].max():
            break
        fit = trial
    expected = np.einsum("ij,jk,ik->i", fit, covariance, fit)
    matrix = np.zeros((len(fit), 2 * used.size))
    matrix[:, np.tile(used, 2)] = fit * (2 * np.pi / geometry.wavelength)
    return Reconstruction(matrix, order[: len(fit)], expected, diameter)


def _mean_gradient(coefficients: Floats, place: Floats, side: float, radius: float) -> Floats:
    """Mean gradient (all x, then all y) of a mode over squares at `place` (A, 2), 1/m."""
    nodes, weights = np.polynomial.legendre.leggauss(4)  # exact: gradients have degree 4
    x = (place[:, 0, None, None] + side / 2 * nodes[:, None]) / radius
    y = (place[:, 1, None, None] + side / 2 * nodes) / radius
    x, y = np.broadcast_arrays(x, y)
    area = np.outer(weights, weights) / 4
    along = [polynomial.polyval2d(x, y, polynomial.polyder(coefficients, axis=axis)) for axis in range(2)]
    return np.concatenate([(values * area).sum(axis=(1, 2)) for values in along]) / radius


def _gradient_covariance(index: NDArray[np.int64], side: float) -> Floats:
    """Covariance of the mean phase gradients (all x, then all y) over squares, Kolmogorov turbulence with r0 = 1 m.

    The mean gradient along x is the difference of the mean phases of two opposite sides of the square; the covariance
    of phase differences is a sum of structure functions, <(A-B)(C-D)> = [D_AD + D_BC - D_AC - D_BD] / 2.

    Returns
    -------
    ndarray, (2 A, 2 A)
        rad^2 / m^2.
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    half, part = (nodes + 1) / 2, weights / 2  # on [0, 1]

    def structure(x: Any, y: Any) -> Any:
        return STRUCTURE * np.hypot(x, y) ** (5 / 3)

    # Differences of two points on parallel sides are distributed as a triangle.
    u = np.concatenate([-half[::-1], half])
    triangle = np.concatenate([part[::-1], part]) * (1 - np.abs(u))
    across = np.multiply.outer(part, part)
    row, col = index.T
    lags, where = np.unique(
        np.stack([(col[:, None] - col).ravel(), (row[:, None] - row).ravel()]), axis=1, return_inverse=True
    )
    table = np.empty((3, lags.shape[1]))
    for number, (dx, dy) in enumerate(lags.T):
        for kind, (along, other) in enumerate(((dx, dy), (dy, dx))):
            differences = structure(along + 1, other + u) + structure(along - 1, other + u)
            differences -= 2 * structure(along, other + u)
            table[kind, number] = (differences * triangle).sum() / 2
        total = 0.0
        for one, two, sign in ((0.5, -0.5, 1), (-0.5, 0.5, 1), (0.5, 0.5, -1), (-0.5, -0.5, -1)):
            x, y = dx + one - (half[:, None] - 0.5), dy + (half - 0.5) - two
            total += sign * float((structure(x, y) * across).sum())
        table[2, number] = total / 2
    table *= side ** (5 / 3 - 2)
    xx, yy, xy = table[:, where.ravel()].reshape(3, len(index), len(index))
    # The covariance of x here and y there depends on the lag alone, and is even in it.
    return np.block([[xx, xy], [xy, yy]])


class ZernikeCheck(NamedTuple):
    """Zernike variances of each source against Kolmogorov's.

    Attributes
    ----------
    variance : ndarray, (S, 5)
        Variance of a coefficient, mean over each radial order, detection noise removed; rad^2 of phase; NaN for
        orders that cannot be fitted.
    kolmogorov : ndarray, (S, 5)
        The same of Kolmogorov turbulence with `r0`, aliasing included.
    r0 : ndarray, (S,)
        Fried parameter from orders 2 and above, m; NaN where their mean variance is not positive.
    misfit : ndarray, (S,)
        Root mean square over these orders of ln(variance / kolmogorov).
    """

    variance: Floats
    kolmogorov: Floats
    r0: Floats
    misfit: Floats


def zernike_check(found: Correlation, slope_noise: Floats, geometry: Geometry) -> ZernikeCheck:
    """Zernike variances, and r0 from them as Sauvage et al. 2021 but for the aliasing.

    Each order gives one estimate of (D/r0)^(5/3), its measured variance over that of D = r0, and the mean of the
    estimates counts. The slopes are those of an extended source: turbulence near it is averaged over its image and
    hardly seen, so that this r0 is larger than that of a point source.

    Parameters
    ----------
    found : Correlation
        Covariance of the slopes.
    slope_noise : ndarray, (2, S, A)
        Variance of the slopes by detection noise, rad^2; NaN where unknown, counted as none.
    geometry : Geometry
        Pupil and wavelength.

    Returns
    -------
    ZernikeCheck
    """
    sources, subapertures = geometry.n_sources, geometry.n_subapertures
    shape = (3, sources, subapertures, 3, sources, subapertures)
    covariance = found.covariance.reshape(shape)
    variance = np.full((sources, len(RADIAL_ORDERS)), np.nan)
    model, r0, misfit = variance.copy(), np.full(sources, np.nan), np.full(sources, np.nan)
    for source in range(sources):
        own = covariance[:2, source, :, :2, source, :]
        seen = np.isfinite(np.einsum("iaia->ia", own)).all(axis=0)
        fit = reconstruction(geometry, None if seen.all() else tuple(seen.tolist()))
        matrix = fit.matrix.reshape(-1, 2, subapertures)
        clean = np.nan_to_num(own)
        noise = np.nan_to_num(slope_noise[:, source])
        each = np.einsum("jia,iakb,jkb->j", matrix, clean, matrix, optimize=True)
        each -= np.einsum("jia,ia->j", matrix**2, noise)
        for number, order in enumerate(RADIAL_ORDERS):
            modes = fit.order == order
            if modes.any():
                variance[source, number] = each[modes].mean()
                model[source, number] = fit.expected[modes].mean()
        high = np.array(RADIAL_ORDERS) >= FIRST_ORDER
        estimates = variance[source, high] / model[source, high]
        estimates = estimates[np.isfinite(estimates)]
        strength = float(estimates.mean()) if estimates.size else np.nan
        model[source] *= strength
        if strength > 0:
            r0[source] = fit.diameter * strength ** (-3 / 5)
        if estimates.size and (estimates > 0).all():
            misfit[source] = np.sqrt(np.mean(np.log(estimates / strength) ** 2))
    return ZernikeCheck(variance, model, r0, misfit)


# --- log-amplitude ------------------------------------------------------------------------------------------


class LogAmplitude(NamedTuple):
    """Distribution of the log-amplitude of each source.

    Attributes
    ----------
    histogram : ndarray of int64, (S, bins)
        Samples in each bin of `LOG_AMPLITUDES`; the outermost hold everything beyond them too.
    mean, deviation : ndarray, (S,)
        Of the Gaussian that fits best (largest likelihood). In weak turbulence the mean is minus the variance, for
        the mean flux to be one.
    distance : ndarray, (S,)
        Largest difference between the cumulative distributions of samples and Gaussian.
    """

    histogram: NDArray[np.int64]
    mean: Floats
    deviation: Floats
    distance: Floats


def log_amplitude(flux: NDArray[np.floating], mean_flux: Floats) -> LogAmplitude:
    """Histogram of chi = ln(i / <i>) / 2 over all subapertures and every third frame, with a Gaussian fit.

    Parameters
    ----------
    flux : ndarray, (T, S, A)
        Fluxes, counts; NaN where not measured. Fluxes of zero and less have no logarithm and are left out.
    mean_flux : ndarray, (S, A)
        Mean flux of each spot.

    Returns
    -------
    LogAmplitude
        NaN and zeros for a source without light.
    """
    sources = flux.shape[1]
    count = np.zeros((sources, len(LOG_AMPLITUDES)), dtype=np.int64)
    mean, deviation, distance = (np.full(sources, np.nan) for _ in range(3))
    lower = LOG_AMPLITUDES[0] - LOG_AMPLITUDE_STEP / 2
    borders = LOG_AMPLITUDES[:-1] + LOG_AMPLITUDE_STEP / 2
    for source in range(sources):
        relative = flux[::EVERY, source] / np.where(mean_flux[source] > 0, mean_flux[source], np.nan)
        relative = relative[relative > 0]
        if relative.size < 2:
            continue
        chi = np.log(relative) / 2
        mean[source], deviation[source] = chi.mean(), chi.std()
        bins = np.clip((chi - lower) / LOG_AMPLITUDE_STEP, 0, len(LOG_AMPLITUDES) - 1).astype(np.int64)
        count[source] = np.bincount(bins, minlength=len(LOG_AMPLITUDES))
        if deviation[source] > 0:
            below = np.cumsum(count[source])[:-1] / chi.size
            distance[source] = np.abs(below - ndtr((borders - mean[source]) / deviation[source])).max()
    return LogAmplitude(count, mean, deviation, distance)


# --- stationarity -------------------------------------------------------------------------------------------


class Stationarity(NamedTuple):
    """Variances of the parts of a batch against that of the whole.

    Attributes
    ----------
    deviation : ndarray, (3,)
        Largest deviation of a third from the batch, relative; for x slopes, y slopes (both relative to the pupil's
        mean) and flux.
    error : ndarray, (3,)
        What the number of effectively independent frames leads one to expect of a single third, 1 sigma.
    """

    deviation: Floats
    error: Floats


def stationarity(
    slopes: NDArray[np.floating],
    flux: NDArray[np.floating],
    found: Correlation,
    noise_covariance: Floats,
    geometry: Geometry,
) -> Stationarity:
    """Variances in the thirds of a batch, from every third frame.

    Parameters
    ----------
    slopes : ndarray, (T, 2, S, A)
        Slopes, rad; NaN where not measured.
    flux : ndarray, (T, S, A)
        Fluxes, counts.
    found : Correlation
        Means and maps of the whole batch.
    noise_covariance : ndarray, (m, m)
        Convergence noise of the rows `geometry.independent` of the maps.
    geometry : Geometry
        Pupil and sources.

    Returns
    -------
    Stationarity
        NaN where a third holds no measurement.
    """
    some = slopes[::EVERY] - found.mean_slope
    relative = flux[::EVERY] / found.mean_flux - 1
    values: Any
    parts = np.full((PARTS, 3), np.nan)
    complete = bool(np.isfinite(some.sum()) and np.isfinite(relative.sum()))
    mean: Any = np.mean if complete else _mean
    cuts = np.linspace(0, len(some), PARTS + 1).astype(int)
    for part in range(PARTS):
        piece = slice(cuts[part], cuts[part + 1])
        if complete:
            tilt = some[piece].sum(axis=-1) / some.shape[-1]
        else:
            tilt = _mean(some[piece], axis=-1)
        for axis in range(2):
            values = some[piece, axis]
            parts[part, axis] = mean(values**2) - mean(tilt[:, axis] ** 2)
        parts[part, 2] = mean(relative[piece] ** 2)
    whole = parts.mean(axis=0)
    error = np.full(3, np.nan)
    p, q = geometry.map_shape
    entries, centre = p * q, (p * q) // 2
    for kind in range(3):
        weight = np.zeros(6 * entries)
        block = AUTO_MAP[kind] * entries
        weight[block + centre] = 1.0
        if kind < 2:
            # The mean over the pupil has the mean of the map over all pairs as its variance.
            pairs = found.pair_count[AUTO_MAP[kind]].ravel()
            weight[block : block + entries] -= pairs / max(pairs.sum(), 1)
        rows = np.bincount(geometry.mirror, weight, weight.size)[geometry.independent]
        kept = rows != 0
        variance = rows[kept] @ noise_covariance[np.ix_(kept, kept)] @ rows[kept]
        # A part has PARTS times the variance of the whole, and is a part of it.
        error[kind] = np.sqrt(max(variance, 0.0) * (PARTS - 1)) if np.isfinite(variance) else np.nan
    with np.errstate(invalid="ignore", divide="ignore"):
        return Stationarity(np.abs(parts / whole - 1).max(axis=0), error / whole)


def _mean(values: NDArray[np.floating], axis: int | None = None) -> Any:
    """Mean of what is finite, NaN where nothing is."""
    finite = np.isfinite(values)
    total = np.where(finite, values, 0.0).sum(axis=axis)
    count = finite.sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
