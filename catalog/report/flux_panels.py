"""Figures of what a profile says with its surroundings: scintillometers, heat fluxes, height above ground."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...pipeline.beam_heights import mean_separation
from ...pipeline.comparison import Pair, Separation
from .batch_panels import note
from .reading import DAY, Floats, bounds, edges, listed, values
from .style import BLUE, DIVERGING, GREEN, INK, MUTED, PAPER, PURPLE, RED, figure_style
from .time_panels import _frame, _join, _visible, time_axis
from .words import clean, number, scientific

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

_COLOURS = ((PURPLE, "o"), (GREEN, "s"), (BLUE, "D"), (RED, "^"))


def pairs_in(datasets: Sequence[Dataset]) -> list[Pair]:
    """Emulated and measured path averages of each scintillometer that the products name."""
    found: dict[str, list[tuple[Any, ...]]] = {}
    apart: dict[str, Separation] = {}
    for dataset in datasets:
        if "cn2_path_average" not in dataset or "scintillometer" not in dataset.coords:
            continue
        columns = [
            values(dataset, name)
            for name in (
                "cn2_path_average",
                "cn2_path_average_standard_error",
                "cn2_scintillometer",
                "cn2_scintillometer_standard_error",
            )
        ]
        blank = np.full(dataset["cn2_path_average"].shape, np.nan)
        for index, name in enumerate(dataset["scintillometer"].values):
            shown = clean(name)[:24].replace("$", r"\$")
            apart.setdefault(shown, _separation(dataset, index))
            found.setdefault(shown, []).append(
                (bounds(dataset), *((blank if column is None else column)[:, index] for column in columns))
            )
    pairs = []
    for name, parts in found.items():
        whole = [np.concatenate(column) for column in zip(*parts, strict=True)]
        order = np.argsort(whole[0][:, 0], kind="stable")
        when, ours, ours_error, theirs, theirs_error = (column[order] for column in whole)
        pairs.append(Pair(name, when, ours, ours_error, theirs, theirs_error, apart[name]))
    return pairs


def _separation(dataset: Dataset, index: int) -> Separation:
    """How far a scintillometer of a product is from the line of sight; products of older versions do not say."""
    names = (
        "scintillometer_offset", "scintillometer_height", "scintillometer_weight", "scintillometer_height_factor",
    )  # fmt: skip
    if not all(name in dataset for name in names):
        return Separation()
    offset, height, weight, factor = (np.asarray(dataset[name].values[index], np.float64) for name in names)
    sight = values(dataset, "flux_height")
    vertical = float("nan") if sight is None else mean_separation(height, sight.ravel(), weight)
    return Separation(float(offset), vertical, bool((factor != 1).any()))


def draw_agreement(ax: Axes, pairs: Sequence[Pair]) -> Axes:
    """Draw emulated (solid) and measured (dotted) Cn2 over time, as Sauvage et al. 2021, Fig. 12."""
    for index, pair in enumerate(pairs):
        colour, marker = _COLOURS[index % len(_COLOURS)]
        days = pair.bounds.mean(axis=1) / DAY
        few = np.isfinite(pair.ours).sum() <= 120
        good = np.isfinite(pair.ours)
        ax.errorbar(days[good], pair.ours[good], np.nan_to_num(pair.ours_error[good]), color=colour, lw=1.6,
                    elinewidth=1, marker=marker if few else "", ms=5, label=f"{pair.name}, emulated",
                    rasterized=not few)  # fmt: skip
        good = np.isfinite(pair.theirs)
        if good.any():
            few = good.sum() <= 120
            ax.plot(days[good], pair.theirs[good], color=colour, ls=(0, (1, 1.2)), lw=1.8, marker=marker if few else "",
                    mfc=PAPER, ms=5, label=f"{pair.name}, measured")  # fmt: skip
    ax.set_yscale("log")
    ax.set_ylabel(r"$\overline{C_n^2}$ (m$^{-2/3}$)")
    ax.grid(axis="y")
    return ax


def draw_scatter(ax: Axes, pairs: Sequence[Pair]) -> Axes:
    """Draw emulated against measured Cn2 with both errors, and the line of equality."""
    from matplotlib.ticker import NullFormatter

    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_autoscale_on(False)  # the limits below hold for both axes, also of a single point
    low, high = np.inf, 0.0
    for index, pair in enumerate(pairs):
        with np.errstate(invalid="ignore"):
            both = (pair.ours > 0) & (pair.theirs > 0)
        if not both.any():
            continue
        colour, marker = _COLOURS[index % len(_COLOURS)]
        x, y = pair.theirs[both], pair.ours[both]
        ax.errorbar(x, y, np.nan_to_num(pair.ours_error[both]), np.nan_to_num(pair.theirs_error[both]), color=colour,
                    ls="", marker=marker, ms=5, elinewidth=0.8, label=pair.name,
                    rasterized=both.sum() > 120)  # fmt: skip
        low, high = min(low, x.min(), y.min()), max(high, x.max(), y.max())
    if high > 0:
        ends = np.array([low / 1.4, high * 1.4])
        ax.plot(ends, ends, color=MUTED, lw=1, zorder=0)
        ax.set_xlim(*ends)
        ax.set_ylim(*ends)
        ax.set_aspect("equal")
        ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel(r"measured (m$^{-2/3}$)")
    ax.set_ylabel(r"emulated (m$^{-2/3}$)")
    return ax


def _lower(ax: Axes) -> None:
    """Leave room above for the labels of a time axis that is not shared."""
    box = ax.get_position()
    room = 0.7 / ax.figure.get_size_inches()[1]  # type: ignore[union-attr]
    ax.set_position((box.x0, box.y0, box.width, box.height - room))


def compose_agreement(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out time series above and scatter below."""
    pairs = pairs_in(datasets)
    above, below = _frame(figure, datasets, [2.8, 4.0], left=1.35, head=0.6)
    draw_agreement(above, pairs)
    time_axis(above, datasets)
    figure.legend(*above.get_legend_handles_labels(), loc="upper left", ncol=3, fontsize=10, borderaxespad=0.1)
    draw_scatter(below, pairs)
    _lower(below)


