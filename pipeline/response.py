r"""Response functions: the correlation maps that a slice of turbulence with Cn2 dz = 1 prints on the data.

A layer at distance z gives slopes and intensities through linear filters of its index fluctuations. With
X = pi lambda z f^2 L / (L - z), m = z / (L - z), k = 2 pi / lambda, the aperture filter F, the source's transform P~ and the
transform M_l of s_l P about its own centroid, the amplitude of one source is, in pupil frequencies f (cycles per m),

    slope along l    A_l = -2 pi i f_l F cos X conj(P~(m f)) + (2 k / L) F sin X conj(M_l(m f))
    scintillation    A_i = 2 k F sin X conj(P~(m f))

and the response at the separation d = r_a - r_b, a on the first source and b on the second,

    W(d) = integral of (L / (L - z))^2 S_n(f L / (L - z)) A^(1) conj(A^(2)) exp(2 pi i f.(d - m s)) d^2f,

with the separation s of the sources: the ridge of the cross maps lies at d = m s. These are Sauvage et al. 2021
(https://doi.org/10.1364/AO.438170), Eqs. (8)-(16), for any two sources, with one term more: each point of an extended
source scintillates on its own and is imaged at s / L, so the centroid also moves by the intensity-weighted mean of s / L.
For a Gaussian source of standard deviation sigma_l the two slope terms are -2 pi i f_l F conj(P~) (cos X - (2 k m sigma_l^2 / L)
sin X). `slope_response="printed"` leaves the second term out, as the paper does.

Near f = 0 the slope integrand goes as f^(-5/3): no grid that is uniform in f holds it. The integral is taken in polar
coordinates, over shells of geometrically growing radius with Gauss-Legendre panels in u = f^(1/3), in which that
singularity is gone, and the trapezoidal rule in angle, which converges exponentially. Orders follow from the phase
that the widest separation, shift, aperture, source and diffraction give the integrand; shells are added until
the maps no longer move. Slice means use Gauss-Kronrod panels along z, halved where their two rules disagree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.special import j1, jv

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

#: Relative change, of each map's maximum, at which shells and panels stop; the maps are then good to about 1e-6.
TOLERANCE = 2e-7

#: Nodes per radian of phase in radius, and spare angles, at resolution 1 (see `_shells`).
_NODES_PER_RADIAN = 0.42
_SHELL_RATIO = math.sqrt(2.0)
_MAX_SHELLS = 90
_CHUNK = 8192

#: Kronrod's extension of the 5-point Gauss-Legendre rule to 11 points: nodes, weights, and Gauss weights.
_KRONROD_HALF = (
    (0.0, 0.282987417857491213, 0.568888888888888889),
    (0.279630413161783193, 0.272849801912558922, 0.0),
    (0.538469310105683091, 0.241040339228647587, 0.478628670499366468),
    (0.754166726570849220, 0.186800796556492657, 0.0),
    (0.906179845938663993, 0.115233316622473394, 0.236926885056189088),
    (0.984085360094842464, 0.042582036751081833, 0.0),
)
_NODES = np.array([-x for x, _, _ in _KRONROD_HALF[:0:-1]] + [x for x, _, _ in _KRONROD_HALF])
_RULES = np.array(
    [
        [w for _, w, _ in _KRONROD_HALF[:0:-1]] + [w for _, w, _ in _KRONROD_HALF],
        [w for _, _, w in _KRONROD_HALF[:0:-1]] + [w for _, _, w in _KRONROD_HALF],
    ]
)

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
    model = _model(geometry, spectrum, sources, slope_response, aperture, tilt)
    columns = []
    for z0, z1 in zip(grid.edges[:-1], grid.edges[1:], strict=True):
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
) -> Array:
    """Response functions W of one thin layer (Sauvage et al. 2021, Eqs. (8)-(10)).

    Parameters
    ----------
    geometry, spectrum, sources, slope_response, aperture, tilt
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
    return _at(_model(geometry, spectrum, sources, slope_response, aperture, tilt), z)


@dataclass(frozen=True)
class _Model:
    """What every integral needs, checked and measured once."""

    geometry: Geometry
    spectrum: TurbulenceSpectrum
    sources: tuple[SourceModel, ...]  # one where both are the same
    centroids: tuple[tuple[float, float], ...]
    extent: tuple[float, float]  # half-widths that hold the largest source, x and y
    centroid_term: float  # 2 k / L, 0 where the term is left out
    aperture: Aperture
    tilt: Tilt
    power: float  # n in f = u^n

    @property
    def wavenumber(self) -> float:
        return 2 * math.pi / self.geometry.wavelength


