"""Command that puts two products side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import OUT
from .results import catalog, existing, find

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
    from ...catalog.export.files import ExportError
    from ...catalog.products import open_product
    from ...catalog.query_times import utc_text
    from ...catalog.report.difference import write_difference
    from ...catalog.report.two_lineages import differences, summary_rows
    from ...pipeline.units import safe
    from ..settings import InputError

    products: list[Any] = []
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
        try:
            write_difference(products, rows[batch]["batches"], labels, output)
        except (ExportError, OSError) as error:
            raise InputError([f"{output}: the figure cannot be written: {error}"]) from error
        click.echo(output)
