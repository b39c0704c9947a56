"""From settings to published products. Imports neither Prefect nor, by itself, Dask.

An archive is planned, its batches are sent to the workers, what comes back is kept in a scratch store, and once all
are there they become one product. The catalog and the scratch store are the only memory: killed at any moment, the
same command goes on where it was.
"""

from __future__ import annotations

import logging
from concurrent.futures import FIRST_COMPLETED, CancelledError, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from threading import Event, Lock
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..catalog.archive import ArchiveError
from ..catalog.kept import Kept
from ..catalog.products import assemble
from ..pipeline import batch as stages
from ..pipeline import description, response
from ..pipeline.products import QUALITY_FLAGS
from ..pipeline.units import safe, text
from ..plugins.registry import PluginError
from .cluster import ALLOWED_FAILURES, BatchOutcome, BatchTask, as_stored, from_stored, process_batch, remember
from .plan import ArchivePlan, BatchWindow, plan_archive
from .settings import InputError, Unavailable, cache_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path

    from distributed import Client, Future
    from numpy.typing import NDArray

    from ..catalog.store import Catalog
    from ..pipeline.products import BatchResult
    from .settings import Settings

log = logging.getLogger("coslidar")

#: Batches per worker thread that are under way at once: enough that none idles, few enough that memory stays flat.
AHEAD = 2
#: How often those who wait look whether the run is to stop, s.
PATIENCE = 0.2


class Stopped(BaseException):
    """The run is to stop; raised in the threads of its archives, past everything that handles faults."""


class Progress(Protocol):
    """What wants to know how far a run is."""

    def planned(self, archive: str, batches: int) -> None:
        """An archive begins, with so many batches to compute."""

    def advanced(self, archive: str, index: int, reason: str) -> None:
        """A batch is done; `reason` says why it failed, if it did."""

    def finished(self, outcome: ArchiveOutcome) -> None:
        """An archive is done."""


@dataclass(frozen=True)
class ArchiveOutcome:
    """What became of one archive.

    Parameters
    ----------
    url : str
        Where it is.
    name : str
        Campaign and archive; the url where it could not be opened.
    status : str
        ``published``, ``present`` (nothing to do), ``refused`` (its input is at fault), ``failed``, or
        ``cancelled`` (the run was interrupted).
    batches, failed_batches, reused, frames_read : int
        Batches in all, those that failed, those that were there already, and frames that were read.
    faults : tuple of str
        Why the archive was refused or failed, or which batches did.
    product : str
        Path of the product in the catalog.
    input_fault : bool
        Whether the fault lies in the data (exit code 2) rather than in the run.
    """

    url: str
    name: str
    status: str
    batches: int = 0
    failed_batches: int = 0
    reused: int = 0
    frames_read: int = 0
    faults: tuple[str, ...] = ()
    product: str = ""
    input_fault: bool = False


@dataclass(eq=False)
class Work:
    """What the archives of one run share.

    Parameters
    ----------
    settings : Settings
        What to compute.
    catalog : Catalog
        Where results go.
    run : int or str
        Identity of the run in the catalog.
    client : distributed.Client
        Where batches are computed.
    progress : Progress
        Who is told.
    """

    settings: Settings
    catalog: Catalog
    run: Any
    client: Client
    progress: Progress
    correlations: Kept = field(init=False)
    responses: Kept = field(init=False)
    stopping: Event = field(default_factory=Event)
    _matrices: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def __post_init__(self) -> None:
        self.correlations = kept_correlations(self.catalog.root)
        # A response matrix depends on no recording, so all catalogs of a user share theirs.
        self.responses = Kept(cache_folder() / "responses")

    def check(self) -> None:
        """Raise Stopped where the run is to stop, Unavailable where nothing is left to compute on."""
        if self.stopping.is_set():
            raise Stopped
        if self.client.status in ("closing", "closed"):
            raise lost(self.settings)

    def matrix(self, plan: ArchivePlan) -> NDArray[np.float64]:
        """Response matrix, computed once for all archives of one geometry."""
        with self._lock:
            digest = str(plan.response_key)
            found = self._matrices.get(digest)
            if found is None and (kept := self.responses.load(digest)) is not None:
                found = kept["M"]
            if found is None:
                parameters = self.settings.configuration.response
                found = response.response_matrix(
                    plan.geometry,
                    plan.grid,
                    plan.spectrum,
                    plan.sources,
                    sampling=parameters.sampling,
                    slope_response=parameters.slope_response,
                )
                with suppress(OSError):  # a cache that cannot be written only costs time
                    self.responses.save(digest, {"M": found})
            self._matrices[digest] = found
            return found


def lost(settings: Settings) -> Unavailable:
    """The error for a cluster that has gone in the middle of a run."""
    where = settings.run.scheduler or "this machine"
    return Unavailable(
        f"the Dask scheduler at {where} was lost; what was finished is kept, the same command goes on from there"
    )


def kept_correlations(root: Path) -> Kept:
    """Where a catalog keeps the correlations of its batches."""
    return Kept(root / "correlations")


