"""The figure of two products side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..export.files import ExportError, write_whole
from .reading import bounds
from .style import BLUE, RED, figure_style
from .two_lineages import draw_two_profiles

if TYPE_CHECKING:
    from xarray import Dataset


def write_difference(
    products: Sequence[Dataset], batches: tuple[int, int], labels: Sequence[str], output: Path
) -> None:
    """Draw the profiles of one pair of batches, and r0 of all of them over time.

    Parameters
    ----------
    products : two Datasets
        Products.
    batches : two ints
        Number of the batch in each whose profiles are drawn.
    labels : two strs
        Names for the legend.
    output : Path
        File that ends in .svg, .png or .pdf.

    Raises
    ------
    ExportError
        It ends otherwise, or there is no folder to write to.
    OSError
        It cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.figure import Figure

    form = output.suffix.lstrip(".").lower()
    if form not in ("svg", "png", "pdf"):
        raise ExportError("name a file that ends in .svg, .png or .pdf")
    with figure_style():
        figure = Figure(figsize=(12, 4.6), layout="constrained", facecolor="white")
        FigureCanvasAgg(figure)
        profile, series = figure.subplots(1, 2)
        draw_two_profiles(profile, products, batches, labels)
        for data, label, color, marker in zip(products, labels, (BLUE, RED), "oD", strict=True):
            begin, end = bounds(data).T
            # Apart by a tenth of a batch: bars of one batch would lie on each other.
            apart = int(np.mean(end - begin) * (0.05 if marker == "D" else -0.05))
            time = (begin + (end - begin) // 2 + apart).astype("datetime64[ns]")
            r0 = 100 * data["r0_profile"].values
            low, high = np.moveaxis(100 * data["r0_interval_68"].values, -1, 0)
            bars = np.nan_to_num(np.clip([r0 - low, high - r0], 0, None))
            fill = color if marker == "o" else "white"
            series.errorbar(time, r0, yerr=bars, color=color, marker=marker, mfc=fill, ls="", capsize=3, label=label)
        series.set_xlabel("time (UTC)")
        series.set_ylabel("Fried parameter $r_0$ (cm)")
        series.grid(axis="y")
        locator = AutoDateLocator()  # type: ignore[no-untyped-call]
        series.xaxis.set_major_locator(locator)
        series.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
        # A date in the file would make every figure another one.
        metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(form)
        write_whole(output, lambda file: figure.savefig(file, format=form, metadata=metadata))
