"""The report on paper and as pictures: the same panels, titles and words as the page."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import page
from .reading import LEVELS, bounds, has_profile, levels, listed, span
from .style import figure_style
from .words import clean, interval
from .words import days as period

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

#: Characters of running text in a line.
_LINE = 128


def _panels(products: Sequence[Dataset], most_batches: int) -> Iterator[tuple[str, str, str, Figure]]:
    """Name, heading, words and figure of every panel that has something to show."""
    import numpy as np

    for panel in page.TIME_PANELS:
        if not page.nothing_to_draw(panel, products):
            drawn = page.figure(panel, products)
            yield panel.key, panel.title, f"{panel.describe(products)} {panel.reading}", drawn
    batches = [(dataset, i) for dataset in products for i in range(dataset.sizes["time"])]
    shown = page.pick(np.concatenate([has_profile(dataset) for dataset in products]), most_batches)
    for number, (dataset, i) in enumerate(batches[n] for n in shown):
        start, stop = (int(time) for time in bounds(dataset)[i])
        which = f"{' to '.join(interval(start, stop))} UTC, {LEVELS[levels(dataset)[i]]}"
        for one in page.BATCH_PANELS:
            if page.nothing_to_draw(one, [dataset], i):
                continue
            name = one.key if len(shown) == 1 else f"{one.key}-{number + 1}"
            words = f"{which}. {one.describe(dataset, i)} {one.reading}"
            yield name, one.title, words, page.figure(one, dataset, i)


def _words(text: str) -> str:
    # A dollar sign would begin a formula.
    return "\n".join(textwrap.wrap(clean(text), _LINE)).replace("$", r"\$")


def _loaded(datasets: Dataset | Iterable[Dataset]) -> list[Dataset]:
    products = listed(datasets)
    if not products:
        raise ValueError("there is no batch to report on: every product is empty, or none was given")
    return [dataset.load() for dataset in products]


def write_pdf(
    datasets: Dataset | Iterable[Dataset],
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
    most_batches: int = 6,
) -> list[Path]:
    """Write the report of one or more products as PDF, one panel a page after a page of numbers and origin.

    Parameters
    ----------
    datasets, title, most_batches
        As for :func:`coslidar.catalog.report.write_report`.
    path : path-like
        File to write; its folder is made where it is missing.

    Returns
    -------
    list of Path
        The file. The same products give the same bytes.

    Raises
    ------
    ValueError
        There is no batch in the products.
    """
    from matplotlib.backends.backend_pdf import PdfPages

    products, target = _loaded(datasets), Path(path)
    heading = title or page.heading(products)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    metadata: dict[str, Any] = {"CreationDate": None, "ModDate": None, "Producer": None, "Creator": "coslidar",
                                "Title": clean(heading)}  # fmt: skip
    try:
        with figure_style(), PdfPages(temporary, metadata=metadata) as book:
            book.savefig(_front(products, heading))
            for _, question, words, drawn in _panels(products, most_batches):
                drawn.set_facecolor("white")
                drawn.text(0.01, 1.03, question, fontsize=16, weight="bold", va="bottom")
                drawn.text(0.01, -0.03, _words(words), fontsize=9.5, va="top")
                book.savefig(drawn, bbox_inches="tight", pad_inches=0.4)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
    return [target]


def _front(products: Sequence[Dataset], heading: str) -> Figure:
    """Numbers, flags, geometry and origin, as text."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(10, 7.5), facecolor="white")
    archives = list(dict.fromkeys(str(dataset.attrs.get("archive", "unnamed archive")) for dataset in products))
    lines = [period(*span(products)), f"{len(archives)} recordings: {', '.join(archives)[:600]}", ""]
    for item in (*page.key_numbers(products), *page.geometry(products)):
        remark = f" ({item['remark']})" if item["remark"] else ""
        lines.append(f"{item['name']}: {item['value']} {item['unit']}{remark}")
    keys = ", ".join(str(dataset.attrs.get("lineage_key", "none"))[:16] for dataset in products)
    lines += ["", f"Method: {page.METHOD}", f"Software: {page.software(products)}", f"Lineage keys: {keys[:600]}"]
    drawn.text(0.05, 0.95, _words(heading), fontsize=18, weight="bold", va="top")
    drawn.text(0.05, 0.88, "\n".join(_words(line) for line in lines), fontsize=9.5, va="top", linespacing=1.5)
    return drawn


def write_png(
    datasets: Dataset | Iterable[Dataset],
    path: str | os.PathLike[str],
    *,
    most_batches: int = 6,
    dpi: int = 150,
) -> list[Path]:
    """Write every panel of the report as a picture ``NAME-<panel>.png``, batches numbered.

    Parameters
    ----------
    datasets, most_batches
        As for :func:`coslidar.catalog.report.write_report`.
    path : path-like
        ``NAME.png``; its folder is made where it is missing.
    dpi : int
        Pixels an inch; a panel is ten inches wide.

    Returns
    -------
    list of Path
        The files. The same products give the same bytes.

    Raises
    ------
    ValueError
        There is no batch in the products.
    """
    products, target = _loaded(datasets), Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    written = []
    with figure_style():
        for name, question, words, drawn in _panels(products, most_batches):
            file = target.with_name(f"{target.stem}-{name}.png")
            temporary = file.with_name(f".{file.name}.{os.getpid()}.part")
            # The text alternative travels inside the picture.
            about = {"Title": question, "Description": clean(words), "Software": None}
            try:
                drawn.savefig(temporary, format="png", dpi=dpi, facecolor="white", metadata=about)
                temporary.replace(file)
            finally:
                temporary.unlink(missing_ok=True)
            written.append(file)
    return written
