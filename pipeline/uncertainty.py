"""Uncertainty of the reconstructed profile: error bars, averaging kernels, degrees of freedom.

All of it describes the linear solution: the positivity constraint, which stabilises the reconstruction further,
does not enter (Sauvage et al. 2021, section "Maximum a posteriori solution"). Unpenalised unknowns are
marginalised, because the problem has been projected on what they cannot produce.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .geometry import SliceGrid
    from .inversion import LinearProblem

Floats: TypeAlias = NDArray[np.float64]


def posterior_covariance(problem: LinearProblem, mu: float) -> Floats:
    """Posterior covariance (M^T C_conv^-1 M + mu R)^-1 of Sauvage et al. 2021, eq. (eq-error-covariance).

    Parameters
    ----------
    problem : LinearProblem
        Whitened problem.
    mu : float
        Hyper-parameter, m^(4/3), >= 0.

    Returns
    -------
    ndarray, (k, k)
        m^(-4/3). Rows and columns of slices that neither data nor prior determine are NaN, with infinity on
        the diagonal.
    """
    triangle, _, _ = problem.triangle
    stacked = np.concatenate([triangle, np.sqrt(float(mu)) * problem.factor])
    norm = np.linalg.norm(stacked, axis=0)
    unseen = norm == 0
    norm[unseen] = 1.0
    _, s, vt = np.linalg.svd(stacked / norm, full_matrices=True)
    s = np.pad(s, (0, len(vt) - len(s)))
    kept = s > 1e-13 * max(s[0], 1e-300)
    inverse = vt[kept].T / s[kept]
    covariance = inverse @ inverse.T / norm / norm[:, None]
    # A slice with a share in a direction that nothing sees has no finite error, however small the share.
    undetermined = unseen | (np.sqrt((vt[~kept] ** 2).sum(axis=0)) > 1e-6)
    covariance[undetermined] = np.nan
    covariance[:, undetermined] = np.nan
    covariance[undetermined, undetermined] = np.inf
    return np.asarray(covariance)


def map_error(problem: LinearProblem, mu: float) -> Floats:
    """Standard errors of the maximum a posteriori profile, sqrt(diag((M^T C_conv^-1 M + mu R)^-1)).

    Parameters
    ----------
    problem : LinearProblem
        Whitened problem.
    mu : float
        Hyper-parameter, m^(4/3).

    Returns
    -------
    ndarray, (k,)
        m^(-2/3). Infinite where neither data nor prior determine a slice. They tend to the prior's own spread,
        mu^(-1/2) for a white prior, where the data say nothing, and shrink with a mu chosen too large.
    """
    return np.asarray(np.sqrt(np.diag(posterior_covariance(problem, mu))))


def ml_error(problem: LinearProblem) -> Floats:
    """Standard errors of the maximum likelihood profile, sqrt(diag((M^T C_conv^-1 M)^-1)): mu = 0.

    They do not depend on the prior (Sauvage et al. 2021 call them very conservative).

    Parameters
    ----------
    problem : LinearProblem
        Whitened problem.

    Returns
    -------
    ndarray, (k,)
        m^(-2/3). If M^T C_conv^-1 M is singular (condition number of the column-scaled response above 1e13),
        slices with a share in its null space get infinity and the others the error of the pseudo-inverse, which
        is theirs whatever the undetermined slices are.
    """
    return map_error(problem, 0.0)


def averaging_kernel(problem: LinearProblem, mu: float) -> Floats:
    """Averaging kernels, the sensitivity of the linear solution to the true profile.

    ``K = (A^T A + mu R)^-1 A^T A`` (Rodgers 2000, "Inverse Methods for Atmospheric Sounding", section
    2.4.2): row i says from which slices estimate i is made.

    Parameters
    ----------
    problem : LinearProblem
        Whitened problem.
    mu : float
        Hyper-parameter, m^(4/3).

    Returns
    -------
    ndarray, (k, k)
        Dimensionless; [estimated slice, true slice].
    """
    modes = problem.modes
    triangle, _, _ = problem.triangle
    filters = modes.filters(mu)
    weight = np.divide(filters, modes.gain**2, out=np.zeros_like(filters), where=modes.gain > 0)
    seen = triangle @ modes.vectors
    return np.asarray((modes.vectors * weight) @ seen.T @ triangle)


def degrees_of_freedom(problem: LinearProblem, mu: float) -> float:
    """Degrees of freedom for signal: how many independent numbers about the profile the data give.

    Parameters
    ----------
    problem : LinearProblem
        Whitened problem.
    mu : float
        Hyper-parameter, m^(4/3).

    Returns
    -------
    float
        Trace of the averaging kernel, between 0 and k.
    """
    return float(problem.modes.filters(mu).sum())


def resolution_length(kernel: Floats, grid: SliceGrid) -> Floats:
    """Resolution length of each slice from its averaging kernel.

    The thickness of the slice over the diagonal of the kernel, the reciprocal of the density of degrees of
    freedom along the path (Purser & Huang 1993, J. Appl. Meteor. 32, 1092, who show that widths of the kernel
    mislead where it has side lobes, as those of Cn2 have).

    No estimate stands for more than the path. One that answers by less than half both to its own slice (the
    diagonal) and to a profile that rises everywhere (the area of the kernel, the part of the estimate that comes
    from the data: Rodgers 2000, "Inverse Methods for Atmospheric Sounding", chapter 3) is more the prior's than the
    data's: that slice is not resolved and has no length.

    Parameters
    ----------
    kernel : ndarray, (k, k)
        Averaging kernels.
    grid : SliceGrid
        The slices.

    Returns
    -------
    ndarray, (k,)
        m; from the thickness of the slice to the length of all slices, NaN where the slice is not resolved.
    """
    thickness = np.asarray(grid.thickness, dtype=float)
    own = np.clip(np.diag(kernel), 0.0, 1.0)
    path = np.full(thickness.shape, thickness.sum())
    length = np.minimum(np.divide(thickness, own, out=path.copy(), where=own > 0), path)
    return np.where((own < 0.5) & (kernel.sum(axis=1) < 0.5), np.nan, length)
