"""The small language in which batches are asked for: conditions that all must hold.

``campaign=lannemezan t>=2012-09-14T14:00+02:00 scint<0.3 r0>10 cm quality=good``

A condition is a field, one of ``= != < <= > >=`` and a value; a value ends where the next condition begins, or at the
end of its quotes. Quantities have units, names may end in ``*``, and a list ``a,b`` means any of them. A query becomes
bound parameters of one statement: no text of it ever stands in SQL.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import sqlalchemy as sa

from ..pipeline.products import QUALITY_FLAGS
from ..pipeline.units import QuantityError, parse, safe
from .query_times import TimeError, moment
from .rows import BATCHES, key_begins
from .tables import alias_product, archive, batch, campaign, plugin, product

#: Longest query, characters.
LIMIT = 10_000
LEVELS = ("good", "usable", "bad")
_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "=": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_BEGINNING = re.compile(r"(?:and\s+)?(?P<field>[A-Za-z_]\w*)\s*(?P<sign><=|>=|!=|==|=|<|>)\s*")
_NEXT = re.compile(r"\s+" + _BEGINNING.pattern.replace("?P<field>", "?:").replace("?P<sign>", "?:"))
_QUOTED = re.compile(r'"([^"]*)"')

Condition = sa.ColumnElement[bool]


class QueryError(ValueError):
    """A query that cannot be understood; `faults` has one sentence for each fault, with its position."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults


@dataclass(frozen=True)
class Term:
    """One condition as it was written.

    Parameters
    ----------
    field, sign, value : str
        Its parts.
    position : int
        Where it begins, counted from 1.
    """

    field: str
    sign: str
    value: str
    position: int


class _Fault(ValueError):
    """What is wrong with one condition."""


@dataclass(frozen=True)
class Field:
    """Something that can be asked for.

    Parameters
    ----------
    meaning : str
        What it is, for the list of fields.
    example : str
        A condition.
    signs : str
        Operators that make sense, separated by blanks.
    build : callable
        Operator and value -> condition; raises ``_Fault``, QuantityError or TimeError.
    """

    meaning: str
    example: str
    signs: str
    build: Callable[[str, str], Condition]


def _several(value: str) -> list[str]:
    parts = [part.strip() for part in value.split(",")]
    if not all(parts):
        raise _Fault("a name is missing")
    return parts


def _either(sign: str, conditions: Sequence[Condition]) -> Condition:
    return sa.or_(*conditions) if sign == "=" else sa.not_(sa.or_(*conditions))


def _name(column: Any) -> Callable[[str, str], Condition]:
    def one(text: str) -> Condition:
        beginning = text.removesuffix("*")
        if "*" in beginning:
            raise _Fault("a '*' can only stand at the end of a name")
        if beginning != text:
            return sa.func.substr(column, 1, len(beginning)) == beginning
        return column == text  # type: ignore[no-any-return]

    return lambda sign, value: _either(sign, [one(text) for text in _several(value)])


def _plugin(role: str) -> Callable[[str, str], Condition]:
    def build(sign: str, value: str) -> Condition:
        there = sa.select(plugin.c.lineage_key).where(
            plugin.c.lineage_key == product.c.lineage_key, plugin.c.role == role, _name(plugin.c.name)("=", value)
        )
        return sa.exists(there) if sign == "=" else ~sa.exists(there)

    return build


