"""Commands for schedules: serve and deploy."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ...pipeline.units import parse

if TYPE_CHECKING:
    from collections.abc import Callable


def _scheduled(command: Callable[..., Any]) -> Callable[..., Any]:
    """Arguments and options that name what to process, and when."""
    for decorate in (
        click.option("--name", default="coslidar", show_default=True, help="Name of the deployment."),
        click.option(
            "--every", metavar="DURATION", default="10 min", show_default=True,
            help="Time from one start to the next; 'never' for starts by hand only.",
        ),
        click.argument(
            "campaigns", metavar="CAMPAIGN.toml...", nargs=-1, required=True,
            type=click.Path(exists=True, dir_okay=False, path_type=Path),
        ),
    ):  # fmt: skip
        command = decorate(command)
    return command


def _seconds(every: str) -> float | None:
    from ..settings import InputError

    if every == "never":
        return None
    try:
        seconds = parse(every, "s", key="--every")
    except ValueError as error:
        raise InputError([str(error)]) from error
    if seconds < 1:
        raise InputError([f"--every {every}: it must be at least '1 s'"])
    return seconds


@click.command()
@_scheduled
def serve(campaigns: tuple[Path, ...], every: str, name: str) -> None:
    """Process campaigns again and again on this machine, so that new archives are picked up.

    A run computes only what the catalog does not have. Patterns of the campaign file (archives = ['raw/*.zarr.zip'])
    are looked up each time. Write recordings under another name and rename them when they are complete.

    Example:  coslidar serve campaign.toml --every "10 min"

    With PREFECT_API_URL the runs show on that server, else on one that lives as long as this command. Ctrl-C ends it.
    """
    from ..deployment import deployment
    from ..deployment import serve as listen
    from ..progress import counted
    from ..server import server

    seconds = _seconds(every)
    # An interrupt is how it is meant to end.
    with suppress(KeyboardInterrupt), server(schedules=True) as ready:
        url = ready()
        made = deployment(campaigns, name, seconds)
        when = "started by hand" if seconds is None else f"every {every}"
        click.echo(f"coslidar: serving {counted(len(campaigns), 'campaign')}, {when}; Prefect API at {url}", err=True)
        listen(made)
    click.echo("coslidar: serving no more; what was finished is kept", err=True)


@click.command()
@_scheduled
@click.option("--pool", required=True, help="Work pool whose workers run the flows.")
def deploy(campaigns: tuple[Path, ...], every: str, name: str, pool: str) -> None:
    """Register campaigns with a Prefect server, to be run by the workers of a work pool.

    The server is the one of PREFECT_API_URL, and the pool must be there: prefect work-pool create --type process
    turbulence. Then coslidar deploy campaign.toml --pool turbulence --every "1 h", and on the machine that sees the
    archives: prefect worker start --pool turbulence.
    """
    from ..deployment import deploy as register
    from ..deployment import deployment
    from ..server import server
    from ..settings import InputError

    seconds = _seconds(every)
    if not os.environ.get("PREFECT_API_URL"):
        raise InputError(["PREFECT_API_URL is not set; a deployment needs a server that stays: give its address"])
    with server() as ready:
        ready()
        register(deployment(campaigns, name, seconds), pool)
    click.echo(f"reprocess/{name} is registered; start it now with: prefect deployment run reprocess/{name}")
