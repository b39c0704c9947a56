"""The walls between the packages, read from the source without importing it."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("pipeline", "plugins", "catalog", "flows")
#: Package -> packages of ours that it may import.
ALLOWED = {
    "pipeline": {"pipeline"},
    "plugins": {"plugins", "pipeline"},
    "catalog": {"catalog", "pipeline"},
    "flows": {"flows", "pipeline", "plugins", "catalog"},
}
#: Library -> where alone it may be imported.
OWNERS = {
    "dask": ("flows/",),
    "distributed": ("flows/",),
    "prefect": ("flows/",),
    "zarr": ("catalog/",),
    "numcodecs": ("catalog/",),
    "xarray": ("catalog/",),
    "sqlalchemy": ("catalog/",),
    "pint": ("pipeline/units.py",),
    "click": ("flows/",),
    "rich": ("flows/",),
    "matplotlib": ("catalog/report/",),
    "jinja2": ("catalog/report/", "flows/browser/"),
    "starlette": ("flows/browser/",),
    "uvicorn": ("flows/browser/", "flows/server.py"),
}
#: Prefect is wired in one module, with its pages and its schedules beside it; the driver knows nothing of it.
PREFECT = {"flows/campaign.py", "flows/artifacts.py", "flows/cancelling.py", "flows/deployment.py", "flows/server.py"}

FILES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def imports(path: Path) -> list[tuple[int, str]]:
    """(line, module) of every import, relative ones resolved to 'pipeline.x' form."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    found = []
    tree = ast.parse(path.read_text("utf-8"))
    # A type that is only named does not depend on its library when the program runs.
    named = {id(inner) for node in ast.walk(tree) if _for_types(node) for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            if id(node) in named:
                continue
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                base = package[: len(package) - node.level + 1]
                module = ".".join((*base, *filter(None, [node.module])))
                # `from ..pipeline import x` from the top of the tree leaves an empty base.
                names = [f"{module}.{alias.name}" if module else alias.name for alias in node.names]
                found += [(node.lineno, name) for name in names]
            elif id(node) not in named:
                found.append((node.lineno, node.module or ""))
    return found


def _for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_walls(path: Path) -> None:
    relative = path.relative_to(ROOT).as_posix()
    package = relative.split("/")[0]
    faults = []
    for line, module in imports(path):
        top = module.split(".")[0]
        if top in ALLOWED and top not in ALLOWED[package]:
            faults.append(f"{relative}:{line}: {package} must not import {module}")
        if top == "coslidar":
            faults.append(f"{relative}:{line}: import relatively inside the distribution, not {module}")
        if top in OWNERS and not relative.startswith(OWNERS[top]):
            faults.append(f"{relative}:{line}: {top} belongs to {' and '.join(OWNERS[top])}")
        if top == "prefect" and relative not in PREFECT:
            faults.append(f"{relative}:{line}: prefect belongs to {', '.join(PREFECT)}")
    assert not faults, "\n".join(faults)


def test_relative_imports_are_resolved() -> None:
    """The reader above would pass anything if it resolved nothing."""
    found = {module for path in FILES for _, module in imports(path)}
    assert "pipeline.geometry.SliceGrid" in found
    assert "catalog.archive.open_archive" in found


def test_help_imports_nothing_heavy() -> None:
    """`coslidar --help` must answer at once: none of the slow libraries may be loaded for it."""
    code = (
        "import sys\n"
        "from coslidar.flows.cli import cli\n"
        "try: cli.main(['--help'], standalone_mode=False)\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'numba', 'zarr', 'xarray', 'dask', 'distributed', 'prefect', 'pint',"
        " 'sqlalchemy', 'matplotlib', 'pydantic'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "invert" in done.stdout
