"""A run: the catalog opened, the cluster connected, the run recorded, and its end told.

What is slow to import is imported where it is used: a Prefect server takes longest, and starts before that.
"""

from __future__ import annotations

import logging
import os
import shlex
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from . import logs
from .settings import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .driver import ArchiveOutcome, Progress, Work
    from .options import Options
    from .settings import Settings


log = logging.getLogger("coslidar")


class Silent:
    """Progress that nobody watches."""

    def planned(self, archive: str, batches: int) -> None:
        """Nothing."""

    def advanced(self, archive: str, index: int, reason: str) -> None:
        """Nothing."""

    def warned(self, message: str) -> None:
        """Nothing."""

    def finished(self, outcome: ArchiveOutcome) -> None:
        """Nothing."""


def described(settings: Settings) -> dict[str, Any]:
    """Settings as plain JSON, for the record of a run."""
    return {
        "campaign": settings.campaign,
        "origin": settings.origin,
        "archives": len(settings.archives),
        "configuration": settings.configuration.model_dump(mode="json"),
        "plugins": settings.plugins,
        "header": settings.header,
        "run": settings.run.model_dump(mode="json"),
        "keep": list(settings.keep),
        "surroundings": settings.surroundings.model_dump(mode="json"),
        "folder": os.getcwd(),
    }


@contextmanager
def session(settings: Settings, progress: Progress | None = None, options: Options | None = None) -> Iterator[Work]:
    """Open what the archives of one run share, and close it in any case.

    Parameters
    ----------
    settings : Settings
        What to compute, and where.
    progress : Progress, optional
        Who is told.
    options : Options, optional
        What to do beside the settings.

    Yields
    ------
    Work

    Raises
    ------
    InputError
        The catalog cannot be used.
    Unavailable
        The cluster cannot be used.
    """
    from threadpoolctl import threadpool_limits

    from ..catalog.database import DatabaseError
    from ..catalog.store import Catalog, CatalogError
    from .cluster import connect
    from .driver import Work
    from .options import Options
    from .pulse import Pulse

    try:
        opened = Catalog(settings.output)
    except (CatalogError, DatabaseError) as error:
        raise InputError([str(error)]) from error
    # Batches run in parallel, so numerical libraries use one thread each, also where Python was not started by us.
    with opened as catalog, threadpool_limits(limits=1), connect(settings.run) as client:
        identity = catalog.start_run(described(settings), shlex.join(sys.argv))
        threads = sum(client.nthreads().values())
        pulse = Pulse(catalog, identity, progress or Silent(), len(settings.archives), threads)
        work = Work(settings, catalog, identity, client, pulse, options or Options())
        try:
            with pulse, logs.about(run=identity):
                log.info("archives: %d, threads: %d, catalog: %s", len(settings.archives), threads, settings.output)
                yield work
        except BaseException as error:
            work.stopping.set()
            with suppress(Exception):  # the catalog may be what failed
                catalog.finish_run(work.run, "failed" if isinstance(error, Exception) else "cancelled")
            raise


def run(
    settings: Settings, progress: Progress | None = None, *, prefect: bool = True, options: Options | None = None
) -> list[ArchiveOutcome]:
    """Process every archive of the settings.

    Parameters
    ----------
    settings : Settings
        From :func:`coslidar.flows.settings.load`.
    progress : Progress, optional
        Who is told how far it is.
    prefect : bool
        As a Prefect flow, or as a bare loop; the results are the same bytes.
    options : Options, optional
        What to do beside the settings; no number depends on it.

    Returns
    -------
    list of ArchiveOutcome
        In the order of the archives.

    Raises
    ------
    InputError
        The catalog cannot be used.
    Unavailable
        The cluster or the Prefect server cannot be used.
    """
    if not prefect:
        from .driver import execute, in_threads

        with session(settings, progress, options) as work:
            return execute(work, settings.archives, in_threads)
    from .server import server

    # The server starts while everything else is imported, and catalog and workers are opened.
    with server() as ready, session(settings, progress, options) as work:
        from .campaign import processing_flow

        ready()
        return processing_flow(settings, work)
