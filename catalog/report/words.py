"""Numbers, times and foreign text as words that are safe to show."""

from __future__ import annotations

import datetime
import json
import math
import re
import zoneinfo
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from markupsafe import Markup

#: Shown where there is no value.
NOTHING = "–"

_MONTHS = ("January", "February", "March", "April", "May", "June", "July", "August", "September", "October",
           "November", "December")  # fmt: skip
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# Control characters, lone surrogates and the marks that reorder the text around them: each would let a campaign's
# name look like something else, or break the page's encoding.
_UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


def clean(value: object) -> str:
    """Text of `value` with control characters, direction marks and lone surrogates made visible as ``\ufffd``."""
    return _UNSAFE.sub("\ufffd", str(value))


def raised_units(text: str) -> Markup:
    """Markup with exponents written as ``m^(-2/3)`` set higher, everything else escaped."""
    from markupsafe import Markup, escape

    raised = re.sub(r"\^\(([-0-9/]+)\)", r"<sup>\1</sup>", str(escape(clean(text))))
    return Markup(raised.replace("<sup>-", "<sup>−"))


def scientific(value: float, digits: int = 3) -> str:
    """`value` with `digits` significant digits as ``2.04×10⁻¹³``."""
    if not math.isfinite(value):
        return number(value)
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    if int(exponent) == 0 or value == 0:
        return mantissa.replace("-", "−")
    return f"{mantissa.replace('-', '−')}×10{str(int(exponent)).translate(_SUPERSCRIPT)}"


def number(value: float, digits: int = 3) -> str:
    """`value` with `digits` significant digits, with a power of ten only where zeros would have to be counted."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".split("e")[1])
    if -4 < exponent < 6:
        return f"{value:.{max(0, digits - 1 - exponent)}f}".replace("-", "−")
    return scientific(value, digits)


def measured(value: float, error: float) -> str:
    """`value` and its error with a common power of ten, the error to two significant digits."""
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return number(value)
    exponent = math.floor(math.log10(max(abs(value), error)))
    if -3 <= exponent < 4:
        exponent = 0
    decimals = max(0, 1 - math.floor(math.log10(error / 10.0**exponent)))
    pair = f"{value / 10.0**exponent:.{decimals}f} ± {error / 10.0**exponent:.{decimals}f}".replace("-", "−")
    return f"({pair})×10{str(exponent).translate(_SUPERSCRIPT)}" if exponent else pair


def moment(time: int, zone: datetime.tzinfo = datetime.UTC) -> datetime.datetime | None:
    """Calendar time of `time` ns since 1970-01-01 UTC, to the microsecond; None outside the years 1 to 9999."""
    try:
        utc = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC) + datetime.timedelta(microseconds=time // 1000)
        return utc.astimezone(zone)
    except OverflowError:
        return None


def aligned(lengths: Iterable[float]) -> list[str]:
    """Lengths in m with the same decimals, so that they stand below each other."""
    found = [float(length) for length in lengths]
    return [f"{length:.{1 if max(found) >= 100 else 4}f}" for length in found]


def clock(time: int, zone: datetime.tzinfo = datetime.UTC) -> str:
    """``2012-09-14 12:15:00`` of `time` (ns since 1970 UTC) in `zone`, tenths of a second where there are any."""
    when = moment(time, zone)
    if when is None:
        return NOTHING
    tenths = f".{when.microsecond // 100_000}" if when.microsecond >= 100_000 else ""
    return f"{when:%Y-%m-%d %H:%M:%S}{tenths}"


def interval(start: int, stop: int, zone: datetime.tzinfo = datetime.UTC) -> tuple[str, str]:
    """``2012-09-14 12:15:00`` and ``14:15:00``, the second with its date where that is another one."""
    first, last = clock(start, zone), clock(stop, zone)
    return first, last.removeprefix(first[:11])


def day(time: int, zone: datetime.tzinfo = datetime.UTC) -> str:
    """``14 September 2012`` of `time` (ns since 1970 UTC) in `zone`."""
    when = moment(time, zone)
    return NOTHING if when is None else f"{when.day} {_MONTHS[when.month - 1]} {when.year}"


def days(start: int, stop: int, zone: datetime.tzinfo = datetime.UTC) -> str:
    """The day, or the first and last day, of an interval (ns since 1970 UTC)."""
    first, last = day(start, zone), day(stop, zone)
    return first if first == last else f"{first} to {last}"


def month(index: int) -> str:
    """Three letters of month 1 to 12, whatever the locale."""
    return _MONTHS[index - 1][:3]


def offset(time: int, zone: datetime.tzinfo) -> str:
    """Offset of `zone` from UTC at `time` as ``UTC+02:00``."""
    when = moment(time, zone)
    shift = None if when is None else when.utcoffset()
    if shift is None:
        return "UTC"
    minutes = round(shift.total_seconds() / 60)
    return f"UTC{'+' if minutes >= 0 else '−'}{abs(minutes) // 60:02d}:{abs(minutes) % 60:02d}"


def mapping(value: object) -> dict[str, Any]:
    """`value` as a dict: a mapping itself or the JSON text of one; empty for anything else."""
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, str):
        try:
            decoded = json.loads(value)
        except (ValueError, RecursionError):
            return {}
        return decoded if isinstance(decoded, dict) else {}
    return {}


def site_zone(attributes: Mapping[Any, Any]) -> zoneinfo.ZoneInfo | None:
    """Time zone of the site in a product's attributes, None where it is not given or not known.

    Looked for as `timezone` or `site_timezone`, or as `timezone` in `site` or in the `site` of `header`, each of
    which may be a mapping or JSON text.
    """
    site = mapping(attributes.get("site")) or mapping(mapping(attributes.get("header")).get("site"))
    for name in (attributes.get("timezone"), attributes.get("site_timezone"), site.get("timezone")):
        if isinstance(name, str) and name:
            try:
                return zoneinfo.ZoneInfo(name)
            except (KeyError, ValueError, OSError):
                return None
    return None
