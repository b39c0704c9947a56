"""Picture of a lenslet grid over the frame on which it was found."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from .style import BLUE, INK, RED, figure_style

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from ...pipeline.lenslets import Boxes, LensletGrid


def draw_grid(
    image: NDArray[np.float64], grid: LensletGrid | None, boxes: Boxes | None, title: str, path: Path
) -> None:
    """Draw boxes and spots over a mean frame and write the picture.

    Parameters
    ----------
    image : ndarray, (row, col)
        Mean frame.
    grid : LensletGrid or None
        Grid found on it; its spots are drawn as circles.
    boxes : Boxes or None
        The grid in boxes of whole pixels, drawn as squares where they describe it.
    title : str
        Line above the picture.
    path : pathlib.Path
        File to write; its ending chooses the format (png, svg, pdf).

    Raises
    ------
    ValueError
        matplotlib does not know the format.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    height, width = image.shape
    with figure_style():
        figure = Figure(figsize=(10, 10 * height / width + 0.9), layout="constrained", facecolor="white")
        axes = figure.subplots()
        good = image[np.isfinite(image)]
        low, high = np.quantile(good, [0.01, 0.998]) if good.size else (0.0, 1.0)
        # The square root shows faint spots beside bright ones.
        shown = np.sqrt(np.clip((np.nan_to_num(image, nan=low) - low) / max(high - low, 1e-300), 0, 1))
        axes.imshow(shown, cmap="gray", interpolation="nearest")
        if grid is not None:
            for number, colour in zip(range(grid.n_sources), (RED, BLUE, INK, INK), strict=False):
                spots = grid.positions[number][np.isfinite(grid.positions[number]).all(axis=-1)]
                axes.plot(
                    spots[:, 1],
                    spots[:, 0],
                    "o",
                    color=colour,
                    markersize=7,
                    fillstyle="none",
                    markeredgewidth=1.2,
                    label=f"spot {number + 1}",
                )
            if boxes is not None and not boxes.faults:
                rows, cols = boxes.pitch
                corner = np.array(boxes.origin) + np.argwhere(boxes.mask) * boxes.pitch - 0.5
                around = np.array([[0, 0], [0, cols], [rows, cols], [rows, 0], [0, 0]])
                lines = (corner[:, None] + around)[..., ::-1]
            else:
                # Cells of the grid as it is: where boxes of whole pixels do not describe it, this shows how it lies.
                a, b = grid.vectors
                around = np.array([-a - b, -a + b, a + b, a - b, -a - b]) / 2
                lines = (grid.lenslets[grid.mask][:, None] + around)[..., ::-1]
            axes.add_collection(LineCollection(list(lines), colors="#56b4e9", linewidths=0.8))
            if grid.n_sources > 1:
                axes.legend(loc="upper right", facecolor="white", frameon=True)
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
        axes.set_xlabel("column (px)")
        axes.set_ylabel("row (px)")
        axes.set_title("\n".join(textwrap.wrap(title, 84)), fontsize=11)
        figure.savefig(path, metadata={"Date": None} if path.suffix.lower() == ".svg" else None)
