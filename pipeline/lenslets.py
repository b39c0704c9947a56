"""The lenslet grid and the spots of a Shack-Hartmann sensor, found on a mean frame.

Spots are peaks of the frame seen through band-passes of several widths. The steps from each to its neighbours are
sampled autocorrelation of the field of spots: steps that occur often are tried in pairs as the axes of the grid, and
the pair that joins most spots into one net is the grid. Two sources make two such nets with the same steps. Pitch,
origin and rotation are then a straight line fitted through all spots of the net, so that a regular grid of n x n spots
gives its pitch n times better than one spot its place.

The grid is found whatever its direction, pitch and kind (square, oblong, hexagonal); only :func:`boxes` asks whether
whole boxes of whole pixels describe it, as format 1 of the archives wants.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]

#: Widths of the band-passes, px (standard deviation of the inner Gaussian); spots of 2 to 30 px across pass one.
SCALES = (0.8, 1.3, 2.1, 3.4, 5.4, 8.6)
#: Standard deviation of the outer Gaussian over that of the inner one.
OUTER = 1.6
#: Peaks below this many times the noise are none.
SIGNIFICANT = 6.0
#: Strongest peaks that are looked at: two for each of 64 x 64 lenslets, and some more.
MAX_PEAKS = 10000
#: Ratio of the curvatures of a peak above which it is a ridge: a bad column, the border of the light.
RIDGE = 8.0
#: Steps to this many neighbours of each spot are candidates of the grid's axes.
NEIGHBOURS = 12
#: Spots whose steps are counted.
VOTERS = 250
#: Candidates that are tried in pairs.
CANDIDATES = 8
#: A spot belongs to a place of the grid within this fraction of the pitch.
NEAR = 0.16
#: Peaks fainter than this fraction of the bright ones are no spots but their wings, or stray light.
FAINT = 0.15
#: Spots that make a grid, at least.
MIN_SPOTS = 4
#: Part of the peaks that must lie on the grid.
MIN_REGULAR = 0.5
#: A spot fills at most this fraction of the smaller pitch, else it is the light of a lenslet and no spot.
MAX_WIDTH = 0.75
#: A spot stands at least this far above the light between the spots, as a fraction of that light ...
MIN_CONTRAST = 0.12
#: ... and, unless it is this far above it, ...
CLEAR_CONTRAST = 0.5
#: ... this many times the pixel noise: boxes evenly filled with light have soft borders that repeat like spots.
MIN_HEIGHT = 5.0
#: Spots fainter than this fraction of the bright ones are lenslets without light, or the second source's absence.
ILLUMINATED = 0.3
#: Largest error of a nominal spot of format 1, px.
SPOT_TOLERANCE = 1.0


class NoGrid(ValueError):
    """There is no lenslet grid on an image; the message says why."""


@dataclass(frozen=True, eq=False)
class LensletGrid:
    """A lenslet grid found on a mean frame. Pixel positions are (row, col), 0 at the centre of the first pixel.

    Parameters
    ----------
    vectors : ndarray of float, (2, 2)
        Step (row, col) from lenslet (i, j) to (i + 1, j), and to (i, j + 1), px.
    centre : ndarray of float, (2,)
        Centre of lenslet (0, 0): its spot, or half way between its two spots.
    spots : ndarray of float, (S, 2)
        Spot of each source relative to the lenslet's centre, the one of smaller row (then column) first.
    mask : ndarray of bool, (p, q)
        Lenslets with light from every source.
    positions : ndarray of float, (S, p, q, 2)
        Spots found, NaN where there is none.
    brightness : ndarray of float, (S, p, q)
        Height of each spot behind the band-pass, in the units of the frame.
    fwhm : float
        Full width at half maximum of the mean spot, px.
    contrast : float
        Height of the mean spot over the light between the spots.
    residual : float
        Root mean square distance of the spots from their places on the grid, px.
    regular : float
        Part of the significant peaks that lie on the grid.
    """

    vectors: Floats
    centre: Floats
    spots: Floats
    mask: NDArray[np.bool_]
    positions: Floats
    brightness: Floats
    fwhm: float
    contrast: float
    residual: float
    regular: float

    @property
    def n_sources(self) -> int:
        """Spots in a box."""
        return len(self.spots)

    @property
    def pitch(self) -> tuple[float, float]:
        """Lengths of the two steps, px."""
        along_rows, along_cols = np.hypot(*self.vectors.T)
        return float(along_rows), float(along_cols)

    @property
    def rotation(self) -> float:
        """Angle between the grid and the detector, rad; positive from +row towards +col, smallest in magnitude."""
        (down, aside), (aside_2, down_2) = self.vectors[0], self.vectors[1][::-1] * (1, -1)
        return math.atan2(aside + down_2, down + aside_2) if self.kind == "rectangular" else math.atan2(aside, down)

    @property
    def angle(self) -> float:
        """Angle between the two axes of the grid, rad."""
        return math.acos(float(np.dot(*self.vectors)) / math.prod(self.pitch))

    @property
    def kind(self) -> str:
        """``rectangular``, ``hexagonal`` or ``oblique``."""
        off = abs(math.degrees(self.angle) - 90)
        if off < 5:
            return "rectangular"
        ratio = self.pitch[0] / self.pitch[1]
        return "hexagonal" if abs(off - 30) < 5 and 0.9 < ratio < 1.1 else "oblique"

    @property
    def lenslets(self) -> Floats:
        """Centre of each lenslet, (p, q, 2)."""
        index = np.moveaxis(np.indices(self.mask.shape), 0, -1)
        found: Floats = self.centre + index @ self.vectors
        return found


@dataclass(frozen=True, eq=False)
class Boxes:
    """A grid in the terms of format 1.

    Parameters
    ----------
    origin : tuple of int
        First pixel (row, col) of the box of lenslet (0, 0).
    pitch : tuple of int
        Size (rows, cols) of a box.
    mask : ndarray of bool, (p, q)
        Lenslets with light whose box lies on the detector.
    spots : ndarray of float, (S, 2)
        Nominal spot in a box, 0 at the centre of its first pixel.
    misfit : float
        Largest distance between the grid's place of a spot and its nominal one, px.
    faults : tuple of str
        Why format 1 cannot describe this grid; empty if it can.
    notes : tuple of str
        What is worth knowing.
    """

    origin: tuple[int, int]
    pitch: tuple[int, int]
    mask: NDArray[np.bool_]
    spots: Floats
    misfit: float
    faults: tuple[str, ...]
    notes: tuple[str, ...]


def find_grid(
    image: ArrayLike, *, bad_pixel: NDArray[np.bool_] | None = None, illuminated: float = ILLUMINATED
) -> LensletGrid:
    """Find lenslet grid, spots and illuminated lenslets on a mean frame.

    Parameters
    ----------
    image : array_like, (row, col)
        Mean of frames, raw or calibrated; any level and slope of the background.
    bad_pixel : ndarray of bool, (row, col), optional
        True where a pixel must not be used; pixels that are not finite are not used either.
    illuminated : float
        Brightness of a spot that counts as light, as a fraction of that of the bright spots.

    Returns
    -------
    LensletGrid

    Raises
    ------
    NoGrid
        There is none; the message says what was found instead.
    ValueError
        The image is no image.
    """
    picture = _clean(np.asarray(image, dtype=np.float64), bad_pixel)
    noise = _noise(picture)
    spread = float(np.ptp(picture))
    if spread == 0:
        raise NoGrid("all pixels are alike; there is no light, or the frames are empty")
    best: _Net | None = None
    most = 0
    for scale in SCALES:
        if 8 * scale > min(picture.shape):
            break
        points, height = _peaks(_band(picture, scale), scale, max(SIGNIFICANT * noise * _gain(scale), 1e-9 * spread))
        most = max(most, len(points))
        for count in _counts(height):
            if best is not None and count <= best.score:
                break
            net = _net(points[:count], height[:count], scale)
            if net is not None and (best is None or net.score > best.score):
                best = net
    if best is None or best.regular < MIN_REGULAR:
        if most < MIN_SPOTS:
            raise NoGrid(f"only {most} spots stand out of the noise; a grid needs {MIN_SPOTS}")
        found = 0 if best is None else round(100 * best.regular)
        raise NoGrid(f"{most} spots stand out, but no regular grid joins them (at best {found} % of them); no grid")
    return _measured(picture, best, noise, illuminated)


def boxes(grid: LensletGrid, frame_shape: tuple[int, int]) -> Boxes:
    """Put a grid into the terms of format 1: boxes of whole pixels along rows and columns.

    Parameters
    ----------
    grid : LensletGrid
        A grid.
    frame_shape : tuple of int
        (rows, cols) of a frame.

    Returns
    -------
    Boxes
        The nearest that format 1 has, and why it does not do, where it does not.
    """
    faults, notes = [], []
    rotation, across = math.degrees(grid.rotation), grid.pitch
    pitch = np.maximum(np.rint(np.abs(np.diag(grid.vectors))).astype(int), 1)
    if grid.kind != "rectangular":
        faults.append(
            f"the lenslets form {'a hexagonal' if grid.kind == 'hexagonal' else 'an oblique'} array (steps of "
            f"{across[0]:.2f} and {across[1]:.2f} px at {math.degrees(grid.angle):.1f} deg); format 1 describes "
            "rectangular arrays only"
        )
    if grid.n_sources > 2:
        faults.append(f"there are {grid.n_sources} spots in each box; format 1 knows one or two sources")
    mask = grid.mask.copy()
    lit = np.argwhere(mask)
    drift = grid.lenslets[mask] - lit * pitch
    middle = (drift.max(axis=0) + drift.min(axis=0)) / 2
    # Half a pixel either way is the same to the spots: a box that leaves the detector by less moves onto it.
    exact = middle - (pitch - 1) / 2
    origin = np.rint(exact).astype(int)
    for axis in (0, 1):
        first, last = lit[:, axis].min() * pitch[axis], (lit[:, axis].max() + 1) * pitch[axis]
        if origin[axis] + first < 0 and exact[axis] + first > -1.5:
            origin[axis] = -first
        if origin[axis] + last > frame_shape[axis] and exact[axis] + last < frame_shape[axis] + 1.5:
            origin[axis] = frame_shape[axis] - last
    corner = origin + lit * pitch
    off = (corner < 0).any(axis=1) | (corner + pitch > frame_shape).any(axis=1)
    if 2 * off.sum() > len(off):
        faults.append(f"{int(off.sum())} of {len(off)} boxes of {pitch[0]} x {pitch[1]} pixels lie off the detector")
    if off.any() and not off.all():
        mask[tuple(lit[off].T)] = False
        notes.append(f"{int(off.sum())} lenslets with light are left out: their boxes reach beyond the detector")
        drift = drift[~off]
        middle = (drift.max(axis=0) + drift.min(axis=0)) / 2
    spots = middle - origin + grid.spots
    misfit = float(np.hypot(*(drift - middle).T).max())
    if misfit > SPOT_TOLERANCE and grid.kind == "rectangular":
        causes = [f"the pitch is {across[0]:.3f} x {across[1]:.3f} px (row, col)"]
        if abs(rotation) > 0.02:
            causes.append(f"the grid is turned by {rotation:.2f} deg")
        faults.append(
            f"{' and '.join(causes)}: boxes of {pitch[0]} x {pitch[1]} pixels would miss the spots by up to "
            f"{misfit:.1f} px, but a nominal spot must be good to {SPOT_TOLERANCE:g} px; turn or resample the frames "
            "to whole pixels before they are ingested, or use a part of the lenslets"
        )
    measured = grid.positions[:, mask] - grid.lenslets[mask]
    away = np.hypot(*np.moveaxis(measured - grid.spots[:, None], -1, 0))
    if strayed := int(np.sum((away > SPOT_TOLERANCE).any(axis=0))):
        notes.append(
            f"{strayed} of {int(mask.sum())} lenslets have a spot more than {SPOT_TOLERANCE:g} px off the grid"
        )
    outside = (spots < -0.5) | (spots >= pitch - 0.5)
    if outside.any() and not faults:
        faults.append("a spot lies outside its lenslet's box")
    # Rows and columns of lenslets without light say nothing; they would only push boxes off the detector.
    if mask.any():
        rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        origin = origin + (rows[0], cols[0]) * pitch
        mask = mask[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    if max(mask.shape) > 64:
        faults.append(f"there are {mask.shape[0]} x {mask.shape[1]} lenslets; at most 64 x 64 are supported")
    return Boxes(
        origin=(int(origin[0]), int(origin[1])),
        pitch=(int(pitch[0]), int(pitch[1])),
        mask=mask,
        spots=spots,
        misfit=misfit,
        faults=tuple(faults),
        notes=tuple(notes),
    )


# --- the picture -------------------------------------------------------------------------------------------


def _clean(picture: Floats, bad_pixel: NDArray[np.bool_] | None) -> Floats:
    """Unusable pixels filled in from around them, single hot pixels taken for what they are."""
    if picture.ndim != 2 or min(picture.shape, default=0) < 8:
        raise ValueError(f"an image of shape {picture.shape} is no frame; (row, col) of at least 8 x 8 is needed")
    bad = ~np.isfinite(picture)
    if bad_pixel is not None:
        if bad_pixel.shape != picture.shape:
            raise ValueError(f"bad_pixel has shape {bad_pixel.shape}, the image {picture.shape}")
        bad |= bad_pixel
    if bad.all():
        raise NoGrid("no pixel is good: all are bad or not finite")
    if bad.any():
        picture = np.where(bad, np.median(picture[~bad]), picture)
        for reach in (4.0, 1.0):
            weight = ndimage.gaussian_filter((~bad).astype(float), reach)
            near = ndimage.gaussian_filter(np.where(bad, 0.0, picture), reach)
            picture = np.where(bad & (weight > 1e-3), near / np.maximum(weight, 1e-3), picture)
    ring = np.ones((3, 3), bool)
    ring[1, 1] = False
    typical = ndimage.median_filter(picture, footprint=ring)
    brightest = ndimage.maximum_filter(picture, footprint=ring)
    # Light that passed a lens reaches more than one pixel; a cosmic ray or a hot pixel need not.
    hot = picture - typical > 5 * (brightest - typical) + 8 * _noise(picture)
    return np.where(hot, typical, picture)


def _noise(picture: Floats) -> float:
    """Standard deviation of the pixel noise, from differences of neighbours."""
    steps = [np.abs(np.diff(picture, axis=axis)).ravel() for axis in (0, 1)]
    return float(np.median(np.concatenate(steps))) * 1.4826 / math.sqrt(2)


def _band(picture: Floats, scale: float) -> Floats:
    """What a picture shows between two widths."""
    band: Floats = ndimage.gaussian_filter(picture, scale) - ndimage.gaussian_filter(picture, OUTER * scale)
    return band


def _gain(scale: float) -> float:
    """Standard deviation behind a band-pass of white noise of standard deviation 1."""
    size = 2 * math.ceil(5 * OUTER * scale) + 1
    point = np.zeros((size, size))
    point[size // 2, size // 2] = 1
    return float(np.sqrt((_band(point, scale) ** 2).sum()))


def _peaks(band: Floats, scale: float, floor: float) -> tuple[Floats, Floats]:
    """Positions (n, 2) and heights (n,) of the round peaks of a band, the highest first."""
    size = 2 * math.ceil(1.5 * scale) + 1
    top = (band == ndimage.maximum_filter(band, size)) & (band > floor)
    top[[0, -1]] = False
    top[:, [0, -1]] = False
    row, col = np.nonzero(top)
    order = np.argsort(-band[row, col], kind="stable")[:MAX_PEAKS]
    row, col = row[order], col[order]
    here = band[row, col]
    up, down, left, right = band[row - 1, col], band[row + 1, col], band[row, col - 1], band[row, col + 1]
    curved = np.stack([up + down - 2 * here, left + right - 2 * here])
    mixed = (band[row + 1, col + 1] - band[row + 1, col - 1] - band[row - 1, col + 1] + band[row - 1, col - 1]) / 4
    determinant = curved[0] * curved[1] - mixed**2
    # Ratio r of the principal curvatures: trace^2 / determinant = (r + 1)^2 / r.
    round_ = determinant * (RIDGE + 1) ** 2 / RIDGE > curved.sum(axis=0) ** 2
    slope = np.stack([down - up, right - left]) / 2
    shift = -slope / np.where(curved < 0, curved, -np.inf)
    points = np.stack([row, col], axis=1) + np.clip(shift, -0.5, 0.5).T
    return points[round_], here[round_]


def _counts(height: Floats) -> list[int]:
    """How many of the highest peaks to try: all, and those above ever higher levels."""
    if len(height) < MIN_SPOTS:
        return []
    levels = float(height[-1]) * 2.0 ** np.arange(20)
    return sorted({count for level in levels if (count := int(np.sum(height >= level))) >= MIN_SPOTS}, reverse=True)


# --- the grid ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Net:
    """Spots joined by the steps of a grid: (i, j) of those of the main net, and where the other sources' spots are."""

    scale: float
    points: Floats
    height: Floats
    member: NDArray[np.int64]
    index: NDArray[np.int64]
    vectors: Floats
    start: Floats
    offsets: Floats
    explained: int

    @property
    def regular(self) -> float:
        return self.explained / len(self.points)

    @property
    def score(self) -> float:
        # Of two ways to see the same spots the one with fewer in a box is the plainer.
        return self.explained * self.regular**2 * 0.8 ** len(self.offsets)


