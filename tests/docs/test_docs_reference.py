"""Pages made from the code: everything is on them; and the map of the code, and the collection of changes."""

from __future__ import annotations

import importlib.util
import re
import sys
import types
from pathlib import Path

import click
import pytest
from page_blocks import ROOT

from coslidar.flows.cli import COMMANDS, cli
from coslidar.pipeline.parameters import Configuration
from coslidar.pipeline.products import COORDINATES, QUALITY_FLAGS, SCHEMA


def module(path: str) -> types.ModuleType:
    """A module that is no part of the distribution."""
    file = ROOT / path
    spec = importlib.util.spec_from_file_location(f"page_{file.stem}", file)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(file.parent))
    try:
        spec.loader.exec_module(loaded)
    finally:
        sys.path.remove(str(file.parent))
    return loaded


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("reference")
    module("docs/generate.py").write(folder)
    return {path.name: path.read_text() for path in folder.iterdir()}


def rows(page: str, section: str) -> dict[str, list[str]]:
    """Rows of the table below a heading, by their first cell."""
    text = re.split(r"^#+ ", page.partition(f"# {section}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]
    found = [
        [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in text.splitlines() if line[:1] == "|"
    ]
    return {cells[0].strip("`"): cells[1:] for cells in found[2:]}


def test_every_setting_has_its_unit_default_and_meaning(pages: dict[str, str]) -> None:
    for key, table in Configuration.model_fields.items():
        model = table.annotation
        listed = rows(pages["configuration.md"], f"`[{key}]`")
        assert listed.keys() == model.model_fields.keys()  # type: ignore[union-attr]
        for name, (value, default, meaning) in listed.items():
            assert value, f"{key}.{name}"
            assert default, f"{key}.{name}"
            assert meaning, f"{key}.{name}: write a docstring below it"
    assert rows(pages["configuration.md"], "`[batch]`")["duration"][:2] == ["quantity in s, > 0", '`"3 min"`']
    assert "outer_scale" in rows(pages["configuration.md"], "von_karman")


def test_every_flag_and_variable_is_listed(pages: dict[str, str]) -> None:
    assert rows(pages["flags.md"], "Of a batch").keys() == QUALITY_FLAGS.keys()
    assert rows(pages["variables.md"], "Coordinates").keys() == COORDINATES.keys()
    listed = rows(pages["variables.md"], "Variables")
    assert {name: cells[1] for name, cells in listed.items()} == {name: item.unit for name, item in SCHEMA.items()}


def test_every_command_and_option_is_listed(pages: dict[str, str]) -> None:
    page = pages["commands.md"]

    def check(command: click.Command, path: str) -> None:
        assert re.search(rf"^#+ {re.escape(path)}$", page, re.MULTILINE), path
        context = click.Context(command, info_name=path)
        listed = " ".join(rows(page, path))
        for parameter in command.params:
            if isinstance(parameter, click.Option) and not parameter.hidden:
                assert max(parameter.opts, key=len) in listed, f"{path} {parameter.opts}"
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                check(command.get_command(context, name), f"{path} {name}")  # type: ignore[arg-type]

    context = click.Context(cli)
    for name in COMMANDS:
        check(cli.get_command(context, name), f"coslidar {name}")  # type: ignore[arg-type]


def test_help_teaches() -> None:
    """Every command says more than its name, and every option what it does."""
    context = click.Context(cli)

    def check(command: click.Command, path: str) -> list[str]:
        faults = [] if command.help and len(command.help.split()) >= 4 else [f"{path}: say what it does"]
        for parameter in command.params:
            if isinstance(parameter, click.Option) and not (parameter.hidden or parameter.help):
                faults.append(f"{path} {parameter.opts[0]}: say what it is")
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                faults += check(command.get_command(context, name), f"{path} {name}")  # type: ignore[arg-type]
        return faults

    assert [fault for name in COMMANDS for fault in check(cli.get_command(context, name), name)] == []  # type: ignore[arg-type]


def test_the_map_follows_the_imports(pages: dict[str, str]) -> None:
    code = module("docs/code_map.py")
    found = code.modules()
    assert {"pipeline.batch", "catalog.store", "flows.cli", "plugins.registry"} <= found.keys()
    assert "pipeline.parameters" in code.imports("flows.settings")
    assert "plugins.registry" in code.imports("flows.settings")
    assert not any(name.startswith(("catalog", "flows", "plugins")) for one in found for name in code.imports(one)
                   if one.startswith("pipeline"))  # fmt: skip
    picture = pages["code-map.svg"]
    assert picture.count("<path ") == sum(len(code.imports(name)) for name in found)
    assert all(f">{name.partition('.')[2]}</text>" in picture for name in found if "." in name)


def test_changes_are_collected(tmp_path: Path) -> None:
    collect = module("changes/collect.py")
    assert collect.fragments(ROOT / "changes"), "nothing new since the last release?"
    (tmp_path / "b.fixed.md").write_text("Two\nlines.\n")
    (tmp_path / "a.added.md").write_text("New.")
    (tmp_path / "CHANGES").write_text("# Changes\n\n<!-- releases -->\n\n## 0.1 (2026-01-01)\n")
    collect.collect(tmp_path / "CHANGES", tmp_path, "0.2", "2026-02-03")
    assert (tmp_path / "CHANGES").read_text() == (
        "# Changes\n\n<!-- releases -->\n\n## 0.2 (2026-02-03)\n\n### Added\n\n- New.\n\n### Fixed\n\n- Two\n  lines.\n"
        "\n## 0.1 (2026-01-01)\n"
    )
    assert list(tmp_path.glob("*.md")) == []
    (tmp_path / "c.wrong.md").write_text("x")
    (tmp_path / "d.md").write_text("x")
    with pytest.raises(ValueError, match=r"c\.wrong\.md, d\.md"):
        collect.fragments(tmp_path)
