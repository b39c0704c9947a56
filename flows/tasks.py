"""What a worker does with one batch. Imports Dask only to know its own name; imports no Prefect."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from ..catalog.archive import ArchiveError, ChunkError, open_archive
from ..catalog.measurements import MeasurementStore
from ..pipeline import batch as stages
from ..pipeline.extraction import Calibration
from ..pipeline.units import safe
from ..plugins.registry import KINDS
from . import logs, patience

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from ..catalog.archive import Archive
    from ..pipeline.batch import Model, ReducedBatch
    from ..pipeline.geometry import Geometry
    from ..pipeline.parameters import CorrelationParameters, ExtractionParameters, Header
    from ..pipeline.products import BatchResult, Measurements
    from .plan import BatchWindow

log = logging.getLogger("coslidar")

#: Archives that a worker keeps open.
MAX_OPEN = 8


@dataclass(frozen=True)
class Origin:
    """The process that drives a run, so that a worker knows whether it is another one, and of the same versions.

    Parameters
    ----------
    host : str
        Its machine.
    process : int
        Its number there.
    versions : dict of str to str
        What it computes with.
    level : int
        Least level of log records it wants to have.
    """

    host: str
    process: int
    versions: dict[str, str]
    level: int

    @classmethod
    def here(cls) -> Origin:
        """The process that this runs in."""
        return cls(socket.gethostname(), os.getpid(), versions(), log.getEffectiveLevel())

    @property
    def elsewhere(self) -> bool:
        """Whether it is another process than the one that asks."""
        return (self.host, self.process) != (socket.gethostname(), os.getpid())


@dataclass(frozen=True, eq=False)
class BatchTask:
    """One batch, small enough to travel.

    Parameters
    ----------
    origin : Origin
        Who asks.
    run : str
        In which run.
    url, identity, name : str
        The archive, what it was when the run was planned, and what people call it.
    window : BatchWindow
        Frames of the batch.
    header : Header
        Effective header.
    geometry : Geometry
        Pupil and the sources that are used.
    duration : float
        Requested length of a batch, s.
    extraction, correlation
        Parameters of the stages.
    complete : dict
        Tables of the campaign on top of the archive's header.
    reduced : ReducedBatch or None
        Correlations that are already there; no frame is read then.
    neighbours : tuple of ReducedBatch
        Correlations of the batches around it, for selectors that look at several.
    measurements : str
        Folder of kept slopes and fluxes.
    measurement_key : str
        Key of those of this batch.
    keep : bool
        Whether to keep them.
    """

    origin: Origin
    run: str
    url: str
    identity: str
    name: str
    window: BatchWindow
    header: Header
    geometry: Geometry
    duration: float
    extraction: ExtractionParameters
    correlation: CorrelationParameters
    complete: dict[str, Any]
    measurements: str
    measurement_key: str
    keep: bool = False
    reduced: ReducedBatch | None = None
    neighbours: tuple[ReducedBatch, ...] = ()


@dataclass(frozen=True, eq=False)
class BatchOutcome:
    """What comes back from a worker.

    Parameters
    ----------
    window : BatchWindow
        Which batch.
    result : BatchResult or None
        Its contribution to the product; None where only correlations were asked for and came out.
    reduced : ReducedBatch or None
        Correlations, where they were computed just now.
    frames_read : int
        Frames that were read for it.
    transient : bool
        Whether it failed for a reason in the machine, so that another try may succeed.
    lasting : bool
        Whether the same archive gives the same result again. A damaged chunk may be mended, and the archive keeps
        its identity then.
    reduce_seconds, retrieve_seconds : float
        Time that frames to correlations and correlations to profile took.
    unkept : str
        Why slopes and fluxes could not be kept.
    refused : str
        Why this worker is not to be used.
    worker : str
        Its address.
    records : tuple of dict
        What it logged, where it is another process than the driver.
    """

    window: BatchWindow
    result: BatchResult | None
    reduced: ReducedBatch | None = None
    frames_read: int = 0
    transient: bool = False
    lasting: bool = True
    reduce_seconds: float = 0.0
    retrieve_seconds: float = 0.0
    unkept: str = ""
    refused: str = ""
    worker: str = ""
    records: tuple[dict[str, Any], ...] = ()


class ArchiveChanged(RuntimeError):
    """An archive is not what it was when the run was planned."""


# --- what a process has of its own -------------------------------------------------------------------------

_open: OrderedDict[str, Archive] = OrderedDict()
_open_lock = Lock()


def _archive(url: str, identity: str, complete: dict[str, Any]) -> Archive:
    """The archive, opened once per process and checked to be the one that was planned."""
    with _open_lock:
        archive = _open.get(identity)
        if archive is None:
            # As the plan opened it: what is missing spoils its batch only.
            archive = patience.patiently(
                lambda: open_archive(url, complete=complete, allow_missing=True), patience.unreachable
            )
            if archive.identity != identity:
                raise ArchiveChanged(f"{url} has changed since the run was planned; start the run again")
            _keep_open(archive)
    return archive


def _keep_open(archive: Archive) -> None:
    _open[archive.identity] = archive
    while len(_open) > MAX_OPEN:
        _open.popitem(last=False)


def remember(archive: Archive) -> None:
    """Let the workers of this process use an archive that is open already."""
    with _open_lock:
        _keep_open(archive)


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Versions of what can change a number, or could not talk to another version of itself; plugins included."""
    import platform
    from importlib.metadata import entry_points, version

    names = ("coslidar", "numpy", "scipy", "numba", "zarr", "numcodecs", "dask", "distributed")
    # Two checkouts of one release differ in their stages.
    numbers = (stages.MEASURE_VERSION, stages.REDUCE_VERSION, stages.RESPONSE_VERSION, stages.RETRIEVE_VERSION)
    plugins = {
        point.dist.name: point.dist.version
        for group, _ in KINDS.values()
        for point in entry_points(group=group)
        if point.dist is not None
    }
    return {
        "python": platform.python_version(),
        **plugins,
        **{name: version(name) for name in names},
        "stages of coslidar": ".".join(map(str, numbers)),
    }


