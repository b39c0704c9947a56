"""One self-contained page from products: what is in it, in which order, and with which words."""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...pipeline.products import QUALITY_FLAGS, SCHEMA
from . import batch_panels as one
from . import check_panels as check
from . import flux_panels as flux
from . import model_panels as model
from . import time_panels as over
from .reading import (
    LEVELS,
    Floats,
    bounds,
    edges,
    flag_names,
    flags,
    has_profile,
    levels,
    listed,
    log_mu,
    of_batch,
    scalar,
    span,
    values,
)
from .style import figure_style
from .svg import inline_svg
from .words import (
    NOTHING,
    clean,
    clock,
    interval,
    mapping,
    measured,
    number,
    offset,
    raised_units,
    scientific,
    site_zone,
)
from .words import days as period

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

#: The paper that describes the method.
METHOD = (
    "C. Sauvage, C. Robert, L. M. Mugnier, J.-M. Conan, J.-M. Cohard, K.-L. Nguyen, M. Irvine, J.-P. Lagouarde: "
    "Near ground horizontal high resolution Cn2 profiling from Shack-Hartmann slope and scintillation data. "
    "Applied Optics 60 (34), 10499-10519 (2021), doi:10.1364/AO.438170"
)

#: Characters of lineage and provenance that a page shows.
SHOWN = 200_000


@dataclass(frozen=True)
class BatchPanel:
    """A figure of one batch, named after the question it answers.

    Parameters
    ----------
    key : str
        Name for programs.
    title : str
        The question.
    reading : str
        How to read the figure.
    size : (float, float)
        Width and height, inches.
    compose : callable
        Draws the figure of (figure, dataset, batch).
    describe : callable
        Says what the figure of (dataset, batch) shows.
    variables : tuple of str
        The figure says something only where one of them has a value.
    absent : str
        Why there is no figure where none has.
    """

    key: str
    title: str
    reading: str
    size: tuple[float, float]
    compose: Callable[[Figure, Dataset, int], None]
    describe: Callable[[Dataset, int], str]
    variables: tuple[str, ...]
    absent: str


@dataclass(frozen=True)
class TimePanel:
    """A figure over all batches, named after the question it answers.

    Parameters
    ----------
    key, title, reading, size, compose, describe
        As in :class:`BatchPanel`, for all batches.
    variables, absent
        As in :class:`BatchPanel`; a figure without variables always says something.
    least : int
        The figure says something only of so many batches.
    """

    key: str
    title: str
    reading: str
    size: tuple[float, float]
    compose: Callable[[Figure, Sequence[Dataset]], None]
    describe: Callable[[Sequence[Dataset]], str]
    variables: tuple[str, ...] = ()
    absent: str = ""
    least: int = 1


