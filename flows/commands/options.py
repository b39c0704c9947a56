"""Options that several commands share: which catalog, and which of its products and batches."""

from __future__ import annotations

from pathlib import Path

import click

OUT = click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("results"),
    show_default=True,
    help="Folder of the catalog.",
)
SINCE = click.option("--from", "since", metavar="TIME", help="Batches that start at or after it, as 2012-09-14T14:00Z.")
UNTIL = click.option("--to", "until", metavar="TIME", help="Batches that start before it, as 2012-09-14T18:00+02:00.")
LINEAGE = click.option("--lineage", metavar="KEY", help="Products of this lineage, by the first digits of its key.")