def _model(
    geometry: Geometry,
    spectrum: TurbulenceSpectrum,
    sources: Sequence[SourceModel],
    slope_response: str,
    aperture: str,
    tilt: str,
) -> _Model:
    for name, value, known in (
        ("slope_response", slope_response, ("centroid", "printed")),
        ("aperture", aperture, ("square", "circular")),
        ("tilt", tilt, ("gradient", "zernike")),
    ):
        if value not in known:
            raise ValueError(f"{name} must be '{known[0]}' or '{known[1]}', got {value!r}")
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
    term = 4 * math.pi / geometry.wavelength * inverse_length if slope_response == "centroid" else 0.0
    return _Model(
        geometry,
        spectrum,
        kept,
        tuple(centroids),
        (float(extents[:, 0].max()), float(extents[:, 1].max())),
        term,
        aperture,  # type: ignore[arg-type]
        tilt,  # type: ignore[arg-type]
        _radial_power(spectrum),
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


def _radial_power(spectrum: TurbulenceSpectrum) -> float:
    """n in f = u^n that leaves no singularity at zero: 3 for S_n ~ f^(-11/3), more for steeper spectra."""
    psd = spectrum.psd(np.array([1e-9, 1e-8]))
    slope = math.log10(psd[1] / psd[0])
    if slope <= -4:
        raise ValueError("the spectrum rises as f^(-4) or faster toward zero, so slopes have no finite variance")
    return max(3.0, 1 / (4 + slope))


def _slice_integral(model: _Model, z0: float, z1: float) -> Array:
    """Integral of W over one slice, (6, 2p - 1, 2q - 1), halving panels until both rules agree."""
    edges = _panel_edges(model.geometry, z0, z1)
    resolution = _resolution(model, (z0 + z1) / 2)
    panels = []
    total = np.zeros((6, *model.geometry.map_shape))
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        maps, error = _panel(model, a, b, np.abs(total).max(axis=(1, 2)), resolution)
        panels.append((a, b, maps, error))
        total += maps
    for _ in range(24):
        size = np.maximum(np.abs(total).max(axis=(1, 2)), np.finfo(float).tiny)
        errors = np.array([error for *_, error in panels]) / size
        if np.all(errors.sum(axis=0) <= TOLERANCE):
            break
        a, b, maps, _ = panels.pop(int(np.argmax(errors.max(axis=1))))
        total = total - maps
        for c, d in ((a, (a + b) / 2), ((a + b) / 2, b)):
            maps, error = _panel(model, c, d, size, resolution)
            panels.append((c, d, maps, error))
            total = total + maps
    if model.geometry.n_sources == 1:
        total[list(_CROSS)] = np.nan
    return total


def _panel_edges(geometry: Geometry, z0: float, z1: float) -> list[float]:
    """Borders of the panels along z: the slice, cut where the shift m s passes a multiple of d.

    There the edges of the two subapertures coincide, and the cross maps have a kink in z near the pupil, where
    the source does not blur it.
    """
    cuts = {z0, z1}
    for s, n in zip(geometry.separation, (geometry.q, geometry.p), strict=True):
        for step in range(1, n + 1):
            if s:
                m = step * geometry.subaperture_size / abs(s)
                z = m if geometry.infinite else geometry.path_length * m / (1 + m)
                # A sliver of a panel costs as much as a whole one.
                if z0 + 0.01 * (z1 - z0) < z < z1 - 0.01 * (z1 - z0):
                    cuts.add(z)
    return sorted(cuts)


def _panel(model: _Model, z0: float, z1: float, floor: Array, resolution: float) -> tuple[Array, Array]:
    """Integral of W over [z0, z1], (6, 2p - 1, 2q - 1), and the error of each kind, (6,)."""
    z = (z0 + z1) / 2 + (z1 - z0) / 2 * _NODES
    rules = (z1 - z0) / 2 * _RULES
    both = np.zeros((2, 6, *model.geometry.map_shape))
    for first, last in _groups(model.geometry, z):
        size = np.maximum(floor, np.abs(both[0]).max(axis=(1, 2)))
        both += _maps(model, z[first:last], rules[:, first:last], size, resolution)
    difference = np.abs(both[0] - both[1]).max(axis=(1, 2))
    size = np.maximum(np.maximum(floor, np.abs(both[0]).max(axis=(1, 2))), np.finfo(float).tiny)
    # The rules differ by the error of the shorter one; the longer one is better by QUADPACK's power of it.
    return both[0], difference * np.minimum(1.0, np.sqrt(200 * difference / size))


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
        maps = _maps(model, np.array([z]), np.ones((1, 1)), np.zeros(6), _resolution(model, z))[0]
    if model.geometry.n_sources == 1:
        maps[list(_CROSS)] = np.nan
    return maps


def _resolution(model: _Model, z: float) -> float:
    """Factor on all orders at which the maps of a layer no longer move when the orders grow by a third."""
    resolution = 1.0
    rule, floor = np.ones((1, 1)), np.zeros(6)
    maps = _maps(model, np.array([z]), rule, floor, resolution)[0]
    for _ in range(6):
        finer = _maps(model, np.array([z]), rule, floor, 4 / 3 * resolution)[0]
        size = np.abs(finer).max(axis=(1, 2))
        if np.all(np.abs(finer - maps).max(axis=(1, 2)) <= 2 * TOLERANCE * size):
            return resolution
        resolution, maps = 4 / 3 * resolution, finer
    raise ArithmeticError(f"the response at {z:g} m does not converge: the source or the spectrum is too structured")


def _maps(model: _Model, z: Array, rules: Array, floor: Array, resolution: float) -> Array:
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
        maps[:, kinds] = _integrate(model, z, rules, kinds, floor[list(kinds)], resolution)
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
    """Nodes of one shell: radii (n,), weights of dr (n,), angles of the half circle (m,), and the taper (n,)."""

    f: Array
    weight: Array
    angle: Array
    taper: Array


def _shells(model: _Model, z: Array, reach: float, resolution: float) -> Iterator[_Shell]:
    """Shells of frequencies from zero outward.

    A Gauss-Legendre panel of n nodes over a phase of 2a is in error by about (a / 2)^(2n) / (2n)!, which 0.42 nodes per
    radian and 8 more hold below 1e-9; a trapezoidal rule over a circle at which the phase reaches x is in error by the
    Bessel function J_n(x), which falls below 1e-10 for n = x + 8 x^(1/3).
    """
    geometry = model.geometry
    bend = 2 * math.pi * geometry.wavelength * max(float(a) * geometry.scaling(float(a)) for a in z)
    swing = 2 * math.pi * reach

    def phase(f: float) -> float:
        return swing * f + bend * f * f

    start = min(0.5 / swing, 0.5 / math.sqrt(bend) if bend else math.inf)
    edges = [0.0] + [start * 8.0**-level for level in range(4, 0, -1)]
    outer = start
    for _ in range(_MAX_SHELLS):
        edges.append(outer)
        radii, weights, inner = [], [], edges[0]
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            panels = max(1, math.ceil((phase(b) - phase(a)) / 60))
            nodes, rule = _legendre(math.ceil(resolution * (_NODES_PER_RADIAN * (phase(b) - phase(a)) / panels + 8)))
            cuts = np.linspace(a, b, panels + 1) ** (1 / model.power)
            half = np.diff(cuts)[:, None] / 2
            u = (cuts[:-1, None] + half) + half * nodes
            radii.append((u**model.power).ravel())
            weights.append((half * rule * model.power * u ** (model.power - 1)).ravel())
        f = np.concatenate(radii)
        x = np.clip((f - inner) / (outer - inner), 0, 1)
        turn = swing * outer
        angles = math.ceil(resolution * (turn + 8 * turn ** (1 / 3) + 16) / 2)
        angle = np.pi * (np.arange(angles) + 0.5) / angles
        # Smooth to the fourth derivative: a sharp edge would ring in the maps of far separations.
        yield _Shell(f, np.concatenate(weights), angle, 1 - x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3))
        edges, outer = [outer], outer * _SHELL_RATIO


