"""Figures of the model: what the data answer to, and how much a profile depends on mu."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...pipeline.products import INTENSITY_KINDS, SLOPE_KINDS
from .batch_panels import cn2_limits, draw_profile, note
from .reading import Floats, edges, log_mu, of_batch, scalar
from .style import BLUE, GREEN, INK, MUTED, PAPER, PURPLE, RED, SEQUENTIAL
from .words import clean, number, scientific

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

#: Auto maps: variable, kinds, kind, label, unit, direction of the cut.
_AUTO = (
    ("response_intensity", INTENSITY_KINDS, "ii_auto", "scintillation"),
    ("response_slope", SLOPE_KINDS, "xx_auto", "x slopes"),
)


def _response(dataset: Dataset, variable: str, kinds: tuple[str, ...], kind: str) -> Floats | None:
    """Response of one map to Cn2 dz = 1 in each slice, (dy, dx, z)."""
    if variable not in dataset:
        return None
    whole: Floats = np.asarray(dataset[variable].values, np.float64)
    return np.asarray(whole[kinds.index(kind)] / np.diff(edges(dataset)))


def draw_response(ax: Axes, dataset: Dataset, kind: str = "ii_auto") -> Axes:
    """Draw the auto-correlation that each slice makes along y at dx = 0, for Cn2 dz = 1 in it.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    dataset : Dataset
        A product.
    kind : str
        "ii_auto" for scintillation, "xx_auto" for slopes along x.

    Returns
    -------
    Axes
        `ax`, with one line a slice.

    Raises
    ------
    ValueError
        There is no such kind.
    """
    from matplotlib import colormaps

    known = {item[2]: item for item in _AUTO}
    if kind not in known:
        raise ValueError(f"kind = {kind!r}: there are {', '.join(known)}")
    variable, kinds, _, label = known[kind]
    found = _response(dataset, variable, kinds, kind)
    if found is None or not np.isfinite(found).any():
        return note(ax, "no response functions")
    dy = np.asarray(dataset["dy"].values, np.float64)
    middle_y, middle_x = len(dy) // 2, found.shape[1] // 2
    border = edges(dataset)
    colours = colormaps[SEQUENTIAL](np.linspace(0, 0.88, found.shape[-1]))
    for slice_, colour in enumerate(colours):
        # The slice's number stands at the line too: colour alone tells nothing.
        values = found[middle_y:, middle_x, slice_]
        ax.plot(100 * dy[middle_y:], values, color=colour, lw=1.5, marker=f"${slice_ + 1}$", ms=7, mew=0.6)
    ax.axhline(0, color=MUTED, lw=0.8)
    ax.yaxis.set_major_formatter(lambda value, _: number(value, 2))
    ax.set_xlabel("separation dy (cm)")
    ax.set_ylabel(f"{label}, per Cn²dz")
    ax.set_title(f"slices 1 to {len(border) - 1}, from the pupil", fontsize=11)
    return ax


def draw_sensitivity(ax: Axes, dataset: Dataset) -> Axes:
    """Draw scintillation and slope variance that Cn2 dz = 1 makes at each distance, relative to their largest."""
    z = np.asarray(dataset["z"].values, np.float64)
    drawn = False
    for (variable, kinds, kind, label), colour, marker, dashes in zip(
        _AUTO, (RED, BLUE), ("o", "s"), ("-", (0, (5, 2))), strict=True
    ):
        found = _response(dataset, variable, kinds, kind)
        if found is None:
            continue
        variance = found[found.shape[0] // 2, found.shape[1] // 2]
        ax.plot(z, variance / np.nanmax(variance), color=colour, marker=marker, mfc=PAPER, ls=dashes, label=label)
        drawn = True
    if not drawn:
        return note(ax, "no response functions")
    limit = float(dataset["z_max"].values) if "z_max" in dataset else float("nan")
    if np.isfinite(limit):
        ax.axvline(limit, color=INK, lw=1, ls=":")
        ax.annotate("triangulation ends", (limit, 0.02), xytext=(5, 2), textcoords="offset points", fontsize=11)
    ax.set_xlim(edges(dataset)[0], edges(dataset)[-1])
    ax.set_ylim(0, 1.22)
    ax.set_xlabel("distance from the pupil z (m)")
    ax.set_ylabel("variance / largest")
    ax.legend(loc="upper right", ncol=2)
    return ax


def compose_response(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out responses of scintillation and slopes, and the sensitivity against distance."""
    dataset = _described(datasets)
    for place, item in zip(((0.115, 0.575, 0.375, 0.36), (0.605, 0.575, 0.375, 0.36)), _AUTO, strict=True):
        draw_response(figure.add_axes(place), dataset, item[2])
    draw_sensitivity(figure.add_axes((0.115, 0.1, 0.865, 0.32)), dataset)


def _described(datasets: Sequence[Dataset]) -> Dataset:
    """The first product that knows its responses."""
    return next((dataset for dataset in datasets if "response_intensity" in dataset), datasets[0])


