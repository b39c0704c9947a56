"""Choice of the hyper-parameter mu of the prior.

Every selector evaluates a criterion on a grid of log10(mu / m^(4/3)) and takes its smallest value; it
returns the whole curve, and says when the minimum lies at an end of the grid.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from ..pipeline import inversion, posterior
from ..pipeline.units import Hyperparameter
from .contract import HyperparameterSelectorBase

if TYPE_CHECKING:
    from typing import Self

    from numpy.typing import NDArray

    from ..pipeline.inversion import LinearProblem, Selection


class _Ranged(HyperparameterSelectorBase):
    """What all selectors share: the grid of log10(mu / m^(4/3))."""

    log_mu_min: float = Field(23.0, ge=-100, le=100)
    """Lower end of the range of log10(mu / m^(4/3)); 25 where Cn2 is known to stay below 10^-12.5 m^(-2/3)."""
    log_mu_max: float = Field(33.0, ge=-100, le=100)
    """Upper end of the range of log10(mu / m^(4/3))."""
    log_mu_step: float = Field(0.25, ge=0.001, le=10)
    """Step of the grid of log10(mu / m^(4/3))."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.log_mu_max < self.log_mu_min:
            raise ValueError(f"log_mu_max = {self.log_mu_max:g} lies below log_mu_min = {self.log_mu_min:g}")
        return self

    @property
    def log_mu(self) -> NDArray[np.float64]:
        """Grid of log10(mu / m^(4/3))."""
        return inversion.log_mu_grid(self.log_mu_min, self.log_mu_max, self.log_mu_step)


class GCV(_Ranged):
    """Generalised cross-validation, as printed in the appendix of Sauvage et al. 2021.

    After Golub, Heath & Wahba 1979. Needs no noise level; flat toward small mu.
    """

    name: ClassVar[str] = "gcv"

    def select(self, problem: LinearProblem) -> Selection:
        """Take mu of the smallest V(mu)."""
        return inversion.select_minimum("gcv", self.log_mu, inversion.gcv(problem, self.log_mu))


class Fixed(_Ranged):
    """A value given beforehand. The curve returned is that of generalised cross-validation, for comparison."""

    name: ClassVar[str] = "fixed"
    expected_failed_checks: ClassVar = {
        "mu_at_minimum": "mu is given; the curve is there for comparison",
        "recovers_mu": "mu is given",
    }

    mu: Hyperparameter = Field("1e27 m^(4/3)", ge=0)  # type: ignore[assignment]
    """Hyper-parameter; 0 gives the maximum-likelihood profile under positivity."""

    def select(self, problem: LinearProblem) -> Selection:
        """The given mu."""
        return inversion.Selection("gcv", self.mu, self.log_mu, inversion.gcv(problem, self.log_mu), False)


class Evidence(_Ranged):
    """Largest marginal likelihood of the data under the Gaussian prior, positivity left aside (MacKay 1992)."""

    name: ClassVar[str] = "evidence"

    def select(self, problem: LinearProblem) -> Selection:
        """Take mu of the largest evidence; the curve is -2 log of it, up to a constant."""
        return inversion.select_minimum("evidence", self.log_mu, inversion.evidence(problem, self.log_mu))


class PositiveEvidence(_Ranged):
    """Largest marginal likelihood of the data under the Gaussian prior cut off at Cn2 >= 0.

    What the profile can be enters the choice of mu as it enters the profile.
    """

    name: ClassVar[str] = "positive_evidence"

    def select(self, problem: LinearProblem) -> Selection:
        """Take mu of the largest evidence; the curve is -2 log of it, up to a constant."""
        curve = posterior.positive_evidence(problem, self.log_mu)
        return inversion.select_minimum("positive_evidence", self.log_mu, curve)


class UPRE(_Ranged):
    """Unbiased predictive risk (Mallows 1973): the smallest expected error of the fitted correlations."""

    name: ClassVar[str] = "upre"

    def select(self, problem: LinearProblem) -> Selection:
        """Take mu of the smallest estimated risk."""
        return inversion.select_minimum("upre", self.log_mu, inversion.upre(problem, self.log_mu))


class Discrepancy(_Ranged):
    """Misfit equal to its expectation (Morozov 1966). Relies on the convergence noise being known
    absolutely.
    """

    name: ClassVar[str] = "discrepancy"
    expected_failed_checks: ClassVar = {
        "recovers_mu": "a misfit of 1 per datum leaves nothing for the modes that are fitted: a decade too smooth"
    }

    tau: float = Field(1.0, gt=0, allow_inf_nan=False)
    """Misfit per datum to reach."""

    def select(self, problem: LinearProblem) -> Selection:
        """Take mu whose misfit per datum is nearest to `tau`."""
        curve = inversion.discrepancy(problem, self.log_mu, self.tau)
        return inversion.select_minimum("discrepancy", self.log_mu, curve)


class LCurve(_Ranged):
    """Corner of the L-curve, the prior term against the misfit on logarithmic axes (Hansen & O'Leary 1993)."""

    name: ClassVar[str] = "lcurve"

    def select(self, problem: LinearProblem) -> Selection:
        """Take mu of the largest curvature; the curve is the curvature with its sign turned."""
        return inversion.select_minimum("lcurve", self.log_mu, inversion.lcurve(problem, self.log_mu))


class Previous(_Ranged):
    """One mu for a batch and its neighbours: the smallest value of a criterion summed over all of them.

    mu varies slowly (by half a decade over 75 minutes in Sauvage et al. 2021) while the minimum of one batch is
    shallow. Likelihood-like curves of independent batches add: -2 log evidence, the estimated risk, and for
    generalised cross-validation n log V. Without neighbours the choice is that of the batch alone.
    """

    name: ClassVar[str] = "previous"
    version: ClassVar[int] = 2

    criterion: Literal["gcv", "evidence", "positive_evidence", "upre"] = "gcv"
    """Criterion that is summed."""
    neighbours: int = Field(2, ge=0, le=50)
    """How many batches before, and how many after, take part."""

    def select(self, problem: LinearProblem) -> Selection:
        """Take mu of the smallest sum; the curve is the mean over the batches."""
        curves = [self._curve(one) for one in (problem, *problem.neighbours)]
        return inversion.select_minimum(f"previous_{self.criterion}", self.log_mu, np.mean(curves, axis=0))

    def _curve(self, problem: LinearProblem) -> NDArray[np.float64]:
        if self.criterion == "evidence":
            return inversion.evidence(problem, self.log_mu)
        if self.criterion == "positive_evidence":
            return posterior.positive_evidence(problem, self.log_mu)
        if self.criterion == "upre":
            return inversion.upre(problem, self.log_mu)
        return np.asarray(len(problem.data) * np.log(inversion.gcv(problem, self.log_mu)))