def model_of(plan: ArchivePlan, work: Work) -> stages.Model:
    """What turns correlations of this archive into profiles."""
    return stages.Model(
        geometry=plan.geometry,
        grid=plan.grid,
        matrix=work.matrix(plan),
        sampling=work.settings.configuration.response.sampling,
        regulariser=plan.regulariser,
        selector=plan.selector,
        inversion=work.settings.configuration.inversion,
        scintillometers=description.scintillometer_weights(
            plan.header, plan.grid, work.settings.configuration.response.sampling
        ),
    )


def process_archive(url: str, work: Work) -> ArchiveOutcome:
    """Process one archive; never raises for what is wrong with it."""
    name = safe(url)
    try:
        work.check()
        plan = plan_archive(url, work.settings)
        name = plan.name
        outcome = _process(plan, work)
    except (ArchiveError, InputError, PluginError) as error:
        outcome = ArchiveOutcome(url, name, "refused", faults=tuple(error.faults), input_fault=True)
    except Stopped:
        return ArchiveOutcome(url, name, "cancelled")
    except Unavailable:
        raise
    except Exception as error:
        if work.client.status != "running":
            raise lost(work.settings) from error
        # Whatever else goes wrong with one archive must not take the others down.
        log.debug("archive %s failed", url, exc_info=True)
        reason = f"{name}: {type(error).__name__}: {safe(str(error))}"
        outcome = ArchiveOutcome(url, name, "failed", faults=(reason,))
    if outcome.status in ("refused", "failed"):
        for fault in outcome.faults:
            work.catalog.record_failure(work.run, url, fault)
    work.progress.finished(outcome)
    return outcome


def _process(plan: ArchivePlan, work: Work) -> ArchiveOutcome:
    catalog, digest = work.catalog, str(plan.profile_key)
    if catalog.has(plan.archive.identity, digest):
        row = catalog.products(archive_identity=plan.archive.identity, lineage_key=digest)[0]
        batches = catalog.batches(lineage_key=digest)
        lost = sum(bool(batch.quality_flag & QUALITY_FLAGS["failed"][0]) for batch in batches)
        # The same command says the same again, whether it is the first or the second time that it gets so far.
        return ArchiveOutcome(
            plan.url,
            plan.name,
            "present",
            batches=row.batches,
            failed_batches=lost,
            product=str(row.path),
            input_fault=lost > 0,
        )
    remember(plan.archive)
    done: dict[int, BatchResult] = {}
    for window in plan.windows:
        if (finished := catalog.scratch.load(plan.result_key(window))) is not None:
            done[window.index] = finished
    reused = len(done)
    todo = [window for window in plan.windows if window.index not in done]
    work.progress.planned(plan.name, len(todo))
    frames_read, transient = 0, False
    for window, outcome in _compute(plan, todo, work):
        frames_read += outcome.frames_read
        if outcome.reduced is not None:
            work.correlations.save(plan.correlation_key(window), as_stored(outcome.reduced))
        if outcome.transient:
            transient = True
        elif outcome.lasting:
            catalog.scratch.save(plan.result_key(window), outcome.result)
        done[window.index] = outcome.result
        if outcome.result.reason:
            catalog.record_failure(
                work.run, plan.url, outcome.result.reason, start=window.start_time, stop=window.stop_time
            )
        work.progress.advanced(plan.name, window.index, outcome.result.reason)

    results = [done[window.index] for window in plan.windows]
    faults = tuple(
        f"{plan.name}: batch {number}: {result.reason}" for number, result in enumerate(results) if result.reason
    )
    counts: dict[str, Any] = {
        "batches": len(results),
        "failed_batches": len(faults),
        "reused": reused,
        "frames_read": frames_read,
    }
    if len(faults) == len(results) or transient:
        # What the machine spoiled may succeed next time; what the data forbid never will.
        return ArchiveOutcome(plan.url, plan.name, "failed", faults=faults, input_fault=not transient, **counts)
    header = plan.header
    dataset = assemble(
        results,
        description.describe(model_of(plan, work), header),
        campaign=header.campaign,
        archive=header.archive,
        archive_identity=plan.archive.identity,
        lineage=plan.profile_key,
        wavelength=header.instrument.wavelength,
        sources=plan.source_names,
        scintillometers=[scintillometer.name for scintillometer in header.scintillometers],
        attributes=attributes_of(plan, work.settings),
    )
    published = catalog.publish(dataset, work.run, url=plan.url, header=plan.archive.attributes)
    catalog.scratch.remove(plan.result_key(window) for window in plan.windows)
    return ArchiveOutcome(
        plan.url,
        plan.name,
        "published",
        faults=faults,
        product=str(published.row.path),
        input_fault=bool(faults),
        **counts,
    )