def _integrate(
    model: _Model, z: Array, rules: Array, kinds: tuple[int, ...], floor: Array, resolution: float
) -> Array:
    """Maps of the given kinds, (rules, kinds, 2p - 1, 2q - 1), adding shells until they stand still."""
    crossed = kinds[-1] in _CROSS
    total = 0.0
    before: Array | None = None
    estimate: Array | None = None
    change: Array | None = None
    calm = 0
    for shell in _shells(model, z, _reach(model, z, crossed), resolution):
        whole, tapered = _shell_maps(model, z, rules, kinds, shell)
        ended = total + tapered
        total = total + whole
        if before is None:
            before = ended
            continue
        step = ended - before
        # Without a source to blur it, the integrand falls as a power of f: continue it as the geometric series
        # that the last two shells begin.
        latest = ended + _rest(step, change)
        if estimate is not None:
            size = np.maximum(np.abs(latest[0]).max(axis=(1, 2)), floor)
            calm = calm + 1 if np.all(np.abs(latest[0] - estimate[0]).max(axis=(1, 2)) <= TOLERANCE * size) else 0
            if calm == 2:
                return np.asarray(latest)
        before, change, estimate = ended, step, latest
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


def _shell_maps(
    model: _Model, z: Array, rules: Array, kinds: tuple[int, ...], shell: _Shell
) -> tuple[Array, Array]:
    """Contribution of one shell, whole and tapered, each (rules, kinds, 2p - 1, 2q - 1)."""
    geometry = model.geometry
    p, q = geometry.p, geometry.q
    crossed = kinds[-1] in _CROSS
    own = kinds[0] in _AUTO
    rows = max(1, _CHUNK // shell.angle.size)
    sums = np.zeros((2, (2 if crossed else 1), len(rules), len(kinds), 4, p, q))
    cosine, sine = np.cos(shell.angle), np.sin(shell.angle)
    radial = _radial(model, z, shell)
    for first in range(0, shell.f.size, rows):
        part = slice(first, first + rows)
        f = shell.f[part, None]
        fx, fy = f * cosine, f * sine
        density = _densities(model, z, fx, fy, tuple(values[:, part, None] for values in radial), own, crossed)
        # (layers, parts, kinds, radii, angles) -> (rules, ...)
        density = np.tensordot(rules, density, axes=1)
        tapered = density * shell.taper[part, None]
        cx, sx = _harmonics(fx.ravel(), geometry.subaperture_size, q)
        cy, sy = _harmonics(fy.ravel(), geometry.subaperture_size, p)
        for number, values in enumerate((density, tapered)):
            flat = np.moveaxis(values.reshape(*values.shape[:3], -1), 1, 0)
            left_c = (flat[..., None, :] * cy).reshape(-1, fx.size)
            left_s = (flat[..., None, :] * sy).reshape(-1, fx.size)
            shape = (flat.shape[0], len(rules), len(kinds), p, q)
            products = [left_c @ cx.T, left_s @ sx.T]
            if crossed:
                products += [left_s @ cx.T, left_c @ sx.T]
            for place, product in enumerate(products):
                sums[number, :, :, :, place] += product.reshape(shape)
    return _unfold(sums[0]), _unfold(sums[1])


def _unfold(sums: Array) -> Array:
    """Maps over all separations from the sums over cosines and sines of the non-negative ones.

    `sums` is (part, rules, kinds, 4, p, q): real and imaginary part of the density times cos cos, sin sin, sin(y) cos(x),
    cos(y) sin(x). The map is Re of the density times exp(i a_x + i a_y), and sines are odd in the separation.
    """
    p, q = sums.shape[-2:]
    dy, dx = np.arange(1 - p, p), np.arange(1 - q, q)
    take = np.ix_(np.abs(dy), np.abs(dx))
    odd_y, odd_x = np.sign(dy)[:, None], np.sign(dx)[None, :]
    cc, ss, sc, cs = (sums[..., place, :, :][..., take[0], take[1]] for place in range(4))
    maps = cc[0] - odd_y * odd_x * ss[0]
    if len(sums) == 2:
        maps = maps - odd_y * sc[1] - odd_x * cs[1]
    return np.asarray(maps)


def _harmonics(f: Array, d: float, n: int) -> tuple[Array, Array]:
    """Cosine and sine of 2 pi f d j for j = 0 ... n - 1, (n, f.size) each, by recurrence."""
    step = np.exp(2j * np.pi * d * f)
    powers = np.ones((n, f.size), dtype=complex)
    for j in range(1, n):
        np.multiply(powers[j - 1], step, out=powers[j])
    return np.ascontiguousarray(powers.real), np.ascontiguousarray(powers.imag)


def _radial(model: _Model, z: Array, shell: _Shell) -> tuple[Array, Array, Array]:
    """Weighted index spectrum, cos X and sin X of every layer and radius, (layers, radii) each."""
    scaling = np.array([model.geometry.scaling(float(a)) for a in z])[:, None]
    x = np.pi * model.geometry.wavelength * z[:, None] * scaling * shell.f**2
    # The half circle stands for the whole one, whose other half holds the complex conjugate.
    measure = shell.weight * shell.f * (2 * np.pi / shell.angle.size)
    spectrum = np.stack([model.spectrum.psd(float(a) * shell.f) for a in scaling[:, 0]])
    return scaling**2 * spectrum * measure, np.cos(x), np.sin(x)


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
    tilt = mean if model.tilt == "gradient" else np.where(w < 1e-3, 1 - w**2 / 12, 8 * jv(2, w) / np.maximum(w, 1e-3) ** 2)
    return mean, 2 * np.pi * fx * tilt, 2 * np.pi * fy * tilt


def _spherical_j1(x: Array) -> Array:
    small = np.abs(x) < 1e-2
    safe = np.where(small, 1.0, x)
    return np.where(small, x / 3 * (1 - x**2 / 10), (np.sin(safe) / safe - np.cos(safe)) / safe)


def _real(values: NDArray[Any]) -> NDArray[Any]:
    """The same numbers, real where they are: even sources then cost real arithmetic only."""
    return values if not np.iscomplexobj(values) or values.imag.any() else values.real


def _densities(
    model: _Model, z: Array, fx: Array, fy: Array, radial: tuple[Array, Array, Array], own: bool, crossed: bool
) -> Array:
    """Spectral density of each kind, (layers, parts, kinds, radii, angles).

    `own` asks for the auto kinds, `crossed` for the cross kinds; the parts are real and, with `crossed`, imaginary.
    """
    geometry = model.geometry
    spectrum, cos_x, sin_x = radial
    mean, tilt_x, tilt_y = _aperture(model, fx, fy)
    sx, sy = geometry.separation
    turn = 2 * np.pi * (sx * fx + sy * fy) if crossed else fx
    autos = 3 * own
    out = np.zeros((z.size, 1 + crossed, autos + 3 * crossed, *fx.shape))
    for layer, distance in enumerate(z):
        m = geometry.magnification(float(distance))
        power, c, s = spectrum[layer], cos_x[layer], sin_x[layer]
        amplitudes = []
        for source, centroid in zip(model.sources, model.centroids, strict=True):
            transfer = np.conj(_real(source.transfer(m * fx, m * fy)))
            seen = c * transfer
            ax, ay = tilt_x * seen, tilt_y * seen
            if model.centroid_term:
                # Of -i times the slope amplitude; see the module's first lines.
                bright = (model.centroid_term * s) * mean
                moments = source.moment(m * fx, m * fy)
                for axis, (moment, centre) in enumerate(zip(moments, centroid, strict=True)):
                    about = moment - centre * np.conj(transfer) if centre else moment
                    term = bright * _real(1j * np.conj(about))
                    if axis == 0:
                        ax = ax + term
                    else:
                        ay = ay + term
            amplitudes.append((ax, ay, (2 * model.wavenumber * s) * mean * transfer))
        first, second = amplitudes[0], amplitudes[-1]
        for kind in range(3):
            a, b = first[kind], second[kind]
            if len(amplitudes) == 1:
                even = power * (a * a if not np.iscomplexobj(a) else (a * a.conj()).real)
            if own:
                out[layer, 0, kind] = (
                    even
                    if len(amplitudes) == 1
                    else power / 2 * ((a * np.conj(a)).real + (b * np.conj(b)).real)
                )
            if crossed:
                shift_c, shift_s = (np.cos(m * turn), np.sin(m * turn)) if kind == 0 else (shift_c, shift_s)
                if len(amplitudes) == 1:
                    out[layer, 0, autos + kind] = even * shift_c
                    out[layer, 1, autos + kind] = -even * shift_s
                else:
                    value = power * (a * np.conj(b)) * (shift_c - 1j * shift_s)
                    out[layer, 0, autos + kind] = value.real
                    out[layer, 1, autos + kind] = value.imag
    return out
