"""A SLURM of one node on this machine, for tests that submit real jobs."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
from pathlib import Path

import psutil
import pytest
from small_runs import wait_for

NEEDED = ("slurmctld", "slurmd", "sbatch", "squeue", "munged")


def _ports(number: int) -> list[int]:
    sockets = [socket.socket() for _ in range(number)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]
    finally:
        for one in sockets:
            one.close()


class Slurm:
    """slurmctld, slurmd and munged with every file of theirs in one folder."""

    def __init__(self, folder: Path) -> None:
        missing = [name for name in NEEDED if shutil.which(name) is None]
        if missing or os.geteuid() != 0:
            pytest.skip(
                f"no {', '.join(missing)} on this machine (Debian: slurm-wlm)"
                if missing
                else "SLURM starts as root only"
            )
        self.folder = folder
        self.configuration = folder / "slurm.conf"
        for name in ("state", "spool"):
            (folder / name).mkdir()
        host, (control, node) = socket.gethostname().partition(".")[0], _ports(2)
        self.configuration.write_text(
            f"ClusterName=test\nSlurmctldHost={host}(127.0.0.1)\nAuthType=auth/munge\nAuthInfo=socket={folder}/munge/s\n"
            f"ProctrackType=proctrack/linuxproc\nTaskPlugin=task/none\nSlurmUser=root\nSlurmdUser=root\n"
            f"SlurmctldPort={control}\nSlurmdPort={node}\nStateSaveLocation={folder}/state\nSlurmdSpoolDir={folder}/spool\n"
            f"SlurmctldPidFile={folder}/control.pid\nSlurmdPidFile={folder}/node.pid\nSlurmctldLogFile={folder}/control.log\n"
            f"SlurmdLogFile={folder}/node.log\nSelectType=select/cons_tres\nSelectTypeParameters=CR_Core\nMpiDefault=none\n"
            f"SchedulerParameters=sched_min_interval=0,bf_interval=1\nJobAcctGatherType=jobacct_gather/none\n"
            f"NodeName={host} NodeAddr=127.0.0.1 CPUs={os.cpu_count()} State=UNKNOWN\n"
            f"PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP OverSubscribe=FORCE:4\n"
        )
        (folder / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\nIgnoreSystemd=yes\n")
        self.environment = {"SLURM_CONF": str(self.configuration)}
        self._munge()
        for program in ("slurmctld", "slurmd"):
            done = subprocess.run(
                [program, "-f", str(self.configuration)], env=self._all(), timeout=60, capture_output=True, text=True
            )
            if done.returncode:
                self.close()
                pytest.skip(f"{program} does not start here: {done.stderr.strip()[-300:]}")
        if not wait_for(lambda: "idle" in self.ask("sinfo", "-h", "-o", "%T"), 30, 0.2):
            said = (folder / "node.log").read_text()[-500:]
            self.close()
            pytest.skip(f"the node of SLURM does not come up here: {said}")

    def _all(self) -> dict[str, str]:
        return {**os.environ, **self.environment}

    def _munge(self) -> None:
        # It wants folders that belong to its user, and one that everybody may enter for its socket.
        user = pwd.getpwnam("munge")
        home = self.folder / "munge"
        home.mkdir(mode=0o711)
        (home / "key").write_bytes(os.urandom(128))
        (home / "key").chmod(0o400)
        for path in (home, home / "key"):
            os.chown(path, user.pw_uid, user.pw_gid)
        command = [
            "munged", "--force", f"--socket={home}/s", f"--key-file={home}/key", f"--pid-file={home}/pid",
            f"--log-file={home}/log", f"--seed-file={home}/seed",
        ]  # fmt: skip
        subprocess.run(
            command, user="munge", group="munge", extra_groups=[], check=True, timeout=30, capture_output=True
        )

    def ask(self, *command: str) -> str:
        """What a command of SLURM prints."""
        return subprocess.run(command, env=self._all(), timeout=30, capture_output=True, text=True).stdout

    def close(self) -> None:
        """End the daemons and what they run."""
        for process in psutil.process_iter(["cmdline"]):
            if str(self.folder) in " ".join(process.info["cmdline"] or ()) and process.pid != os.getpid():
                process.send_signal(signal.SIGKILL)
