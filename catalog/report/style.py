"""How figures look: one set of colours, sizes and settings for page, PNG and PDF."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

#: Colours of figures -> name of the page's colour that replaces them (light and dark differ). Okabe and Ito's
#: colour-blind-safe set, the last darkened so that thin lines keep a contrast of 3:1 on white.
COLOURS = {
    "#1b1f24": "ink",
    "#59636e": "muted",
    "#d1d7de": "grid",
    "#fffffe": "paper",
    "#0072b2": "blue",
    "#d55e00": "red",
    "#009e73": "green",
    "#a8487f": "purple",
}
INK, MUTED, GRID, PAPER, BLUE, RED, GREEN, PURPLE = COLOURS

#: Colour maps: perceptually even and readable with any colour vision; the second is symmetrical about zero.
SEQUENTIAL, DIVERGING = "viridis", "RdBu_r"

_SETTINGS: dict[str, object] = {
    "axes.axisbelow": True,
    "axes.edgecolor": INK,
    "axes.facecolor": "none",
    "axes.grid": False,
    "axes.labelcolor": INK,
    "axes.labelsize": 13,
    "axes.linewidth": 0.9,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 13,
    "figure.dpi": 100,
    "figure.edgecolor": "none",
    "figure.facecolor": "none",
    "font.family": "DejaVu Sans",
    "font.size": 12,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "hatch.linewidth": 0.8,
    "image.composite_image": False,
    "legend.fontsize": 12,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "lines.linewidth": 1.8,
    "lines.markersize": 6,
    "path.simplify": True,
    "savefig.dpi": 150,
    "savefig.facecolor": "auto",
    "svg.fonttype": "none",
    "svg.hashsalt": "coslidar",
    "text.color": INK,
    "xtick.color": INK,
    "xtick.labelsize": 12,
    "ytick.color": INK,
    "ytick.labelsize": 12,
}


@contextmanager
def figure_style() -> Iterator[None]:
    """Draw in the report's style whatever the user's matplotlibrc says, and leave that as it was."""
    import matplotlib.style

    with matplotlib.style.context(_SETTINGS, after_reset=True):
        yield
