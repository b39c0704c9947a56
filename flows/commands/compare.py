"""Command that puts two products side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .results import OUT, catalog, existing, find

if TYPE_CHECKING:
    from xarray import Dataset

#: Columns of the table of results, each for both products.
_RESULTS = ("mean Cn2", "r0 (cm)", "scint.", "log mu", "chi2")


@catalog.command("diff")
@click.argument("a")
@click.argument("b")
@OUT
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="Figure to write (.svg, .png or .pdf)."
)
@click.option("--batch", type=click.IntRange(0), default=0, show_default=True, help="Batch whose profiles are drawn.")
def catalog_diff(a: str, b: str, out: Path, output: Path | None, batch: int) -> None:
    """Put two products side by side: the settings in which they differ, and what came out of both.

    A and B are names, first digits of keys, or product files. Batches that overlap in time are compared.

    \b
    coslidar catalog diff demo/r0.78128ac8 demo/r0.dd832e33 -o diff.svg
    """  # noqa: D301
    from ...catalog.products import open_product
    from ...catalog.query_times import utc_text
    from ...catalog.report.two_lineages import differences, summary_rows
    from ...pipeline.units import safe
    from ..settings import InputError

    products: list[Dataset] = []
    for item in (a, b):
        if Path(item).is_file():
            products.append(open_product(Path(item)))
        else:
            with existing(out) as opened:
                products.append(opened.open(find(opened, item)))
    labels = [f"{data.attrs['archive']}.{str(data.attrs['lineage_key'])[:8]}" for data in products]
    settings = [("", *labels), *differences(*products)]
    wide, left = (min(60, max(len(row[n]) for row in settings)) for n in (0, 1))
    if len(settings) == 1:
        click.echo(f"{labels[0]} and {labels[1]} have the same settings")
    else:
        for name, of_a, of_b in settings:
            click.echo(f"{safe(name):<{wide}}  {safe(of_a) or '-':<{left}}  {safe(of_b) or '-'}".rstrip())
    rows = summary_rows(*products)
    click.echo(f"\n{'start (UTC)':<20}  " + "  ".join(f"{name:^21}" for name in _RESULTS))
    click.echo(f"{'':<20}  " + "  ".join(f"{'A':>10} {'B':>10}" for _ in _RESULTS))
    for row in rows:
        cells = [f"{text:>10}" for text in row["cells"][: 2 * len(_RESULTS)]]
        pairs = "  ".join(" ".join(cells[n : n + 2]) for n in range(0, len(cells), 2))
        click.echo(f"{utc_text(row['start']):<20}  {pairs}")
    click.echo(f"{len(rows)} batches of both overlap in time")
    if output is not None:
        if not rows:
            raise InputError([f"{output}: {a} and {b} have no batch at the same time; there is nothing to draw"])
        if batch >= len(rows):
            raise InputError([f"--batch {batch}: there are {len(rows)} pairs of batches, counted from 0"])
        _draw(products, rows[batch]["batches"], labels, output)
        click.echo(output)


def _draw(products: list[Dataset], batches: tuple[int, int], labels: list[str], output: Path) -> None:
    """Profiles of one pair of batches, and r0 of all of them over time."""
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.figure import Figure

    from ...catalog.export.files import ExportError, write_whole
    from ...catalog.report.style import BLUE, RED, figure_style
    from ...catalog.report.two_lineages import draw_two_profiles
    from ..settings import InputError

    with figure_style():
        figure = Figure(figsize=(12, 4.6), layout="constrained", facecolor="white")
        FigureCanvasAgg(figure)
        profile, series = figure.subplots(1, 2)
        draw_two_profiles(profile, products, batches, labels)
        for data, label, color, marker in zip(products, labels, (BLUE, RED), "oD", strict=True):
            bounds = data["time_bounds"].values.astype("datetime64[ns]").astype(np.int64)
            middle, length = bounds[:, 0] + np.diff(bounds)[:, 0] // 2, np.diff(bounds).mean()
            # Apart by a tenth of a batch: bars of one batch would lie on each other.
            apart = int(length * (0.05 if marker == "D" else -0.05))
            time, r0 = (middle + apart).astype("datetime64[ns]"), 100 * data["r0_profile"].values
            low, high = np.moveaxis(100 * data["r0_interval_68"].values, -1, 0)
            bars = np.nan_to_num(np.clip([r0 - low, high - r0], 0, None))
            fill = color if marker == "o" else "white"
            series.errorbar(time, r0, yerr=bars, color=color, marker=marker, mfc=fill, ls="", capsize=3, label=label)
        series.set_xlabel("time (UTC)")
        series.set_ylabel("Fried parameter $r_0$ (cm)")
        series.grid(axis="y")
        locator = AutoDateLocator()  # type: ignore[no-untyped-call]
        series.xaxis.set_major_locator(locator)
        series.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
        form = output.suffix.lstrip(".").lower()
        if form not in ("svg", "png", "pdf"):
            raise InputError([f"{output}: name a file that ends in .svg, .png or .pdf"])
        try:
            # A date in the file would make every figure another one.
            metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(form)
            write_whole(output, lambda file: figure.savefig(file, format=form, metadata=metadata))
        except (ExportError, OSError) as error:
            raise InputError([f"{output}: the figure cannot be written: {error}"]) from error
