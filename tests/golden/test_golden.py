"""Numbers and versions move together; see :mod:`golden.cases`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from golden import cases
from golden.cases import Case

ALL = {case.name: case for case in cases.cases()}


@pytest.mark.parametrize("name", ALL)
def test_golden(name: str) -> None:
    fault = cases.verdict(ALL[name])
    assert fault is None, fault


def test_nothing_is_stored_that_is_gone() -> None:
    assert {path.stem for path in cases.VALUES.glob("*.json")} == set(ALL)


# --- that it can fail --------------------------------------------------------------------------------------


@pytest.fixture
def case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Case:
    """A case whose values are stored."""
    monkeypatch.setattr(cases, "VALUES", tmp_path)
    made = Case(
        "thing", 3, "the THING version", lambda: {"x": np.array([1.0, 2e-9, np.nan]), "interval": np.array(5.0)}
    )
    assert cases.verdict(made) == f"thing has no golden values; store them with: {cases.COMMAND} thing"
    assert cases.store(made) == "thing: version 3 stored"
    assert cases.verdict(made) is None
    assert cases.store(made) == "thing: unchanged"
    return made


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"x": [1 + 2e-6, 2e-9, np.nan], "interval": 5.0}, "x moved by 2.0e-06 of its largest value"),
        ({"x": [1.0, 3e-6, np.nan], "interval": 5.0}, "x moved by 3.0e-06 of its largest value"),
        ({"x": [1.0, 2e-9, 0.0], "interval": 5.0}, "x has another shape, or other gaps"),
        ({"x": [1.0, 2e-9], "interval": 5.0}, "x has another shape, or other gaps"),
        ({"x": [1.0, 2e-9, np.nan], "interval": 6.5}, "interval moved by 3.0e-01 of its largest value"),
        ({"x": [1.0, 2e-9, np.nan]}, "interval is gone"),
        ({"x": [1.0, 2e-9, np.nan], "interval": 5.0, "y": 0.0}, "y is new"),
    ],
)
def test_numbers_that_move_alone_are_caught(case: Case, values: dict[str, object], words: str) -> None:
    moved = replace(case, compute=lambda: {name: np.asarray(value) for name, value in values.items()})
    assert cases.verdict(moved) == f"bump the THING version or restore the result: {words}"
    with pytest.raises(SystemExit, match="bump the THING version first"):
        cases.store(moved)
    again = replace(moved, version=4)
    assert str(cases.verdict(again)).startswith(
        "the THING version is 4, the golden values are of 3; store the new ones"
    )
    cases.store(again)
    assert cases.verdict(again) is None


def test_a_version_that_moves_alone_is_caught(case: Case) -> None:
    assert str(cases.verdict(replace(case, version=4))).startswith(
        "restore the THING version to 3 or change the result"
    )


def test_rounding_is_no_change(case: Case) -> None:
    close = replace(case, compute=lambda: {"x": np.array([1 + 1e-9, 2.1e-9, np.nan]), "interval": np.array(5.5)})
    assert cases.verdict(close) is None


def test_arithmetic_noise_is_as_promised() -> None:
    drawn = cases.noise(20_000)
    # Standard errors of mean and variance of 20,000 values are 0.007 and 0.008.
    assert abs(drawn.mean()) < 0.03
    assert abs(drawn.var() - 1) < 0.04
    assert abs(np.corrcoef(drawn[1:], drawn[:-1])[0, 1]) < 0.03
