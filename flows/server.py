"""Our own quiet Prefect server, for as long as a run lasts.

Used where PREFECT_API_URL is not set. Prefect's built-in ephemeral server times out on a busy machine and prints
tracebacks; a plain server on loopback, with its log in a file and its database kept between runs, does neither.
Imports nothing heavy: this module is also the body of the server's process.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING
from urllib.error import HTTPError, URLError
from urllib.request import ProxyHandler, build_opener, urlopen

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

#: Longest wait for the server, s. The first start migrates its database.
TIMEOUT = 120.0
#: How long it may take to stop, s.
GRACE = 5.0
#: What a server does beside answering that a single run has no use for: schedules, automations, events. Runs that an
#: earlier schedule left behind would be gone through again at every start, which cost seconds.
IDLE_SERVICES = (
    "CANCELLATION_CLEANUP",
    "CLEANUP_RECONCILER",
    "EVENT_LOGGER",
    "EVENT_PERSISTER",
    "FOREMAN",
    "LATE_RUNS",
    "PAUSE_EXPIRATIONS",
    "REPOSSESSOR",
    "SCHEDULER",
    "TRIGGERS",
)


def quiet_environment() -> dict[str, str]:
    """Settings that keep Prefect from phoning home and from filling the terminal."""
    return {
        "DO_NOT_TRACK": "1",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_SERVER_LOGGING_LEVEL": "CRITICAL",
        # What becomes of an archive is told once, by the driver.
        "PREFECT_LOGGING_LEVEL": "CRITICAL",
        # That an archive has to wait for its turn is no error.
        "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",
        "PREFECT_LOGGING_TO_API_ENABLED": "false",
        "PREFECT_CLI_WRAP_LINES": "false",
        "PREFECT_RESULTS_PERSIST_BY_DEFAULT": "false",
    }


def home() -> tuple[Path, IO[bytes]]:
    """Folder of the server's database and log, and the lock that makes it ours as long as it is open.

    Kept between runs, because migrations are the slow part of a first start. A run beside another one gets a folder of
    its own: two servers on one SQLite file lock each other out.
    """
    import fcntl

    from .caches import cache_folder
    from .settings import Unavailable

    number = 1
    while True:
        folder = cache_folder() / ("prefect" if number == 1 else f"prefect-{number}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = (folder / "lock").open("wb")
        except OSError as error:
            raise Unavailable(
                f"{folder}: the Prefect server cannot keep its database there ({error.strerror}); set COSLIDAR_HOME to "
                "a folder that can be written, or run with --no-prefect"
            ) from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return folder, lock
        except OSError:
            lock.close()
            number += 1


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def _environment(**values: str) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, old in before.items():
            if old is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = old


@contextmanager
def server(schedules: bool = False) -> Iterator[Callable[[], str]]:
    """A Prefect API: the one of PREFECT_API_URL, or our own until the block ends.

    Parameters
    ----------
    schedules : bool
        Whether our own has to start runs by itself.

    Yields
    ------
    callable
        Waits until the API answers, and returns its URL, which PREFECT_API_URL has meanwhile.

    Raises
    ------
    Unavailable
        It did not answer in time; names its log.
    """
    for name, value in quiet_environment().items():
        os.environ.setdefault(name, value)
    if given := os.environ.get("PREFECT_API_URL"):
        yield partial(_answering, given)
        return
    folder, lock = home()
    with lock:
        port = _free_port()
        url = f"http://127.0.0.1:{port}/api"
        # Loopback never goes through a proxy.
        direct = ",".join(filter(None, (os.environ.get("NO_PROXY", os.environ.get("no_proxy", "")), "127.0.0.1")))
        with _environment(PREFECT_HOME=str(folder), NO_PROXY=direct, no_proxy=direct):
            process = _start(folder, port, schedules)
            try:
                with _environment(PREFECT_API_URL=url):
                    yield partial(_await, url, process, folder / "server.log")
            finally:
                _stop(process)


def _start(folder: Path, port: int, schedules: bool) -> subprocess.Popen[bytes]:
    idle = () if schedules else IDLE_SERVICES
    with (folder / "server.log").open("wb") as sink:
        return subprocess.Popen(
            [sys.executable, "-m", __name__, str(port)],
            stdout=sink,
            stderr=subprocess.STDOUT,
            env={**os.environ, **{f"PREFECT_SERVER_SERVICES_{name}_ENABLED": "false" for name in idle}},
            # Ends when this process does, whatever ends it; the server watches for that.
            stdin=subprocess.PIPE,
            # Ctrl-C at the terminal is for us; we stop the server.
            start_new_session=True,
        )


def _answering(url: str) -> str:
    """Check that somebody's server is there, before Prefect tries for minutes."""
    from .settings import Unavailable

    try:
        with urlopen(f"{url.rstrip('/')}/health", timeout=20):
            return url
    except HTTPError:
        return url  # it wants to know who we are; that is Prefect's business
    except (URLError, OSError, ValueError) as error:
        raise Unavailable(
            f"no Prefect server answers at PREFECT_API_URL = {url} ({getattr(error, 'reason', error)}); start it, "
            "unset the variable to use a server of our own, or run with --no-prefect"
        ) from error


def _await(url: str, process: subprocess.Popen[bytes], log: Path) -> str:
    from .settings import Unavailable

    opener = build_opener(ProxyHandler({}))
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline and process.poll() is None:
        with suppress(URLError, OSError), opener.open(f"{url}/health", timeout=2):
            return url
        time.sleep(0.1)
    raise Unavailable(
        f"the Prefect server did not start (its log: {log}); run with --no-prefect, or set PREFECT_API_URL to a "
        "server that is running"
    )


def _stop(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    try:
        process.wait(GRACE)
    except subprocess.TimeoutExpired:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    finally:
        if process.stdin is not None:
            process.stdin.close()


def _serve(port: str) -> None:
    """Body of the server's process: it ends with the run that holds the other end of its stdin."""
    import gc
    from threading import Thread

    def watch() -> None:
        sys.stdin.buffer.read()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE)
        os._exit(1)

    Thread(target=watch, daemon=True).start()
    os.environ["PREFECT_SERVER_UI_ENABLED"] = "false"
    # What is being imported is no garbage: looking for some takes a tenth of the start.
    gc.disable()
    import uvicorn
    from prefect.server.api.server import create_app

    # As 'prefect server start' does, without its command line.
    app = create_app(final=True)
    gc.enable()
    uvicorn.run(app, host="127.0.0.1", port=int(port), log_level="critical")


if __name__ == "__main__":
    _serve(sys.argv[1])
