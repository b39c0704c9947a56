"""How much memory a process keeps that it does not use."""

from __future__ import annotations

import ctypes
import os
import sys

#: From glibc's malloc.h.
_M_ARENA_MAX = -8


def few_heaps(threads: int) -> None:
    """Let the threads of this process share as many heaps as there are threads that compute.

    glibc gives each new thread a heap of its own, up to eight for every core, and what a thread has freed in one is
    not used in another. Event loops and pools make many threads, so that a process that runs again and again kept
    60 MB more than it needed. Without glibc nothing is done, and neither where the user has decided (MALLOC_ARENA_MAX).

    Parameters
    ----------
    threads : int
        Threads that compute.
    """
    if sys.platform != "linux" or "MALLOC_ARENA_MAX" in os.environ:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, max(2, threads))
