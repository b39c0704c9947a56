"""Progress of a run: bars on a terminal, one line per archive in a log."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager, suppress
from threading import Lock
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.progress import Progress as Bars
    from rich.progress import TaskID

    from .driver import ArchiveOutcome, Progress


def say(line: str) -> None:
    """One line on stderr. Whoever read it may have gone (``2>&1 | head``), which is no reason to lose a run."""
    with suppress(OSError, ValueError):
        click.echo(f"coslidar: {line}", err=True)


def counted(number: int, what: str) -> str:
    """Number and noun: ``1 batch``, ``2 batches``."""
    plural = "es" if what.endswith(("ch", "s")) else "s"
    return f"{number} {what}{'' if number == 1 else plural}"


def _sentence(outcome: ArchiveOutcome) -> str:
    words = outcome.status
    if outcome.status == "published":
        words = f"{counted(outcome.batches - outcome.failed_batches, 'batch')} published"
        if outcome.reused:
            words += f", {outcome.reused} computed earlier"
    elif outcome.status == "present":
        words = f"{counted(outcome.batches - outcome.failed_batches, 'batch')}, in the catalog already"
    elif outcome.status == "skipped":
        words = f"skipped, {outcome.note}"
    if outcome.failed_batches:
        words += f", {outcome.failed_batches} of {outcome.batches} failed"
    return words


class Lines:
    """One line per archive on stderr."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.outcomes: list[ArchiveOutcome] = []
        self._told: set[str] = set()
        self._lock = Lock()

    def planned(self, archive: str, batches: int) -> None:
        """Nothing: a log wants results."""

    def advanced(self, archive: str, index: int, reason: str) -> None:
        """Say why a batch failed."""
        if reason:
            self._say(f"{archive}: batch {index}: {reason}")

    def _say(self, fault: str) -> None:
        if fault not in self._told:
            self._told.add(fault)
            say(fault)

    def warned(self, message: str) -> None:
        """Say what is no failure."""
        say(message)

    def finished(self, outcome: ArchiveOutcome) -> None:
        """Say what became of an archive."""
        with self._lock:
            self.outcomes.append(outcome)
            say(f"[{len(self.outcomes)}/{self.total}] {outcome.name}: {_sentence(outcome)}")
            for fault in outcome.faults:
                self._say(fault)

    def summary(self) -> str:
        """What the run did, in one line."""
        computed = sum(o.batches - o.reused for o in self.outcomes if o.status in ("published", "failed"))
        frames = sum(outcome.frames_read for outcome in self.outcomes)
        return f"{counted(computed, 'batch')} computed, {counted(frames, 'frame')} read"


class Bar(Lines):
    """A bar per archive while it is worked on, and one for the run."""

    def __init__(self, total: int, bars: Bars) -> None:
        super().__init__(total)
        self._bars = bars
        self._run = bars.add_task("archives", total=total)
        self._tasks: dict[str, TaskID] = {}

    def planned(self, archive: str, batches: int) -> None:
        """Show a bar."""
        self._remove(archive)  # the same recording under another path
        self._tasks[archive] = self._bars.add_task(archive, total=batches)

    def advanced(self, archive: str, index: int, reason: str) -> None:
        """Move it."""
        super().advanced(archive, index, reason)
        if (task := self._tasks.get(archive)) is not None:
            self._bars.advance(task)

    def finished(self, outcome: ArchiveOutcome) -> None:
        """Take it away again."""
        self._remove(outcome.name)
        self._bars.advance(self._run)
        super().finished(outcome)

    def _remove(self, archive: str) -> None:
        if (task := self._tasks.pop(archive, None)) is not None:
            self._bars.remove_task(task)


@contextmanager
def progress(total: int, quiet: bool = False, silent: bool = False) -> Iterator[Progress]:
    """Bars on a terminal, lines elsewhere, and one line at the end with the time it took.

    Parameters
    ----------
    total : int
        Number of archives.
    quiet : bool
        Only what went wrong.
    silent : bool
        Nothing: log records say it.
    """
    begin = time.monotonic()
    if quiet or silent:
        yield _Nothing(total) if silent else _Faults(total)
        return
    watcher: Lines
    if not sys.stderr.isatty():
        yield (watcher := Lines(total))
    else:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars

        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
            yield (watcher := Bar(total, bars))
    say(f"{watcher.summary()}, {time.monotonic() - begin:.1f} s")


class _Faults(Lines):
    """Only what went wrong."""

    def finished(self, outcome: ArchiveOutcome) -> None:
        """Speak of failures."""
        for fault in outcome.faults:
            self._say(fault)


class _Nothing(Lines):
    """Nothing at all."""

    def _say(self, fault: str) -> None:
        """Say nothing."""

    def warned(self, message: str) -> None:
        """Say nothing."""

    def finished(self, outcome: ArchiveOutcome) -> None:
        """Say nothing."""
