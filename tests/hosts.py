"""Hosts of a small network on this machine: network namespaces on one bridge."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from small_runs import environment, family, wait_for

BRIDGE = f"cos{os.getpid() % 100000}"
#: What workers do beside: they count whose frames they have read. Dask imports it twice.
COUNT = """
from coslidar.flows import tasks
if not hasattr(tasks, "counted"):
    tasks.counted, honest = True, tasks._measure
    def measure(task):
        measured = honest(task)
        with open({file!r}, "a") as out:
            out.write(f"{{task.name}} {{task.window.index}}\\n")
        return measured
    tasks._measure = measure
"""
NETWORK = f"10.{77 + os.getpid() % 100}.{os.getpid() // 100 % 250}"


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, timeout=30)


class Hosts:
    """A Dask scheduler and workers, each in a network namespace; this process is a host of the same network."""

    def __init__(self, folder: Path, cache: Path, workers: int) -> None:
        if shutil.which("ip") is None or os.geteuid() != 0:
            pytest.skip("hosts of a network need root and the command 'ip' (Debian: iproute2)")
        self.folder, self.cache = folder, cache
        self._counted = folder / "counted"
        self._counted.touch()
        (folder / "count.py").write_text(COUNT.format(file=str(self._counted)))
        self.names = ["scheduler", *(f"worker{number}" for number in range(workers))]
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.address = f"tcp://{NETWORK}.10:8786"
        self._made: list[tuple[str, ...]] = []
        try:
            self._make("link", "add", BRIDGE, "type", "bridge", undo=("link", "del", BRIDGE))
            _ip("addr", "add", f"{NETWORK}.1/24", "dev", BRIDGE)
            _ip("link", "set", BRIDGE, "up")
            for number, name in enumerate(self.names):
                space, plug = self._space(name), f"{BRIDGE}-{number}"
                self._make("netns", "add", space, undo=("netns", "del", space))
                self._make(
                    "link", "add", plug, "type", "veth", "peer", "name", "eth0", "netns", space,
                    undo=("link", "del", plug),
                )  # fmt: skip
                _ip("link", "set", plug, "master", BRIDGE, "up")
                _ip("-n", space, "addr", "add", f"{NETWORK}.{10 + number}/24", "dev", "eth0")
                for device in ("lo", "eth0"):
                    _ip("-n", space, "link", "set", device, "up")
        except subprocess.CalledProcessError as error:
            self.close()
            pytest.skip(f"no network namespaces here: {error.stderr.decode().strip()}")
        for name in self.names:
            self.start(name)

    def _make(self, *arguments: str, undo: tuple[str, ...]) -> None:
        _ip(*arguments)
        self._made.append(undo)

    @staticmethod
    def _space(name: str) -> str:
        return f"{BRIDGE}-{name}"

    def start(self, name: str) -> None:
        """Start the program of a host."""
        here = f"{NETWORK}.{10 + self.names.index(name)}"
        if name == "scheduler":
            program = ["distributed.cli.dask_scheduler", "--host", here, "--port", "8786", "--no-dashboard"]
        else:
            program = [
                "distributed.cli.dask_worker", self.address, "--host", here, "--no-dashboard", "--no-nanny",
                "--nthreads", "1", "--local-directory", str(self.folder), "--preload", str(self.folder / "count.py"),
            ]  # fmt: skip
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                ["ip", "netns", "exec", self._space(name), sys.executable, "-m", *program],
                stdout=log, stderr=log, cwd=self.folder, env=environment(self.cache, OMP_NUM_THREADS="1"),
            )  # fmt: skip
        if name == "scheduler":
            log_file = self.folder / "scheduler.log"
            assert wait_for(lambda: "Scheduler at" in log_file.read_text(), 60), log_file.read_text()

    def measured(self) -> Counter[str]:
        """How often the frames of each batch have been read to their end, on all hosts, by archive and batch."""
        return Counter(self._counted.read_text().splitlines())

    def kill(self, name: str) -> None:
        """What a power cut does."""
        for one in family(self.processes[name].pid):
            one.kill()
        self.processes[name].kill()
        self.processes[name].wait()

    def plug(self, name: str, *, connected: bool) -> None:
        """Pull the plug of a host's network, or put it back."""
        _ip("link", "set", f"{BRIDGE}-{self.names.index(name)}", "up" if connected else "down")

    def close(self) -> None:
        """Leave nothing behind."""
        for name in self.processes:
            self.kill(name)
        for undo in reversed(self._made):
            subprocess.run(["ip", *undo], capture_output=True, timeout=30)
