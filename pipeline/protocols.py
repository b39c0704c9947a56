"""What the science asks of a plugin, so that it can call one without importing any."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .geometry import SliceGrid
    from .inversion import LinearProblem, Selection


class SourceModel(Protocol):
    """Intensity distribution P of one source, normalised to 1."""

    @property
    def version(self) -> int:
        """Integer that moves whenever the numbers move."""

    def transfer(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> NDArray[Any]:
        """Fourier transform of P, integral of P(s) exp(-2 pi i f.s), 1 at f = 0; f in cycles per m (or rad)."""

    def moment(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Fourier transforms of x P(x, y) and y P(x, y)."""


class TurbulenceSpectrum(Protocol):
    """Power spectral density of the refractive index."""

    @property
    def version(self) -> int:
        """Integer that moves whenever the numbers move."""

    def psd(self, f: NDArray[np.float64]) -> NDArray[np.float64]:
        """S_n(f) for Cn2 dz = 1 (Sauvage et al. 2021, Eq. (14)); f = |f| in cycles per m."""


class Regulariser(Protocol):
    """Prior of the profile, J_prior = mu x^T R x."""

    @property
    def version(self) -> int:
        """Integer that moves whenever the numbers move."""

    def precision(self, grid: SliceGrid) -> NDArray[np.float64]:
        """R, (k, k), symmetric and positive semi-definite, without unit."""


class HyperparameterSelector(Protocol):
    """Choice of the hyperparameter mu."""

    @property
    def version(self) -> int:
        """Integer that moves whenever the numbers move."""

    def select(self, problem: LinearProblem) -> Selection:
        """Choose mu, and return it with the criterion curve it was chosen from."""