def describe_response(datasets: Sequence[Dataset]) -> str:
    """Say where slopes and scintillation are most sensitive."""
    dataset = _described(datasets)
    z = np.asarray(dataset["z"].values, np.float64) if "z" in dataset else np.empty(0)
    parts = []
    for variable, kinds, kind, label in _AUTO:
        found = _response(dataset, variable, kinds, kind)
        if found is not None and np.isfinite(found).any():
            variance = found[found.shape[0] // 2, found.shape[1] // 2]
            parts.append(f"{label}: largest at {number(float(z[np.nanargmax(variance)]), 4)} m, smallest at "
                         f"{number(float(z[np.nanargmin(variance)]), 4)} m")  # fmt: skip
    return f"Variance per Cn²dz, {'; '.join(parts)}." if parts else "The products do not hold their response functions."


#: Marker and dashes of each scintillometer.
_WEIGHTS = (("s", (0, (5, 2)), GREEN), ("o", (0, (1, 1.5)), RED), ("^", (0, (6, 2, 1, 2)), PURPLE))


def _weighted(datasets: Sequence[Dataset]) -> Dataset | None:
    return next((dataset for dataset in datasets if dataset.sizes.get("scintillometer", 0)
                 and "scintillometer_weight" in dataset), None)  # fmt: skip


def compose_weights(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out the weight of each slice in the Cn2 of each scintillometer."""
    ax = figure.add_axes((0.085, 0.19, 0.895, 0.76))
    dataset = _weighted(datasets)
    if dataset is None:
        note(ax, "no scintillometers")
        return
    z = np.asarray(dataset["z"].values, np.float64)
    # Per length of path, relative to the mean: slices may differ in thickness.
    border = edges(dataset)
    weights = np.asarray(dataset["scintillometer_weight"].values, np.float64) / np.diff(border)
    for number_, (name, row) in enumerate(zip(dataset["scintillometer"].values, weights, strict=True)):
        marker, dashes, colour = _WEIGHTS[number_ % len(_WEIGHTS)]
        shown = clean(name)[:24].replace("$", r"\$")
        ax.plot(z, row * (border[-1] - border[0]), color=colour, marker=marker, mfc=PAPER, ls=dashes, label=shown)
    ax.set_xlim(border[0], border[-1])
    ax.set_ylim(bottom=0)
    ax.set_xlabel("distance from the pupil z (m)")
    ax.set_ylabel("weight / mean weight")
    ax.grid(axis="y")
    ax.legend(loc="upper right")


def describe_weights(datasets: Sequence[Dataset]) -> str:
    """Say where along the path each scintillometer looks."""
    dataset = _weighted(datasets)
    if dataset is None:
        return "The recording's header names no scintillometer."
    z = np.asarray(dataset["z"].values, np.float64)
    weights = np.asarray(dataset["scintillometer_weight"].values, np.float64)
    parts = [f"{clean(name)}: centre of weight at {number(float(row @ z / row.sum()), 4)} m"
             for name, row in zip(dataset["scintillometer"].values, weights, strict=True)]  # fmt: skip
    return "; ".join(parts) + "."


def compose_other_mu(figure: Figure, dataset: Dataset, batch: int) -> None:
    """Lay out the profile at a hundredth of mu, at mu, and at a hundred times mu on one scale."""
    other = of_batch(dataset, "cn2_other_mu", batch)
    if other is None or not (other > 0).any():
        note(figure.add_axes((0.1, 0.1, 0.8, 0.8)), "no profiles at other μ")
        return
    left, width, gap = 0.085, 0.285, 0.018
    axes = [figure.add_axes((left + i * (width + gap), 0.17, width, 0.66)) for i in range(3)]
    chosen = log_mu(scalar(dataset, "mu", batch))
    factors = [np.log10(factor) for factor in np.asarray(dataset["mu_factor"].values, np.float64)]
    variants = [_at(dataset, batch, 0), dataset, _at(dataset, batch, 1)]
    scales = [cn2_limits(shown, batch) for shown in variants]
    known = [scale for scale in scales if scale is not None]
    scale = None
    if known:
        top = max(high for _, high in known)
        scale = max(min(low for low, _ in known), top / 1e5), top
    for ax, shown, shift in zip(axes, variants, (factors[0], 0.0, factors[1]), strict=True):
        draw_profile(ax, shown, batch, bars=("map",), legend=False, scale=scale)
        words = "" if shift else "\nchosen"
        ax.set_title(f"log₁₀ μ = {number(chosen + shift, 4)}{words}", fontsize=12, loc="center")
    for ax in axes[1:]:
        ax.set_ylabel("")
        ax.tick_params(axis="y", labelleft=False)
    for ax in axes:
        ax.set_xlabel("z (m)")
        ax.locator_params(axis="x", nbins=3)


def _at(dataset: Dataset, batch: int, which: int) -> Dataset:
    """The product with the profile of a batch at another mu in the place of the chosen one."""
    chosen = dataset[["cn2", "cn2_standard_error", "z_bounds"]].copy(deep=True)
    for name, other in (("cn2", "cn2_other_mu"), ("cn2_standard_error", "cn2_other_mu_standard_error")):
        chosen[name][batch] = dataset[other].values[batch, which]
    return chosen


def describe_other_mu(dataset: Dataset, batch: int) -> str:
    """Say how much the mean over the path changes with mu."""
    cn2, other = of_batch(dataset, "cn2", batch), of_batch(dataset, "cn2_other_mu", batch)
    if cn2 is None or other is None or not np.isfinite(other).any():
        return "This batch has no profiles at other μ."
    share = np.diff(edges(dataset)) / np.diff(edges(dataset)).sum()
    means = [float(share @ values) for values in (other[0], cn2, other[1])]
    words = [scientific(mean) for mean in means]
    return (
        f"Mean of Cn² along the path: {words[0]} m^(-2/3) at a hundredth of the chosen μ, {words[1]} at the chosen "
        f"one, {words[2]} at a hundred times as much."
    )
