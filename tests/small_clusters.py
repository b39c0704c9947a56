"""Dask clusters for tests, every part a process of its own."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

from small_runs import environment, family, wait_for


class Cluster:
    """A scheduler and its workers, each a process."""

    def __init__(self, folder: Path, cache: Path) -> None:
        self.folder, self.cache = folder, cache
        self.processes: list[subprocess.Popen[bytes]] = []
        self.file = folder / "scheduler.json"
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
        self.scheduler = self.start(
            "scheduler", "--host", "127.0.0.1", "--port", self.address.rsplit(":", 1)[1], "--no-dashboard",
            "--scheduler-file", str(self.file),
        )  # fmt: skip
        assert wait_for(self.file.exists, 60)

    def start(self, what: str, *arguments: str, **more: str) -> subprocess.Popen[bytes]:
        log = (self.folder / f"{what}-{len(self.processes)}.log").open("wb")
        process = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_" + what, *arguments],
            stdout=log,
            stderr=log,
            cwd=self.folder,
            env=environment(self.cache, **{"OMP_NUM_THREADS": "1", **more}),
        )
        log.close()
        self.processes.append(process)
        return process

    def worker(self, *arguments: str, **more: str) -> subprocess.Popen[bytes]:
        return self.start(
            "worker", self.address, "--host", "127.0.0.1", "--no-dashboard", "--nworkers", "1", "--nthreads", "1",
            *arguments, **more,
        )  # fmt: skip

    def ready(self, workers: int) -> bool:
        """Wait until so many workers have been heard of."""

        def registered() -> bool:
            logs = (path.read_text(errors="replace") for path in self.folder.glob("worker-*.log"))
            return sum("Registered to" in log for log in logs) >= workers

        return wait_for(registered, 240, step=0.1)

    def close(self) -> None:
        for process in self.processes:
            for one in family(process.pid):
                one.kill()
            process.kill()
            process.wait()
