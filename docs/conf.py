"""Configuration of the documentation: `make docs` builds it, without network and with warnings as errors."""

from __future__ import annotations

import sys
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import generate

project = "coslidar"
author = "the coslidar developers"
version = release = version_of("coslidar")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "equations"]
exclude_patterns = ["_build", "decisions/template.md"]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3
myst_dmath_allow_space = False
myst_dmath_allow_digits = False
highlight_language = "text"
nitpicky = False

html_theme = "furo"
html_title = "coslidar"
html_static_path = ["_static"]
html_css_files = ["equations.css"]
html_copy_source = False
html_show_sphinx = False
html_last_updated_fmt = None

autodoc_default_options = {"members": True, "show-inheritance": True, "exclude-members": "model_config"}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_class_signature = "separated"
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
# Docstrings put names between single backticks.
default_role = "code"
# Docstrings are checked by ruff (numpydoc); their formulas are plain text, in which reStructuredText sees markup.
suppress_warnings = ["docutils", "ref.python"]

#: Sections of the front page, and the pages in them where they are there. What is not named here stands under "More".
SECTIONS = {
    "First steps": ["tutorial"],
    "How to": ["howto/own-instrument", "ingest", "howto/reprocessing", "howto/cluster", "howto/scintillometers",
               "plugins", "experiment", "figures"],
    "Reference": ["reference/commands", "reference/configuration", "reference/header", "archive", "products",
                  "reference/variables", "reference/flags", "catalog", "reference/python"],
    "Explanation": ["method", "resolution", "response", "extraction", "fluxes", "checks", "validation", "performance"],
    "For contributors": ["contributing", "reference/code-map", "decisions/index"],
}  # fmt: skip


def _toctrees() -> str:
    present = {
        str(path.relative_to(HERE).with_suffix(""))
        for path in HERE.rglob("*.md")
        if not path.is_relative_to(HERE / "_build") and path.stem != "index"
    } | {f"reference/{name}" for name in generate.PAGES}
    if (HERE / "decisions" / "index.md").is_file():
        present.add("decisions/index")
    named = {name for names in SECTIONS.values() for name in names}
    more = sorted(name for name in present - named if "/" not in name)
    text = []
    for title, names in {**SECTIONS, "More": more}.items():
        here = [name for name in names if name in present]
        if here:
            text.append("\n".join(["```{toctree}", f":caption: {title}", ":hidden:", "", *here, "```\n"]))
    return "\n".join(text)


def _fill_front_page(app: Any, name: str, source: list[str]) -> None:
    if name == "index":
        source[0] = source[0].replace("<!-- pages -->", _toctrees())


def setup(app: Any) -> None:
    """Make what is made from the code, and find all pages."""
    generate.write(HERE / "reference")
    app.connect("source-read", _fill_front_page)
    # The front page changes with the list of pages, not with its own text.
    app.connect("env-get-outdated", lambda *_: ["index"])
