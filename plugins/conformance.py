"""The contract of a plugin, executable: small named checks for the tests of whoever writes one.

In a plugin author's own test suite::

    from coslidar.plugins.conformance import parametrize_with_checks
    from my_prior import MyPrior

    @parametrize_with_checks([MyPrior, MyPrior(length="500 m")])
    def test_contract(plugin, check):
        check(plugin)

Every check has a name, which is in the id of its test, and one promise. A plugin that breaks it raises an
AssertionError that names plugin, check, what was promised and what was delivered. A check that a plugin fails on
purpose is declared with its reason, by the class attribute `expected_failed_checks` or by the argument of that name.
"""

from __future__ import annotations

import pickle
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from ..pipeline import inversion, lineage
from ..pipeline.geometry import SliceGrid
from ..pipeline.units import faults
from .contract import HyperparameterSelectorBase, Plugin, RegulariserBase, SourceModelBase, TurbulenceSpectrumBase
from .registry import KEYS, KINDS

if TYPE_CHECKING:
    import pytest

Expected: TypeAlias = Mapping[str, str]

#: Decades within which a selector must find mu, on the median of :data:`_DRAWS` draws.
_DECADES = 1.0
_DRAWS = 15
_UNIFORM = SliceGrid.uniform(2670.0, 12)
#: Regularisers must do with any grid: few and many slices, unequal ones, a long path.
_GRIDS = (
    _UNIFORM,
    *(SliceGrid.uniform(2670.0, k) for k in (1, 2, 3, 40)),
    SliceGrid((0.0, 50.0, 150.0, 400.0, 900.0, 1000.0, 2500.0, 2670.0)),
    SliceGrid.uniform(20_000.0, 12),
)
#: Text that is a number with a unit.
_LIKE_QUANTITY = re.compile(r"^[+-]?\d+(\.\d*)?([eE][+-]?\d+)? ?[A-Za-z]+")
#: SI unit -> another that measures the same, and its size. Powers of ten, so that respelling a number is exact.
_RESPELLED = {
    "m": ("mm", "1e-3"),
    "rad": ("urad", "1e-6"),
    "s": ("ms", "1e-3"),
    "Hz": ("kHz", "1e3"),
    "m/s": ("km/s", "1e3"),
    "rad^2": ("urad^2", "1e-12"),
}


@dataclass(frozen=True)
class Check:
    """One promise of the contract.

    Parameters
    ----------
    name : str
        What the id of a test and the command line call it.
    promise : str
        What is promised, in words.
    judge : callable
        Takes a plugin and returns what it delivered instead, or None where it keeps the promise.
    """

    name: str
    promise: str
    judge: Callable[[Any], str | None] = field(repr=False)

    def __call__(self, plugin: Plugin | type[Plugin]) -> None:
        """Run the check.

        Raises
        ------
        AssertionError
            The promise is broken; the sentence names plugin, check, promised and delivered.
        """
        cause = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # an overflow is judged by what comes of it
                delivered = self.judge(plugin)
        except Exception as error:  # whatever a plugin raises is what it delivered
            delivered, cause = f"{type(error).__name__}: {error}", error
        if delivered is not None:
            raise AssertionError(
                f"{kind_of(plugin)} '{label(plugin)}' fails the check '{self.name}': promised: {self.promise}; "
                f"delivered: {delivered}"
            ) from cause

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class CheckResult:
    """What one check found.

    Parameters
    ----------
    plugin : str
        Plugin and the parameters it was tried with.
    check : str
        Name of the check.
    status : {"passed", "failed", "exempt"}
        Exempt: it failed, and the plugin declares that it does.
    message : str
        The sentence of the failure, or the reason of the exemption.
    """

    plugin: str
    check: str
    status: Literal["passed", "failed", "exempt"]
    message: str = ""


def kind_of(plugin: Plugin | type[Plugin]) -> str:
    """Kind of a plugin, one of :data:`~.registry.KINDS`.

    Raises
    ------
    TypeError
        It is derived from none of the base classes.
    """
    cls = plugin if isinstance(plugin, type) else type(plugin)
    for kind, (_, base) in KINDS.items():
        if issubclass(cls, base):
            return kind
    bases = ", ".join(base.__name__ for _, base in KINDS.values())
    raise TypeError(f"{cls.__name__} is no plugin; derive it from one of coslidar.plugins.contract: {bases}")


def label(plugin: Plugin | type[Plugin]) -> str:
    """Name of a plugin with the parameters that were given: ``"exponential(length=500 m)"``."""
    cls = plugin if isinstance(plugin, type) else type(plugin)
    name = str(getattr(cls, "name", cls.__name__))
    if isinstance(plugin, type):
        return name
    given = plugin.model_dump(mode="json", include=plugin.model_fields_set)
    text = ", ".join(f"{key}={value}" for key, value in given.items())
    shown = text if len(text) <= 60 else text[:57] + "..."
    return f"{name}({shown})" if shown else name


