"""Every code block of the documentation is executed; tests/page_blocks.py says how."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import catalogs
import click
import numpy as np
import page_blocks
import pytest
from page_blocks import LANGUAGES, ROOT, Block, Runner, blocks, differs, environment, session

from coslidar.catalog import open_archive
from coslidar.flows.cli import cli

#: Pages whose blocks another test executes, because they need more than the tutorial made.
ELSEWHERE = {
    "docs/plugins.md": "tests/unit/test_docs_plugins.py",
    "docs/ingest.md": "tests/docs/test_docs_ingest.py",
    "docs/fluxes.md": "tests/docs/test_docs_fluxes.py",
}
#: Pages that are executed among the quick tests; all others, also new ones, are slow.
QUICK = ("README.md", "docs/howto/reprocessing.md", "docs/resolution.md", "docs/archive.md")
#: The wave-optics recording, where there is one.
SAMPLE = ROOT.parent / "shared" / "data" / "lannemezan-sample.zarr.zip"
#: The server that pages name.
SERVER = "postgresql://me@server/coslidar"
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


def executed() -> list[object]:
    """Every page with something to execute; pages among the quick tests once more if they have long blocks."""
    found = []
    for name in PAGES:
        here = blocks(ROOT / name)
        if name in ELSEWHERE or name == "docs/tutorial.md" or not any(b.language != "text" or b.file for b in here):
            continue
        quick = name in QUICK
        found += [pytest.param(name, not quick, id=name, marks=[] if quick else [pytest.mark.slow])]
        if quick and any(block.long for block in here):
            found += [pytest.param(name, True, id=f"{name}-long", marks=[pytest.mark.slow])]
    return found


@pytest.mark.parametrize(("page", "long"), executed())
def test_blocks_of_a_page(page: str, long: bool, folder: Path, home: Path) -> None:
    runner = Runner(folder, environment(home))
    left_out = []
    with ExitStack() as stack:
        for block in blocks(ROOT / page):
            if "make" in block.words or (block.long and not long):
                continue  # make: test_targets_are_what_ci_does
            try:
                runner.run(supplied(block, folder, stack))
            except AssertionError as error:
                raise AssertionError(f"{page}, line {block.line}:\n{error}") from None
            except LookupError as error:
                left_out.append(f"{page}, line {block.line}: {error.args[0]}")
    if left_out:
        pytest.skip("all others are executed; " + "; ".join(left_out))


def supplied(block: Block, folder: Path, stack: ExitStack) -> Block:
    """The block, with what is its reader's own put beside it or in its place.

    Raises
    ------
    LookupError
        It cannot be had here; says what.
    """
    if "FRAMES" in block.body and not (folder / "FRAMES.fits").is_file():
        as_fits(folder / "demo" / "raw" / "2012-09-14T1715.zarr.zip", folder)
    if SAMPLE.name in block.body and not (folder / SAMPLE.name).exists():
        if not SAMPLE.is_file():
            raise LookupError(f"no {SAMPLE}, which is not part of the distribution")
        (folder / SAMPLE.name).symlink_to(SAMPLE)
    if SERVER in block.body:
        if not catalogs.SERVER:
            raise LookupError("COSLIDAR_TEST_POSTGRESQL names no server")
        url = stack.enter_context(catalogs.database_of("postgresql", folder))
        return replace(block, body=block.body.replace(SERVER, f"'{url}'"))
    return block


def as_fits(recording: Path, folder: Path) -> None:
    """A recording as a camera would have left it, with the header file that a reader writes."""
    fits = pytest.importorskip("astropy.io.fits")
    archive = open_archive(recording)
    frames = np.concatenate([part for _, part in archive.chunks(0, archive.n_frames)])
    middle = archive.n_frames // 2
    for name, part in (("", frames[:100]), ("_1", frames[:middle]), ("_2", frames[middle:])):
        fits.PrimaryHDU(part).writeto(folder / f"FRAMES{name}.fits")
    fits.PrimaryHDU(np.asarray(archive.dark)).writeto(folder / "dark.fits")
    header = {name: archive.attributes[name] for name in ("campaign", "archive", "instrument", "path", "sources")}
    text = "".join(f"{key} = {json.dumps(value)}\n" for key, value in header.items() if isinstance(value, str))
    for name in ("instrument", "path"):
        text += f"[{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in header[name].items())
    for source in header["sources"]:
        text += "[[sources]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in source.items())
    text += '[ingest]\ndark = "dark.fits"\ntime = {start = 2012-09-14T15:15:00Z}\n'
    (folder / "header.toml").write_text(text)


def check_options(text: str, where: str) -> None:
    """Commands and their options are at least there."""
    for line in text.replace("\\\n", " ").splitlines():
        try:
            program, *words = shlex.split(line.removeprefix("$ "), comments=True) or [""]
        except ValueError:
            continue  # a quote that goes on in the next line
        if program != "coslidar":
            continue
        command: click.Command = cli
        while isinstance(command, click.Group) and words and not words[0].startswith("-"):
            found = command.get_command(click.Context(command), words.pop(0))
            assert found is not None, f"{where}: there is no such command: {line}"
            command = found
        known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
        unknown = [word for word in words if word.startswith("--") and word.partition("=")[0] not in known | {"--help"}]
        assert not unknown, f"{where}: there are no options {unknown}: {line}"


@pytest.mark.parametrize("page", PAGES)
def test_commands_are_there(page: str) -> None:
    """Those of blocks, also of pages that are slow, and those within sentences."""
    for block in blocks(ROOT / page):
        check_options(block.body, f"{page}, line {block.line}")
    prose = re.sub(r"^ *```.*?^ *```$", "", (ROOT / page).read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    for words in re.findall(r"`(coslidar [^`]+)`", prose):
        if not re.search(r"[A-Z]{3,}|…", " ".join(words.split()[:3])):
            check_options(" ".join(words.split()), page)


@pytest.mark.parametrize("page", PAGES)
def test_files_of_the_checkout_are_there(page: str) -> None:
    """Benchmarks and tests that sentences name."""
    text = (ROOT / page).read_text("utf-8")
    for path in re.findall(r"\b(?:benchmarks|tests|docs|pipeline|plugins|catalog|flows)/[\w/.-]*\.(?:py|sql)\b", text):
        assert (ROOT / path).is_file(), f"{page}: there is no {path}"


def test_targets_are_what_ci_does() -> None:
    """`make` in a page is not executed by tests, but by CI, or it is what one of those targets needs."""
    makefile = (ROOT / "Makefile").read_text("utf-8")
    needs = {name: found.split() for name, found in re.findall(r"^([\w-]+):(?!=)(.*)$", makefile, re.MULTILINE)}
    done = set(re.findall(r"^make ([\w-]+)", (ROOT / ".ci" / "run").read_text("utf-8"), re.MULTILINE))
    done |= {need for name in done for need in needs[name]}
    told = {
        (page, target)
        for page in PAGES
        for block in blocks(ROOT / page)
        if "make" in block.words
        for target in re.findall(r"^make ([\w-]+)", block.body, re.MULTILINE)
    }
    assert {target for _, target in told} >= {"demo", "test"}
    assert [item for item in sorted(told) if item[1] not in done] == []
    for page in PAGES:
        for target in re.findall(r"`make ([\w-]+)`", (ROOT / page).read_text("utf-8")):
            assert target in needs, f"{page}: there is no 'make {target}'"


@pytest.mark.parametrize("page", PAGES)
def test_every_block_says_what_it_is(page: str) -> None:
    """A block of unknown language would not be executed, and nobody would notice."""
    unknown = [
        f"line {block.line}: '{' '.join([block.language, *block.words])}'"
        for block in blocks(ROOT / page)
        if block.language not in LANGUAGES
        or ((words := LANGUAGES[block.language]) is not None and not words.issuperset(block.words))
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
    check_options("coslidar run a.toml --no-prefect  # --nothing\n", "here")
    with pytest.raises(AssertionError, match="--nothing"):
        check_options("$ coslidar run a.toml --nothing\n", "here")
    with pytest.raises(AssertionError, match="no such command"):
        check_options("coslidar nothing", "here")
    assert Block("python", (), "# my/file.py\nx = 1\n", 1).file == "my/file.py"
    assert Block("python", (), "# a comment\nx = 1\n", 1).file is None
    assert Block("text", ("my/file.csv",), "1,2\n", 1).file == "my/file.csv"


def test_a_command_that_stays_can_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_blocks, "GRACE", 0.2)
    runner = Runner(tmp_path, environment(tmp_path))
    head = "import http.server, signal, subprocess, sys\n"
    (tmp_path / "page.py").write_text(
        head + "server = http.server.HTTPServer(('127.0.0.1', 0), http.server.SimpleHTTPRequestHandler)\n"
        "if 'orphan' in sys.argv:\n"
        "    subprocess.Popen(['sleep', '300'], start_new_session=True)\n"
        "print(f'at http://127.0.0.1:{server.server_port}/ now', flush=True)\n"
        "try:\n    server.serve_forever()\n"
        "except KeyboardInterrupt:\n    sys.exit('bad' in sys.argv)\n"
    )
    assert runner.stay("python page.py").startswith("at http://")
    with pytest.raises(AssertionError, match="exit code 1"):
        runner.stay("python page.py bad")
    with pytest.raises(AssertionError, match=r"left behind.*sleep"):
        runner.stay("python page.py orphan")
    with pytest.raises(AssertionError, match="gave no address:\nno way"):
        runner.stay("echo no way")
