r"""Scintillation of moderate strength, corrected in several rounds of inversion.

The filters of :mod:`.extended_rytov` give the covariance of ln I, and the covariance of I is exp(.) - 1, for light that
apertures and source have averaged too (Andrews and Phillips, Laser Beam Propagation through Random Media, 2nd ed.,
Chap. 10, https://doi.org/10.1117/3.626196). The theory was made for uniform turbulence; here the index b^2 of a point
source is that of the retrieved profile, with the weights of a spherical wave.

The response then depends on the profile. With W_b the scintillation response of the filtered spectrum, a map is

    C = exp(c) - 1 = [(exp(c) - 1) / c] W_b Cn2,     c = W_b Cn2,

linear in Cn2 but for b and the bracket. Both are taken from the profile of the round before, beginning with that of the
first-order response, until the response stands still. Slopes keep their first-order response.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import barycentric_interpolate

from .extended_rytov import growth
from .response import response_matrix
from .turbulence import point_source_weights

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from .geometry import Geometry, SliceGrid
    from .parameters import ResponseParameters
    from .protocols import SourceModel, TurbulenceSpectrum
    from .turbulence import Sampling

    Array = NDArray[np.float64]

#: Largest index of a point source that is corrected for; what lies above is corrected as if it were this.
STRONGEST = 2.0
#: Indices at which the response is computed: Chebyshev's extrema in b^(12/5), between which interpolation is good to
#: 1e-4 of a map's maximum, a hundredth of what the theory is good for.
LEVELS: Array = (growth(STRONGEST) * (1 - np.cos(np.pi * np.arange(6) / 5)) / 2) ** (1 / 1.2)
#: Change of the response, relative to its largest entry, below which the rounds end, and their number at most.
SETTLED = 1e-3
ROUNDS = 12


def responses(
    geometry: Geometry,
    grid: SliceGrid,
    spectrum: TurbulenceSpectrum,
    sources: Sequence[SourceModel],
    parameters: ResponseParameters,
) -> dict[str, Array]:
    """Response matrix, and where it is corrected for strong scintillation, that of every level.

    Parameters
    ----------
    geometry, grid, spectrum, sources
        As for :func:`~coslidar.pipeline.response.response_matrix`.
    parameters : ResponseParameters
        How the response is made.

    Returns
    -------
    dict of str to ndarray
        `M` (m, k), and with `scintillation = "extended_rytov"` also `scintillation` (levels, n, k), the rows of M that
        belong to scintillation, its last third, at each of :data:`LEVELS`.
    """
    options = parameters.options(geometry)
    matrix = response_matrix(geometry, grid, spectrum, sources, **options)
    if parameters.scintillation == "first_order":
        return {"M": matrix}
    rows = slice(-len(matrix) // 3, None)
    levels = [matrix[rows]]
    for level in LEVELS[1:]:
        levels.append(response_matrix(geometry, grid, spectrum, sources, **options, point_index=float(level))[rows])
    return {"M": matrix, "scintillation": np.stack(levels)}


def from_responses(
    found: Mapping[str, Array], geometry: Geometry, grid: SliceGrid, sampling: Sampling
) -> StrongScintillation | None:
    """What :func:`responses` gave, ready for use; None without correction."""
    if "scintillation" not in found:
        return None
    weights = point_source_weights(grid, geometry.wavelength, geometry.path_length, sampling=sampling)
    return StrongScintillation(found["scintillation"], weights)


def moved(before: Array, after: Array) -> bool:
    """Whether the scintillation rows of a response matrix still change from round to round."""
    rows = slice(-len(after) // 3, None)
    change = np.abs(after[rows] - before[rows])
    return bool(np.nanmax(change) > SETTLED * np.nanmax(np.abs(after[rows])))


@dataclass(frozen=True, eq=False)
class StrongScintillation:
    """Scintillation responses for several strengths of turbulence.

    Parameters
    ----------
    responses : ndarray of float, (levels, n, k)
        Scintillation rows of the response matrix at each of :data:`LEVELS`.
    point_weights : ndarray of float, (k,)
        Index of one point of the source per Cn2; see :func:`~coslidar.pipeline.turbulence.point_source_weights`.
    """

    responses: Array
    point_weights: Array

    def matrix(self, first_order: Array, cn2: Array) -> Array:
        """Response matrix for profiles near a given one.

        Parameters
        ----------
        first_order : ndarray of float, (m, k)
            First-order response matrix, whose last n rows are those of scintillation.
        cn2 : ndarray of float, (k,)
            Profile, m^(-2/3).

        Returns
        -------
        ndarray of float, (m, k)
            The same with other scintillation rows; times `cn2` they give the maps of that profile.
        """
        index = min(float(self.point_weights @ cn2), STRONGEST)
        rows = barycentric_interpolate(growth(LEVELS), self.responses, growth(index))
        covariance = rows @ cn2
        small = np.abs(covariance) < 1e-9
        safe = np.where(small, 1.0, covariance)
        rows = rows * np.where(small, 1.0, np.expm1(safe) / safe)[:, None]
        return np.concatenate([first_order[: -len(rows)], rows])
