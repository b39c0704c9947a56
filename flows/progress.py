"""Progress of a run: bars on a terminal, one line per archive in a log."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from threading import Lock
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.progress import Progress as Bars
    from rich.progress import TaskID

    from .driver import ArchiveOutcome, Progress


def _sentence(outcome: ArchiveOutcome) -> str:
    if outcome.status == "published":
        words = f"{outcome.batches} batches published"
        if outcome.reused:
            words += f", {outcome.reused} of them found finished"
        if outcome.failed_batches:
            words += f", {outcome.failed_batches} failed"
        return words
    if outcome.status == "present":
        return f"{outcome.batches} batches, already in the catalog"
    return outcome.status


class Lines:
    """One line per archive on stderr."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.done = 0
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
            click.echo(f"coslidar: {fault}", err=True)

    def finished(self, outcome: ArchiveOutcome) -> None:
        """Say what became of an archive."""
        with self._lock:
            self.done += 1
            click.echo(f"coslidar: [{self.done}/{self.total}] {outcome.name}: {_sentence(outcome)}", err=True)
            if outcome.status in ("refused", "failed"):
                for fault in outcome.faults:
                    self._say(fault)


class Bar(Lines):
    """A bar per archive while it is worked on, and one for the run."""

    def __init__(self, total: int, bars: Bars) -> None:
        super().__init__(total)
        self._bars = bars
        self._run = bars.add_task("archives", total=total)
        self._tasks: dict[str, TaskID] = {}

    def planned(self, archive: str, batches: int) -> None:
        """Show a bar."""
        self._tasks[archive] = self._bars.add_task(archive, total=batches)

    def advanced(self, archive: str, index: int, reason: str) -> None:
        """Move it."""
        super().advanced(archive, index, reason)
        self._bars.advance(self._tasks[archive])

    def finished(self, outcome: ArchiveOutcome) -> None:
        """Take it away again."""
        if (task := self._tasks.pop(outcome.name, None)) is not None:
            self._bars.remove_task(task)
        self._bars.advance(self._run)
        super().finished(outcome)


@contextmanager
def progress(total: int, quiet: bool = False) -> Iterator[Progress]:
    """Bars on a terminal, lines elsewhere, and one line at the end with the time it took.

    Parameters
    ----------
    total : int
        Number of archives.
    quiet : bool
        Only what went wrong.
    """
    begin = time.monotonic()
    if quiet:
        yield _Faults(total)
        return
    if not sys.stderr.isatty():
        yield Lines(total)
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
            yield Bar(total, bars)
    click.echo(f"coslidar: {time.monotonic() - begin:.1f} s", err=True)


class _Faults(Lines):
    """Only what went wrong."""

    def finished(self, outcome: ArchiveOutcome) -> None:
        """Speak of failures."""
        if outcome.status in ("refused", "failed"):
            super().finished(outcome)
