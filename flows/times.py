"""Times as people read them: always with their zone."""

from __future__ import annotations

from datetime import UTC, datetime


def write_time(nanoseconds: int) -> str:
    """Write a time in UTC to the second: ``2012-09-14T14:00:00Z``."""
    return datetime.fromtimestamp(nanoseconds // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
