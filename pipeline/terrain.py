"""Height of the line of sight above the ground, from a transect of the terrain below it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .geometry import SliceGrid

Array: TypeAlias = NDArray[np.float64]

#: Mean radius of the Earth, m, and the part of its curvature that refraction gives to the light.
EARTH, REFRACTION = 6.371e6, 0.13


@dataclass(frozen=True)
class Transect:
    """Elevation of the ground below the line of sight.

    Parameters
    ----------
    distance : ndarray of float, (n,)
        Distance from the pupil, m, increasing.
    elevation : ndarray of float, (n,)
        Elevation, m; straight in between.

    Raises
    ------
    ValueError
        Fewer than two points, distances that do not increase, or numbers that are not finite.
    """

    distance: Array
    elevation: Array

    def __post_init__(self) -> None:
        if self.distance.shape != self.elevation.shape or self.distance.ndim != 1 or self.distance.size < 2:
            raise ValueError("a transect needs at least two points, with an elevation for each distance")
        if not (np.isfinite(self.distance).all() and np.isfinite(self.elevation).all()):
            raise ValueError("distances and elevations of a transect must be finite")
        if not (np.diff(self.distance) > 0).all():
            raise ValueError("the distances of a transect must increase")


@dataclass(frozen=True)
class Beam:
    """A line of sight.

    Parameters
    ----------
    length : float
        Path length, m.
    start, end : float
        Elevation at the pupil and at the sources, m, on the datum of the transect.
    refraction : float
        Curvature of the light over that of the Earth; 0.13 by day over land, as surveyors take it.
    """

    length: float
    start: float
    end: float
    refraction: float = REFRACTION

    def elevation(self, z: Array) -> Array:
        """Elevation of the light at distances z from the pupil, m.

        Straight in space, it passes (1 - refraction) z (L - z) / (2 R) below the straight line over a curved datum.
        """
        straight = self.start + (self.end - self.start) * z / self.length
        return np.asarray(straight - (1 - self.refraction) * z * (self.length - z) / (2 * EARTH))


def beam_above_ground(
    transect: Transect, length: float, pupil: float, sources: float, refraction: float = REFRACTION
) -> Beam:
    """The line of sight between ends whose height above the ground is known.

    Parameters
    ----------
    transect : Transect
        Ground.
    length : float
        Path length, m.
    pupil, sources : float
        Heights above the ground at either end, m.
    refraction : float
        See :class:`Beam`.

    Returns
    -------
    Beam
    """
    ground = np.interp([0.0, length], transect.distance, transect.elevation)
    return Beam(length, float(ground[0]) + pupil, float(ground[1]) + sources, refraction)


def heights(transect: Transect, beam: Beam, z: Array) -> Array:
    """Height of the line of sight above the ground.

    Parameters
    ----------
    transect : Transect
        Ground.
    beam : Beam
        Line of sight.
    z : ndarray of float, (n,)
        Distances from the pupil, m.

    Returns
    -------
    ndarray of float, (n,)
        Heights, m; negative where the ground is in the way, NaN beyond the transect.
    """
    z = np.asarray(z, dtype=np.float64)
    inside = (z >= transect.distance[0]) & (z <= transect.distance[-1])
    return np.where(inside, beam.elevation(z) - np.interp(z, transect.distance, transect.elevation), np.nan)


def slice_heights(transect: Transect, beam: Beam, grid: SliceGrid, *, exponent: float = 1.0) -> Array:
    """Mean height of the line of sight above the ground in each slice.

    Parameters
    ----------
    transect : Transect
        Ground.
    beam : Beam
        Line of sight.
    grid : SliceGrid
        Slices.
    exponent : float
        1 for the mean height; -4/3 for the height whose Cn2 under free convection is the mean Cn2 of the slice.

    Returns
    -------
    ndarray of float, (k,)
        Heights, m; NaN where the transect does not cover the slice, or the ground is in the way.
    """
    nodes, rule = np.polynomial.legendre.leggauss(8)
    found = np.full(grid.k, np.nan)
    for number, (low, high) in enumerate(zip(grid.edges[:-1], grid.edges[1:], strict=True)):
        # The points of the transect are kinks: each stretch between them is integrated for itself.
        points = transect.distance[(transect.distance > low) & (transect.distance < high)]
        edges = np.concatenate([[low], points, [high]])
        half = np.diff(edges)[:, None] / 2
        h = heights(transect, beam, (edges[:-1, None] + half) + half * nodes)
        if (h > 0).all():
            found[number] = (np.sum(half * rule * h**exponent) / (high - low)) ** (1 / exponent)
    return found
