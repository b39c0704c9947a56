"""The page for plugin authors is executed, and what it and the README list is what is there."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

from coslidar.pipeline import lineage, units
from coslidar.plugins import conformance, registry

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "plugins.md").read_text("utf-8")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
FILE = re.compile(r"# ([\w.-]+/[\w./-]+)\n")


def table(text: str, header: str) -> list[list[str]]:
    """Cells of the table whose header line begins with `header`."""
    lines = text[text.index(f"| {header} |") :].splitlines()[2:]
    rows = [
        line.strip("| ").split(" | ") for line in lines[: next(i for i, x in enumerate([*lines, ""]) if x[:1] != "|")]
    ]
    return [[cell.strip() for cell in row] for row in rows]


def builds_offline() -> bool:
    """Whether pip can build the page's distribution with what is installed here, and needs no package index."""
    try:
        return tuple(int(part) for part in version("setuptools").split(".")[:2]) >= (70, 1)
    except (PackageNotFoundError, ValueError):
        return False


def test_every_block_is_a_file_or_typed() -> None:
    assert [kind for kind, body in BLOCKS if not (kind == "sh" or FILE.match(body))] == []
    assert [FILE.match(body)[1] for kind, body in BLOCKS if kind != "sh"] == [  # type: ignore[index]
        "my-prior/pyproject.toml",
        "my-prior/my_prior.py",
        "my-prior/test_my_prior.py",
        "my-campaign/campaign.toml",
    ]


@pytest.mark.slow
def test_the_page_works_from_an_empty_folder(tmp_path: Path) -> None:
    """As it stands, but that pip installs beside this environment instead of into it."""
    work, site, pip = tmp_path / "work", tmp_path / "site", tmp_path / "bin" / "pip"
    work.mkdir()
    pip.parent.mkdir()
    options = f"--no-deps --target '{site}'" + " --no-build-isolation" * builds_offline()
    pip.write_text(f"#!/bin/sh\nexec '{sys.executable}' -m pip --disable-pip-version-check \"$@\" {options}\n")
    pip.chmod(0o755)
    environment = {
        **os.environ,
        "PATH": os.pathsep.join([str(pip.parent), str(Path(sys.executable).parent), os.environ["PATH"]]),
        "PYTHONPATH": str(site),
    }

    def shell(commands: str) -> str:
        done = subprocess.run(["bash", "-e", "-c", commands], cwd=work, env=environment, capture_output=True, text=True)
        if "No matching distribution found for setuptools" in done.stderr:
            pytest.skip("pip finds no package index to take setuptools from, and setuptools>=70.1 is not installed")
        assert done.returncode == 0, f"{commands}\n{done.stdout}\n{done.stderr}"
        return done.stdout + (done.stderr if "coslidar run" in commands else "")

    code = lineage.checkout.__wrapped__()
    said = []
    for kind, body in BLOCKS:
        if kind == "sh":
            said.append(shell(body))
        elif found := FILE.match(body):
            (work / found[1]).parent.mkdir(exist_ok=True)
            (work / found[1]).write_text(body)

    described, checked, tested, _, first, second = said
    assert "regulariser 'calm_far_away', version 1, from my-prior 1.0" in described
    assert "length  (unit m, default '1 km')  Distance at which" in described
    assert re.search(r"my-prior 1\.0: 1 plugin, \d+ checks passed, 0 failed, 0 exempt$", checked.strip())
    assert re.search(r"^\d+ passed in", tested.strip().splitlines()[-1])
    assert "1 product in my-campaign/results" in first
    assert "2 products in my-campaign/results" in second
    assert " 1420 frames read" in first
    # An uncommitted change of the code is part of every key: edits made while this runs leave nothing to reuse.
    if lineage.checkout.__wrapped__().mark == code.mark:
        assert " 0 frames read" in second
    shown = json.loads(shell("coslidar catalog show uniform --out my-campaign/results --json"))
    made_of = json.dumps(shown["attributes"]["lineage"])
    assert '"calm_far_away"' in made_of
    assert '"length": 2000' in made_of
    assert max(shown["cn2"][0]) > 0


def test_the_page_lists_the_kinds() -> None:
    expected = [
        [kind, f"`{group}`", f"`{base.__name__}`", f"`[{conformance.KEYS_OF[kind]}]`"]
        for kind, (group, base) in registry.KINDS.items()
    ]
    assert table(PAGE, "kind") == expected
    for _, base in registry.KINDS.values():
        assert all(f"`{base.__name__}.{method}(self" in PAGE for method in base.__abstractmethods__)


def test_the_page_lists_the_types_of_units() -> None:
    listed = {name.strip("`"): row[1] for row in table(PAGE, "type") for name in row[0].split(", ")}
    types = {
        name: alias.__metadata__[0].unit
        for name, alias in vars(units).items()
        if isinstance(getattr(alias, "__metadata__", (None,))[0], units.Quantity)
    }
    assert listed == types


def test_the_page_lists_the_checks() -> None:
    checks = {check.name: check for kind in conformance.CHECKS.values() for check in kind}
    checks[conformance.EXAMPLES.name] = conformance.EXAMPLES
    assert {row[0].strip("`"): row[1] for row in table(PAGE, "check")} == {
        name: check.promise for name, check in checks.items()
    }


def test_the_readme_lists_what_is_built_in() -> None:
    """In the order in which pyproject.toml registers it."""
    import tomllib

    points = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["entry-points"]
    expected = [
        [kind, f"`[{conformance.KEYS_OF[kind]}]`", ", ".join(points[group])]
        for kind, (group, _) in registry.KINDS.items()
    ]
    assert table((ROOT / "README.md").read_text("utf-8"), "kind") == expected
    for kind, (group, _) in registry.KINDS.items():
        installed = registry.entries(kind)
        shipped = {name for name, entry in installed.items() if entry.distribution.split()[0] == "coslidar"}
        assert shipped == set(points[group]), "the installed coslidar is older than pyproject.toml: pip install -e ."