BATCH_PANELS = (
    BatchPanel(
        "profile",
        "How does Cn² vary along the line of sight?",
        "A step is one slice. The bar with a filled circle is the MAP error (1 sigma); the bar with an open "
        "diamond is the maximum-likelihood error, from the data alone: where it is much longer, the prior decides."
        " The thick and the thin line between them are the shortest intervals of the posterior that hold 68 % and 95 %."
        " A bar with an arrow is a slice that the positivity constraint holds at zero; it marks zero plus two MAP "
        "errors, or the upper end of the 95 % interval where the product has one.",
        (10.0, 5.0),
        one.compose_profile,
        one.describe_profile,
        ("cn2",),
        "This batch has no profile.",
    ),
    BatchPanel(
        "correlations",
        "Does the profile explain the measured correlations?",
        "Each map shows a correlation against the separation of two subapertures, dx to the right and dy "
        "upward; separations without a pair are blank. Measured and model share a scale for all slope maps, and "
        "one for both scintillation maps. Residuals are (measured − model) in units of their error, with a plus "
        "or minus sign beyond 3. Errors of neighbouring entries are correlated, so that whole areas share a "
        "sign and the rms may lie well below 1; well above 1 it is a misfit. The last row cuts the maps at dx = 0.",
        one.CORRELATION_SIZE,
        one.compose_correlations,
        one.describe_correlations,
        ("slope_correlation", "intensity_correlation"),
        "This batch has no correlation maps.",
    ),
    BatchPanel(
        "criterion",
        "How was the strength of the regularisation chosen?",
        "The curve is the criterion for each μ; μ is the inverse of the a priori variance of the profile. The "
        "diamond on the dashed line is the value used; on the right, its surroundings. A flat curve means that "
        "the data hardly tell.",
        (10.0, 3.6),
        one.compose_criterion,
        one.describe_criterion,
        ("criterion",),
        "There is no criterion curve: μ was given.",
    ),
    BatchPanel(
        "kernels",
        "Which part of the path does each slice really see?",
        "A row tells how one retrieved slice answers to turbulence at each true distance, without the positivity "
        "constraint. Ideal: 1 on the dotted diagonal. Right: the sum of each row (filled circles; 1 means that the"
        " data, not the prior, set the level) and the part from the slice's own place (open squares).",
        (10.0, 4.9),
        one.compose_kernels,
        one.describe_kernels,
        ("averaging_kernel",),
        "This batch has no averaging kernels.",
    ),
    BatchPanel(
        "other_mu",
        "How much does the profile depend on the regularisation?",
        "The same data with a hundredth of the chosen μ, with the chosen one, and with a hundred times as much, with "
        "MAP bars, on one scale. What all three show is in the data; what only one shows is the prior's, or noise.",
        (10.0, 3.6),
        model.compose_other_mu,
        model.describe_other_mu,
        ("cn2_other_mu",),
        "This batch has no profiles at other μ.",
    ),
    BatchPanel(
        "checks",
        "Do slopes and scintillation look like turbulence?",
        "Left: variance per Zernike mode from the slopes against radial order; lines are Kolmogorov turbulence with "
        "the direct r₀, after Noll, of the extended source. Points off the line at order 1 mean vibration or drift, "
        "at the highest order noise or aliasing. Right: histogram of the log-amplitude; weak turbulence makes it "
        "Gaussian.",
        (10.0, 3.9),
        check.compose_checks,
        check.describe_checks,
        ("zernike_variance", "log_amplitude_count"),
        "This batch has no such checks.",
    ),
    BatchPanel(
        "vibration",
        "Does the instrument vibrate?",
        "Temporal spectrum of the slopes that all spots of both sources share. Turbulence falls smoothly; a machine "
        "makes a line, marked where one is found. A line above half the frame rate appears at its alias.",
        (10.0, 3.4),
        check.compose_spectrum,
        check.describe_spectrum,
        ("slope_spectrum",),
        "This batch has no spectrum of the slopes.",
    ),
)

