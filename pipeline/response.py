r"""Response functions: the correlation maps that a slice of turbulence with Cn2 dz = 1 prints on the data.

A layer at distance z gives slopes and intensities through linear filters of its index fluctuations. With
X = pi lambda z f^2 L / (L - z), m = z / (L - z), k = 2 pi / lambda, the aperture filter F, the source's transform P~
and the transform M_l of s_l P about its own centroid, the amplitude of one source is, in pupil frequencies f (cycles
per m),

    slope along l    A_l = -2 pi i f_l F cos X conj(P~(m f)) + (2 k / L) F sin X conj(M_l(m f))
    scintillation    A_i = 2 k F sin X conj(P~(m f))

and the response at the separation d = r_a - r_b, a on the first source and b on the second,

    W(d) = integral of (L / (L - z))^2 S_n(f L / (L - z)) A^(1) conj(A^(2)) exp(2 pi i f.(d - m s)) d^2f,

with the separation s of the sources: the ridge of the cross maps lies at d = m s. These are Sauvage et al. 2021
(https://doi.org/10.1364/AO.438170), Eqs. (8)-(16), for any two sources, with one term more: each point of an extended
source scintillates on its own and is imaged at s / L, so the centroid also moves by the intensity-weighted mean of
s / L. For a Gaussian source of standard deviation sigma_l the two slope terms are
-2 pi i f_l F conj(P~) (cos X - (2 k m sigma_l^2 / L) sin X). `slope_response="printed"` leaves the second term out, as
the paper does. A detector band puts the weighted means of cos X and k sin X in their places (see :mod:`.band`).

Near f = 0 the slope integrand goes as f^(-5/3): no grid that is uniform in f holds it. The integral is taken in polar
coordinates, over shells of geometrically growing radius with Gauss-Legendre panels in u = f^(1/3), in which that
singularity is gone, and the trapezoidal rule in angle, which converges exponentially. Orders follow from the phase
that the widest separation, shift, aperture, source and diffraction give the integrand, and are checked against finer
ones in every slice; shells are added until the maps no longer move. Slice means use nested Gauss rules along z, on
panels that are halved where two rules disagree.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.special import j1, jv

from .band import Band
from .extended_rytov import suppression
from .geometry import MAP_KINDS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from .geometry import Geometry, SliceGrid
    from .protocols import SourceModel, TurbulenceSpectrum

    Array = NDArray[np.float64]

Sampling = Literal["mean", "midpoint"]
SlopeResponse = Literal["centroid", "printed"]
Aperture = Literal["square", "circular"]
Tilt = Literal["gradient", "zernike"]

#: Error of each map, relative to its maximum, that shells of frequencies and panels along z may leave.
TOLERANCE = 1e-6

#: Nodes per radian of phase in radius (see `_shells`), growth of the shells, nodes that fit the cache.
_NODES_PER_RADIAN = 0.36
_SHELL_RATIO = math.sqrt(2.0)
_MAX_SHELLS = 90
_MAX_PANELS = 200
#: Turns of the diffraction fringe within a slice above which its mean is taken from the ends of the slice. A source of
#: a few cm blurs the fringe away.
_FRINGE_TURNS = 16
#: Phase in radians over which a fringe is long work to follow.
_LONG = 3000.0
_CHUNK = 2048

#: Nested rules of 3, 7 and 15 points: Gauss-Legendre with the extensions of Kronrod and Patterson 1968
#: (https://doi.org/10.1090/S0025-5718-68-99866-9). Columns: node and its weight in each rule, for nodes of 0 and more.
_NESTED_HALF = (
    (0.000000000000000000, 0.888888888888888889, 0.450916538658474142, 0.225510499798206687),
    (0.223386686428966882, 0.000000000000000000, 0.000000000000000000, 0.219156858401587496),
    (0.434243749346802558, 0.000000000000000000, 0.401397414775962223, 0.200628529376989021),
    (0.621102946737226403, 0.000000000000000000, 0.000000000000000000, 0.171511909136391381),
    (0.774596669241483377, 0.555555555555555556, 0.268488089868333441, 0.134415255243784220),
    (0.888459232872256999, 0.000000000000000000, 0.000000000000000000, 0.092927195315124538),
    (0.960491268708020283, 0.000000000000000000, 0.104656226026467265, 0.051603282997079740),
    (0.993831963212755022, 0.000000000000000000, 0.000000000000000000, 0.017001719629940260),
)
_NESTED = np.array([(-x, *w) for x, *w in _NESTED_HALF[:0:-1]] + [*_NESTED_HALF])
_NODES, _RULES = _NESTED[:, 0], _NESTED[:, 1:].T
_FIRST, _SECOND = slice(1, None, 2), slice(0, None, 2)

#: Blocks of the data vector that a pass over the frequencies fills.
_AUTO = tuple(MAP_KINDS.index(kind) for kind in ("xx_auto", "yy_auto", "ii_auto"))
_CROSS = tuple(MAP_KINDS.index(kind) for kind in ("xx_cross", "yy_cross", "ii_cross"))


def response_matrix(
    geometry: Geometry,
    grid: SliceGrid,
    spectrum: TurbulenceSpectrum,
    sources: Sequence[SourceModel],
    *,
    sampling: Sampling = "mean",
    slope_response: SlopeResponse = "centroid",
    aperture: Aperture = "square",
    tilt: Tilt = "gradient",
    band: Band | None = None,
    point_index: float = 0.0,
) -> Array:
    """Matrix M of the direct model, maps = M Cn2 (Sauvage et al. 2021, Eq. (22)).

    Parameters
    ----------
    geometry : Geometry
        Pupil, path, wavelength and sources.
    grid : SliceGrid
        Slices of the profile, within [0, L].
    spectrum : TurbulenceSpectrum
        Spectrum of the refractive index.
    sources : sequence of SourceModel
        Intensity distribution of each source, in the order of the geometry.
    sampling : {"mean", "midpoint"}
        Response averaged over each slice, or taken at its middle.
    slope_response : {"centroid", "printed"}
        With or without the centroid's motion by the scintillation of the source's points.
    aperture : {"square", "circular"}
        Shape of a subaperture of size d.
    tilt : {"gradient", "zernike"}
        Slope as the mean gradient over the subaperture, or as the tilt of the best-fitting plane.
    band : Band, optional
        Spectral weight of the detector; the single wavelength of the geometry where it is absent.
    point_index : float
        First-order scintillation index of one point of the source at which the scintillation response is taken, by
        the filters of :func:`~coslidar.pipeline.extended_rytov.suppression`; 0 is first order.

    Returns
    -------
    ndarray of float, (6 (2p - 1)(2q - 1), k)
        Slice thickness included: m^(2/3) rad^2 for slopes, m^(2/3) for scintillation. The order of the rows is
        that of :data:`~coslidar.pipeline.geometry.MAP_KINDS`, row-major [dy, dx]; with one source the cross
        blocks are NaN.

    Raises
    ------
    ValueError
        Wrong option, number of sources, or a slice beyond the sources.
    ArithmeticError
        The spectrum does not decay, so that the maps do not converge.
    """
    if sampling not in ("mean", "midpoint"):
        raise ValueError(f"sampling must be 'mean' or 'midpoint', got {sampling!r}")
    if grid.edges[-1] > geometry.path_length:
        raise ValueError(f"a slice ends at {grid.edges[-1]:g} m, beyond the sources at {geometry.path_length:g} m")
    model = _model(geometry, spectrum, sources, slope_response, aperture, tilt, band, point_index)
    columns = []
    for z0, z1 in itertools.pairwise(grid.edges):
        if sampling == "midpoint":
            maps = (z1 - z0) * _at(model, (z0 + z1) / 2)
        else:
            maps = _slice_integral(model, z0, z1)
        columns.append(maps.ravel())
    return np.stack(columns, axis=1)


def response(
    geometry: Geometry,
    z: float,
    spectrum: TurbulenceSpectrum,
    sources: Sequence[SourceModel],
    slope_response: SlopeResponse = "centroid",
    *,
    aperture: Aperture = "square",
    tilt: Tilt = "gradient",
    band: Band | None = None,
    point_index: float = 0.0,
) -> Array:
    """Response functions W of one thin layer (Sauvage et al. 2021, Eqs. (8)-(10)).

    Parameters
    ----------
    geometry, spectrum, sources, slope_response, aperture, tilt, band, point_index
        As for :func:`response_matrix`.
    z : float
        Distance of the layer from the pupil, m, in [0, L].

    Returns
    -------
    ndarray of float, (6, 2p - 1, 2q - 1)
        Maps [kind, dy, dx] for Cn2 dz = 1 m^(1/3): m^(-1/3) rad^2 for slopes, m^(-1/3) for scintillation.

    Raises
    ------
    ValueError
        Wrong option, number of sources, or a layer outside [0, L].
    ArithmeticError
        The spectrum does not decay, so that the maps do not converge.
    """
    if not (0 <= z <= geometry.path_length and math.isfinite(z)):
        raise ValueError(f"the layer at {z:g} m is not between pupil and sources (0 to {geometry.path_length:g} m)")
    return _at(_model(geometry, spectrum, sources, slope_response, aperture, tilt, band, point_index), z)


@dataclass(frozen=True)
class _Model:
    """What every integral needs, checked and measured once."""

    geometry: Geometry
    spectrum: TurbulenceSpectrum
    sources: tuple[SourceModel, ...]  # one where both are the same
    centroids: tuple[tuple[float, float], ...]
    extent: tuple[float, float]  # half-widths that hold the largest source, x and y
    centroid_term: float  # 2 / L, 0 where the term is left out
    band: Band
    point_index: float
    aperture: Aperture
    tilt: Tilt
    power: float  # n in f = u^n
    even: bool  # sources symmetric about both axes: a quadrant of frequencies tells all


def _model(
    geometry: Geometry,
    spectrum: TurbulenceSpectrum,
    sources: Sequence[SourceModel],
    slope_response: str,
    aperture: str,
    tilt: str,
    band: Band | None,
    point_index: float,
) -> _Model:
    for name, value, known in (
        ("slope_response", slope_response, ("centroid", "printed")),
        ("aperture", aperture, ("square", "circular")),
        ("tilt", tilt, ("gradient", "zernike")),
    ):
        if value not in known:
            raise ValueError(f"{name} must be '{known[0]}' or '{known[1]}', got {value!r}")
    if not (0 <= point_index < math.inf) or (point_index and geometry.infinite):
        raise ValueError(f"point_index must be 0 or, on a finite path, more; got {point_index!r}")
    if len(sources) != geometry.n_sources:
        raise ValueError(f"the geometry has {geometry.n_sources} sources, but {len(sources)} source models are given")
    kept = tuple(sources[:1]) if all(source == sources[0] for source in sources) else tuple(sources)
    zero = np.zeros(1)
    centroids = []
    for source in kept:
        mx, my = source.moment(zero, zero)
        centroids.append((float(np.real(mx[0])), float(np.real(my[0]))))
    extents = np.array([_extent(source) for source in kept])
    inverse_length = 1.0 if geometry.infinite else 1 / geometry.path_length
    return _Model(
        geometry,
        spectrum,
        kept,
        tuple(centroids),
        (float(extents[:, 0].max()), float(extents[:, 1].max())),
        2 * inverse_length if slope_response == "centroid" else 0.0,
        band or Band((geometry.wavelength,), (1.0,)),
        float(point_index),
        aperture,  # type: ignore[arg-type]
        tilt,  # type: ignore[arg-type]
        _radial_power(spectrum),
        all(_is_even(source) for source in kept),
    )


def _extent(source: SourceModel) -> tuple[float, float]:
    """Half-width of a source along x and y, from where its transform has fallen by half (0 for a point).

    A Gaussian of standard deviation sigma falls by half at 0.187 / sigma; two of them hold a Gaussian, and the
    same rule gives 1.06 radii of a disc and 1.24 half-widths of a bar. Only orders of quadrature depend on it.
    """
    f = np.logspace(-4, 8, 481)
    zero = np.zeros_like(f)
    half = []
    for transform in (source.transfer(f, zero), source.transfer(zero, f)):
        fallen = np.flatnonzero(np.abs(transform) < 0.5)
        half.append(2 * 0.187 / float(f[fallen[0]]) if fallen.size else 0.0)
    return half[0], half[1]


def _is_even(source: SourceModel) -> bool:
    """Whether a source is symmetric about the x and the y axis, from its transform at scattered frequencies."""
    scatter = np.random.default_rng(1).standard_normal((2, 64)) * np.logspace(-3, 6, 64)
    values = [source.transfer(i * scatter[0], j * scatter[1]) for i, j in ((1, 1), (-1, 1), (1, -1))]
    return all(bool(np.all(np.abs(value - np.real(values[0])) < 1e-14)) for value in values)


def _radial_power(spectrum: TurbulenceSpectrum) -> float:
    """Power n in f = u^n that leaves no singularity at zero: 3 for S_n ~ f^(-11/3), more for steeper spectra."""
    psd = spectrum.psd(np.array([1e-9, 1e-8]))
    slope = math.log10(psd[1] / psd[0])
    if slope <= -4:
        raise ValueError("the spectrum rises as f^(-4) or faster toward zero, so slopes have no finite variance")
    return max(3.0, 1 / (4 + slope))


def _slice_integral(model: _Model, z0: float, z1: float) -> Array:
    """Integral of W over one slice, (6, 2p - 1, 2q - 1), halving panels until their rules agree."""
    effort, _ = _effort(model, z0, z1)
    edges = _panel_edges(model, z0, z1, effort)
    # Wide panels first: what is added later needs no accuracy of its own.
    waiting = sorted(itertools.pairwise(edges), key=lambda panel: panel[1] - panel[0])
    done: list[tuple[float, float, Array, Array]] = []
    total = np.zeros((6, *model.geometry.map_shape))
    while True:
        while waiting:
            a, b = waiting.pop()
            maps, error = _panel(model, a, b, (b - a) / (z1 - z0) * _sizes(total), effort)
            done.append((a, b, maps, error))
            total = total + maps
        errors = np.array([error for *_, error in done]) / _sizes(total)
        if np.all(errors.sum(axis=0) <= TOLERANCE):
            break
        if len(done) > _MAX_PANELS:
            raise ArithmeticError(f"the mean response from {z0:g} to {z1:g} m does not converge")
        a, b, maps, _ = done.pop(int(np.argmax(errors.max(axis=1))))
        total = total - maps
        waiting = [(a, (a + b) / 2), ((a + b) / 2, b)]
    if effort.without_fringe:
        total = total + _fringe_at(model, z1, effort) - _fringe_at(model, z0, effort)
    if model.geometry.n_sources == 1:
        total[list(_CROSS)] = np.nan
    return total


def _sizes(maps: Array, floor: Array | float = 0.0) -> Array:
    """Largest absolute value of each kind, (6,), at least `floor` and above zero."""
    return np.asarray(np.maximum(np.maximum(np.abs(maps).max(axis=(1, 2)), floor), np.finfo(float).tiny))


def _blur(model: _Model, z0: float, z1: float) -> float:
    """Half-width of the largest source's shadow on the pupil, from a layer in the middle (m)."""
    return model.geometry.magnification((z0 + z1) / 2) * max(model.extent)


