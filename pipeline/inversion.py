"""Positive maximum a posteriori reconstruction of the Cn2 profile from correlation maps.

The measurement equation of Sauvage et al. 2021, section "Reduced data model", is ``C_mes = M x + C_d + u``
with ``x`` the profile, ``C_d`` what detection noise, vibration and finite records add, and ``u`` the
convergence noise of covariance ``C_conv``. The profile minimises, subject to ``x >= 0``,

``J(x) = (C_mes - C_d - M x)^T C_conv^-1 (C_mes - C_d - M x) + mu x^T R x``

where ``C_d = B b`` holds a few unpenalised unknowns ``b`` (:func:`nuisance_design`). The work is done once per
covariance and once per regulariser; every value of ``mu`` then costs microseconds:

1. the independent rows are kept (:func:`independent_rows`, or those of the geometry);
2. each datum is divided by its own standard deviation *before* anything is factorised: squared slopes are
   some 1e-17 of the scintillation entries, and an unscaled factorisation loses them without a word;
3. the correlation matrix is factorised and the data whitened;
4. ``b`` is eliminated by projection on the orthogonal complement of the whitened ``B``, which is exact: the
   profile, its covariance and its influence matrix are those of the joint problem;
5. a QR factorisation reduces the problem to (k, k).

What remains, ``||A x - y||^2 + mu x^T R x``, is a :class:`LinearProblem`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, optimize

from . import posterior, uncertainty
from .markup import table

if TYPE_CHECKING:
    from .geometry import SliceGrid
    from .protocols import HyperparameterSelector, Regulariser

Floats: TypeAlias = NDArray[np.float64]

EIGENVALUE_FLOOR = 1e-12
"""Eigenvalues of the correlation matrix of the data below this fraction of the largest are not independent
data.

