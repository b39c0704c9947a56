"""The batches of one archive: what is there already, what is sent to the workers, and what comes back."""

from __future__ import annotations

import logging
import time
from collections import deque
from concurrent.futures import CancelledError
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

from ..catalog.measurements import MeasurementStore
from ..pipeline import batch as stages
from ..pipeline.products import QUALITY_FLAGS
from ..pipeline.units import safe
from . import logs
from .tasks import BatchOutcome, BatchTask, as_stored, from_stored, process_batch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from distributed import Future

    from ..pipeline.batch import Model, ReducedBatch
    from ..pipeline.products import BatchResult
    from .driver import Work
    from .plan import ArchivePlan, BatchWindow

log = logging.getLogger("coslidar")

FAILED = QUALITY_FLAGS["failed"][0]
#: Batches per worker thread that are under way at once: enough that none idles, few enough that memory stays flat.
AHEAD = 2
#: How often those who wait look whether the run is to stop, s.
PATIENCE = 0.2


class Vanished(RuntimeError):
    """The kept result of a batch is gone: another run has published the same product, or the disk lost it."""


class Batches:
    """The batches of one archive in one run.

    Parameters
    ----------
    plan : ArchivePlan
        Which.
    work : Work
        What the archives of the run share.
    """

    def __init__(self, plan: ArchivePlan, work: Work) -> None:
        self.plan, self.work = plan, work
        #: Why each finished batch failed; nothing where it did not. The results wait on the disk: memory stays flat.
        self.done: dict[int, str] = {}
        self.frames_read = 0
        #: Whether the machine spoiled one.
        self.transient = False
        self._unstable: set[int] = set()
        self._unkept: dict[int, BatchResult] = {}
        for window in plan.windows:
            finished = work.catalog.scratch.load(plan.result_key(window))
            if finished is None or (work.options.retry_failed and finished.quality_flag & FAILED):
                continue
            self.done[window.index] = finished.reason
            if finished.reason:
                self._record(window, finished.reason)
        self.reused = len(self.done)
        self.measurements = MeasurementStore(work.catalog.root / "measurements")
        if work.settings.keeps_measurements:
            self.measurements.folder.mkdir(exist_ok=True)

    @property
    def todo(self) -> list[BatchWindow]:
        """Batches that are not done."""
        return [window for window in self.plan.windows if window.index not in self.done]

    def compute(self, model: Callable[[], Model]) -> None:
        """Compute what is not there.

        Parameters
        ----------
        model : callable
            Gives what turns correlations into profiles; not called where nothing is to be done.
        """
        if todo := self.todo:
            # The model travels with every batch: a few kB, and no worker that dies can take the only copy along.
            made = model()
            if self.plan.reach:
                # Correlations wait on the disk for those of the batches around them: memory stays flat.
                for outcome in self._send(self._without_correlations(todo), None):
                    self._take(outcome)
            for outcome in self._send(self.todo, made):
                self._take(outcome)

    def results(self) -> list[BatchResult]:
        """All batches in their order, once they are computed.

        Raises
        ------
        Vanished
            A result is no longer where it was kept.
        """
        scratch, found = self.work.catalog.scratch, []
        for window in self.plan.windows:
            result = self._unkept.get(window.index) or scratch.load(self.plan.result_key(window))
            if result is None:
                raise Vanished(f"the kept result of batch {window.index} cannot be read back; run again")
            found.append(result)
        return found

    def _without_correlations(self, todo: list[BatchWindow]) -> list[BatchWindow]:
        needed = {near.index: near for window in todo for near in self.plan.around(window)}
        return [window for _, window in sorted(needed.items()) if self._reduced(window) is None]

    def _reduced(self, window: BatchWindow) -> ReducedBatch | None:
        stored = self.work.correlations.load(self.plan.correlation_key(window))
        return from_stored(stored) if stored else None

    def _neighbours(self, window: BatchWindow) -> tuple[ReducedBatch, ...]:
        found = []
        for near in self.plan.around(window):
            if near is window:
                continue
            reduced = self._reduced(near)
            if reduced is not None:
                found.append(reduced)
            elif not self.done.get(near.index):
                raise RuntimeError(f"the kept correlations of batch {near.index} are gone; run again")
        return tuple(found)

    def _task(self, window: BatchWindow, model: Model | None) -> BatchTask:
        plan, configuration = self.plan, self.work.settings.configuration
        return BatchTask(
            origin=self.work.origin,
            run=str(self.work.run),
            url=plan.url,
            identity=plan.archive.identity,
            name=plan.name,
            window=window,
            header=plan.header,
            geometry=plan.geometry,
            duration=configuration.batch.duration,
            extraction=configuration.extraction,
            correlation=configuration.correlation,
            complete=self.work.settings.header,
            measurements=str(self.measurements.folder),
            measurement_key=str(plan.measurement_key(window)),
            keep=self.work.settings.keeps_measurements,
            reduced=self._reduced(window) if model is not None else None,
            neighbours=self._neighbours(window) if model is not None and plan.reach else (),
        )

    def _take(self, outcome: BatchOutcome) -> None:
        """Keep what came back."""
        plan, work, window = self.plan, self.work, outcome.window
        work.progress.computed(outcome, self.plan)
        self.frames_read += outcome.frames_read
        if outcome.reduced is not None:
            work.correlations.save(plan.correlation_key(window), as_stored(outcome.reduced))
        if outcome.unkept:
            work.warn(f"slopes and fluxes are not kept: {outcome.unkept}")
        result = outcome.result
        if result is None:
            return
        self.transient |= outcome.transient
        if outcome.transient or not outcome.lasting:
            self._unstable.add(window.index)
        if any(near.index in self._unstable for near in self.plan.around(window)):
            self._unkept[window.index] = result
        else:
            work.catalog.scratch.save(plan.result_key(window), result)
        self.done[window.index] = result.reason
        if result.reason:
            self._record(window, f"transient: {result.reason}" if outcome.transient else result.reason)
        work.progress.advanced(plan.name, window.index, result.reason)

    def _record(self, window: BatchWindow, reason: str) -> None:
        times = {"start": window.start_time, "stop": window.stop_time}
        self.work.catalog.record_failure(self.work.run, self.plan.url, reason, **times)

    # --- to the workers and back -----------------------------------------------------------------------

    def _send(self, windows: Iterable[BatchWindow], model: Model | None) -> Iterator[BatchOutcome]:
        """Send batches to the workers, a few ahead, and yield what comes back as it comes."""
        client, work = self.work.client, self.work
        waiting = deque(windows)
        suspects: deque[BatchWindow] = deque()
        flying: dict[str, tuple[Future, BatchWindow]] = {}
        back: SimpleQueue[Future] = SimpleQueue()

        def submit(window: BatchWindow) -> None:
            task = self._task(window, model)
            key = f"{self.plan.name}-{window.index}-{id(task):x}"
            future = client.submit(process_batch, task, model, pure=False, key=key, workers=work.usable_workers())
            flying[future.key] = (future, window)
            future.add_done_callback(back.put)

        alone = False
        try:
            while waiting or flying or suspects:
                work.check()
                while waiting and len(flying) < work.threads() * AHEAD:
                    submit(waiting.popleft())
                if not flying:
                    # All others are done: what dies now with its worker was not in bad company.
                    alone = True
                    submit(suspects.popleft())
                try:
                    future = back.get(timeout=PATIENCE)
                except Empty:
                    work.check_workers()
                    continue
                _, window = flying.pop(future.key)
                outcome = self._outcome(future, window, alone)
                future.release()
                if outcome is None:
                    suspects.append(window)
                    continue
                logs.replay(outcome.records)
                if outcome.refused:
                    work.refuse(outcome.worker, outcome.refused)
                    waiting.append(window)
                    continue
                yield outcome
        finally:
            with suppress(Exception):  # the scheduler may be what is gone
                client.cancel([future for future, _ in flying.values()])

    def _outcome(self, future: Future, window: BatchWindow, alone: bool) -> BatchOutcome | None:
        """What a worker sent back; None where it died, perhaps by another batch's fault."""
        from distributed import KilledWorker

        transient = True
        try:
            outcome: BatchOutcome = future.result()
            return outcome
        except KilledWorker as error:
            if not alone:
                return None
            # Every try would end so: the others are worth a product, and --retry-failed mends it.
            transient = False
            reason = (
                f"every worker that computed it died ({error.allowed_failures + 1} tries by itself alone); too little "
                "memory is the usual cause; 'coslidar run --retry-failed' tries it again"
            )
        except CancelledError:
            raise  # somebody stopped the scheduler, or told it to forget
        except Exception as error:
            log.debug("batch %s of %s failed", window.index, self.plan.name, exc_info=True)
            reason = f"{type(error).__name__}: {safe(str(error))}"
        result = stages.failed(window.start_time, window.stop_time, reason)
        return BatchOutcome(window, result, transient=transient, lasting=False)