# --- the checks: every plugin ----------------------------------------------------------------------------

_COMMON: list[Check] = []
_BY_KIND: dict[str, list[Check]] = {kind: [] for kind in KINDS}


def _check(
    promise: str, kind: str | None = None
) -> Callable[[Callable[[Any], str | None]], Callable[[Any], str | None]]:
    """Put a judgement into the list of its kind; its name is that of the function."""

    def register(judge: Callable[[Any], str | None]) -> Callable[[Any], str | None]:
        checks = _COMMON if kind is None else _BY_KIND[kind]
        checks.append(Check(judge.__name__.removeprefix("_"), promise, judge))
        return judge

    return register


def _parameters(plugin: Plugin) -> dict[str, Any]:
    """Parameters as a campaign file would give them: quantities as text with their unit."""
    return plugin.model_dump(mode="json")


def _quantity(schema: Mapping[str, Any], value: Any) -> tuple[str, Any, Callable[[str], Any]] | None:
    """Where a parameter holds a quantity: its unit, its text (None where unset), and how to put another there."""
    if "unit" in schema:
        return str(schema["unit"]), value, lambda text: text
    for branch in schema.get("anyOf", ()):
        if found := _quantity(branch, value):
            return found
    item = (schema.get("prefixItems") or [schema.get("items")])[0]
    if isinstance(item, Mapping):
        rest = list(value) if isinstance(value, (list, tuple)) else []
        if found := _quantity(item, rest[0] if rest else None):
            unit, text, put = found
            return unit, text, lambda new: [put(new), *rest[1:]]
    return None


def _quantities(plugin: Plugin) -> Iterator[tuple[str, str, Any, Callable[[str], Any]]]:
    """Every parameter with a unit: (name, unit, text or None, how to write another text into it)."""
    schemas = type(plugin).model_json_schema()["properties"] if type(plugin).model_fields else {}
    given = _parameters(plugin)
    for name, schema in schemas.items():
        if name in given and (found := _quantity(schema, given[name])):
            yield (name, *found)


@_check("the name of the class is that of its one entry point, lower case with underscores")
def _entry_point(plugin: Plugin) -> str | None:
    cls, group = type(plugin), KINDS[kind_of(plugin)][0]
    here = f"{cls.__module__}:{cls.__qualname__}"
    name = getattr(cls, "name", None)
    if not (isinstance(name, str) and re.fullmatch(r"[a-z][a-z0-9_]*", name)):
        return f"name = {name!r}"
    points = entry_points(group=group)
    values = sorted({point.value for point in points if point.name == name})
    if not values:
        others = [point.name for point in points if point.value == here]
        if others:
            return f"name = '{name}', and an entry point called '{others[0]}'"
        return (
            f'no entry point; write [project.entry-points."{group}"] {name} = "{here}" into the pyproject.toml of '
            "its distribution, and install that"
        )
    if len(values) > 1:
        return f"{len(values)} entry points called '{name}': {', '.join(values)}"
    found = next(point for point in points if point.name == name).load()
    return None if found is cls else f"an entry point '{name}' that loads {values[0]}, another class than {here}"


@_check("`version` is an integer of 1 or more, of the class and no parameter")
def _version(plugin: Plugin) -> str | None:
    version = type(plugin).__dict__.get("version", getattr(type(plugin), "version", None))
    if "version" in type(plugin).model_fields:
        return "a parameter 'version'; annotate it as ClassVar[int]"
    # bool is an int to Python, and no version.
    return None if type(version) is int and version >= 1 else f"version = {version!r}"


@_check("the class and every parameter are documented")
def _documented(plugin: Plugin) -> str | None:
    cls = type(plugin)
    bare = [name for name, info in cls.model_fields.items() if not (info.description or "").strip()]
    if not (cls.__doc__ or "").strip():
        return f"no docstring of the class {cls.__name__}"
    return f"no description of {', '.join(bare)}" if bare else None


@_check("it is frozen: no attribute can be set, and it has a hash")
def _frozen(plugin: Plugin) -> str | None:
    copy = plugin.model_copy()
    for name in (*type(plugin).model_fields, "another_attribute"):
        try:
            setattr(copy, name, getattr(copy, name, None))
        except (ValidationError, ValueError, AttributeError, TypeError):
            continue
        return f"'{name}' could be set"
    try:
        hash(plugin)
    except TypeError as error:
        return f"no hash ({error}); hold tuples, not lists, dictionaries or arrays"
    return None


@_check("it pickles, and what is unpickled is equal to it")
def _pickles_equal(plugin: Plugin) -> str | None:
    copy = pickle.loads(pickle.dumps(plugin))
    if copy != plugin:
        return f"{copy!r} from {plugin!r}"
    return None if copy.identity() == plugin.identity() else f"the identity {copy.identity()}, not {plugin.identity()}"


