"""How two instruments that measured the same thing compare: ratio, bias, regression, scatter and what it should be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .timeseries import Means, Times

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Line:
    """A straight line y = intercept + slope x.

    Parameters
    ----------
    intercept, slope : float
        The line.
    intercept_error, slope_error : float
        Their standard errors.
    chi2 : float
        Sum of the squared, weighted residuals.
    """

    intercept: float
    slope: float
    intercept_error: float
    slope_error: float
    chi2: float


def fit_line(x: Array, y: Array, x_error: Array, y_error: Array) -> Line:
    """Line through points with errors in both coordinates.

    York et al. (2004, American Journal of Physics 72, 367), without correlation of the two
    errors of a point.

    Parameters
    ----------
    x, y, x_error, y_error : ndarray of float, (n,)
        Points and their standard errors, of which one may be zero, not both.

    Returns
    -------
    Line
        NaN with fewer than two points, or points at one x.
    """
    nan = float("nan")
    if x.size < 2 or np.ptp(x) == 0:
        return Line(nan, nan, nan, nan, nan)
    vx, vy = x_error**2, y_error**2
    slope = float(np.sign(np.cov(x, y)[0, 1]) * np.std(y) / np.std(x)) or 1.0
    for _ in range(200):
        w = 1 / (vy + slope**2 * vx)
        mean_x, mean_y = w @ x / w.sum(), w @ y / w.sum()
        u, v = x - mean_x, y - mean_y
        b = w * (u * vy + slope * v * vx)
        following = float((w * b) @ v / ((w * b) @ u))
        done = abs(following - slope) <= 1e-14 * abs(following)
        slope = following
        if done or not np.isfinite(slope):
            break
    adjusted = mean_x + b
    centre = w @ adjusted / w.sum()
    variance = 1 / (w @ (adjusted - centre) ** 2)
    intercept = float(mean_y - slope * mean_x)
    return Line(
        intercept,
        slope,
        float(np.sqrt(1 / w.sum() + centre**2 * variance)),
        float(np.sqrt(variance)),
        float(w @ (y - slope * x - intercept) ** 2),
    )


@dataclass(frozen=True)
class Comparison:
    """How one series of Cn2 compares with another; NaN where there are too few values.

    Parameters
    ----------
    count : int
        Windows in which both have a positive value.
    ratio, ratio_error : float
        Geometric mean of ours over theirs, and its standard error from the scatter.
    bias, bias_error : float
        Mean of ours minus theirs, m^(-2/3), and its standard error.
    slope, slope_error : float
        Line of log10 ours over log10 theirs, errors in both.
    offset : float
        log10 of ours where theirs is at its geometric mean, minus that: the line without its leverage.
    correlation : float
        Correlation of the logarithms.
    scatter : float
        Standard deviation of ln(ours / theirs).
    expected_scatter : float
        The same if nothing but the errors of both made it.
    """

    count: int
    ratio: float = float("nan")
    ratio_error: float = float("nan")
    bias: float = float("nan")
    bias_error: float = float("nan")
    slope: float = float("nan")
    slope_error: float = float("nan")
    offset: float = float("nan")
    correlation: float = float("nan")
    scatter: float = float("nan")
    expected_scatter: float = float("nan")


def compare(ours: Array, ours_error: Array, theirs: Array, theirs_error: Array) -> Comparison:
    """Compare two series of Cn2 on one time base.

    Parameters
    ----------
    ours, theirs : ndarray of float, (n,)
        Cn2, m^(-2/3); NaN where there is none.
    ours_error, theirs_error : ndarray of float, (n,)
        Standard errors; NaN counts as unknown and adds nothing to the expected scatter.

    Returns
    -------
    Comparison
    """
    with np.errstate(invalid="ignore"):
        both = (ours > 0) & (theirs > 0) & np.isfinite(ours) & np.isfinite(theirs)
    a, b = ours[both], theirs[both]
    n = int(both.sum())
    if n == 0:
        return Comparison(0)
    ea, eb = (
        np.nan_to_num(error[both], nan=0.0, posinf=0.0) / value for error, value in ((ours_error, a), (theirs_error, b))
    )
    log = np.log(a / b)
    ratio = float(np.exp(log.mean()))
    expected = float(np.sqrt(np.mean(ea**2 + eb**2)))
    if n == 1:
        return Comparison(1, ratio, ratio * expected or float("nan"), float(a[0] - b[0]), expected_scatter=expected)
    scatter = float(log.std(ddof=1))
    x, y = np.log10(b), np.log10(a)
    floor = 1e-12 if (ea**2 + eb**2 > 0).all() else max(expected, 1e-3)  # points without any error count alike
    line = fit_line(x, y, np.hypot(eb, floor) / np.log(10), np.hypot(ea, floor) / np.log(10))
    spread = np.std(x) * np.std(y)
    return Comparison(
        count=n,
        ratio=ratio,
        ratio_error=ratio * scatter / np.sqrt(n),
        bias=float(np.mean(a - b)),
        bias_error=float(np.std(a - b, ddof=1) / np.sqrt(n)),
        slope=line.slope,
        slope_error=line.slope_error,
        offset=line.intercept + (line.slope - 1) * float(x.mean()),
        correlation=float(np.mean((x - x.mean()) * (y - y.mean())) / spread) if spread > 0 else float("nan"),
        scatter=scatter,
        expected_scatter=expected,
    )


@dataclass(frozen=True)
class Separation:
    """How far the paths of two instruments are apart.

    Parameters
    ----------
    lateral : float
        Lateral distance, m, positive to the right of who looks from the pupil to the sources.
    vertical : float
        Mean height of the other above ours, as it weights the path, m; NaN if unknown.
    carried : bool
        Whether ours was carried to the height of the other.
    """

    lateral: float = 0.0
    vertical: float = float("nan")
    carried: bool = False

    def text(self) -> str:
        """In words; `-` where the other is on our path, as far as is known."""
        parts = []
        if self.lateral:
            parts.append(f"{abs(self.lateral):.4g} m {'right' if self.lateral > 0 else 'left'}")
        if np.isfinite(self.vertical):
            parts.append(f"{abs(self.vertical):.1f} m {'below' if self.vertical < 0 else 'above'}")
        if self.carried:
            parts.append("carried as h^(-4/3)")
        return ", ".join(parts) or "-"


@dataclass(frozen=True, eq=False)
class Pair:
    """Two series of Cn2 on one time base.

    Parameters
    ----------
    name : str
        Name of the other instrument.
    bounds : ndarray of int64, (n, 2)
        Windows, ns since 1970 UTC.
    ours, ours_error, theirs, theirs_error : ndarray of float, (n,)
        Cn2 of profiles as the instrument weights it, its own, and standard errors, m^(-2/3).
    separation : Separation
        Of the instrument from the line of sight.
    """

    name: str
    bounds: Times
    ours: Array
    ours_error: Array
    theirs: Array
    theirs_error: Array
    separation: Separation = Separation()

    def comparison(self) -> Comparison:
        """How they compare."""
        return compare(self.ours, self.ours_error, self.theirs, self.theirs_error)


def emulate(cn2: Array, covariance: Array, weights: Array) -> tuple[Array, Array]:
    """Path averages of profiles, with errors from their posterior.

    Parameters
    ----------
    cn2 : ndarray of float, (n, k)
        Profiles, m^(-2/3).
    covariance : ndarray of float, (n, k, k)
        Covariances of their posterior, m^(-4/3).
    weights : ndarray of float, (k,)
        Weights of the slices.

    Returns
    -------
    value, error : ndarray of float, (n,)
        Averages and standard errors, m^(-2/3).
    """
    variance = np.einsum("i,nij,j->n", weights, covariance, weights)
    return cn2 @ weights, np.sqrt(np.maximum(variance, 0.0))


def on_windows(bounds: Times, values: Array, errors: Array, windows: Times, coverage: float = 0.5) -> Means:
    """Means of values whose errors are known, over windows of another time base.

    Parameters
    ----------
    bounds : ndarray of int64, (n, 2)
        Start and end of each value, ns, in order and without overlap.
    values, errors : ndarray of float, (n,)
        Values and standard errors, which are taken as independent of each other.
    windows : ndarray of int64, (m, 2)
        Windows, ns.
    coverage : float
        Part of a window that values must cover.

    Returns
    -------
    Means
        With errors carried from those of the values.
    """
    good = np.isfinite(values)
    overlap = np.minimum(bounds[good, 1][:, None], windows[:, 1]) - np.maximum(bounds[good, 0][:, None], windows[:, 0])
    share = np.maximum(overlap, 0) / (windows[:, 1] - windows[:, 0])
    covered = share.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(covered >= coverage - 1e-9, share / covered, np.nan)
    return Means(
        values[good] @ weight,
        np.sqrt(errors[good] ** 2 @ weight**2),
        covered,
        np.asarray((share > 0).sum(axis=0), dtype=np.int64),
    )
