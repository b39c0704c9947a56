"""Heights of two beams over one terrain: the line of sight, and a scintillometer that does not stand on it.

Both beams are straight and bent alike by the air, so that their separation is linear between the scintillometer's ends
whatever the ground does. Turbulence is carried from one height to the other as free convection over ground that is
uniform across the path has it, Cn2 ~ h^(-4/3) (Wyngaard, Izumi and Collins 1971, Journal of the Optical Society of
America 61, 1646, https://doi.org/10.1364/JOSA.61.001646).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .terrain import Beam, Transect, slice_heights

if TYPE_CHECKING:
    from .geometry import SliceGrid
    from .parameters import Path, Scintillometer

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SightHeights:
    """Height of the line of sight above ground.

    Parameters
    ----------
    effective : ndarray of float, (k,)
        Height of each slice whose free convection is the mean of it: (mean of h^(-4/3))^(-3/4), m; NaN if unknown.
    borders : ndarray of float, (k + 1,)
        Height at the borders of the slices, m; NaN if unknown.
    """

    effective: Array
    borders: Array


def sight_heights(path: Path, grid: SliceGrid) -> SightHeights | None:
    """Heights of the line of sight that a header tells.

    Parameters
    ----------
    path : Path
        Line of sight, with `heights` or a mean `height`.
    grid : SliceGrid
        Slices.

    Returns
    -------
    SightHeights or None
        None where the header says nothing of heights.
    """
    if path.heights is not None:
        z, above = np.array(path.heights).T
        # Heights as they are: the ground lies that much below a straight line at zero.
        level = Beam(float(z[-1]), 0.0, 0.0, refraction=1.0)
        edges = np.asarray(grid.edges)
        known = (edges >= z[0]) & (edges <= z[-1])
        return SightHeights(
            slice_heights(Transect(z, -above), level, grid, exponent=-4 / 3),
            np.where(known, np.interp(edges, z, above), np.nan),
        )
    if path.height is not None and path.height > 0:
        return SightHeights(np.full(grid.k, path.height), np.full(grid.k + 1, path.height))
    return None


def beam_heights(one: Scintillometer, path_length: float, grid: SliceGrid, sight: SightHeights | None) -> Array:
    """Height of a scintillometer's beam above ground in each slice.

    Parameters
    ----------
    one : Scintillometer
        With the heights of its ends.
    path_length : float
        m.
    grid : SliceGrid
        Slices.
    sight : SightHeights or None
        Line of sight, whose height at the ends of the scintillometer says how far the two beams are apart. An end
        beyond the slices counts as at their border.

    Returns
    -------
    ndarray of float, (k,)
        The height of the line of sight in the sense of :class:`SightHeights` plus the separation of the beams in the
        middle of the part of the slice that the scintillometer looks through, m; where the height changes by a quarter
        along one slice, this is within 1 % of the (mean of h^(-4/3))^(-3/4) of the beam itself. NaN where a height is
        not known, and beyond the ends.
    """
    start, stop = one.ends(path_length)
    edges = np.clip(np.asarray(grid.edges), start, stop)
    middle = (edges[1:] + edges[:-1]) / 2
    if one.heights is None or sight is None:
        return np.full(grid.k, np.nan)
    apart = np.array(one.heights) - np.interp([start, stop], grid.edges, sight.borders)
    separation = apart[0] + (apart[1] - apart[0]) * (middle - start) / (stop - start)
    return np.where(edges[1:] > edges[:-1], sight.effective + separation, np.nan)


def height_factors(heights: Array, effective: Array) -> Array:
    """Factor of Cn2 from one height to another under free convection.

    Parameters
    ----------
    heights, effective : ndarray of float, (k,)
        Heights to and from, m.

    Returns
    -------
    ndarray of float, (k,)
        (heights / effective)^(-4/3); NaN where a height is not known or not above the ground.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where((heights > 0) & (effective > 0), heights / effective, np.nan)
    return np.asarray(ratio ** (-4 / 3))


def carried_weights(weights: Array, factors: Array) -> Array:
    """Weights that give the Cn2 at the scintillometer's height.

    Parameters
    ----------
    weights : ndarray of float, (..., k)
        Weights of the slices, summing to 1.
    factors : ndarray of float, (..., k)
        Of :func:`height_factors`.

    Returns
    -------
    ndarray of float, (..., k)
        Their product, zero where the weight is: a height that nobody looks at need not be known.
    """
    return np.where(weights == 0, 0.0, weights * factors)


def mean_separation(heights: Array, effective: Array, weights: Array) -> float:
    """Mean height of a beam above the line of sight, as its scintillometer weights the path, m; NaN if unknown."""
    used = weights > 0
    return float(weights[used] @ (heights - effective)[used] / weights[used].sum())


def scaled_weights(
    one: Scintillometer, path_length: float, grid: SliceGrid, weights: Array, sight: SightHeights | None
) -> Array:
    """Weights of the slices in the Cn2 of a scintillometer, carried to its height where it asks for that.

    Parameters
    ----------
    one : Scintillometer
        With `height_scaling`.
    path_length : float
        m.
    grid : SliceGrid
        Slices.
    weights : ndarray of float, (k,)
        Of :func:`coslidar.pipeline.scintillometer.slice_weights`.
    sight : SightHeights or None
        Line of sight.

    Returns
    -------
    ndarray of float, (k,)

    Raises
    ------
    ValueError
        The beam runs into the ground, or the scaling lacks a height.
    """
    beam = beam_heights(one, path_length, grid, sight)
    with np.errstate(invalid="ignore"):
        low = beam <= 0
    if low.any():
        raise ValueError(
            f"the beam runs {-np.nanmin(beam):.1f} m below the ground at {grid.centres[np.nanargmin(beam)]:.0f} m; "
            "check heights (above the ground, at the pupil's end and at the sources' end)"
        )
    if one.height_scaling == "none":
        return weights
    factors = np.full(grid.k, np.nan) if sight is None else height_factors(beam, sight.effective)
    carried = carried_weights(weights, factors)
    if not np.isfinite(carried).all():
        raise ValueError(
            "height_scaling needs the height of the line of sight above ground all along the beam; give path.height, "
            "path.heights, or a table [terrain], and run again"
        )
    return carried