def _panel_edges(model: _Model, z0: float, z1: float, effort: _Effort) -> list[float]:
    """Borders of the panels along z: the slice, cut where the shift m s passes a multiple of d.

    There the edges of the two subapertures coincide, and the cross maps have a kink in z, as long as the source
    does not blur it. Where it does not blur the diffraction of the edges either, the panels are shorter from the start.
    """
    geometry = model.geometry
    d = geometry.subaperture_size
    blur = _blur(model, z0, z1)
    pieces = min(4, math.ceil(d / (3 * blur))) if blur else 4
    if effort.lowest:
        pieces = max(pieces, math.ceil((_turns_of_fringe(model, z1) - _turns_of_fringe(model, z0)) / 3))
    cuts = set(np.linspace(z0, z1, pieces + 1).tolist())
    for s, n in zip(geometry.separation, (geometry.q, geometry.p), strict=True):
        for step in range(1, n + 1):
            m = step * d / abs(s) if s else math.inf
            if m * max(model.extent) > d / 8:
                break
            z = m if geometry.infinite else geometry.path_length * m / (1 + m)
            if z0 < z < z1:
                cuts.add(z)
    # A sliver of a panel costs as much as a whole one.
    edges = sorted(cuts)
    kept = [a for a, b in itertools.pairwise(edges) if b - a > 0.01 * (z1 - z0)]
    return [z0, *kept[1:], z1]