def attributes_of(plan: ArchivePlan, settings: Settings) -> dict[str, Any]:
    """What a reader of the product wants to know at first sight; the lineage has everything."""
    header, parameters = plan.header, settings.configuration
    attributes: dict[str, Any] = {
        "instrument": header.instrument.name or "unnamed instrument",
        "path_length": text(header.path.length, "m"),
        "subaperture_size": text(header.instrument.subaperture_size, "m"),
        "batch_duration": text(parameters.batch.duration, "s"),
        "sampling": parameters.response.sampling,
        "slope_response": parameters.response.slope_response,
        "covariance": parameters.correlation.covariance,
        "sources_used": parameters.correlation.sources,
        "source_model": settings.plugins["source"]["name"],
        "spectrum": settings.plugins["spectrum"]["name"],
        "regulariser": settings.plugins["regulariser"]["name"],
        "selector": settings.plugins["selector"]["name"],
        "estimator": parameters.inversion.estimator,
        "data_subset": parameters.inversion.subset,
        "noise_bias": parameters.inversion.noise_bias,
        "slope_offset": parameters.inversion.slope_offset,
    }
    if header.site is not None:
        for key in ("name", "timezone"):
            if value := getattr(header.site, key):
                attributes[f"site_{key}"] = value
    return attributes


def _compute(plan: ArchivePlan, todo: list[BatchWindow], work: Work) -> Iterator[tuple[BatchWindow, BatchOutcome]]:
    """Send batches to the workers, a few ahead, and yield them as they come back."""
    if not todo:
        return
    settings, client = work.settings, work.client
    # The model travels with every batch: a few kB, and no worker that dies can take the only copy along.
    model = model_of(plan, work)
    waiting = iter(todo)
    flying: dict[str, tuple[Future, BatchWindow]] = {}
    back: SimpleQueue[Future] = SimpleQueue()

    def submit() -> None:
        window = next(waiting, None)
        if window is None:
            return
        stored = work.correlations.load(plan.correlation_key(window))
        task = BatchTask(
            url=plan.url,
            identity=plan.archive.identity,
            window=window,
            header=plan.header,
            duration=settings.configuration.batch.duration,
            extraction=settings.configuration.extraction,
            correlation=settings.configuration.correlation,
            complete=settings.header,
            reduced=from_stored(stored) if stored else None,
        )
        future = client.submit(process_batch, task, model, pure=False, key=f"{plan.name}-{window.index}-{id(task):x}")
        flying[future.key] = (future, window)
        future.add_done_callback(back.put)

    try:
        for _ in range(max(1, sum(client.nthreads().values())) * AHEAD):
            submit()
        while flying:
            work.check()
            try:
                future = back.get(timeout=PATIENCE)
            except Empty:
                continue
            _, window = flying.pop(future.key)
            outcome = _outcome(future, window, plan)
            future.release()
            submit()
            yield window, outcome
    finally:
        with suppress(Exception):  # the scheduler may be what is gone
            client.cancel([future for future, _ in flying.values()])


def _outcome(future: Future, window: BatchWindow, plan: ArchivePlan) -> BatchOutcome:
    """What a worker sent back; a fault of the machine is one of this try only."""
    from distributed import KilledWorker

    try:
        outcome: BatchOutcome = future.result()
        return outcome
    except KilledWorker:
        reason = (
            f"every worker that computed it died ({ALLOWED_FAILURES + 1} tries); too little memory is the usual cause"
        )
    except CancelledError:
        raise  # somebody stopped the scheduler, or told it to forget
    except Exception as error:
        log.debug("batch %s of %s failed", window.index, plan.name, exc_info=True)
        reason = f"{type(error).__name__}: {safe(str(error))}"
    return BatchOutcome(window, stages.failed(window.start_time, window.stop_time, reason), None, 0, transient=True)


def execute(work: Work, archives: Iterable[str], fan_out: Callable[..., list[ArchiveOutcome]]) -> list[ArchiveOutcome]:
    """Process archives, several at once, and keep the record of the run.

    Parameters
    ----------
    work : Work
        What they share.
    archives : iterable of str
        Paths and URLs.
    fan_out : callable
        Calls a function for each of a list and returns the results: threads here, tasks under Prefect.

    Returns
    -------
    list of ArchiveOutcome
        In the order of `archives`.
    """
    outcomes = fan_out(process_archive, list(archives), work)
    complete = all(outcome.status in ("published", "present") for outcome in outcomes)
    work.catalog.finish_run(work.run, "finished" if complete else "failed")
    return outcomes


def in_threads(process: Callable[[str, Work], ArchiveOutcome], archives: list[str], work: Work) -> list[ArchiveOutcome]:
    """Process archives in a few threads; the work itself is done by Dask."""
    with ThreadPoolExecutor(work.settings.run.archives_at_once, thread_name_prefix="archive") as pool:
        futures = [pool.submit(process, url, work) for url in archives]
        try:
            pending = set(futures)
            while pending:
                # Short waits, so that an interrupt is noticed at once.
                done, pending = wait(pending, timeout=PATIENCE, return_when=FIRST_COMPLETED)
                for future in done:
                    future.result()
        except BaseException:
            work.stopping.set()
            raise
    return [future.result() for future in futures]