TIME_PANELS = (
    TimePanel(
        "map",
        "When and where is the turbulence strong?",
        "One column per batch (widened to the right where it would be too narrow to see), one row per slice; "
        "brighter is stronger, on a logarithmic scale taken from the data. Blank: "
        "nothing was measured. Hatched: the positivity constraint holds the slice at zero.",
        (10.0, 4.9),
        over.compose_time_distance,
        over.describe_time_distance,
        ("cn2",),
        "No batch has a profile.",
        2,
    ),
    TimePanel(
        "strength",
        "Does the profile agree with what the spots show directly?",
        "Open symbols are measured directly from fluxes and slopes, source by source; filled diamonds are computed"
        " from the retrieved profile, with aperture and source averaging in the index. Both hold at the "
        "instrument's wavelength. Where they differ, the profile misses or invents turbulence; by how much, the lowest "
        "panel says.",
        (10.0, 6.6),
        over.compose_strength,
        over.describe_strength,
        ("scintillation_index_profile", "scintillation_index_direct", "r0_profile", "r0_direct"),
        "No batch has these numbers.",
    ),
    TimePanel(
        "fit",
        "Does the model fit, and is the regularisation steady?",
        "Above: misfit per independent datum; 1 is what the convergence noise predicts. Below: the hyperparameter "
        "μ (m^(4/3)); it rises by 2 in the logarithm when the turbulence falls by 10.",
        (10.0, 4.8),
        over.compose_fit,
        over.describe_fit,
        ("chi2_reduced", "mu"),
        "No batch has these numbers.",
    ),
    TimePanel(
        "selection",
        "How sure is the choice of the regularisation?",
        "A column is the criterion of one batch, relative to its own minimum: the brighter, the closer to it. An open "
        "diamond is the chosen μ. A broad bright band means that the data hardly tell.",
        (10.0, 4.0),
        over.compose_selection,
        over.describe_selection,
        ("criterion",),
        "There are no criterion curves: μ was given.",
    ),
    TimePanel(
        "averages",
        "What would a scintillometer see?",
        "Mean of Cn² along the path with its 68 % interval, and for each scintillometer that the recording's header "
        "names, the mean with that instrument's weight.",
        (10.0, 4.0),
        over.compose_averages,
        over.describe_averages,
        ("cn2_path_mean",),
        "No batch has a mean along the path.",
    ),
    TimePanel(
        "scintillometers",
        "Do profiles and scintillometers agree?",
        "Solid lines with bars: the profiles averaged along the path as each scintillometer weights them, "
        "with the errors of their posterior. Dotted lines with open symbols: what the instruments measured in the same "
        "time. Below, one against the other; the grey line is equality.",
        (10.0, 7.6),
        flux.compose_agreement,
        flux.describe_agreement,
        ("cn2_scintillometer",),
        "No records of a scintillometer stand beside these profiles.",
    ),
    TimePanel(
        "height",
        "Does the turbulence follow the height above ground?",
        "The solid steps are the median profile of the first product. The dashed ones are what free convection over "
        "uniform ground would make of the same Fried parameter; the terrain decides where they rise. Below: height of "
        "the line of sight above the ground.",
        (10.0, 5.2),
        flux.compose_height_model,
        flux.describe_height_model,
        ("cn2_height_model",),
        "The height of the line of sight above the ground is not known.",
    ),
    TimePanel(
        "heat_flux",
        "How much heat does the ground give to the air?",
        "Sensible heat flux, upward, of each slice over time: red where the ground warms the air, blue where it cools "
        "it. Blank where there is no solution or no weather. Below: the median of each slice.",
        (10.0, 6.4),
        flux.compose_heat_flux,
        flux.describe_heat_flux,
        ("sensible_heat_flux",),
        "No weather is known, from which a heat flux would follow.",
    ),
    TimePanel(
        "weights",
        "Where along the path does each scintillometer look?",
        "Weight of the turbulence at each distance in the Cn² of the instrument, relative to its mean: the end with "
        "the smaller aperture counts more.",
        (10.0, 3.4),
        model.compose_weights,
        model.describe_weights,
        ("scintillometer_weight",),
        "The recording's header names no scintillometer.",
    ),
    TimePanel(
        "response",
        "What do the data answer to, and from where?",
        "Above: correlation that Cn²dz = 1 m^(1/3) in one slice makes, along dy at dx = 0; the numbers count the "
        "slices from the pupil. The width of the scintillation grows with distance, that of the slopes hardly does. "
        "Below: variance at zero separation against distance, relative to its largest. Slopes see what is near, "
        "scintillation the middle of the path; beyond the dotted line the two sources share no turbulence.",
        (10.0, 7.2),
        model.compose_response,
        model.describe_response,
        ("response_intensity", "response_slope"),
        "The product holds no response functions.",
    ),
    TimePanel(
        "quality",
        "Which batches need care?",
        "A bar shows when a flag was raised: filled bars mean usable with care, crossed bars mean bad, and an open bar "
        "is a remark on a batch that may be good. The number behind its name counts the batches.",
        (10.0, 4.3),
        over.compose_quality,
        over.describe_quality,
    ),
)


@dataclass(frozen=True)
class Day:
    """A day in the index of a long campaign.

    Parameters
    ----------
    name : str
        ``2012-09-14``.
    file : str
        File name of its page.
    count : int
        Batches.
    quality : tuple of int
        How many are good, usable with care, bad.
    cn2 : float
        Median of the mean along the path, m^(-2/3).
    """

    name: str
    file: str
    count: int
    quality: tuple[int, int, int]
    cn2: float

    @property
    def shown(self) -> tuple[str, str]:
        """`cn2` as text and as what the table is sorted by."""
        return number(self.cn2, 3), repr(self.cn2) if np.isfinite(self.cn2) else ""


def figure(panel: BatchPanel | TimePanel, datasets: Dataset | Sequence[Dataset], batch: int = 0) -> Figure:
    """Draw the figure of a panel, to be saved as PNG, PDF or SVG with ``figure.savefig``.

    Parameters
    ----------
    panel : BatchPanel or TimePanel
        One of :data:`BATCH_PANELS`, :data:`TIME_PANELS`.
    datasets : Dataset or sequence of Dataset
        Products; a panel of one batch takes the first.
    batch : int
        Number of the batch in that product.
    """
    with figure_style():
        return _draw(panel, listed(datasets), batch)


def _draw(panel: BatchPanel | TimePanel, products: Sequence[Dataset], batch: int) -> Figure:
    from matplotlib.figure import Figure

    drawn = Figure(figsize=panel.size)
    if isinstance(panel, BatchPanel):
        panel.compose(drawn, products[0], batch)
    else:
        panel.compose(drawn, products)
    return drawn