def _panel(model: _Model, z0: float, z1: float, floor: Array, effort: _Effort) -> tuple[Array, Array]:
    """Integral of W over [z0, z1], (6, 2p - 1, 2q - 1), and the error of each kind, (6,)."""
    z = (z0 + z1) / 2 + (z1 - z0) / 2 * _NODES
    rules = (z1 - z0) / 2 * _RULES
    geometry, d = model.geometry, model.geometry.subaperture_size
    moved = math.hypot(*geometry.separation) * (z1 - z0) * geometry.scaling((z0 + z1) / 2) ** 2
    if not geometry.infinite:
        moved /= geometry.path_length
    if z0 and moved > d / 8 and _blur(model, z0, z1) < d:
        # Seven layers never suffice where the pattern moves and is not blurred; fifteen at once share frequencies.
        seven, fifteen = _layers(model, z, rules[1:], floor, effort)
    else:
        three, seven, fifteen = _layers(model, z[_FIRST], rules[:, _FIRST], floor, effort)
        first = np.abs(seven - three).max(axis=(1, 2))
        # The difference is the error of the shorter rule; the power 3/2 for that of the longer one is QUADPACK's.
        error = first * np.minimum(1.0, np.sqrt(2e4 * first / _sizes(seven, floor)))
        if np.all(error <= TOLERANCE * _sizes(seven, floor)):
            return seven, error
        fifteen = fifteen + _layers(model, z[_SECOND], rules[2:, _SECOND], _sizes(seven, floor), effort)[0]
    last = np.abs(fifteen - seven).max(axis=(1, 2))
    # Diffraction by the edges oscillates in z near the pupil, and gains only a factor of ten there; 1e-9 elsewhere.
    return fifteen, last / 10


