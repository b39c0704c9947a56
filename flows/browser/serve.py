"""The server of `coslidar browse`: one process, a socket of its own, a token, and an end at Ctrl-C."""

from __future__ import annotations

import secrets
import socket
from typing import TYPE_CHECKING

from ..settings import InputError, Unavailable

if TYPE_CHECKING:
    from collections.abc import Callable

    from ...catalog.store import Catalog

_LOOPBACK = frozenset({"127.0.0.1", "localhost", "[::1]"})


def serve(catalog: Catalog, name: str, *, host: str, port: int, ready: Callable[[str], None]) -> None:
    """Answer requests until the process is interrupted.

    Parameters
    ----------
    catalog : Catalog
        Opened read-only.
    name : str
        What the pages call it.
    host : str
        Name or address to listen on.
    port : int
        Port; 0 takes a free one.
    ready : callable
        Is told the address with the token, once connections are accepted.

    Raises
    ------
    InputError
        There is no such host.
    Unavailable
        The port is taken or may not be used.
    """
    import uvicorn

    from .access import Guard
    from .pages import Pages

    bound = _socket(host, port)
    with bound:
        taken = bound.getsockname()[1]
        written = f"[{host}]" if ":" in host else host
        token = secrets.token_urlsafe(24)
        hosts = _LOOPBACK if written in _LOOPBACK else _LOOPBACK | {written.lower(), socket.gethostname().lower()}
        app = Guard(Pages(catalog, name).app(), token, hosts, f"coslidar-{taken}")
        config = uvicorn.Config(
            app, log_level="error", access_log=False, lifespan="off", ws="none", proxy_headers=False,
            server_header=False, timeout_graceful_shutdown=3,
        )  # fmt: skip
        ready(f"http://{written}:{taken}/?token={token}")
        uvicorn.Server(config).run(sockets=[bound])


def _socket(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise InputError([f"--host = '{host}': this machine cannot find it ({error}); leave it out"]) from error
    bound = socket.socket(family, kind, protocol)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen()
    except OSError as error:
        bound.close()
        raise Unavailable(
            f"{host}:{port} cannot be used ({error.strerror}); without --port a free port is taken"
        ) from error
    return bound
