"""Figure of synthetic reconstructions: how mu is chosen, and what the bars are worth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .style import BLUE, GREEN, GRID, INK, MUTED, PURPLE, RED, figure_style

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from matplotlib.axes import Axes

    from ...pipeline.experiment import Outcome
    from ...pipeline.geometry import SliceGrid


def draw_experiment(outcomes: Mapping[str, Outcome], grid: SliceGrid, criterion: str, path: Path) -> None:
    """Draw one row of four panels per profile and write them to a file.

    Criterion against mu, error against mu, profiles with MAP and empirical bars, coverage of each slice.

    Parameters
    ----------
    outcomes : mapping of str to Outcome
        Results by name of the profile.
    grid : SliceGrid
        The slices.
    criterion : str
        What the criterion is called.
    path : pathlib.Path
        File to write; its ending chooses the format (png, svg, pdf).

    Raises
    ------
    ValueError
        matplotlib does not know the format.
    """
    from matplotlib.figure import Figure

    with figure_style():
        figure = Figure(figsize=(19, 4.4 * len(outcomes)), layout="constrained", facecolor="white")
        axes = figure.subplots(len(outcomes), 4, squeeze=False)
        for row, (name, outcome) in zip(axes, outcomes.items(), strict=True):
            _criterion(row[0], outcome, f"{name}: {criterion}")
            _error(row[1], outcome)
            _profiles(row[2], outcome, grid)
            _coverage(row[3], outcome, grid)
        figure.savefig(path, metadata={"Date": None} if path.suffix.lower() == ".svg" else None)


def _criterion(axes: Axes, outcome: Outcome, title: str) -> None:
    # Curves differ by constants from draw to draw, and the dip is shallow beside the rise toward large mu.
    curves = outcome.criterion - np.nanmin(outcome.criterion, axis=1, keepdims=True)
    axes.plot(outcome.log_mu_grid, curves.T, color=BLUE, alpha=0.25, lw=0.9)
    axes.set_title(title)
    axes.set_ylabel("above its minimum")
    axes.set_xlabel("log10 mu [m^(4/3)]")
    low = np.nanmedian(np.nanmin(np.where(curves > 0, curves, np.nan), axis=1))
    if np.isfinite(low):
        axes.set_yscale("symlog", linthresh=float(low))


def _error(axes: Axes, outcome: Outcome) -> None:
    axes.plot(outcome.log_mu_grid, outcome.error_curve.T, color=MUTED, alpha=0.25, lw=0.9)
    axes.plot(outcome.best_log_mu, outcome.error_best, "o", color=GREEN, ms=5, label="best mu")
    axes.plot(outcome.log_mu, outcome.error_map, "o", color=RED, ms=5, mfc="none", label="chosen mu")
    axes.set_title(f"error of the MAP profile; mean squared gap {outcome.squared_gap:.2f}")
    axes.set_ylabel("RMS error / mean Cn2")
    axes.set_xlabel("log10 mu [m^(4/3)]")
    axes.set_ylim(bottom=0)
    axes.legend()


def _profiles(axes: Axes, outcome: Outcome, grid: SliceGrid) -> None:
    edges = np.asarray(grid.edges)
    step = float(np.mean(grid.thickness))
    mean = outcome.cn2_map.mean(axis=0)
    axes.fill_between(
        grid.centres, outcome.cn2_map.min(axis=0), outcome.cn2_map.max(axis=0), color=GRID, label="least to greatest"
    )
    axes.stairs(outcome.truth, edges, color=INK, lw=1.8, label="truth", baseline=None)
    axes.errorbar(
        grid.centres - 0.12 * step,
        mean,
        outcome.bar_map.mean(axis=0),
        fmt="none",
        ecolor=RED,
        capsize=3,
        label="MAP bar",
    )
    axes.errorbar(
        grid.centres + 0.12 * step, mean, outcome.bar_empirical, fmt="none", ecolor=PURPLE, capsize=3,
        label="empirical bar",
    )  # fmt: skip
    axes.plot(grid.centres, mean, "o", color=BLUE, ms=4, label="mean of all draws")
    axes.set_title("profiles")
    axes.set_ylabel(r"$C_n^2$ (m$^{-2/3}$)")
    axes.set_xlabel("z (m)")
    axes.legend(fontsize=9)


def _coverage(axes: Axes, outcome: Outcome, grid: SliceGrid) -> None:
    for level, nominal in ((0, 0.68), (1, 0.95)):
        axes.axhline(nominal, color=MUTED, lw=0.8, ls=":")
        for kind, colour in (("map", RED), ("ml", MUTED), ("hpd", BLUE)):
            values = outcome.coverage[kind][level]
            style = "-" if level == 0 else "--"
            axes.plot(grid.centres, values, style, marker=".", color=colour, label=f"{kind} {nominal:.0%}")
    axes.set_title("share of draws that hold the truth")
    axes.set_xlabel("z (m)")
    axes.set_ylim(0, 1.02)
    axes.legend(fontsize=9, ncols=2)
