"""Dask: where the batches are computed. The driver of one archive; imports no Prefect."""

from __future__ import annotations

import json
import logging
import os
import re
import socket
import warnings
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
from ..pipeline.units import safe
from .settings import InputError, Unavailable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from distributed import Client

    from ..catalog.archive import Archive
    from ..pipeline.batch import Model, ReducedBatch
    from ..pipeline.parameters import CorrelationParameters, ExtractionParameters, Header
    from ..pipeline.products import BatchResult
    from .plan import BatchWindow
    from .settings import RunParameters

log = logging.getLogger("coslidar")

#: A batch that has been lost with its worker more often than this is taken for poison.
ALLOWED_FAILURES = 3
#: How long a cluster may take to answer, and to have its first worker, s.
PATIENCE = 15


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
    complete : dict
        Tables of the campaign on top of the archive's header.
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
    complete: dict[str, Any]
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
    lasting : bool
        Whether the same archive gives the same result again. A damaged chunk may be mended, and the archive keeps
        its identity then.
    """

    window: BatchWindow
    result: BatchResult
    reduced: ReducedBatch | None
    frames_read: int
    transient: bool = False
    lasting: bool = True


class ArchiveChanged(RuntimeError):
    """An archive is not what it was when the run was planned."""


#: Archives that a worker keeps open.
MAX_OPEN = 8
_open: OrderedDict[str, Archive] = OrderedDict()
_open_lock = Lock()


def _archive(url: str, identity: str, complete: dict[str, Any]) -> Archive:
    """The archive, opened once per process and checked to be the one that was planned."""
    with _open_lock:
        archive = _open.get(identity)
        if archive is None:
            # As the plan opened it: what is missing spoils its batch only.
            archive = open_archive(url, complete=complete, allow_missing=True)
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


def process_batch(task: BatchTask, model: Model) -> BatchOutcome:
    """Frames to profile, on a worker.

    Never raises: what the data forbid becomes a failed result with its reason, and so does what goes wrong with the
    machine, which another try may mend. Exceptions do not travel: not all can, and one that cannot hangs the run.
    """
    reduced, new, window = task.reduced, None, task.window
    lasting, transient = True, False
    try:
        if reduced is None:
            archive = _archive(task.url, task.identity, task.complete)
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
    except (stages.BatchError, ChunkError) as error:
        lasting = isinstance(error, stages.BatchError)
        result = stages.failed(window.start_time, window.stop_time, str(error))
    except Exception as error:
        log.debug("batch %s of %s failed", window.index, task.url, exc_info=True)
        lasting, transient = False, True
        # The driver could open it.
        what = (
            "the archive cannot be opened there: " if isinstance(error, ArchiveError) else f"{type(error).__name__}: "
        )
        reason = f"worker on {socket.gethostname()}: {what}{safe(str(error))}"
        result = stages.failed(window.start_time, window.stop_time, reason)
    read = 0 if task.reduced is not None else window.stop - window.start
    return BatchOutcome(window, result, new, read, transient=transient, lasting=lasting)


def _settings() -> dict[str, Any]:
    return {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        "distributed.admin.tick.limit": "60s",
        "distributed.worker.memory.terminate": 0.95,
    }


def _cores() -> int:
    # Not every core may be ours; macOS does not tell.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def scheduler_address(scheduler: str) -> str:
    """Address of a scheduler, and a look whether anything listens there.

    Dask itself tries for long, and ends badly where there is nothing.

    Parameters
    ----------
    scheduler : str
        Address, or path of a scheduler file.

    Returns
    -------
    str

    Raises
    ------
    InputError
        It is neither.
    Unavailable
        Nothing listens there.
    """
    address, path = scheduler, Path(scheduler)
    if path.is_file():
        try:
            address = str(json.loads(path.read_text("utf-8"))["address"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                [f"run.scheduler = {scheduler!r}: this is no scheduler file, as 'dask scheduler' writes one"]
            ) from error
    match = re.fullmatch(r"(?P<protocol>[a-z]+)://\[?(?P<host>[^\s\[\]]+?)\]?:(?P<port>\d{1,5})", address)
    if match is None:
        raise InputError(
            [
                f"run.scheduler = {scheduler!r}: this is neither an address nor a file that is there; write the "
                "address of a Dask scheduler ('tcp://10.0.0.1:8786', 'tls://…'), or the path of its scheduler file"
            ]
        )
    if match["protocol"] in ("tcp", "tls", "ws", "wss"):
        try:
            socket.create_connection((match["host"], int(match["port"])), PATIENCE).close()
        except (OSError, OverflowError) as error:
            raise _no_scheduler(address, error) from error
    return address


def _no_scheduler(address: str, error: Exception) -> Unavailable:
    return Unavailable(
        f"no Dask scheduler answers at {address} ({safe(str(error))}); start one with 'dask scheduler', or leave "
        "--scheduler out to compute on this machine"
    )


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
    InputError
        What should be an address is none.
    Unavailable
        No scheduler answers, it has no worker, or its workers run other versions.
    """
    import dask
    from distributed import Client
    from distributed.versions import VersionMismatchWarning

    # Prefect gives every logger a handler; what went wrong in a batch is told once, by the driver.
    for name in [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    # Kernels release the GIL, so threads of one process use every core, start at once and share the archive.
    threads = run.threads or _cores()
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
            address = scheduler_address(run.scheduler)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", VersionMismatchWarning)  # we refuse, and say more
                    client = Client(address, timeout=PATIENCE, set_as_default=False)
            except (OSError, ValueError, TimeoutError) as error:
                raise _no_scheduler(address, error) from error
        try:
            if run.scheduler is not None:
                check_workers(client, run.scheduler)
            yield client
        finally:
            client.close()


def _versions() -> dict[str, str]:
    import platform
    from importlib.metadata import version

    names = ("coslidar", "numpy", "scipy", "numba", "zarr", "numcodecs", "dask", "distributed")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


def check_workers(client: Client, address: str) -> None:
    """Refuse a cluster without workers, or with other packages than ours: numbers would depend on where a batch ran.

    Parameters
    ----------
    client : distributed.Client
        Connected to a cluster of somebody else.
    address : str
        What the user calls it.

    Raises
    ------
    Unavailable
        No worker comes, or its versions differ.
    """
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError as error:
        raise Unavailable(
            f"the Dask scheduler at {address} has no worker; start some with 'dask worker {client.scheduler.address}'"
        ) from error
    mine = _versions()
    try:
        theirs = client.run(_versions)
    except Exception as error:
        raise Unavailable(
            f"the workers of {address} cannot run coslidar ({type(error).__name__}: {error}); "
            "install the same environment on every worker"
        ) from error
    wrong = sorted(
        {
            f"{name} is {found.get(name)} on worker {worker} and {mine[name]} here"
            for worker, found in theirs.items()
            for name in mine
            if found.get(name) != mine[name]
        }
    )
    if wrong:
        raise Unavailable(f"versions differ: {'; '.join(wrong)}; install the same environment everywhere")


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
