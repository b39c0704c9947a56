"""Reference pages made from the code, so that they cannot say anything else than it does.

``python docs/generate.py FOLDER`` writes them; the documentation's build does the same into ``docs/reference``.
"""

from __future__ import annotations

import sys
import types
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

import annotated_types
import click
import code_map
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from coslidar.flows import settings
from coslidar.flows.cli import COMMANDS, cli
from coslidar.pipeline import products
from coslidar.pipeline.extraction import FLAGS
from coslidar.pipeline.parameters import Configuration, Header
from coslidar.pipeline.units import Quantity
from coslidar.plugins import registry

#: Modules whose public names are the programming interface, with the line that introduces each group.
INTERFACE = {
    "Catalogs, archives and products": (
        "coslidar.catalog",
        "coslidar.catalog.store",
        "coslidar.catalog.archive_writer",
    ),
    "Plugins": ("coslidar.plugins.contract", "coslidar.plugins.registry", "coslidar.plugins.conformance"),
    "The stages": (
        "coslidar.pipeline.geometry",
        "coslidar.pipeline.correlation",
        "coslidar.pipeline.convergence",
        "coslidar.pipeline.response",
        "coslidar.pipeline.inversion",
        "coslidar.pipeline.uncertainty",
        "coslidar.pipeline.turbulence",
        "coslidar.pipeline.units",
    ),
    "From optics to fluxes": (
        "coslidar.catalog.series",
        "coslidar.pipeline.timeseries",
        "coslidar.pipeline.comparison",
        "coslidar.pipeline.scintillometer",
        "coslidar.pipeline.air",
        "coslidar.pipeline.surface_layer",
        "coslidar.pipeline.terrain",
        "coslidar.pipeline.optical_parameters",
    ),
    "Runs": ("coslidar.flows.settings", "coslidar.flows.run"),
    "Figures": ("coslidar.catalog.report",),
}
_SETTINGS = """# Settings

A campaign file is TOML. `coslidar init DIR` writes one, and `--set table.key=value` replaces any key of it on the
command line. A quantity is text with its unit (`"3 min"`, `"7 cm"`); a bare number is refused. Every fault of a file is
told at once.
"""
_HEADER = """# Header of a raw archive

Attributes of the zarr group of a recording ([](../archive.md) is the whole format), and, for `coslidar ingest`, the
header file. Quantities are text with their unit; unknown keys are kept and handed on.
"""
_FLAGS = """# Flags

`quality_flag` of a batch is the sum of the bits that are raised, `quality_level` the worst level among them: 0 good, 1
usable with care, 2 bad. [](../checks.md) says what each check measures.

## Of a batch
"""
_SPOT_FLAGS = """## Of a spot

Within a batch every slope and flux carries one of its own; what is flagged is NaN and enters nothing.
"""
_VARIABLES = """# Variables of a product

A product is one archive under one set of settings: a zarr group (format v3) in one zip file, opened by
`coslidar.catalog.open_product` as an xarray Dataset. What a batch does not have is NaN.

## Coordinates
"""
_PYTHON = """# Python

There is no module `coslidar` itself: it is four packages. Names that begin with an underscore, and modules that are not
listed here, may change without notice.
"""
_BOUNDS = {
    annotated_types.Gt: ("gt", "> {}"),
    annotated_types.Ge: ("ge", "≥ {}"),
    annotated_types.Lt: ("lt", "< {}"),
    annotated_types.Le: ("le", "≤ {}"),
}
_PLAIN = {float: "number", int: "whole number", str: "text", bool: "true or false"}


def _cell(text: object) -> str:
    return " ".join(str(text).split()).replace("|", "\\|")


