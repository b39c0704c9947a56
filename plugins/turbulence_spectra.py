"""Power spectral densities of the refractive index.

Every spectrum is given for Cn2 dz = 1 in the convention of Sauvage et al. 2021 (https://doi.org/10.1364/AO.438170),
Eq. (14): with f in cycles per m and kappa = 2 pi f, S_n(f) = (2 pi)^3 Phi_n(2 pi f) for the three-dimensional
spectrum Phi_n(kappa) of the index, so that Kolmogorov's 0.033 kappa^(-11/3) becomes
0.033 (2 pi)^(-2/3) f^(-11/3).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field
from scipy.special import gamma

from ..pipeline.units import Length
from .contract import TurbulenceSpectrumBase

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: 0.033 (2 pi)^(-2/3): Kolmogorov's constant for frequencies in cycles per m.
_CONSTANT = 0.033 * (2 * np.pi) ** (-2 / 3)


def _energy_range(f: NDArray[np.float64], outer_scale: float | None) -> NDArray[np.float64]:
    """S_n with its low frequencies levelled off at the outer scale (m), or Kolmogorov's where there is none."""
    if outer_scale is None:
        return np.asarray(_CONSTANT * f ** (-11 / 3))
    return np.asarray(_CONSTANT * (f**2 + outer_scale**-2.0) ** (-11 / 6))


class Kolmogorov(TurbulenceSpectrumBase):
    """Inertial range without inner or outer scale.

    S_n(f) = 0.033 (2 pi)^(-2/3) f^(-11/3): Sauvage et al. 2021, Eq. (14), https://doi.org/10.1364/AO.438170; Andrews
    and Phillips, Laser Beam Propagation through Random Media, 2nd ed., Eq. (3.18), https://doi.org/10.1117/3.626196.
    """

    name: ClassVar[str] = "kolmogorov"

    def psd(self, f: NDArray[np.float64]) -> NDArray[np.float64]:
        """S_n(f) for Cn2 dz = 1; see :meth:`TurbulenceSpectrumBase.psd`."""
        return _energy_range(f, None)


class VonKarman(TurbulenceSpectrumBase):
    """Finite outer scale L0.

    S_n(f) = 0.033 (2 pi)^(-2/3) (f^2 + 1/L0^2)^(-11/6): the von Karman form of the index spectrum with
    kappa_0 = 2 pi / L0 (Andrews and Phillips, Laser Beam Propagation through Random Media, 2nd ed., Eq. (3.20),
    https://doi.org/10.1117/3.626196).
    """

    name: ClassVar[str] = "von_karman"
    examples: ClassVar = ({"outer_scale": "10 m"},)

    outer_scale: Length = Field(gt=0)
    """Outer scale L0; kappa_0 is 2 pi / L0."""

    def psd(self, f: NDArray[np.float64]) -> NDArray[np.float64]:
        """S_n(f) for Cn2 dz = 1; see :meth:`TurbulenceSpectrumBase.psd`."""
        return _energy_range(f, self.outer_scale)


class Tatarskii(TurbulenceSpectrumBase):
    """Gaussian cut at the inner scale l0.

    S_n(f) = 0.033 (2 pi)^(-2/3) (f^2 + 1/L0^2)^(-11/6) exp(-kappa^2 / kappa_m^2), kappa_m = 5.92 / l0 (Andrews and
    Phillips, Eq. (3.19) and (3.20), https://doi.org/10.1117/3.626196; Tatarskii 1971).
    """

    name: ClassVar[str] = "tatarskii"
    examples: ClassVar = ({"inner_scale": "5 mm"}, {"inner_scale": "5 mm", "outer_scale": "0.4 m"})

    inner_scale: Length = Field(gt=0)
    """Inner scale l0; kappa_m is 5.92 / l0."""

    outer_scale: Length | None = Field(default=None, gt=0)
    """Outer scale L0; none where it is absent."""

    def psd(self, f: NDArray[np.float64]) -> NDArray[np.float64]:
        """S_n(f) for Cn2 dz = 1; see :meth:`TurbulenceSpectrumBase.psd`."""
        ratio = 2 * np.pi * f * self.inner_scale / 5.92
        return np.asarray(_energy_range(f, self.outer_scale) * np.exp(-(ratio**2)))


class Hill(TurbulenceSpectrumBase):
    """Hill's bump before the inner scale, in the analytic form of Andrews.

    S_n(f) = 0.033 (2 pi)^(-2/3) (f^2 + 1/L0^2)^(-11/6) [1 + 1.802 r - 0.254 r^(7/6)] exp(-r^2), with
    r = kappa / kappa_l and kappa_l = 3.3 / l0 (Andrews 1992, https://doi.org/10.1080/09500349214551931; Hill 1978,
    https://doi.org/10.1017/S002211207800227X).
    """

    name: ClassVar[str] = "hill"
    examples: ClassVar = ({"inner_scale": "5 mm"}, {"inner_scale": "1 cm", "outer_scale": "2 m"})

    inner_scale: Length = Field(gt=0)
    """Inner scale l0; kappa_l is 3.3 / l0."""

    outer_scale: Length | None = Field(default=None, gt=0)
    """Outer scale L0; none where it is absent."""

    def psd(self, f: NDArray[np.float64]) -> NDArray[np.float64]:
        """S_n(f) for Cn2 dz = 1; see :meth:`TurbulenceSpectrumBase.psd`."""
        r = 2 * np.pi * f * self.inner_scale / 3.3
        bump = 1 + 1.802 * r - 0.254 * r ** (7 / 6)
        return np.asarray(_energy_range(f, self.outer_scale) * bump * np.exp(-(r**2)))


class PowerLaw(TurbulenceSpectrumBase):
    """Power law of another exponent than Kolmogorov's.

    Phi_n(kappa) = A(a) B kappa^(-a) with A(a) = Gamma(a - 1) cos(a pi / 2) / (4 pi^2), whose index structure function
    is B r^(a - 3) for 3 < a < 5 (Toselli et al. 2008, https://doi.org/10.1117/1.2870113); slopes have a finite
    variance for a < 4 only. Normalisation: Cn2 is defined by the structure function at the
    reference separation, B = Cn2 r_ref^(11/3 - a), so that D_n(r_ref) = Cn2 r_ref^(2/3) for every exponent. With
    a = 11/3, A = 0.0330 and the spectrum is Kolmogorov's (to 1e-3: 0.033 is rounded there).
    """

    name: ClassVar[str] = "power_law"
    examples: ClassVar = ({"exponent": 3.1}, {"exponent": 3.9, "reference": "1 mm"})

    exponent: float = Field(gt=3, lt=4)
    """Exponent a of the three-dimensional spectrum; Kolmogorov's is 11/3."""

    reference: Length = Field(default="1 m", gt=0, validate_default=True)
    """Separation r_ref at which the structure function is that of Kolmogorov's spectrum."""

    def psd(self, f: NDArray[np.float64]) -> NDArray[np.float64]:
        """S_n(f) for Cn2 dz = 1; see :meth:`TurbulenceSpectrumBase.psd`."""
        a = self.exponent
        amplitude = gamma(a - 1) * np.cos(a * np.pi / 2) / (4 * np.pi**2) * self.reference ** (11 / 3 - a)
        return np.asarray(amplitude * (2 * np.pi) ** (3 - a) * f**-a)