def nothing_to_draw(panel: BatchPanel | TimePanel, products: Sequence[Dataset], batch: int = 0) -> str:
    """Why a panel would be empty, in a sentence; no words where it has something to draw.

    Parameters
    ----------
    panel : BatchPanel or TimePanel
        One of :data:`BATCH_PANELS`, :data:`TIME_PANELS`.
    products : sequence of Dataset
        Products; a panel of one batch takes the first.
    batch : int
        Number of the batch in that product.
    """
    if isinstance(panel, BatchPanel):
        found = {name: [of_batch(products[0], name, batch)] for name in panel.variables}
    else:
        if (count := sum(dataset.sizes["time"] for dataset in products)) < panel.least:
            return f"This takes {panel.least} batches at least; here {'is 1' if count == 1 else f'are {count}'}."
        found = {name: [values(dataset, name) for dataset in products] for name in panel.variables}
    drawn = any(_valued(name, value) for name, several in found.items() for value in several)
    return "" if drawn or not found else panel.absent


def _valued(name: str, value: Floats | None) -> bool:
    # A Cn2 of zero is a value; a count of nothing is none.
    counted = name in SCHEMA and SCHEMA[name].dtype == "int64"
    return value is not None and bool((value != 0).any() if counted else np.isfinite(value).any())


def _known(panel: TimePanel, products: Sequence[Dataset]) -> bool:
    """Whether a product holds what the panel is about, be it without a value."""
    return not panel.variables or any(name in dataset for dataset in products for name in panel.variables)


def _markup(panel: BatchPanel | TimePanel, prefix: str, products: Sequence[Dataset], batch: int = 0) -> dict[str, str]:
    text = panel.describe(products[0], batch) if isinstance(panel, BatchPanel) else panel.describe(products)
    svg = ""
    if not nothing_to_draw(panel, products, batch):
        with figure_style():
            svg = inline_svg(_draw(panel, products, batch), prefix, panel.title, text)
    return {"title": panel.title, "reading": panel.reading, "text": text, "svg": svg, "key": panel.key}


def pick(usable: Sequence[bool] | np.ndarray, most: int) -> list[int]:
    """Numbers of at most `most` usable batches, first and last among them, spread evenly."""
    numbers = np.flatnonzero(np.asarray(usable))
    if len(numbers) <= most:
        return [int(i) for i in numbers]
    return [int(i) for i in numbers[np.round(np.linspace(0, len(numbers) - 1, most)).astype(int)]]


def _spread(found: Sequence[float], factor: float = 1.0) -> tuple[str, str]:
    """A number with what is known of its variation: value, remark."""
    finite = np.asarray([value for value in found if np.isfinite(value)]) * factor
    if not finite.size:
        return NOTHING, ""
    if finite.size == 1:
        return number(float(finite[0]), 3), ""
    return number(
        float(np.median(finite)), 3
    ), f"median; {number(float(finite.min()), 3)} to {number(float(finite.max()), 3)}"


def key_numbers(products: Sequence[Dataset]) -> list[dict[str, str]]:
    """Name, value, unit and remark of what everybody asks for first."""
    batches = [(dataset, batch) for dataset in products for batch in range(dataset.sizes["time"])]

    def number_of(name: str, words: str, unit: str, factor: float = 1.0) -> dict[str, str]:
        value, remark = _spread([scalar(dataset, name, batch) for dataset, batch in batches], factor)
        error = f"{name}_standard_error"
        if len(batches) == 1 and error in products[0]:
            value = measured(factor * scalar(*batches[0][:1], name, 0), factor * scalar(products[0], error, 0))
        return {"name": words, "value": value, "unit": unit, "remark": remark}

    means, errors = zip(*(path_mean(dataset, batch) for dataset, batch in batches), strict=True)
    value, remark = _spread(means)
    if len(batches) == 1 and np.isfinite(means[0]):
        value, remark = measured(means[0], errors[0]), "error: the slices' MAP bars, taken as independent"
    elif np.isfinite(errors).any():
        remark += f"; error of one batch {scientific(float(np.nanmedian(errors)), 2)}"
    return [
        {"name": "Cn², mean over the path", "value": value, "unit": "m^(-2/3)", "remark": remark},
        number_of("r0_profile", "Fried parameter r₀, from the profile", "cm", 100),
        *([number_of("r0_direct", "Fried parameter r₀, direct", "cm", 100)] if "r0_direct" in products[0] else []),
        number_of("scintillation_index_profile", "Scintillation index, from the profile", ""),
        number_of("scintillation_index_direct", "Scintillation index, direct", ""),
        number_of("chi2_reduced", "χ² per datum", ""),
        number_of("degrees_of_freedom", "Degrees of freedom for signal", ""),
    ]


