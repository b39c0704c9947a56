"""The report's panels, drawn one at a time when somebody asks for them."""

from __future__ import annotations

import io
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from ...catalog.report import BATCH_PANELS, TIME_PANELS, BatchPanel, TimePanel, figure, figure_style
from ...catalog.report.reading import values
from ...catalog.report.svg import inline_svg

#: An xarray Dataset; only the catalog imports xarray.
Dataset: TypeAlias = Any
#: Formats of a figure that can be downloaded -> media type.
FORMATS = {"svg": "image/svg+xml", "png": "image/png", "pdf": "application/pdf"}
PANELS: dict[str, BatchPanel | TimePanel] = {panel.key: panel for panel in (*TIME_PANELS, *BATCH_PANELS)}

# Matplotlib's settings belong to the process.
_PEN = threading.Lock()


class Drawn:
    """Markup of panels that were drawn before: leafing back costs nothing."""

    def __init__(self, most: int = 64) -> None:
        self._kept: OrderedDict[object, dict[str, str]] = OrderedDict()
        self._most = most

    def get(self, key: object, make: Callable[[], dict[str, str]]) -> dict[str, str]:
        """What `make` gives, made once as long as it is not pushed out."""
        with _PEN:
            if key not in self._kept:
                self._kept[key] = make()
                while len(self._kept) > self._most:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]


def _empty(panel: BatchPanel | TimePanel, products: Sequence[Dataset]) -> bool:
    names: Sequence[str] = getattr(panel, "variables", ())
    found = [values(dataset, name) for dataset in products for name in names]
    return bool(names) and not any(value is not None and bool(np.isfinite(value).any()) for value in found)


def panel_markup(key: str, products: Sequence[Dataset], batch: int = 0) -> dict[str, str]:
    """A panel as the report shows it: key, title, reading, text and svg (empty where there is nothing to draw)."""
    panel = PANELS[key]
    text = panel.describe(products[0], batch) if isinstance(panel, BatchPanel) else panel.describe(products)
    drawn = ""
    if not _empty(panel, products):
        with figure_style():
            drawn = inline_svg(figure(panel, products, batch), f"p-{key}", panel.title, text)
    return {"key": key, "title": panel.title, "reading": panel.reading, "text": text, "svg": drawn}


def figure_bytes(key: str, products: Sequence[Dataset], batch: int, form: str) -> bytes:
    """A panel as a file of one of :data:`FORMATS`."""
    out = io.BytesIO()
    with _PEN, figure_style():
        # Transparent figures cannot be read on the dark background of a viewer.
        figure(PANELS[key], products, batch).savefig(out, format=form, facecolor="white")
    return out.getvalue()
