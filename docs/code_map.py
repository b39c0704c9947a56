"""A map of the code in one picture, drawn from the imports."""

from __future__ import annotations

import ast
from functools import lru_cache
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Packages from left to right; arrows of the architecture run to the left.
PACKAGES = ("pipeline", "plugins", "catalog", "flows")
_INTRODUCTION = """# Map of the code

Drawn from the imports. A column is a package, with what others rest on at its top; an arc at the left of a name leads
to a module of its package that it imports, a line to one of another package. Lines only ever run to the left.

![Modules in four columns, pipeline, plugins, catalog and flows, with lines from each to those that it imports; the
tables below say the same](code-map.svg)
"""
_COLOURS = {"pipeline": "#0072b2", "plugins": "#a8487f", "catalog": "#00795a", "flows": "#c24f00"}
_ROW, _TOP, _WIDTH, _LEFT = 18, 60, 330, 110


@lru_cache(1)
def modules() -> dict[str, ast.Module]:
    """Dotted name within the distribution -> syntax tree, without tests and empty modules."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            tree = ast.parse(path.read_text("utf-8"))
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            if parts[-1] != "__init__" or len(tree.body) > 1:
                found[name] = tree
    return found


def imports(name: str) -> set[str]:
    """Modules of ours that a module imports, also within functions and for types only."""
    known = modules()
    package = name.split(".") if (ROOT / name.replace(".", "/")).is_dir() else name.split(".")[:-1]
    found = set()
    for node in ast.walk(known[name]):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1]
            target = ".".join([*base, *(node.module or "").split(".")]).strip(".")
            inner = {f"{target}.{alias.name}" for alias in node.names} & known.keys()
            found |= inner or ({target} & known.keys())
    return found - {name}


def _ordered(package: str) -> list[str]:
    """Modules of a package, those that others rest on first."""
    mine = [name for name in modules() if name.split(".")[0] == package]
    order: list[str] = []

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name in order or name in above:
            return
        for needed in sorted(imports(name)):
            if needed in mine:
                visit(needed, (*above, name))
        order.append(name)

    for name in mine:
        visit(name, ())
    return order


def picture() -> str:
    """The map as SVG: a column per package, arcs within it, lines between packages."""
    columns = {package: _ordered(package) for package in PACKAGES}
    place = {
        name: (_LEFT + number * _WIDTH, _TOP + row * _ROW)
        for number, names in enumerate(columns.values())
        for row, name in enumerate(names)
    }
    height = _TOP + max(map(len, columns.values())) * _ROW + 20
    width = _LEFT + len(PACKAGES) * _WIDTH - 60
    lines, texts = [], []
    for name, (x, y) in place.items():
        package = name.split(".")[0]
        for target in sorted(imports(name)):
            tx, ty = place[target]
            if target.split(".")[0] == package:
                bow = min(12 + abs(ty - y) / 5, 85)
                path = f"M{x - 4},{y - 4} C{x - bow:.0f},{y - 4} {tx - bow:.0f},{ty - 4} {tx - 4},{ty - 4}"
            else:
                end = tx + 6.6 * len(target.partition(".")[2] or target) + 6
                path = f"M{x - 4},{y - 4} C{x - 90},{y - 4} {end + 60:.0f},{ty - 4} {end:.0f},{ty - 4}"
            lines.append(f'<path d="{path}" stroke="{_COLOURS[package]}"/>')
        label = escape(name.partition(".")[2] or name)
        about = escape((ast.get_docstring(modules()[name]) or "").partition("\n")[0])
        texts.append(f'<text x="{x}" y="{y}"><title>{about}</title>{label}</text>')
    heads = [
        f'<text x="{_LEFT + number * _WIDTH}" y="28" font-size="17" font-weight="bold" fill="{_COLOURS[package]}">'
        f"{package}</text>"
        for number, package in enumerate(PACKAGES)
    ]
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"',
        'font-family="sans-serif" font-size="12">',
        "<title>Modules of coslidar and which of them imports which</title>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        '<g fill="none" stroke-width="0.8" stroke-opacity="0.35">', *lines, "</g>",
        '<g fill="#1b1f24">', *texts, "</g>", *heads, "</svg>\n",
    ])  # fmt: skip


def page() -> str:
    """The page with the picture, and the same in words."""
    parts = [_INTRODUCTION]
    for package in PACKAGES:
        parts.append(f"## {package}\n\n| module | what | imports |\n| --- | --- | --- |")
        for name in _ordered(package):
            about = (
                (ast.get_docstring(modules()[name]) or "").partition("\n\n")[0].replace("\n", " ").replace("|", "\\|")
            )
            used = ", ".join(f"`{target}`" for target in sorted(imports(name)))
            parts.append(f"| `{name}` | {about} | {used} |")
        parts.append("")
    return "\n".join(parts)