def _wavelength(value: object) -> str:
    """A wavelength written in metres, in µm; anything else as it is."""
    number_of, _, unit = str(value).partition(" ")
    try:
        return f"{float(number_of) * 1e6:.6g} µm" if unit == "m" else str(value)
    except ValueError:
        return str(value)


def _settings(products: Sequence[Dataset]) -> str:
    """The choices that a reader of a profile should know, as far as the products name them."""
    found = []
    for name in ("source_model", "spectrum", "sampling", "slope_response", "covariance", "regulariser", "selector"):
        chosen = dict.fromkeys(str(dataset.attrs[name]) for dataset in products if name in dataset.attrs)
        if chosen:
            found.append(f"{name.replace('_', ' ')} {' and '.join(chosen)}")
    return ", ".join(found)


def _path(dataset: Dataset) -> str:
    border = edges(dataset)
    return f"{border.size - 1} slices, {number(border[0], 4)} to {number(border[-1], 4)} m from the pupil"


def path_mean(dataset: Dataset, batch: int) -> tuple[float, float]:
    """Cn2 averaged over the path and its error from independent MAP bars, m^(-2/3); NaN without a profile."""
    cn2, error = of_batch(dataset, "cn2", batch), of_batch(dataset, "cn2_standard_error", batch)
    if cn2 is None or not np.isfinite(cn2).all():
        return float("nan"), float("nan")
    width = np.diff(edges(dataset))
    share = width / width.sum()
    # A product holds no correlation of its errors. Those of neighbouring slices are mostly negative, as what one slice
    # loses the next one gains, so that independence exaggerates rather than flatters.
    return float(share @ cn2), float(np.sqrt(np.sum((share * error) ** 2))) if error is not None else float("nan")


def geometry(products: Sequence[Dataset]) -> list[dict[str, str]]:
    """What the arrangement of pupil, path and sources allows: name, value, unit, remark."""
    found: dict[tuple[str, ...], None] = {}
    for dataset in products:
        rows = [("Path length", *_quantity(dataset.attrs.get("path_length")), "")]
        rows.append(("Subaperture", *_quantity(dataset.attrs.get("subaperture_size"), 100, "cm", 3), ""))
        if "dy" in dataset and dataset.sizes["dy"] > 1:
            dy = np.asarray(dataset["dy"].values, dtype=np.float64)
            rows.append(("Pupil along y", number(100 * ((dy[-1] - dy[0]) / 2 + dy[1] - dy[0]), 3), "cm", ""))
        for name, words, remark in (
            ("z_max", "z_max", "triangulation ends here: beyond, the two sources share no turbulence"),
            ("z_first", "Resolution near the pupil", "where the sources' patterns move by one subaperture"),
        ):
            value = float(dataset[name].values) if name in dataset else float("nan")
            if np.isfinite(value):
                rows.append((words, number(value, 4), "m", remark))
        if "fresnel_scale" in dataset:
            scale = 100 * np.asarray(dataset["fresnel_scale"].values, dtype=np.float64)
            rows.append(("Fresnel scale on the pupil", f"{number(float(scale[0]), 3)} to {number(float(scale[-1]), 3)}",
                         "cm", "size of the scintillation from the first and from the last slice"))  # fmt: skip
        found |= dict.fromkeys(row for row in rows if row[1])
    lengths = [values(dataset, "resolution_length") for dataset in products]
    known = np.concatenate([np.ravel(length) for length in lengths if length is not None] or [np.empty(0)])
    if (resolved := known[np.isfinite(known)]).size:
        remark = (f"length of path that a slice stands for: median; {number(float(resolved.min()), 3)} to "
                  f"{number(float(resolved.max()), 3)}")  # fmt: skip
        if lost := known.size - resolved.size:
            remark += f"; {number(100 * lost / known.size, 2)} % of the slices are not resolved"
        found[("Resolution of the profiles", number(float(np.median(resolved)), 3), "m", remark)] = None
    return [dict(zip(("name", "value", "unit", "remark"), row, strict=True)) for row in found]


