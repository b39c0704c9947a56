"""Our own quiet Prefect server, for as long as a run lasts.

Used where PREFECT_API_URL is not set. Prefect's built-in ephemeral server times out on a busy machine and prints
tracebacks; a plain server on loopback, with its log in a file and its database kept between runs, does neither.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.error import URLError
from urllib.request import ProxyHandler, build_opener

from .settings import cache_folder

if TYPE_CHECKING:
    from collections.abc import Iterator

#: Longest wait for the server, s. The first start migrates its database.
TIMEOUT = 120.0


class ServerError(RuntimeError):
    """The Prefect server did not start."""


def quiet_environment() -> dict[str, str]:
    """Settings that keep Prefect from phoning home and from filling the terminal."""
    return {
        "DO_NOT_TRACK": "1",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_SERVER_LOGGING_LEVEL": "CRITICAL",
        "PREFECT_LOGGING_LEVEL": "ERROR",
        "PREFECT_LOGGING_TO_API_ENABLED": "false",
        "PREFECT_CLI_WRAP_LINES": "false",
        "PREFECT_RESULTS_PERSIST_BY_DEFAULT": "false",
    }


def home() -> Path:
    """Folder of the server's database and log, kept between runs: migrations are the slow part of a first start."""
    return cache_folder() / "prefect"


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _die_with_parent() -> None:
    # A run that is killed must not leave its server behind (Linux; elsewhere the server outlives a SIGKILL).
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)


@contextmanager
def server() -> Iterator[str]:
    """A Prefect API: the one of PREFECT_API_URL, or our own until the block ends.

    Yields
    ------
    str
        URL of the API, also in PREFECT_API_URL meanwhile.

    Raises
    ------
    ServerError
        It did not answer in time; names its log.
    """
    for name, value in quiet_environment().items():
        os.environ.setdefault(name, value)
    if url := os.environ.get("PREFECT_API_URL"):
        yield url
        return
    folder = home()
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "server.log"
    port = _free_port()
    environment = {**os.environ, "PREFECT_HOME": str(folder)}
    command = [sys.executable, "-m", "prefect", "server", "start", "--no-ui", "--host", "127.0.0.1"]
    with log.open("wb") as sink:
        process = subprocess.Popen(
            [*command, "--port", str(port)],
            stdout=sink,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,
            preexec_fn=_die_with_parent,
        )
    url = f"http://127.0.0.1:{port}/api"
    before = {name: os.environ.get(name) for name in ("PREFECT_API_URL", "PREFECT_HOME")}
    try:
        _await(url, process, log)
        os.environ.update(PREFECT_API_URL=url, PREFECT_HOME=str(folder))
        yield url
    finally:
        for name, old in before.items():
            if old is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = old
        _stop(process)


def _await(url: str, process: subprocess.Popen[bytes], log: Path) -> None:
    opener = build_opener(ProxyHandler({}))  # loopback never goes through a proxy
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline:
        if process.poll() is not None:
            break
        with suppress(URLError, OSError), opener.open(f"{url}/health", timeout=2):
            return
        time.sleep(0.1)
    raise ServerError(
        f"the Prefect server did not start (its log: {log}); run with --no-prefect, or set PREFECT_API_URL to a "
        "server that is running"
    )


def _stop(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    try:
        process.wait(5)
    except subprocess.TimeoutExpired:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
