"""How far a run is: told to whoever watches, and every few seconds to the catalog, for who looks from elsewhere."""

from __future__ import annotations

import logging
import time
from collections import Counter
from dataclasses import dataclass, field
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, Any

from ..catalog.heartbeats import EVERY

if TYPE_CHECKING:
    from types import TracebackType

    from ..catalog.store import Catalog
    from .driver import ArchiveOutcome, Progress
    from .plan import ArchivePlan
    from .tasks import BatchOutcome

log = logging.getLogger("coslidar")


@dataclass
class _Counts:
    """Batches of an archive in this run."""

    todo: int
    done: int = 0
    failed: int = 0


@dataclass
class Pulse:
    """Progress of a run, with a heart that beats in the catalog.

    Parameters
    ----------
    catalog : Catalog
        Where it beats.
    run : str
        Which run.
    watcher : Progress
        Who is told too.
    archives : int
        Archives of the run.
    threads : int
        Threads of all workers.
    """

    catalog: Catalog
    run: str
    watcher: Progress
    archives: int
    threads: int
    outcomes: Counter[str] = field(default_factory=Counter)
    frames: int = 0
    pixels: int = 0
    reduce_seconds: float = 0.0
    retrieved: int = 0
    retrieve_seconds: float = 0.0
    _current: dict[str, _Counts] = field(default_factory=dict)
    _past: _Counts = field(default_factory=lambda: _Counts(0))
    _lock: Lock = field(default_factory=Lock)
    _over: Event = field(default_factory=Event)
    _thread: Thread | None = None
    _began: float = field(default_factory=time.monotonic)

    def __enter__(self) -> Pulse:
        self._thread = Thread(target=self._live, name="heartbeat", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join()

    def _live(self) -> None:
        ended = False
        while not ended:
            ended = self._over.wait(EVERY)
            try:
                self.catalog.beat(self.run, self.state())
            except Exception:  # a catalog that is busy for a moment must not end a run
                log.debug("the heartbeat could not be written", exc_info=True)

    def state(self) -> dict[str, Any]:
        """What the catalog is told, JSON-able."""
        with self._lock:
            counts = [self._past, *self._current.values()]
            return {
                "archives": self.archives,
                "outcomes": dict(self.outcomes),
                "current": {name: vars(one).copy() for name, one in self._current.items()},
                "batches": {what: sum(getattr(one, what) for one in counts) for what in ("todo", "done", "failed")},
                "frames": self.frames,
                "pixels": self.pixels,
                "reduce_seconds": self.reduce_seconds,
                "retrieved": self.retrieved,
                "retrieve_seconds": self.retrieve_seconds,
                "threads": self.threads,
                "seconds": time.monotonic() - self._began,
            }

    def planned(self, archive: str, batches: int) -> None:
        """An archive begins, with so many batches to compute."""
        with self._lock:
            self._current[archive] = _Counts(batches)
        self.watcher.planned(archive, batches)

    def computed(self, outcome: BatchOutcome, plan: ArchivePlan) -> None:
        """Something came back from a worker: what it cost."""
        rows, cols = plan.archive.frame_shape
        with self._lock:
            if outcome.frames_read:
                self.frames += outcome.frames_read
                self.pixels += outcome.frames_read * rows * cols
                self.reduce_seconds += outcome.reduce_seconds
            if outcome.retrieve_seconds > 0:
                self.retrieved += 1
                self.retrieve_seconds += outcome.retrieve_seconds

    def advanced(self, archive: str, index: int, reason: str) -> None:
        """A batch is done; `reason` says why it failed, if it did."""
        with self._lock:
            if (counts := self._current.get(archive)) is not None:
                counts.done += 1
                counts.failed += bool(reason)
        self.watcher.advanced(archive, index, reason)

    def warned(self, message: str) -> None:
        """Something is to be known that is no failure."""
        self.watcher.warned(message)

    def finished(self, outcome: ArchiveOutcome) -> None:
        """An archive is done."""
        with self._lock:
            self.outcomes[outcome.status] += 1
            if (counts := self._current.pop(outcome.name, None)) is not None:
                for what in ("todo", "done", "failed"):
                    setattr(self._past, what, getattr(self._past, what) + getattr(counts, what))
        self.watcher.finished(outcome)
