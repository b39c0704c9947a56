"""Raw archives in, products out: files, the database that lists them, and what can be asked of both."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .archive import open_archive
    from .products import open_product
    from .store import open_catalog

__all__ = ["open_archive", "open_catalog", "open_product"]

_HOME = {"open_archive": "archive", "open_catalog": "store", "open_product": "products"}


def __getattr__(name: str) -> Any:
    # zarr, xarray and sqlalchemy take a second to import: whoever only wants --help does not pay for them.
    if name in _HOME:
        return getattr(import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
