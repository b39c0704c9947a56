"""Figures over time: time-distance map, direct against retrieved numbers, fit, quality.

Each `draw_…` function draws into axes that the caller made and returns them, each `compose_…` lays out a whole figure
of the report, and each `describe_…` says in words what the figure shows.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...pipeline.products import QUALITY_FLAGS
from .reading import (
    DAY,
    LEVELS,
    Floats,
    Series,
    borders,
    bounds,
    edges,
    flag_names,
    flags,
    levels,
    listed,
    series,
    source_names,
    span,
    values,
)
from .style import BLUE, GREEN, INK, MUTED, PAPER, PURPLE, RED, SEQUENTIAL
from .words import clean, clock, days, month, number, offset, scientific, site_zone

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from xarray import Dataset

#: More points than this are drawn as a line without a marker each.
MARKED = 120
#: Up to this many points a thin line shows the length of each batch.
SPANNED = 24


def _tick(value: float, zone: datetime.tzinfo, width: float) -> str:
    when = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC) + datetime.timedelta(days=float(value))
    when = (when + datetime.timedelta(microseconds=500)).astimezone(zone)
    if width > 7:
        return f"{when.day} {month(when.month)}"
    if width > 1.05:
        return f"{when:%H:%M}\n{when.day} {month(when.month)}"
    if width > 4 / 1440:
        return f"{when:%H:%M}"
    return f"{when:%H:%M:%S}"


def time_axis(ax: Axes, datasets: Sequence[Dataset]) -> Axes:
    """Set up the time axis: UTC below and, where the site's time zone is known, local time above.

    Parameters
    ----------
    ax : Axes
        Axes whose x are days since 1970 UTC.
    datasets : sequence of Dataset
        Products, for the limits and the time zone.
    """
    from matplotlib.dates import AutoDateLocator

    start, stop = span(datasets)
    pad = 0.01 * max(stop - start, 1_000_000_000)
    low, high = (start - pad) / DAY, (stop + pad) / DAY
    ax.set_xlim(low, high)
    width = high - low

    def ticks(axis: Axis, zone: datetime.tzinfo) -> None:
        axis.set_major_locator(AutoDateLocator(tz=zone, minticks=3, maxticks=8))  # type: ignore[no-untyped-call]
        axis.set_major_formatter(lambda value, _: _tick(value, zone, width))

    ticks(ax.xaxis, datetime.UTC)
    ax.set_xlabel(f"UTC, {days(start, stop)}")
    zone = site_zone(datasets[0].attrs)
    if zone is not None:
        above = ax.secondary_xaxis("top")
        ticks(above.xaxis, zone)
        shifts = dict.fromkeys([offset(start, zone), offset(stop, zone)])
        above.set_xlabel(f"local time, {zone.key} ({', then '.join(shifts)})", labelpad=7)
        above.tick_params(colors=INK)
    return ax


#: Columns of the time-distance map that would fill its width, if they were as narrow as one may get.
NARROWEST = 40
#: Inches kept free at the left, at the right, and around the time axes.
_LEFT, _RIGHT, _LINE = 1.0, 0.45, 0.2


def _frame(
    figure: Figure,
    datasets: Sequence[Dataset],
    heights: Sequence[float],
    *,
    left: float = _LEFT,
    right: float = _RIGHT,
    head: float = 0.0,
) -> list[Axes]:
    """Stack axes over a common time axis, from above, with room for the labels that this period needs."""
    start, stop = span(datasets)
    # Ticks of more than a day and less than a week carry the date in a second line.
    lines = 2 if 1.05 < 1.02 * (stop - start) / DAY <= 7 else 1
    below = 0.42 + _LINE * lines
    above = head + (0.42 + _LINE * lines if site_zone(datasets[0].attrs) is not None else 0.15)
    width, gap = figure.get_figwidth(), 0.42
    height = below + sum(heights) + gap * (len(heights) - 1) + above
    figure.set_size_inches(width, height)
    found, y = [], height - above
    for size in heights:
        found.append(
            figure.add_axes((left / width, (y - size) / height, (width - left - right) / width, size / height))
        )
        y -= size + gap
    return found


def _join(axes: Sequence[Axes]) -> None:
    """Leave local time to the uppermost and UTC to the lowest of stacked axes."""
    for ax in axes[:-1]:
        ax.tick_params(axis="x", labelbottom=False)
        ax.set_xlabel("")
    for ax in axes[1:]:
        for child in ax.child_axes:
            child.set_visible(False)


def draw_time_distance(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw the time-distance map of Cn2: logarithmic scale from the data, gaps blank, bounded values hatched.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    datasets : Dataset or sequence of Dataset
        Products; their slices may differ.

    Returns
    -------
    Axes
        `ax`.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    products = listed(datasets)
    scale = cn2_scale(products)
    image, corners = None, []
    columns = _visible([bounds(dataset) / DAY for dataset in products])
    for dataset, limit in zip(products, columns, strict=True):
        cn2, border = values(dataset, "cn2"), edges(dataset)
        if cn2 is None:
            continue
        active = _active(dataset, cn2)
        shown = np.ma.masked_where(~np.isfinite(cn2) | active, cn2)
        if scale is not None:
            for first, last in _uninterrupted(limit):
                image = ax.pcolormesh(
                    np.append(limit[first:last, 0], limit[last - 1, 1]), border, shown[first:last].T,
                    norm=LogNorm(*scale), cmap=SEQUENTIAL, rasterized=True, shading="flat",
                )  # fmt: skip
        for first, last in _uninterrupted(limit):
            for j in range(active.shape[1]):
                for start, stop in _runs(active[first:last, j]):
                    corners.append((limit[first + start, 0], limit[first + stop - 1, 1], border[j], border[j + 1]))
    if corners:
        boxes = [Path([(a, c), (b, c), (b, d), (a, d), (a, c)], closed=True) for a, b, c, d in corners]
        # Outlines help where there is room for them, and would fill narrow columns.
        outline = 0.6 if len(boxes) < 150 else 0.0
        ax.add_patch(PathPatch(Path.make_compound_path(*boxes), fc="none", ec=MUTED, hatch="///", lw=outline))
    ax.set_ylim(min(edges(d)[0] for d in products), max(edges(d)[-1] for d in products))
    ax.set_ylabel("distance from the pupil z (m)")
    time_axis(ax, products)
    _show_columns(ax, columns)
    if image is not None:
        bar = ax.figure.colorbar(image, ax=ax, fraction=0.04, pad=0.015, extend="both")
        bar.set_label(r"$C_n^2$ (m$^{-2/3}$)")
        bar.outline.set_linewidth(0.6)
    return ax


def _visible(limits: Sequence[Floats]) -> list[Floats]:
    """Bounds of the columns: those of the batches, widened to the right where a column would be too narrow to see.

    A minute every quarter of an hour would be slivers; no column reaches into the next one.
    """
    starts = np.sort(np.concatenate([limit[:, 0] for limit in limits]))
    wanted = (max(limit[:, 1].max() for limit in limits) - starts[0]) / NARROWEST
    widened = []
    for limit in limits:
        following = np.append(starts, np.inf)[np.searchsorted(starts, limit[:, 0], side="right")]
        room = limit[:, 0] + np.minimum(wanted, 0.9 * (following - limit[:, 0]))
        widened.append(np.stack([limit[:, 0], np.maximum(limit[:, 1], room)], axis=1))
    return widened


def _show_columns(ax: Axes, columns: Sequence[Floats]) -> None:
    """Make room for the last column, which may have been widened beyond the last batch."""
    low, high = ax.get_xlim()
    ax.set_xlim(low, max(high, max(limit[-1, 1] for limit in columns) + 0.005 * (high - low)))


def _in_columns(line: Series, columns: Sequence[Floats]) -> Series:
    """The same numbers in the middle of the columns that stand for their batches."""
    drawn = np.concatenate(columns)
    drawn = drawn[np.argsort(drawn[:, 0])]
    own = np.searchsorted(drawn[:, 0], line.days, side="right") - 1
    return Series(drawn[own].mean(axis=1), line.values, line.half)


def _active(dataset: Dataset, cn2: Floats) -> NDArray[np.bool_]:
    bound = values(dataset, "cn2_at_bound")
    return np.asarray((np.nan_to_num(bound) > 0 if bound is not None else cn2 <= 0) & np.isfinite(cn2))


def _runs(flag: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """[start, stop) of each run of true values."""
    turns = np.flatnonzero(np.diff(np.concatenate([[0], flag.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in turns.reshape(-1, 2)]


def _uninterrupted(limit: Floats) -> list[tuple[int, int]]:
    """[first, last) of each stretch of batches that follow each other within a tenth of a batch."""
    gap = limit[1:, 0] - limit[:-1, 1]
    cuts = np.flatnonzero(np.abs(gap) > 0.1 * np.median(limit[:, 1] - limit[:, 0])) + 1
    return [(int(a), int(b)) for a, b in zip(np.append(0, cuts), np.append(cuts, len(limit)), strict=True)]


def cn2_scale(datasets: Sequence[Dataset]) -> tuple[float, float] | None:
    """Limits of the logarithmic Cn2 scale: the middle 98 % of the positive values; None without any."""
    found = []
    for dataset in datasets:
        cn2 = values(dataset, "cn2")
        if cn2 is not None:
            found.append(cn2[np.isfinite(cn2) & (cn2 > 0) & ~_active(dataset, cn2)])
    positive = np.concatenate(found) if found else np.empty(0)
    if not positive.size:
        return None
    low, high = np.percentile(positive, [1, 99])
    return (float(low), float(high)) if high > 1.5 * low else (float(low / 1.5), float(high * 1.5))


def compose_time_distance(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out the figure of the time-distance map."""
    draw_time_distance(_frame(figure, datasets, [3.3], right=1.15)[0], datasets)


