"""Quantities at the border: text with a unit outside, float64 in SI units inside.

The only module that knows pint. Everything with a dimension enters as text ("3.8 um") and leaves as text;
in between it is a plain float in the SI unit that its parameter declares.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import ValidationError
from pydantic_core import PydanticCustomError, core_schema

if TYPE_CHECKING:
    from collections.abc import Iterable

    import pint
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler

#: What a unit measures in words, and what to write, for the messages.
_KNOWN: dict[str, tuple[str, tuple[str, ...]]] = {
    "m": ("length", ("2670 m", "2.67 km")),
    "rad": ("angle", ("27 urad", "1 arcsec")),
    "s": ("duration", ("180 s", "3 min")),
    "Hz": ("frequency", ("142 Hz", "1 kHz")),
    "m/s": ("speed", ("3 m/s", "10 km/hour")),
    "pixel": ("number of pixels", ("9 pixel", "10.5 pixel")),
    "count": ("detector level", ("16383 count",)),
    "electron": ("number of electrons", ("60 electron",)),
    "electron/count": ("detector gain", ("12 electron/count",)),
    "count/s": ("count rate", ("100 count/s",)),
    "m^(4/3)": ("hyperparameter", ("1e27 m^(4/3)",)),
    "m^(-2/3)": ("turbulence strength", ("1e-14 m^(-2/3)",)),
    "m^(1/3)": ("integrated turbulence strength", ("1e-12 m^(1/3)",)),
    "rad^2": ("angular variance", ("1e-12 rad^2",)),
    "deg": ("angle", ("43.1285 deg",)),
}


#: pint holds angles and counts dimensionless, so that "5 count" would pass as an angle, and reads "px" as a
#: length. Each of these lines of its definitions is replaced: every quantity here is a dimension of its own.
_OWN_DEFINITIONS = {
    "radian = [] = rad": "radian = [plane_angle] = rad",
    "count = []": "count = [detector_level] = _ = ADU = adu",
    "pixel = [printing_unit] = _ = dot = pel = picture_element": "pixel = [detector_position] = px",
    "css_pixel = inch / 96 = px": "css_pixel = inch / 96",
}


@lru_cache(maxsize=1)
def _registry() -> pint.UnitRegistry[Any]:
    from importlib.resources import files

    import pint

    definitions = files("pint")
    lines: list[str] = []
    for line in (definitions / "default_en.txt").read_text("utf-8").splitlines():
        if line.startswith("@import"):
            lines += (definitions / line.split()[1]).read_text("utf-8").splitlines()
        else:
            lines.append(_OWN_DEFINITIONS.get(line.strip(), line))
    registry: pint.UnitRegistry[Any] = pint.UnitRegistry(None)
    registry.load_definitions([*lines, "electron = [electron_number]"])
    return registry


def _dimensionality(units: Any) -> dict[str, Fraction]:
    # m^(1/3)/m has the exponent -0.6666666666666667 and m^(-2/3) has -0.6666666666666666: compare fractions.
    return {
        name: Fraction(float(power)).limit_denominator(60)
        for name, power in dict(units.dimensionality).items()
        if Fraction(float(power)).limit_denominator(60)
    }


@lru_cache(maxsize=256)
def _describe(dimensionality: frozenset[tuple[str, Fraction]]) -> str:
    for unit, (word, _) in _KNOWN.items():
        if frozenset(_dimensionality(_registry().Unit(unit)).items()) == dimensionality:
            return word
    return "dimensionless number" if not dimensionality else "quantity of another kind"


def rounded(value: float) -> float:
    """Round to 15 significant digits, so that "3.8 um" and "3.8e-6 m" are the same number.

    Parameters
    ----------
    value : float
        Any float.

    Returns
    -------
    float
        The nearest float with 15 significant decimal digits; infinities unchanged.
    """
    return float(f"{value:.15g}")


def text(value: float, unit: str) -> str:
    """Write a value in SI units as text that :func:`parse` reads back to the same float.

    Parameters
    ----------
    value : float
        Value in `unit`.
    unit : str
        SI unit, in the spelling of the project (``"m^(-2/3)"``).

    Returns
    -------
    str
        For example ``"0.089 m"``.
    """
    return f"{rounded(value):.15g} {unit}"


class QuantityError(ValueError):
    """A quantity that cannot be read; the message says what was found and what was expected."""

    @property
    def reason(self) -> str:
        """The message."""
        return str(self)


_NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"
_COMMA = re.compile(r"^\s*([+-]?\d+),(\d+)(.*)$", re.DOTALL)
_QUANTITY = re.compile(rf"^\s*({_NUMBER}|[+-]?(?:inf|infinity|nan))\s*(.*?)\s*$", re.IGNORECASE | re.DOTALL)


def _article(word: str) -> str:
    return ("an " if word[0] in "aeiou" else "a ") + word


def parse(value: object, unit: str, *, key: str = "value", allow_infinite: bool = False) -> float:
    """Read a quantity given as text.

    Parameters
    ----------
    value : object
        Text such as ``"2.67 km"``; anything else is an error that says so.
    unit : str
        The SI unit to convert to; its dimension is the one that is accepted.
    key : str
        Name of the parameter, for the message.
    allow_infinite : bool
        Whether ``"inf m"`` is legal (a path length only).

    Returns
    -------
    float
        Value in `unit`, rounded to 15 significant digits.

    Raises
    ------
    QuantityError
        The unit is missing, unknown or of another dimension, the number is not finite, or it is written
        with a decimal comma.
    """
    word, examples = _KNOWN.get(unit, ("quantity", (f"1 {unit}",)))
    sample = ", ".join(f"'{example}'" for example in examples)
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise QuantityError(f"a {type(value).__name__} is no quantity; {key} is {_article(word)}; write {sample}")
    if not isinstance(value, str):
        example = examples[0] if unit not in ("m", "s", "Hz") else f"{value:g} {unit}"
        raise QuantityError(f"the unit is missing. {key} is {_article(word)}; write '{example}'")
    if comma := _COMMA.match(value):
        raise QuantityError(
            f"use a point as decimal sign, not a comma; write '{comma[1]}.{comma[2]}{comma[3].rstrip()}'"
        )
    if len(value) > 200 or not (match := _QUANTITY.match(value)):
        raise QuantityError(f"this is no number with a unit; {key} is {_article(word)}; write for example {sample}")
    number, unit_text = float(match[1]), match[2]
    if math.isnan(number) or (math.isinf(number) and not allow_infinite):
        raise QuantityError(f"{key} must be a finite {word}, for example {sample}")
    if not unit_text:
        raise QuantityError(f"the unit is missing. {key} is {_article(word)}; write '{match[1]} {unit}'")
    import pint

    registry = _registry()
    try:
        # "^" and "(-2/3)" are pint's own grammar; a second number would be a product, never meant.
        if re.match(rf"^\s*[*/]?\s*{_NUMBER}(?![\w)/])", unit_text):
            raise QuantityError(f"this is no single number with a unit; {key} is {_article(word)}; write {sample}")
        found = registry.Unit(unit_text)
        wanted = registry.Unit(unit)
    except QuantityError:
        raise
    except (
        pint.errors.PintError,
        ValueError,
        TypeError,
        AttributeError,
        KeyError,
        ZeroDivisionError,
        SyntaxError,
        AssertionError,
        OverflowError,
        RecursionError,
    ) as error:
        raise QuantityError(
            f"'{unit_text}' is no unit that is known; {key} must be {_article(word)} (SI unit {unit}), "
            f"for example {sample}"
        ) from error
    if _dimensionality(found) != _dimensionality(wanted):
        what = _describe(frozenset(_dimensionality(found).items()))
        raise QuantityError(
            f"'{unit_text}' is {_article(what)}, but {key} must be {_article(word)} (SI unit {unit}), "
            f"for example {sample}"
        )
    # The root factor of the unit alone: multiplying quantities would drag fractional exponents through pint.
    ours, theirs = (float(str(registry.get_root_units(each)[0])) for each in (found, wanted))
    factor = ours / theirs
    if any(power.denominator != 1 for power in _dimensionality(wanted).values()):
        factor = float(f"{factor:.14g}")  # 1000^(4/3) comes as 9999.999999999995
    return rounded(number * factor)


#: Spellings of units that instruments write and pint does not know.
_SPELLINGS = {"deg C": "degC", "degrees C": "degC", "celsius": "degC", "C": "degC", "%": "percent", "": "1"}
#: Fractional exponents without parentheses: pint reads m^-2/3 as m^(-2) / 3, UDUNITS m-2/3 likewise.
_BARE_FRACTION = re.compile(r"(?<=[A-Za-z])\s*(?:\^|\*\*)?\s*(-\s*\d+\s*/\s*\d+)(?!\s*[\d)])")
#: Exponents as UDUNITS has them: W m-2.
_BARE_EXPONENT = re.compile(r"(?<=[A-Za-z])(-?\d+)(?![\d/)])")


def conversion(unit_text: str, unit: str) -> tuple[float, float, str]:
    """How values in a unit that an instrument wrote become values in an SI unit.

    Parameters
    ----------
    unit_text : str
        Unit as written: ``"hPa"``, ``"deg C"``, ``"%"``, ``"m^(-2/3)"``, also ``"m^-2/3"``.
    unit : str
        SI unit; ``"1"`` without dimension.

    Returns
    -------
    factor, offset : float
        ``value * factor + offset`` is in `unit`.
    remark : str
        What was wrong with the spelling; empty where nothing was.

    Raises
    ------
    QuantityError
        The unit is unknown, or of another dimension.
    """
    import pint

    registry = _registry()
    plain = _SPELLINGS.get(unit_text.strip(), unit_text.strip())
    written = _BARE_FRACTION.sub(lambda match: f"^({match[1].replace(' ', '')})", plain)
    remark = "" if written == plain else f"'{safe(unit_text)}' says another thing than is meant; read as '{written}'"
    try:
        found, wanted = registry.Unit(_BARE_EXPONENT.sub(r"^(\1)", written)), registry.Unit(unit)
        fault = _dimensionality(found) != _dimensionality(wanted)
        zero, one = (0.0, 1.0) if fault else (registry.Quantity(x, found).to_root_units().magnitude for x in (0.0, 1.0))
    except (
        pint.errors.PintError,
        ValueError,
        TypeError,
        AttributeError,
        KeyError,
        SyntaxError,
        AssertionError,
    ) as error:
        raise QuantityError(f"'{safe(unit_text)}' is no unit that is known; write for example '{unit}'") from error
    if fault:
        what = _describe(frozenset(_dimensionality(found).items()))
        raise QuantityError(f"'{safe(unit_text)}' is {_article(what)}; a unit like '{unit}' is needed")
    scale = float(str(registry.get_root_units(wanted)[0]))
    return rounded((one - zero) / scale), rounded(zero / scale), remark


#: Stands for the key in a reason that is kept until the whole location of the value is known.
_KEY = "\N{SYMBOL FOR NULL}"


def quantity_fault(error: QuantityError, field: str | None, why: str = "") -> PydanticCustomError:
    """Wrap a reason written with :data:`_KEY` for pydantic; :func:`faults` puts the full key in its place."""
    shown = error.reason.replace(_KEY, field or "value") + why
    return PydanticCustomError("quantity", "{shown}", {"shown": shown, "reason": error.reason + why})


@dataclass(frozen=True)
class Quantity:
    """Annotation of a model field that is given as text with a unit and held as a float in SI units.

    Parameters
    ----------
    unit : str
        SI unit of the float.
    infinite : bool
        Whether ``"inf <unit>"`` is legal.
    alternative : str or None
        A second unit that is accepted (an angle, for sources at infinity).
    """

    unit: str
    infinite: bool = False
    alternative: str | None = None

    def read(self, value: object) -> float:
        """Read one value; raises :class:`QuantityError`."""
        try:
            return parse(value, self.unit, key=_KEY, allow_infinite=self.infinite)
        except QuantityError:
            if self.alternative is None:
                raise
            try:
                return parse(value, self.alternative, key=_KEY)
            except QuantityError:
                pass
            raise

    def note(self) -> str:
        """What to add to a fault."""
        return ""

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        def read(
            value: object, bounds: core_schema.ValidatorFunctionWrapHandler, info: core_schema.ValidationInfo
        ) -> float:
            try:
                number = self.read(value)
            except QuantityError as error:
                raise quantity_fault(error, info.field_name, self.note()) from error
            try:
                return float(bounds(number))
            except ValidationError as error:
                # Raised anew, so that the fault shows the text that was given and not the number made of it.
                words = error.errors()[0]["msg"].replace("Input should", "it should")
                raise quantity_fault(QuantityError(f"{words} {self.unit}"), info.field_name) from error

        def write(value: float) -> str:
            return text(value, self.unit)

        return core_schema.with_info_wrap_validator_function(
            read,
            handler(source),  # carries the bounds of the field
            serialization=core_schema.plain_serializer_function_ser_schema(write, when_used="json"),
        )

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "string", "unit": self.unit, "examples": list(_KNOWN.get(self.unit, ("", ()))[1])}


Length = Annotated[float, Quantity("m")]
PathLength = Annotated[float, Quantity("m", infinite=True)]
Extent = Annotated[float, Quantity("m", alternative="rad")]
Angle = Annotated[float, Quantity("rad")]
Wavelength = Annotated[float, Quantity("m")]
Duration = Annotated[float, Quantity("s")]
Frequency = Annotated[float, Quantity("Hz")]
Speed = Annotated[float, Quantity("m/s")]
Pixels = Annotated[float, Quantity("pixel")]
Level = Annotated[float, Quantity("count")]
Electrons = Annotated[float, Quantity("electron")]
Gain = Annotated[float, Quantity("electron/count")]
Hyperparameter = Annotated[float, Quantity("m^(4/3)")]
TurbulenceStrength = Annotated[float, Quantity("m^(-2/3)")]
AngularVariance = Annotated[float, Quantity("rad^2")]


def _location(parts: Iterable[int | str]) -> str:
    written = ""
    for part in parts:
        written += f"[{part}]" if isinstance(part, int) else f".{part}" if written else str(part)
    return written


def _found(value: object) -> str:
    shown = repr(value)
    return shown if len(shown) <= 120 else shown[:117] + "..."


def safe(value: str) -> str:
    """Make text from a file harmless on a terminal: control characters are escaped, long text is cut.

    Parameters
    ----------
    value : str
        Any text.

    Returns
    -------
    str
        Printable text of at most 500 characters.
    """
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in value[:500])
    return shown + ("…" if len(value) > 500 else "")


def faults(error: ValidationError, origin: str, prefix: str = "") -> list[str]:
    """Turn pydantic's faults into the project's sentences, one per fault.

    Parameters
    ----------
    error : pydantic.ValidationError
        What a model refused.
    origin : str
        File that the values come from.
    prefix : str
        Key of the model inside the file.

    Returns
    -------
    list of str
        ``"<origin>: <key> = <found>: <what is wrong and what to write>"``.
    """
    sentences = []
    for fault in error.errors(include_url=False):
        location = _location((*([prefix] if prefix else []), *fault["loc"]))
        kind, context = fault["type"], fault.get("ctx", {})
        message = fault["msg"]
        if kind == "missing":
            sentences.append(f"{origin}: {location} is missing; it is required")
            continue
        if kind == "extra_forbidden":
            sentences.append(
                f"{origin}: {location} = {_found(fault['input'])}: there is no such key; check its spelling"
            )
            continue
        if kind == "quantity":
            message = str(context["reason"]).replace(_KEY, location)
        elif kind == "value_error":
            message = str(context.get("error", message))
        elif kind in ("tuple_type", "list_type"):
            message = "it should be a list; write its values in brackets, [..., ...]"
        else:
            message = message.replace("Input should", "it should")
        if not location:
            sentences.append(f"{origin}: {message}")
        elif fault["input"] is None:  # nothing was written there
            sentences.append(f"{origin}: {location}: {message}")
        else:
            sentences.append(f"{origin}: {location} = {_found(fault['input'])}: {message}")
    return [safe(sentence) for sentence in sentences]
