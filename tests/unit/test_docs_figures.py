"""The pages on products and on the paper's figures say what is there."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
from click.testing import CliRunner

from coslidar.catalog.report import BATCH_PANELS, TIME_PANELS
from coslidar.flows.commands.export import export
from coslidar.pipeline.products import COORDINATES, SCHEMA

DOCS = Path(__file__).resolve().parents[2] / "docs"
FIGURES = (DOCS / "figures.md").read_text("utf-8")
PRODUCTS = (DOCS / "products.md").read_text("utf-8")


def script(name: str) -> ModuleType:
    specification = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    return module


def test_every_figure_and_table_of_the_paper_has_a_row() -> None:
    rows = re.findall(r"^\| (Fig\. \d+|Table \d+) \|", FIGURES, re.MULTILINE)
    assert sorted(rows) == sorted([f"Fig. {n}" for n in range(1, 20)] + ["Table 1"])


def test_pictures_are_there_small_and_described() -> None:
    shown = re.findall(r"!\[([^\]]*)\]\(([^)]*)\)", FIGURES)
    assert {path for _, path in shown} == {f"figures/{path.name}" for path in (DOCS / "figures").glob("paper-*.png")}
    for words, path in shown:
        assert len(words) > 60, path
        assert (DOCS / path).stat().st_size < 150_000
    made = script("paper_figures").PANELS
    assert {f"figures/{name}.png" for name in made} | {"figures/paper-16-19-appendix.png"} == {p for _, p in shown}


def test_panels_named_on_the_page_exist() -> None:
    panels = {panel.key for panel in (*BATCH_PANELS, *TIME_PANELS)}
    assert {panel for _, panel in script("paper_figures").PANELS.values()} <= panels
    rows = [line for line in FIGURES.splitlines() if line.startswith("| Fig.")]
    named = {name for row in rows for name in re.findall(r"`([a-z_]+)`", row)}
    assert named
    assert named <= panels


def test_anchors_of_the_page_exist() -> None:
    headings = {
        re.sub(r"[^a-z0-9 -]", "", line[3:].lower()).replace(" ", "-")
        for line in FIGURES.splitlines()
        if line.startswith("## ")
    }
    assert set(re.findall(r"\(#([^)]*)\)", FIGURES)) <= headings


def test_every_variable_is_listed_with_dimensions_unit_and_meaning() -> None:
    """The table that the page on products refers to is made from the schema; this reads it back."""
    assert "(reference/variables.md)" in PRODUCTS
    sys.path.insert(0, str(DOCS))
    try:
        page = script("generate").variables()
    finally:
        sys.path.remove(str(DOCS))
    for name, variable in (COORDINATES | SCHEMA).items():
        row = f"| `{name}` | {', '.join(variable.dims)} | {variable.unit} | {variable.dtype} | {variable.long_name} |"
        assert row in page, name


def test_variables_and_formats_of_the_page_exist() -> None:
    for name in re.findall(r'product\["(\w+)"\]', PRODUCTS):
        assert name in SCHEMA
    formats = re.findall(r"^\| `(\w+)` \|", PRODUCTS, re.MULTILINE)
    words = " ".join(CliRunner().invoke(export, ["--help"], terminal_width=200).output.split())
    assert f"[{'|'.join(formats)}]" in words
    for option in set(re.findall(r"(?<![-\w])--[a-z][a-z-]+", PRODUCTS)):
        assert option in words, option


@pytest.mark.parametrize("page", ["figures.md", "products.md"])
def test_links_lead_somewhere(page: str) -> None:
    text = (DOCS / page).read_text("utf-8")
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", text):
        # Pages below reference/ are made from the code when the documentation is built.
        assert (DOCS / target).exists() or target.startswith("reference/"), target
