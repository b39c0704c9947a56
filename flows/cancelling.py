"""A run whose flow run is cancelled on a Prefect server stops, also where nothing of Prefect's watches its process."""

from __future__ import annotations

import logging
from threading import Event, Thread
from typing import TYPE_CHECKING

from prefect.client.orchestration import get_client
from prefect.runtime import flow_run

if TYPE_CHECKING:
    from types import TracebackType

    from .driver import Work

log = logging.getLogger("coslidar")

#: How often the server is asked, s.
EVERY = 2.0


class Cancellation:
    """Asks for the state of the present flow run, and stops the work where somebody has cancelled it.

    Prefect ends the processes that its own workers have started. A run that a person has started has no such worker:
    ``prefect flow-run cancel`` and the button of the page would leave it at work.

    Parameters
    ----------
    work : Work
        What is to stop.
    """

    def __init__(self, work: Work) -> None:
        self.work = work
        self._over = Event()
        self._flow_run = flow_run.id
        self._thread = Thread(target=self._live, name="cancellation", daemon=True)

    def __enter__(self) -> Cancellation:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join(10)

    def _live(self) -> None:
        with get_client(sync_client=True) as client:
            while not self._over.wait(EVERY):
                try:
                    state = client.read_flow_run(self._flow_run).state
                except Exception:  # a server that is busy never stops a run
                    log.debug("the state of the flow run is not known", exc_info=True)
                    continue
                if state is not None and (state.is_cancelling() or state.is_cancelled()):
                    log.warning("the flow run was cancelled on its server")
                    self.work.stopping.set()
                    return
