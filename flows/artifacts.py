"""What a Prefect page shows of a run: a table of its progress, and a link to the report."""

from __future__ import annotations

import logging
from contextlib import suppress
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

from prefect.artifacts import TableArtifact, create_link_artifact
from prefect.client.orchestration import get_client
from prefect.client.schemas.actions import ArtifactUpdate

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType
    from uuid import UUID

    from .pulse import Pulse

log = logging.getLogger("coslidar")

#: Shortest time between two updates, s.
EVERY = 1.0


def rows(state: dict[str, Any]) -> list[dict[str, Any]]:
    """Table of a run's progress.

    Parameters
    ----------
    state : dict
        From :meth:`coslidar.flows.pulse.Pulse.state`.

    Returns
    -------
    list of dict
        One row for each archive that is being worked on, and one for the run.
    """
    counts = {**dict(sorted(state["current"].items())), "all": state["batches"]}
    done = sum(state["outcomes"].values())
    told = ", ".join(f"{number} {status}" for status, number in sorted(state["outcomes"].items()))
    return [
        {
            "archive": f"{done} of {state['archives']} archives done" if name == "all" else name,
            "batches": one["todo"],
            "computed": one["done"] - one["failed"],
            "failed": one["failed"],
            "outcome": told if name == "all" else "in progress",
        }
        for name, one in counts.items()
    ]


class ProgressTable:
    """One artifact of the present flow run that follows its pulse; a server that is busy never stops the run."""

    def __init__(self, pulse: Pulse, key: str) -> None:
        self.pulse = pulse
        self.key = key
        self._over = Event()
        self._shown: list[dict[str, Any]] = []
        self._artifact: UUID | None = None
        self._thread = Thread(target=self._live, name="artifact", daemon=True)

    def __enter__(self) -> ProgressTable:
        self._shown = rows(self.pulse.state())
        try:
            # Made here, where Prefect knows the flow run; the thread only rewrites it.
            made = TableArtifact(key=self.key, table=self._shown, description="Progress of the run").create()
            self._artifact = made.id  # type: ignore[union-attr]
            self._thread.start()
        except Exception:
            log.debug("no progress table", exc_info=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(10)

    def _live(self) -> None:
        import json

        ended = False
        with get_client(sync_client=True) as client:
            while not ended:
                ended = self._over.wait(EVERY)
                now = rows(self.pulse.state())
                if now != self._shown and self._artifact is not None:
                    try:
                        client.update_artifact(self._artifact, ArtifactUpdate(data=json.dumps(now)))
                        self._shown = now
                    except Exception:
                        log.debug("the progress table could not be written", exc_info=True)


def link_report(report: Path) -> None:
    """Link a report from the page of the present flow run."""
    with suppress(Exception):
        create_link_artifact(link=report.resolve().as_uri(), key="report", link_text="Report of this campaign")