def _net(points: Floats, height: Floats, scale: float) -> _Net | None:
    """The grid that joins most points; None where no steps repeat."""
    tree = cKDTree(points)
    tried: list[tuple[float, float, Floats]] = []
    for vectors in _lattices(points, tree):
        _, sizes, error = _joined(points, tree, vectors)
        first, second = np.sort(np.append(sizes, 0))[:-3:-1].tolist()
        # One source makes one net, two make two of about a size; steps twice too long make two of one source's.
        # And steps that fit only within the tolerance join spots of different sources.
        worth = (first + second) * (1.0 if first > 0.7 * (first + second) else 0.8) * (1 - error / 2)
        tried.append((worth, abs(float(np.linalg.det(vectors))), vectors))
    if not tried:
        return None
    # Two rows of lenslets with two spots each could be two rows of spots with two lenslets each: spots of a lenslet
    # lie closer together than lenslets.
    highest = max(worth for worth, _, _ in tried)
    best = max((one for one in tried if one[0] > 0.97 * highest), key=lambda one: one[1])[2]
    net = _walked(points, tree, best)
    if net is not None and (doubled := _doubled(points, net)) is not None:
        net = _walked(points, tree, doubled) or net
    if net is None:
        return None
    labels, sizes, member, index, start, vectors = net
    size = int(sizes.max())
    # Other nets with the same steps are other sources; what is much smaller is stray light or a piece of this one.
    phase = (points - start) @ np.linalg.inv(vectors)
    phase -= np.rint(phase)
    tolerance = NEAR * min(np.hypot(*vectors.T))
    offsets: list[Floats] = []
    taken = np.hypot(*(phase @ vectors).T) < tolerance
    bright = np.median(height[taken])
    for label in np.argsort(-sizes):
        points_of = (labels == label) & ~taken
        if sizes[label] < max(MIN_SPOTS, 0.4 * size) or points_of.sum() < MIN_SPOTS or len(offsets) == 3:
            continue
        offset = _circular_mean(phase[points_of]) @ vectors
        near = phase - offset @ np.linalg.inv(vectors)
        near -= np.rint(near)
        ours = (np.hypot(*(near @ vectors).T) < tolerance) & ~taken
        if ours.sum() < 0.4 * size or np.median(height[ours]) < FAINT * bright:
            continue
        offsets.append(_circular_mean(phase[ours]) @ vectors)
        taken |= ours
    # The rings and crosses of diffraction make nets of their own between the spots, finer and much fainter.
    explained = int(np.sum(taken & (height > FAINT * np.quantile(height[taken], 0.9))))
    return _Net(scale, points, height, member, index, vectors, start, np.array(offsets).reshape(-1, 2), explained)


