"""The report's panels, drawn one at a time when somebody asks for them."""

from __future__ import annotations

import io
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

from ...catalog.report import BATCH_PANELS, TIME_PANELS, BatchPanel, TimePanel, figure, figure_style, nothing_to_draw
from ...catalog.report.svg import inline_svg

#: An xarray Dataset; only the catalog imports xarray.
Dataset: TypeAlias = Any
T = TypeVar("T")
#: Formats of a figure that can be downloaded -> media type.
FORMATS = {"svg": "image/svg+xml", "png": "image/png", "pdf": "application/pdf"}
PANELS: dict[str, BatchPanel | TimePanel] = {panel.key: panel for panel in (*TIME_PANELS, *BATCH_PANELS)}

# Matplotlib's settings belong to the process.
PEN = threading.Lock()


class Kept(Generic[T]):
    """Things that were made before: leafing back costs nothing.

    Parameters
    ----------
    most : int
        How many; those not asked for longest go first.
    lock : Lock, optional
        Held while one is made.
    """

    def __init__(self, most: int, lock: threading.Lock | None = None) -> None:
        self._kept: OrderedDict[object, T] = OrderedDict()
        self._most = most
        self._lock = lock or threading.Lock()

    def get(self, key: object, make: Callable[[], T]) -> T:
        """What `make` gives, made once as long as it is not pushed out."""
        with self._lock:
            if key not in self._kept:
                self._kept[key] = make()
                while len(self._kept) > self._most:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]


@dataclass(frozen=True)
class Offer:
    """Panels that a page has to offer.

    Parameters
    ----------
    panels : list of BatchPanel or TimePanel
        Those that have something to draw.
    absent : list of (str, str)
        Titles of the others, and why they are none.
    """

    panels: list[BatchPanel | TimePanel]
    absent: list[tuple[str, str]]

    @classmethod
    def of(cls, kind: Sequence[BatchPanel | TimePanel], products: Sequence[Dataset], batch: int = 0) -> Offer:
        """What of a kind of panels products, or one batch of the first, have to offer."""
        why = {panel.key: nothing_to_draw(panel, products, batch) for panel in kind}
        return cls(
            [panel for panel in kind if not why[panel.key]],
            [(panel.title, why[panel.key]) for panel in kind if why[panel.key]],
        )


def panel_markup(key: str, products: Sequence[Dataset], batch: int = 0) -> dict[str, str]:
    """A panel as the report shows it: key, title, reading, text and svg (empty where there is nothing to draw)."""
    panel = PANELS[key]
    text = panel.describe(products[0], batch) if isinstance(panel, BatchPanel) else panel.describe(products)
    drawn = ""
    if reason := nothing_to_draw(panel, products, batch):
        text = reason
    else:
        with figure_style():
            drawn = inline_svg(figure(panel, products, batch), f"p-{key}", panel.title, text)
    return {"key": key, "title": panel.title, "reading": panel.reading, "text": text, "svg": drawn}


def figure_bytes(key: str, products: Sequence[Dataset], batch: int, form: str) -> bytes:
    """A panel as a file of one of :data:`FORMATS`."""
    out = io.BytesIO()
    with PEN, figure_style():
        # Transparent figures cannot be read on the dark background of a viewer.
        figure(PANELS[key], products, batch).savefig(out, format=form, facecolor="white")
    return out.getvalue()