@_check("its parameters, written as text with units, build it again, and its identity can enter a key")
def _round_trip(plugin: Plugin) -> str | None:
    again = type(plugin).model_validate(_parameters(plugin))
    if lineage.canonical(again.identity()) != lineage.canonical(plugin.identity()):
        return f"{again.identity()} from {plugin.identity()}"
    return None


@_check("a quantity is given with its unit: a wrong dimension and a bare number are refused, naming parameter and unit")
def _wrong_dimension(plugin: Plugin) -> str | None:
    cls, given = type(plugin), _parameters(plugin)

    def refusal(parameter: str, value: Any) -> str | None:
        try:
            cls.model_validate({**given, parameter: value})
        except ValidationError as error:
            return " ".join(faults(error, "campaign.toml"))
        return None

    for name, unit, _, put in _quantities(plugin):
        for wrong in ("1 kg", "1"):
            said = refusal(name, put(wrong))
            if said is None:
                return f"{name} = '{wrong}' was accepted, where a quantity in {unit} belongs"
            if name not in said or unit not in said:
                return f"{name} = '{wrong}' was refused without naming {name} and {unit}: {said}"
    for name, schema in (cls.model_json_schema().get("properties") or {}).items():
        value = given.get(name)
        as_text = schema.get("type") == "string" and "unit" not in schema and _LIKE_QUANTITY.match(str(value))
        plain = name in given and (schema.get("type") in ("number", "integer") or as_text)
        if plain and refusal(name, "1 kg") is None:
            return (
                f"{name} = {value!r}, and '1 kg' was accepted; annotate a quantity with its type in "
                "coslidar.pipeline.units"
            )
    return None


@_check("the spelling of a unit does not change its identity")
def _unit_spelling(plugin: Plugin) -> str | None:
    for name, unit, text, put in _quantities(plugin):
        if not isinstance(text, str) or "inf" in text:
            continue
        number = Decimal(text.split()[0])
        other, size = _RESPELLED.get(unit, (unit, "1"))
        for spelling in (f"{number / Decimal(size):f} {other}", f"{number:e} {unit}"):
            again = type(plugin).model_validate({**_parameters(plugin), name: put(spelling)})
            if lineage.canonical(again.identity()) != lineage.canonical(plugin.identity()) or again != plugin:
                return f"{again.identity()} from {name} = '{spelling}', {plugin.identity()} from '{text}'"
    return None


def _inputs(plugin: Plugin, variant: int = 0) -> tuple[Any, ...]:
    """Fresh input of the one method of a plugin."""
    if isinstance(plugin, RegulariserBase):
        return (_GRIDS[(0, -1)[variant]],)
    if isinstance(plugin, HyperparameterSelectorBase):
        return (_problem(seed=variant, log_mu=27.0 + variant),)
    if isinstance(plugin, TurbulenceSpectrumBase):
        return (np.logspace(-3, 3, 25 + variant),)
    return _frequencies(plugin, 9 + 2 * variant)


def _outputs(plugin: Any, inputs: tuple[Any, ...]) -> list[NDArray[Any]]:
    if isinstance(plugin, RegulariserBase):
        return [np.asarray(plugin.precision(*inputs))]
    if isinstance(plugin, TurbulenceSpectrumBase):
        return [np.asarray(plugin.psd(*inputs))]
    if isinstance(plugin, SourceModelBase):
        return [np.asarray(part) for part in (plugin.transfer(*inputs), *plugin.moment(*inputs))]
    found = plugin.select(*inputs)
    return [np.asarray(part) for part in (found.mu, found.log_mu_grid, found.criterion, found.at_edge)]


@_check("the same input gives the same numbers, to the last bit and whatever was computed before")
def _deterministic(plugin: Plugin) -> str | None:
    first = _outputs(plugin, _inputs(plugin))
    _outputs(plugin, _inputs(plugin, 1))
    fresh = plugin.model_copy()
    for what, again in (("called again", plugin), ("as a copy", fresh)):
        for one, other in zip(first, _outputs(again, _inputs(plugin)), strict=True):
            if one.shape != other.shape or one.tobytes() != other.tobytes():
                apart = np.nanmax(np.abs(one - other)) if one.shape == other.shape and one.dtype != bool else "shape"
                return f"other numbers when {what} (largest difference {apart})"
    return None


def _arrays(value: Any) -> list[NDArray[Any]]:
    """Copies of all that an input holds."""
    if isinstance(value, inversion.LinearProblem):
        modes = value.modes
        held = (value.matrix, value.data, value.precision, *value.triangle, value.factor)
        return [np.array(part) for part in (*held, modes.vectors, modes.gain, modes.roughness, modes.projection)]
    return [np.array(value.edges if isinstance(value, SliceGrid) else value)]


