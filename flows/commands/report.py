"""Command that draws the report."""

from __future__ import annotations

from pathlib import Path

import click

from .options import LINEAGE, OUT, SINCE, UNTIL

_FORMATS = {".html": "html", ".htm": "html", ".pdf": "pdf", ".png": "png"}


@click.command()
@click.argument("inputs", metavar="CAMPAIGN.toml | PRODUCT | FOLDER", nargs=-1, required=True)
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), required=True, help="File to write.")
@click.option("--format", "form", type=click.Choice(["html", "pdf", "png"]), help="By the ending of FILE if absent.")
@SINCE
@UNTIL
@LINEAGE
@OUT
def report(
    inputs: tuple[str, ...],
    output: Path,
    form: str | None,
    since: str | None,
    until: str | None,
    lineage: str | None,
    out: Path,
) -> None:
    """Draw one self-contained page: profiles with their bars, correlation maps, criterion curves and more.

    Give a campaign file (the newest product of each of its archives), product files, names or keys in the catalog
    of --out, or the folder of a catalog. A campaign of many days gets a page for each and an index; --format pdf
    makes one document, --format png a picture of every panel.
    """
    from ...catalog import report as reports
    from ..chosen import choose
    from ..settings import InputError

    kind = form or _FORMATS.get(output.suffix.lower())
    if kind is None:
        raise InputError([f"{output.name}: no report ends so; write .html, .pdf or .png, or say --format"])
    chosen = choose(inputs, out, since=since, until=until, lineage=lineage)
    if kind == "html":
        written = reports.write_report(chosen.datasets, output, title=chosen.title)
    elif kind == "pdf":
        written = reports.write_pdf(chosen.datasets, output, title=chosen.title)
    else:
        written = reports.write_png(chosen.datasets, output)
    count = sum(dataset.sizes["time"] for dataset in chosen.datasets)
    batches = "1 batch" if count == 1 else f"{count} batches"
    if kind == "png":
        click.echo(f"{batches} in {len(written)} pictures, {written[0]} the first.")
    elif len(written) > 1:
        click.echo(f"{written[0]}: {batches} on {len(written) - 1} pages, one a day. Open it in a browser.")
    else:
        click.echo(f"{written[0]}: {batches}. Open it in a {'browser' if kind == 'html' else 'viewer'}.")