def _quantity(value: object, factor: float = 1.0, unit: str = "m", digits: int = 4) -> tuple[str, str]:
    """Number and unit of a length written as text in metres; empty where it is none."""
    amount, _, written = str(value).partition(" ")
    try:
        return (number(factor * float(amount), digits), unit) if written == "m" else ("", "")
    except ValueError:
        return "", ""


#: Columns of the table of batches: heading, unit, tooltip.
COLUMNS = (
    ("start", "UTC", "start of the batch"),
    ("length", "s", "end minus start"),
    ("frames", "", "frames in the batch"),
    ("quality", "", "good, usable with care, bad; and the flags raised"),
    ("Cn² mean", "m^(-2/3)", "average of the profile over the path"),
    ("r₀", "cm", "Fried parameter of a spherical wave, from the profile"),
    ("σ² direct", "", "scintillation index measured directly, mean of the sources"),
    ("σ² profile", "", "scintillation index of the profile, aperture- and source-averaged"),
    ("σ² point", "", "scintillation index of one point of the source: first-order theory fails above 0.3"),
    ("log₁₀ μ", "μ: m^(4/3)", "hyperparameter"),
    ("χ²", "per datum", "misfit"),
    ("d.o.f.", "", "degrees of freedom for signal"),
    ("measured", "%", "spots that could be measured"),
)


def _cell(value: float, digits: int = 4) -> dict[str, str]:
    return {"text": number(value, digits), "sort": repr(float(value)) if np.isfinite(value) else ""}


def _table(products: Sequence[Dataset]) -> list[dict[str, Any]]:
    rows = []
    for dataset in products:
        limit, level, raised = bounds(dataset), levels(dataset), flags(dataset)
        for batch in range(dataset.sizes["time"]):
            start, stop = (int(time) for time in limit[batch])
            names = flag_names(int(raised[batch]))
            cells = [
                {"text": clock(start), "sort": str(start)},
                _cell((stop - start) / 1e9),
                {"text": f"{frames:.0f}" if np.isfinite(frames := scalar(dataset, "n_frames", batch)) else NOTHING,
                 "sort": repr(frames) if np.isfinite(frames) else ""},
                {"text": LEVELS[level[batch]] + (f": {', '.join(names)}" if names else ""), "sort": str(level[batch])},
                _cell(path_mean(dataset, batch)[0]),
                _cell(100 * scalar(dataset, "r0_profile", batch)),
                _cell(scalar(dataset, "scintillation_index_direct", batch)),
                _cell(scalar(dataset, "scintillation_index_profile", batch)),
                _cell(scalar(dataset, "scintillation_index_point", batch)),
                _cell(log_mu(scalar(dataset, "mu", batch))),
                _cell(scalar(dataset, "chi2_reduced", batch)),
                _cell(scalar(dataset, "degrees_of_freedom", batch)),
                _cell(100 * scalar(dataset, "valid_fraction", batch)),
            ]  # fmt: skip
            rows.append({"level": int(level[batch]), "cells": cells})
    return rows


def _documents(products: Sequence[Dataset]) -> list[dict[str, Any]]:
    """For each product its short attributes, the stages it went through, and its documents as long as there is room."""
    room, written = SHOWN, []
    for dataset in products:
        short, long = [], []
        for name, value in dataset.attrs.items():
            decoded = mapping(value)
            text = (
                json.dumps(decoded, indent=1, sort_keys=True, default=str, ensure_ascii=False)
                if decoded
                else str(value)
            )
            if len(text) <= 120 and "\n" not in text:
                short.append((str(name), text))
            elif len(text) <= room:
                room -= len(text)
                long.append((str(name), text))
            else:
                long.append((str(name), f"left out here ({len(text)} characters); the product file has it"))
        written.append({
            "archive": str(dataset.attrs.get("archive", "unnamed archive")),
            "key": str(dataset.attrs.get("lineage_key", "")),
            "short": short,
            "long": long,
            "stages": _stages(dataset) if room > 0 else [],
        })  # fmt: skip
    return written


def _stages(dataset: Dataset) -> list[list[str]]:
    """Stage, version, plugins and parameters of each step of the lineage."""
    nodes = mapping(mapping(dataset.attrs.get("lineage")).get("nodes"))
    rows = []
    for node in (mapping(node) for node in nodes.values()):
        plugins, tracked = node.get("plugins"), node.get("tracked")
        rows.append([str(node.get("stage", "")), str(node.get("version", "")), _flat(plugins), _flat(tracked)])
    return sorted(rows)