def _layers(model: _Model, z: Array, rules: Array, floor: Array, effort: _Effort) -> Array:
    """Weighted sums of W over layers, (rules, 6, 2p - 1, 2q - 1)."""
    maps = np.zeros((len(rules), 6, *model.geometry.map_shape))
    for first, last in _groups(model.geometry, z):
        # Each run of layers may leave its share of the error that the sum of all of them may.
        share = float(rules[-1, first:last].sum() / rules[-1].sum())
        allowance = share * _sizes(maps[-1], floor)
        maps += _maps(model, z[first:last], rules[:, first:last], allowance, effort)
    return maps


def _groups(geometry: Geometry, z: Array) -> Iterator[tuple[int, int]]:
    """Runs of layers that share one set of pupil frequencies: their patterns are scaled within a factor 1.3."""
    first = 0
    for last in range(1, z.size + 1):
        if last == z.size or geometry.scaling(float(z[last])) > 1.3 * geometry.scaling(float(z[first])):
            yield first, last
            first = last


def _at(model: _Model, z: float) -> Array:
    """W of one layer, (6, 2p - 1, 2q - 1)."""
    shape = (6, *model.geometry.map_shape)
    if z == model.geometry.path_length:
        # Tilts of a layer at the source move nothing, and it has no way to diffract.
        maps = np.zeros(shape)
    else:
        effort, checked = _effort(model, z, z)
        maps = _one_layer(model, z, effort) if checked is None else checked
    if model.geometry.n_sources == 1:
        maps[list(_CROSS)] = np.nan
    return maps


def _one_layer(model: _Model, z: float, effort: _Effort) -> Array:
    return np.asarray(_maps(model, np.array([z]), np.ones((1, 1)), np.zeros(6), effort)[0])


@dataclass(frozen=True)
class _Effort:
    """How finely and how far the frequencies of a slice are followed.

    A factor on all orders, the frequency below which the cross maps do not stop, and whether they leave out the fringe
    that diffraction prints at the shift between the sources (see `_effort`).
    """

    resolution: float = 1.0
    lowest: float = 0.0
    without_fringe: bool = False


def _fringe_frequency(model: _Model, wavelength: float) -> float:
    """Frequency s / (2 lambda L) at which the phase 2X of any layer is stationary against that of the shift m s."""
    length = 1.0 if model.geometry.infinite else model.geometry.path_length
    return math.hypot(*model.geometry.separation) / (2 * wavelength * length)


def _turns_of_fringe(model: _Model, z: float) -> float:
    """Phase of the fringe, in turns: (m s)^2 / (4 lambda z L / (L - z))."""
    geometry = model.geometry
    if z == geometry.path_length:
        return math.inf
    reach = math.hypot(*geometry.separation) * geometry.magnification(z)
    return reach**2 / (4 * model.band.centre * z * geometry.scaling(z)) if z else 0.0


