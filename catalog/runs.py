"""The record of runs and of what failed in them."""

from __future__ import annotations

import os
import socket
import sys
import uuid
from collections.abc import Mapping
from time import time_ns
from typing import Any, Literal

import sqlalchemy as sa

from ..pipeline.lineage import checkout
from . import provenance as records
from .database import Database, plain_json, plain_text
from .heartbeats import alive
from .rows import FailureRow, RunRow
from .tables import failure, run

# A run is told by its pid; the column has had another name since the first version of the tables.
_RUN = [run.c.process.label("pid") if column.name == "process" else column for column in run.c]
State = Literal["finished", "failed", "cancelled"]


class RunLog:
    """Runs of a catalog."""

    database: Database

    def start_run(self, configuration: Mapping[str, Any] | None = None, command: str | None = None) -> str:
        """Note that a run begins.

        Runs of this host that still pass for running although their process is gone are noted as interrupted.

        Parameters
        ----------
        configuration : mapping, optional
            What was asked for, JSON-able.
        command : str, optional
            Command line; the one of this process where it is absent.

        Returns
        -------
        str
            Identity of the run.
        """
        identity, host, now = uuid.uuid4().hex, socket.gethostname(), time_ns()
        with self.database.write() as connection:
            running = sa.select(run.c.id, run.c.process).where(run.c.state == "running", run.c.host == host)
            gone = [row.id for row in connection.execute(running) if not alive(row.process)]
            if gone:
                connection.execute(sa.update(run).where(run.c.id.in_(gone)).values(state="interrupted"))
            connection.execute(
                sa.insert(run).values(
                    id=identity,
                    started=now,
                    heartbeat=now,
                    state="running",
                    host=host,
                    process=os.getpid(),
                    command=plain_text(command if command is not None else " ".join(sys.argv)),
                    commit=str(checkout()),
                    software=records.software(),
                    configuration=plain_json(configuration or {}),
                )
            )
        return identity

    def beat(self, run_id: str, progress: Mapping[str, Any] | None = None) -> None:
        """Note that a run is alive; see :attr:`RunRow.heartbeat`.

        Parameters
        ----------
        run_id : str
            From :meth:`start_run`.
        progress : mapping, optional
            How far it is, JSON-able; see :mod:`coslidar.catalog.heartbeats`.
        """
        values: dict[str, Any] = {"heartbeat": time_ns()}
        if progress is not None:
            values["progress"] = dict(progress)
        with self.database.write() as connection:
            connection.execute(sa.update(run).where(run.c.id == run_id).values(**values))

    def finish_run(self, run_id: str, state: State = "finished") -> None:
        """Note that a run ended."""
        with self.database.write() as connection:
            connection.execute(sa.update(run).where(run.c.id == run_id).values(state=state, finished=time_ns()))

    def record_failure(
        self, run_id: str, archive_url: str, reason: str, *, start: int | None = None, stop: int | None = None
    ) -> None:
        """Note an archive, or one of its batches, that could not be processed.

        Parameters
        ----------
        run_id : str
            From :meth:`start_run`.
        archive_url : str
            Which archive.
        reason : str
            Why.
        start, stop : int, optional
            Time of the batch, ns since 1970 UTC.
        """
        values = {
            "run_id": run_id,
            "archive": plain_text(archive_url),
            "start": start,
            "stop": stop,
            "reason": plain_text(reason),
            "recorded": time_ns(),
        }
        with self.database.write() as connection:
            connection.execute(sa.insert(failure).values(**values))

    def runs(self) -> list[RunRow]:
        """All runs, the first one first."""
        with self.database.read() as connection:
            rows = connection.execute(sa.select(*_RUN).order_by(run.c.started)).mappings()
            return [RunRow(**row) for row in rows]

    def failures(self, run_id: str | None = None) -> list[FailureRow]:
        """Failures of one run, or of all, the first one first."""
        query = sa.select(failure).order_by(failure.c.id)
        if run_id is not None:
            query = query.where(failure.c.run_id == run_id)
        with self.database.read() as connection:
            return [
                FailureRow(row.run_id, row.archive, row.start, row.stop, row.reason, row.recorded)
                for row in connection.execute(query)
            ]