if TYPE_CHECKING:
    _Walk = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Floats, Floats]


def _walked(points: Floats, tree: Any, vectors: Floats) -> _Walk | None:
    """The largest net of given steps: labels and sizes of all nets, its members, their (i, j), origin and steps."""
    labels, sizes, _ = _joined(points, tree, vectors)
    member = np.flatnonzero(labels == int(np.argmax(sizes)))
    if len(member) < MIN_SPOTS:
        return None
    index = _numbered(points, member, vectors)
    start, vectors, kept = _line(points[member], index, vectors)
    member, index = member[kept], index[kept]
    if len(member) < MIN_SPOTS or np.ptp(index, axis=0).min() < 1:
        return None
    return labels, sizes, member, index, start, vectors


def _doubled(points: Floats, net: _Walk) -> Floats | None:
    """Steps of a grid of two sources that lie nearly, but not quite, half a pitch apart: taken for one finer grid.

    Every other spot is then off the fine grid by the same amount. None where there is no such amount.
    """
    _, _, member, index, start, (a, b) = net
    rest = points[member] - start - index @ np.stack([a, b])
    for parity, doubled in (
        (index[:, 0], np.stack([2 * a, b])),
        (index[:, 1], np.stack([a, 2 * b])),
        (index.sum(axis=1), np.stack([a + b, a - b])),
    ):
        odd = parity % 2 == 1
        if min(odd.sum(), (~odd).sum()) < MIN_SPOTS:
            continue
        apart = rest[odd].mean(axis=0) - rest[~odd].mean(axis=0)
        spread = (rest[odd].var(axis=0).sum() / odd.sum() + rest[~odd].var(axis=0).sum() / (~odd).sum()) ** 0.5
        if np.hypot(*apart) > max(0.2, 5 * spread):
            return _reduced(doubled)
    return None


