r"""Extended Rytov theory: which eddies of strong turbulence still act on the scintillation.

Andrews, Phillips, Hopen and Al-Habash 1999 (https://doi.org/10.1364/JOSAA.16.001417; Andrews and Phillips, Laser Beam
Propagation through Random Media, 2nd ed., Chap. 9, https://doi.org/10.1117/3.626196) keep the first-order integrals,
but let only eddies act that are larger than the scattering disc or smaller than the coherence radius. For a spherical
wave without inner scale the index spectrum is multiplied by

    G(kappa) = exp(-kappa^2 / kappa_x^2) + [kappa^2 / (kappa^2 + kappa_y^2)]^(11/6),
    kappa_x^2 = 8.56 (k / L) / (1 + 0.56 b^(12/5)),     kappa_y^2 = 9 (k / L) (1 + 0.69 b^(12/5)),

with b^2 the first-order scintillation index of a point source. The constants make the approximate integrals of the two
terms 0.49 b^2 and 0.51 b^2 without saturation. Our integrals are exact, and with them G would reduce weak scintillation
by a quarter; so G is divided by its value at b = 0, and weak turbulence keeps the first-order response.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def growth(point_index: float | Array) -> Array:
    """b^(12/5) of an index b^2, in which the filters are smooth."""
    return np.asarray(np.asarray(point_index) ** 1.2)


def filters(f: Array, wavelength: float, path_length: float, point_index: float) -> tuple[Array, Array]:
    """Large-scale and small-scale filter, whose sum is G(kappa).

    Parameters
    ----------
    f : ndarray of float
        Spatial frequency at the layer, cycles per m.
    wavelength, path_length : float
        Wavelength and finite length L of the path, m.
    point_index : float
        First-order scintillation index b^2 of one point of the source.

    Returns
    -------
    (ndarray of float, ndarray of float)
        Of the shape of `f`.
    """
    fresnel = 2 * np.pi * wavelength * path_length * f**2  # kappa^2 L / k
    b = growth(point_index)
    large = np.exp(-fresnel * (1 + 0.56 * b) / 8.56)
    small = (fresnel / (fresnel + 9 * (1 + 0.69 * b))) ** (11 / 6)
    return np.asarray(large), np.asarray(small)


def suppression(f: Array, wavelength: float, path_length: float, point_index: float) -> Array:
    """G(kappa) over its value without turbulence; parameters as for :func:`filters`."""
    strong = sum(filters(f, wavelength, path_length, point_index))
    return np.asarray(strong / sum(filters(f, wavelength, path_length, 0.0)))
