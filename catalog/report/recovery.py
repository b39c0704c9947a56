"""Figure of profiles of simulated recordings beside their truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from .style import BLUE, GRID, INK, MUTED, RED, figure_style

if TYPE_CHECKING:
    from pathlib import Path

    from ...pipeline.geometry import SliceGrid

    Floats = NDArray[np.float64]


class Found(Protocol):
    """What is drawn: R recordings, k slices."""

    @property
    def grid(self) -> SliceGrid:
        """The slices."""

    @property
    def truth(self) -> Floats:
        """(R, k)."""

    @property
    def cn2(self) -> Floats:
        """(R, k)."""

    @property
    def mean_interval_68(self) -> Floats:
        """(k, 2)."""

    @property
    def mean_interval_95(self) -> Floats:
        """(k, 2)."""

    @property
    def held_68(self) -> Floats:
        """(k,)."""

    @property
    def held_95(self) -> Floats:
        """(k,)."""


def draw_recovery(found: Found, title: str, path: Path) -> None:
    """Draw profiles and mean intervals beside the truth, and the share of recordings that hold it.

    Parameters
    ----------
    found : Found
        Results of the recordings.
    title : str
        Line above.
    path : pathlib.Path
        File to write; its ending chooses the format (png, svg, pdf).

    Raises
    ------
    ValueError
        matplotlib does not know the format.
    """
    from matplotlib.figure import Figure

    edges, z = np.asarray(found.grid.edges), found.grid.centres
    with figure_style():
        figure = Figure(figsize=(12, 4.4), layout="constrained", facecolor="white")
        left, right = figure.subplots(1, 2, width_ratios=[3, 2])
        for number, profile in enumerate(found.cn2):
            left.stairs(
                profile, edges, color=MUTED, alpha=0.25, lw=0.8, baseline=None,
                label="single recordings" if number == 0 else None,
            )  # fmt: skip
        for interval, width, label in (
            (found.mean_interval_95, 0.5, "mean 95 % interval"),
            (found.mean_interval_68, 0.25, "mean 68 % interval"),
        ):
            side = width * found.grid.thickness / 2
            colour = GRID if width == 0.5 else BLUE
            left.bar(
                z, interval[:, 1] - interval[:, 0], 2 * side, interval[:, 0], color=colour, alpha=0.55, label=label
            )
        left.stairs(found.truth.mean(axis=0), edges, color=INK, lw=2.0, baseline=None, label="truth")
        left.plot(z, found.cn2.mean(axis=0), "o", color=RED, label="mean profile")
        left.set_xlabel("z (m)")
        left.set_ylabel(r"$C_n^2$ (m$^{-2/3}$)")
        # A single recording may be far off in the last slice; the scale is that of what is stated.
        stated = found.mean_interval_95[np.isfinite(found.mean_interval_95)]
        left.set_ylim(0, 1.25 * max(stated.max(initial=0.0), found.truth.max()))
        left.set_title(title)
        left.legend(fontsize=9)
        for values, nominal, style in ((found.held_68, 0.68, "-o"), (found.held_95, 0.95, "--s")):
            right.axhline(nominal, color=MUTED, lw=0.9, ls=":")
            right.plot(z, values, style, color=BLUE, label=f"{nominal:.0%} interval")
        right.set_ylim(0, 1.02)
        right.set_xlabel("z (m)")
        right.set_title("share of recordings that hold the truth")
        right.legend(loc="lower left")
        figure.savefig(path, metadata={"Date": None} if path.suffix.lower() == ".svg" else None)