Rounding leaves an absolute error of some 1e-16 to 1e-15 of the largest eigenvalue in each, so at the floor an
eigenvalue, and the weight it gives, is still known to better than a percent.
"""

CORRELATION_TOLERANCE = 1e-9
"""Two rows whose correlation is 1 within this carry the same datum."""

ROW_TOLERANCE = 1e-6
"""Rows of M equal within this fraction of their largest entry are the same row (accuracy of the quadrature)."""

NUISANCE_TOLERANCE = 1e-10
"""Singular values of the whitened design, columns of unit norm, below this fraction leave an unknown
undetermined.
"""

N_KINDS = 6
"""Map kinds in the data vector: xx auto, yy auto, xx cross, yy cross, ii auto, ii cross."""

SUBSETS: dict[str, tuple[int, ...]] = {
    "all": (0, 1, 2, 3, 4, 5),
    "slopes": (0, 1, 2, 3),
    "scintillation": (4, 5),
    "auto": (0, 1, 4),
    "cross": (2, 3, 5),
}
"""Names of the parts of the data that can be inverted alone, as block numbers."""

_NOISE_BLOCKS = {"noise_bias_x": 0, "noise_bias_y": 1, "noise_bias_i": 4}
_OFFSET_BLOCKS = {"slope_offset_x": (0, 2), "slope_offset_y": (1, 3)}


def log_mu_grid(low: float = 23.0, high: float = 33.0, step: float = 0.25) -> Floats:
    """Grid of log10(mu / m^(4/3)).

    Parameters
    ----------
    low, high : float
        Ends of the range. Sauvage et al. 2021 search from 23 to 33, or from 25 where Cn2 is known to stay below
        10^-12.5 m^(-2/3).
    step : float
        Step, > 0. The grid ends at the last step that does not exceed `high`.

    Returns
    -------
    ndarray, (n,)

    Raises
    ------
    ValueError
        If the range is empty or not finite.
    """
    if not (np.isfinite([low, high, step]).all() and high >= low and step > 0):
        raise ValueError(f"log mu range {low:g}:{high:g}:{step:g}: needs LOW <= HIGH and STEP > 0")
    return np.asarray(low + step * np.arange(int((high - low) / step + 1e-9) + 1))


# --- rows ------------------------------------------------------------------------------------------------


def block_length(n_rows: int) -> int:
    """Rows per map kind of a data vector of `n_rows`.

    Parameters
    ----------
    n_rows : int
        Length of the data vector, 6 (2p-1) (2q-1).

    Returns
    -------
    int

    Raises
    ------
    ValueError
        If `n_rows` is not six times an odd number.
    """
    length, rest = divmod(n_rows, N_KINDS)
    if rest or length % 2 == 0:
        raise ValueError(
            f"{n_rows} data are not six maps of (2p-1) (2q-1) separations each (six times an odd number); "
            "without that order the zero separations and the slope maps are not known"
        )
    return length


def subset_mask(n_rows: int, name: str) -> NDArray[np.bool_]:
    """Rows that belong to a named subset of the data.

    Parameters
    ----------
    n_rows : int
        Length of the data vector.
    name : str
        A key of :data:`SUBSETS`.

    Returns
    -------
    ndarray of bool, (n_rows,)

    Raises
    ------
    ValueError
        If the name is unknown or the data are not six maps.
    """
    if name not in SUBSETS:
        raise ValueError(f"no data subset {name!r}; there are: {', '.join(SUBSETS)}")
    if name == "all":
        return np.ones(n_rows, dtype=bool)
    return np.repeat(np.isin(np.arange(N_KINDS), SUBSETS[name]), block_length(n_rows))


def independent_rows(data: ArrayLike, covariance: ArrayLike, matrix: ArrayLike) -> NDArray[np.intp]:
    """Rows that carry independent data, found from the matrices alone.

    Rows without a pair of subapertures (NaN, or a zero row of `matrix`, or no variance) are dropped. Of rows
    that are the same datum (equal variance, correlation 1, equal rows of `matrix`: an auto-correlation map
    satisfies C(d) = C(-d)) the last is kept, which is the one with d >= 0 in row-major order. 486 rows become
    312 for the 20 subapertures of Sauvage et al. 2021. Other linear dependence is left to the factorisation.

    Parameters
    ----------
    data : array_like, (n,) or (draws, n)
        Correlations; a row that is NaN in any draw counts as absent.
    covariance : array_like, (n, n)
        Covariance of their convergence noise.
    matrix : array_like, (n, k)
        Response matrix M.

    Returns
    -------
    ndarray of int, (m,)
        Rows kept, ascending.

    Raises
    ------
    ValueError
        If the shapes disagree, or no row is left.
    """
    values: Floats = np.atleast_2d(np.asarray(data, dtype=float))
    full: Floats = np.asarray(covariance, dtype=float)
    response: Floats = np.asarray(matrix, dtype=float)
    n = values.shape[-1]
    if values.ndim != 2 or response.ndim != 2 or len(response) != n or full.shape != (n, n):
        raise ValueError(
            f"shapes disagree: C_mes {values.shape}, C_conv {full.shape}, M {response.shape}; "
            "expected (n,) or (draws, n), (n, n), (n, k)"
        )
    variance = np.diag(full)
    with np.errstate(invalid="ignore"):
        present = (
            np.isfinite(values).all(axis=0)
            & np.isfinite(response).all(axis=1)
            & (response != 0).any(axis=1)
            & np.isfinite(variance)
            & (variance > 0)
        )
    rows = np.flatnonzero(present)
    if not rows.size:
        raise ValueError("no row has finite data, a positive variance and a response")
    deviation = np.sqrt(variance[rows])
    correlation = full[np.ix_(rows, rows)] / deviation[:, None] / deviation
    response = response[rows]
    first, second = np.nonzero(np.triu(correlation > 1 - CORRELATION_TOLERANCE, 1))
    gap = np.abs(response[first] - response[second]).max(axis=1, initial=0.0)
    same = (gap <= ROW_TOLERANCE * np.abs(response[second]).max(axis=1, initial=0.0)) & (
        np.abs(deviation[first] / deviation[second] - 1) < CORRELATION_TOLERANCE
    )
    redundant = np.zeros(rows.size, dtype=bool)
    redundant[first[same]] = True
    return rows[~redundant]


# --- unpenalised unknowns --------------------------------------------------------------------------------


def nuisance_design(
    n_rows: int, *, noise_bias: bool | str = True, slope_offset: bool = True
) -> tuple[Floats, tuple[str, ...]]:
    """Design matrix of the unpenalised unknowns that are estimated jointly with the profile.

    *Noise bias.* Detection noise is uncorrelated between subapertures and sources, so it adds to the zero
    separation of the three auto-correlation maps and nowhere else: one unknown per kind. It is a variance,
    yet it is not held non-negative. The same datum takes up everything else that differs at zero separation
    (a centroid gain other than 1, an inner scale), of either sign, and cutting that off would push it into the
    profile; a linear unknown keeps the elimination, the criterion curves and the error bars exact; and a
    significantly negative estimate is the sign of a fault upstream, flagged by the caller, which a bound would
    hide.

    *Slope offset.* Vibration of the instrument, a finite outer scale and the removal of the mean of a finite
    record all change every entry of the slope maps of one axis by the same amount, auto and cross, whatever
    the separation: one unknown per axis, of either sign.

    Parameters
    ----------
    n_rows : int
        Length of the data vector, six blocks of (2p-1) (2q-1); the zero separation is the centre of a block.
    noise_bias : bool or str
        Whether to include the noise of all kinds, or the kinds among ``"xyi"``.
    slope_offset : bool
        Whether to include the constants.

    Returns
    -------
    design : ndarray, (n_rows, b)
        B of ``C_d = B b``, in the units of the data (rad^2 for slopes, 1 for scintillation).
    names : tuple of str
        ``noise_bias_x``, ``noise_bias_y``, ``noise_bias_i``, ``slope_offset_x``, ``slope_offset_y``.

    Raises
    ------
    ValueError
        If unknowns are asked for and `n_rows` is not six times an odd number.
    """
    columns: dict[str, Floats] = {}
    length = block_length(n_rows) if noise_bias or slope_offset else 0
    kinds = noise_bias if isinstance(noise_bias, str) else "xyi" if noise_bias else ""
    for name, block in _NOISE_BLOCKS.items():
        if name[-1] in kinds:
            columns[name] = np.zeros(n_rows)
            columns[name][block * length + length // 2] = 1.0
    if slope_offset:
        for name, blocks in _OFFSET_BLOCKS.items():
            columns[name] = np.repeat(np.isin(np.arange(N_KINDS), blocks), length).astype(float)
    if not columns:
        return np.zeros((n_rows, 0)), ()
    return np.stack(list(columns.values()), axis=1), tuple(columns)


# --- whitening -------------------------------------------------------------------------------------------


def _frozen(values: NDArray[Any]) -> NDArray[Any]:
    """View that cannot be written through."""
    view = values.view()
    view.setflags(write=False)
    return view


@dataclass(frozen=True, eq=False)
class Reduction:
    """Whitening and elimination of the unpenalised unknowns for one covariance and one response matrix.

    Made by :func:`prepare`; any number of data vectors can then be reduced with it.

    Attributes
    ----------
    rows : ndarray of int, (m,)
        Rows of the data vector that enter.
    response : ndarray, (n, k)
        Response matrix M of all rows, NaN where no pair exists; m^(2/3) rad^2 or m^(2/3).
    design : ndarray, (n, b)
        Design of the unpenalised unknowns on all rows.
    names : tuple of str
        Names of the unpenalised unknowns.
    deviation : ndarray, (m,)
        Standard deviation of each datum.
    factor : ndarray, (m, m) or (m, n_data)
        Lower Cholesky factor of the correlation matrix, or eigenvectors over the square root of the
        eigenvalues.
    cholesky : bool
        Which of the two.
    n_data : int
        Number of independent data: the rank kept.
    complement : ndarray, (n_data, n_data - n_nuisance)
        Orthonormal basis of what the whitened unknowns cannot produce.
    matrix : ndarray, (n_data - n_nuisance, k)
        Whitened and projected response.
    """

    rows: NDArray[np.intp]
    response: Floats
    design: Floats
    names: tuple[str, ...]
    deviation: Floats
    factor: Floats
    cholesky: bool
    n_data: int
    complement: Floats
    matrix: Floats

    def __post_init__(self) -> None:
        """Forbid changes to what many problems share."""
        for name, value in vars(self).copy().items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, _frozen(value))

    @property
    def n_nuisance(self) -> int:
        """Number of unpenalised unknowns the data determine."""
        return int(self.n_data - self.complement.shape[1])

    def whiten(self, values: Floats) -> Floats:
        """Scale and whiten values on the kept rows.

        Parameters
        ----------
        values : ndarray, (m,) or (m, c)
            In the units of the data.

        Returns
        -------
        ndarray, (n_data,) or (n_data, c)
            Of unit covariance if `values` has the covariance of the data.
        """
        scaled = (values.T / self.deviation).T
        if self.cholesky:
            return np.asarray(linalg.solve_triangular(self.factor, scaled, lower=True, check_finite=False))
        return np.asarray(self.factor.T @ scaled)

    def problem(
        self,
        data: ArrayLike,
        precision: ArrayLike,
        *,
        grid: SliceGrid | None = None,
        neighbours: Sequence[LinearProblem] = (),
    ) -> LinearProblem:
        """Linear problem for one data vector.

        Parameters
        ----------
        data : array_like, (n,)
            Correlations; only the kept rows are read.
        precision : array_like, (k, k)
            R of the prior term mu x^T R x, symmetric and positive semi-definite, dimensionless.
        grid : SliceGrid, optional
            The slices, handed on to selectors.
        neighbours : sequence of LinearProblem
            Problems of neighbouring batches, for selectors that smooth.

        Returns
        -------
        LinearProblem

        Raises
        ------
        ValueError
            If a kept row of the data is not finite, or a shape is wrong.
        """
        values: Floats = np.asarray(data, dtype=float)
        if values.shape != (len(self.response),):
            raise ValueError(f"the data vector has shape {values.shape}, expected ({len(self.response)},)")
        if not np.isfinite(values[self.rows]).all():
            raise ValueError("the data hold NaN or infinity on rows that enter the inversion")
        return LinearProblem(
            matrix=self.matrix,
            data=self.complement.T @ self.whiten(values[self.rows]),
            precision=np.asarray(precision, dtype=float),
            n_data=self.n_data,
            grid=grid,
            neighbours=tuple(neighbours),
        )

    def nuisance(self, data: ArrayLike, cn2: Floats, covariance: Floats | None = None) -> tuple[Floats, Floats]:
        """Unpenalised unknowns that go with a profile, and their standard errors.

        Parameters
        ----------
        data : array_like, (n,)
            Correlations.
        cn2 : ndarray, (k,)
            Profile, m^(-2/3).
        covariance : ndarray, (k, k), optional
            Posterior covariance of the profile. With it the errors are those of the joint problem; without,
            those at a known profile.

        Returns
        -------
        values, errors : ndarray, (b,)
            In the units of the data. NaN and infinity for unknowns the kept rows do not determine.
        """
        values = np.full(len(self.names), np.nan)
        errors = np.full(len(self.names), np.inf)
        design = self.design[self.rows]
        used = (design != 0).any(axis=0)
        if not used.any():
            return values, errors
        whitened = self.whiten(design[:, used])
        norm = np.linalg.norm(whitened, axis=0)
        inverse, null = _pseudo_inverse(whitened / norm)
        model = self.response[self.rows] @ cn2
        spread = inverse @ inverse.T
        if covariance is not None:
            gain = inverse @ self.whiten(self.response[self.rows])
            with np.errstate(invalid="ignore"):
                spread = spread + gain @ covariance @ gain.T
        found = inverse @ self.whiten(np.asarray(data, dtype=float)[self.rows] - model) / norm
        deviation = np.sqrt(np.diag(spread)) / norm
        values[used] = np.where(null, np.nan, found)
        errors[used] = np.where(null | np.isnan(deviation), np.inf, deviation)
        return values, errors


def _pseudo_inverse(matrix: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Pseudo-inverse of an equilibrated tall matrix, and which unknowns its columns do not determine."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    kept = s > NUISANCE_TOLERANCE * s[0]
    null = np.sqrt(1 - np.clip((vt[kept] ** 2).sum(axis=0), 0, 1)) > 1e-5
    return (vt[kept].T / s[kept]) @ u[:, kept].T, null


def _factorise(correlation: Floats) -> tuple[Floats, bool]:
    """Whitening factor of a correlation matrix, and whether it is its Cholesky factor.

    A matrix that is singular or indefinite beyond rounding (a covariance estimated from few frames) is
    diagonalised instead. Kept are the eigenvalues above :data:`EIGENVALUE_FLOOR` times the largest and above
    the modulus of the most negative one, which shows how wrong the small ones are.
    """
    norm = np.abs(correlation).sum(axis=0).max()
    try:
        factor = linalg.cholesky(correlation, lower=True, check_finite=False)
        # A squared diagonal entry, the variance of a datum given those before it, bounds the least eigenvalue.
        if np.diag(factor).min() ** 2 > EIGENVALUE_FLOOR * norm:
            return factor, True
    except linalg.LinAlgError:
        pass
    values, vectors = linalg.eigh(correlation, check_finite=False)
    floor = max(EIGENVALUE_FLOOR * values[-1], -values[0])
    kept = values > floor
    return vectors[:, kept] / np.sqrt(values[kept]), False


def prepare(
    data: ArrayLike,
    covariance: ArrayLike,
    matrix: ArrayLike,
    *,
    rows: ArrayLike | None = None,
    subset: str = "all",
    noise_bias: bool | str = True,
    slope_offset: bool = True,
) -> Reduction:
    """Choose rows, whiten them and eliminate the unpenalised unknowns.

    The part of :func:`invert` that all draws of one covariance share.

    Parameters
    ----------
    data : array_like, (n,) or (draws, n)
        Correlations; read only for which rows are present.
    covariance : array_like, (n, n) or (m, m)
        Covariance of the convergence noise, of all rows or of `rows`.
    matrix : array_like, (n, k)
        Response matrix M, slice thickness included.
    rows : array_like of int, (m,), optional
        Independent rows; found from the matrices (:func:`independent_rows`) if not given.
    subset : str
        Part of the data to use, a key of :data:`SUBSETS`.
    noise_bias, slope_offset : bool
        Unpenalised unknowns to include (:func:`nuisance_design`).

    Returns
    -------
    Reduction

    Raises
    ------
    ValueError
        If shapes disagree, if kept rows are not finite or have no variance, or if nothing is left to invert.
    """
    values: Floats = np.atleast_2d(np.asarray(data, dtype=float))
    full: Floats = np.asarray(covariance, dtype=float)
    response: Floats = np.array(matrix, dtype=float)
    chosen = independent_rows(values, full, response) if rows is None else np.asarray(rows, dtype=np.intp)
    n, m = len(response), len(chosen)
    if values.shape[-1] != n:
        raise ValueError(f"the data vector has {values.shape[-1]} rows, the response matrix {n}")
    if full.shape == (n, n) and n != m:
        full = full[np.ix_(chosen, chosen)]
    if full.shape != (m, m):
        raise ValueError(f"C_conv has shape {full.shape}; expected ({n}, {n}) or ({m}, {m}) for {m} rows")
    # Subapertures that are never measured leave both their data and their noise NaN.
    measured = np.isfinite(values[:, chosen]).all(axis=0) & np.isfinite(np.diag(full))
    kept = subset_mask(n, subset)[chosen] & measured
    if not kept.any():
        raise ValueError(f"no finite datum in the subset {subset!r}")
    chosen, full = chosen[kept], full[np.ix_(kept, kept)]
    if not (np.isfinite(full).all() and np.isfinite(response[chosen]).all()):
        raise ValueError("C_conv or M is not finite on rows that enter the inversion")
    variance: Floats = np.diag(full)
    if not (variance > 0).all():
        raise ValueError("C_conv has a variance that is not positive on a row that enters the inversion")
    deviation: Floats = np.sqrt(variance)
    correlation = full / deviation[:, None] / deviation
    factor, cholesky = _factorise((correlation + correlation.T) / 2)
    design, names = nuisance_design(n, noise_bias=noise_bias, slope_offset=slope_offset)
    n_data = factor.shape[1]
    whitening = Reduction(
        rows=chosen,
        response=response,
        design=design,
        names=names,
        deviation=deviation,
        factor=factor,
        cholesky=cholesky,
        n_data=n_data,
        complement=np.eye(n_data),
        matrix=np.empty((n_data, 0)),
    )
    complement = np.eye(n_data)
    used = (design[chosen] != 0).any(axis=0)
    if used.any():
        whitened = whitening.whiten(design[chosen][:, used])
        u, s, _ = np.linalg.svd(whitened / np.linalg.norm(whitened, axis=0), full_matrices=True)
        complement = u[:, int((s > NUISANCE_TOLERANCE * s[0]).sum()) :]
    if not complement.shape[1]:
        raise ValueError(f"{n_data} independent data are no more than the unpenalised unknowns")
    return replace(whitening, complement=complement, matrix=complement.T @ whitening.whiten(response[chosen]))


# --- the linear problem ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Modes:
    """Generalised singular value decomposition of the pair (A, R).

    ``x = vectors @ t`` turns ``||A x - y||^2 + mu x^T R x`` into a sum over modes,
    ``(gain_i t_i - projection_i)^2 + mu roughness_i^2 t_i^2``, plus a constant.

    Attributes
    ----------
    vectors : ndarray, (k, r)
        Modes of the profile; r < k only if some combination of slices is seen by neither A nor R.
    gain : ndarray, (r,)
        Norm of A times each mode, in standard deviations of the data.
    roughness : ndarray, (r,)
        Square root of x^T R x of each mode.
    projection : ndarray, (r,)
        Data seen by each mode.
    misfit : float
        ||y||^2 that no profile explains.
    """

    vectors: Floats
    gain: Floats
    roughness: Floats
    projection: Floats
    misfit: float

    def filters(self, mu: ArrayLike) -> Floats:
        """Filter factors gain^2 / (gain^2 + mu roughness^2).

        Parameters
        ----------
        mu : array_like, (...)
            Hyper-parameter, m^(4/3).

        Returns
        -------
        ndarray, (..., r)
            0 for modes the data do not see.
        """
        signal = self.gain**2
        total = signal + np.asarray(mu, dtype=float)[..., None] * self.roughness**2
        return np.divide(signal, total, out=np.zeros_like(total), where=signal > 0)


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """Whitened problem ``||A x - y||^2 + mu x^T R x``, ``x >= 0``, free of unpenalised unknowns.

    Attributes
    ----------
    matrix : ndarray, (n, k)
        A, whitened response; m^(2/3).
    data : ndarray, (n,)
        y, whitened data, of unit variance.
    precision : ndarray, (k, k)
        R, dimensionless, symmetric and positive semi-definite.
    n_data : int
        Number of independent data before the unpenalised unknowns were eliminated; n_data - n of these were.
    grid : SliceGrid or None
        The slices.
    neighbours : tuple of LinearProblem
        Problems of neighbouring batches, for selectors that smooth over them.

    Raises
    ------
    ValueError
        If shapes disagree or R is not symmetric and positive semi-definite.
    """

    matrix: Floats
    data: Floats
    precision: Floats
    n_data: int
    grid: SliceGrid | None = None
    neighbours: tuple[LinearProblem, ...] = ()

    def __post_init__(self) -> None:
        """Check shapes and the precision, and forbid changes."""
        n, k = self.matrix.shape
        if self.data.shape != (n,):
            raise ValueError(f"A has {n} rows, y has shape {self.data.shape}")
        if self.precision.shape != (k, k):
            raise ValueError(f"the regulariser gives a matrix of shape {self.precision.shape}, not ({k}, {k})")
        if not np.isfinite(self.precision).all():
            raise ValueError("the precision of the regulariser is not finite")
        size = np.abs(self.precision).max(initial=0.0)
        if np.abs(self.precision - self.precision.T).max(initial=0.0) > 1e-12 * size:
            raise ValueError("the precision of the regulariser is not symmetric")
        for name in ("matrix", "data", "precision"):
            object.__setattr__(self, name, _frozen(getattr(self, name)))

    @property
    def k(self) -> int:
        """Number of slices."""
        return int(self.matrix.shape[1])

    @property
    def n_nuisance(self) -> int:
        """Number of unpenalised unknowns that were eliminated."""
        return self.n_data - len(self.data)

    @cached_property
    def triangle(self) -> tuple[Floats, Floats, float]:
        """(T, c, misfit) with ``||A x - y||^2 = ||T x - c||^2 + misfit``; T is (min(n, k), k)."""
        q, t = linalg.qr(self.matrix, mode="economic", check_finite=False)
        c = q.T @ self.data
        rest = self.data - q @ c
        # Once more: the first projection leaves rounding of the size of y in the directions of A.
        again = q.T @ rest
        rest = rest - q @ again
        return t, c + again, float(rest @ rest)

    @cached_property
    def factor(self) -> Floats:
        """F with ``F^T F = R``, (rank of R, k)."""
        values, vectors = np.linalg.eigh((self.precision + self.precision.T) / 2)
        largest = max(values[-1], 0.0)
        if values[0] < -1e-10 * largest or (largest == 0 and values[0] < 0):
            raise ValueError("the precision of the regulariser is not positive semi-definite")
        kept = values > 1e-14 * self.k * largest
        return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T)

    @cached_property
    def modes(self) -> Modes:
        """Generalised singular value decomposition, from which every curve against mu follows."""
        t, c, misfit = self.triangle
        f = self.factor
        balance = _ratio(np.linalg.norm(t), np.linalg.norm(f))
        p, s, zt = np.linalg.svd(np.concatenate([t, balance * f]), full_matrices=False)
        kept = s > 1e-14 * max(len(p), 1) * s[0] if s.size and s[0] > 0 else np.zeros(s.shape, dtype=bool)
        basis = zt[kept].T / s[kept]
        u, gain, vt = np.linalg.svd(p[: len(t), kept], full_matrices=True)
        r = vt.shape[0]
        projection = np.zeros(r)
        width = min(u.shape[1], r)
        projection[:width] = (u.T @ c)[:width]
        gain = np.pad(gain, (0, r - len(gain)))
        gain[gain < 1e-15 * self.k] = 0.0
        lost = np.linalg.norm(u[:, width:].T @ c) ** 2 + np.linalg.norm(projection[gain == 0]) ** 2
        projection[gain == 0] = 0.0
        roughness = np.linalg.norm(p[len(t) :, kept] @ vt.T, axis=0) / balance
        return Modes(basis @ vt.T, gain, roughness, projection, misfit + float(lost))


def _ratio(numerator: Any, denominator: Any) -> float:
    """Ratio of two norms, 1 where either is zero."""
    return float(numerator / denominator) if numerator > 0 and denominator > 0 else 1.0


# --- solutions -------------------------------------------------------------------------------------------


def solve_linear(problem: LinearProblem, mu: ArrayLike) -> Floats:
    """Minimiser of J without the positivity constraint.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    mu : array_like, (...)
        Hyper-parameter, m^(4/3), >= 0.

    Returns
    -------
    ndarray, (..., k)
        Profile, m^(-2/3); of least norm where neither the data nor the prior decide.
    """
    modes = problem.modes
    filters = modes.filters(mu)
    weight = np.divide(filters, modes.gain, out=np.zeros_like(filters), where=modes.gain > 0)
    return np.asarray((weight * modes.projection) @ modes.vectors.T)


def solve_positive(problem: LinearProblem, mu: ArrayLike) -> Floats:
    """Minimiser of J subject to x >= 0.

    J is strictly convex, so the minimiser is unique, and the active-set method of Lawson & Hanson (1974,
    "Solving Least Squares Problems", ch. 23) reaches it exactly after finitely many steps. It runs on the
    (k, k) system with the factor of the prior stacked below, every column scaled to unit norm: Cn2 near
    1e-14 would otherwise stop any tolerance at the start.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    mu : array_like, (...)
        Hyper-parameter, m^(4/3), >= 0.

    Returns
    -------
    ndarray, (..., k)
        Profile, m^(-2/3), exactly 0 where the constraint binds.

    Raises
    ------
    ValueError
        If mu is negative or not finite.
    """
    values = np.asarray(mu, dtype=float)
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise ValueError("mu must be finite and not negative")
    t, c, _ = problem.triangle
    f = problem.factor
    target = np.concatenate([c, np.zeros(len(f))])
    solutions = np.empty((values.size, problem.k))
    for solution, value in zip(solutions, values.ravel(), strict=True):
        stacked = np.concatenate([t, np.sqrt(value) * f])
        norm = np.linalg.norm(stacked, axis=0)
        norm[norm == 0] = 1.0
        scaled, _ = optimize.nnls(stacked / norm, target, maxiter=100 * problem.k)
        solution[:] = scaled / norm
    return solutions.reshape(*values.shape, problem.k)


# --- criteria --------------------------------------------------------------------------------------------


def _powers(log_mu: ArrayLike) -> Floats:
    return np.asarray(10.0 ** np.asarray(log_mu, dtype=float))


def misfit(problem: LinearProblem, log_mu: ArrayLike) -> Floats:
    """||A x(mu) - y||^2 of the linear solution.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    log_mu : array_like, (...)
        log10(mu / m^(4/3)).

    Returns
    -------
    ndarray, (...)
    """
    modes = problem.modes
    blocked = 1 - modes.filters(_powers(log_mu))
    return np.asarray(modes.misfit + (blocked**2) @ modes.projection**2)


def gcv(problem: LinearProblem, log_mu: ArrayLike) -> Floats:
    """Generalised cross-validation, V = ||A x(mu) - y||^2 / trace(I - G(mu))^2.

    As printed in the appendix of Sauvage et al. 2021 (Golub, Heath & Wahba 1979,
    https://doi.org/10.1080/00401706.1979.10489751): x(mu) is the linear solution, I has the size of the
    number of independent data, and G is the influence matrix of the joint problem, so each unpenalised
    unknown counts one in its trace.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    log_mu : array_like, (...)
        log10(mu / m^(4/3)).

    Returns
    -------
    ndarray, (...)
        NaN where the data are no more than the unknowns they fit.
    """
    free = len(problem.data) - problem.modes.filters(_powers(log_mu)).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(free > 1e-9, misfit(problem, log_mu) / free**2, np.nan))


def evidence(problem: LinearProblem, log_mu: ArrayLike) -> Floats:
    """-2 log of the marginal likelihood of the data under the Gaussian prior, up to a constant.

    ``y^T S^-1 y + log det S`` with ``S = I + A (mu R)^-1 A^T`` (MacKay 1992,
    https://doi.org/10.1162/neco.1992.4.3.415), positivity left aside. Directions that R does not penalise
    have a flat prior and add a constant.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    log_mu : array_like, (...)
        log10(mu / m^(4/3)).

    Returns
    -------
    ndarray, (...)
    """
    modes = problem.modes
    mu = _powers(log_mu)
    held = modes.roughness > 1e-12 * modes.roughness.max(initial=0.0)
    ratio = modes.gain[held] ** 2 / (mu[..., None] * modes.roughness[held] ** 2)
    blocked = np.where(held, 1 - modes.filters(mu), 0.0)
    return np.asarray(modes.misfit + blocked @ modes.projection**2 + np.log1p(ratio).sum(axis=-1))


def upre(problem: LinearProblem, log_mu: ArrayLike) -> Floats:
    """Unbiased estimate of the predictive risk, ||A x(mu) - y||^2 + 2 trace G(mu) - n.

    Mallows' C_L for noise of known, here unit, variance (Mallows 1973,
    https://doi.org/10.1080/00401706.1973.10489103): its mean is that of ||A x(mu) - A x_true||^2.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    log_mu : array_like, (...)
        log10(mu / m^(4/3)).

    Returns
    -------
    ndarray, (...)
    """
    trace = problem.modes.filters(_powers(log_mu)).sum(axis=-1)
    return np.asarray(misfit(problem, log_mu) + 2 * trace - len(problem.data))


def discrepancy(problem: LinearProblem, log_mu: ArrayLike, tau: float = 1.0) -> Floats:
    """Distance of the misfit from its expectation, | ||A x(mu) - y||^2 / n - tau |.

    Morozov's principle (1966, Soviet Math. Dokl. 7, 414): the misfit of whitened data should equal their
    number n, here less the unpenalised unknowns.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    log_mu : array_like, (...)
        log10(mu / m^(4/3)).
    tau : float
        Safety factor.

    Returns
    -------
    ndarray, (...)
    """
    return np.asarray(np.abs(misfit(problem, log_mu) / max(len(problem.data), 1) - tau))


def lcurve(problem: LinearProblem, log_mu: ArrayLike) -> Floats:
    """Less the curvature of the L-curve, log(x^T R x) against log ||A x - y||^2, in its corner the smallest.

    Hansen & O'Leary 1993, https://doi.org/10.1137/0914086; the derivatives with respect to log mu are exact.

    Parameters
    ----------
    problem : LinearProblem
        The problem.
    log_mu : array_like, (...)
        log10(mu / m^(4/3)).

    Returns
    -------
    ndarray, (...)
        NaN where the solution or the misfit vanishes.
    """
    modes = problem.modes
    f = modes.filters(_powers(log_mu))
    b = 1 - f
    power = modes.projection**2
    rho = modes.misfit + (b**2) @ power
    # x^T R x times mu; the factor 1/mu enters the derivatives of its logarithm as -1 and 0.
    eta = (f * b) @ power
    slope = 2 * (f * b**2) @ power
    bend = 2 * (f * b**2 * (2 * f - b)) @ power
    with np.errstate(divide="ignore", invalid="ignore"):
        x1 = slope / rho
        x2 = bend / rho - x1**2
        y1 = -slope / eta
        y2 = (slope - bend) / eta - y1**2
        curvature = (x1 * y2 - y1 * x2) / (x1**2 + y1**2) ** 1.5
    return np.asarray(-curvature)


@dataclass(frozen=True, eq=False)
class Selection:
    """A value of mu and the curve it was chosen from.

    Attributes
    ----------
    criterion_name : str
        What the curve is ("gcv", "evidence", ...).
    mu : float
        Hyper-parameter, m^(4/3).
    log_mu_grid : ndarray, (g,)
        log10(mu / m^(4/3)).
    criterion : ndarray, (g,)
        The curve; the smallest value is the best.
    at_edge : bool
        True if the minimum lies at an end of the grid, so the true one may lie outside.
    """

    criterion_name: str
    mu: float
    log_mu_grid: Floats
    criterion: Floats
    at_edge: bool

    @property
    def log_mu(self) -> float:
        """log10(mu / m^(4/3))."""
        with np.errstate(divide="ignore"):
            return float(np.log10(self.mu))


def select_minimum(criterion_name: str, log_mu: ArrayLike, criterion: ArrayLike) -> Selection:
    """Selection at the smallest value of a curve.

    Parameters
    ----------
    criterion_name : str
        What the curve is.
    log_mu : array_like, (g,)
        log10(mu / m^(4/3)), ascending.
    criterion : array_like, (g,)
        The curve; NaN entries are passed over.

    Returns
    -------
    Selection

    Raises
    ------
    ValueError
        If no value of the curve is finite.
    """
    grid = np.asarray(log_mu, dtype=float)
    curve = np.asarray(criterion, dtype=float)
    finite = np.flatnonzero(np.isfinite(curve))
    if not finite.size:
        raise ValueError(f"{criterion_name} is finite nowhere from log mu {grid[0]:g} to {grid[-1]:g}")
    best = int(finite[np.argmin(curve[finite])])
    return Selection(criterion_name, float(10.0 ** grid[best]), grid, curve, best in (finite[0], finite[-1]))


# --- the profile -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Profile:
    """A reconstructed profile with its uncertainty and the fit it comes from.

    Attributes
    ----------
    cn2 : ndarray, (k,)
        Profile, m^(-2/3).
    estimator : str
        "map" or "posterior_mean".
    selection : Selection
        Hyper-parameter and criterion curve.
    covariance : ndarray, (k, k)
        Posterior covariance of the linear solution, m^(-4/3) (:func:`~.uncertainty.posterior_covariance`).
    error_map, error_ml : ndarray, (k,)
        Standard errors, m^(-2/3) (:func:`~.uncertainty.map_error`, :func:`~.uncertainty.ml_error`).
    averaging_kernel : ndarray, (k, k)
        d cn2_i / d truth_j (:func:`~.uncertainty.averaging_kernel`).
    degrees_of_freedom : float
        Trace of the averaging kernel.
    posterior : Posterior or None
        Draws from the posterior under positivity; None if neither data nor prior bound the profile.
    at_bound : ndarray of bool, (k,)
        Slices the positivity constraint holds at zero in the MAP solution.
    nuisance_names : tuple of str
        Unpenalised unknowns.
    nuisance, nuisance_error : ndarray, (b,)
        Their estimates and standard errors (joint with the profile), in the units of the data: rad^2 or 1.
    chi2 : float
        Misfit ||A x - y||^2 of the whitened data.
    chi2_reduced : float
        `chi2` over the number of independent data less the unpenalised unknowns and `degrees_of_freedom`.
    model, residual : ndarray, (n,)
        M cn2 + B b on all rows, and data less model; NaN where there is neither.
    n_data : int
        Number of independent data.
    resolution_length : ndarray, (k,)
        Length of path that each estimate stands for, m (:func:`~.uncertainty.resolution_length`); NaN where the
        data do not resolve the slice, and where the slices were not given.
    """

    cn2: Floats
    estimator: str
    selection: Selection
    covariance: Floats
    error_map: Floats
    error_ml: Floats
    averaging_kernel: Floats
    degrees_of_freedom: float
    posterior: posterior.Posterior | None
    at_bound: NDArray[np.bool_]
    nuisance_names: tuple[str, ...]
    nuisance: Floats
    nuisance_error: Floats
    chi2: float
    chi2_reduced: float
    model: Floats
    residual: Floats
    n_data: int
    resolution_length: Floats

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        rows = [
            (number, f"{cn2:.2e}", f"{bar:.1e}", f"{data:.1e}", "at zero" if bound else "")
            for number, (cn2, bar, data, bound) in enumerate(
                zip(self.cn2, self.error_map, self.error_ml, self.at_bound, strict=True)
            )
        ]
        caption = f"Cn2 profile ({self.estimator}), m^(-2/3); chi2 per datum {self.chi2_reduced:.2f}"
        return table(caption, ("slice", "Cn2", "MAP bar", "ML bar", ""), rows)

    @property
    def mu(self) -> float:
        """Hyper-parameter, m^(4/3)."""
        return self.selection.mu

    @property
    def log_mu_grid(self) -> Floats:
        """Grid of log10(mu / m^(4/3)) of the criterion curve."""
        return self.selection.log_mu_grid

    @property
    def criterion(self) -> Floats:
        """Criterion curve on `log_mu_grid`."""
        return self.selection.criterion

    @property
    def posterior_mean(self) -> Floats:
        """Mean of the posterior under positivity, (k,), m^(-2/3); NaN if there is no posterior."""
        return np.full(len(self.cn2), np.nan) if self.posterior is None else self.posterior.mean

    @property
    def interval_68(self) -> Floats:
        """Highest-density intervals of 68 %, (k, 2), m^(-2/3); 0 to infinity if there is no posterior."""
        return self._unbounded() if self.posterior is None else self.posterior.interval_68

    @property
    def interval_95(self) -> Floats:
        """Highest-density intervals of 95 %, (k, 2), m^(-2/3); 0 to infinity if there is no posterior."""
        return self._unbounded() if self.posterior is None else self.posterior.interval_95

    def _unbounded(self) -> Floats:
        return np.tile([0.0, np.inf], (len(self.cn2), 1))


Estimator: TypeAlias = Literal["map", "posterior_mean"]


def estimate(
    reduction: Reduction,
    data: ArrayLike,
    precision: ArrayLike,
    selector: HyperparameterSelector,
    *,
    grid: SliceGrid | None = None,
    neighbours: Sequence[LinearProblem] = (),
    estimator: Estimator = "map",
    seed: int = 0,
) -> Profile:
    """Profile of one data vector.

    Parameters
    ----------
    reduction : Reduction
        From :func:`prepare`.
    data : array_like, (n,)
        Correlations C_mes, rad^2 and 1.
    precision : array_like, (k, k)
        R of the prior.
    selector : HyperparameterSelector
        Chooses mu.
    grid : SliceGrid, optional
        The slices.
    neighbours : sequence of LinearProblem
        Problems of neighbouring batches.
    estimator : {"map", "posterior_mean"}
        The minimiser of J under positivity (Sauvage et al. 2021), or the mean of the posterior under
        positivity, which has the least expected squared error if the prior is right.
    seed : int
        Seed of the draws from the posterior.

    Returns
    -------
    Profile

    Raises
    ------
    ValueError
        If the data are not finite, or the posterior mean is asked for and does not exist.
    """
    values: Floats = np.asarray(data, dtype=float)
    problem = reduction.problem(values, precision, grid=grid, neighbours=neighbours)
    selection = selector.select(problem)
    mode = solve_positive(problem, selection.mu)
    drawn = posterior.sample(problem, selection.mu, seed=seed) if posterior.proper(problem, selection.mu) else None
    if estimator == "posterior_mean":
        if drawn is None:
            raise ValueError("neither the data nor the prior bound the profile: it has no posterior mean")
        best = drawn.mean
    elif estimator == "map":
        best = mode
    else:
        raise ValueError(f"no estimator {estimator!r}; there are: map, posterior_mean")
    rest = problem.matrix @ best - problem.data
    chi2 = float(rest @ rest)
    kernel = uncertainty.averaging_kernel(problem, selection.mu)
    freedom = float(np.trace(kernel))
    covariance = uncertainty.posterior_covariance(problem, selection.mu)
    nuisance, nuisance_error = reduction.nuisance(values, best, covariance)
    model = reduction.response @ best + reduction.design @ np.nan_to_num(nuisance)
    remaining = len(problem.data) - freedom
    return Profile(
        cn2=best,
        estimator=estimator,
        selection=selection,
        covariance=covariance,
        error_map=np.sqrt(np.diag(covariance)),
        error_ml=uncertainty.ml_error(problem),
        averaging_kernel=kernel,
        degrees_of_freedom=freedom,
        posterior=drawn,
        at_bound=mode == 0,
        nuisance_names=reduction.names,
        nuisance=nuisance,
        nuisance_error=nuisance_error,
        chi2=chi2,
        chi2_reduced=chi2 / remaining if remaining > 0 else np.nan,
        model=model,
        residual=values - model,
        n_data=reduction.n_data,
        resolution_length=np.full(len(best), np.nan) if grid is None else uncertainty.resolution_length(kernel, grid),
    )


def invert(
    data: ArrayLike,
    covariance: ArrayLike,
    matrix: ArrayLike,
    *,
    grid: SliceGrid,
    regulariser: Regulariser,
    selector: HyperparameterSelector,
    rows: ArrayLike | None = None,
    subset: str = "all",
    noise_bias: bool | str = True,
    slope_offset: bool = True,
    neighbours: Sequence[LinearProblem] = (),
    estimator: Estimator = "map",
    seed: int = 0,
) -> Profile:
    """Profile from correlations, their covariance and the response matrix.

    Parameters
    ----------
    data : array_like, (n,)
        Correlations C_mes, six blocks of (2p-1) (2q-1); rad^2 and 1. NaN where no pair exists.
    covariance : array_like, (n, n) or (m, m)
        Covariance C_conv of the convergence noise on all rows, or on `rows` if these are given.
    matrix : array_like, (n, k)
        Response matrix M, slice thickness included.
    grid : SliceGrid
        The k slices.
    regulariser : Regulariser
        Gives R of the prior.
    selector : HyperparameterSelector
        Chooses mu.
    rows : array_like of int, (m,), optional
        Independent rows; found from the matrices (:func:`independent_rows`) if not given.
    subset : str
        Part of the data to use, a key of :data:`SUBSETS`.
    noise_bias, slope_offset : bool
        Unpenalised unknowns (:func:`nuisance_design`).
    neighbours : sequence of LinearProblem
        Problems of neighbouring batches, for selectors that smooth.
    estimator : {"map", "posterior_mean"}
        As in :func:`estimate`.
    seed : int
        Seed of the draws from the posterior.

    Returns
    -------
    Profile

    Raises
    ------
    ValueError
        If shapes disagree or nothing is left to invert.
    """
    reduction = prepare(
        data, covariance, matrix, rows=rows, subset=subset, noise_bias=noise_bias, slope_offset=slope_offset
    )
    return estimate(
        reduction,
        data,
        regulariser.precision(grid),
        selector,
        grid=grid,
        neighbours=neighbours,
        estimator=estimator,
        seed=seed,
    )