@_check("what it is given is left as it was, and so is the plugin")
def _inputs_untouched(plugin: Plugin) -> str | None:
    inputs, identity = _inputs(plugin), plugin.identity()
    before = [part for value in inputs for part in _arrays(value)]
    _outputs(plugin, inputs)
    after = [part for value in inputs for part in _arrays(value)]
    if any(one.tobytes() != other.tobytes() for one, other in zip(before, after, strict=True)):
        return "it changed its input in place"
    return None if plugin.identity() == identity else f"it changed itself: {plugin.identity()} from {identity}"


# --- source models ---------------------------------------------------------------------------------------


def _extent(plugin: SourceModelBase) -> float:
    """Size of a source, as the reciprocal of the frequency at which its transfer function has fallen by half."""
    return 1e-3 / plugin._difference_step()


def _frequencies(plugin: Any, n: int = 9) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequencies that matter for a source model: to three times that of its half, on a square around zero."""
    axis = np.linspace(-3, 3, n) / _extent(plugin)
    fx, fy = np.meshgrid(axis, axis)
    return fx, fy


def _all_scales() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequencies from zero to beyond any use, in eight directions."""
    radius = np.concatenate([[0.0], np.logspace(-4, 9, 131)])
    angle = np.arange(8) * np.pi / 4 + 0.1
    return np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))


def _shape_of(value: Any, shape: tuple[int, ...], kinds: str) -> str | None:
    if not isinstance(value, np.ndarray):
        return f"a {type(value).__name__}, no array, for input of shape {shape}"
    if value.shape != shape:
        return f"shape {value.shape} for input of shape {shape}"
    return None if value.dtype.kind in kinds else f"an array of {value.dtype}"


_SOURCE = "source model"


@_check("transfer(fx, fy) is a real or complex array of the shape of fx", _SOURCE)
def _transfer_shape(plugin: SourceModelBase) -> str | None:
    for shape in ((7,), (3, 4), (1,)):
        f = np.linspace(0.0, 10.0, int(np.prod(shape))).reshape(shape)
        if fault := _shape_of(plugin.transfer(f, f[::-1].copy()), shape, "fc"):
            return fault
    return None


@_check("transfer is finite at every frequency, from 0 to 1e9 cycles per m", _SOURCE)
def _transfer_finite(plugin: SourceModelBase) -> str | None:
    fx, fy = _all_scales()
    bad = ~np.isfinite(plugin.transfer(fx, fy))
    return f"{bad.sum()} values that are not, the first at |f| = {np.hypot(fx, fy)[bad][0]:.3g}" if bad.any() else None


@_check("transfer is 1 at zero frequency, to 1e-9: the intensity is normalised", _SOURCE)
def _transfer_at_zero(plugin: SourceModelBase) -> str | None:
    zero = np.zeros(1)
    found = np.asarray(plugin.transfer(zero, zero)).ravel()[0]
    return None if abs(found - 1) <= 1e-9 else f"transfer(0, 0) = {found:.12g}"


@_check("the modulus of transfer exceeds 1 nowhere, up to infinity, as no intensity is negative", _SOURCE)
def _transfer_bounded(plugin: SourceModelBase) -> str | None:
    scales, near = _all_scales(), _frequencies(plugin, 25)
    fx, fy = (np.concatenate([one.ravel(), other.ravel()]) for one, other in zip(scales, near, strict=True))
    size = np.abs(plugin.transfer(fx, fy))
    worst = int(np.nanargmax(size))
    return f"{size[worst]:.6g} at f = ({fx[worst]:.3g}, {fy[worst]:.3g})" if size[worst] > 1 + 1e-9 else None


@_check("transfer(-f) is the complex conjugate of transfer(f), as the intensity is real", _SOURCE)
def _transfer_conjugate(plugin: SourceModelBase) -> str | None:
    fx, fy = _frequencies(plugin)
    gap = np.nanmax(np.abs(plugin.transfer(-fx, -fy) - np.conj(plugin.transfer(fx, fy))))
    return f"they differ by up to {gap:.3g}" if gap > 1e-9 else None


@_check("moment(fx, fy) is two arrays of the shape of fx", _SOURCE)
def _moment_shape(plugin: SourceModelBase) -> str | None:
    for shape in ((7,), (3, 4), (1,)):
        f = np.linspace(0.0, 10.0, int(np.prod(shape))).reshape(shape)
        parts = plugin.moment(f, f[::-1].copy())
        if not isinstance(parts, tuple) or len(parts) != 2:
            return f"a {type(parts).__name__}" + (f" of {len(parts)}" if isinstance(parts, tuple) else "")
        for part in parts:
            if fault := _shape_of(part, shape, "fc"):
                return fault
    return None


