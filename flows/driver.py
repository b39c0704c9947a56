"""From settings to published products. Imports neither Prefect nor, by itself, Dask.

An archive is planned, its batches are sent to the workers, what comes back is kept in a scratch store, and once all
are there they become one product. The catalog and the scratch store are the only memory: killed at any moment, the
same command goes on where it was.
"""

from __future__ import annotations

import logging
import os
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Event, Lock
from typing import TYPE_CHECKING, Any, Protocol

from ..catalog.archive import ArchiveError
from ..catalog.database import passing
from ..catalog.kept import Kept
from ..catalog.products import assemble
from ..pipeline import batch as stages
from ..pipeline import description, strong_scintillation, surroundings
from ..pipeline.units import safe, text
from ..plugins.registry import PluginError
from . import logs
from .batches import FAILED, PATIENCE, Batches, Vanished, Workers
from .caches import cache_folder
from .options import Options
from .patience import patiently, unreachable
from .plan import ArchivePlan, plan_archive
from .settings import InputError, Unavailable
from .tasks import Origin, remember

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from distributed import Client
    from numpy.typing import NDArray

    from ..catalog.store import Catalog
    from .pulse import Pulse
    from .settings import Settings

log = logging.getLogger("coslidar")


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

    def warned(self, message: str) -> None:
        """Something is to be known that is no failure."""


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
        ``published``, ``present`` (nothing to do), ``skipped`` (not asked for), ``refused`` (its input is at fault),
        ``failed``, or ``cancelled`` (the run was interrupted).
    batches, failed_batches, reused, frames_read : int
        Batches in all, those that failed, those that were there already, and frames that were read.
    faults : tuple of str
        Why the archive was refused or failed, or which batches did.
    product : str
        Path of the product in the catalog.
    input_fault : bool
        Whether the fault lies in the data (exit code 2) rather than in the run.
    note : str
        Why it was skipped.
    transient : bool
        Whether it could not be reached, so that another run may find it whole.
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
    note: str = ""
    transient: bool = False


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
    progress : Pulse
        Who is told.
    options : Options
        What to do beside.
    """

    settings: Settings
    catalog: Catalog
    run: Any
    client: Client
    progress: Pulse
    options: Options = field(default_factory=Options)
    origin: Origin = field(default_factory=Origin.here)
    correlations: Kept = field(init=False)
    responses: Kept = field(init=False)
    workers: Workers = field(init=False)
    stopping: Event = field(default_factory=Event)
    spoiled: Event = field(default_factory=Event)
    _matrices: dict[str, dict[str, NDArray[Any]]] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    _warned: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.workers = Workers(self.client)
        self.correlations = kept_correlations(self.catalog.root)
        # A response matrix depends on no recording, so all catalogs of a user share theirs.
        self.responses = Kept(cache_folder() / "responses")

    def check(self) -> None:
        """Raise Stopped where the run is to stop, Unavailable where nothing is left to compute on."""
        if self.stopping.is_set():
            raise Stopped
        if self.client.status in ("closing", "closed"):
            raise lost(self.settings)

    def threads(self) -> int:
        """Threads of all workers, at least one: what is sent waits for a worker to come."""
        return max(1, sum(self.workers.known().values()))

    def check_workers(self) -> None:
        """Raise Unavailable where there has been no worker for too long."""
        if self.workers.missing():
            where = self.settings.run.scheduler or "this machine"
            raise Unavailable(
                f"the Dask scheduler at {where} has had no worker for {Workers.EMPTY:g} s; what was finished is kept, "
                "start workers and give the same command again"
            )

    def usable_workers(self) -> list[str] | None:
        """Workers that may be used; None for all of them."""
        if not self.workers.refused:
            return None
        usable = list(self.workers.known())
        if not usable:
            raise Unavailable(
                f"versions differ: {'; '.join(sorted(set(self.workers.refused.values())))}; install the same "
                "environment everywhere"
            )
        return usable

    def refuse(self, worker: str, reason: str) -> None:
        """Send nothing more to a worker."""
        self.workers.refuse(worker, reason)
        self.warn(f"a worker is not used, for its versions differ: {reason}")

    def warn(self, message: str) -> None:
        """Say once what is no failure and yet to be known."""
        with self._lock:
            news = message not in self._warned
            self._warned.add(message)
        if news:
            log.warning("%s", message)
            self.progress.warned(message)

    def responses_of(self, plan: ArchivePlan) -> dict[str, NDArray[Any]]:
        """Response matrix M, and those of stronger scintillation; computed once for all archives of one geometry."""
        with self._lock:
            digest = str(plan.response_key)
            found = self._matrices.get(digest)
            if found is None:
                found = self.responses.load(digest)
            if found is None:
                found = strong_scintillation.responses(
                    plan.geometry,
                    plan.grid,
                    plan.spectrum,
                    plan.sources,
                    self.settings.configuration.response,
                )
                with suppress(OSError):  # a cache that cannot be written only costs time
                    self.responses.save(digest, found)
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
    responses = work.responses_of(plan)
    return stages.Model(
        geometry=plan.geometry,
        grid=plan.grid,
        matrix=responses["M"],
        sampling=work.settings.configuration.response.sampling,
        regulariser=plan.regulariser,
        selector=plan.selector,
        inversion=work.settings.configuration.inversion,
        scintillometers=description.scintillometer_weights(
            plan.header, plan.grid, work.settings.configuration.response.sampling
        ),
        height_factors=description.scintillometer_factors(plan.header, plan.grid),
        strong=strong_scintillation.from_responses(
            responses, plan.geometry, plan.grid, work.settings.configuration.response.sampling
        ),
        surroundings=plan.surroundings,
    )


def process_archive(url: str, work: Work) -> ArchiveOutcome:
    """Process one archive; never raises for what is wrong with it."""
    with logs.about(run=work.run, archive=safe(url)):
        outcome = _outcome(url, work)
    if outcome.status == "cancelled":
        return outcome
    with logs.about(run=work.run, archive=outcome.name):
        if outcome.status in ("refused", "failed"):
            work.spoiled.set()
            for fault in outcome.faults:
                log.error("%s", fault)
                if not outcome.batches:  # those of its batches were recorded as they came
                    reason = f"transient: {fault}" if outcome.transient else fault
                    work.catalog.record_failure(work.run, url, reason)
        log.info(
            "archive %s: %d of %d batches", outcome.status, outcome.batches - outcome.failed_batches, outcome.batches
        )
    work.progress.finished(outcome)
    return outcome


def _outcome(url: str, work: Work) -> ArchiveOutcome:
    name = safe(url)
    try:
        work.check()
        if work.spoiled.is_set() and not work.options.keep_going:
            return ArchiveOutcome(url, name, "skipped", note="not begun, because another archive failed")
        plan = plan_archive(url, work.settings)
        name = plan.name
        if not work.options.wants(plan):
            return ArchiveOutcome(url, name, "skipped", note="outside the range of time")
        with logs.about(archive=name):
            # What was computed is kept, so another try goes on where the database was lost.
            return patiently(lambda: _process(plan, work), lambda error: passing(error) or isinstance(error, Vanished))
    except (ArchiveError, InputError, PluginError) as error:
        if unreachable(error):
            return ArchiveOutcome(url, name, "failed", faults=tuple(error.faults), transient=True)
        return ArchiveOutcome(url, name, "refused", faults=tuple(error.faults), input_fault=True)
    except Stopped:
        return ArchiveOutcome(url, name, "cancelled")
    except Unavailable:
        raise
    except Exception as error:
        if work.client.status != "running":
            raise lost(work.settings) from error
        # Whatever else goes wrong with one archive must not take the others down.
        log.debug("archive %s failed", url, exc_info=True)
        return ArchiveOutcome(url, name, "failed", faults=(f"{name}: {type(error).__name__}: {safe(str(error))}",))


def _process(plan: ArchivePlan, work: Work) -> ArchiveOutcome:
    catalog, digest = work.catalog, str(plan.profile_key)
    again = False
    if catalog.has(plan.archive.identity, digest):
        row = catalog.products(archive_identity=plan.archive.identity, lineage_key=digest)[0]
        failed = sum(bool(batch.quality_flag & FAILED) for batch in catalog.batches(lineage_key=digest))
        again = work.options.retry_failed and failed > 0
        if not again:
            # The same command says the same again, whether it is the first or the second time that it gets so far.
            return ArchiveOutcome(
                plan.url,
                plan.name,
                "present",
                batches=row.batches,
                failed_batches=failed,
                product=str(row.path),
                input_fault=failed > 0,
            )
    remember(plan.archive)
    batches = Batches(plan, work)
    work.progress.planned(plan.name, len(batches.todo))
    log.info("%d of %d batches to compute", len(batches.todo), len(plan.windows))
    batches.compute(lambda: model_of(plan, work))
    spoiled = sorted((number, reason) for number, reason in batches.done.items() if reason)
    faults = tuple(f"{plan.name}: batch {number}: {reason}" for number, reason in spoiled)
    counts: dict[str, Any] = {
        "batches": len(batches.done),
        "failed_batches": len(faults),
        "reused": batches.reused,
        "frames_read": batches.frames_read,
    }
    if len(faults) == len(batches.done) or batches.transient:
        # What the machine spoiled may succeed next time; what the data forbid never will.
        return ArchiveOutcome(plan.url, plan.name, "failed", faults=faults, input_fault=not batches.transient, **counts)
    header, results = plan.header, batches.results()
    dataset = assemble(
        results,
        description.describe(model_of(plan, work), header) | surroundings.compared(results),
        campaign=header.campaign,
        archive=header.archive,
        archive_identity=plan.archive.identity,
        lineage=plan.profile_key,
        wavelength=header.instrument.wavelength,
        sources=plan.source_names,
        scintillometers=[scintillometer.name for scintillometer in header.scintillometers],
        attributes=attributes_of(plan, work.settings),
    )
    published = catalog.publish(dataset, work.run, url=lasting(plan.url), header=plan.archive.attributes, replace=again)
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


def lasting(url: str) -> str:
    """The URL, or the path as it is from any folder."""
    return url if "://" in url or "::" in url else os.path.abspath(url)


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
        "aperture": parameters.response.aperture,
        "tilt": parameters.response.tilt,
        "band": parameters.response.band.text() if parameters.response.band else "single wavelength",
        "scintillation": parameters.response.scintillation,
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
        for key in ("latitude", "longitude"):
            if (value := getattr(header.site, key)) is not None:
                attributes[f"site_{key}"] = text(value, "deg")
    return attributes


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

    Raises
    ------
    Stopped
        The run was told to stop.
    """
    outcomes = fan_out(process_archive, list(archives), work)
    if work.stopping.is_set():
        raise Stopped
    complete = all(outcome.status in ("published", "present", "skipped") for outcome in outcomes)
    patiently(lambda: work.catalog.finish_run(work.run, "finished" if complete else "failed"), passing)
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
