from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, ValidationError, create_model

from coslidar.pipeline.parameters import Parameters
from coslidar.pipeline.units import Extent, Length, PathLength, QuantityError, faults, parse, rounded, safe, text


@pytest.mark.parametrize(
    ("written", "unit", "value"),
    [
        ("2.67 km", "m", 2670.0),
        ("7 cm", "m", 0.07),
        ("3.8 um", "m", 3.8e-6),
        ("3 min", "s", 180.0),
        ("142 Hz", "Hz", 142.0),
        ("1 turn", "rad", 2 * math.pi),
        ("-7 arcsec", "rad", -7 * math.pi / 180 / 3600),
        ("27 urad", "rad", 27e-6),
        ("43.1285 deg", "deg", 43.1285),
        ("12 electron/count", "electron/count", 12.0),
        ("10.5 px", "pixel", 10.5),
        ("1e27 m^(4/3)", "m^(4/3)", 1e27),
        ("1e-14 m^(-2/3)", "m^(-2/3)", 1e-14),
        ("1e-14 m^(1/3)/m", "m^(-2/3)", 1e-14),
        ("1e-14 m**(-2/3)", "m^(-2/3)", 1e-14),
        ("1 km^(-2/3)", "m^(-2/3)", 0.01),
        ("5e-12 rad**2", "rad^2", 5e-12),
    ],
)
def test_reads(written: str, unit: str, value: float) -> None:
    assert parse(written, unit) == pytest.approx(value, rel=1e-14)


def test_spelling_does_not_change_the_number() -> None:
    """pint gives 3.7999999999999996e-06 for 3.8 um; a key made of that would depend on the spelling."""
    assert parse("3.8 um", "m") == parse("3.8e-6 m", "m") == parse("3800 nm", "m") == 3.8e-6
    assert parse("1e23 km^(4/3)", "m^(4/3)") == parse("1e27 m^(4/3)", "m^(4/3)") == 1e27


@pytest.mark.parametrize(
    ("written", "unit", "message"),
    [
        (
            "2670 s",
            "m",
            "'s' is a duration, but path.length must be a length (SI unit m), for example '2670 m', '2.67 km'",
        ),
        (2670, "m", "the unit is missing. path.length is a length; write '2670 m'"),
        ("2670", "m", "the unit is missing. path.length is a length; write '2670 m'"),
        ("8,9 cm", "m", "use a point as decimal sign, not a comma; write '8.9 cm'"),
        ("nan m", "m", "path.length must be a finite length, for example '2670 m', '2.67 km'"),
        ("inf m", "m", "path.length must be a finite length, for example '2670 m', '2.67 km'"),
    ],
)
def test_says_what_is_wrong(written: object, unit: str, message: str) -> None:
    with pytest.raises(QuantityError) as error:
        parse(written, unit, key="path.length")
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("written", "unit"),
    [
        ("5 count", "rad"),  # pint alone holds both dimensionless
        ("5 px", "m"),  # pint alone reads a CSS pixel, a length
        ("5 rad", "count"),
        ("5 %", "rad"),
        ("2 3 m", "m"),
        ("3 m 5", "m"),
        ("3 __import__('os')", "m"),
        ("3 foo", "m"),
        ("5 degC", "m"),
        ("3 m**m", "m"),
        ("", "m"),
        ("m", "m"),
        ("1" * 300 + " m", "m"),
        (True, "m"),
        (None, "m"),
        (["1 m"], "m"),
    ],
)
def test_refuses(written: object, unit: str) -> None:
    with pytest.raises(QuantityError):
        parse(written, unit)


@given(st.floats(min_value=-1e300, max_value=1e300))
def test_text_round_trip(value: float) -> None:
    assert parse(text(value, "m"), "m") == rounded(value)


class Path(Parameters):
    length: PathLength = Field(gt=0)
    height: Length | None = None
    width: Extent = 0.1  # type: ignore[assignment]

    model_config = Parameters.model_config | {"validate_default": False}


def test_infinite_is_legal_for_a_path_only() -> None:
    assert math.isinf(Path(length="inf m").length)  # type: ignore[arg-type]
    with pytest.raises(ValidationError):
        Path(length="1 m", height="inf m")  # type: ignore[arg-type]


def test_alternative_dimension() -> None:
    assert Path(length="1 m", width="2 rad").width == 2  # type: ignore[arg-type]
    with pytest.raises(ValidationError):
        Path(length="1 m", width="2 s")  # type: ignore[arg-type]


def test_every_fault_at_once_with_its_place() -> None:
    with pytest.raises(ValidationError) as error:
        Path.model_validate({"length": "-2 m", "height": "3 s", "depth": "4 m"})
    assert faults(error.value, "campaign.toml", "path") == [
        "campaign.toml: path.length = '-2 m': it should be greater than 0 m",
        "campaign.toml: path.height = '3 s': 's' is a duration, but path.height must be a length (SI unit m), "
        "for example '2670 m', '2.67 km'",
        "campaign.toml: path.depth = '4 m': there is no such key; check its spelling",
    ]


def test_json_keeps_the_unit() -> None:
    path = Path(length="2.67 km", height="23 m")  # type: ignore[arg-type]
    assert path.model_dump(mode="json")["length"] == "2670 m"
    assert Path.model_validate_json(path.model_dump_json()) == path


def test_safe_text_cannot_steer_a_terminal() -> None:
    assert safe("a\x1b[31m\nb") == "a\\x1b[31m\\nb"
    assert len(safe("x" * 10_000)) < 600


@pytest.mark.parametrize("kind", [Length, PathLength, Extent, Length | None])
def test_bounds_hold_for_every_kind_of_field(kind: object) -> None:
    model = create_model("Model", value=(kind, Field(gt=0)))
    assert model(value="1 m").value == 1
    with pytest.raises(ValidationError):
        model(value="-1 m")
