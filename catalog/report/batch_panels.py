"""Figures of one batch: profile, correlation maps, criterion, averaging kernels.

Each `draw_…` function draws into axes that the caller made and returns them, each `compose_…` lays out a whole figure
of the report, and each `describe_…` says in words what the figure shows.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...pipeline.geometry import MAP_KINDS
from .reading import Floats, Maps, edges, log_mu, maps, of_batch, scalar
from .style import BLUE, DIVERGING, GREEN, INK, MUTED, PAPER, PURPLE, RED, SEQUENTIAL
from .words import aligned, measured, number, scientific

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from xarray import Dataset

Flags = NDArray[np.bool_]

#: Titles of the correlation maps.
KIND_TITLES = {
    "xx_auto": "x slopes\none source",
    "yy_auto": "y slopes\none source",
    "xx_cross": "x slopes\ntwo sources",
    "yy_cross": "y slopes\ntwo sources",
    "ii_auto": "scintillation\none source",
    "ii_cross": "scintillation\ntwo sources",
}
#: Residuals beyond this many of their errors carry a sign in the map.
NOTABLE = 3.0
_INTERVAL = "68 % and 95 % interval"
_HEIGHT = r"$h^{-4/3}$ over the terrain"
_LEGEND = ("retrieved", "MAP bar", _INTERVAL, "maximum-likelihood bar", "bar goes on", "upper limit", _HEIGHT)
#: rad^2 are shown as µrad^2.
_MICRO = 1e12


def note(ax: Axes, text: str) -> Axes:
    """Say in empty axes why they are empty."""
    ax.text(0.5, 0.5, text, ha="center", va="center", color=MUTED, transform=ax.transAxes)
    ax.set_xticks([])
    ax.set_yticks([])
    return ax


def _plain(value: float, _: float = 0) -> str:
    return f"{value:.6g}".replace("-", "−")


def _ticks(axis: Axis, lags: Floats) -> None:
    """Mark zero and a round number on either side, well inside so that labels of neighbouring maps keep apart."""
    reach = 0.8 * float(np.abs(lags).max())
    if reach > 0:
        decade = 10.0 ** np.floor(np.log10(reach))
        step = max(factor * decade for factor in (1, 2, 3, 5) if factor * decade <= reach)
        axis.set_ticks([-step, 0.0, step])
    else:
        axis.set_ticks([0.0])
    axis.set_major_formatter(_plain)
    axis.set_tick_params(labelsize=11)


def _limits(dataset: Dataset, batch: int, shape: tuple[int, ...]) -> tuple[Floats, Floats, Flags, Floats]:
    """MAP bars, ML bars, whether the bound is active, and the upper limit there."""
    blank = np.full(shape, np.nan)
    cn2 = of_batch(dataset, "cn2", batch)
    error = of_batch(dataset, "cn2_standard_error", batch)
    error_ml = of_batch(dataset, "cn2_standard_error_ml", batch)
    bound = of_batch(dataset, "cn2_at_bound", batch)
    interval = of_batch(dataset, "cn2_interval_95", batch)
    cn2 = blank if cn2 is None else cn2
    error = blank if error is None else error
    active: Flags = np.asarray(np.nan_to_num(bound) > 0 if bound is not None else cn2 <= 0)
    upper = interval[..., 1] if interval is not None else cn2 + 2 * error
    return error, blank if error_ml is None else error_ml, active, np.where(active, upper, np.nan)


def cn2_limits(dataset: Dataset, batch: int) -> tuple[float, float] | None:
    """Limits of the Cn2 axis that show the profile of a batch with its MAP bars; None where every slice is at zero."""
    cn2 = of_batch(dataset, "cn2", batch)
    if cn2 is None:
        return None
    error, _, active, limit = _limits(dataset, batch, cn2.shape)
    shown = np.isfinite(cn2) & (cn2 > 0) & ~active
    seen = np.concatenate([cn2[shown], (cn2 + error)[shown], limit])
    seen = seen[np.isfinite(seen) & (seen > 0)]
    if not seen.size:
        return None
    top = 1.6 * float(seen.max())
    low = float(min([*cn2[shown], *limit[np.isfinite(limit) & (limit > 0)]]))
    return max(low / 3, top / 1e5), top


def draw_profile(
    ax: Axes,
    dataset: Dataset,
    batch: int = 0,
    *,
    bars: Collection[str] = ("map", "interval", "ml"),
    legend: bool = True,
    scale: tuple[float, float] | None = None,
) -> Axes:
    """Draw the profile of a batch: slices as steps, every kind of bar, upper limits where the bound is active.

    Where the product knows the height above ground, a dashed line shows Cn2 proportional to its power of -4/3 (free
    convection; Wyngaard, Izumi and Collins 1971, https://doi.org/10.1364/JOSA.61.001646), scaled to the profile.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    dataset : Dataset
        A product.
    batch : int
        Number of the batch in the product.
    bars : collection of str
        Which of "map" (MAP bars), "interval" (intervals of the posterior that hold 68 % and 95 %), "ml"
        (maximum-likelihood bars).
    legend : bool
        Whether to say what is what.
    scale : (float, float), optional
        Limits of the Cn2 axis; those of :func:`cn2_limits` where they are absent.

    Returns
    -------
    Axes
        `ax`.
    """
    from matplotlib.ticker import NullFormatter

    cn2 = of_batch(dataset, "cn2", batch)
    if cn2 is None or not np.isfinite(cn2).any():
        return note(ax, "no profile")
    border = edges(dataset)
    centre, width = (border[1:] + border[:-1]) / 2, np.diff(border)
    error, error_ml, active, limit = _limits(dataset, batch, cn2.shape)
    shown = np.isfinite(cn2) & (cn2 > 0) & ~active

    scale = scale or cn2_limits(dataset, batch)
    if scale is None:
        return note(ax, "every slice is at the bound")
    bottom, top = scale
    ax.set_yscale("log")
    ax.set_ylim(bottom, top)
    if top > 30 * bottom:
        # Decades are enough then; the long names of the steps between them would need a wider margin.
        ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_xlim(border[0], border[-1])

    steps = np.where(shown, cn2, np.nan)
    ax.stairs(np.where(shown, cn2, bottom), border, baseline=bottom, fill=True, color=BLUE, alpha=0.13, lw=0)
    ax.stairs(steps, border, baseline=None, color=BLUE, lw=2.2, label="retrieved")

    def draw_bars(at: Floats, bar: Floats, where: Flags, **style: object) -> None:
        # On a logarithmic axis a bar that reaches below zero ends under the axis, not nowhere.
        here = where & np.isfinite(bar) & (bar > 0)
        low = np.minimum(bar, cn2 - np.minimum(cn2, bottom) / 2)
        ax.errorbar(at[here], cn2[here], yerr=np.stack([low, bar])[:, here], **style)  # type: ignore[arg-type]

    if "map" in bars:
        draw_bars(centre - 0.23 * width, error, shown, fmt="o", color=BLUE, mfc=BLUE, ms=5.5, capsize=4, lw=2,
                  label="MAP bar")  # fmt: skip
    if "interval" in bars:
        for name, thickness, label in (("cn2_interval_95", 1.4, "_"), ("cn2_interval_68", 4.5, _INTERVAL)):
            ends = of_batch(dataset, name, batch)
            if ends is not None:
                here = shown & np.isfinite(ends).all(axis=-1) & (ends[:, 1] > bottom)
                ax.vlines(centre[here], np.maximum(ends[here, 0], bottom / 2), ends[here, 1], color=GREEN, lw=thickness,
                          label=label)  # fmt: skip
    beyond = shown & ~np.isnan(error_ml) & (cn2 + error_ml > top) & ("ml" in bars)
    if "ml" in bars:
        draw_bars(centre + 0.23 * width, error_ml, shown & (error_ml < 1e3 * top), fmt="D", color=RED, mfc=PAPER, ms=5,
                  capsize=4, lw=1.2, label="maximum-likelihood bar")  # fmt: skip
    if beyond.any():
        ax.plot((centre + 0.23 * width)[beyond], np.full(beyond.sum(), 0.985), "^", color=RED, mfc=PAPER, ms=7,
                transform=ax.get_xaxis_transform(), clip_on=False, label="bar goes on")  # fmt: skip
    arrows = active & np.isfinite(limit) & (limit > bottom)
    if arrows.any():
        x, high = centre[arrows], limit[arrows]
        low = np.maximum(0.45 * high, 1.1 * bottom)
        ax.hlines(high, x - 0.4 * width[arrows], x + 0.4 * width[arrows], color=PURPLE, lw=2.2)
        ax.vlines(x, low, high, color=PURPLE, lw=2.2)
        ax.plot(x, low, "v", color=PURPLE, ms=9, label="upper limit")
    ground = _over_ground(dataset, cn2, error)
    if legend and ground is not None:
        ax.plot(centre, ground, color=INK, ls=(0, (5, 3)), lw=1.5, label=_HEIGHT)
    ax.set_xlabel("distance from the pupil z (m)")
    ax.set_ylabel(r"$C_n^2$ (m$^{-2/3}$)")
    ax.grid(axis="y", which="major")
    if not legend:
        return ax
    handles, labels = ax.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda i: _LEGEND.index(labels[i]))
    ax.legend([handles[i] for i in order], [labels[i] for i in order], loc="lower left", bbox_to_anchor=(-0.01, 1.0),
              ncol=4, columnspacing=1.4, handletextpad=0.5)  # fmt: skip
    return ax


def _over_ground(dataset: Dataset, cn2: Floats, error: Floats) -> Floats | None:
    """Cn2 proportional to h^(-4/3), as close to the profile as its MAP bars ask for; None without heights."""
    if "height_above_ground" not in dataset:
        return None
    shape = np.asarray(dataset["height_above_ground"].values, np.float64) ** (-4 / 3)
    weight = np.where(np.isfinite(shape) & np.isfinite(cn2) & (error > 0), 1 / np.where(error > 0, error, 1) ** 2, 0)
    known = np.nan_to_num(shape)
    if not (weight * known).any():
        return None
    return np.asarray(shape * np.sum(weight * known * np.nan_to_num(cn2)) / np.sum(weight * known**2))


def compose_profile(figure: Figure, dataset: Dataset, batch: int) -> None:
    """Lay out the figure of the profile."""
    draw_profile(figure.add_axes((0.105, 0.145, 0.88, 0.71)), dataset, batch)


def describe_profile(dataset: Dataset, batch: int) -> str:
    """Say what the profile of a batch shows."""
    cn2 = of_batch(dataset, "cn2", batch)
    if cn2 is None or not np.isfinite(cn2).any():
        return "This batch has no profile."
    border = edges(dataset)
    error, _, active, _ = _limits(dataset, batch, cn2.shape)
    peak = int(np.nanargmax(cn2))
    text = (
        f"Cn² in {cn2.size} slices from {number(border[0], 4)} to {number(border[-1], 4)} m. The strongest slice, "
        f"{number(border[peak], 4)} to {number(border[peak + 1], 4)} m, holds "
        f"{measured(cn2[peak], error[peak])} m^(-2/3)."
    )
    count = int(active.sum())
    return text + (f" {count} of the slices {'is' if count == 1 else 'are'} at the bound of zero." if count else "")


def _one(dataset: Dataset, batch: int, kind: str) -> Maps | None:
    """Map of one kind of a batch, None where it has none."""
    if kind not in MAP_KINDS:
        raise ValueError(f"kind = {kind!r}: there are {', '.join(MAP_KINDS)}")
    return next((item for item in maps(dataset, batch) if item.kind == kind), None)


def draw_correlation_map(
    ax: Axes, dataset: Dataset, batch: int = 0, *, kind: str = "ii_auto", which: str = "measured"
) -> Axes:
    """Draw one correlation map of a batch with its scale, dy upward: µrad² of slopes, an index of scintillation.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    dataset : Dataset
        A product.
    batch : int
        Number of the batch in the product.
    kind : str
        One of :data:`coslidar.pipeline.geometry.MAP_KINDS`.
    which : str
        "measured", "model", or "residual" (measured minus model in units of the error, with a sign beyond 3).

    Returns
    -------
    Axes
        `ax`.

    Raises
    ------
    ValueError
        There is no such kind, or no such map of it.
    """
    from matplotlib.colors import Normalize

    if which not in ("measured", "model", "residual"):
        raise ValueError(f"which = {which!r}: there are measured, model, residual")
    item = _one(dataset, batch, kind)
    if item is None:
        return note(ax, "no correlation maps")
    residual, unit = which == "residual", _MICRO if item.is_slope else 1.0
    norm = Normalize(-2 * NOTABLE, 2 * NOTABLE) if residual else Normalize(*_range([item], unit))
    values = item.residual if residual else getattr(item, which) * unit
    image = _draw_map(ax, dataset, values, norm=norm, residual=residual)
    ax.set_title(f"{KIND_TITLES[kind]}, {which}".replace("\n", ", "))
    ax.set_xlabel("dx (cm)")
    ax.set_ylabel("dy (cm)")
    words = "errors" if residual else "µrad²" if item.is_slope else "index"
    ax.figure.colorbar(image, ax=ax, fraction=0.05, pad=0.03, label=words)
    return ax


def draw_correlation_cut(ax: Axes, dataset: Dataset, batch: int = 0, *, kind: str = "ii_auto") -> Axes:
    """Draw measured and modelled correlation of a batch along dy at dx = 0.

    Parameters
    ----------
    ax, dataset, batch, kind
        As for :func:`draw_correlation_map`.

    Returns
    -------
    Axes
        `ax`.
    """
    item = _one(dataset, batch, kind)
    if item is None:
        return note(ax, "no correlation maps")
    _draw_cut(ax, dataset, item).set_xlabel("dy (cm)")
    ax.set_ylabel(KIND_TITLES[kind].replace("\n", ", ") + (" (µrad²)" if item.is_slope else ""))
    ax.legend()
    return ax


def _draw_map(
    ax: Axes, dataset: Dataset, values: Floats, *, norm: Normalize, residual: bool = False, ticks: bool = True
) -> AxesImage:
    """Draw values of (dy, dx), NaN blank, with signs beyond :data:`NOTABLE` if they are a residual."""
    dy, dx = (np.asarray(dataset[name].values, dtype=np.float64) * 100 for name in ("dy", "dx"))
    half_y, half_x = ((axis[1] - axis[0]) / 2 if axis.size > 1 else 0.5 for axis in (dy, dx))
    image = ax.imshow(
        np.ma.masked_invalid(values), origin="lower", interpolation="none", norm=norm, aspect="equal",
        cmap=DIVERGING if residual else SEQUENTIAL,
        extent=(dx[0] - half_x, dx[-1] + half_x, dy[0] - half_y, dy[-1] + half_y),
    )  # fmt: skip
    if residual:
        for sign, marker in ((1, "+"), (-1, "_")):
            rows, columns = np.nonzero(np.nan_to_num(sign * values) > NOTABLE)
            ax.plot(dx[columns], dy[rows], marker, color=PAPER, ms=5, mew=1.3, ls="none")
    if ticks:
        _ticks(ax.xaxis, dx)
        _ticks(ax.yaxis, dy)
    else:
        ax.set_xticks([])
        ax.set_yticks([])
    ax.spines[["right", "top"]].set_visible(True)
    return image


def _draw_cut(ax: Axes, dataset: Dataset, item: Maps) -> Axes:
    """Draw measured and modelled correlation along dy at dx = 0."""
    dy = np.asarray(dataset["dy"].values, dtype=np.float64) * 100
    middle = item.measured.shape[1] // 2
    unit = _MICRO if item.is_slope else 1.0
    ax.axhline(0, color=MUTED, lw=0.8)
    ax.plot(dy, item.model[:, middle] * unit, color=BLUE, lw=1.6, label="model")
    error = np.nan_to_num(item.error[:, middle]) * unit
    ax.errorbar(dy, item.measured[:, middle] * unit, yerr=error, fmt="o", color=RED, mfc=PAPER, ms=4.2, lw=1.2,
                label="measured")  # fmt: skip
    _ticks(ax.xaxis, dy)
    ax.tick_params(labelsize=11)
    return ax


def _range(items: list[Maps], unit: float) -> tuple[float, float]:
    # A batch without a model (or without finite values) still has a measured scale.
    stack = np.concatenate([np.ravel(values) for item in items for values in (item.measured, item.model)]) * unit
    finite = stack[np.isfinite(stack)]
    low, high = float(finite.min()), float(finite.max())
    return min(low, 0.0), high if high > min(low, 0.0) else min(low, 0.0) + 1.0


#: Width and usual height of the figure of the correlation maps, inches.
CORRELATION_SIZE = (10.0, 6.9)
_CUT = 1.25


def compose_correlations(figure: Figure, dataset: Dataset, batch: int) -> None:
    """Lay out measured, modelled and residual maps and their cut, one column per kind, on common scales.

    The height of the figure follows from the number of kinds: with fewer of them the maps are larger.
    """
    from matplotlib.colors import Normalize

    items = maps(dataset, batch)
    if not items:
        note(figure.add_axes((0.1, 0.1, 0.8, 0.8)), "no correlation maps")
        return
    groups = [group for group in ([i for i in items if i.is_slope], [i for i in items if not i.is_slope]) if group]
    width, left, gap, bar = CORRELATION_SIZE[0], 0.86, 0.12, 0.85
    cell = min(1.9, (width - left - bar * len(groups) - gap * (len(items) - len(groups))) / len(items))
    rows = {"cut": 0.55, "residual": 0.55 + _CUT + 0.92}
    rows["model"] = rows["residual"] + cell + 0.36
    rows["measured"] = rows["model"] + cell + 0.14
    height = rows["measured"] + cell + 0.52
    figure.set_size_inches(width, height)
    worst = max((float(np.nanmax(np.abs(i.residual))) for i in items if np.isfinite(i.residual).any()), default=NOTABLE)
    spread = float(np.clip(np.ceil(worst), NOTABLE, 6.0))
    sigma = Normalize(-spread, spread)
    lags = {name: np.asarray(dataset[name].values, dtype=np.float64) * 100 for name in ("dx", "dy")}

    def axes(x: float, y: float, w: float, h: float) -> Axes:
        return figure.add_axes((x / width, y / height, w / width, h / height))

    def scale(image: AxesImage, x: float, low: float, high: float, label: str, extend: str = "neither") -> None:
        drawn = figure.colorbar(image, cax=axes(x, low, 0.13, high - low), extend=extend)
        drawn.outline.set_linewidth(0.6)
        drawn.ax.yaxis.set_major_formatter(_plain)
        drawn.ax.tick_params(labelsize=11)
        drawn.ax.set_title(label, fontsize=11, loc="left", pad=7)

    for name, y in rows.items():
        text, size = ("at dx = 0", _CUT) if name == "cut" else (name, cell)
        figure.text(
            0.012, (y + size / 2) / height, text, rotation=90, va="center", ha="center", weight="bold", fontsize=13
        )
    x = left
    for group in groups:
        unit, words = (_MICRO, "µrad²") if group[0].is_slope else (1.0, "index")
        low, high = _range(group, unit)
        norm = Normalize(low, high)
        for item in group:
            edge = x == left
            for name in ("measured", "model", "residual"):
                ax = axes(x, rows[name], cell, cell)
                residual = name == "residual"
                values = item.residual if residual else getattr(item, name) * unit
                image = _draw_map(ax, dataset, values, norm=sigma if residual else norm, residual=residual,
                                             ticks=False)  # fmt: skip
                if name == "measured":
                    ax.set_title(KIND_TITLES[item.kind], fontsize=12, loc="center")
                if residual:
                    _ticks(ax.xaxis, lags["dx"])
                    ax.set_xlabel("dx (cm)", labelpad=1)
                    if np.isfinite(item.rms):
                        ax.set_title(f"rms {number(item.rms, 3)}", fontsize=12, loc="center", pad=4)
                if edge:
                    _ticks(ax.yaxis, lags["dy"])
                    ax.set_ylabel("dy (cm)", labelpad=0)
                if item is group[-1] and name == "measured":
                    scale(image, x + cell + 0.1, rows["model"], rows["measured"] + cell, words)
                if item is group[-1] and residual:
                    extend = "both" if worst > spread else "neither"
                    scale(image, x + cell + 0.1, rows[name], rows[name] + cell, "errors", extend)
            cut = _draw_cut(axes(x, rows["cut"], cell, _CUT), dataset, item)
            cut.set_xlabel("dy (cm)", labelpad=1)
            cut.set_ylim(low - 0.06 * (high - low), high + 0.08 * (high - low))
            cut.yaxis.set_major_formatter(_plain)
            if item is not group[0]:
                cut.set_yticks([])
            elif edge:
                cut.set_ylabel(words, labelpad=2)
                cut.legend(loc="lower left", bbox_to_anchor=(-0.12, 0.97), ncol=2, fontsize=11, borderpad=0.2)
            x += cell + gap
        x += bar - gap


def describe_correlations(dataset: Dataset, batch: int) -> str:
    """Say how well the model follows the measured maps of a batch."""
    items = maps(dataset, batch)
    if not items:
        return "This batch has no correlation maps."
    parts = []
    for item in items:
        unit, word = (_MICRO, " µrad²") if item.is_slope else (1.0, "")
        peak = number(float(np.nanmax(item.measured)) * unit, 3)
        title = KIND_TITLES[item.kind].replace("\n", ", ")
        parts.append(f"{title}: up to {peak}{word}, residual rms {number(item.rms, 3)} errors")
    missing = len(MAP_KINDS) - len(items)
    alone = " There are no maps between sources: one source was observed." if missing and not any(
        "cross" in item.kind for item in items
    ) else ""  # fmt: skip
    return "; ".join(parts) + "." + alone


def draw_criterion(ax: Axes, dataset: Dataset, batch: int = 0, *, near: float | None = None) -> Axes:
    """Draw the criterion of a batch against log10(mu) with the chosen value marked.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    dataset : Dataset
        A product.
    batch : int
        Number of the batch in the product.
    near : float, optional
        Show only this many decades of mu on either side of the chosen value, as excess over the minimum.

    Returns
    -------
    Axes
        `ax`.
    """
    grid = of_batch(dataset, "log_mu_grid", batch)
    curve = of_batch(dataset, "criterion", batch)
    chosen = log_mu(scalar(dataset, "mu", batch))
    ax.set_xlabel(r"$\log_{10}\,\mu$   ($\mu$ in m$^{4/3}$)")
    if grid is None or curve is None or not np.isfinite(curve).any():
        return note(ax, "no criterion: μ was given")
    finite = np.isfinite(curve)
    grid, curve = grid[finite], curve[finite]
    lowest = curve.min()
    # GCV is positive and only its shape counts; others, as a logarithm of evidence, count by differences.
    ratio = lowest > 0
    name = str(dataset.attrs.get("selector", ""))
    name = name.upper() if name in ("gcv", "upre") else "criterion"
    if near is not None and np.isfinite(chosen):
        keep = np.abs(grid - chosen) <= near + 1e-9
        grid, curve = grid[keep], curve[keep]
        curve = 100 * (curve / lowest - 1) if ratio else curve - lowest
        ax.set_ylabel("above the minimum (%)" if ratio else "above the minimum")
    else:
        curve = curve / lowest if ratio else curve - lowest
        ax.set_ylabel(f"{name} / its minimum" if ratio else f"{name} − its minimum")
    if not grid.size:
        return note(ax, "μ is outside the curve")
    ax.plot(grid, curve, "-", color=BLUE, marker=".", ms=6)
    if np.isfinite(chosen):
        ax.axvline(chosen, color=RED, lw=1.6, ls=(0, (5, 3)))
        ax.plot([chosen], [np.interp(chosen, grid, curve)], "D", color=RED, mfc=PAPER, ms=8, mew=1.8)
        if near is None:
            right = chosen > (grid[0] + grid[-1]) / 2
            ax.annotate(
                f"chosen: {number(chosen, 4)}", (chosen, 0.93), xycoords=("data", "axes fraction"), color=RED,
                xytext=(-8 if right else 8, 0), textcoords="offset points", ha="right" if right else "left",
            )  # fmt: skip
    ax.yaxis.set_major_formatter(_plain)
    ax.grid(axis="y")
    return ax


def compose_criterion(figure: Figure, dataset: Dataset, batch: int) -> None:
    """Lay out the criterion as a whole and near the chosen value."""
    draw_criterion(figure.add_axes((0.09, 0.19, 0.52, 0.77)), dataset, batch)
    draw_criterion(figure.add_axes((0.72, 0.19, 0.265, 0.77)), dataset, batch, near=1.5)


def describe_criterion(dataset: Dataset, batch: int) -> str:
    """Say which mu was chosen and how sharp the criterion is there."""
    grid = of_batch(dataset, "log_mu_grid", batch)
    curve = of_batch(dataset, "criterion", batch)
    chosen = log_mu(scalar(dataset, "mu", batch))
    if grid is None or curve is None or not np.isfinite(curve).any():
        return f"There is no criterion curve; log₁₀ μ is {number(chosen, 4)}."
    least = float(grid[np.nanargmin(curve)])
    return (
        f"Criterion for log₁₀ μ from {number(float(grid[0]), 4)} to {number(float(grid[-1]), 4)}. "
        f"Its minimum on the grid is at {number(least, 4)}; the chosen value is {number(chosen, 4)}."
    )


def draw_averaging_kernels(ax: Axes, dataset: Dataset, batch: int = 0) -> Axes:
    """Draw the averaging kernels of a batch as a matrix: a row per retrieved slice, a column per true slice."""
    kernel = of_batch(dataset, "averaging_kernel", batch)
    if kernel is None or not np.isfinite(kernel).any():
        return note(ax, "no averaging kernels")
    from .reading import borders

    rows = edges(dataset)
    columns = rows if kernel.shape[0] == kernel.shape[1] else borders(np.asarray(dataset["z_true"].values, float))
    limit = float(np.nanmax(np.abs(kernel))) or 1.0
    if all(np.allclose(np.diff(border), border[1] - border[0]) for border in (rows, columns)):
        image = ax.imshow(np.ma.masked_invalid(kernel), origin="lower", interpolation="none", aspect="auto",
                          cmap=DIVERGING, vmin=-limit, vmax=limit,
                          extent=(columns[0], columns[-1], rows[0], rows[-1]))  # fmt: skip
    else:
        image = ax.pcolormesh(columns, rows, np.ma.masked_invalid(kernel), cmap=DIVERGING, vmin=-limit, vmax=limit,
                              rasterized=True)  # type: ignore[assignment] # fmt: skip
    ends = [max(rows[0], columns[0]), min(rows[-1], columns[-1])]
    ax.plot(ends, ends, color=INK, lw=1, ls=":")
    ax.set_xlabel("true distance z (m)")
    ax.set_ylabel("retrieved distance z (m)")
    scale = ax.figure.colorbar(image, ax=ax, fraction=0.05, pad=0.03)
    scale.outline.set_linewidth(0.6)
    scale.ax.set_title("response", fontsize=12, loc="left", pad=8)
    scale.ax.yaxis.set_major_formatter(_plain)
    return ax


def draw_kernel_sums(ax: Axes, dataset: Dataset, batch: int = 0) -> Axes:
    """Draw diagonal and sum of each averaging kernel against the distance of its slice."""
    kernel = of_batch(dataset, "averaging_kernel", batch)
    if kernel is None or not np.isfinite(kernel).any():
        return note(ax, "")
    border = edges(dataset)
    centre = (border[1:] + border[:-1]) / 2
    ax.axvline(1, color=MUTED, lw=1)
    ax.axvline(0, color=MUTED, lw=1)
    ax.plot(kernel.sum(axis=1), centre, "o-", color=BLUE, label="sum")
    if kernel.shape[0] == kernel.shape[1]:
        ax.plot(np.diag(kernel), centre, "s--", color=RED, mfc=PAPER, label="own slice")
    ax.set_ylim(border[0], border[-1])
    ax.xaxis.set_major_formatter(_plain)
    ax.set_xlabel("response")
    ax.legend(loc="lower left", bbox_to_anchor=(-0.04, 1.0), ncol=2, columnspacing=1.0, handletextpad=0.4)
    return ax


def compose_kernels(figure: Figure, dataset: Dataset, batch: int) -> None:
    """Lay out the averaging kernels and their sums."""
    draw_averaging_kernels(figure.add_axes((0.105, 0.13, 0.575, 0.78)), dataset, batch)
    sums = draw_kernel_sums(figure.add_axes((0.76, 0.13, 0.215, 0.78)), dataset, batch)
    sums.set_yticklabels([])


def _places(border: Floats, chosen: NDArray[np.bool_]) -> str:
    """Slices in words, neighbours as one stretch."""
    turns = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]])))
    pairs = zip(turns[::2], turns[1::2], strict=True)
    return ", ".join(f"{number(border[first], 4)} to {number(border[last], 4)} m" for first, last in pairs)


def describe_kernels(dataset: Dataset, batch: int) -> str:
    """Say how many slices the data determine."""
    kernel = of_batch(dataset, "averaging_kernel", batch)
    if kernel is None or not np.isfinite(kernel).any():
        return "This batch has no averaging kernels."
    freedom = scalar(dataset, "degrees_of_freedom", batch)
    text = f"{number(freedom, 3)} degrees of freedom for {kernel.shape[0]} slices. " if np.isfinite(freedom) else ""
    border = edges(dataset)
    if kernel.shape[0] == kernel.shape[1]:
        weak = np.diag(kernel) < 0.5
        text += (
            f"Slices that answer by less than half to their own turbulence: {_places(border, weak)}. "
            if weak.any()
            else "Every slice answers by more than half to its own turbulence. "
        )
    length = of_batch(dataset, "resolution_length", batch)
    if length is not None and np.isfinite(length).any() and (lost := np.isnan(length)).any():
        text += f"Not resolved, more the prior's than the data's: {_places(border, lost)}."
    return text.strip()


def profile_rows(dataset: Dataset, batch: int) -> list[list[str]]:
    """The profile of a batch as text: from, to, Cn2, MAP bar, ML bar, remark."""
    cn2 = of_batch(dataset, "cn2", batch)
    if cn2 is None:
        return []
    border = aligned(edges(dataset))
    error, error_ml, active, limit = _limits(dataset, batch, cn2.shape)
    return [
        [
            border[i],
            border[i + 1],
            scientific(cn2[i]),
            scientific(error[i]),
            scientific(error_ml[i]),
            f"at the bound, below {scientific(limit[i])}" if active[i] else "",
        ]
        for i in range(cn2.size)
    ]
