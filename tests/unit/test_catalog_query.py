"""Queries against a plain reading of the same rows, and every way to write one wrongly."""

from __future__ import annotations

import random
from datetime import datetime
from zoneinfo import ZoneInfo

import pytest
import sqlalchemy as sa
from catalogs import KINDS, database_of
from hypothesis import given
from hypothesis import strategies as st
from made_products import LENGTH, START, batch, failed, key, product

from coslidar.catalog.query import FIELDS, LIMIT, QueryError, understand
from coslidar.catalog.query_times import TimeError, local_text, moment, utc_text
from coslidar.catalog.store import Catalog
from coslidar.pipeline.products import QUALITY_FLAGS


@pytest.fixture(scope="module", params=KINDS)
def catalog(request, tmp_path_factory):
    """Four products of three archives in two campaigns, two of one archive, one of them accepted."""
    folder = tmp_path_factory.mktemp("catalog")
    with database_of(request.param, folder) as url, Catalog(folder / "c", url) as made:
        header = {"site": {"timezone": "Europe/Paris"}}
        first = made.publish(product(0), header=header).row
        made.publish(product(1), header=header)
        made.promote(first)
        flags = [QUALITY_FLAGS["poor_fit"][0] | QUALITY_FLAGS["gaps"][0], 0, QUALITY_FLAGS["rytov_limit"][0]]
        results = [batch(number, 7, flag=flag) for number, flag in enumerate(flags)] + [failed(3)]
        made.publish(product(2, results, archive="other.one", archive_identity="e" * 64), header=header)
        made.publish(product(3, archive="Other", campaign="second", archive_identity="d" * 64))
        made.release("paper-v1", [first], "as printed")
        yield made


def rows(catalog, wanted):
    """What a loop over all rows finds."""
    return [row for row in catalog.batches() if wanted(row)]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", lambda row: True),
        ("campaign=second", lambda row: row.campaign == "second"),
        ("campaign!=second", lambda row: row.campaign != "second"),
        ("archive=other*", lambda row: row.archive.startswith("other")),
        ("archive=Other,2012-09*", lambda row: row.archive == "Other" or row.archive.startswith("2012-09")),
        ("archive!=Other,2012-09*", lambda row: row.archive == "other.one"),
        ("archive=%", lambda row: False),
        ("archive=o_her.one", lambda row: False),
        ("r0>400 cm", lambda row: row.r0 is not None and row.r0 > 4.0),
        ("r0 <= 4 m r0>200cm", lambda row: row.r0 is not None and 2 < row.r0 <= 4),
        ("r0=none", lambda row: row.r0 is None),
        ("r0!=none and chi2 < 5", lambda row: row.r0 is not None and row.chi2 < 5),
        ("scint>=3.5", lambda row: row.scintillation_index is not None and row.scintillation_index >= 3.5),
        ("mu>4 m^(4/3)", lambda row: row.mu is not None and row.mu > 4),
        ("quality=good", lambda row: row.quality_level == 0),
        ("quality=good,bad", lambda row: row.quality_level != 1),
        ("quality!=good", lambda row: row.quality_level > 0),
        ("quality<=usable", lambda row: row.quality_level <= 1),
        ("quality>good", lambda row: row.quality_level > 0),
        ("flag=poor_fit", lambda row: row.quality_flag & 128),
        ("flag=poor_fit,failed", lambda row: row.quality_flag & 129),
        ("flag!=poor_fit,failed", lambda row: not row.quality_flag & 129),
        ("flag=none", lambda row: row.quality_flag == 0),
        ("batch=1,", None),
        ("batch>=2", lambda row: row.number >= 2),
        (f"key={str(key(1))[:8]}", lambda row: row.lineage_key == str(key(1))),
        ("alias=paper-v1", lambda row: row.lineage_key == str(key(0))),
        ("accepted=yes", lambda row: row.lineage_key == str(key(0))),
        ("current=yes", lambda row: row.lineage_key != str(key(1))),
        ("current=no", lambda row: row.lineage_key == str(key(1))),
        ("published>2020-01-01Z", lambda row: True),
        ("published<2020-01-01Z", lambda row: False),
        # The recordings begin at 12:15:00 UTC, and a batch has 3 min.
        ("t>=2012-09-14T14:18+02:00", lambda row: row.start >= START - 123 + LENGTH),
        ("t=2012-09-14T12:19:30Z", lambda row: row.number == 1),
        ('t="2012-09-14 14:19:30 Europe/Paris"', lambda row: row.number == 1),
        ("t>2012-09-14T12:15:00.000000122Z t<2012-09-14T12:15:00.000000124Z", lambda row: row.start == START),
        ("t>2012-09-14T12:15:00.000000123Z", lambda row: row.start > START),
        ("campaign=test-campaign r0>1 m quality=good scint<9", lambda row: row.campaign == "test-campaign" and
            row.quality_level == 0 and row.r0 > 1 and row.scintillation_index < 9),
    ],
)  # fmt: skip
def test_a_query_finds_what_a_loop_finds(catalog, text, wanted):
    if wanted is None:
        with pytest.raises(QueryError):
            catalog.query(text)
        return
    found = rows(catalog, wanted)
    assert catalog.query(text) == found
    assert catalog.query(text, limit=2) == found[:2]


