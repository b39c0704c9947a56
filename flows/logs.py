"""Logs: one record format with run, archive and batch, as text or as JSON, wherever a record was made.

Everything of ours goes through the logger ``coslidar`` of the standard library. What a worker logs while it computes a
batch travels back with the batch and is handled here as if it had been logged here.
"""

from __future__ import annotations

import json
import logging
import socket
import time
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from ..pipeline.units import safe

if TYPE_CHECKING:
    from collections.abc import Iterator

log = logging.getLogger("coslidar")
# Whoever uses the package from Python decides what becomes of its records.
log.addHandler(logging.NullHandler())

#: What a record says of its place, in this order.
PLACES = ("run", "archive", "batch")
#: Records of one batch that a worker sends back at most; a batch is to stay small.
MAX_RECORDS = 200
MAX_MESSAGE = 2000

_place: ContextVar[dict[str, Any] | None] = ContextVar("_place", default=None)
_collected: ContextVar[list[dict[str, Any]] | None] = ContextVar("_collected", default=None)


@contextmanager
def about(**place: Any) -> Iterator[None]:
    """Say in every record of the block which `run`, `archive` and `batch` it is about."""
    token = _place.set({**(_place.get() or {}), **place})
    try:
        yield
    finally:
        _place.reset(token)


class _Placed(logging.Filter):
    """Give each record its place and host, unless it has them from another process."""

    def filter(self, record: logging.LogRecord) -> bool:
        if not hasattr(record, "place"):
            record.place = dict(_place.get() or {})
        if not hasattr(record, "host"):
            record.host = socket.gethostname()
        return True


def _stamp(record: logging.LogRecord) -> str:
    return f"{time.strftime('%Y-%m-%dT%H:%M:%S', time.gmtime(record.created))}.{int(record.msecs):03d}Z"


class Text(logging.Formatter):
    """``2026-11-22T07:50:41.123Z warning run=4f1c archive=demo/r0 batch=3: message``."""

    def format(self, record: logging.LogRecord) -> str:
        """One line; what others wrote cannot begin another."""
        place = getattr(record, "place", {})
        words = [f"{name}={safe(str(place[name]))}" for name in PLACES if name in place]
        head = " ".join([_stamp(record), record.levelname.lower(), *words])
        return f"{head}: {safe(record.getMessage())}"


class Json(logging.Formatter):
    """One JSON object a line: `time`, `level`, `logger`, `host`, `run`, `archive`, `batch`, `message`."""

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        place = getattr(record, "place", {})
        content: dict[str, Any] = {
            "time": _stamp(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "host": getattr(record, "host", socket.gethostname()),
            **{name: place.get(name) for name in PLACES},
            "message": record.getMessage(),
        }
        if record.exc_info:
            content["exception"] = self.formatException(record.exc_info)
        return json.dumps(content, ensure_ascii=True)


@contextmanager
def shown(level: str | None, as_json: bool) -> Iterator[None]:
    """Write our records to stderr for as long as the block lasts.

    Parameters
    ----------
    level : str or None
        Least level that is written (``"info"``); nothing where it is None and `as_json` is not asked for.
    as_json : bool
        One JSON object a line instead of text; level info where none is given.
    """
    if level is None and not as_json:
        # The progress tells what went wrong; Prefect's handlers of the root logger would tell it once more.
        propagate, log.propagate = log.propagate, False
        try:
            yield
        finally:
            log.propagate = propagate
        return
    handler = logging.StreamHandler()
    handler.setFormatter(Json() if as_json else Text())
    handler.addFilter(_Placed())
    before, propagate = log.level, log.propagate
    log.setLevel((level or "info").upper())
    log.addHandler(handler)
    log.propagate = False  # Prefect gives the root logger handlers of its own
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before)
        log.propagate = propagate


# --- from workers to the driver ----------------------------------------------------------------------------


class _Collector(logging.Handler):
    """Keeps the records of the batch that this thread computes."""

    def emit(self, record: logging.LogRecord) -> None:
        kept = _collected.get()
        if kept is not None and len(kept) < MAX_RECORDS:
            kept.append(
                {
                    "name": record.name,
                    "levelno": record.levelno,
                    "levelname": record.levelname,
                    "msg": record.getMessage()[:MAX_MESSAGE],
                    "created": record.created,
                    "msecs": record.msecs,
                    "host": socket.gethostname(),
                    "place": dict(_place.get() or {}),
                }
            )


_collector = _Collector()


@contextmanager
def collected(level: int) -> Iterator[list[dict[str, Any]]]:
    """Collect what is logged in the block, to be sent elsewhere; see :func:`replay`.

    Parameters
    ----------
    level : int
        Least level that is wanted there.
    """
    if _collector not in log.handlers:
        log.addHandler(_collector)
    log.setLevel(level)
    records: list[dict[str, Any]] = []
    token = _collected.set(records)
    try:
        yield records
    finally:
        _collected.reset(token)


def replay(records: tuple[dict[str, Any], ...]) -> None:
    """Handle records of another process as if they had been made here."""
    for record in records:
        logger = logging.getLogger(record["name"])
        if logger.isEnabledFor(record["levelno"]):
            logger.handle(logging.makeLogRecord(record))