@_check("moment is i / (2 pi) times the derivative of transfer along x and y, to 1e-6 of the source's size", _SOURCE)
def _moment_derivative(plugin: SourceModelBase) -> str | None:
    fx, fy = _frequencies(plugin)
    for axis, found, wanted in zip("xy", plugin.moment(fx, fy), SourceModelBase.moment(plugin, fx, fy), strict=True):
        gap = np.abs(found - wanted)
        worst = np.unravel_index(np.argmax(gap), gap.shape)
        if not gap[worst] <= 1e-6 * _extent(plugin):
            return (
                f"along {axis} {np.asarray(found)[worst]:.4g} at f = ({fx[worst]:.3g}, {fy[worst]:.3g}), where the "
                f"derivative gives {wanted[worst]:.4g}"
            )
    return None


@_check("moment is 0 at zero frequency: the centroid is at the position that the header gives", _SOURCE)
def _moment_centred(plugin: SourceModelBase) -> str | None:
    zero = np.zeros(1)
    x, y = (np.asarray(part).ravel()[0] for part in plugin.moment(zero, zero))
    if np.hypot(abs(x), abs(y)) <= 1e-6 * _extent(plugin):
        return None
    return f"a centroid at ({x.real:.4g}, {y.real:.4g})"


# --- turbulence spectra ----------------------------------------------------------------------------------

_SPECTRUM = "turbulence spectrum"
_F = np.logspace(-4, 5, 181)


@_check("psd(f) is a real array of the shape of f", _SPECTRUM)
def _psd_shape(plugin: TurbulenceSpectrumBase) -> str | None:
    for shape in ((7,), (3, 4), (1,)):
        f = np.logspace(-1, 2, int(np.prod(shape))).reshape(shape)
        if fault := _shape_of(plugin.psd(f), shape, "f"):
            return fault
    return None


@_check("psd is finite from 1e-4 to 1e5 cycles per m", _SPECTRUM)
def _psd_finite(plugin: TurbulenceSpectrumBase) -> str | None:
    bad = ~np.isfinite(plugin.psd(_F.copy()))
    return f"{bad.sum()} values that are not, the first at f = {_F[bad][0]:.3g} /m" if bad.any() else None


@_check("psd is negative nowhere, and positive in the inertial range, 0.3 to 3 cycles per m", _SPECTRUM)
def _psd_positive(plugin: TurbulenceSpectrumBase) -> str | None:
    psd = plugin.psd(_F.copy())
    bad = (psd < 0) | ((psd <= 0) & (_F > 0.3) & (_F < 3))
    return f"{psd[bad][0]:.3g} at f = {_F[bad][0]:.3g} /m" if bad.any() else None


@_check("psd decays toward infinity: it rises nowhere above 10 cycles per m, and falls faster than f^-3", _SPECTRUM)
def _psd_decays(plugin: TurbulenceSpectrumBase) -> str | None:
    f = np.logspace(1, 5, 161)
    psd = np.abs(plugin.psd(f.copy()))
    rising = np.flatnonzero(np.diff(psd) > 1e-9 * psd[:-1])
    if rising.size:
        return f"it rises at f = {f[rising[0]]:.3g} /m"
    if psd[-1] * f[-1] ** 3 > psd[0] * f[0] ** 3:
        return f"a ratio of {psd[-1] / psd[0]:.3g} over the four decades from {f[0]:g} to {f[-1]:g} /m"
    return None


@_check("psd grows slower than f^-4 toward zero, so that slopes have a finite variance", _SPECTRUM)
def _psd_integrable(plugin: TurbulenceSpectrumBase) -> str | None:
    low, high = np.abs(plugin.psd(np.array([1e-4, 1e-2])))
    return f"a factor of {low / high:.3g} from 1e-2 to 1e-4 /m" if low * 1e-4**4 > high * 1e-2**4 else None


@_check(
    "psd is S_n of Cn2 dz = 1 for f in cycles per m: somewhere from 0.05 to 50 /m within a factor of 100 of "
    "0.033 (2 pi)^(-2/3) f^(-11/3)",
    _SPECTRUM,
)
def _psd_normalised(plugin: TurbulenceSpectrumBase) -> str | None:
    f = np.logspace(np.log10(0.05), np.log10(50), 61)
    with np.errstate(divide="ignore"):
        decades = np.log10(np.abs(plugin.psd(f.copy())) / (0.033 * (2 * np.pi) ** (-2 / 3) * f ** (-11 / 3)))
    nearest = decades[np.nanargmin(np.abs(decades))]
    return f"never nearer than a factor of 1e{nearest:+.1f}" if abs(nearest) > 2 else None


# --- regularisers ----------------------------------------------------------------------------------------

_REGULARISER = "regulariser"


def _precisions(plugin: RegulariserBase) -> list[tuple[SliceGrid, Any]]:
    """R on every grid that the plugin accepts; it may refuse one by name, but not all."""
    found, refusals = [], []
    for grid in _GRIDS:
        try:
            found.append((grid, plugin.precision(grid)))
        except ValueError as error:
            if plugin.name not in str(error):
                raise type(error)(f"{error} (on {_words(grid)})") from error
            refusals.append(error)
    if not found:
        raise refusals[0]
    return found