def describe_time_distance(datasets: Sequence[Dataset]) -> str:
    """Say where and when Cn2 is largest, and how much of the map is blank or bounded."""
    best, words, total, bounded, blank = 0.0, "", 0, 0, 0
    for dataset in datasets:
        cn2 = values(dataset, "cn2")
        if cn2 is None:
            continue
        total += cn2.size
        blank += int((~np.isfinite(cn2)).sum())
        bounded += int(_active(dataset, cn2).sum())
        if np.isfinite(cn2).any() and np.nanmax(cn2) > best:
            best = float(np.nanmax(cn2))
            i, j = np.unravel_index(np.nanargmax(cn2), cn2.shape)
            border = edges(dataset)
            words = (
                f"The largest value is {scientific(best)} m^(-2/3), {number(border[j], 4)} to "
                f"{number(border[j + 1], 4)} m away at {clock(int(bounds(dataset)[i, 0]))} UTC. "
            )
    return f"{words}Of {total} values {bounded} are at the bound of zero and {blank} are missing."


def _follow(ax: Axes, line: Series | None, label: str, **style: object) -> None:
    if line is not None and np.isfinite(line.values).any():
        if line.values.size > MARKED:
            style["marker"] = ""
        elif line.values.size <= SPANNED:
            ax.hlines(line.values, line.days - line.half, line.days + line.half, color=style["color"], lw=1.2)
        ax.plot(line.days, line.values, label=label, **style)  # type: ignore[arg-type]


