"""Geometry of a recording: pupil, path, sources, slices, and the order of the correlation data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

#: Kinds of correlation map, in the order of the data vector (Sauvage et al. 2021, Eq. (19) with C_mes).
MAP_KINDS = ("xx_auto", "yy_auto", "xx_cross", "yy_cross", "ii_auto", "ii_cross")


@dataclass(frozen=True)
class SliceGrid:
    """Slices of the line of sight in which Cn2 is constant.

    Parameters
    ----------
    edges : tuple of float
        The k + 1 borders of the slices, as distances from the pupil in m, increasing from 0 or more.

    Raises
    ------
    ValueError
        The edges do not increase or are not finite.
    """

    edges: tuple[float, ...]

    def __post_init__(self) -> None:
        edges = np.asarray(self.edges)
        if edges.size < 2 or not np.all(np.isfinite(edges)) or edges[0] < 0 or np.any(np.diff(edges) <= 0):
            raise ValueError("slice edges must be finite distances from the pupil that increase from 0 or more")

    @classmethod
    def uniform(cls, length: float, slices: int) -> SliceGrid:
        """Divide [0, `length`] (m) into `slices` equal slices."""
        return cls(tuple(float(length * i / slices) for i in range(slices + 1)))

    @property
    def k(self) -> int:
        """Number of slices."""
        return len(self.edges) - 1

    @property
    def centres(self) -> NDArray[np.float64]:
        """Mid-points of the slices, (k,), m."""
        edges = np.asarray(self.edges)
        return np.asarray((edges[1:] + edges[:-1]) / 2)

    @property
    def thickness(self) -> NDArray[np.float64]:
        """Thickness of each slice, (k,), m."""
        return np.diff(np.asarray(self.edges))


@dataclass(frozen=True)
class Geometry:
    """What the response functions depend on, apart from the turbulence spectrum and the source shape.

    Axes: x runs along columns, y along rows; subaperture (i, j) of a p x q mask has its centre at
    x = (j - (q - 1)/2) d, y = (i - (p - 1)/2) d. Subapertures are listed in row-major order of the mask.

    Parameters
    ----------
    mask : tuple of tuple of int
        p x q, 1 where the subaperture is exploited.
    subaperture_size : float
        Side d of a square subaperture, m.
    path_length : float
        Distance L from pupil to sources, m; may be infinite.
    wavelength : float
        Detection wavelength, m.
    positions : tuple of (float, float)
        (x, y) of one or two sources, in m, or in rad for an infinite path.
    """

    mask: tuple[tuple[int, ...], ...]
    subaperture_size: float
    path_length: float
    wavelength: float
    positions: tuple[tuple[float, float], ...]

    @property
    def p(self) -> int:
        """Rows of the mask."""
        return len(self.mask)

    @property
    def q(self) -> int:
        """Columns of the mask."""
        return len(self.mask[0])

    @property
    def n_sources(self) -> int:
        """Number of sources, 1 or 2."""
        return len(self.positions)

    @cached_property
    def n_subapertures(self) -> int:
        """Number of exploited subapertures."""
        return int(np.sum(self.mask))

    @property
    def separation(self) -> tuple[float, float]:
        """Separation vector (x, y) from the first source to the second; zero with one source."""
        if self.n_sources == 1:
            return (0.0, 0.0)
        (x1, y1), (x2, y2) = self.positions
        return (x2 - x1, y2 - y1)

    @cached_property
    def subaperture_index(self) -> NDArray[np.int64]:
        """(i, j) of each exploited subaperture, (A, 2)."""
        return np.argwhere(np.asarray(self.mask) != 0)

    @cached_property
    def subaperture_position(self) -> NDArray[np.float64]:
        """(x, y) of each exploited subaperture's centre, (A, 2), m."""
        i, j = self.subaperture_index.T
        d = self.subaperture_size
        return np.stack([(j - (self.q - 1) / 2) * d, (i - (self.p - 1) / 2) * d], axis=1)

    @property
    def map_shape(self) -> tuple[int, int]:
        """Shape (2p - 1, 2q - 1) of a correlation map, indexed [dy, dx]."""
        return (2 * self.p - 1, 2 * self.q - 1)

    @cached_property
    def lags(self) -> NDArray[np.int64]:
        """(dx, dy) of every map entry in units of d, (2p - 1, 2q - 1, 2)."""
        dy, dx = np.mgrid[1 - self.p : self.p, 1 - self.q : self.q]
        return np.stack([dx, dy], axis=-1)

    @cached_property
    def separation_vectors(self) -> NDArray[np.float64]:
        """(dx, dy) in m of every row of the data vector, (6 (2p - 1)(2q - 1), 2)."""
        return np.tile(self.lags.reshape(-1, 2) * self.subaperture_size, (len(MAP_KINDS), 1))

    @cached_property
    def pair_count(self) -> NDArray[np.int64]:
        """N(d): pairs of exploited subapertures with separation d, (2p - 1, 2q - 1)."""
        count = np.zeros(self.map_shape, dtype=np.int64)
        i, j = self.subaperture_index.T
        np.add.at(count, (i[:, None] - i[None, :] + self.p - 1, j[:, None] - j[None, :] + self.q - 1), 1)
        return count

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Rows of the data vector that some pair measures, (6 (2p - 1)(2q - 1),)."""
        pairs = self.pair_count.ravel() > 0
        crossed = pairs & (self.n_sources == 2)
        return np.concatenate([crossed if kind.endswith("cross") else pairs for kind in MAP_KINDS])

    @cached_property
    def independent(self) -> NDArray[np.int64]:
        """Rows of the data vector that carry independent numbers.

        Auto-correlation maps satisfy C(d) = C(-d): of each such pair the entry with dy > 0, or dy = 0 and
        dx >= 0, is kept. Two sources and the 20 subapertures of a 5 x 5 mask without corners and centre
        leave 312 rows of 486. Without two sources the cross maps have none.
        """
        dx, dy = self.lags.reshape(-1, 2).T
        half = (dy > 0) | ((dy == 0) & (dx >= 0))
        whole = np.ones_like(half)
        kept = np.concatenate([whole if kind.endswith("cross") else half for kind in MAP_KINDS])
        return np.flatnonzero(kept & self.valid)

    @cached_property
    def mirror(self) -> NDArray[np.int64]:
        """Row of the data vector holding the independent value of each row, (6 (2p - 1)(2q - 1),).

        A row of an auto map with the kept half of the separations names itself, its mirror image -d names
        the row of d. Rows that no pair measures name themselves.
        """
        size = self.lags.size // 2
        rows = np.arange(len(MAP_KINDS) * size)
        dx, dy = self.lags.reshape(-1, 2).T
        half = (dy > 0) | ((dy == 0) & (dx >= 0))
        block = np.where(half, np.arange(size), size - 1 - np.arange(size))
        for number, kind in enumerate(MAP_KINDS):
            if kind.endswith("auto"):
                rows[number * size : (number + 1) * size] = number * size + block
        return rows

    @property
    def infinite(self) -> bool:
        """Whether the sources are at infinity (positions and extents are then angles)."""
        return math.isinf(self.path_length)

    def magnification(self, z: float) -> float:
        """Displacement m(z) of a layer's pupil pattern per unit of source displacement.

        m = z / (L - z); for an infinite path m = z, and sources are displaced by angles.
        """
        return z if self.infinite else z / (self.path_length - z)

    def scaling(self, z: float) -> float:
        """Scaling L / (L - z) of a layer's pattern on the pupil by the spherical wave."""
        return 1.0 if self.infinite else self.path_length / (self.path_length - z)
