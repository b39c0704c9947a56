"""Commands that process: plan and run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..settings import Settings


def _inputs(command: Callable[..., Any]) -> Callable[..., Any]:
    """Arguments and options that name what to process."""
    for decorate in (
        click.option(
            "--set", "assignments", multiple=True, metavar="KEY=VALUE",
            help="Set one key on top of the campaign file; may be repeated: --set batch.duration='1 min'.",
        ),
        click.option(
            "--slices", type=click.IntRange(1, 200), help="Number of equal slices (response.slices)."
        ),
        click.option(
            "--sampling", type=click.Choice(["mean", "midpoint"]),
            help="Response averaged over a slice or at its middle (response.sampling).",
        ),
        click.option(
            "--out", type=click.Path(file_okay=False, path_type=Path),
            help="Folder of the catalog.  [default: output of the campaign file, or ./results]",
        ),
        click.argument("inputs", metavar="CAMPAIGN.toml | ARCHIVE...", nargs=-1, required=True),
    ):  # fmt: skip
        command = decorate(command)
    return command


def settings_of(
    inputs: tuple[str, ...],
    out: Path | None,
    assignments: tuple[str, ...] = (),
    scheduler: str | None = None,
    **shortcuts: Any,
) -> Settings:
    """Settings of a command line: a campaign file, archives, or both."""
    from ..settings import InputError, load

    campaigns = [item for item in inputs if item.endswith(".toml")]
    archives = [item for item in inputs if not item.endswith(".toml")]
    if len(campaigns) > 1:
        raise InputError([f"{len(campaigns)} campaign files are given; process them one after the other"])
    extra = [f"response.{key}={value}" for key, value in shortcuts.items() if value is not None]
    settings = load(
        Path(campaigns[0]) if campaigns else None,
        archives=archives,
        output=out,
        assignments=[*assignments, *extra],
        scheduler=scheduler,
    )
    if not settings.archives:
        raise InputError([f"{settings.origin}: archives names none; write archives = ['raw/*.zarr.zip']"])
    return settings


@click.command()
@_inputs
def plan(
    inputs: tuple[str, ...], out: Path | None, sampling: str | None, slices: int | None, assignments: tuple[str, ...]
) -> None:
    """Show what a run would read, compute and reuse; nothing is computed and nothing written."""
    from ...catalog.archive import ArchiveError
    from ...catalog.database import is_catalog
    from ...pipeline.units import safe
    from ..cli import complain
    from ..driver import kept_correlations
    from ..plan import plan_archive
    from ..progress import counted
    from ..settings import InputError
    from .results import existing

    settings = settings_of(inputs, out, assignments, sampling=sampling, slices=slices)
    faults: list[str] = []
    frames = computed = 0
    catalog = existing(settings.output) if is_catalog(settings.output) else None
    kept = kept_correlations(settings.output.absolute())
    for url in settings.archives:
        try:
            planned = plan_archive(url, settings)
        except (ArchiveError, InputError) as error:
            faults += error.faults
            continue
        if catalog is not None and catalog.has(planned.archive.identity, planned.profile_key):
            click.echo(f"{safe(planned.name)}: {counted(len(planned.windows), 'batch')}, in the catalog already")
            continue
        new = [window for window in planned.windows if not kept.has(planned.correlation_key(window))]
        read = sum(window.stop - window.start for window in new)
        frames += read
        computed += len(planned.windows)
        click.echo(
            f"{safe(planned.name)}: {counted(len(planned.windows), 'batch')} to compute, "
            f"{len(planned.windows) - len(new)} from kept correlations, {counted(read, 'frame')} to read  "
            f"(key {str(planned.profile_key)[:16]})"
        )
    click.echo(f"in all {counted(computed, 'batch')} to compute, {counted(frames, 'frame')} to read")
    if faults:
        complain(faults)
        raise click.exceptions.Exit(2)


@click.command()
@_inputs
@click.option("--scheduler", metavar="ADDRESS|FILE", help="Dask cluster to compute on; this machine without.")
@click.option("--no-prefect", is_flag=True, help="Without the Prefect server: the same results, a quicker start.")
@click.option("-q", "--quiet", is_flag=True, help="Say only what went wrong.")
def run(
    inputs: tuple[str, ...],
    out: Path | None,
    sampling: str | None,
    slices: int | None,
    assignments: tuple[str, ...],
    scheduler: str | None,
    no_prefect: bool,
    quiet: bool,
) -> None:
    """Turn recordings into catalogued Cn2 profiles.

    Give a campaign file, raw archives (folders, .zip files, URLs), or both. What the catalog already holds is not
    computed again; a run that was interrupted goes on where it was. One bad archive or batch does not stop the others.
    """
    from ..progress import counted, progress
    from ..run import run as process

    settings = settings_of(inputs, out, assignments, scheduler, sampling=sampling, slices=slices)
    with progress(len(settings.archives), quiet) as watcher:
        outcomes = process(settings, watcher, prefect=not no_prefect)
    published = [outcome for outcome in outcomes if outcome.status in ("published", "present")]
    if not quiet and published:
        verb = "is" if len(published) == 1 else "are"
        click.echo(f"{len(published)} of {counted(len(outcomes), 'archive')} {verb} in {settings.output}")
        source = inputs[0] if inputs[0].endswith(".toml") else published[0].product
        click.echo(f"Next: coslidar report {source} -o report.html")
    if any(outcome.input_fault for outcome in outcomes):
        raise click.exceptions.Exit(2)
    if any(outcome.status == "failed" or outcome.failed_batches for outcome in outcomes):
        raise click.exceptions.Exit(1)