def _from_zero(ax: Axes, *lines: Series | None) -> None:
    top = max(
        (float(np.nanmax(line.values)) for line in lines if line is not None and np.isfinite(line.values).any()),
        default=1,
    )
    ax.set_ylim(0, 1.12 * top if top > 0 else 1)
    ax.grid(axis="y")


_SOURCES = (("o", RED, (0, (1, 1.5))), ("s", GREEN, (0, (5, 2))))


def draw_scintillation(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw the scintillation index over time, direct for each source and from the profile."""
    return _draw_pair(ax, listed(datasets), "scintillation_index", r"$\sigma_I^2$", 1.0)


def draw_fried_parameter(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw the Fried parameter over time in cm, direct for each source where it is known, and from the profile."""
    return _draw_pair(ax, listed(datasets), "r0", r"$r_0$ (cm)", 100.0)


def _draw_pair(ax: Axes, products: list[Dataset], name: str, label: str, factor: float) -> Axes:
    lines: list[Series | None] = []
    for component, source in enumerate(source_names(products)):
        marker, colour, dashes = _SOURCES[component % len(_SOURCES)]
        line = series(products, f"{name}_direct", component)
        line = None if line is None else line.mapped(lambda values: factor * values)
        lines.append(line)
        _follow(ax, line, f"direct, {source}", color=colour, marker=marker, mfc=PAPER, ls=dashes, lw=1.6)
    line = series(products, f"{name}_profile")
    line = None if line is None else line.mapped(lambda values: factor * values)
    lines.append(line)
    _follow(ax, line, "from the profile", color=BLUE, marker="D", ls="-", ms=5)
    _from_zero(ax, *lines)
    ax.set_ylabel(label)
    return time_axis(ax, products)


def draw_relative(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw by how much scintillation index and Fried parameter of the profile differ from the direct ones, in %."""
    products = listed(datasets)
    ax.axhline(0, color=MUTED, lw=1.2)
    reach = 10.0
    for name, label, colour, marker, dashes in (
        ("scintillation_index", r"$\sigma_I^2$", BLUE, "D", "-"),
        ("r0", r"$r_0$", PURPLE, "^", (0, (5, 2))),
    ):
        direct, profile = series(products, f"{name}_direct"), series(products, f"{name}_profile")
        if direct is None or profile is None or direct.values.size != profile.values.size:
            continue
        line = profile.mapped(lambda values, direct=direct: 100 * (values / direct.values - 1))  # type: ignore[misc]
        _follow(ax, line, f"{label}: profile / direct − 1", color=colour, marker=marker, ls=dashes, ms=5)
        if np.isfinite(line.values).any():
            reach = max(reach, float(np.nanpercentile(np.abs(line.values), 98)))
    ax.set_ylim(-1.15 * reach, 1.15 * reach)
    ax.grid(axis="y")
    ax.set_ylabel("difference (%)")
    return time_axis(ax, products)


def compose_strength(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out scintillation index and Fried parameter over time, and their relative differences."""
    above, below, relative = _frame(figure, datasets, [1.7, 1.7, 1.3], head=0.55)
    draw_scintillation(above, datasets)
    draw_fried_parameter(below, datasets)
    draw_relative(relative, datasets)
    _join((above, below, relative))
    handles = {}
    for ax in (above, below, relative):
        handles.update(dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True)))
    figure.legend(
        list(handles.values()), list(handles), loc="upper left", bbox_to_anchor=(0.09, 1.0), ncol=3, borderaxespad=0.1
    )


