"""The group `coslidar catalog`: its commands stand in modules by subject."""

from __future__ import annotations

from . import compare, keeping, query
from .results import catalog

__all__ = ["catalog", "compare", "keeping", "query"]
