"""Whether anything still works on a run: judged by its driver's heartbeat, from any machine that sees the catalog."""

from __future__ import annotations

import os
import socket
from time import time_ns
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from .store import RunRow

#: How often a driver shows that it lives, s.
EVERY = 5.0
#: A driver that has been silent for so long is taken for dead, s. Clocks of two machines may differ by a part of it.
SILENCE = 60.0

Life = Literal["running", "lost", "finished", "failed", "cancelled"]


def life(run: RunRow, now: int | None = None) -> Life:
    """What became of a run.

    Parameters
    ----------
    run : RunRow
        The run as the catalog lists it.
    now : int, optional
        Time to judge silence by, ns since 1970 UTC; the clock where it is absent.

    Returns
    -------
    str
        Its state; ``lost`` where it never came to an end and its driver is gone.
    """
    if run.state == "interrupted":
        return "lost"
    if run.state != "running":
        return run.state  # type: ignore[return-value]  # the table admits no other
    last = run.heartbeat if run.heartbeat is not None else run.started
    silent = (time_ns() if now is None else now) - last > SILENCE * 1e9
    return "lost" if silent or (run.host == socket.gethostname() and not alive(run.pid)) else "running"


def alive(process: int) -> bool:
    """Whether a process of this machine lives."""
    if process <= 0:
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
