"""From a product back to what made it."""

from __future__ import annotations

from pathlib import Path

import click

from .options import OUT


@click.command()
@click.argument("product", metavar="KEY")
@OUT
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="File to write instead of printing."
)
def show(product: str, out: Path, output: Path | None) -> None:
    """Print the lineage of the product KEY (beginning of its key, or its name) as a campaign file.

    'coslidar show KEY -o again.toml; coslidar run again.toml' makes the product again, in a catalog of its own. With
    the same software it is the same file, byte for byte; with other versions of packages or another commit, which
    stand in its provenance, all but the provenance is the same. What is known to differ is said at the top.
    """
    from ..reproduce import campaign_file
    from ..settings import InputError
    from .results import existing, find

    with existing(out) as opened:
        row = find(opened, product)
        url, header = opened.recording(row)
        text = campaign_file(opened.open(row), url, header)
    if output is None:
        click.echo(text, nl=False)
        return
    if output.exists():
        raise InputError([f"{output} is there already; name another file"])
    output.write_text(text, encoding="utf-8")
    click.echo(f"{output} is ready. Next: coslidar run {output}")