def differences(theirs: dict[str, str], mine: dict[str, str], worker: str) -> list[str]:
    """What differs between a worker and the driver, both versions named."""
    return [
        f"{name} is {theirs.get(name, 'not installed')} on worker {worker} and {found} here"
        for name, found in mine.items()
        if theirs.get(name) != found
    ]


@lru_cache(maxsize=1)
def one_thread() -> None:
    """Let numerical libraries of this worker use one thread, however it was started: batches run in parallel."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(limits=1)


def _address() -> str:
    from distributed import get_worker

    try:
        return str(get_worker().address)
    except ValueError:  # called by hand
        return socket.gethostname()


# --- one batch ---------------------------------------------------------------------------------------------


def process_batch(task: BatchTask, model: Model | None) -> BatchOutcome:
    """Frames to profile, on a worker; to correlations only where there is no model.

    Never raises: what the data forbid becomes a failed result with its reason, and so does what goes wrong with the
    machine, which another try may mend. Exceptions do not travel: not all can, and one that cannot hangs the run.
    """
    place = {"run": task.run, "archive": task.name, "batch": task.window.index}
    if not task.origin.elsewhere:
        with logs.about(**place):
            return _process(task, model)
    worker = _address()
    # Workers that join while a run is under way are seen by nobody before their first batch.
    if wrong := differences(versions(), task.origin.versions, worker):
        return BatchOutcome(task.window, None, refused="; ".join(wrong), worker=worker)
    one_thread()
    with logs.collected(task.origin.level) as records, logs.about(**place):
        outcome = _process(task, model)
    return replace(outcome, worker=worker, records=tuple(records))


def _process(task: BatchTask, model: Model | None) -> BatchOutcome:
    window, spent, done = task.window, [time.perf_counter()], BatchOutcome(task.window, None)
    try:
        reduced = task.reduced
        if reduced is None:
            store = MeasurementStore(task.measurements)
            measured = store.load(task.measurement_key)
            if measured is None:
                done = replace(done, frames_read=window.stop - window.start)
                measured = _measure(task)
                if task.keep:
                    done = replace(done, unkept=_keep(store, task, measured))
            reduced = stages.reduce(
                measured, task.geometry, task.header.instrument.frame_rate, task.duration, task.correlation
            )
            done = replace(done, reduced=reduced)
        spent.append(time.perf_counter())
        if model is not None:
            done = replace(done, result=stages.retrieve(reduced, model, task.neighbours))
        log.info("batch done, %d frames read", done.frames_read)
    except (stages.BatchError, ChunkError) as error:
        transient = isinstance(error, ChunkError) and error.transient
        done = replace(
            _failed(done, window, str(error)), lasting=isinstance(error, stages.BatchError), transient=transient
        )
    except Exception as error:
        log.debug("batch failed", exc_info=True)
        # The driver could open it.
        what = (
            "the archive cannot be opened there: " if isinstance(error, ArchiveError) else f"{type(error).__name__}: "
        )
        reason = f"worker on {socket.gethostname()}: {what}{safe(str(error))}"
        done = replace(_failed(done, window, reason), lasting=False, transient=True)
    spent.append(time.perf_counter())
    return replace(done, reduce_seconds=spent[1] - spent[0], retrieve_seconds=spent[-1] - spent[1])


def _failed(done: BatchOutcome, window: BatchWindow, reason: str) -> BatchOutcome:
    log.warning("batch failed: %s", reason)
    return replace(done, result=stages.failed(window.start_time, window.stop_time, reason))


def _measure(task: BatchTask) -> Measurements:
    """Slopes and fluxes of the frames."""
    window = task.window
    archive = _archive(task.url, task.identity, task.complete)
    calibration = Calibration(
        dark=archive.dark,
        flat=archive.flat,
        bad_pixel=archive.bad_pixel,
        saturation=task.header.instrument.saturation,
    )
    return stages.measure(
        frames(archive, window.start, window.stop, task.extraction.reference_frames),
        archive.time[window.start : window.stop],
        task.header,
        calibration,
        task.extraction,
    )


def _keep(store: MeasurementStore, task: BatchTask, measured: Measurements) -> str:
    """Keep slopes and fluxes; why that could not be done."""
    try:
        store.save(task.measurement_key, measured)
    except OSError as error:
        return f"{task.measurements} on {socket.gethostname()}: {error.strerror}"
    return ""


def frames(archive: Archive, start: int, stop: int, together: int = 1) -> Iterator[NDArray[Any]]:
    """Blocks of frames, tried again where a network failed and damage is not the reason.

    Those that hold the last `together` frames stay as they are; memory of earlier ones is used again.
    """
    tries = 0
    keep = -(-(together - 1) // archive.chunk_frames) + 1
    while start < stop:
        try:
            for first, block in archive.chunks(start, stop, keep=keep):
                yield block
                start, tries = first + len(block), 0
        except ChunkError as error:
            if not error.transient or tries == len(patience.PAUSES):
                raise
            log.warning("%s; trying again in %g s", error, patience.PAUSES[tries])
            time.sleep(patience.PAUSES[tries])
            tries += 1


# --- correlations as files ---------------------------------------------------------------------------------


def as_stored(reduced: ReducedBatch) -> dict[str, NDArray[Any]]:
    """Arrays of a reduced batch with its bounds, ready for a file."""
    return {
        **reduced.arrays,
        "start": np.asarray(reduced.start),
        "stop": np.asarray(reduced.stop),
        "quality_flag": np.asarray(reduced.quality_flag),
    }


def from_stored(arrays: dict[str, NDArray[Any]]) -> ReducedBatch:
    """Inverse of :func:`as_stored`."""
    rest = dict(arrays)
    start, stop, flag = (int(rest.pop(name)) for name in ("start", "stop", "quality_flag"))
    return stages.ReducedBatch(start=start, stop=stop, quality_flag=flag, arrays=rest)
