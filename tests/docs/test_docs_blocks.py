"""Every code block of the documentation is executed; tests/page_blocks.py says how."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from page_blocks import LANGUAGES, ROOT, Block, Runner, blocks, differs, environment, session

from coslidar.flows.cli import cli

#: Pages whose blocks another test executes, because they need more than the tutorial made.
ELSEWHERE = {
    "docs/plugins.md": "tests/unit/test_docs_plugins.py",
    "docs/ingest.md": "tests/docs/test_docs_ingest.py",
    "docs/fluxes.md": "tests/docs/test_docs_fluxes.py",
}
#: Pages that are executed among the quick tests; all others, also new ones, are slow.
QUICK = ("README.md", "docs/howto/reprocessing.md", "docs/resolution.md", "docs/archive.md")
TUTORIAL = ROOT / "docs" / "tutorial.md"


def pages() -> list[str]:
    """Pages with blocks, by name; what is made from the code or built has none to execute."""
    found = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGES.md")] + sorted(
        (ROOT / "docs").rglob("*.md")
    )
    made = (ROOT / "docs" / "reference", ROOT / "docs" / "_build")
    return [
        str(page.relative_to(ROOT))
        for page in found
        if page.is_file() and not any(page.is_relative_to(x) for x in made)
    ]


PAGES = pages()


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("docs-cache")


@pytest.fixture(scope="session")
def tutorial(tmp_path_factory: pytest.TempPathFactory, home: Path) -> Path:
    """The tutorial, walked through from an empty folder; what it made is there for the other pages."""
    folder = tmp_path_factory.mktemp("tutorial")
    runner = Runner(folder, environment(home))
    for block in blocks(TUTORIAL):
        runner.run(block)
    return folder


@pytest.fixture
def folder(tutorial: Path, tmp_path: Path) -> Iterator[Path]:
    """A folder for one page, with a copy of what the tutorial made and the checkout's environment."""
    for item in tutorial.iterdir():
        (shutil.copytree if item.is_dir() else shutil.copy2)(item, tmp_path / item.name)
    (tmp_path / ".venv").symlink_to(sys.prefix)
    yield tmp_path
    shutil.rmtree(tmp_path, ignore_errors=True)


def test_the_tutorial_works_from_an_empty_folder(tutorial: Path) -> None:
    assert (tutorial / "demo" / "results" / "catalog.sqlite").is_file()


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(name, id=name, marks=[] if name in QUICK else [pytest.mark.slow])
        for name in PAGES
        if name not in ELSEWHERE
        and name != "docs/tutorial.md"
        and any(b.language != "text" for b in blocks(ROOT / name))
    ],
)
def test_blocks_of_a_page(page: str, folder: Path, home: Path) -> None:
    runner = Runner(folder, environment(home))
    for block in blocks(ROOT / page):
        if "make" in block.words:
            continue  # make demo, make test: what CI does in a clean checkout
        if "long" in block.words:
            check_options(block)  # hours, or data that are not everybody's
            continue
        try:
            runner.run(block)
        except AssertionError as error:
            raise AssertionError(f"{page}, line {block.line}:\n{error}") from None


def check_options(block: Block) -> None:
    """Commands that take too long to be executed: they and their options are at least there."""
    for line in block.body.replace("\\\n", " ").splitlines():
        program, *words = shlex.split(line, comments=True) or [""]
        if program != "coslidar":
            continue
        command: click.Command = cli
        while isinstance(command, click.Group) and words:
            found = command.get_command(click.Context(command), words.pop(0))
            assert found is not None, f"line {block.line}: there is no such command: {line}"
            command = found
        known = {name for parameter in command.params for name in parameter.opts}
        unknown = [word for word in words if word.startswith("-") and word.partition("=")[0] not in known]
        assert not unknown, f"line {block.line}: there are no options {unknown}: {line}"


@pytest.mark.parametrize("page", PAGES)
def test_every_block_says_what_it_is(page: str) -> None:
    """A block of unknown language would not be executed, and nobody would notice."""
    unknown = [
        f"line {block.line}: '{block.language}'" for block in blocks(ROOT / page) if block.language not in LANGUAGES
    ]
    assert not unknown, f"{page}: write console, sh, python, pycon, toml, json or text behind the fence: {unknown}"
    for block in blocks(ROOT / page):
        if block.language == "text":
            hidden = re.findall(r"^(?:\$ )?coslidar \w+.*|^>>> .*", block.body, re.MULTILINE)
            # Usage lines have placeholders in capitals or brackets; they are no commands.
            hidden = [line for line in hidden if not re.search(r"\b[A-Z]{3,}\b|\[|…", line)]
            assert not hidden, f"{page}, line {block.line}: these are commands, write console or sh: {hidden}"


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    text = re.sub(r"^ *```.*?^ *```$|`[^`]*`", "", (ROOT / page).read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        path = target.partition("#")[0]
        if re.match(r"[a-z]+:", target) or not path:
            continue
        where = (ROOT / page).parent / path
        made = "reference/" in path and (ROOT / "docs" / "generate.py").read_text().count(f'"{where.stem}":') == 1
        assert where.exists() or made, f"{page}: the link {target} leads nowhere"


def test_pages_executed_elsewhere_are() -> None:
    for page, test in ELSEWHERE.items():
        assert Path(page).stem in (ROOT / test).read_text(), f"{test} does not execute {page}"


def test_the_comparison_can_fail() -> None:
    shown = "8 of 8 archives\n...\nr0 10.5 cm, key 0123456789abcdef"
    assert differs("8 of 8 archives\nsomething\nr0 11.5 cm, key fedcba9876543210\n", shown) is None
    assert differs("8 of 8 archives\nr0 17.5 cm, key fedcba9876543210\n", shown) == "r0 10.5 cm, key 0123456789abcdef"
    assert differs("8 of 8 recordings\nr0 10.5 cm, key fedcba9876543210\n", shown) == "8 of 8 archives"
    assert differs("a\nb\n", "a") == "(nothing more; the program went on with: b)"
    assert differs("", "a") == "a"
    assert list(session("$ one \\\n  two\nsaid\n$ three\n")) == [("one \\\n  two", "said"), ("three", "")]
    check_options(Block("sh", ("long",), "coslidar run a.toml --no-prefect  # --nothing\n", 1))
    with pytest.raises(AssertionError, match="--nothing"):
        check_options(Block("sh", ("long",), "coslidar run a.toml --nothing\n", 1))
    assert Block("python", (), "# my/file.py\nx = 1\n", 1).file == "my/file.py"
    assert Block("python", (), "# a comment\nx = 1\n", 1).file is None