def _fringe_at(model: _Model, z: float, effort: _Effort) -> Array:
    """What the end z of a slice adds to the integral of the fringe over it, (6, 2p - 1, 2q - 1).

    At the separation d the fringe is Re[A exp(i phi)], A slow and phi = pi (m s - d)^2 / (2 lambda z L / (L - z)).
    With phi as variable and H = A / phi', its integral is Re[(-i H + dH/dphi) exp(i phi)] between the ends, by parts
    twice. Four layers within three quarters of a turn tell H and its derivative.
    """
    geometry = model.geometry
    maps = np.zeros((6, *geometry.map_shape))
    if z == geometry.path_length:
        return maps  # infinitely quick there
    sx, sy = geometry.separation
    dx, dy = np.moveaxis(geometry.lags * geometry.subaperture_size, -1, 0)

    def phase(at: float) -> Array:
        m = geometry.magnification(at)
        squared = (m * sx - dx) ** 2 + (m * sy - dy) ** 2
        return np.asarray(np.pi * squared / (2 * model.band.centre * at * geometry.scaling(at)))

    def speed(at: float) -> Array:
        return np.asarray((phase(at + 1e-5 * z) - phase(at - 1e-5 * z)) / (2e-5 * z))

    whole = replace(effort, lowest=1.4 * _fringe_frequency(model, model.band.limits[0]), without_fringe=False)
    quarter = np.pi / 4 / float(speed(z).mean())
    unknowns, values = [], []
    for layer in z + quarter * np.array([-3.0, -1.0, 1.0, 3.0]):
        fringe = _one_layer(model, layer, whole) - _one_layer(model, layer, effort)
        u = phase(layer) - phase(z)
        unknowns.append([np.cos(u), u * np.cos(u), -np.sin(u), -u * np.sin(u)])
        values.append(fringe[list(_CROSS)] / speed(layer))
    # (dy, dx, layers, unknowns): real parts of H exp(i phi) and of its derivative, then imaginary parts.
    system = np.moveaxis(np.array(unknowns), (0, 1), (2, 3))
    found = np.linalg.solve(system, np.moveaxis(np.array(values), (0, 1), (2, 3)))
    maps[list(_CROSS)] = np.moveaxis(found[:, :, 1] + found[:, :, 2], -1, 0)
    return maps


def _effort(model: _Model, z0: float, z1: float) -> tuple[_Effort, Array | None]:
    """Orders with which the maps of a slice no longer move when they grow by a third, and the maps at its middle.

    Sources smaller than the fringe leave about 1e-3 of it in the scintillation cross map, beyond frequencies at which
    nothing else is left. It is followed there, unless it turns so often within the slice that its mean is gone. Where
    that is long work the orders are checked without it, and there are no maps to hand on.
    """
    effort = _Effort()
    shortest, longest = model.band.limits
    frequency = _fringe_frequency(model, longest)
    if frequency:
        sx, sy = (frequency * s / math.hypot(*model.geometry.separation) for s in model.geometry.separation)
        m = model.geometry.magnification(z0)
        left = max(
            float(np.abs(source.transfer(np.array([m * sx]), np.array([m * sy])))[0]) for source in model.sources
        )
        if left > 3e-4:
            often = _turns_of_fringe(model, z1) - _turns_of_fringe(model, z0) > _FRINGE_TURNS
            highest = _fringe_frequency(model, shortest)
            effort = _Effort(lowest=0.0 if often else 1.4 * highest, without_fringe=often)
    z = (z0 + z1) / 2
    long = 2 * math.pi * _reach(model, np.array([z]), True) * effort.lowest > _LONG
    tried = replace(effort, lowest=0.0) if long else effort
    maps = _one_layer(model, z, tried)
    for _ in range(6):
        finer_effort = replace(tried, resolution=4 / 3 * tried.resolution)
        finer = _one_layer(model, z, finer_effort)
        if np.all(np.abs(finer - maps).max(axis=(1, 2)) <= TOLERANCE * _sizes(finer)):
            return replace(effort, resolution=tried.resolution), None if long else finer
        tried, maps = finer_effort, finer
    raise ArithmeticError(f"the response at {z:g} m does not converge: the source or the spectrum is too structured")


def _maps(model: _Model, z: Array, rules: Array, floor: Array, effort: _Effort) -> Array:
    """Weighted sums over layers of W: (rules, 6, 2p - 1, 2q - 1) for weights (rules, layers)."""
    geometry = model.geometry
    maps = np.zeros((len(rules), 6, *geometry.map_shape))
    if geometry.n_sources == 1:
        passes = [_AUTO]
    elif _reach(model, z, True) < 1.3 * _reach(model, z, False):
        passes = [_AUTO + _CROSS]
    else:
        passes = [_AUTO, _CROSS]
    for kinds in passes:
        maps[:, kinds] = _integrate(model, z, rules, kinds, floor[list(kinds)], effort)
    return maps


def _reach(model: _Model, z: Array, crossed: bool) -> float:
    """Largest distance (m) that a frequency meets in the exponent: separation, aperture, source and shift."""
    geometry = model.geometry
    d = geometry.subaperture_size
    m = geometry.magnification(float(z[-1]))
    x, y = (
        n * d + m * (2 * extent + crossed * abs(s))
        for n, extent, s in zip((geometry.q, geometry.p), model.extent, geometry.separation, strict=True)
    )
    return math.hypot(x, y)


@lru_cache(maxsize=256)
def _legendre(n: int) -> tuple[Array, Array]:
    return np.polynomial.legendre.leggauss(n)


@dataclass(frozen=True)
class _Shell:
    """Nodes of one shell.

    Radii (n,), weights of dr (n,), angles (m,) of a quadrant or the half circle, a taper (n,) that ends the shell
    smoothly, and, (n,), what is left of the oscillation cos 2X and sin 2X of diffraction (None: all of it).
    """

    f: Array
    weight: Array
    angle: Array
    taper: Array
    fringes: Array | None