def agreement_figure(pairs: Sequence[Pair], attributes: Mapping[str, Any]) -> Figure:
    """A figure of series and scatter for pairs that no product holds.

    Parameters
    ----------
    pairs : sequence of Pair
        Series on one time base.
    attributes : mapping
        Attributes of a product, for the time zone of the site.

    Returns
    -------
    Figure
    """
    import xarray as xr
    from matplotlib.figure import Figure

    limits = np.concatenate([pair.bounds[np.isfinite(pair.ours) | np.isfinite(pair.theirs)] for pair in pairs])
    if not len(limits):
        limits = pairs[0].bounds
    ends = np.array([[limits[:, 0].min(), limits[:, 1].max()]]).astype("datetime64[ns]")
    frame = xr.Dataset({"time_bounds": (("time", "bound"), ends)}, {"time": ends[:, 0]}, dict(attributes))
    with figure_style():
        figure = Figure(figsize=(10.0, 8.2), layout="constrained")
        above, below = figure.subplots(2, 1, height_ratios=(1, 1.3))
        draw_agreement(above, pairs)
        time_axis(above, [frame])
        handles, labels = above.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncol=3, fontsize=10)
        draw_scatter(below, pairs)
    return figure


def describe_agreement(datasets: Sequence[Dataset]) -> str:
    """Say ratio, scatter and expected scatter for each scintillometer."""
    parts = []
    for pair in pairs_in(datasets):
        found = pair.comparison()
        where = pair.separation.text()
        where = "" if where == "-" else f" (from the line of sight: {where})"
        if not found.count:
            parts.append(f"{pair.name}{where}: emulated only.")
            continue
        spread = (
            f", scatter {number(100 * found.scatter, 2)} % where the errors of both explain "
            f"{number(100 * found.expected_scatter, 2)} %"
            if found.count > 1
            else ""
        )
        error = f" ± {number(found.ratio_error, 2)}" if np.isfinite(found.ratio_error) else ""
        several = "batch" if found.count == 1 else "batches"
        parts.append(
            f"{pair.name}{where}: emulated over measured {number(found.ratio, 3)}{error} in {found.count} "
            f"{several}{spread}."
        )
    return " ".join(parts) or "No product names a scintillometer."


def _median(found: Floats) -> Floats:
    """Median over the first axis of what is finite."""
    with np.errstate(invalid="ignore"):
        middle = np.ma.median(np.ma.masked_invalid(found), axis=0)  # type: ignore[no-untyped-call]
    return np.asarray(np.ma.filled(middle.astype(float), np.nan))


