"""Moments as people write them in a query: always with a zone, never in doubt."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from zoneinfo import ZoneInfo

_MOMENT = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)"
    r"(?:[T ](?P<clock>\d\d:\d\d)(?::(?P<second>\d\d)(?:\.(?P<fraction>\d{1,9}))?)?)?"
    r"\s*(?P<offset>Z|UTC|[+-]\d\d:?\d\d)?"
    r"\s*(?:\[(?P<zone>[^\]]*)\]|(?P<named>[A-Za-z]+/[\w/+-]+))?"
)


class TimeError(ValueError):
    """A time that cannot be read, or that may mean several moments."""


def local_zone(name: str) -> tzinfo:
    """Time zone of a name in the IANA database.

    Raises
    ------
    TimeError
        There is none of this name.
    """
    try:
        return ZoneInfo(name)
    except (ValueError, OSError, KeyError):
        raise TimeError(f"there is no time zone '{name}'; write a name such as Europe/Paris") from None


def moment(text: str) -> int:
    """Read a time.

    Parameters
    ----------
    text : str
        ISO 8601 with an offset, ``2012-09-14T14:00+02:00`` or ``2012-09-14T12:00Z``, or the local time of a zone in the
        manner of RFC 9557, ``2012-09-14T14:00[Europe/Paris]``. Both together decide the hour that the end of summer
        time repeats: ``2012-10-28T02:30+01:00[Europe/Paris]``. A date alone is the midnight that it begins with.

    Returns
    -------
    int
        ns since 1970-01-01T00:00:00 UTC.

    Raises
    ------
    TimeError
        It is no time, has no zone, or stands for two moments or for none.
    """
    match = _MOMENT.fullmatch(text)
    if match is None:
        raise TimeError("this is no time; write for example 2012-09-14T14:00+02:00 or 2012-09-14T14:00[Europe/Paris]")
    date, clock = match["date"], match["clock"] or "00:00"
    try:
        wall = datetime.fromisoformat(f"{date}T{clock}:{match['second'] or '00'}")
    except ValueError as error:
        raise TimeError(f"there is no such time: {error}") from None
    if not 1678 <= wall.year <= 2261:
        raise TimeError("the catalog knows the years 1678 to 2261")
    offset, name = match["offset"], match["zone"] if match["zone"] is not None else match["named"]
    if offset is None and name is None:
        raise TimeError(
            f"the zone is missing, and a time without one may be any of 26 hours; write {date}T{clock}Z for UTC, "
            f"{date}T{clock}+02:00, or {date}T{clock}[Europe/Paris]"
        )
    if name is None:
        aware = wall.replace(tzinfo=_fixed(offset))
    else:
        aware = _in_zone(wall, name, None if offset is None else _fixed(offset))
    elapsed = aware.astimezone(UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    seconds = elapsed.days * 86400 + elapsed.seconds
    return seconds * 10**9 + int((match["fraction"] or "").ljust(9, "0"))


def _fixed(offset: str) -> timezone:
    if offset in ("Z", "UTC"):
        return UTC
    hours, minutes = int(offset[1:3]), int(offset[-2:])
    if hours > 14 or minutes > 59:
        raise TimeError(f"no zone is {offset} from UTC")
    return timezone((-1 if offset[0] == "-" else 1) * timedelta(hours=hours, minutes=minutes))


def _in_zone(wall: datetime, name: str, fixed: timezone | None) -> datetime:
    """A wall clock in a zone, where the clock shows that time once; else the offset decides."""
    zone = local_zone(name)
    readings = [wall.replace(tzinfo=zone, fold=fold) for fold in (0, 1)]
    # A clock that is put forward never shows the hour in between.
    shown = [at for at in readings if at.astimezone(UTC).astimezone(zone).replace(tzinfo=None, fold=0) == wall]
    written = wall.isoformat(timespec="minutes" if not wall.second else "seconds")
    if not shown:
        raise TimeError(f"in {name} no clock showed {written}: summer time began, and the clocks jumped over it")
    offsets = dict.fromkeys(at.utcoffset() for at in shown)
    choices = " or ".join(f"{written}{at.isoformat()[-6:]}[{name}]" for at in shown[: len(offsets)])
    if fixed is not None:
        for at in shown:
            if at.utcoffset() == fixed.utcoffset(None):
                return at
        raise TimeError(f"in {name} the clocks were not at this distance from UTC then; write {choices}")
    if len(offsets) > 1:
        raise TimeError(f"in {name} the clocks showed {written} twice, as summer time ended; write {choices}")
    return shown[0]


def utc_text(nanoseconds: int, *, exact: bool = False) -> str:
    """A moment as ISO 8601 in UTC, to the second or exactly."""
    fraction = f".{nanoseconds % 10**9:09d}".rstrip("0").rstrip(".") if exact else ""
    return f"{_at(nanoseconds):%Y-%m-%dT%H:%M:%S}{fraction}Z"


def local_text(nanoseconds: int, name: str | None) -> str:
    """A moment in the local time of a zone with its offset; empty where the zone is not known."""
    try:
        zone = local_zone(name) if name else None
    except TimeError:
        zone = None
    return "" if zone is None else _at(nanoseconds).astimezone(zone).isoformat(timespec="seconds")


def _at(nanoseconds: int) -> datetime:
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=nanoseconds // 10**9)