def _flat(value: object, depth: int = 0) -> str:
    """Nested settings in one line."""
    if isinstance(value, dict):
        text = ", ".join(f"{name} = {_flat(item, depth + 1)}" for name, item in sorted(value.items(), key=str))
    elif isinstance(value, list):
        text = ", ".join(_flat(item, depth + 1) for item in value)
    else:
        text = "none" if value is None else str(value)
    text = text if len(text) <= 600 else text[:600] + " …"
    return f"({text})" if depth and isinstance(value, dict | list) else text


def software(products: Sequence[Dataset]) -> str:
    """Name, version and commit of the software that made the products."""
    found = []
    for dataset in products:
        agents = mapping(mapping(dataset.attrs.get("provenance")).get("agent"))
        for agent in (mapping(agent) for agent in agents.values()):
            label, commit = agent.get("prov:label"), agent.get("coslidar:commit")
            if isinstance(label, str) and label.startswith("coslidar"):
                found.append(f"{label} (commit {commit})" if commit else label)
    return " and ".join(dict.fromkeys(found)) or "coslidar"


def _policy(*contents: str) -> list[str]:
    return [
        "'sha256-" + base64.b64encode(hashlib.sha256(content.encode()).digest()).decode() + "'" for content in contents
    ]


def render(
    datasets: Dataset | Iterable[Dataset],
    *,
    title: str | None = None,
    most_batches: int = 6,
    days: Sequence[Day] = (),
    back: str = "",
) -> str:
    """Make the report of one or more products as one self-contained HTML page.

    Parameters
    ----------
    datasets : Dataset or iterable of Dataset
        Products of one campaign, in any order.
    title : str, optional
        Heading; by default the campaign.
    most_batches : int
        Batches with figures of their own, picked evenly among those that have a profile.
    days : sequence of Day
        Pages with the batches, one a day; this page has none then, but an index of them.
    back : str
        File name of the page with the index of days, where this one is of a day.

    Returns
    -------
    str
        HTML. The same products give the same text.

    Raises
    ------
    ValueError
        There is no batch in the products.
    """
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    products = listed(datasets)
    if not products:
        raise ValueError("there is no batch to report on: every product is empty, or none was given")
    for dataset in products:
        # Lazily loaded variables would be read once per panel.
        dataset.load()
    source = {
        name: files(__package__).joinpath(name).read_text("utf-8")
        for name in ("report.html", "report.css", "report.js")
    }
    source = {name: text.replace("\r\n", "\n") for name, text in source.items()}

    start, stop = span(products)
    zone = site_zone(products[0].attrs)
    campaigns = list(dict.fromkeys(str(dataset.attrs.get("campaign", "unnamed campaign")) for dataset in products))
    archives = list(dict.fromkeys(str(dataset.attrs.get("archive", "unnamed archive")) for dataset in products))
    level = np.concatenate([levels(dataset) for dataset in products])
    raised = int(np.bitwise_or.reduce(np.concatenate([flags(dataset) for dataset in products])))

    batches = [(i, j) for i, dataset in enumerate(products) for j in range(dataset.sizes["time"])]
    most_batches = 0 if days else most_batches
    chosen = [batches[n] for n in pick(np.concatenate([has_profile(dataset) for dataset in products]), most_batches)]
    shown = []
    for n, (i, j) in enumerate(chosen):
        begin, end = (int(time) for time in bounds(products[i])[j])
        shown.append({
            "label": f"{' to '.join(interval(begin, end))} UTC",
            "quality": LEVELS[levels(products[i])[j]],
            "flags": flag_names(int(flags(products[i])[j])),
            "panels": [_markup(panel, f"b{n}{panel.key}", [products[i]], j) for panel in BATCH_PANELS],
            "rows": one.profile_rows(products[i], j),
        })  # fmt: skip

    panels = [
        _markup(panel, f"t{panel.key}", products)
        for panel in TIME_PANELS
        if _known(panel, products) and (panel.least == 1 or not nothing_to_draw(panel, products))
    ]
    documents = _documents(products)
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        # Markup is what this package wrote itself; everything else may come from the header of somebody's archive.
        finalize=lambda value: value if isinstance(value, Markup) else clean(value),
    )  # fmt: skip

    environment.filters["units"] = raised_units

    def marked(items: list[dict[str, str]]) -> list[dict[str, Any]]:
        return [{**item, "svg": Markup(item["svg"])} for item in items]

    for item in shown:
        item["panels"] = marked(item["panels"])  # type: ignore[arg-type]
    script_policy, style_policy = _policy(source["report.js"], source["report.css"])
    named = title if title is not None else heading(products)
    return environment.from_string(source["report.html"]).render(
        script=Markup(source["report.js"]),
        style=Markup(source["report.css"]),
        script_policy=Markup(script_policy),
        style_policy=Markup(style_policy),
        title=named,
        campaigns=campaigns,
        archives=archives,
        utc=interval(start, stop),
        local=None if zone is None else interval(start, stop, zone),
        zone=None if zone is None else f"{zone.key}, {offset(start, zone)}",
        period=period(start, stop),
        days=days,
        back=back,
        geometry=geometry(products),
        count=len(batches),
        settings=_settings(products),
        path=list(dict.fromkeys(_path(dataset) for dataset in products)),
        wavelength=", ".join(
            dict.fromkeys(_wavelength(d.attrs["wavelength"]) for d in products if "wavelength" in d.attrs)
        ),
        quality=[(i, word, int((level == i).sum())) for i, word in enumerate(LEVELS)],
        flags=[
            (
                name.replace("_", " "),
                sum(int(((flags(d) & bit) > 0).sum()) for d in products),
                LEVELS[severity],
                meaning,
            )
            for name, (bit, severity, meaning) in QUALITY_FLAGS.items()
            if raised & bit
        ],
        numbers=key_numbers(products),
        without=len(batches) - int(np.concatenate([has_profile(dataset) for dataset in products]).sum()),
        panels=marked(panels),
        batches=shown,
        columns=COLUMNS,
        rows=[] if days else _table(products),
        documents=documents,
        software=software(products),
        method=METHOD,
    )


