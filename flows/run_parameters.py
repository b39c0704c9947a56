"""Where a campaign is computed: threads of this machine, a cluster by address, jobs of a batch system."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from ..pipeline.parameters import Parameters
from ..pipeline.units import Duration, safe

_MEMORY = re.compile(r"\d+(\.\d+)? ?[KMGT]i?B")


def _memory(value: str) -> str:
    if not _MEMORY.fullmatch(value):
        raise ValueError("write an amount of memory such as '4 GB' or '512 MiB'")
    return value


def _line(value: str) -> str:
    if not value.isprintable():
        raise ValueError("one line of a job script without control characters")
    return value


Line = Annotated[str, Field(min_length=1, max_length=1000), AfterValidator(_line)]


class TLSParameters(Parameters):
    """Who may speak to the scheduler. Paths are relative to the campaign file."""

    ca_file: Line
    """Certificate authority that scheduler and workers are signed by, PEM."""
    certificate: Line
    """Our certificate, PEM."""
    key: Line
    """Its private key, PEM."""

    def below(self, folder: Path) -> TLSParameters:
        """The same with relative paths taken from a folder."""
        return TLSParameters(**{name: str(folder / value) for name, value in self.model_dump().items()})

    def faults(self, origin: str) -> list[str]:
        """One sentence for each file that cannot be read."""
        found = []
        for name, value in self.model_dump().items():
            try:
                with open(value, "rb"):
                    pass
            except OSError as error:
                found.append(
                    f"{origin}: run.tls.{name} = {safe(value)!r}: this file cannot be read ({error.strerror}); "
                    "give the path of a PEM file"
                )
        return found


class JobParameters(Parameters):
    """Jobs of a batch system that run the workers, through dask-jobqueue.

    The job scripts start this very Python, so the environment must lie where every node sees it, as must archives
    given by path. Scheduler and workers speak TLS with certificates made for this run.
    """

    system: Literal["slurm", "pbs", "sge", "lsf", "oar", "htcondor"]
    """The batch system of the machine."""
    jobs: int = Field(default=1, ge=1, le=10000)
    """How many jobs to submit; the run begins when the first one starts."""
    cores: int = Field(default=1, ge=1, le=1024)
    """Cores of a job; each worker process uses one thread per core it has."""
    processes: int = Field(default=1, ge=1, le=1024)
    """Worker processes of a job, which share its cores and memory."""
    memory: Annotated[str, AfterValidator(_memory)] = "4 GB"
    """Memory of a job."""
    walltime: Duration = Field(default="1 h", ge=60)  # type: ignore[assignment]
    """Longest time a job may run. What was finished is kept; the same command goes on with the rest."""
    queue: Line | None = None
    """Queue or partition; the system's default where it is absent."""
    account: Line | None = None
    """Account or project that is charged."""
    interface: Line | None = None
    """Network interface that nodes reach this machine by, for example `ib0`."""
    directives: tuple[Line, ...] = ()
    """Further options of the batch system, for example `--exclusive`."""
    prologue: tuple[Line, ...] = ()
    """Lines of the job script before the worker starts, for example `module load python`."""
    patience: Duration = Field(default="24 h", gt=0)  # type: ignore[assignment]
    """How long the first job may wait in the queue."""


class RunParameters(Parameters):
    """Where a campaign is computed; never part of a key."""

    scheduler: str | None = Field(default=None, max_length=1000)
    """Address (`tcp://…`, `tls://…`) or scheduler file of a Dask cluster; this machine where it is absent."""
    tls: TLSParameters | None = None
    """Certificates for a `tls://` scheduler."""
    jobs: JobParameters | None = None
    """Workers as jobs of a batch system, started by the run itself; instead of `scheduler`."""
    threads: int | None = Field(default=None, ge=1, le=1024)
    """Threads on this machine; one per core where it is absent."""
    archives_at_once: int = Field(default=2, ge=1, le=256)
    """Archives in flight, so that no worker idles while one archive is being finished."""