def _number(column: Any, unit: str = "", key: str = "", *, whole: bool = False) -> Callable[[str, str], Condition]:
    def read(value: str) -> float:
        if unit:
            return parse(value, unit, key=key)
        if re.fullmatch(r"[+-]?\d+,\d+", value):
            raise _Fault(f"use a point as decimal sign, not a comma; write '{value.replace(',', '.')}'")
        if not re.fullmatch(r"[+-]?\d+" if whole else r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?", value):
            raise _Fault(f"this is no {'whole ' if whole else ''}number; {key} has no unit")
        number = int(value) if whole else float(value)
        if abs(number) >= 2**63:
            raise _Fault("this is more than the catalog can hold")
        return number

    def build(sign: str, value: str) -> Condition:
        if value == "none" and sign in ("=", "!="):
            return column.is_(None) if sign == "=" else column.is_not(None)  # type: ignore[no-any-return]
        return _OPERATORS[sign](column, read(value))  # type: ignore[no-any-return]

    return build


def _time(sign: str, value: str) -> Condition:
    at = moment(value)
    if sign == "=":
        return sa.and_(batch.c.start <= at, batch.c.stop > at)
    return _OPERATORS[sign](batch.c.start, at)  # type: ignore[no-any-return]


def _quality(sign: str, value: str) -> Condition:
    names = _several(value)
    for name in names:
        if name not in LEVELS:
            raise _Fault(f"the levels are {', '.join(LEVELS)}" + _meant(name, LEVELS))
    if sign in ("=", "!="):
        return _either(sign, [batch.c.quality_level == LEVELS.index(name) for name in names])
    if len(names) > 1:
        raise _Fault(f"'{sign}' takes one level")
    return _OPERATORS[sign](batch.c.quality_level, LEVELS.index(names[0]))  # type: ignore[no-any-return]


def _flag(sign: str, value: str) -> Condition:
    def one(name: str) -> Condition:
        if name == "none":
            return batch.c.quality_flag == 0
        if name not in QUALITY_FLAGS:
            raise _Fault(f"the flags are {', '.join(QUALITY_FLAGS)}, and none" + _meant(name, QUALITY_FLAGS))
        return batch.c.quality_flag.bitwise_and(QUALITY_FLAGS[name][0]) != 0

    return _either(sign, [one(name) for name in _several(value)])


def _release(sign: str, value: str) -> Condition:
    named = sa.select(alias_product.c.product_id).where(alias_product.c.alias.in_(_several(value)))
    return product.c.id.in_(named) if sign == "=" else product.c.id.not_in(named)


def _key(sign: str, value: str) -> Condition:
    digits = _several(value)
    for text in digits:
        if not re.fullmatch(r"[0-9a-f]{4,64}", text):
            raise _Fault("write 4 to 64 of the hexadecimal digits that the key begins with")
    return _either(sign, [key_begins(text) for text in digits])


def _yes(condition: Callable[[], Condition]) -> Callable[[str, str], Condition]:
    def build(sign: str, value: str) -> Condition:
        if value not in ("yes", "no"):
            raise _Fault("write yes or no")
        return condition() if (value == "yes") == (sign == "=") else sa.not_(condition())

    return build


def _current() -> Condition:
    """The product of its archive that counts: the accepted one, else the one published last."""
    other = product.alias("other")
    best = (
        sa.select(other.c.id)
        .where(other.c.archive_id == product.c.archive_id)
        .order_by(other.c.accepted.is_(None), other.c.published.desc(), other.c.id.desc())
        .limit(1)
        .correlate(product)
        .scalar_subquery()
    )
    return product.c.id == best


def _published(sign: str, value: str) -> Condition:
    return _OPERATORS[sign](product.c.published, moment(value))  # type: ignore[no-any-return]


_SAME, _ANY = "= !=", "= != < <= > >="
#: Everything that can be asked for.
FIELDS: dict[str, Field] = {
    "t": Field("begin of the batch; t= finds the batch that holds a moment", "t>=2012-09-14T14:00+02:00",
               "= < <= > >=", _time),
    "campaign": Field("name of the campaign", "campaign=lannemezan*", _SAME, _name(campaign.c.name)),
    "archive": Field("name of the recording", "archive=2012-09-14*", _SAME, _name(archive.c.name)),
    "key": Field("first digits of the product's lineage key", "key=78128ac8", _SAME, _key),
    "alias": Field("release that holds the product", "alias=paper-v1", _SAME, _release),
    "current": Field("whether the product counts: accepted, or else the newest of its archive", "current=yes", _SAME,
                     _yes(_current)),
    "accepted": Field("whether the product was promoted", "accepted=yes", _SAME,
                      _yes(lambda: product.c.accepted.is_not(None))),
    "published": Field("when the product was published", "published>=2026-11-01Z", "< <= > >=", _published),
    "run": Field("run that published the product", "run=e06d50290f*", _SAME, _name(product.c.run_id)),
    "regulariser": Field("plugin of the product", "regulariser=white", _SAME, _plugin("regulariser")),
    "selector": Field("plugin of the product", "selector=gcv", _SAME, _plugin("selector")),
    "spectrum": Field("plugin of the product", "spectrum=kolmogorov", _SAME, _plugin("spectrum")),
    "source": Field("plugin of the product, of any source", "source=gaussian", _SAME, _plugin("sources")),
    "batch": Field("number of the batch in its product, from 0", "batch=0", _ANY,
                   _number(batch.c.number, key="batch", whole=True)),
    "frames": Field("frames in the batch", "frames>1000", _ANY,
                    _number(batch.c.n_frames, key="frames", whole=True)),
    "quality": Field("good < usable < bad", "quality<=usable", _ANY, _quality),
    "flag": Field("quality flag by its name, or none", "flag!=poor_fit,saturated", _SAME, _flag),
    "r0": Field("Fried parameter, from the profile", "r0>10 cm", _ANY, _number(batch.c.r0, "m", "r0")),
    "scint": Field("scintillation index, measured, mean of the sources", "scint<0.3", _ANY,
                   _number(batch.c.scintillation_index, key="scint")),
    "scint_profile": Field("the same from the profile", "scint_profile<0.3", _ANY,
                           _number(batch.c.scintillation_index_profile, key="scint_profile")),
    "scint_point": Field("index of one point of the source, from the profile", "scint_point<0.3", _ANY,
                         _number(batch.c.scintillation_index_point, key="scint_point")),
    "mu": Field("hyperparameter of the inversion", "mu>1e27 m^(4/3)", _ANY, _number(batch.c.mu, "m^(4/3)", "mu")),
    "chi2": Field("misfit per independent datum", "chi2<2", _ANY, _number(batch.c.chi2, key="chi2")),
}  # fmt: skip
#: Other names of fields.
_SYNONYMS = {"time": "t", "scintillation": "scint", "scintillation_index": "scint", "lineage_key": "key"}


@dataclass(frozen=True)
class Query:
    """A query that was understood.

    Parameters
    ----------
    terms : tuple of Term
        Its conditions as they were written.
    conditions : tuple
        The same for the database.
    """

    terms: tuple[Term, ...]
    conditions: tuple[Condition, ...]

    def batches(self, limit: int | None = None) -> sa.Select[Any]:
        """Statement for the batches in the order of their time."""
        return BATCHES.where(*self.conditions).order_by(batch.c.start, batch.c.product_id).limit(limit)


def terms(text: str) -> Iterator[Term | str]:
    """Cut a query into its conditions.

    Parameters
    ----------
    text : str
        The query.

    Yields
    ------
    Term or str
        Conditions; a sentence where there is none.
    """
    at = len(text) - len(text.lstrip())
    while at < len(text):
        begin = _BEGINNING.match(text, at)
        if begin is None:
            following = _NEXT.search(text, at)
            end = following.start() if following else len(text)
            lost = text[at:end].strip()
            yield f"query, character {at + 1}: '{safe(lost)}' is no condition; write FIELD=VALUE, as in quality=good"
        else:
            start = begin.end()
            quoted = _QUOTED.match(text, start)
            # From the sign on: where the value is missing, the blank after it is the one before the next condition.
            following = _NEXT.search(text, begin.end("sign"))
            if text[start : start + 1] == '"' and quoted is None:
                yield f'query, character {start + 1}: the closing " is missing'
                return
            end = quoted.end() if quoted else following.start() if following else len(text)
            value = quoted[1] if quoted else text[begin.end("sign") : end]
            sign = "=" if begin["sign"] == "==" else begin["sign"]
            yield Term(begin["field"], sign, value.strip(), begin.start("field") + 1)
        at = end + len(text[end:]) - len(text[end:].lstrip())


def understand(text: str) -> Query:
    """Read a query.

    Parameters
    ----------
    text : str
        Conditions separated by blanks, perhaps with ``and`` between them; see :data:`FIELDS`. Nothing asks for all.

    Returns
    -------
    Query

    Raises
    ------
    QueryError
        With every fault and where it stands.
    """
    if len(text) > LIMIT:
        raise QueryError([f"query: {len(text)} characters are too many; at most {LIMIT} are read"])
    found: list[Term] = []
    conditions: list[Condition] = []
    faults: list[str] = []
    for term in terms(text):
        if isinstance(term, str):
            faults.append(term)
            continue
        written = safe(f"{term.field}{term.sign}{term.value}"[:120])
        where = f"query, character {term.position}: {written}"
        name = _SYNONYMS.get(term.field, term.field)
        field = FIELDS.get(name)
        if field is None:
            faults.append(f"{where}: there is no field '{safe(term.field)}'" + _meant(term.field, FIELDS))
        elif term.value.endswith(" or"):
            faults.append(f"{where}: there is no 'or'; all conditions must hold, and a list a,b means any of them")
        elif not term.value:
            faults.append(f"{where}: the value is missing; write for example {field.example}")
        elif term.sign not in field.signs.split():
            faults.append(f"{where}: '{term.sign}' means nothing for {name}; it takes {field.signs}")
        else:
            try:
                conditions.append(field.build(term.sign, term.value))
                found.append(term)
            except (_Fault, TimeError) as error:
                faults.append(f"{where}: {safe(str(error))}")
            except QuantityError as error:
                faults.append(f"{where}: {safe(error.reason)}")
    if faults:
        raise QueryError(faults)
    return Query(tuple(found), tuple(conditions))


def _meant(name: str, known: Any) -> str:
    near = get_close_matches(name, list(known), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""
