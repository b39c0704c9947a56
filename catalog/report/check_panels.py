"""Figures of one batch that check the signals: Zernike variances, log-amplitudes, temporal spectrum."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .batch_panels import note
from .reading import of_batch, scalar, source_names
from .style import BLUE, GREEN, INK, PAPER, PURPLE, RED
from .words import number, scientific

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

#: Marker, colour and dashes of each source: never told by colour alone.
SOURCES = (("o", RED, (0, (1, 1.5))), ("s", GREEN, (0, (5, 2))))


def draw_zernike(ax: Axes, dataset: Dataset, batch: int = 0) -> Axes:
    """Draw variances of Zernike modes by radial order, measured and of Kolmogorov turbulence with the same r0.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    dataset : Dataset
        A product.
    batch : int
        Number of the batch in the product.

    Returns
    -------
    Axes
        `ax`.
    """
    found = of_batch(dataset, "zernike_variance", batch)
    model = of_batch(dataset, "zernike_variance_kolmogorov", batch)
    if found is None or not (found > 0).any():
        return note(ax, "no Zernike variances")
    order = np.asarray(dataset["radial_order"].values, dtype=np.float64)
    for number_, name in enumerate(source_names([dataset])):
        marker, colour, dashes = SOURCES[number_ % len(SOURCES)]
        # Side by side, so that points of both sources stay apart.
        at = order * (1 + 0.05 * (number_ - 0.5))
        if model is not None and (model[number_] > 0).any():
            ax.plot(order, model[number_], color=colour, ls=dashes, lw=1.6, label=f"Kolmogorov, {name}")
        seen = np.where(found[number_] > 0, found[number_], np.nan)
        ax.plot(at, seen, marker, color=colour, mfc=PAPER, ms=7, mew=1.6,
                label=f"measured, {name}")  # fmt: skip
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xticks(order, [f"{n:.0f}" for n in order])
    ax.set_xticks([], minor=True)
    ax.set_xlim(order[0] * 0.85, order[-1] * 1.18)
    ax.set_xlabel("radial order")
    ax.set_ylabel("variance per mode (rad²)")
    ax.grid(axis="y", which="major")
    ax.legend(loc="lower left", fontsize=10.5, handlelength=2.2)
    return ax


def draw_log_amplitude(ax: Axes, dataset: Dataset, batch: int = 0) -> Axes:
    """Draw the histogram of the log-amplitude of each source with the Gaussian that was fitted to it."""
    count = of_batch(dataset, "log_amplitude_count", batch)
    if count is None or not count.any():
        return note(ax, "no log-amplitudes")
    chi = np.asarray(dataset["log_amplitude"].values, dtype=np.float64)
    step = chi[1] - chi[0]
    mean = of_batch(dataset, "log_amplitude_mean", batch)
    deviation = of_batch(dataset, "log_amplitude_deviation", batch)
    reach = 0.0
    for number_, name in enumerate(source_names([dataset])):
        if not count[number_].any():
            continue
        _, colour, dashes = SOURCES[number_ % len(SOURCES)]
        density = count[number_] / count[number_].sum() / step
        seen = density > 0
        seen[[0, -1]] = False  # they hold all that lies beyond
        # One filled, the other an outline, so that both are seen where they agree.
        first = number_ == 0
        ax.stairs(np.where(seen, density, 0), np.append(chi - step / 2, chi[-1] + step / 2), color=colour, fill=first,
                  alpha=0.35 if first else 1.0, lw=1.4, label=f"measured, {name}")  # fmt: skip
        reach = max(reach, float(np.abs(chi[seen & (density > 0.02 * density.max())]).max()))
        if mean is not None and deviation is not None and deviation[number_] > 0:
            z = (chi - mean[number_]) / deviation[number_]
            bell = np.exp(-(z**2) / 2) / (deviation[number_] * np.sqrt(2 * np.pi))
            ax.plot(chi, bell, color=colour, ls=dashes, lw=1.6, label=f"Gaussian, {name}")
    ax.set_xlim(-1.2 * reach, 1.2 * reach)
    ax.locator_params(axis="x", nbins=5)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("log-amplitude χ = ½ ln(i / mean i)")
    ax.set_ylabel("density")
    ax.legend(loc="upper left", fontsize=10, handlelength=1.8, borderaxespad=0.1)
    low, high = ax.get_ylim()
    ax.set_ylim(low, 1.45 * high)
    return ax


def compose_checks(figure: Figure, dataset: Dataset, batch: int) -> None:
    """Lay out Zernike variances and log-amplitudes."""
    draw_zernike(figure.add_axes((0.095, 0.15, 0.385, 0.81)), dataset, batch)
    draw_log_amplitude(figure.add_axes((0.575, 0.15, 0.41, 0.81)), dataset, batch)


def describe_checks(dataset: Dataset, batch: int) -> str:
    """Say how far variances and log-amplitudes are from what turbulence makes of them."""
    parts = []
    for number_, name in enumerate(source_names([dataset])):
        words = []
        for variable, text, unit, factor in (
            ("r0_direct", "r₀ from the Zernike variances", " cm", 100),
            ("zernike_misfit", "misfit of radial orders 2 to 5", "", 1),
            ("log_amplitude_deviation", "deviation of the log-amplitude", "", 1),
            ("log_amplitude_distance", "distance from a Gaussian", "", 1),
        ):
            found = of_batch(dataset, variable, batch)
            if found is not None and np.isfinite(found[number_]):
                words.append(f"{text} {number(factor * float(found[number_]), 3)}{unit}")
        if words:
            parts.append(f"{name}: {', '.join(words)}")
    return "; ".join(parts).replace(r"\$", "$") + "." if parts else "This batch has no such checks."


def draw_spectrum(ax: Axes, dataset: Dataset, batch: int = 0) -> Axes:
    """Draw the temporal spectrum of the slopes that all spots share, along x and y, with the vibration line if any."""
    density = of_batch(dataset, "slope_spectrum", batch)
    if density is None or not (density > 0).any():
        return note(ax, "no spectrum")
    frequency = np.asarray(dataset["frequency"].values, dtype=np.float64)
    for row, (name, colour, dashes) in zip(density, (("x", BLUE, "-"), ("y", RED, (0, (4, 1.5)))), strict=False):
        ax.plot(
            frequency, np.where(row > 0, row, np.nan), color=colour, ls=dashes, lw=1.5, label=f"slopes along {name}"
        )
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(frequency[0], frequency[-1])
    line = scalar(dataset, "vibration_frequency", batch)
    if np.isfinite(line):
        ax.axvline(line, color=PURPLE, lw=1.2, ls=(0, (1, 1.5)), zorder=0)
        right = line > np.sqrt(frequency[0] * frequency[-1])
        ax.annotate(f"line at {number(line, 4)} Hz", (line, 0.95), xycoords=("data", "axes fraction"), color=PURPLE,
                    xytext=(-6 if right else 6, 0), textcoords="offset points", ha="right" if right else "left",
                    va="top")  # fmt: skip
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.set_xlabel("frequency (Hz)")
    ax.set_ylabel("density (rad²/Hz)")
    ax.grid(axis="y", which="major", color=INK, alpha=0.15)
    ax.legend(loc="lower left")
    return ax


def compose_spectrum(figure: Figure, dataset: Dataset, batch: int) -> None:
    """Lay out the temporal spectrum."""
    draw_spectrum(figure.add_axes((0.095, 0.17, 0.885, 0.79)), dataset, batch)


def describe_spectrum(dataset: Dataset, batch: int) -> str:
    """Say whether there is a vibration line, where, and how strong."""
    density = of_batch(dataset, "slope_spectrum", batch)
    line, variance = scalar(dataset, "vibration_frequency", batch), of_batch(dataset, "vibration_variance", batch)
    if np.isfinite(line) and variance is not None:
        x, y = (scientific(float(value)) for value in variance[:2])
        return f"A vibration line at {number(line, 4)} Hz holds {x} rad² of the slopes along x and {y} rad² along y."
    if density is None or not (density > 0).any():
        return "This batch has no spectrum of the slopes."
    return "No vibration line stands out of the spectrum."