def draw_heat_flux(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw the sensible heat flux over time and distance; blank where there is none."""
    products = listed(datasets)
    found = [values(dataset, "sensible_heat_flux") for dataset in products]
    finite = np.concatenate([flux[np.isfinite(flux)] for flux in found if flux is not None] or [np.empty(0)])
    top = float(np.percentile(np.abs(finite), 98)) if finite.size else 1.0
    image = None
    columns = _visible([bounds(dataset) / DAY for dataset in products])
    for dataset, flux, limit in zip(products, found, columns, strict=True):
        if flux is not None:
            for row in range(len(flux)):
                shown = np.ma.masked_invalid(flux[row])[:, None]
                image = ax.pcolormesh(limit[row], edges(dataset), shown, cmap=DIVERGING, vmin=-top, vmax=top,
                                      rasterized=True, shading="flat")  # fmt: skip
    ax.set_ylabel("distance from the pupil z (m)")
    time_axis(ax, products)
    if image is not None:
        bar = ax.figure.colorbar(image, ax=ax, fraction=0.04, pad=0.015, extend="both")
        bar.set_label(r"$H$ (W m$^{-2}$), upward")
        bar.outline.set_linewidth(0.6)
    return ax


def draw_slice_flux(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw the median heat flux of each slice over the batches, its median interval, and that of free convection."""
    products = listed(datasets)
    dataset = products[0]
    border = edges(dataset)
    centre = (border[1:] + border[:-1]) / 2

    def median(name: str) -> Floats:
        found = [values(one, name) for one in products]
        return _median(np.concatenate([part for part in found if part is not None and part.shape[1] == centre.size]))

    if not any("sensible_heat_flux" in one for one in products):
        return note(ax, "no heat flux")
    flux, interval = median("sensible_heat_flux"), median("sensible_heat_flux_interval_68")
    ax.stairs(flux, border, color=RED, lw=1.8, label="similarity, with 68 % interval", baseline=None)
    ax.vlines(centre, interval[:, 0], interval[:, 1], color=RED, lw=1.2)
    free = median("sensible_heat_flux_free_convection")
    if np.isfinite(free).any():
        ax.stairs(free, border, color=INK, lw=1.2, ls="--", label="free convection", baseline=None)
    ax.axhline(0, color=MUTED, lw=0.6, zorder=0)
    ax.set_xlim(border[0], border[-1])
    ax.set_xlabel("distance from the pupil z (m)")
    ax.set_ylabel(r"median $H$ (W m$^{-2}$)")
    ax.legend(loc="best", fontsize=10)
    return ax


def compose_heat_flux(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out the heat flux over time and distance, and by slice."""
    above, below = _frame(figure, datasets, [2.9, 3.0], right=1.0)
    draw_heat_flux(above, datasets)
    draw_slice_flux(below, datasets)
    _lower(below)


def describe_heat_flux(datasets: Sequence[Dataset]) -> str:
    """Say the range of the heat flux and how it came about."""
    from ...pipeline.surroundings import FLUX_STATES

    products = [dataset for dataset in datasets if "sensible_heat_flux" in dataset]
    if not products:
        return "No product holds a heat flux."
    flux = np.concatenate([dataset["sensible_heat_flux"].values.ravel() for dataset in products])
    state = np.concatenate([dataset["flux_state"].values.ravel() for dataset in products])
    finite = flux[np.isfinite(flux)]
    counts = [
        f"{name.replace('_', ' ')} {int((state == code).sum())}"
        for code, name in enumerate(FLUX_STATES)
        if (state == code).any()
    ]
    middle = f"Median {number(float(np.median(finite)), 3)} W/m²; " if finite.size else ""
    return f"{middle}{finite.size} of {flux.size} values; how they came about: {', '.join(counts)}."


def draw_height_model(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw the median profile beside Cn2 that goes as (height above ground)^(-4/3) (Sauvage et al. 2021, Fig. 14)."""
    dataset = listed(datasets)[0]
    border = edges(dataset)
    for name, colour, dashes, label in (
        ("cn2", RED, "-", "profiles, median"),
        ("cn2_height_model", INK, "--", r"$h^{-4/3}$, same $r_0$"),
    ):
        found = values(dataset, name)
        if found is not None and np.isfinite(found).any():
            ax.stairs(_median(found), border, baseline=None, color=colour, ls=dashes, lw=1.8, label=label)
    ax.set_yscale("log")
    ax.set_ylabel(r"$C_n^2$ (m$^{-2/3}$)")
    ax.legend(loc="best", fontsize=10)
    return ax


def compose_height_model(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out profile and model above the height of the line of sight."""
    above, below = _frame(figure, datasets, [2.6, 1.4], left=1.35)
    draw_height_model(above, datasets)
    dataset = listed(datasets)[0]
    border = edges(dataset)
    height = values(dataset, "height_above_ground")
    if height is not None:
        below.stairs(height.reshape(-1, border.size - 1)[0], border, color=GREEN, fill=True, alpha=0.5)
    below.set_ylim(bottom=0)
    below.set_ylabel("height (m)")
    below.set_xlabel("distance from the pupil z (m)")
    for ax in (above, below):
        ax.set_xlim(border[0], border[-1])
    _join((above, below))


def describe_height_model(datasets: Sequence[Dataset]) -> str:
    """Say how the median profile follows the height."""
    dataset = listed(datasets)[0]
    cn2, model = values(dataset, "cn2"), values(dataset, "cn2_height_model")
    if cn2 is None or model is None:
        return "The height above ground is not known."
    with np.errstate(invalid="ignore"):
        both = (cn2 > 0) & (model > 0)
    if both.sum() < 3:
        return "There are too few values."
    a, b = np.log10(cn2[both]), np.log10(model[both])
    strength = scientific(float(np.nanmedian(model)))
    correlation = float(np.corrcoef(a, b)[0, 1]) if b.std() > 0 and a.std() > 0 else float("nan")
    return f"Model: median {strength} m^(-2/3); correlation of the logarithms {number(correlation, 2)}."