def _words(grid: SliceGrid) -> str:
    equal = "equal" if np.allclose(grid.thickness, grid.thickness[0]) else "unequal"
    return f"{grid.k} {equal} slices to {grid.edges[-1]:g} m"


def _square(plugin: RegulariserBase) -> Iterator[tuple[SliceGrid, NDArray[np.float64]]]:
    """Finite precisions of the right shape: the others are for other checks to name."""
    for grid, precision in _precisions(plugin):
        values = np.asarray(precision)
        if values.shape == (grid.k, grid.k) and values.dtype.kind == "f" and np.isfinite(values).all():
            yield grid, values


@_check("precision(grid) is a real array (k, k) for k slices, on every grid", _REGULARISER)
def _precision_shape(plugin: RegulariserBase) -> str | None:
    for grid, precision in _precisions(plugin):
        if not isinstance(precision, np.ndarray):
            return f"a {type(precision).__name__}, no array"
        if precision.shape != (grid.k, grid.k):
            return f"shape {precision.shape} on {_words(grid)}"
        if precision.dtype.kind != "f":
            return f"an array of {precision.dtype}"
    return None


@_check("precision is finite on every grid", _REGULARISER)
def _precision_finite(plugin: RegulariserBase) -> str | None:
    for grid, precision in _precisions(plugin):
        bad = np.argwhere(~np.isfinite(np.atleast_2d(np.asarray(precision, dtype=float))))
        if len(bad):
            return f"R{[int(i) for i in bad[0]]} = {precision[tuple(bad[0])]} on {_words(grid)}"
    return None


@_check("precision is symmetric to 1e-12 of its largest entry, on every grid", _REGULARISER)
def _precision_symmetric(plugin: RegulariserBase) -> str | None:
    for grid, precision in _square(plugin):
        gap = np.abs(precision - precision.T)
        i, j = np.unravel_index(np.argmax(gap), gap.shape)
        if gap[i, j] > 1e-12 * np.abs(precision).max():
            return f"R[{i}, {j}] = {precision[i, j]:.6g} and R[{j}, {i}] = {precision[j, i]:.6g} on {_words(grid)}"
    return None


@_check("precision is positive semi-definite to 1e-10 of its largest eigenvalue, on every grid", _REGULARISER)
def _precision_psd(plugin: RegulariserBase) -> str | None:
    for grid, precision in _square(plugin):
        values = np.linalg.eigvalsh((precision + precision.T) / 2)
        if values[0] < -1e-10 * max(values[-1], 0.0):
            return f"an eigenvalue of {values[0]:.3g} beside a largest of {values[-1]:.3g} on {_words(grid)}"
    return None


@_check("precision penalises something: it is not zero on a grid of twelve slices or more", _REGULARISER)
def _precision_not_zero(plugin: RegulariserBase) -> str | None:
    empty = [grid for grid, precision in _square(plugin) if grid.k >= 12 and not precision.any()]
    return f"R = 0 on {_words(empty[0])}" if empty else None


# --- hyperparameter selectors ----------------------------------------------------------------------------

_SELECTOR = "hyperparameter selector"


def _problem(seed: int, log_mu: float, k: int = 12, n: int = 60) -> inversion.LinearProblem:
    """A positive profile drawn from the white prior at `log_mu`, seen by data of which every mode carries signal.

    Entries are normal with variance 1 / mu, their sign removed, so that x^T x has the mean that the prior gives it;
    one prior standard deviation moves the data by 1 to 1000 standard deviations of their noise.
    """
    rng = np.random.default_rng(seed)
    sigma = 10.0 ** (-log_mu / 2)
    left, _ = np.linalg.qr(rng.standard_normal((n, k)))
    right, _ = np.linalg.qr(rng.standard_normal((k, k)))
    matrix = left @ np.diag(np.logspace(3, 0, k)) @ right / sigma
    profile = sigma * np.abs(rng.standard_normal(k))
    return inversion.LinearProblem(matrix, matrix @ profile + rng.standard_normal(n), np.eye(k), n, grid=_UNIFORM)


def _ends(selection: inversion.Selection) -> tuple[int, int]:
    """First and last place where the curve is finite."""
    finite = np.flatnonzero(np.isfinite(selection.criterion))
    return int(finite[0]), int(finite[-1])


def _wide(plugin: HyperparameterSelectorBase) -> list[inversion.Selection]:
    """Choices on three problems: one with mu inside the grid, and one with mu far below it and far above it."""
    grid = plugin.select(_problem(0, 27.0)).log_mu_grid
    inside = float(grid[0] + 0.4 * (grid[-1] - grid[0]))
    return [plugin.select(_problem(1, log_mu)) for log_mu in (inside, grid[0] - 6, grid[-1] + 6)]


