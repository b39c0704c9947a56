"""Clusters that need more than an address: jobs of a batch system, and connections under TLS."""

from __future__ import annotations

import logging
import shutil
import signal
import sys
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..pipeline.units import safe
from .settings import Unavailable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from distributed.security import Security

    from .run_parameters import JobParameters, TLSParameters

log = logging.getLogger("coslidar")

#: Class of dask-jobqueue and the command that submits a job, by system.
SYSTEMS = {
    "slurm": ("SLURMCluster", "sbatch"),
    "pbs": ("PBSCluster", "qsub"),
    "sge": ("SGECluster", "qsub"),
    "lsf": ("LSFCluster", "bsub"),
    "oar": ("OARCluster", "oarsub"),
    "htcondor": ("HTCondorCluster", "condor_submit"),
}
#: Variables that numerical libraries take their number of threads from.
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: Attributes of dask's Security that hold a certificate or a key.
_CERTIFICATES = (
    "tls_ca_file",
    *(f"tls_{role}_{what}" for role in ("client", "scheduler", "worker") for what in ("cert", "key")),
)


def tls_security(tls: TLSParameters) -> Security:
    """Encryption in both directions, certificates checked.

    Raises
    ------
    Unavailable
        The files are no certificates and key that belong together.
    """
    from distributed.security import Security

    made = Security(
        require_encryption=True,
        tls_ca_file=tls.ca_file,
        tls_client_cert=tls.certificate,
        tls_client_key=tls.key,
    )
    try:
        made.get_connection_args("client")
    except (OSError, ValueError) as error:
        raise Unavailable(
            f"run.tls: {safe(tls.certificate)} and {safe(tls.key)} cannot be used ({safe(str(error))}); they must be a "
            "certificate and its private key as PEM, without a password"
        ) from error
    return made


def _walltime(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours:02d}:{minutes:02d}:{rest:02d}"


def _arguments(jobs: JobParameters) -> dict[str, Any]:
    given = {
        "cores": jobs.cores,
        "processes": jobs.processes,
        "memory": jobs.memory,
        "interface": jobs.interface,
        "job_extra_directives": list(jobs.directives),
        # The workers' pages are the one thing that TLS does not cover.
        "worker_extra_args": ["--dashboard-address", "127.0.0.1:0"],
        # One thread of a library per task, before any is loaded.
        "job_script_prologue": [f"export {name}=1" for name in ONE_THREAD] + list(jobs.prologue),
        "job_name": "coslidar",
        "python": sys.executable,
    }
    if jobs.system == "htcondor":
        return {**given, "disk": jobs.memory}
    given["walltime"] = _walltime(jobs.walltime)
    if jobs.queue is not None:
        given["queue"] = jobs.queue
    if jobs.account is not None:
        given["account" if jobs.system in ("slurm", "pbs") else "project"] = jobs.account
    return given


@contextmanager
def submitted(jobs: JobParameters, folder: Path) -> Iterator[Any]:
    """A cluster whose workers are jobs, until the block ends.

    Parameters
    ----------
    jobs : JobParameters
        What to submit.
    folder : pathlib.Path
        Where certificates and the jobs' output go; every node must see it.

    Yields
    ------
    dask_jobqueue.JobQueueCluster

    Raises
    ------
    Unavailable
        dask-jobqueue or the batch system is missing, or it refuses the jobs.
    """
    kind, command = SYSTEMS[jobs.system]
    heard = signal.getsignal(signal.SIGINT)
    try:
        import dask_jobqueue
        from distributed.security import Security

        temporary = Security.temporary()
    except ImportError as error:
        raise Unavailable(
            f"run.jobs needs packages that are not installed ({error}); pip install 'coslidar[jobqueue]'"
        ) from error
    # Its import takes Ctrl-C for a reason to leave without a word, and with success.
    signal.signal(signal.SIGINT, heard)
    if shutil.which(command) is None:
        raise Unavailable(
            f"run.jobs.system = '{jobs.system}': there is no command '{command}' on this machine; start the run where "
            "jobs are submitted from, or choose another system"
        )
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as made:
        # Certificates of this run: for us alone, and gone with it.
        secrets = Path(made.enter_context(tempfile.TemporaryDirectory(prefix="tls-", dir=folder)))
        files = {}
        for name in _CERTIFICATES:
            (secrets / name).write_text(getattr(temporary, name))
            files[name] = str(secrets / name)
        try:
            cluster = getattr(dask_jobqueue, kind)(
                **_arguments(jobs),
                log_directory=str(folder / "logs"),
                local_directory=tempfile.gettempdir(),
                security=Security(require_encryption=True, **files),
                protocol="tls://",
                scheduler_options={"dashboard_address": "127.0.0.1:0"},
                silence_logs=logging.CRITICAL,
            )
            made.callback(cluster.close)
            # One first: `scale` submits in the background, where nobody hears that the system refuses.
            cluster.worker_spec.update(cluster.new_worker_spec())
            try:
                cluster.sync(cluster._correct_state)
            except Exception:
                cluster.workers.clear()  # what never began cannot be closed
                cluster._created.clear()
                raise
            logging.getLogger("asyncio").setLevel(logging.CRITICAL)
            cluster.scale(jobs=jobs.jobs)
        except (RuntimeError, OSError, ValueError) as error:
            said = " ".join(str(error).split("stderr:")[-1].split())
            raise Unavailable(f"the batch system refuses the jobs: {safe(said)}") from error
        log.info("%d jobs submitted to %s; their output goes to %s", jobs.jobs, jobs.system, folder / "logs")
        yield cluster
