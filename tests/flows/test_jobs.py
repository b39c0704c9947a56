"""Workers as jobs of a batch system, and schedulers under TLS."""

from __future__ import annotations

import os
import signal
import socket
import ssl
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import psutil
import pytest
from slurm_server import Slurm
from small_runs import Finished, environment, family, products, run_arguments, wait_for

from coslidar.catalog import open_archive
from coslidar.flows.jobs import submitted
from coslidar.flows.run_parameters import JobParameters
from coslidar.flows.settings import InputError, Unavailable, load

Call = Callable[..., Finished]


def test_every_fault_of_where_to_compute_is_told(tmp_path: Path) -> None:
    path = tmp_path / "campaign.toml"
    path.write_text(
        "archives = []\n[run]\nscheduler = 'tcp://127.0.0.1:1'\n[run.tls]\nca_file = 'ca.pem'\ncertificate = 'c.pem'\n"
        "key = 'k.pem'\n[run.jobs]\nsystem = 'slurm'\n"
    )
    with pytest.raises(InputError) as caught:
        load(path)
    for name in ("ca_file", "certificate", "key"):
        assert any(f"run.tls.{name}" in fault and "cannot be read" in fault for fault in caught.value.faults)
    # Paths are those of the campaign file's folder.
    assert str(tmp_path / "ca.pem") in str(caught.value)
    assert any("run.scheduler and run.jobs" in fault for fault in caught.value.faults)
    path.write_text(
        "archives = []\n[run.jobs]\nsystem = 'none-such'\nmemory = '4'\nwalltime = '1 m'\njobs = 0\n"
        'directives = ["a\\nb"]\ncolour = "red"\n'
    )
    with pytest.raises(InputError) as caught:
        load(path)
    for key in ("system", "memory", "walltime", "jobs", "directives", "colour"):
        assert any(f"run.jobs.{key}" in fault for fault in caught.value.faults), key


def test_a_machine_without_the_batch_system_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(Unavailable, match="no command 'bsub'"), submitted(JobParameters(system="lsf"), tmp_path):
        pass


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slurm]:
    """A batch system."""
    pytest.importorskip("dask_jobqueue")
    folder = tmp_path_factory.mktemp("slurm")
    for parent in (folder, *folder.parents[:3]):
        parent.chmod(parent.stat().st_mode | 0o011)  # munge's user passes through
    made = Slurm(folder)
    yield made
    made.close()


JOBS = ("run.jobs.system=slurm", "run.jobs.jobs=2", "run.jobs.memory=1 GB", "run.jobs.walltime=10 min")


def jobs(*more: str) -> list[object]:
    return [part for assignment in (*JOBS, *more) for part in ("--set", assignment)]


@pytest.mark.cluster
def test_jobs_of_slurm_compute_the_same_bytes(
    slurm: Slurm, coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], cache: Path, tmp_path: Path
) -> None:
    done = coslidar(
        *run_arguments(
            recordings, tmp_path / "out", *jobs("run.jobs.directives=['--mem=0']", "run.jobs.patience=90 s")
        ),
        **slurm.environment,
    )
    assert done.code == 0, done.err
    assert products(tmp_path / "out") == undisturbed
    # Nothing stays: no job in the queue, no key on disk.
    assert wait_for(lambda: slurm.ask("squeue", "-h") == "", 30, 0.2)
    assert [path.name for path in (cache / "jobs").iterdir()] == ["logs"]
    assert "tls://" in "".join(path.read_text() for path in (cache / "jobs" / "logs").iterdir())