def _shells(model: _Model, z: Array, reach: float, effort: _Effort, crossed: bool) -> Iterator[_Shell]:
    """Shells of frequencies from zero outward.

    A Gauss-Legendre panel of n nodes over a phase of 2a is in error by about (a / 2)^(2n) / (2n)!, which 0.36 nodes per
    radian and 8 more hold below 1e-8; a trapezoidal rule over a circle at which the phase reaches x is in error by the
    Bessel function J_n(x), which falls below 1e-7 for n = x + 5 x^(1/3).

    The phase 2X of diffraction grows as f^2. Where it outruns by far every other phase, no point of the integrand is
    stationary and its oscillation leaves nothing in the maps: it is faded out there instead of followed to the end.
    """
    geometry = model.geometry
    shortest, longest = model.band.limits
    delays = [2 * math.pi * float(a) * geometry.scaling(float(a)) for a in z]
    bend, least = longest * max(delays), shortest * min(delays)
    # Where the fringes have faded, those between the wavelengths of a band remain.
    beat = (longest - shortest) * max(delays)
    swing = 2 * math.pi * reach
    fade = max(2 * swing / least, math.sqrt(300 / least)) if least else math.inf
    if crossed and effort.without_fringe:
        fade = 0.5 * _fringe_frequency(model, longest)

    start = min(6 / swing, 1 / math.sqrt(bend) if bend else math.inf)
    edges = [0.0] + [start * 8.0**-level for level in range(4, 0, -1)]
    outer = start
    for _ in range(_MAX_SHELLS):
        edges.append(outer)
        radii, weights, inner = [], [], edges[0]
        for a, b in itertools.pairwise(edges):
            turned = swing * (b - a) + (bend if a < _SHELL_RATIO * fade else beat) * (b * b - a * a)
            panels = max(1, math.ceil(turned / 60))
            nodes, rule = _legendre(math.ceil(effort.resolution * (_NODES_PER_RADIAN * turned / panels + 8)))
            cuts = np.linspace(a, b, panels + 1) ** (1 / model.power)
            half = np.diff(cuts)[:, None] / 2
            u = (cuts[:-1, None] + half) + half * nodes
            radii.append((u**model.power).ravel())
            weights.append((half * rule * model.power * u ** (model.power - 1)).ravel())
        f = np.concatenate(radii)
        turn = swing * outer
        span = np.pi / 2 if model.even else np.pi
        angles = math.ceil(effort.resolution * (turn + 5 * turn ** (1 / 3) + 10) * span / (2 * np.pi))
        angle = span * (np.arange(angles) + 0.5) / angles
        fringes = _fall((f / fade - 1) / (_SHELL_RATIO - 1)) if outer > fade else None
        yield _Shell(f, np.concatenate(weights), angle, _fall((f - inner) / (outer - inner)), fringes)
        edges, outer = [outer], outer * _SHELL_RATIO