def _lattices(points: Floats, tree: Any) -> list[Floats]:
    """Pairs of steps that may be the axes of the grid, each as (2, 2) with the shortest steps of its lattice."""
    count = min(NEIGHBOURS, len(points) - 1)
    voters = points[:: -(-len(points) // VOTERS)]
    _, near = tree.query(voters, count + 1)
    steps = (points[near[:, 1:]] - voters[:, None]).reshape(-1, 2)
    # A step and its opposite are one.
    steps *= np.where((steps[:, 0] < -0.3) | ((np.abs(steps[:, 0]) <= 0.3) & (steps[:, 1] < 0)), -1, 1)[:, None]
    length = np.hypot(*steps.T)
    radius = np.clip(0.08 * length, 0.6, 3.0)
    around = cKDTree(steps)
    votes = around.query_ball_point(steps, radius, return_length=True)
    common: list[Floats] = []
    for i in np.argsort(-votes, kind="stable"):
        if len(common) == CANDIDATES or votes[i] < 2:
            break
        if all(np.hypot(*(steps[i] - step)) > 2 * radius[i] and np.hypot(*(steps[i] + step)) > 2 * radius[i]
               for step in common):  # fmt: skip
            common.append(np.median(steps[around.query_ball_point(steps[i], radius[i])], axis=0))
    found: list[Floats] = []
    for i, first in enumerate(common):
        for second in common[i + 1 :]:
            lattice = _reduced(np.stack([first, second]))
            if lattice is not None and all(np.abs(lattice - other).max() > 1.0 for other in found):
                found.append(lattice)
    return found


def _reduced(vectors: Floats) -> Floats | None:
    """The shortest two steps of a lattice (Lagrange and Gauss), rows first; None if it is (nearly) a line."""
    a, b = vectors
    if abs(np.linalg.det(vectors)) < 0.2 * np.hypot(*a) * np.hypot(*b):
        return None
    for _ in range(20):
        if a @ a > b @ b:
            a, b = b, a
        turns = round(float(a @ b) / float(a @ a))
        if turns == 0:
            break
        b = b - turns * a
    if abs(a[0]) < abs(b[0]):
        a, b = b, a
    a, b = a * (1 if a[0] > 0 else -1), b * (1 if b[1] > 0 else -1)
    if min(np.hypot(*a), np.hypot(*b)) < 3:
        return None
    return np.stack([a, b])


def _edges(
    points: Floats, tree: Any, vectors: Floats
) -> tuple[list[tuple[NDArray[np.int64], NDArray[np.int64]]], float]:
    """For each axis, pairs of points that are one step apart; and how well they are, over what is allowed."""
    reach = max(NEAR * min(np.hypot(*vectors.T)), 0.7)
    pairs, squares = [], []
    for vector in vectors:
        distance, other = tree.query(points + vector, distance_upper_bound=reach)
        start = np.flatnonzero(np.isfinite(distance))
        pairs.append((start, other[start]))
        squares.append(distance[start] ** 2)
    every = np.concatenate(squares)
    return pairs, float(np.sqrt(every.mean())) / reach if len(every) else 1.0


def _joined(points: Floats, tree: Any, vectors: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64], float]:
    """Number of its net for each point, sizes of the nets, and the error of the steps as in :func:`_edges`."""
    pairs, error = _edges(points, tree, vectors)
    start, end = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    graph = coo_matrix((np.ones(len(start)), (start, end)), shape=(len(points),) * 2)
    _, labels = connected_components(graph, directed=False)
    return labels, np.bincount(labels), error


def _numbered(points: Floats, member: NDArray[np.int64], vectors: Floats) -> NDArray[np.int64]:
    """Grid index (i, j) of each point of a net, found by walking along it: no error of the steps adds up."""
    own = points[member]
    neighbours: list[list[tuple[int, int, int]]] = [[] for _ in member]
    for axis, (start, end) in enumerate(_edges(own, cKDTree(own), vectors)[0]):
        for a, b in zip(start.tolist(), end.tolist(), strict=True):
            neighbours[a].append((b, axis, 1))
            neighbours[b].append((a, axis, -1))
    index = np.zeros((len(member), 2), np.int64)
    seen = {0}
    queue = [0]
    for here in queue:
        for there, axis, sign in neighbours[here]:
            if there not in seen:
                seen.add(there)
                queue.append(there)
                index[there] = index[here]
                index[there, axis] += sign
    return index


def _line(points: Floats, index: NDArray[np.int64], vectors: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Origin and steps of the grid through numbered points, by least squares without those that lie far off."""
    design = np.column_stack([np.ones(len(index)), index])
    kept = np.ones(len(index), bool)
    solution = np.vstack([points[0] - index[0] @ vectors, vectors])
    for _ in range(4):
        if np.linalg.matrix_rank(design[kept]) < 3:
            break
        solution = np.linalg.lstsq(design[kept], points[kept], rcond=None)[0]
        distance = np.hypot(*(points - design @ solution).T)
        kept = distance <= max(4 * float(np.median(distance)), 0.3)
    return solution[0], solution[1:], kept


def _circular_mean(phase: Floats) -> Floats:
    """Mean of points on a cell whose opposite sides are one."""
    turn: Floats = np.angle(np.exp(2j * np.pi * phase).mean(axis=0)) / (2 * np.pi)
    return turn


# --- what the grid shows -----------------------------------------------------------------------------------


def _measured(picture: Floats, net: _Net, noise: float, illuminated: float) -> LensletGrid:
    """Spots, mask and shape of the spots of a grid."""
    vectors = net.vectors
    offsets = np.vstack([np.zeros((1, 2)), net.offsets])
    if len(offsets) == 2:
        # Of the two pairings the closer one: the light of a lenslet falls into its own box.
        inverse = np.linalg.inv(vectors)
        ways = [offsets[1] + np.array([i, j]) @ vectors for i in (-1, 0, 1) for j in (-1, 0, 1)]
        offsets[1] = min(ways, key=lambda way: (round(float(np.hypot(*way)), 6), float(np.abs(way @ inverse).sum())))
    middle = offsets.mean(axis=0)
    centre = net.start + middle
    offsets = offsets - middle
    offsets = offsets[np.lexsort((offsets[:, 1], np.round(offsets[:, 0])))]

    # Places of the grid on the detector, one step beyond the spots that made it.
    low, high = net.index.min(axis=0) - 1, net.index.max(axis=0) + 1
    index = np.moveaxis(np.indices(tuple(high - low + 1)), 0, -1) + low
    places = centre + index @ vectors + offsets[:, None, None]
    inside = ((places > 0) & (places < np.array(picture.shape) - 1)).all(axis=-1)
    apart = min(np.hypot(*vectors.T).min(), np.inf if len(offsets) == 1 else np.hypot(*(offsets[1] - offsets[0])))
    # Spots fainter than the cut that made the net are light all the same.
    points, height = _peaks(_band(picture, net.scale), net.scale, SIGNIFICANT * noise * _gain(net.scale))
    distance, nearest = cKDTree(points).query(places, distance_upper_bound=max(0.4 * apart, 1.0))
    near = np.isfinite(distance) & inside
    nearest = np.where(near, nearest, 0)
    brightness = np.where(near, height[nearest], 0.0)
    positions = np.where(near[..., None], points[nearest], np.nan)
    typical = np.array([np.quantile(b[n], 0.75) if n.any() else np.inf for b, n in zip(brightness, near, strict=True)])
    mask: NDArray[np.bool_] = np.all(brightness >= illuminated * typical[:, None, None], axis=0)
    # A lenslet with light that has none beside it is a cosmic ray or a ghost.
    beside = ndimage.convolve(mask.astype(int), [[0, 1, 0], [1, 0, 1], [0, 1, 0]], mode="constant")
    mask &= beside > 0
    if mask.sum() < MIN_SPOTS:
        raise NoGrid(f"only {int(mask.sum())} lenslets have light; a grid needs {MIN_SPOTS}")
    if len(offsets) * mask.sum() < net.explained / 2:
        raise NoGrid(
            f"{net.explained} spots repeat, but no more than {int(mask.sum())} lenslets have all of their "
            f"{len(offsets)}; no grid"
        )
    positions = np.where(mask[..., None], positions, np.nan)

    fwhm, contrast, above = _shape(picture, places[:, mask].reshape(-1, 2), apart, float(np.hypot(*vectors.T).min()))
    if fwhm > MAX_WIDTH * apart:
        raise NoGrid(
            f"there is a regular pattern of {vectors[0][0]:.1f} x {vectors[1][1]:.1f} px, but its bright places are "
            f"{fwhm:.1f} px wide: the light of the lenslets, not spots; no grid"
        )
    if contrast < MIN_CONTRAST or (contrast < CLEAR_CONTRAST and above < MIN_HEIGHT * noise):
        raise NoGrid(
            f"there is a regular pattern of {vectors[0][0]:.1f} x {vectors[1][1]:.1f} px, but its bright places stand "
            f"only {100 * contrast:.0f} % above the light between them, {above / max(noise, 1e-300):.1f} times the "
            "noise of a pixel: lenslets without spots; no grid"
        )
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    cut = (slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1))
    first = low + np.array([rows[0], cols[0]])
    away = positions - places
    return LensletGrid(
        vectors=vectors,
        centre=centre + first @ vectors,
        spots=offsets,
        mask=mask[cut],
        positions=positions[:, cut[0], cut[1]],
        brightness=brightness[:, cut[0], cut[1]],
        fwhm=fwhm,
        contrast=contrast,
        residual=float(np.sqrt(np.nanmean((away**2).sum(axis=-1)))),
        regular=net.regular,
    )


def _shape(picture: Floats, places: Floats, apart: float, pitch: float) -> tuple[float, float, float]:
    """Full width at half maximum (px) of the mean spot, its height over the light between the spots, its height."""
    half = max(2, int(0.5 * pitch))
    inside = ((places >= half) & (places < np.array(picture.shape) - half - 1)).all(axis=1)
    if not inside.any():
        return 0.0, math.inf, math.inf
    grid = np.mgrid[-half : half + 1, -half : half + 1]
    whole = np.rint(places[inside]).astype(int)
    stack = picture[whole[:, 0, None, None] + grid[0], whole[:, 1, None, None] + grid[1]]
    mean = stack.mean(axis=0)
    between = float(np.quantile(mean, 0.1))
    core = np.hypot(*grid) <= max(1.0, 0.5 * apart)
    height = float(mean[core].max()) - between
    above = core & (mean > between + height / 2)
    fwhm = 2 * math.sqrt(float(above.sum()) / math.pi)
    dark = float(np.quantile(picture, 0.02))
    return fwhm, height / max(between - dark, 1e-12 * max(abs(height), 1e-300)), height