def describe_strength(datasets: Sequence[Dataset]) -> str:
    """Say the median of each number and the relative difference of direct and retrieved ones."""
    parts = []
    for name, words, factor, unit in (
        ("scintillation_index", "Scintillation index", 1, ""),
        ("r0", "Fried parameter", 100, " cm"),
    ):
        direct, profile = series(datasets, f"{name}_direct"), series(datasets, f"{name}_profile")
        if profile is None or not np.isfinite(profile.values).any():
            continue
        middle = "median " if np.isfinite(profile.values).sum() > 1 else ""
        text = f"{words} from the profile: {middle}{number(factor * float(np.nanmedian(profile.values)), 3)}{unit}"
        if direct is not None and direct.values.size == profile.values.size and np.isfinite(direct.values).any():
            with np.errstate(divide="ignore", invalid="ignore"):
                relative = 100 * (profile.values / direct.values - 1)
            relative = relative[np.isfinite(relative)]
            text += f", direct: {number(factor * float(np.nanmedian(direct.values)), 3)}{unit}"
            if relative.size:
                text += f"; the one from the profile is {_percent(relative)}"
        parts.append(text + ".")
    return " ".join(parts) or "No batch has these numbers."


def _percent(relative: Floats) -> str:
    middle, spread = float(np.mean(relative)), float(np.std(relative))
    side = "larger" if middle >= 0 else "smaller"
    more = f" on average (standard deviation {number(spread, 2)} %)" if relative.size > 1 else ""
    return f"{number(abs(middle), 2)} % {side}{more}"


def draw_chi2(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw chi2 per datum over time with the line at 1 and the limit of the poor-fit flag."""
    products = listed(datasets)
    line = series(products, "chi2_reduced")
    ax.axhline(1, color=MUTED, lw=1.2)
    ax.axhline(3, color=RED, lw=1.2, ls=(0, (5, 3)))
    ax.annotate("flagged above 3", (1, 3), xycoords=("axes fraction", "data"), xytext=(-2, 3),
                textcoords="offset points", ha="right", color=RED, fontsize=11)  # fmt: skip
    _follow(ax, line, "chi2", color=BLUE, marker="o", ls="-", ms=5)
    _from_zero(ax, line)
    ax.set_ylim(top=max(ax.get_ylim()[1], 3.6))
    ax.set_ylabel(r"$\chi^2$ per datum")
    return time_axis(ax, products)


def draw_log_mu(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw log10(mu) over time."""
    products = listed(datasets)
    line = series(products, "mu")
    if line is not None:
        _follow(ax, line.mapped(np.log10), "log mu", color=PURPLE, marker="s", ls="-", ms=5)
    low, high = ax.get_ylim()
    if high - low < 2:
        ax.set_ylim((low + high) / 2 - 1, (low + high) / 2 + 1)
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:.4g}")
    ax.grid(axis="y")
    ax.set_ylabel(r"$\log_{10}\,\mu$")
    return time_axis(ax, products)


