"""Quadratic priors of the profile, J_prior = mu x^T R x.

R has no unit, and every prior is scaled so that mu (m^(4/3)) keeps one meaning: mu^(-1/2) is the standard
deviation of what is penalised, Cn2 of a slice for `white`, its difference or second difference from slice to
slice for `gradient` and `laplacian`. Derivatives are taken per mean spacing of the slices, so that equal
slices give the plain differences and unequal ones the same integral.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field, model_validator

from ..pipeline.units import Length, TurbulenceStrength
from .contract import RegulariserBase

if TYPE_CHECKING:
    from typing import Self

    from numpy.typing import NDArray

    from ..pipeline.geometry import SliceGrid


def _gradient(grid: SliceGrid) -> NDArray[np.float64]:
    """First differences, (k - 1, k): sum of squares is h times the integral of (dx/dz)^2, h the mean
    spacing.
    """
    spacing = np.diff(grid.centres)
    rows = np.diff(np.eye(grid.k), axis=0)
    return np.asarray(rows * np.sqrt(spacing.mean() / spacing)[:, None]) if spacing.size else rows


def _laplacian(grid: SliceGrid) -> NDArray[np.float64]:
    """Second differences at inner slices, (k - 2, k): sum of squares is h^3 times the integral of
    (d2x/dz2)^2.
    """
    if grid.k < 3:
        return np.zeros((0, grid.k))
    spacing = np.diff(grid.centres)
    slopes = np.diff(np.eye(grid.k), axis=0) / spacing[:, None]
    width = (spacing[1:] + spacing[:-1]) / 2
    return np.asarray(np.diff(slopes, axis=0) * (spacing.mean() ** 1.5 / np.sqrt(width))[:, None])


class _Scaled(RegulariserBase):
    """What all priors share: a relative scale per slice."""

    scale: tuple[float, ...] = ()
    """Prior scale of each slice relative to the others: the prior then holds for Cn2 divided by it. Empty:
    all 1.
    """

    @model_validator(mode="after")
    def _positive(self) -> Self:
        if not all(np.isfinite(value) and value > 0 for value in self.scale):
            raise ValueError("scale: every slice needs a finite scale above 0")
        return self

    def _rescaled(self, precision: NDArray[np.float64], grid: SliceGrid) -> NDArray[np.float64]:
        if not self.scale:
            return precision
        if len(self.scale) != grid.k:
            raise ValueError(f"{self.name}: scale has {len(self.scale)} values, the profile {grid.k} slices")
        scale = np.asarray(self.scale)
        return np.asarray(precision / scale / scale[:, None])


class White(_Scaled):
    """Independent slices, R = I: the prior of Sauvage et al. 2021.

    With `scale`, its more general form, sum over slices of (x_i / sigma_i)^2, sigma_i = scale_i mu^(-1/2).
    """

    name: ClassVar[str] = "white"
    examples: ClassVar = ({"scale": tuple(range(1, 13))},)

    def precision(self, grid: SliceGrid) -> NDArray[np.float64]:
        """Identity, over the squared scale of each slice."""
        return self._rescaled(np.eye(grid.k), grid)


class Gradient(_Scaled):
    """Smooth profiles, x^T R x = sum of (x_(i+1) - x_i)^2, as Voyez et al. 2014
    (https://doi.org/10.1364/OE.22.010948).

    A constant profile costs nothing; with one slice R = 0.
    """

    name: ClassVar[str] = "gradient"

    def precision(self, grid: SliceGrid) -> NDArray[np.float64]:
        """Squared first differences."""
        rows = _gradient(grid)
        return self._rescaled(rows.T @ rows, grid)


class Laplacian(_Scaled):
    """Profiles without sharp bends, x^T R x = sum of (x_(i-1) - 2 x_i + x_(i+1))^2 over inner slices.

    A profile linear in z costs nothing; with fewer than three slices R = 0.
    """

    name: ClassVar[str] = "laplacian"

    def precision(self, grid: SliceGrid) -> NDArray[np.float64]:
        """Squared second differences."""
        rows = _laplacian(grid)
        return self._rescaled(rows.T @ rows, grid)


class WeightedLaplacian(_Scaled):
    """Laplacian divided by the strength expected at each slice, after Vedrenne et al. 2007.

    (https://doi.org/10.1364/OL.32.002659). Where the reference profile is strong the estimate may bend more.
    The reference is interpolated at mid-slice, linearly in log Cn2 and constant beyond its ends, and divided
    by its root mean square over the slices, so that its overall level does not change the meaning of mu.
    """

    name: ClassVar[str] = "weighted_laplacian"
    examples: ClassVar = ({"reference_z": ("100 m", "2 km"), "reference_cn2": ("1e-14 m^(-2/3)", "1e-13 m^(-2/3)")},)

    reference_z: tuple[Length, ...] = ()
    """Distances from the pupil at which the reference is given, increasing. Empty: all slices weigh the
    same.
    """
    reference_cn2: tuple[TurbulenceStrength, ...] = ()
    """Cn2 expected there, above 0."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(self.reference_z) != len(self.reference_cn2):
            raise ValueError(
                f"reference_z has {len(self.reference_z)} values and reference_cn2 {len(self.reference_cn2)}; "
                "give one Cn2 for each distance"
            )
        if any(value <= 0 for value in self.reference_cn2):
            raise ValueError("reference_cn2: every value must be above 0")
        if any(b <= a for a, b in zip(self.reference_z, self.reference_z[1:], strict=False)):
            raise ValueError("reference_z: distances must increase")
        return self

    def precision(self, grid: SliceGrid) -> NDArray[np.float64]:
        """Squared second differences over the squared reference."""
        rows = _laplacian(grid)
        if self.reference_z and len(rows):
            strength = np.exp(np.interp(grid.centres, self.reference_z, np.log(self.reference_cn2)))
            weight = strength / np.sqrt(np.mean(strength**2))
            rows = rows / weight[1:-1, None]
        return self._rescaled(rows.T @ rows, grid)


class WhiteGradient(_Scaled):
    """Sum of `white` and `ratio` times `gradient`."""

    name: ClassVar[str] = "white_gradient"

    ratio: float = Field(1.0, ge=0, allow_inf_nan=False)
    """Weight of the squared differences beside the squared values."""

    def precision(self, grid: SliceGrid) -> NDArray[np.float64]:
        """Identity plus squared first differences."""
        rows = _gradient(grid)
        return self._rescaled(np.eye(grid.k) + self.ratio * rows.T @ rows, grid)


class Exponential(_Scaled):
    """Correlated Gaussian prior, covariance exp(-|z_i - z_j| / length) / mu between slices i and j.

    R is the inverse of that matrix in closed form (the prior is a Markov chain, so R is tridiagonal). A short
    length gives `white`, a long one tends to `gradient`.
    """

    name: ClassVar[str] = "exponential"

    length: Length = Field("300 m", gt=0)  # type: ignore[assignment]
    """Correlation length along the path."""

    def precision(self, grid: SliceGrid) -> NDArray[np.float64]:
        """Inverse of the exponential correlation matrix."""
        spacing = np.diff(grid.centres) / self.length
        step = np.exp(-spacing)
        # (x_(i+1) - step x_i)^2 over its variance 1 - step^2; expm1 because slices may be nearly equal.
        spread = np.sqrt(-np.expm1(-2 * spacing))
        rows = (np.eye(grid.k)[1:] - step[:, None] * np.eye(grid.k)[:-1]) / spread[:, None]
        precision = rows.T @ rows
        precision[0, 0] += 1.0
        return self._rescaled(precision, grid)