def test_plugins_are_asked_for_by_name(tmp_path):
    from catalogs import version_1

    from coslidar.catalog.database import Database

    url = f"sqlite:///{tmp_path / 'catalog.sqlite'}"
    version_1(url)
    Database(url, upgrade=True).close()
    with Catalog(tmp_path) as catalog:
        assert len(catalog.query("regulariser=white")) == len(catalog.query("regulariser!=white")) == 12
        assert len(catalog.query("regulariser=gra*,white selector=gcv source=gaussian spectrum=kolmogorov")) == 24
        assert {row.timezone for row in catalog.query("batch=0")} == {"Europe/Paris"}


FAULTS = [
    ("r0>10", 1, "the unit is missing"),
    ("scint<0,3", 1, "point as decimal sign"),
    ("  r0>3 s", 3, "is a duration"),
    ("r0>nan m", 1, "finite"),
    ("scint<nan", 1, "no number"),
    ("scint<1e999", 1, "more than"),
    ("batch=99999999999999999999", 1, "more than"),
    ("batch=1.5", 1, "no whole number"),
    ("t>2012-09-14T14:00", 1, "the zone is missing"),
    ("t>2012-09-14", 1, "the zone is missing"),
    ("t>yesterday", 1, "no time"),
    ("t>2012-13-14Z", 1, "no such time"),
    ("t>0001-01-01Z", 1, "years 1678"),
    ("t>2012-09-14T14:00+25:00", 1, "no zone is"),
    ("t>2012-10-28T02:30[Europe/Paris]", 1, r"twice.*02:30\+02:00\[Europe/Paris\] or .*02:30\+01:00"),
    ("t>2012-03-25T02:30[Europe/Paris]", 1, "no clock showed"),
    ("t>2012-03-25T02:30+01:00[Europe/Paris]", 1, "no clock showed"),
    ("t>2012-09-14T14:00+01:00[Europe/Paris]", 1, r"write 2012-09-14T14:00\+02:00\[Europe/Paris\]"),
    ("t>2012-09-14T14:00[../../etc/passwd]", 1, "no time zone"),
    ("t!=2012-09-14Z", 1, "means nothing"),
    ("quality=goood", 1, "did you mean 'good'"),
    ("quality<good,bad", 1, "one level"),
    ("flag=por_fit", 1, "did you mean 'poor_fit'"),
    ("rO>1 m", 1, "no field 'rO'"),
    ("scnt<1", 1, "did you mean 'scint'"),
    ("r0= quality=good", 1, "the value is missing"),
    ("quality=good or r0>1 m", 1, "there is no 'or'"),
    ("hello quality=good", 1, "'hello' is no condition"),
    ('archive="abc', 9, 'closing " is missing'),
    ("archive=a*b", 1, "end of a name"),
    ("archive=a,,b", 1, "a name is missing"),
    ("key=xyz", 1, "hexadecimal"),
    ("current=maybe", 1, "yes or no"),
    ("alias=paper-v9", 1, "no release of this name"),
    ("x" * (LIMIT + 1), None, "too many"),
]


@pytest.mark.parametrize(("text", "position", "reason"), FAULTS)
def test_faults_say_where_and_what(catalog, text, position, reason):
    where = "query" if position is None else f"query, character {position}:"
    with pytest.raises(QueryError, match=rf"(?s)^{where}.*{reason}"):
        catalog.query(text)


def test_every_fault_at_once():
    """Each fault is told with the place where it stands in the whole."""
    parts = [text for text, position, _ in FAULTS if position == 1 and "alias" not in text and " or " not in text]
    parts = [text for text in parts if text[0] != "h"]
    random.Random(1).shuffle(parts)
    whole = "  ".join(parts)
    with pytest.raises(QueryError) as caught:
        understand(whole)
    assert len(caught.value.faults) == sum(len(text.split("  ")) for text in parts)
    for text in parts:
        assert any(fault.startswith(f"query, character {whole.index(text) + 1}:") for fault in caught.value.faults), (
            text
        )


def refused(text):
    """Faults of a query, fit for a terminal; none where it is understood."""
    try:
        understand(text)
    except QueryError as error:
        faults = error.faults
    else:
        return []
    assert faults
    assert all(fault.isprintable() for fault in faults)
    return faults


HOSTILE = [
    "archive='); DROP TABLE product; --",
    "campaign=x' OR '1'='1",
    "archive=\x1b]0;title\x07",
    "archive=<script>alert(1)</script>",
    "run=%",
    "flag=\u202egood",
]