def compose_fit(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out chi2 and log mu over time."""
    above, below = _frame(figure, datasets, [1.5, 1.5])
    draw_chi2(above, datasets)
    draw_log_mu(below, datasets)
    _join((above, below))


def describe_fit(datasets: Sequence[Dataset]) -> str:
    """Say median and range of chi2 and of log mu."""
    parts = []
    for name, words in (("chi2_reduced", "χ² per datum"), ("mu", "log₁₀ μ")):
        line = series(datasets, name)
        if line is None:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.log10(line.values) if name == "mu" else line.values
        found = found[np.isfinite(found)]
        if found.size:
            low, middle, high = (number(float(value), 3) for value in (found.min(), np.median(found), found.max()))
            parts.append(f"{words}: {middle}" if found.size == 1 else f"{words}: median {middle}, from {low} to {high}")
    return "; ".join(parts) + "." if parts else "No batch has these numbers."


def draw_selection(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw the criterion of every batch against log10(mu) and time, relative to its minimum, with the chosen mu."""
    from matplotlib.colors import LogNorm

    products = listed(datasets)
    image = None
    columns = _visible([bounds(dataset) / DAY for dataset in products])
    for dataset, limit in zip(products, columns, strict=True):
        curve = values(dataset, "criterion")
        if curve is None or curve.shape[1] < 2:
            continue
        with np.errstate(invalid="ignore"):
            lowest = np.nanmin(np.where(np.isfinite(curve), curve, np.inf), axis=1, keepdims=True)
            # GCV and its like are positive, and their ratio counts; of logarithms the difference does.
            excess = curve / lowest - 1 if (lowest[np.isfinite(lowest)] > 0).all() else curve - lowest
        edge = borders(np.asarray(dataset["log_mu_grid"].values, np.float64))
        shown = np.ma.masked_invalid(np.maximum(excess, 1e-4))
        for first, last in _uninterrupted(limit):
            image = ax.pcolormesh(
                np.append(limit[first:last, 0], limit[last - 1, 1]), edge, shown[first:last].T,
                norm=LogNorm(1e-4, 1), cmap=f"{SEQUENTIAL}_r", rasterized=True, shading="flat",
            )  # fmt: skip
    line = series(products, "mu")
    if line is not None:
        _follow(
            ax, _in_columns(line, columns).mapped(np.log10), "chosen", color=RED, marker="D", ls="-", ms=5, mfc=PAPER
        )
    ax.set_ylabel(r"$\log_{10}\,\mu$")
    time_axis(ax, products)
    _show_columns(ax, columns)
    if image is not None:
        bar = ax.figure.colorbar(image, ax=ax, fraction=0.04, pad=0.015, extend="both")
        bar.set_label("criterion / minimum − 1")
        bar.outline.set_linewidth(0.6)
    return ax


def compose_selection(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out the criteria over time."""
    draw_selection(_frame(figure, datasets, [2.6], right=0.75)[0], datasets)


def describe_selection(datasets: Sequence[Dataset]) -> str:
    """Say how much the chosen mu varies."""
    line = series(datasets, "mu")
    found = np.empty(0) if line is None else np.log10(line.values[line.values > 0])
    if not found.size:
        return "No batch has a chosen μ."
    text = f"log₁₀ μ: {number(float(found.mean()), 4)}"
    return text + (f" ± {number(float(found.std()), 2)} (mean and deviation of {found.size} batches)." if found.size > 1
                   else ".")  # fmt: skip


_OF_MEAN = "its 68 % interval"
#: Marker, dashes and colour of the averages along the path.
_AVERAGES = (("s", (0, (5, 2)), GREEN), ("o", (0, (1, 1.5)), RED), ("^", (0, (6, 2, 1, 2)), PURPLE))


def draw_averages(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw the mean of Cn2 along the path with its 68 % interval, and as scintillometers on the path weight it."""
    products = listed(datasets)
    mean = series(products, "cn2_path_mean")
    low, high = (series(products, "cn2_path_mean_interval_68", end) for end in (0, 1))
    positive = []
    if mean is not None:
        if low is not None and high is not None:
            if mean.values.size <= MARKED:
                ax.vlines(mean.days, low.values, high.values, color=BLUE, lw=1.4, label=_OF_MEAN)
            else:
                ax.fill_between(mean.days, low.values, high.values, color=BLUE, alpha=0.25, lw=0, label=_OF_MEAN)
        _follow(ax, mean, "mean along the path", color=BLUE, marker="D", ls="-", ms=5)
        positive.append(mean.values)
    count = max(dataset.sizes.get("scintillometer", 0) for dataset in products)
    named = next((d for d in products if d.sizes.get("scintillometer", 0) == count and count), None)
    for component in range(count):
        line = series(products, "cn2_path_average", component)
        marker, dashes, colour = _AVERAGES[component % len(_AVERAGES)]
        name = clean(named["scintillometer"].values[component])[:24].replace("$", r"\$") if named is not None else ""
        _follow(ax, line, f"as {name} weights it", color=colour, marker=marker, mfc=PAPER, ls=dashes, lw=1.6)
        positive += [line.values] if line is not None else []
    found = np.concatenate(positive) if positive else np.empty(0)
    if (found > 0).any():
        ax.set_yscale("log")
    ax.grid(axis="y", which="both")
    ax.set_ylabel(r"$C_n^2$ (m$^{-2/3}$)")
    handles, words = ax.get_legend_handles_labels()
    if len(words) > 1 and words[0] == _OF_MEAN:
        handles[:2], words[:2] = handles[1::-1], words[1::-1]
    ax.legend(handles, words, loc="lower left", bbox_to_anchor=(0.0, 0.0), fontsize=11)
    return time_axis(ax, products)


def compose_averages(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out averages along the path."""
    draw_averages(_frame(figure, datasets, [2.6], left=1.25)[0], datasets)


def describe_averages(datasets: Sequence[Dataset]) -> str:
    """Say the range of the mean along the path."""
    line = series(datasets, "cn2_path_mean")
    found = np.empty(0) if line is None else line.values[np.isfinite(line.values)]
    if not found.size:
        return "No batch has a mean along the path."
    if found.size == 1:
        return f"Mean of Cn² along the path: {scientific(float(found[0]))} m^(-2/3)."
    return (
        f"Mean of Cn² along the path: median {scientific(float(np.median(found)))} m^(-2/3), from "
        f"{scientific(float(found.min()))} to {scientific(float(found.max()))}."
    )


def draw_quality(ax: Axes, datasets: Dataset | Sequence[Dataset]) -> Axes:
    """Draw when each quality flag was raised: a row per flag, named with how often."""
    products = listed(datasets)
    limit = np.concatenate([bounds(dataset) for dataset in products]) / DAY
    raised = np.concatenate([flags(dataset) for dataset in products])
    order = np.argsort(limit[:, 0], kind="stable")
    limit, raised = limit[order], raised[order]
    start, stop = span(products)
    least = 0.004 * (stop - start) / DAY
    names, words = list(QUALITY_FLAGS), []
    for row, name in enumerate(names):
        bit, level, _ = QUALITY_FLAGS[name]
        here = (raised & bit) > 0
        ax.axhline(row, color=MUTED, lw=0.5, zorder=0)
        bars = []
        for first, last in _uninterrupted(limit):
            for a, b in _runs(here[first:last]):
                left, right = limit[first + a, 0], limit[first + b - 1, 1]
                bars.append((left, max(right - left, least)))
        if bars:
            ax.broken_barh(bars, (row - 0.32, 0.64), fc=(PAPER, BLUE, RED)[level], ec=INK, lw=0.6,
                           hatch="xxx" if level == 2 else "")  # fmt: skip
        words.append(f"{name.replace('_', ' ')} ({int(here.sum())})")
    ax.set_ylim(len(names) - 0.5, -0.6)
    ax.set_yticks(range(len(names)), words)
    ax.tick_params(axis="y", length=0)
    return time_axis(ax, products)


def compose_quality(figure: Figure, datasets: Sequence[Dataset]) -> None:
    """Lay out the quality flags over time."""
    draw_quality(_frame(figure, datasets, [0.32 * len(QUALITY_FLAGS)], left=2.45)[0], datasets)


def describe_quality(datasets: Sequence[Dataset]) -> str:
    """Say how many batches are good, and which flags were raised how often."""
    level = np.concatenate([levels(dataset) for dataset in datasets])
    raised = np.concatenate([flags(dataset) for dataset in datasets])
    counts = ", ".join(f"{int((level == i).sum())} {word}" for i, word in enumerate(LEVELS))
    often = [
        f"{name} {int(((raised & (1 << i)) > 0).sum())}"
        for i in range(31)
        for name in flag_names(1 << i)
        if ((raised & (1 << i)) > 0).any()
    ]
    return f"Of {level.size} {'batch' if level.size == 1 else 'batches'}: {counts}. " + (
        "Flags: " + ", ".join(often) + "." if often else "No flag was raised."
    )
