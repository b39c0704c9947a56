"""What failed for a reason that passes is tried again: a network, a server, a database that is started anew."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

log = logging.getLogger("coslidar")

#: How long to wait before each new try, s.
PAUSES = (0.5, 2.0, 8.0)


def patiently(call: Callable[[], T], passes: Callable[[Exception], bool]) -> T:
    """What `call` returns, in the first try that does not fail for a reason that passes.

    Parameters
    ----------
    call : callable
        To be tried; has no effect where it fails.
    passes : callable
        Whether another try may end better than with this exception.
    """
    for pause in PAUSES:
        try:
            return call()
        except Exception as error:
            if not passes(error):
                raise
            log.warning("%s; trying again in %g s", error, pause)
            time.sleep(pause)
    return call()


def unreachable(error: Exception) -> bool:
    """Whether an archive could not be reached, which says nothing about the archive."""
    return bool(getattr(error, "transient", False))