def _curve_fault(selection: inversion.Selection) -> str | None:
    grid, curve = np.asarray(selection.log_mu_grid), np.asarray(selection.criterion)
    if grid.ndim != 1 or not grid.size or not np.isfinite(grid).all() or (np.diff(grid) <= 0).any():
        return f"a grid of log mu of shape {grid.shape} that does not ascend"
    if curve.shape != grid.shape:
        return f"a curve of shape {curve.shape} on a grid of shape {grid.shape}"
    return None if np.isfinite(curve).any() else "a curve that is finite nowhere"


def _sound(plugin: HyperparameterSelectorBase) -> list[inversion.Selection]:
    """Choices that can be judged further: with a curve, and with mu; the others are for other checks to name."""
    return [one for one in _wide(plugin) if _curve_fault(one) is None and np.isfinite(one.mu) and one.mu > 0]


@_check("select(problem) is a Selection with a finite mu of 0 or more, in m^(4/3) and no logarithm", _SELECTOR)
def _selection(plugin: HyperparameterSelectorBase) -> str | None:
    found = plugin.select(_problem(0, 27.0))
    if not isinstance(found, inversion.Selection):
        return f"a {type(found).__name__}"
    if not (np.ndim(found.mu) == 0 and np.isfinite(found.mu) and found.mu >= 0):
        return f"mu = {found.mu}"
    if 0 < found.mu < 1e4 and found.log_mu_grid[0] <= found.mu <= found.log_mu_grid[-1]:
        return f"mu = {found.mu:g}, which looks like its logarithm"
    return None if isinstance(found.at_edge, (bool, np.bool_)) else f"at_edge = {found.at_edge!r}"


@_check("the curve has a value for each point of an ascending grid of log10 mu", _SELECTOR)
def _curve_on_grid(plugin: HyperparameterSelectorBase) -> str | None:
    return next(filter(None, map(_curve_fault, _wide(plugin))), None)


@_check("mu lies within the grid of its curve", _SELECTOR)
def _mu_in_grid(plugin: HyperparameterSelectorBase) -> str | None:
    for found in _sound(plugin):
        low, high = found.log_mu_grid[0], found.log_mu_grid[-1]
        if not low - 1e-9 <= found.log_mu <= high + 1e-9:
            return f"log mu = {found.log_mu:.4g} on a grid from {low:g} to {high:g}"
    return None


@_check("mu is where the curve is smallest, to a step of its grid", _SELECTOR)
def _mu_at_minimum(plugin: HyperparameterSelectorBase) -> str | None:
    for found in _sound(plugin):
        best = found.log_mu_grid[np.nanargmin(np.where(np.isfinite(found.criterion), found.criterion, np.nan))]
        step = np.diff(found.log_mu_grid).max(initial=0.0)
        inside = found.log_mu_grid[0] <= found.log_mu + 1e-9 and found.log_mu <= found.log_mu_grid[-1] + 1e-9
        if inside and abs(found.log_mu - best) > step + 1e-9:
            return f"log mu = {found.log_mu:.4g} from a curve that is smallest at {best:.4g}"
    return None


@_check("at_edge is True where mu is at an end of the finite curve, and False elsewhere", _SELECTOR)
def _at_edge(plugin: HyperparameterSelectorBase) -> str | None:
    for found in _sound(plugin):
        first, last = (found.log_mu_grid[end] for end in _ends(found))
        half = np.diff(found.log_mu_grid).min(initial=np.inf) / 2 if len(found.log_mu_grid) > 1 else 0.0
        expected = bool(found.log_mu <= first + 0.98 * half or found.log_mu >= last - 0.98 * half)
        if bool(found.at_edge) != expected:
            return f"at_edge = {found.at_edge} with log mu = {found.log_mu:.4g}, the curve from {first:g} to {last:g}"
    return None


@_check(
    f"of {_DRAWS} profiles drawn from the prior, the median log10 mu is that of the prior to {_DECADES:g} decade",
    _SELECTOR,
)
def _recovers_mu(plugin: HyperparameterSelectorBase) -> str | None:
    grid = plugin.select(_problem(0, 27.0)).log_mu_grid
    for part in (0.31, 0.59):  # between the points of the usual grids
        truth = float(grid[0] + part * (grid[-1] - grid[0]))
        found = np.median([plugin.select(_problem(seed, truth)).log_mu for seed in range(_DRAWS)])
        if not abs(found - truth) <= _DECADES:
            return f"log10 mu = {found:.2f} where the prior has {truth:.2f}"
    return None


# --- running them ----------------------------------------------------------------------------------------

#: Kind of plugin -> its checks, those of every plugin first.
CHECKS: dict[str, tuple[Check, ...]] = {kind: (*_COMMON, *checks) for kind, checks in _BY_KIND.items()}