@pytest.mark.cluster
def test_jobs_that_are_refused_or_never_start(
    slurm: Slurm, coslidar: Call, recordings: list[str], tmp_path: Path
) -> None:
    refused = coslidar(
        *run_arguments(recordings, tmp_path / "out", *jobs("run.jobs.directives=['--gres=none-such:1']")),
        **slurm.environment,
    )
    assert refused.code == 1
    assert refused.err.splitlines() == [
        "coslidar: the batch system refuses the jobs: sbatch: error: Invalid generic resource (gres) specification"
    ]
    held = coslidar(
        *run_arguments(
            recordings, tmp_path / "out", *jobs("run.jobs.directives=['--hold', '--mem=0']", "run.jobs.patience=3 s")
        ),
        **slurm.environment,
    )
    assert held.code == 1
    (line,) = held.err.splitlines()
    assert "none started within 3 s (run.jobs.patience)" in line
    assert wait_for(lambda: slurm.ask("squeue", "-h") == "", 30, 0.2)


def listening(processes: Iterable[psutil.Process]) -> set[tuple[str, int]]:
    """Addresses and ports on which processes of this machine wait for others."""
    return {
        (connection.laddr.ip, connection.laddr.port)
        for one in processes
        for connection in one.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    }


def speaks_tls(address: tuple[str, int]) -> bool:
    """Whether a handshake begins there; nobody of ours goes on without a certificate."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with socket.create_connection(address, 5) as plain:
        try:
            with context.wrap_socket(plain):
                return True
        except ssl.SSLError as error:
            return "WRONG_VERSION" not in str(error) and "record layer" not in str(error)
        except OSError:
            return False


@pytest.mark.cluster
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_interrupted_jobs_leave_nothing_behind(
    slurm: Slurm,
    started: Callable[..., subprocess.Popen[str]],
    recordings: list[str],
    tmp_path: Path,
    number: signal.Signals,
) -> None:
    """While they compute nothing listens beyond this machine without TLS; then they go, whatever ended their driver."""
    (tmp_path / "sitecustomize.py").write_text(
        "import time\nfrom coslidar.pipeline import batch\nhonest = batch.retrieve\n"
        "batch.retrieve = lambda *a: (time.sleep(5), honest(*a))[1]\n"
    )
    out = tmp_path / "out"
    process = started(
        *run_arguments(recordings, out, *jobs("run.jobs.directives=['--mem=0']", "run.jobs.patience=90 s")),
        PYTHONPATH=str(tmp_path),
        **slurm.environment,
    )
    assert wait_for(lambda: any((out / "correlations").glob("??/*.npz")) or process.poll() is not None, 120)
    assert process.poll() is None, process.communicate()
    workers = [one for one in psutil.process_iter(["cmdline"]) if "dask_worker" in " ".join(one.info["cmdline"] or ())]
    mine = [one for one in workers if one.environ().get("PYTHONPATH") == str(tmp_path)]
    assert mine
    everyone = {one.pid: one for each in [psutil.Process(process.pid), *mine] for one in [each, *family(each.pid)]}
    heard = {address for address in listening(everyone.values()) if address[0] not in ("127.0.0.1", "::1")}
    assert heard  # nodes must reach the driver
    assert [
        address
        for address in heard
        if not speaks_tls(("127.0.0.1", address[1]) if address[0] == "0.0.0.0" else address)
    ] == []
    process.send_signal(number)
    _, err = process.communicate(timeout=90)
    assert process.returncode == (-9 if number == signal.SIGKILL else 130), err
    if number != signal.SIGKILL:
        assert "coslidar: interrupted; what was finished is kept" in err
    assert wait_for(lambda: not any(one.is_running() for one in everyone.values()), 120, 0.2)
    assert wait_for(lambda: slurm.ask("squeue", "-h") == "", 60, 0.2)


class Secured:
    """A scheduler and a worker that speak TLS only."""

    def __init__(self, folder: Path, cache: Path) -> None:
        import trustme

        self.folder = folder
        authority, stranger = trustme.CA(), trustme.CA()
        for who, name in ((authority, "our"), (stranger, "other")):
            issued = who.issue_cert("127.0.0.1", "localhost")
            who.cert_pem.write_to_path(str(folder / f"{name}-ca.pem"))
            issued.private_key_pem.write_to_path(str(folder / f"{name}-key.pem"))
            (folder / f"{name}-cert.pem").write_bytes(b"".join(blob.bytes() for blob in issued.cert_chain_pems))
        self.file = folder / "scheduler.json"
        self.processes = []
        certificates = [
            f"--tls-{option}={folder / f'our-{name}.pem'}"
            for option, name in (("ca-file", "ca"), ("cert", "cert"), ("key", "key"))
        ]
        common = ["--protocol", "tls", "--scheduler-file", str(self.file), "--no-dashboard", *certificates]
        for what, more in (("scheduler", ["--port", "0"]), ("worker", ["--nthreads", "1", "--no-nanny"])):
            with (folder / f"{what}.log").open("wb") as log:
                self.processes.append(
                    subprocess.Popen(
                        [sys.executable, "-m", f"distributed.cli.dask_{what}", "--host", "127.0.0.1", *common, *more],
                        stdout=log,
                        stderr=log,
                        cwd=folder,
                        env=environment(cache, OMP_NUM_THREADS="1"),
                    )
                )
            assert wait_for(self.file.exists, 60)

    def options(self, whose: str) -> list[object]:
        """Certificates on the command line."""
        keys = (("ca_file", "ca"), ("certificate", "cert"), ("key", "key"))
        return [
            part for key, name in keys for part in ("--set", f"run.tls.{key}={self.folder / f'{whose}-{name}.pem'}")
        ]

    def close(self) -> None:
        for process in self.processes:
            for one in (*family(process.pid), psutil.Process(process.pid)):
                one.kill()
            process.wait()


@pytest.fixture
def secured(tmp_path: Path, cache: Path) -> Iterator[Secured]:
    """A cluster under TLS."""
    pytest.importorskip("trustme")
    folder = tmp_path / "tls"
    folder.mkdir()
    made = Secured(folder, cache)
    yield made
    made.close()


@pytest.mark.cluster
def test_a_cluster_under_tls(
    secured: Secured, coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    arguments = run_arguments(recordings, tmp_path / "out", "--scheduler", secured.file)
    without = coslidar(*arguments)
    assert without.code == 2
    assert "a tls:// scheduler needs certificates" in without.err
    stranger = coslidar(*arguments, *secured.options("other"))
    assert stranger.code == 1
    (line,) = stranger.err.splitlines()
    assert "certificate" in line.lower()
    done = coslidar(*arguments, *secured.options("our"))
    assert done.code == 0, done.err
    assert products(tmp_path / "out") == undisturbed


@pytest.mark.cluster
def test_archives_in_an_object_store(
    coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    pytest.importorskip("s3fs")
    moto = pytest.importorskip("moto.server")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        access = {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
            "AWS_ACCESS_KEY_ID": "testing",
            "AWS_SECRET_ACCESS_KEY": "testing",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_EC2_METADATA_DISABLED": "true",
        }
        with pytest.MonkeyPatch.context() as patch:
            for name, value in access.items():
                patch.setenv(name, value)
            _upload(recordings, tmp_path)
        done = coslidar(
            *run_arguments(
                ["s3://frames/r0.zarr.zip", "s3://frames/r1.zarr", "s3://frames/none.zarr"], tmp_path / "out"
            ),
            **access,
        )
        assert done.code == 2, done.err
        assert "s3://frames/none.zarr" in done.err
        made = products(tmp_path / "out")
        assert len(made) == 2
        # r0 is the same zip; r1 lies there as a folder.
        assert set(made.values()) <= set(undisturbed.values())
    finally:
        server.stop()


def _upload(recordings: list[str], folder: Path) -> None:
    import s3fs
    from small_runs import unpacked

    store = s3fs.S3FileSystem(skip_instance_cache=True)
    store.mkdir("frames")
    store.put(recordings[0], "frames/r0.zarr.zip")
    store.put(str(unpacked(recordings[1], folder)), "frames/r1.zarr", recursive=True)
    assert open_archive("s3://frames/r1.zarr").identity == open_archive(recordings[1]).identity
    assert os.environ["AWS_ENDPOINT_URL"]
