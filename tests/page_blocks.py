"""Code blocks of the documentation: found, executed in order, and what they print compared with what the page says.

The language of a block says what becomes of it:

- `console`: a session. Lines that begin with ``$ `` are typed into a shell, what follows each is what it printed;
  ``...`` alone on a line stands for any number of lines, at the end of one for its rest. Numbers with a point or an
  exponent need to agree only roughly (:data:`ROUGHLY`), and keys and durations not at all: a page shows what one
  sees, other tests hold the numbers.
- `sh`: typed into a shell; has to succeed, what it prints is not looked at. With a second word `long` it takes
  minutes: it is executed among the slow tests, also on a page that is otherwise quick. With `stays` it is a command
  that ends when it is interrupted: it has to come up, print an address that answers, end with exit code 0 and leave no
  process behind. With `make` it is what CI does in a clean checkout.
- `python`: executed, all blocks of a page one after the other in one namespace; `pycon` is a doctest in that namespace.
- any of `toml`, `json`, `python` whose first line is ``# folder/file``: is that file.
- `toml` without: part of a campaign file, `json`: the header of an archive; both have to be valid.
- `text`: shown only; with a second word it is the file of that name.

The blocks of a page run in a folder of its own, in which there is what the tutorial made (``demo``).
"""

from __future__ import annotations

import doctest
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import psutil
from small_runs import wait_for

from coslidar.flows.settings import InputError, load
from coslidar.pipeline.parameters import Header

ROOT = Path(__file__).resolve().parents[1]
#: Numbers of a page and of a run may differ by so much: what a seeded simulation gives depends on the machine in the
#: last digits only, but pages need not be written again whenever a stage is made a little better.
ROUGHLY = 0.3
#: Languages, and the words that may stand behind each.
LANGUAGES = {"console": set(), "sh": {"long", "stays", "make"}, "python": set(), "pycon": set(), "toml": set(),
             "json": set(), "text": None}  # fmt: skip
#: Seconds that a block may take, and one that is long.
PATIENCE, LONG = 900, 3 * 3600
#: Seconds after the end of a command until its processes have to be gone.
GRACE = 30.0
_BLOCK = re.compile(r"^(?P<indent> *)```(?P<info>[^\n`]*)\n(?P<body>.*?)^(?P=indent)```$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"(?:#|//) ([\w.-]+(?:/[\w.-]+)*\.\w+)\n")
_TOKEN = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?|[^\d\s]+")
_ABSENT = re.compile(r"no file or folder matches|No such file or directory")
_ADDRESS = re.compile(r"http://\S+")
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
        """File that the block is, as its first line or the word behind the fence says."""
        if self.language == "text":
            return self.words[0] if self.words else None
        found = _FILE.match(self.body)
        return found[1] if found and self.language in ("toml", "json", "python") else None

    @property
    def long(self) -> bool:
        """Whether it is executed among the slow tests only."""
        return "long" in self.words


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

    def shell(self, command: str, patience: int = PATIENCE) -> str:
        """What a command prints, which has to succeed."""
        done = subprocess.run(
            ["bash", "-e", "-c", command], cwd=self.folder, env=self.environment, text=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=patience,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}"
        return done.stdout

    def stay(self, command: str) -> str:
        """What a command prints that comes up, gives an address that answers, and is interrupted then."""
        said = self.folder / ".said"
        with said.open("w") as output:
            # A shell in the background would make it deaf to interrupts.
            process = psutil.Popen(
                ["bash", "-c", f"exec {command.strip()}"], cwd=self.folder, env=self.environment, text=True,
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, process_group=0,
            )  # fmt: skip
        everyone = [process]
        try:
            wait_for(lambda: process.poll() is not None or bool(_ADDRESS.search(said.read_text())), PATIENCE)
            found = _ADDRESS.search(said.read_text())
            assert found, f"{command}\ngave no address:\n{said.read_text()}"
            with httpx.Client(trust_env=False, follow_redirects=True, timeout=60) as client:
                answer = client.get(found[0])
            assert answer.status_code < 500, f"{command}\n{found[0]}: {answer.status_code}"
            everyone = [process, *process.children(recursive=True)]
            # As Ctrl-C does it: to all that the command started in its group.
            os.killpg(process.pid, signal.SIGINT)
            code = process.wait(timeout=120)
            assert code == 0, f"{command}\nended with exit code {code}:\n{said.read_text()}"
            left = psutil.wait_procs(everyone, timeout=GRACE)[1]
            assert not left, f"{command}\nleft behind: {left}"
        finally:
            if process.is_running():
                everyone += process.children(recursive=True)
            for item in everyone:
                with suppress(psutil.NoSuchProcess):
                    item.kill()
            process.wait()
        return said.read_text()

    def run(self, block: Block) -> None:
        """Execute one block.

        Raises
        ------
        AssertionError
            It fails, or prints something else than the page says.
        ValidationError
            It is a header that is not valid.
        """
        if (file := block.file) is not None:
            path = self.folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.body)
        elif block.language == "sh":
            if "stays" in block.words:
                self.stay(block.body)
            else:
                self.shell(block.body, LONG if block.long else PATIENCE)
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
            part = self.folder / "part-of-a-page.toml"
            part.write_text(block.body)
            try:
                load(part)
            except InputError as error:
                # The files that it names are the reader's.
                faults = [text for text in error.faults if not _ABSENT.search(text)]
                assert not faults, "\n".join(faults)
        elif block.language == "json":
            Header.model_validate(json.loads(block.body))

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
