"""Dask: where the batches are computed. The driver of one archive; imports no Prefect."""

from __future__ import annotations

import logging
import os
from collections import OrderedDict
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from ..catalog.archive import ArchiveError, ChunkError, open_archive
from ..pipeline import batch as stages
from ..pipeline.extraction import Calibration

if TYPE_CHECKING:
    from collections.abc import Iterator

    from distributed import Client

    from ..catalog.archive import Archive
    from ..pipeline.batch import Model, ReducedBatch
    from ..pipeline.parameters import CorrelationParameters, ExtractionParameters, Header
    from ..pipeline.products import BatchResult
    from .plan import BatchWindow
    from .settings import RunParameters

#: A worker that has been lost this often to one batch takes that batch for poison.
ALLOWED_FAILURES = 3


@dataclass(frozen=True, eq=False)
class BatchTask:
    """One batch, small enough to travel.

    Parameters
    ----------
    url, identity : str
        The archive, and what it was when the run was planned.
    window : BatchWindow
        Frames of the batch.
    header : Header
        Effective header.
    duration : float
        Requested length of a batch, s.
    extraction, correlation
        Parameters of the stages.
    reduced : ReducedBatch or None
        Correlations that are already there; no frame is read then.
    """

    url: str
    identity: str
    window: BatchWindow
    header: Header
    duration: float
    extraction: ExtractionParameters
    correlation: CorrelationParameters
    reduced: ReducedBatch | None = None


@dataclass(frozen=True, eq=False)
class BatchOutcome:
    """What comes back from a worker.

    Parameters
    ----------
    window : BatchWindow
        Which batch.
    result : BatchResult
        Its contribution to the product.
    reduced : ReducedBatch or None
        Correlations, where they were computed just now.
    frames_read : int
        Frames that were read for it.
    transient : bool
        Whether it failed for a reason in the machine, so that another try may succeed.
    """

    window: BatchWindow
    result: BatchResult
    reduced: ReducedBatch | None
    frames_read: int
    transient: bool = False


_open: OrderedDict[str, Archive] = OrderedDict()
_open_lock = Lock()


def _archive(url: str, identity: str) -> Archive:
    """The archive, opened once per process and checked to be the one that was planned."""
    with _open_lock:
        archive = _open.get(identity)
        if archive is None:
            archive = open_archive(url)
            if archive.identity != identity:
                raise stages.BatchError(f"{url} has changed since the run was planned; start the run again")
            _open[identity] = archive
            while len(_open) > 8:
                _open.popitem(last=False)
    return archive


def remember(archive: Archive) -> None:
    """Let the workers of this process use an archive that is open already."""
    with _open_lock:
        _open[archive.identity] = archive


def process_batch(task: BatchTask, model: Model) -> BatchOutcome:
    """Frames to profile, on a worker.

    What the data forbid becomes a failed result with its reason; anything else is raised.
    """
    reduced, new, window = task.reduced, None, task.window
    try:
        if reduced is None:
            archive = _archive(task.url, task.identity)
            calibration = Calibration(
                dark=archive.dark,
                flat=archive.flat,
                bad_pixel=archive.bad_pixel,
                saturation=task.header.instrument.saturation,
            )
            measurements = stages.measure(
                (block for _, block in archive.chunks(window.start, window.stop)),
                archive.time[window.start : window.stop],
                task.header,
                calibration,
                task.extraction,
            )
            reduced = new = stages.reduce(
                measurements,
                model.geometry,
                task.header.instrument.frame_rate,
                task.duration,
                task.correlation,
            )
        result = stages.retrieve(reduced, model)
    except (stages.BatchError, ChunkError, ArchiveError) as error:
        result = stages.failed(window.start_time, window.stop_time, str(error))
    return BatchOutcome(window, result, new, 0 if task.reduced is not None else window.stop - window.start)


def _settings() -> dict[str, Any]:
    return {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        "distributed.admin.tick.limit": "60s",
        "distributed.worker.memory.terminate": 0.95,
    }


@contextmanager
def connect(run: RunParameters) -> Iterator[Client]:
    """A Dask client: threads of this process, or a cluster by address or scheduler file.

    Parameters
    ----------
    run : RunParameters
        Where to compute.

    Yields
    ------
    distributed.Client

    Raises
    ------
    ConnectionError
        No scheduler answers, or its workers run other versions.
    """
    import dask
    from distributed import Client

    # Prefect gives every logger a handler; what went wrong in a batch is told once, by the driver.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    # Kernels release the GIL, so threads of one process use every core, start at once and share the archive.
    threads = run.threads or len(os.sched_getaffinity(0))
    with dask.config.set(_settings()):
        if run.scheduler is None:
            client = Client(
                processes=False,
                n_workers=1,
                threads_per_worker=threads,
                memory_limit=0,
                # Nothing of ours listens beyond this machine, not even a page without figures.
                dashboard_address="127.0.0.1:0",
                worker_dashboard_address="127.0.0.1:0",
            )
        else:
            address: dict[str, Any] = (
                {"scheduler_file": run.scheduler} if Path(run.scheduler).is_file() else {"address": run.scheduler}
            )
            try:
                client = Client(**address, timeout="20s", set_as_default=False)
            except (OSError, ValueError, TimeoutError) as error:
                raise ConnectionError(
                    f"no Dask scheduler answers at {run.scheduler} ({type(error).__name__}: {error}); start one with "
                    "'dask scheduler', or leave --scheduler out to compute on this machine"
                ) from error
        try:
            if run.scheduler is not None:
                _same_versions(client)
            yield client
        finally:
            client.close()


def _same_versions(client: Client) -> None:
    """Refuse a cluster whose packages differ from ours: numbers would depend on where a batch ran."""
    import importlib.metadata as metadata

    names = ("coslidar", "numpy", "scipy", "numba", "zarr", "numcodecs", "dask", "distributed")

    def versions() -> dict[str, str]:
        return {name: metadata.version(name) for name in names}

    mine = versions()
    try:
        theirs = client.run(versions)
    except Exception as error:
        raise ConnectionError(
            f"the workers of {client.scheduler.address} cannot run coslidar ({type(error).__name__}: {error}); "
            "install the same environment on every worker"
        ) from error
    wrong = sorted(
        {
            f"{name} is {found[name]} on worker {worker} and {mine[name]} here"
            for worker, found in theirs.items()
            for name in names
            if found[name] != mine[name]
        }
    )
    if wrong:
        raise ConnectionError(f"versions differ: {'; '.join(wrong)}; install the same environment everywhere")


def as_stored(reduced: ReducedBatch) -> dict[str, np.ndarray[Any, Any]]:
    """Arrays of a reduced batch with its bounds, ready for a file."""
    return {
        **reduced.arrays,
        "start": np.asarray(reduced.start),
        "stop": np.asarray(reduced.stop),
        "quality_flag": np.asarray(reduced.quality_flag),
    }


def from_stored(arrays: dict[str, np.ndarray[Any, Any]]) -> ReducedBatch:
    """Inverse of :func:`as_stored`."""
    rest = dict(arrays)
    start, stop, flag = (int(rest.pop(name)) for name in ("start", "stop", "quality_flag"))
    return stages.ReducedBatch(start=start, stop=stop, quality_flag=flag, arrays=rest)
