"""Dask: where the batches are computed. Imports no Prefect."""

from __future__ import annotations

import json
import logging
import os
import re
import socket
import warnings
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..pipeline.units import safe
from .caches import cache_folder
from .jobs import submitted, tls_security
from .memory import few_heaps
from .settings import InputError, Unavailable
from .tasks import differences, versions

if TYPE_CHECKING:
    from collections.abc import Iterator

    from distributed import Client

    from .run_parameters import RunParameters

#: A batch that has been lost with its worker more often than this is taken for poison.
ALLOWED_FAILURES = 3
#: How long a cluster may take to answer, and to have its first worker, s.
PATIENCE = 15


def _settings() -> dict[str, Any]:
    return {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        "distributed.admin.tick.limit": "60s",
        # Dask looks fifty times a second whether it is late, and twice at its machine: nobody reads what it sees.
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.system-monitor.interval": "5s",
        "distributed.worker.memory.terminate": 0.95,
        # Its samples of a quarter of an hour are a hundred MB that nobody looks at.
        "distributed.worker.profile.enabled": False,
    }


def cores() -> int:
    """Cores of this machine that this process may use."""
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

    # Prefect gives every logger a handler; what went wrong in a batch is told once, by the driver.
    for name in [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    # Kernels release the GIL, so threads of one process use every core, start at once and share the archive.
    threads = run.threads or cores()
    few_heaps(threads)
    with ExitStack() as made, dask.config.set(_settings()):
        if run.scheduler is None and run.jobs is None:
            client = Client(
                processes=False,
                n_workers=1,
                threads_per_worker=threads,
                memory_limit=0,
                # Nobody else's arrays are to be computed there once it is closed.
                set_as_default=False,
                # Nothing of ours listens beyond this machine, not even a page without figures.
                dashboard_address="127.0.0.1:0",
                worker_dashboard_address="127.0.0.1:0",
            )
        else:
            client = _elsewhere(run, made)
        try:
            if run.scheduler is not None:
                check_workers(client, f"the Dask scheduler at {run.scheduler}")
            elif run.jobs is not None:
                check_workers(client, f"the cluster of {run.jobs.system} jobs", run.jobs.patience)
            yield client
        finally:
            client.close()
            _let_go()


def _let_go() -> None:
    """Forget the schedulers and workers of this process that are closed.

    distributed remembers for every handler it ever called whether that takes a connection, and keeps with the handler
    whom it belongs to; a service that runs again and again would keep them all.
    """
    from distributed import core

    if (remembered := getattr(core, "_expects_comm", None)) is not None:
        remembered.cache_clear()


def _elsewhere(run: RunParameters, made: ExitStack) -> Client:
    """Client of a cluster that is not in this process; `made` ends what was started for it."""
    from distributed import Client
    from distributed.versions import VersionMismatchWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VersionMismatchWarning)  # we refuse, and say more
        if run.jobs is not None:
            return Client(made.enter_context(submitted(run.jobs, cache_folder() / "jobs")), set_as_default=False)
        address = scheduler_address(str(run.scheduler))
        if address.startswith("tls://") and run.tls is None:
            raise InputError(
                [
                    f"run.scheduler = {run.scheduler!r}: a tls:// scheduler needs certificates; add a table [run.tls] "
                    "with ca_file, certificate and key to the campaign file"
                ]
            )
        security = None if run.tls is None else tls_security(run.tls)
        try:
            return Client(address, timeout=PATIENCE, set_as_default=False, security=security)
        except (OSError, ValueError, TimeoutError) as error:
            raise _no_scheduler(address, error) from error


def check_workers(client: Client, address: str, patience: float = PATIENCE) -> None:
    """Refuse a cluster without workers, or with other packages than ours: numbers would depend on where a batch ran.

    Parameters
    ----------
    client : distributed.Client
        Connected to a cluster of somebody else.
    address : str
        What the user calls it.
    patience : float
        How long the first worker may take, s.

    Raises
    ------
    Unavailable
        No worker comes, or its versions differ.
    """
    try:
        client.wait_for_workers(1, timeout=patience)
    except TimeoutError as error:
        remedy = f"start some with 'dask worker {client.scheduler.address}'"
        if client.cluster is not None:
            remedy = f"none started within {patience:g} s (run.jobs.patience); their output says why"
        raise Unavailable(f"{address} has no worker; {remedy}") from error
    try:
        theirs = client.run(versions)
    except Exception as error:
        raise Unavailable(
            f"the workers of {address} cannot run coslidar ({type(error).__name__}: {error}); "
            "install the same environment on every worker"
        ) from error
    wrong = sorted({line for worker, found in theirs.items() for line in differences(found, versions(), worker)})
    if wrong:
        raise Unavailable(f"versions differ: {'; '.join(wrong)}; install the same environment everywhere")
