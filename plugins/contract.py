"""Base classes of the four kinds of plugin.

A plugin is a frozen model: its parameters are typed fields with units, its identity is its name, its integer
`version` and its parameters. A subclass sets `name` and implements one method. What is promised here in words,
:mod:`.conformance` checks by running it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..pipeline.geometry import SliceGrid
    from ..pipeline.inversion import LinearProblem, Selection


class Plugin(BaseModel):
    """A named, versioned, frozen set of parameters.

    Attributes
    ----------
    name : str
        Name in campaign files; equal to the name of the entry point.
    version : int
        Raise it whenever the same parameters give other numbers; it is part of the key of every product.
    examples : tuple of mapping
        Parameters, written as in a campaign file, with which `coslidar plugins check` tries the plugin beside its
        defaults; at least one where a parameter has no default.
    expected_failed_checks : mapping of str to str
        Name of a check that the plugin fails on purpose, and the reason.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, use_attribute_docstrings=True)

    name: ClassVar[str]
    version: ClassVar[int] = 1
    examples: ClassVar[tuple[Mapping[str, Any], ...]] = ()
    expected_failed_checks: ClassVar[Mapping[str, str]] = {}

    def identity(self) -> dict[str, Any]:
        """Name, version and parameters (SI floats): what enters the lineage."""
        return {"name": self.name, "version": self.version, "parameters": self.model_dump(mode="python")}


class SourceModelBase(Plugin):
    """Intensity distribution of a source, normalised to 1, its centroid at the position that the header gives."""

    @abstractmethod
    def transfer(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> NDArray[Any]:
        """Fourier transform of the normalised intensity P at (fx, fy), 1 at zero.

        Parameters
        ----------
        fx, fy : ndarray of float
            Spatial frequencies in cycles per m (cycles per rad for sources at infinity), of one shape.

        Returns
        -------
        ndarray
            Integral of P(s) exp(-2 pi i f.s), real or complex, of the same shape.
        """

    def moment(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Fourier transforms of x P and y P; here by central differences of :meth:`transfer`.

        The transform of s_l P(s) is (i / 2 pi) times the derivative of the transfer function along f_l. The
        step is 1e-3 of the frequency at which the transfer function has fallen by half, from its curvature
        at zero; the fourth-order difference is then good to about 1e-10.
        """
        step = self._difference_step()

        def derivative(dx: float, dy: float) -> NDArray[Any]:
            near = self.transfer(fx + dx, fy + dy) - self.transfer(fx - dx, fy - dy)
            far = self.transfer(fx + 2 * dx, fy + 2 * dy) - self.transfer(fx - 2 * dx, fy - 2 * dy)
            return np.asarray((8 * near - far) / (12 * step))

        return 1j / (2 * np.pi) * derivative(step, 0.0), 1j / (2 * np.pi) * derivative(0.0, step)

    def _difference_step(self) -> float:
        trial = np.logspace(-6, 9, 151)
        zero = np.zeros_like(trial)
        fallen = (np.abs(self.transfer(trial, zero)) < 0.5) | (np.abs(self.transfer(zero, trial)) < 0.5)
        half = trial[int(np.argmax(fallen))] if fallen.any() else trial[-1]
        return float(1e-3 * half)


class TurbulenceSpectrumBase(Plugin):
    """Power spectral density of the refractive index."""

    @abstractmethod
    def psd(self, f: NDArray[np.float64]) -> NDArray[np.float64]:
        """S_n(f) for Cn2 dz = 1.

        Parameters
        ----------
        f : ndarray of float
            Modulus of the spatial frequency in cycles per m, positive.

        Returns
        -------
        ndarray of float
            Power spectral density in the normalisation of Sauvage et al. 2021, Eq. (14).
        """


class RegulariserBase(Plugin):
    """Quadratic prior of the profile."""

    @abstractmethod
    def precision(self, grid: SliceGrid) -> NDArray[np.float64]:
        """R in J_prior = mu x^T R x.

        Parameters
        ----------
        grid : SliceGrid
            The slices of the profile.

        Returns
        -------
        ndarray of float, (k, k)
            Symmetric, positive semi-definite, without unit.

        Raises
        ------
        ValueError
            The parameters fit no such grid (a value for each of another number of slices); the message begins with
            the name of the plugin.
        """


class HyperparameterSelectorBase(Plugin):
    """Choice of the hyperparameter."""

    @abstractmethod
    def select(self, problem: LinearProblem) -> Selection:
        """Choose mu.

        Parameters
        ----------
        problem : LinearProblem
            The whitened data, the whitened response matrix and the precision.

        Returns
        -------
        Selection
            mu in m^(4/3), and the criterion curve it was chosen from; its smallest value is the best.
        """