def write_report(
    datasets: Dataset | Iterable[Dataset],
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
    most_batches: int = 6,
) -> list[Path]:
    """Write the report of one or more products; what stood under a name is replaced only when the page is complete.

    Batches of more than :data:`DAYS` days (of the site, where its time zone is known) have a page a day,
    ``NAME-2012-09-14.html``, and ``NAME.html`` is their index.

    Parameters
    ----------
    datasets, title, most_batches
        As in :func:`render`.
    path : path-like
        File to write; its folder is made where it is missing.

    Returns
    -------
    list of Path
        The files; the first is the one to open.
    """
    target, products = Path(path), listed(datasets)
    by_day = _by_day(products)
    if len(by_day) <= DAYS:
        return [_write(target, render(products, title=title, most_batches=most_batches))]
    found = []
    for name, parts in by_day.items():
        page = target.with_name(f"{target.stem}-{name}{target.suffix}")
        of_day = f"{title or heading(products)}: {name}"
        _write(page, render(parts, title=of_day, most_batches=most_batches, back=target.name))
        level = np.concatenate([levels(part) for part in parts])
        means = [path_mean(part, i)[0] for part in parts for i in range(part.sizes["time"])]
        known = [mean for mean in means if np.isfinite(mean)]
        found.append(
            Day(name, page.name, level.size, tuple(int((level == i).sum()) for i in range(3)),  # type: ignore[arg-type]
                float(np.median(known)) if known else float("nan"))
        )  # fmt: skip
    index = _write(target, render(products, title=title, days=found))
    return [index, *(target.with_name(day.file) for day in found)]


#: Up to so many days of batches stand on one page.
DAYS = 2


def _by_day(products: Sequence[Dataset]) -> dict[str, list[Dataset]]:
    """Batches by the day, at the site where its time zone is known, on which they start."""
    found: dict[str, list[Dataset]] = {}
    for dataset in products:
        zone = site_zone(products[0].attrs)
        names = [clock(int(time), *([] if zone is None else [zone]))[:10] for time in bounds(dataset)[:, 0]]
        for name in dict.fromkeys(names):
            found.setdefault(name, []).append(dataset.isel(time=[i for i, day in enumerate(names) if day == name]))
    return dict(sorted(found.items()))


def heading(products: Sequence[Dataset]) -> str:
    """What a report is called by default."""
    campaigns = dict.fromkeys(str(dataset.attrs.get("campaign", "unnamed campaign")) for dataset in products)
    return f"Cn² along the line of sight: {', '.join(campaigns)}"


def _write(target: Path, text: str) -> Path:
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(text.encode("utf-8"))
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
    return target