class Workers:
    """The workers of a run: how many threads they have, and which of them are not to be used.

    Parameters
    ----------
    client : distributed.Client
        Connection to them.
    """

    #: How long an answer of the scheduler is good for, s.
    FRESH = 2.0
    #: How long there may be no worker at all, s: a batch system may be starting some.
    EMPTY = 120.0

    def __init__(self, client: object) -> None:
        self._client = client
        self._asked = self._seen = time.monotonic()
        self._threads: dict[str, int] = {}
        self.refused: dict[str, str] = {}

    def known(self) -> dict[str, int]:
        """Threads of each worker, refused ones left out."""
        now = time.monotonic()
        if not self._threads or now - self._asked > self.FRESH:
            found = self._client.nthreads()  # type: ignore[attr-defined]
            self._threads = {worker: threads for worker, threads in found.items() if worker not in self.refused}
            self._asked = now
        if self._threads:
            self._seen = now
        return self._threads

    def missing(self) -> bool:
        """Whether there has been none for too long."""
        return not self.known() and time.monotonic() - self._seen > self.EMPTY

    def refuse(self, worker: str, reason: str) -> bool:
        """Use a worker no longer; whether that is news."""
        news = worker not in self.refused
        self.refused[worker] = reason
        self._threads.pop(worker, None)
        return news
