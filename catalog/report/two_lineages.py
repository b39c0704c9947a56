"""What differs between two products: their settings, and what came out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .page import path_mean
from .reading import bounds, edges, log_mu, of_batch, scalar
from .style import BLUE, RED, figure_style
from .svg import inline_svg
from .words import aligned, mapping, number, scientific

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import Dataset


def settings(dataset: Dataset) -> dict[str, str]:
    """Everything that enters a product's key, as ``stage.name`` and text; archive and upstream keys left out."""
    found: dict[str, str] = {}
    for node in mapping(mapping(dataset.attrs.get("lineage")).get("nodes")).values():
        node = mapping(node)
        stage = str(node.get("stage", ""))
        found[f"{stage}: version"] = str(node.get("version", ""))
        for part in ("plugins", "tracked"):
            _flatten(node.get(part), f"{stage}: ", found)
    return found


def _flatten(value: object, name: str, found: dict[str, str]) -> None:
    if isinstance(value, Mapping):
        for key, item in value.items():
            _flatten(item, f"{name}{key}" if name.endswith(" ") else f"{name}.{key}", found)
    elif value is not None or not name.endswith(": "):
        found[name] = "none" if value is None else str(value)[:200]


def differences(a: Dataset, b: Dataset) -> list[tuple[str, str, str]]:
    """Settings in which two products differ: name, of `a`, of `b`; empty text where one has no such setting."""
    left, right = settings(a), settings(b)
    return [
        (name, left.get(name, ""), right.get(name, ""))
        for name in sorted(left.keys() | right.keys())
        if left.get(name) != right.get(name)
    ]


def pairs(a: Dataset, b: Dataset) -> list[tuple[int, int]]:
    """Numbers of the batches that overlap in time by more than half of the shorter one, in the order of time."""
    found = []
    ours, theirs = bounds(a), bounds(b)
    for i, (start, stop) in enumerate(ours):
        overlap = np.minimum(stop, theirs[:, 1]) - np.maximum(start, theirs[:, 0])
        j = int(np.argmax(overlap))
        if overlap[j] > 0.5 * min(stop - start, theirs[j, 1] - theirs[j, 0]):
            found.append((i, j))
    return found


def draw_two_profiles(ax: Axes, products: Sequence[Dataset], batches: Sequence[int], labels: Sequence[str]) -> Axes:
    """Draw the profiles of two batches, with their MAP bars, into axes.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    products : two Datasets
        Products.
    batches : two ints
        Number of the batch in each.
    labels : two strs
        Names for the legend.

    Returns
    -------
    Axes
        `ax`.
    """
    top = 0.0
    low = np.inf
    for dataset, batch, label, color, marker, line, shift in zip(
        products, batches, labels, (BLUE, RED), "oD", ("-", "--"), (-0.08, 0.08), strict=True
    ):
        cn2, error = of_batch(dataset, "cn2", batch), of_batch(dataset, "cn2_standard_error", batch)
        border = edges(dataset)
        shown = np.zeros(border.size - 1, bool) if cn2 is None else np.isfinite(cn2) & (cn2 > 0)
        if cn2 is None or not shown.any():
            ax.plot([], [], color=color, ls=line, marker=marker, label=f"{label}: no profile above zero")
            continue
        ax.stairs(np.where(shown, cn2, np.nan), border, baseline=None, color=color, ls=line, lw=2)
        bar = np.full(cn2.shape, np.nan) if error is None else error
        centre = (border[1:] + border[:-1]) / 2 + shift * np.diff(border)
        ax.errorbar(
            centre[shown], cn2[shown], yerr=np.stack([np.minimum(bar, 0.999 * cn2), bar])[:, shown], fmt=marker,
            color=color, mfc=color if marker == "o" else "white", ms=6, capsize=3, lw=1.4, label=label,
        )  # fmt: skip
        top = max(top, float(cn2[shown].max() * 2))
        low = min(low, float(cn2[shown].min() / 4))
        ax.set_xlim(border[0], border[-1])
    if top > 0:
        ax.set_yscale("log")
        ax.set_ylim(max(low, top / 1e5), top)
    ax.set_xlabel("distance from the pupil z (m)")
    ax.set_ylabel(r"$C_n^2$ (m$^{-2/3}$)")
    ax.grid(axis="y", which="major")
    ax.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncol=2)
    return ax


def two_profiles_markup(products: tuple[Dataset, Dataset], batches: tuple[int, int]) -> str:
    """The profiles of two batches as inline markup, called A and B."""
    from matplotlib.figure import Figure

    text = "Two profiles of Cn² against distance, A solid and B dashed; the table has their numbers."
    with figure_style():
        drawn = Figure(figsize=(10.0, 4.6))
        draw_two_profiles(drawn.add_axes((0.105, 0.155, 0.88, 0.73)), products, batches, ("A", "B"))
        return inline_svg(drawn, "cmp", "Profiles of A and B", text)


def slice_rows(a: Dataset, b: Dataset, i: int, j: int) -> list[list[str]]:
    """Both profiles in numbers: from, to, of `a`, of `b`, ratio, difference in units of both MAP bars.

    Empty where the slices are not the same.
    """
    border = edges(a)
    left, right = of_batch(a, "cn2", i), of_batch(b, "cn2", j)
    if left is None or right is None or not np.array_equal(border, edges(b)):
        return []
    bars = [of_batch(a, "cn2_standard_error", i), of_batch(b, "cn2_standard_error", j)]
    both = np.hypot(*(np.full(left.shape, np.nan) if bar is None else bar for bar in bars))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, apart = right / left, (right - left) / both
    places = aligned(border)
    return [
        [places[n], places[n + 1], scientific(left[n]), scientific(right[n]),
         number(ratio[n]) if np.isfinite(ratio[n]) else "–", number(apart[n], 2)]
        for n in range(left.size)
    ]  # fmt: skip


def summary_rows(a: Dataset, b: Dataset) -> list[dict[str, Any]]:
    """One row for each pair of batches: start (ns), numbers of the batches, and the text of paired numbers."""

    def pair(name: str, i: int, j: int, factor: float = 1.0, digits: int = 3) -> list[str]:
        return [number(factor * scalar(a, name, i), digits), number(factor * scalar(b, name, j), digits)]

    rows = []
    for i, j in pairs(a, b):
        rows.append({
            "start": int(bounds(a)[i, 0]),
            "batches": (i, j),
            "cells": [
                *(number(path_mean(*which)[0]) for which in ((a, i), (b, j))),
                *pair("r0_profile", i, j, 100),
                *pair("scintillation_index_profile", i, j),
                number(log_mu(scalar(a, "mu", i)), 4),
                number(log_mu(scalar(b, "mu", j)), 4),
                *pair("chi2_reduced", i, j),
            ],
        })  # fmt: skip
    return rows
