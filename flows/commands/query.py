"""Command that asks for batches."""

from __future__ import annotations

from pathlib import Path

import click

from .options import OUT
from .results import catalog, existing


def _fields() -> str:
    """All fields that can be asked for, as lines."""
    from ...catalog.query import FIELDS

    width = max(len(field.example) for field in FIELDS.values())
    return "\n".join(
        f"  {name:<14} {field.example:<{width}}  {field.meaning}; takes {field.signs}" for name, field in FIELDS.items()
    )


@catalog.command("query")
@click.argument("query", nargs=-1)
@OUT
@click.option(
    "--format",
    "form",
    type=click.Choice(["table", "csv", "json", "parquet"]),
    default="table",
    show_default=True,
    help="A table to read, or what other programs read.",
)
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="File to write (.parquet needs it)."
)
@click.option("--limit", type=click.IntRange(1), help="So many batches at most, the earliest.")
@click.option("--fields", is_flag=True, help="List every field that can be asked for, with an example.")
def catalog_query(
    query: tuple[str, ...], out: Path, form: str, output: Path | None, limit: int | None, fields: bool
) -> None:
    """Find batches by what came out of them.

    QUERY is conditions that all must hold; put it in quotes, because < and > mean something to the shell. Quantities
    have units, times a zone, names may end in *, and a list a,b means any of them. --fields lists what can be asked.

    \b
    coslidar catalog query 'campaign=lannemezan t>=2012-09-14T14:00+02:00 scint<0.3 r0>10 cm quality=good'
    coslidar catalog query 't=2012-09-14T14:20[Europe/Paris]'          the batch that holds this moment
    coslidar catalog query 'flag!=none current=yes' --format csv -o flagged.csv
    coslidar catalog query 'alias=paper-v1' --format json

    A time is written with its offset (2012-09-14T14:00+02:00, 2012-09-14T12:00Z) or its zone
    (2012-09-14T14:00[Europe/Paris]); one without is refused, and so is the hour that clocks show twice in autumn.
    """  # noqa: D301
    from ...catalog import listing
    from ...catalog.export.files import ExportError
    from ...catalog.query import QueryError
    from ..progress import counted
    from ..settings import InputError

    if fields:
        click.echo(_fields())
        return
    if form == "parquet" and output is None:
        raise InputError(["--format parquet: name a file to write with -o FILE.parquet"])
    asked = " ".join(query)
    with existing(out) as opened:
        try:
            rows = opened.query(asked, limit=limit)
        except QueryError as error:
            raise InputError(error.faults) from error
    several = len({(row.archive, row.lineage_key) for row in rows}) - len({(row.campaign, row.archive) for row in rows})
    if several > 0 and "current" not in asked:
        click.echo("coslidar: some recordings answer with several products; current=yes asks for one of each", err=True)
    try:
        if form == "parquet" and output is not None:
            listing.write_parquet(rows, output, asked)
        else:
            if form == "json":
                text = listing.as_json(rows, asked)
            else:
                text = listing.as_csv(rows) if form == "csv" else listing.table(rows)
            if output is None:
                click.echo(text, nl=False)
            else:
                output.write_text(text, encoding="utf-8")
    except ExportError as error:
        raise InputError([str(error)]) from error
    except OSError as error:
        raise InputError([f"{output}: the file cannot be written: {error.strerror}"]) from error
    if form == "table" or output is not None:
        click.echo(f"{counted(len(rows), 'batch')} in {out if output is None else output}", err=form != "table")