def _can_be_built(cls: type[Plugin]) -> str | None:
    required = [name for name, info in cls.model_fields.items() if info.is_required()]
    if required and not cls.examples:
        pattern = ", ".join(f'"{name}": "..."' for name in required)
        return (
            f"no example, though {', '.join(required)} {'has' if len(required) == 1 else 'have'} no default; write "
            f"examples: ClassVar = ({{{pattern}}},)"
        )
    for example in cls.examples:
        try:
            cls.model_validate(dict(example))
        except ValidationError as error:
            return f"{dict(example)} is refused: {' '.join(faults(error, 'examples', KEYS_OF[kind_of(cls)]))}"
    if not required:
        cls.model_validate({})
    return None


#: Kind of plugin -> key in a campaign file.
KEYS_OF = {kind: key for key, kind in KEYS.items()}
#: The one check of a class: the others need an instance.
EXAMPLES = Check("examples", "its defaults, or the parameters of each of its `examples`, build it", _can_be_built)


def instances(cls: type[Plugin]) -> list[Plugin]:
    """Plugins to check for a class: with its defaults, where it has them for all, and one for each example."""
    bare: list[dict[str, Any]] = [] if any(info.is_required() for info in cls.model_fields.values()) else [{}]
    return [cls.model_validate(parameters) for parameters in (*bare, *map(dict, cls.examples))]


def checks_of(plugin: Plugin | type[Plugin]) -> Iterator[tuple[Plugin | type[Plugin], Check]]:
    """Every check of a plugin with what to call it with.

    Parameters
    ----------
    plugin : Plugin or type
        A class is tried with its defaults and its `examples`.

    Yields
    ------
    subject : Plugin or type
        What to give to the check.
    check : Check
        The check.
    """
    if not isinstance(plugin, type):
        for check in CHECKS[kind_of(plugin)]:
            yield plugin, check
        return
    kind_of(plugin)
    yield plugin, EXAMPLES
    try:
        built = instances(plugin)
    except Exception:  # the check says what is wrong with it
        return
    for instance in built:
        yield from checks_of(instance)


def _exemptions(plugin: Plugin | type[Plugin], given: Expected | Callable[[Any], Expected] | None) -> dict[str, str]:
    declared = dict(plugin.expected_failed_checks)
    declared.update(given(plugin) if callable(given) else given or {})
    known = {check.name for checks in CHECKS.values() for check in checks} | {EXAMPLES.name}
    if strangers := sorted(set(declared) - known):
        raise ValueError(
            f"{label(plugin)}: expected_failed_checks names '{strangers[0]}', which is no check; there are: "
            f"{', '.join(sorted(known))}"
        )
    return declared


def check_plugin(
    plugin: Plugin | type[Plugin], *, expected_failed_checks: Expected | Callable[[Any], Expected] | None = None
) -> list[CheckResult]:
    """Run every check on a plugin.

    Parameters
    ----------
    plugin : Plugin or type
        A class is tried with its defaults and its `examples`.
    expected_failed_checks : mapping of str to str, or callable, optional
        Checks that it fails on purpose, with the reason; in addition to those the class declares.

    Returns
    -------
    list of CheckResult
        In the order of the checks.

    Raises
    ------
    TypeError
        It is no plugin.
    ValueError
        An exemption names no check.
    """
    results = []
    for subject, check in checks_of(plugin):
        exempt = _exemptions(subject, expected_failed_checks)
        try:
            check(subject)
        except AssertionError as error:
            if check.name in exempt:
                results.append(CheckResult(label(subject), check.name, "exempt", exempt[check.name]))
            else:
                results.append(CheckResult(label(subject), check.name, "failed", str(error)))
        else:
            results.append(CheckResult(label(subject), check.name, "passed"))
    return results


def parametrize_with_checks(
    plugins: Sequence[Plugin | type[Plugin]] | Iterable[Plugin | type[Plugin]],
    *,
    expected_failed_checks: Expected | Callable[[Any], Expected] | None = None,
) -> pytest.MarkDecorator:
    """Decorator that runs a test for every check of every plugin, as scikit-learn's of that name does.

    The test takes `plugin` and `check`, and calls ``check(plugin)``. Its ids read
    ``exponential(length=500 m)-precision_psd``.

    Parameters
    ----------
    plugins : iterable of Plugin or type
        Instances; of classes, their defaults and `examples`.
    expected_failed_checks : mapping of str to str, or callable, optional
        Checks that fail on purpose, with the reason: their tests are marked xfail. A callable is given the plugin.

    Returns
    -------
    pytest.MarkDecorator

    Raises
    ------
    TypeError
        Something in the list is no plugin.
    ValueError
        An exemption names no check.
    """
    import pytest

    cases = []
    for plugin in plugins:
        for subject, check in checks_of(plugin):
            exempt = _exemptions(subject, expected_failed_checks)
            marks = [pytest.mark.xfail(reason=exempt[check.name])] if check.name in exempt else []
            cases.append(pytest.param(subject, check, id=f"{label(subject)}-{check.name}", marks=marks))
    return pytest.mark.parametrize(("plugin", "check"), cases)