def _table(heading: list[str], rows: list[list[str]]) -> str:
    lines = [heading, ["---"] * len(heading), *([_cell(cell) for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _kind(annotation: Any, metadata: list[Any]) -> str:
    """What a value must be, in words: its unit, choices, length."""
    for mark in metadata:
        if isinstance(mark, Quantity):
            other = f", or an angle ({mark.alternative})" if mark.alternative else ""
            return f"quantity in {mark.unit}{other}"
    origin = get_origin(annotation)
    if origin is typing.Annotated:
        base, *marks = get_args(annotation)
        return _kind(base, marks)
    if origin is typing.Literal:
        return ", ".join(f'`"{choice}"`' for choice in get_args(annotation))
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_kind(part, []) for part in get_args(annotation) if part is not type(None))
    if origin in (tuple, list):
        parts = [part for part in get_args(annotation) if part is not Ellipsis]
        if Ellipsis in get_args(annotation):
            return f"list: {_kind(parts[0], [])}"
        return "[" + ", ".join(_kind(part, []) for part in parts) + "]"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table, see below"
    return _PLAIN.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _bounds(metadata: list[Any]) -> str:
    found = [
        form.format(f"{getattr(mark, name):g}")
        for mark in metadata
        for kind, (name, form) in _BOUNDS.items()
        if isinstance(mark, kind)
    ]
    return ", ".join(found)


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    value = field.default
    if value is None or value is PydanticUndefined or value == ():
        return "absent"
    return f'`"{value}"`' if isinstance(value, str) else f"`{value}`"


def _fields(model: type[BaseModel]) -> str:
    rows = []
    for name, field in model.model_fields.items():
        kind, bounds = _kind(field.annotation, field.metadata), _bounds(field.metadata)
        rows.append([f"`{name}`", f"{kind}, {bounds}" if bounds else kind, _default(field), field.description or ""])
    return _table(["key", "value", "default", "what"], rows)


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)


def _first(text: str | None) -> str:
    return (text or "").strip().partition("\n\n")[0].replace("\n", " ")


def _table_of(key: str, model: type[BaseModel], level: str = "##") -> Iterator[str]:
    """A section for a table of a file, and one for each table in it."""
    yield f"{level} `[{key}]`\n\n{_first(model.__doc__)}\n\n{_fields(model)}"
    for name, field in model.model_fields.items():
        for inner in dict.fromkeys(_models(field.annotation)):
            yield from _table_of(f"{key}.{name}", inner, level + "#")


def configuration() -> str:
    """Every key of a campaign file."""
    top = [
        ["`campaign`", "name", "absent", "Name that every archive must carry; any is accepted where it is absent."],
        ["`archives`", "list: path, pattern or URL", "absent", "Recordings, relative to the file."],
        ["`output`", "path", '`"results"`', "Folder of the catalog, relative to the file."],
        ["`preset`", ", ".join(f'`"{name}"`' for name in settings.PRESETS), "absent",
         "Settings that stand below those of the file."],
    ]  # fmt: skip
    parts = [
        _SETTINGS,
        _table(["key", "value", "default", "what"], top),
    ]  # fmt: skip
    for key, field in Configuration.model_fields.items():
        parts += _table_of(key, field.annotation)  # type: ignore[arg-type]
    parts += _table_of("run", settings.RunParameters)
    names = ", ".join(f"`[{key}]`" for key in settings.HEADER_TABLES)
    parts.append(
        f"## Tables of the header\n\n{names} replace or complete keys of the archives' headers: [](header.md).\n"
    )
    parts.append("## Plugins\n\nEach of these tables has the `name` of a plugin, and its parameters.\n")
    for key, kind in registry.KEYS.items():
        default = settings.DEFAULT_PLUGINS[key]["name"]
        parts.append(f'### `[{key}]`: {kind}\n\nDefault: `name = "{default}"`.\n')
        for name, entry in sorted(registry.entries(kind).items()):
            if entry.distribution.split()[0] != "coslidar":
                continue
            model = entry.load()
            parts.append(f"#### {name}\n\n{_first(model.__doc__)}\n")
            if model.model_fields:
                parts.append(_fields(model))
    for name, preset in settings.PRESETS.items():
        rows = [[f"`{table}.{key}`", f"`{value}`"] for table, values in preset.items() for key, value in values.items()]
        parts.append(f'## `preset = "{name}"`\n\n{_table(["key", "value"], rows)}')
    return "\n".join(parts)


def header() -> str:
    """Every key of a raw archive's header."""
    parts = [
        _HEADER,
        _fields(Header),
    ]  # fmt: skip
    for name, field in Header.model_fields.items():
        for model in dict.fromkeys(_models(field.annotation)):
            parts += _table_of(name, model)
    return "\n".join(parts)


def flags() -> str:
    """What marks a batch or a spot."""
    levels = ("good", "usable with care", "bad")
    batch = [
        [f"`{name}`", str(bit), levels[level], meaning]
        for name, (bit, level, meaning) in products.QUALITY_FLAGS.items()
    ]
    spot = [[f"`{name}`", str(bit)] for name, bit in FLAGS.items()]
    return "\n".join(
        [
            _FLAGS,
            _table(["flag", "bit", "level", "meaning"], batch),
            _SPOT_FLAGS,
            _table(["flag", "bit"], spot),
        ]
    )


def variables() -> str:
    """Variables of a product."""

    def rows(schema: dict[str, products.Variable]) -> list[list[str]]:
        return [
            [f"`{item.name}`", ", ".join(item.dims), item.unit, item.dtype, item.long_name] for item in schema.values()
        ]

    heading = ["variable", "dimensions", "unit", "type", "what"]
    return "\n".join(
        [
            _VARIABLES,
            _table(heading, rows(products.COORDINATES)),
            "## Variables\n",
            _table(heading, rows(products.SCHEMA)),
        ]
    )


def _command(command: click.Command, path: str, level: str) -> Iterator[str]:
    context = click.Context(command, info_name=path)
    usage = command.get_usage(context).removeprefix("Usage: ")
    yield f"{level} {path}\n\n```text\n{usage}\n```\n\n{_prose(command.help)}\n"
    rows = []
    for parameter in command.get_params(context):
        if isinstance(parameter, click.Option) and not parameter.hidden and parameter.name != "help":
            record = parameter.get_help_record(context)
            if record is not None:
                rows.append([f"`{record[0]}`", record[1]])
    if rows:
        yield _table(["option", "what"], rows)
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            inner = command.get_command(context, name)
            if inner is not None and not inner.hidden:
                yield from _command(inner, f"{path} {name}", level + "#")


def _prose(text: str | None) -> str:
    """Help as paragraphs; what click keeps as it is (after a backspace) becomes a block."""
    parts = []
    for paragraph in "\n".join(line.strip() for line in (text or "").splitlines()).split("\n\n"):
        parts.append(f"```text\n{paragraph[1:].strip()}\n```" if paragraph.startswith("\b") else paragraph)
    return "\n\n".join(parts)


def commands() -> str:
    """The command line."""
    parts = [
        f"# Command line\n\n{_prose(cli.help)}\n",
        _table(["command", "what"], [[f"[`{name}`](#coslidar-{name})", line] for name, (_, line) in COMMANDS.items()]),
    ]
    context = click.Context(cli, info_name="coslidar")
    for name in COMMANDS:
        command = cli.get_command(context, name)
        assert command is not None
        parts += _command(command, f"coslidar {name}", "##")
    return "\n".join(parts)


def interface() -> str:
    """The programming interface; the text is in the docstrings."""
    parts = [_PYTHON]
    for group, modules in INTERFACE.items():
        parts.append(f"## {group}\n")
        parts += [f"### {module}\n\n```{{eval-rst}}\n.. automodule:: {module}\n```\n" for module in modules]
    return "\n".join(parts)


PAGES: dict[str, Callable[[], str]] = {
    "commands": commands,
    "configuration": configuration,
    "header": header,
    "flags": flags,
    "variables": variables,
    "python": interface,
    "code-map": code_map.page,
}


def write(folder: Path) -> None:
    """Write every page, and the map of the code, whose text has changed."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in PAGES.items():
        _update(folder / f"{name}.md", make())
    _update(folder / "code-map.svg", code_map.picture())


def _update(path: Path, text: str) -> None:
    if not path.is_file() or path.read_text("utf-8") != text:
        path.write_text(text, "utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
