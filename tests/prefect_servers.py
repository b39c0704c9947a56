"""Somebody's Prefect server for tests, on SQLite or on PostgreSQL, and what it knows."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import catalogs
import pytest
import sqlalchemy as sa
from small_runs import environment, wait_for

from coslidar.flows import server

ROOT = Path(__file__).resolve().parents[1]


@contextmanager
def _postgresql(folder: Path) -> Iterator[sa.URL]:
    """An empty database: on the server that the environment names, else on one of its own."""
    own = None
    if catalogs.SERVER is None:
        if shutil.which("initdb") is None and not list(Path("/usr/lib/postgresql").glob("*/bin/initdb")):
            pytest.skip("no PostgreSQL on this machine; '.ci/postgresql start DIR' installs it")
        own = Path("/tmp") / f"coslidar-{uuid.uuid4().hex[:12]}"  # a path to a socket has little room
    script = str(ROOT / ".ci" / "postgresql")
    url = catalogs.SERVER
    try:
        if own is not None:
            done = subprocess.run([script, "start", str(own)], capture_output=True, text=True, timeout=120, check=True)
            url = done.stdout.strip()
        name = f"prefect_{uuid.uuid4().hex}"
        where = sa.make_url(str(url)).set(drivername="postgresql+psycopg")
        engine = sa.create_engine(where, isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.execute(sa.text(f"CREATE DATABASE {name}"))
        try:
            yield where.set(drivername="postgresql+asyncpg", database=name)
        finally:
            with engine.connect() as connection:
                connection.execute(sa.text(f"DROP DATABASE {name} WITH (FORCE)"))
            engine.dispose()
    finally:
        if own is not None:
            subprocess.run([script, "stop", str(own)], timeout=60, check=False, capture_output=True)


class PrefectServer:
    """A server on loopback, as a process of its own.

    Parameters
    ----------
    url : str
        Of its API.
    folder : Path
        For what its clients keep.
    process : Popen
        The server.
    """

    def __init__(self, url: str, folder: Path, process: subprocess.Popen[bytes]) -> None:
        self.url, self.folder, self.process = url, folder, process

    def _post(self, path: str, body: dict[str, Any]) -> Any:
        content = json.dumps(body).encode()
        request = Request(f"{self.url}/{path}", content, {"Content-Type": "application/json"})
        with urlopen(request, timeout=20) as answer:
            return json.loads(answer.read())

    def all(self, what: str) -> list[dict[str, Any]]:
        """All ``flow_runs``, ``task_runs``, ``artifacts`` … that it knows."""
        return self._post(f"{what}/filter", {})  # type: ignore[no-any-return]

    def count(self, what: str, state: str) -> int:
        """How many ``flow_runs`` or ``task_runs`` are in a state."""
        return int(self._post(f"{what}/count", {what: {"state": {"type": {"any_": [state]}}}}))

    def healthy(self) -> bool:
        """Whether it answers."""
        try:
            with urlopen(f"{self.url}/health", timeout=2):
                return True
        except OSError:
            return False

    def prefect(self, cache: Path, *arguments: str) -> str:
        """What a command of Prefect's prints, as its user gives it."""
        more = {"PREFECT_API_URL": self.url, "PREFECT_HOME": str(self.folder / "mine")}
        done = subprocess.run(
            [sys.executable, "-m", "prefect", *arguments],
            env=environment(cache, **{**server.quiet_environment(), **more}),
            capture_output=True, text=True, timeout=200, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout


@contextmanager
def prefect_server(kind: str, folder: Path, cache: Path) -> Iterator[PrefectServer]:
    """A server whose database is ``sqlite`` or ``postgresql``, until the block ends."""
    port = server._free_port()
    url = f"http://127.0.0.1:{port}/api"
    variables = {**server.quiet_environment(), "PREFECT_HOME": str(folder / "theirs")}
    with _postgresql(folder) if kind == "postgresql" else _nothing() as database:
        if database is not None:
            variables["PREFECT_API_DATABASE_CONNECTION_URL"] = database.render_as_string(hide_password=False)
        with (folder / "server.log").open("wb") as log:
            listen = ("--no-ui", "--host", "127.0.0.1", "--port", str(port))
            process = subprocess.Popen(
                [sys.executable, "-m", "prefect", "server", "start", *listen],
                env=environment(cache, **variables), stdout=log, stderr=log,
            )  # fmt: skip
        made = PrefectServer(url, folder, process)
        try:
            assert wait_for(lambda: made.healthy() or process.poll() is not None, 120, step=0.2)
            assert process.poll() is None, (folder / "server.log").read_text()
            yield made
        finally:
            process.terminate()
            process.wait(30)


@contextmanager
def _nothing() -> Iterator[None]:
    yield None