def _fall(x: Array) -> Array:
    """1 for x < 0, 0 for x > 1, with three continuous derivatives: a sharp edge would ring in the maps."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(1 - x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3))


def _integrate(model: _Model, z: Array, rules: Array, kinds: tuple[int, ...], floor: Array, effort: _Effort) -> Array:
    """Maps of the given kinds, (rules, kinds, 2p - 1, 2q - 1), adding shells until they stand still."""
    crossed = kinds[-1] in _CROSS
    total: Array | float = 0.0
    before = change = estimate = None
    for shell in _shells(model, z, _reach(model, z, crossed), effort, crossed):
        whole, tapered = _shell_maps(model, z, rules, kinds, shell)
        ended = total + tapered
        total = total + whole
        if before is not None:
            step = ended - before
            # Without a source to blur it, the integrand falls as a power of f: what is left continues, in good
            # approximation, the geometric series that the last two shells begin.
            rest = _rest(step, change)
            latest = ended + rest
            if estimate is not None:
                largest = np.abs(latest[-1]).max(axis=(1, 2))
                # The rest is known to a third or better, so it may be twice what it may leave.
                allowed = 4 * TOLERANCE * np.maximum(largest, floor)
                moved = np.abs(latest[-1] - estimate[-1]).max(axis=(1, 2))
                followed = not crossed or shell.f[-1] >= effort.lowest
                if followed and np.all(moved <= allowed) and np.all(np.abs(rest[-1]).max(axis=(1, 2)) <= allowed):
                    return latest
            change, estimate = step, latest
        before = ended
    raise ArithmeticError("the response does not converge: the spectrum does not decay toward high frequencies")


def _rest(step: Array, change: Array | None) -> Array:
    """Sum of the shells to come, from the last two, for each rule and kind."""
    if change is None:
        return np.zeros_like(step)
    flat, previous = (array.reshape(*array.shape[:2], -1) for array in (step, change))
    largest = np.argmax(np.abs(previous), axis=2)[..., None]
    last = np.take_along_axis(flat, largest, axis=2)
    first = np.take_along_axis(previous, largest, axis=2)
    ratio = np.divide(last, first, out=np.zeros_like(last), where=first != 0)
    ratio = np.where((ratio > 0) & (ratio < 0.7), ratio, 0.0)
    return np.asarray((flat * ratio / (1 - ratio)).reshape(step.shape))


#: Sums that make a map: products of the cosine or sine along y and along x; sines are odd in the separation.
_COS_COS, _SIN_SIN, _SIN_COS, _COS_SIN = range(4)


def _shell_maps(model: _Model, z: Array, rules: Array, kinds: tuple[int, ...], shell: _Shell) -> tuple[Array, Array]:
    """Contribution of one shell, whole and tapered, each (rules, kinds, 2p - 1, 2q - 1)."""
    p, q, d = model.geometry.p, model.geometry.q, model.geometry.subaperture_size
    rows = max(1, _CHUNK // shell.angle.size)
    cosine, sine = np.cos(shell.angle), np.sin(shell.angle)
    radial = _radial(model, z, shell)
    sums = np.zeros((4, 2, len(rules), len(kinds), p, q))
    for first in range(0, shell.f.size, rows):
        part = slice(first, first + rows)
        f = shell.f[part, None]
        fx, fy = f * cosine, f * sine
        along_x, along_y = _harmonics(fx.ravel(), d, q), _harmonics(fy.ravel(), d, p)
        densities = _densities(model, z, fx, fy, radial.part(part), kinds)
        basis: dict[int, Array] = {}
        for block, products, density in densities:
            # (layers, kinds, radii, angles) -> (whole or tapered, rules, kinds, nodes)
            weighed = np.tensordot(rules, density, axes=1)
            pair = np.stack([weighed, weighed * shell.taper[part, None]])
            shape = (2, len(rules), density.shape[1], p, q)
            pair = pair.reshape(-1, fx.size)
            for product, sign in products:
                if product not in basis:
                    y = along_y[product in (_SIN_SIN, _SIN_COS)][:, None]
                    x = along_x[product in (_SIN_SIN, _COS_SIN)]
                    basis[product] = (y * x).reshape(p * q, -1)
                sums[product][:, :, block] += sign * (pair @ basis[product].T).reshape(shape)
    dy, dx = np.arange(1 - p, p), np.arange(1 - q, q)
    rows_, columns = np.ix_(np.abs(dy), np.abs(dx))
    odd_y, odd_x = np.sign(dy)[:, None], np.sign(dx)
    every = sums[..., rows_, columns]
    whole, tapered = (
        every[_COS_COS] + odd_y * odd_x * every[_SIN_SIN] + odd_y * every[_SIN_COS] + odd_x * every[_COS_SIN]
    )
    return whole, tapered


def _harmonics(f: Array, d: float, n: int) -> tuple[Array, Array]:
    """Cosine and sine of 2 pi f d j for j = 0 ... n - 1, (n, f.size) each, by recurrence."""
    step = np.exp(2j * np.pi * d * f)
    powers = np.ones((n, f.size), dtype=complex)
    for j in range(1, n):
        np.multiply(powers[j - 1], step, out=powers[j])
    return np.ascontiguousarray(powers.real), np.ascontiguousarray(powers.imag)


@dataclass(frozen=True)
class _Radial:
    """What depends on layer and modulus of the frequency only, (layers, radii) each.

    Parameters
    ----------
    power, bright : ndarray
        Weighted index spectrum, for slopes and for scintillation.
    factors : tuple of ndarray
        Where all of the fringes are followed, cos X and k sin X, means over the band; where they fade, what is left of
        their squares and of their product.
    """

    power: Array
    bright: Array
    factors: tuple[Array, ...]

    def part(self, radii: slice) -> _Radial:
        factors = tuple(factor[:, radii, None] for factor in self.factors)
        return _Radial(self.power[:, radii, None], self.bright[:, radii, None], factors)


def _radial(model: _Model, z: Array, shell: _Shell) -> _Radial:
    geometry = model.geometry
    scaling = np.array([geometry.scaling(float(a)) for a in z])[:, None]
    zeta = z[:, None] * scaling * shell.f**2
    turn = np.exp(1j * np.pi * model.band.centre * zeta)
    c, s = (envelope * turn for envelope in model.band.envelopes(zeta))
    factors: tuple[Array, ...] = (c.real, s.imag)
    if shell.fringes is not None:
        # Of the product of two real parts, half is the product of the numbers, which turns, and half that of one with
        # the other's conjugate, which does not.
        factors = (
            (np.abs(c) ** 2 + shell.fringes * (c * c).real) / 2,
            (np.abs(s) ** 2 - shell.fringes * (s * s).real) / 2,
            ((np.conj(c) * s).imag + shell.fringes * (c * s).imag) / 2,
        )
    # The rest of the circle holds the same values, or their complex conjugates.
    measure = shell.weight * shell.f * (2 * np.pi / shell.angle.size)
    spectrum = np.stack([model.spectrum.psd(float(a) * shell.f) for a in scaling[:, 0]])
    power = scaling**2 * spectrum * measure
    bright = power
    if model.point_index:
        bright = power * suppression(scaling * shell.f, geometry.wavelength, geometry.path_length, model.point_index)
    return _Radial(power, bright, factors)


def _aperture(model: _Model, fx: Array, fy: Array) -> tuple[Array, Array, Array]:
    """Filters of one subaperture: mean over it, and tilt along x and y in units of i rad/m."""
    d = model.geometry.subaperture_size
    if model.aperture == "square":
        ax, ay = np.sinc(d * fx), np.sinc(d * fy)
        mean = ax * ay
        if model.tilt == "gradient":
            return mean, 2 * np.pi * fx * mean, 2 * np.pi * fy * mean
        # Plane fitted by least squares: 12 / d^2 times the mean of x phase; j1 is the spherical Bessel function.
        return mean, 6 / d * _spherical_j1(np.pi * d * fx) * ay, 6 / d * ax * _spherical_j1(np.pi * d * fy)
    w = np.pi * d * np.hypot(fx, fy)
    mean = np.where(w < 1e-6, 1.0, 2 * j1(w) / np.maximum(w, 1e-300))
    tilt = mean
    if model.tilt == "zernike":
        tilt = np.where(w < 1e-3, 1 - w**2 / 12, 8 * jv(2, w) / np.maximum(w, 1e-3) ** 2)
    return mean, 2 * np.pi * fx * tilt, 2 * np.pi * fy * tilt


def _spherical_j1(x: Array) -> Array:
    small = np.abs(x) < 1e-2
    safe = np.where(small, 1.0, x)
    return np.where(small, x / 3 * (1 - x**2 / 10), (np.sin(safe) / safe - np.cos(safe)) / safe)


_Amplitudes = list[tuple["NDArray[Any]", "NDArray[Any]"]]


def _amplitudes(
    model: _Model, m: float, fx: Array, fy: Array, filters: tuple[Array, Array, Array]
) -> list[_Amplitudes]:
    """Factors of cos X and k sin X in the amplitudes of slopes x and y, times i, and of scintillation, for each source.

    They are real for even sources.
    """
    mean, *tilts = filters
    glint, flux = model.centroid_term * mean, 2 * mean
    amplitudes = []
    for source, centroid in zip(model.sources, model.centroids, strict=True):
        transfer = source.transfer(m * fx, m * fy)
        transfer = np.real(transfer) if model.even else np.conj(transfer)
        bright: list[NDArray[Any]] = [np.zeros(1), np.zeros(1)]
        if model.centroid_term:
            moments = source.moment(m * fx, m * fy)
            for axis, (moment, centre) in enumerate(zip(moments, centroid, strict=True)):
                # i conj(M), whose real part is the imaginary part of M.
                about = np.imag(moment) if model.even else 1j * (np.conj(moment) - centre * transfer)
                bright[axis] = glint * about
        slopes = [(tilt * transfer, term) for tilt, term in zip(tilts, bright, strict=True)]
        amplitudes.append([*slopes, (np.zeros(1), flux * transfer)])
    return amplitudes


def _product(
    first: tuple[NDArray[Any], NDArray[Any]],
    second: tuple[NDArray[Any], NDArray[Any]],
    power: Array,
    factors: tuple[Array, ...],
) -> NDArray[Any]:
    """Density of the product of two amplitudes, first times conj(second), for one layer (see `_Radial`)."""
    if len(factors) == 2:
        c, s = factors
        a = c * first[0] + s * first[1]
        if first is second:
            return np.asarray(power * (a * a if not np.iscomplexobj(a) else np.abs(a) ** 2))
        return np.asarray(power * (a * np.conj(c * second[0] + s * second[1])))
    cc, ss, cs = factors
    tilts, glints = first[0] * np.conj(second[0]), first[1] * np.conj(second[1])
    mixed = first[0] * np.conj(second[1]) + first[1] * np.conj(second[0])
    return np.asarray(power * (cc * tilts + ss * glints + cs * mixed))


def _densities(
    model: _Model,
    z: Array,
    fx: Array,
    fy: Array,
    radial: _Radial,
    kinds: tuple[int, ...],
) -> list[tuple[slice, tuple[tuple[int, int], ...], Array]]:
    """Spectral densities of the kinds: for each block of kinds the products it enters, with sign, and the density.

    Densities are (layers, kinds, radii, angles). Over the half circle, a map is the real part of the sum of density
    times exp(i a_x + i a_y); over a quadrant, of even sources, the sum of density times cos(a_x - b_x) cos(a_y - b_y),
    with the phase a of the separation and b of the shift between the sources.
    """
    geometry = model.geometry
    filters = _aperture(model, fx, fy)
    crossed, own = kinds[-1] in _CROSS, kinds[0] in _AUTO
    autos = np.empty((z.size, 3, *fx.shape)) if own else None
    terms: dict[int, Array] = {}
    phases = [2 * np.pi * s * f if s else None for s, f in zip(geometry.separation, (fx, fy), strict=True)]
    for layer, distance in enumerate(z):
        m = geometry.magnification(float(distance))
        amplitudes = _amplitudes(model, m, fx, fy, filters)
        factors = tuple(factor[layer] for factor in radial.factors)
        turns = _turns(phases, m, model.even) if crossed else {}
        for kind in range(3):
            first, second = amplitudes[0][kind], amplitudes[-1][kind]
            power = (radial.bright if kind == 2 else radial.power)[layer]
            density = _product(first, second, power, factors)
            if autos is not None and first is second:
                autos[layer, kind] = np.real(density)
            elif autos is not None:
                each = [np.real(_product(one, one, power, factors)) for one in (first, second)]
                autos[layer, kind] = (each[0] + each[1]) / 2
            for product, turn in turns.items():
                if product not in terms:
                    terms[product] = np.empty((z.size, 3, *fx.shape))
                values = terms[product]
                if model.even:
                    np.multiply(density, turn, out=values[layer, kind])
                else:
                    shifted = density * turn
                    values[layer, kind] = shifted.imag if product == _SIN_COS else shifted.real
    blocks: list[tuple[slice, tuple[tuple[int, int], ...], Array]] = []
    if autos is not None:
        blocks.append((slice(0, 3), ((_COS_COS, 1),) if model.even else ((_COS_COS, 1), (_SIN_SIN, -1)), autos))
    crosses = slice(len(kinds) - 3, len(kinds))
    if model.even:
        blocks += [(crosses, ((product, 1),), values) for product, values in terms.items()]
    elif crossed:
        blocks.append((crosses, ((_COS_COS, 1), (_SIN_SIN, -1)), terms[_COS_COS]))
        blocks.append((crosses, ((_SIN_COS, -1), (_COS_SIN, -1)), terms[_SIN_COS]))
    return blocks


def _turns(phases: list[Array | None], m: float, even: bool) -> dict[int, NDArray[Any]]:
    """Factors of the density by the shift between the sources, for each product that they feed."""
    if not even:
        turn = np.exp(-1j * m * sum(phase for phase in phases if phase is not None))
        return {_COS_COS: turn, _SIN_COS: turn}
    x, y = (None if phase is None else (np.cos(m * phase), np.sin(m * phase)) for phase in phases)
    if x is None or y is None:
        turns: dict[int, NDArray[Any]] = {_COS_COS: np.ones(1)}
        if y is not None:
            turns = {_COS_COS: y[0], _SIN_COS: y[1]}
        if x is not None:
            turns = {_COS_COS: x[0], _COS_SIN: x[1]}
        return turns
    return {_COS_COS: x[0] * y[0], _SIN_COS: x[0] * y[1], _COS_SIN: x[1] * y[0], _SIN_SIN: x[1] * y[1]}