@pytest.mark.parametrize("text", HOSTILE)
def test_texts_stay_texts(catalog, text):
    before = len(catalog.products())
    faults = refused(text)
    assert faults or catalog.query(text) == []
    assert len(catalog.products()) == before


@given(st.text(max_size=60))
def test_any_text_is_understood_or_refused(text):
    """Whatever was understood is bound: nothing of it stands in the statement."""
    whole = text + ' archive="needle\'--" '
    if not refused(whole):
        assert "needle" not in str(understand(whole).batches())


def test_every_example_is_a_query():
    for name, field in FIELDS.items():
        asked = understand(field.example)
        assert [term.field for term in asked.terms] == [name]
        for sign in field.signs.split():
            value = field.example[len(name) :].lstrip("=!<>")
            understand(f"{name}{sign}{value.split(',')[0]}")
        assert isinstance(asked.batches().compile().params, dict)


def test_the_index_of_times_is_used(tmp_path):
    """A query for a night does not look at every batch."""
    with Catalog(tmp_path) as catalog, catalog.database.read() as connection:
        compiled = (
            understand("t>=2012-09-14Z t<2012-09-15Z")
            .batches()
            .compile(catalog.database.engine, compile_kwargs={"literal_binds": True})
        )
        plan = connection.execute(sa.text(f"EXPLAIN QUERY PLAN {compiled}")).all()
    assert any("ix_batch_start" in row[3] for row in plan), plan


# --- times -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("1970-01-01T00:00Z", 0),
        ("1970-01-01T00:00:01UTC", 1),
        ("2012-09-14T14:00+02:00", 1347624000),
        ("2012-09-14T12:00Z", 1347624000),
        ("2012-09-14 14:00 +0200", 1347624000),
        ("2012-09-14T14:00[Europe/Paris]", 1347624000),
        ("2012-09-14T14:00 Europe/Paris", 1347624000),
        ("2012-09-14[Europe/Paris]", 1347573600),
        # Summer time ended at 01:00 UTC, 1351386000.
        ("2012-10-28T02:30+02:00[Europe/Paris]", 1351386000 - 1800),
        ("2012-10-28T02:30+01:00[Europe/Paris]", 1351386000 + 1800),
        ("2012-10-28T03:00[Europe/Paris]", 1351386000 + 3600),
        ("2012-10-28T01:59[Europe/Paris]", 1351386000 - 3660),
        ("2012-03-25T03:00[Europe/Paris]", 1332637200),
        ("1969-12-31T23:59:59Z", -1),
    ],
)
def test_moments(text, seconds):
    assert moment(text) == seconds * 10**9


def test_fractions_are_exact():
    assert moment("2012-09-14T12:15:00.000000123Z") == START
    assert moment("1969-12-31T23:59:59.9Z") == -(10**8)


@given(
    st.datetimes(datetime(1971, 1, 1), datetime(2037, 12, 31)),
    st.sampled_from(["Europe/Paris", "America/St_Johns", "Australia/Lord_Howe", "Asia/Kolkata", "Pacific/Apia"]),
)
def test_local_times_are_those_of_the_zone(wall, name):
    """Against a search of all offsets: a wall time is taken where exactly one moment shows it."""
    wall = wall.replace(second=0, microsecond=0)
    zone, base = ZoneInfo(name), int((wall - datetime(1970, 1, 1)).total_seconds())
    shown = [
        base - 60 * minutes
        for minutes in range(-14 * 60, 15 * 60, 15)
        if datetime.fromtimestamp(base - 60 * minutes, zone).replace(tzinfo=None, fold=0) == wall
    ]
    # Offsets in these years are whole quarters of an hour in these zones.
    try:
        found = moment(f"{wall:%Y-%m-%dT%H:%M}[{name}]")
    except TimeError:
        assert len(shown) != 1
    else:
        assert [found] == [seconds * 10**9 for seconds in shown]


def test_times_are_shown_beside_each_other():
    assert utc_text(START) == "2012-09-14T12:15:00Z"
    assert utc_text(START, exact=True) == "2012-09-14T12:15:00.000000123Z"
    assert utc_text(START - 123 + 5 * 10**8, exact=True) == "2012-09-14T12:15:00.5Z"
    assert utc_text(START - 123, exact=True) == "2012-09-14T12:15:00Z"
    assert local_text(START, "Europe/Paris") == "2012-09-14T14:15:00+02:00"
    assert local_text(START + 60 * 86400 * 10**9, "Europe/Paris") == "2012-11-13T13:15:00+01:00"
    assert local_text(START, None) == local_text(START, "Mars/Olympus") == ""


def test_the_zone_of_a_campaign_is_the_newest(tmp_path):
    with Catalog(tmp_path) as catalog:
        catalog.publish(product(0), header={"site": {"timezone": "UTC"}})
        catalog.publish(product(1), header={"site": {"timezone": "Europe/Paris"}})
        catalog.publish(product(2), header={"site": {"timezone": 5}})
        assert {row.timezone for row in catalog.products()} == {"Europe/Paris"}
