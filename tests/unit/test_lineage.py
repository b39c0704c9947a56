"""Keys: what enters them, what does not, and the value that every stored result hangs on."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from coslidar.pipeline import lineage
from coslidar.pipeline.lineage import LineageError, canonical, check, checkout, document, make_key
from coslidar.pipeline.parameters import ResponseParameters


def chain():
    first = make_key("measurements", 1, {"method": "window", "window_x": 1.7e-05}, upstream=["a" * 64])
    second = make_key("response", 2, {"edges": (0.0, 222.5)}, [{"name": "gaussian", "version": 1, "parameters": {}}])
    return make_key("profile", 1, {"noise_bias": "joint"}, upstream=[first, second])


def test_golden_key():
    # sha256 of the text below, taken with sha256sum: a change here orphans every result ever stored.
    text = (
        '[1,"measurements","1",{"length":2670,"path":"inf","wavelength":3.8e-06},'
        '{"regulariser":{"name":"white"}},["archive"]]'
    )
    made = make_key(
        "measurements",
        1,
        {"wavelength": 3.7999999999999996e-06, "length": 2670.0, "path": float("inf")},
        {"regulariser": {"name": "white"}},
        ["archive"],
    )
    shell = subprocess.run(["sha256sum"], input=text.encode(), capture_output=True, check=True).stdout.decode()
    assert str(made) == shell.split()[0]
    assert str(made) == "b54e4fbe5a3d44097586f6bb16f07c3a3bc7ad07794402a86111c2cc6345cfce"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (-0.0, "0"),
        (0.1 + 0.2, "0.3"),
        (12.0, "12"),
        (12, "12"),
        (True, "true"),
        (1e15, "1e+15"),
        (5e-324, "4.94065645841247e-324"),
        (float("inf"), '"inf"'),
        (float("-inf"), '"-inf"'),
        (np.float32(0.5), "0.5"),
        (np.int8(-3), "-3"),
        (np.bool_(False), "false"),
        (np.array([[1.0, 2.5]]), "[[1,2.5]]"),
        (np.array(3.0), "3"),
        ((1, [2, None]), "[1,[2,null]]"),
        ({"b": 1, "a": "é\n"}, '{"a":"\\u00e9\\n","b":1}'),
    ],
)
def test_canonical_form(value, text):
    assert canonical(value) == text


@pytest.mark.parametrize(
    "value",
    [
        float("nan"),
        {"x": [np.nan]},
        {1: 2},
        {1, 2},
        b"x",
        1j,
        object(),
        np.array([1j]),
        np.datetime64(0, "s"),
        sys.float_info.max,
        int,
        Path("x"),
    ],
)
def test_what_cannot_enter_a_key(value):
    with pytest.raises(LineageError, match="value"):
        canonical(value)


def test_the_fault_names_its_place():
    with pytest.raises(LineageError, match=r"response parameters\.edges\[1\]: NaN"):
        make_key("response", 1, {"edges": [0, float("nan")]})


def test_models_and_dataclasses_are_mappings():
    @dataclass(frozen=True)
    class Grid:
        edges: tuple[float, ...]

    assert canonical(Grid((0.0, 1.0))) == '{"edges":[0,1]}'
    assert json.loads(canonical(ResponseParameters(extent="8 km")))["extent"] == 8000
    assert canonical(ResponseParameters(extent="8 km")) == canonical(ResponseParameters(extent="8000 m"))


def test_every_part_changes_the_key():
    base = {"stage": "s", "version": 1, "tracked": {"a": 1}, "plugins": [{"name": "p"}], "upstream": ["u", "v"]}
    others = [
        base | {"stage": "t"},
        base | {"version": 2},
        base | {"tracked": {"a": 2}},
        base | {"tracked": {"b": 1}},
        base | {"plugins": [{"name": "q"}]},
        base | {"upstream": ["v", "u"]},
        base | {"upstream": ["u"]},
        base | {"mark": "+dirty.0"},
    ]
    digests = {str(make_key(**parts)) for parts in [base, *others]}
    assert len(digests) == len(others) + 1


def test_a_change_far_upstream_reaches_the_end():
    def end(value):
        far = make_key("a", 1, {"x": value})
        return make_key("c", 1, {}, upstream=[make_key("b", 1, {}, upstream=[far])])

    assert str(end(1)) != str(end(2))


def test_document_proves_itself_after_a_round_trip():
    written = json.loads(json.dumps(document(chain())))
    check(written)
    assert sorted(node["stage"] for node in written["nodes"].values()) == ["measurements", "profile", "response"]
    node = next(node for node in written["nodes"].values() if node["stage"] == "measurements")
    assert node["upstream"] == ["a" * 64]
    node["tracked"]["window_x"] = 1.8e-05
    with pytest.raises(LineageError, match="measurements does not follow"):
        check(written)


@pytest.mark.parametrize(
    "damage",
    [
        lambda d: d.update(scheme=2),
        lambda d: d.update(key="0" * 64),
        lambda d: d.pop("nodes"),
        lambda d: next(iter(d["nodes"].values())).pop("tracked"),
        lambda d: d.update(nodes={d["key"]: None}),
    ],
)
def test_damaged_document(damage):
    written = document(chain())
    damage(written)
    with pytest.raises(LineageError):
        check(written)


def test_a_stage_shared_by_two_paths_is_written_once():
    shared = make_key("shared", 1, {})
    top = make_key(
        "top", 1, {}, upstream=[make_key("l", 1, {}, upstream=[shared]), make_key("r", 1, {}, upstream=[shared])]
    )
    assert len(document(top)["nodes"]) == 4


def test_same_key_under_every_hash_seed():
    script = (
        "from coslidar.pipeline.lineage import make_key;"
        "print(make_key('s', 1, {'b': 1.5, 'a': [1, 2], 'c': {'z': 0, 'y': 1}}, upstream=['u']))"
    )
    runs = {
        subprocess.run(
            [sys.executable, "-c", script], env={"PYTHONHASHSEED": seed}, capture_output=True, check=True
        ).stdout
        for seed in ("0", "4242")
    }
    assert len(runs) == 1


def git(folder, *arguments):
    identity = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", "-C", str(folder), *identity, *arguments], check=True, capture_output=True)


@pytest.fixture
def working_copy(tmp_path):
    (tmp_path / "pipeline").mkdir()
    (tmp_path / "pipeline" / "a.py").write_text("x = 1\n")
    (tmp_path / "README.md").write_text("text\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "start")
    return tmp_path


def state(folder):
    # Past the cache, which other tests of this process rely on.
    return checkout.__wrapped__(folder)


def test_checkout_knows_changes_of_the_code_only(working_copy):
    clean = state(working_copy)
    assert len(clean.commit) == 40
    assert clean.mark == ""
    (working_copy / "README.md").write_text("other\n")
    assert state(working_copy) == clean
    (working_copy / "pipeline" / "a.py").write_text("x = 2\n")
    second = state(working_copy)
    (working_copy / "pipeline" / "a.py").write_text("x = 3\n")
    third = state(working_copy)
    assert second.mark.startswith("+dirty.")
    assert second.mark != third.mark
    git(working_copy, "checkout", "-q", ".")
    (working_copy / "pipeline" / "new.py").write_text("")
    assert state(working_copy).mark.startswith("+dirty.")


def test_checkout_never_fails(tmp_path, working_copy, monkeypatch):
    stranger = tmp_path / "site-packages"
    (stranger / "pipeline").mkdir(parents=True)
    (stranger / "pipeline" / "a.py").write_text("")
    assert str(state(stranger)) == ""  # inside somebody's repository, but not of it
    assert str(state(tmp_path / "nowhere")) == ""
    monkeypatch.setenv("PATH", "")
    assert str(state(working_copy)) == ""


def test_scheme_is_part_of_the_key(monkeypatch):
    before = str(make_key("s", 1, {}))
    monkeypatch.setattr(lineage, "SCHEME", 2)
    assert str(make_key("s", 1, {})) != before
