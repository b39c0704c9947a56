"""Code blocks of the documentation: found, executed in order, and what they print compared with what the page says.

The language of a block says what becomes of it:

- `console`: a session. Lines that begin with ``$ `` are typed into a shell, what follows each is what it printed;
  ``...`` alone on a line stands for any number of lines, at the end of one for its rest. Numbers with a point or an
  exponent need to agree only roughly (:data:`ROUGHLY`), and keys and durations not at all: a page shows what one
  sees, other tests hold the numbers.
- `sh`: typed into a shell; has to succeed, what it prints is not looked at. With a second word `long` it is not
  executed: that its commands and options exist is checked. With `make` it is what CI does in a clean checkout.
- `python`: executed, all blocks of a page one after the other in one namespace; `pycon` is a doctest in that namespace.
- any of `toml`, `json`, `python`, `yaml`, `ini` whose first line is ``# folder/file``: is that file.
- `toml`, `json` without: has to be readable.
- `text`: shown only.

The blocks of a page run in a folder of its own, in which there is what the tutorial made (``demo``).
"""

from __future__ import annotations

import doctest
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
#: Numbers of a page and of a run may differ by so much: what a seeded simulation gives depends on the machine in the
#: last digits only, but pages need not be written again whenever a stage is made a little better.
ROUGHLY = 0.3
LANGUAGES = {"console", "sh", "python", "pycon", "toml", "json", "yaml", "ini", "text", "bibtex"}
_BLOCK = re.compile(r"^(?P<indent> *)```(?P<info>[^\n`]*)\n(?P<body>.*?)^(?P=indent)```$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"(?:#|//) ([\w.-]+(?:/[\w.-]+)*\.\w+)\n")
_TOKEN = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?|[^\d\s]+")
#: A number with a point or an exponent is a measurement; one without is a count, or part of a name.
_MEASURED = re.compile(r"\d+\.\d+(?:e[-+]?\d+)?|\d+e[-+]?\d+")
#: Never the same twice: keys, times of publishing, seconds spent.
_VOLATILE = re.compile(
    r"\b[0-9a-f]{16,64}\b|\b[0-9a-f]{8}\b(?=\W)|20[2-9]\d-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?Z?|\d+(?:\.\d+)? s\b"
)


@dataclass(frozen=True)
class Block:
    """A fenced block: language, the other words behind it, body, and the line it begins on."""

    language: str
    words: tuple[str, ...]
    body: str
    line: int

    @property
    def file(self) -> str | None:
        """File that the block is, as its first line says."""
        found = _FILE.match(self.body)
        return found[1] if found and self.language in ("toml", "json", "python", "yaml", "ini") else None


def blocks(page: Path) -> list[Block]:
    """Blocks of a page in their order; directives (``{…}``) are none."""
    text = page.read_text("utf-8")
    found = []
    for match in _BLOCK.finditer(text):
        info = match["info"].split()
        if info and info[0].startswith("{"):
            continue
        body = "\n".join(line.removeprefix(match["indent"]) for line in match["body"].split("\n"))
        found.append(Block(info[0] if info else "", tuple(info[1:]), body, text.count("\n", 0, match.start()) + 1))
    return found


def session(body: str) -> Iterator[tuple[str, str]]:
    """Commands of a session and what each printed; a backslash or an open quote continues a command."""
    command, printed = "", []
    for line in body.splitlines():
        if line.startswith("$ "):
            if command:
                yield command, "\n".join(printed)
            command, printed = line[2:], []
        elif command.endswith("\\"):
            command += "\n" + line
        else:
            printed.append(line)
    if command:
        yield command, "\n".join(printed)


def _alike(said: str, shown: str) -> bool:
    said, shown = (" ".join(_VOLATILE.sub("#", text).split()) for text in (said, shown))
    if shown.endswith("..."):
        shown = shown.removesuffix("...").rstrip()
        said = said[: _length(said, len(_TOKEN.findall(shown)))]
    left, right = _TOKEN.findall(said), _TOKEN.findall(shown)
    return len(left) == len(right) and all(map(_same, left, right))


def _length(text: str, tokens: int) -> int:
    """Characters of the first tokens of a text."""
    found = list(_TOKEN.finditer(text))[:tokens]
    return found[-1].end() if found else 0


def _same(a: str, b: str) -> bool:
    if a == b:
        return True
    if not (_MEASURED.fullmatch(a) and _MEASURED.fullmatch(b)):
        return False
    x, y = float(a), float(b)
    return abs(x - y) <= ROUGHLY * max(abs(x), abs(y))


def differs(said: str, shown: str) -> str | None:
    """The first line of a page that a program did not print; None where they agree."""
    printed = [line.rstrip() for line in said.splitlines() if line.strip()]
    place = 0
    anything = False
    for line in (line.rstrip() for line in shown.splitlines() if line.strip()):
        if line.strip() == "...":
            anything = True
            continue
        reach = range(place, len(printed)) if anything else range(place, min(place + 1, len(printed)))
        here = next((n for n in reach if _alike(printed[n], line)), None)
        if here is None:
            return line
        place, anything = here + 1, False
    if place < len(printed) and not anything:
        return f"(nothing more; the program went on with: {printed[place]})"
    return None


class Runner:
    """Executes the blocks of one page in a folder."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.folder = folder
        self.environment = environment
        self.names: dict[str, Any] = {"__name__": "page"}

    def shell(self, command: str) -> str:
        done = subprocess.run(
            ["bash", "-e", "-c", command], cwd=self.folder, env=self.environment, text=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=900,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}"
        return done.stdout

    def run(self, block: Block) -> None:
        """Execute one block.

        Raises
        ------
        AssertionError
            It fails, or prints something else than the page says.
        """
        if (file := block.file) is not None:
            path = self.folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.body)
        elif block.language == "sh":
            self.shell(block.body)
        elif block.language == "console":
            for command, shown in session(block.body):
                said = self.shell(command)
                wrong = differs(said, shown)
                assert wrong is None, f"$ {command}\nthe page shows: {wrong}\nthe program printed:\n{said}"
        elif block.language in ("python", "pycon"):
            here = os.getcwd()
            os.chdir(self.folder)
            try:
                if block.language == "python":
                    exec(compile(block.body, f"<line {block.line}>", "exec"), self.names)
                else:
                    self._doctest(block.body)
            finally:
                os.chdir(here)
        elif block.language == "toml":
            tomllib.loads(block.body)
        elif block.language == "json":
            json.loads(block.body)

    def _doctest(self, body: str) -> None:
        told: list[str] = []
        test = doctest.DocTestParser().get_doctest(body, self.names, "page", None, 0)
        runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
        runner.run(test, out=told.append, clear_globs=False)
        self.names.update(test.globs)
        assert runner.failures == 0, "".join(told)


def environment(cache: Path) -> dict[str, str]:
    """Environment of a reader: `coslidar` and `python` are those of this interpreter, nothing is set."""
    mine = {key: value for key, value in os.environ.items() if not key.startswith(("PREFECT_", "COSLIDAR_", "DASK_"))}
    path = os.pathsep.join([str(Path(sys.executable).parent), mine.get("PATH", "")])
    return {**mine, "PATH": path, "COSLIDAR_HOME": str(cache), "GIT_DIR": "/nonexistent", "COLUMNS": "110"}
