"""The command that shows a catalog in a web browser."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import click


@click.command()
@click.argument("where", metavar="[CAMPAIGN.toml | FOLDER]", type=click.Path(path_type=Path), required=False)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("results"),
    show_default=True,
    help="Folder of the catalog, where none is named.",
)
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port.  [default: a free one]")
@click.option("--open", "show", is_flag=True, help="Open it in the web browser of this machine.")
def browse(where: Path | None, out: Path, host: str, port: int, show: bool) -> None:
    """Look through a catalog in a web browser: campaigns, batches, every panel of the report, downloads.

    Give a campaign file or the folder of a catalog. Nothing is written: the database itself refuses. The page is
    served to this machine only, and only to whoever has the address with its token; Ctrl-C ends it.

    On a distant machine, leave --host alone and forward the port: 'ssh -L 8000:localhost:8000 HOST', then on HOST
    'coslidar browse --port 8000'.
    """
    from ..browser.serve import serve
    from ..settings import load
    from .results import existing

    folder = out
    if where is not None:
        folder = load(where).output if where.suffix == ".toml" else where

    def ready(address: str) -> None:
        click.echo(f"{folder} is shown at\n\n    {address}\n\nCtrl-C ends it.")
        if show:
            import webbrowser

            webbrowser.open(address)

    # An interrupt is how it is meant to end.
    with existing(folder, read_only=True) as catalog, suppress(KeyboardInterrupt):
        serve(catalog, str(folder), host=host, port=port, ready=ready)
    click.echo("The page is closed.")
