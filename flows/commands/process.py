"""Commands that process: plan and run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..options import Options
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
        click.argument("inputs", metavar="CAMPAIGN.toml... | ARCHIVE...", nargs=-1, required=True),
    ):  # fmt: skip
        command = decorate(command)
    return command


def settings_of(
    inputs: tuple[str, ...],
    out: Path | None,
    assignments: tuple[str, ...] = (),
    scheduler: str | None = None,
    **shortcuts: Any,
) -> list[Settings]:
    """Settings of a command line: one for each campaign file, or one for archives with or without a campaign file."""
    from ..settings import InputError, load

    campaigns = [Path(item) for item in inputs if item.endswith(".toml")]
    archives = [item for item in inputs if not item.endswith(".toml")]
    if len(campaigns) > 1 and archives:
        raise InputError(
            [f"{len(campaigns)} campaign files and archives are given; archives go with one campaign file"]
        )
    extra = [f"response.{key}={value}" for key, value in shortcuts.items() if value is not None]
    found, faults = [], []
    files: list[Path | None] = [*campaigns] or [None]
    for campaign in files:
        try:
            settings = load(
                campaign,
                archives=archives,
                output=out,
                assignments=[*assignments, *extra],
                scheduler=scheduler,
            )
        except InputError as error:
            faults += error.faults
            continue
        if not settings.archives:
            faults.append(f"{settings.origin}: archives names none; write archives = ['raw/*.zarr.zip']")
        found.append(settings)
    if faults:
        raise InputError(faults)
    return found


def _chosen(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options that choose among archives and batches; no number depends on them."""
    for decorate in (
        click.option("--retry-failed", is_flag=True, help="Also compute again what failed in products that are there."),
        click.option("--since", metavar="TIME", help="Only archives with frames at TIME (2012-09-14T14:00Z) or later."),
        click.option("--until", metavar="TIME", help="Only archives with frames before TIME."),
    ):
        command = decorate(command)
    return command


def options_of(since: str | None, until: str | None, retry_failed: bool, keep_going: bool = True) -> Options:
    """Options of a command line."""
    from ...catalog.query_times import TimeError, moment
    from ..options import Options
    from ..settings import InputError

    times: list[int | None] = []
    faults = []
    for option, value in (("--since", since), ("--until", until)):
        try:
            times.append(None if value is None else moment(value))
        except TimeError as error:
            faults.append(f"{option}: {error}")
    if not faults and None not in times and times[0] >= times[1]:  # type: ignore[operator]
        faults.append(f"--since {since} --until {until}: nothing lies between them; --since must be the earlier one")
    if faults:
        raise InputError(faults)
    return Options(retry_failed=retry_failed, keep_going=keep_going, since=times[0], until=times[1])


def show_plans(campaigns: list[Settings], options: Options) -> None:
    """Say what a run would reuse, read, compute and write, and how long that may take."""
    from ..cli import complain

    faults: list[str] = []
    for settings in campaigns:
        if len(campaigns) > 1:
            click.echo(f"{settings.origin}:")
        faults += _show_plan(settings, options)
    if faults:
        complain(faults)
        raise click.exceptions.Exit(2)


def _show_plan(settings: Settings, options: Options) -> list[str]:
    """The same of one campaign; what is wrong with its archives."""
    from ...catalog.archive import ArchiveError
    from ...catalog.database import is_catalog
    from ...pipeline.units import safe
    from ...plugins.registry import PluginError
    from ..estimate import forecast, lines
    from ..plan import plan_archive
    from ..settings import InputError
    from .results import existing

    faults: list[str] = []
    found, skipped = [], 0
    catalog = existing(settings.output) if is_catalog(settings.output) else None
    for url in settings.archives:
        try:
            planned = plan_archive(url, settings)
        except (ArchiveError, InputError, PluginError) as error:
            faults += error.faults
            continue
        if options.wants(planned):
            found.append(forecast(planned, settings, catalog, options))
        else:
            skipped += 1
    for line in lines(found, settings, catalog):
        click.echo(safe(line))
    if skipped:
        click.echo(f"{skipped} of {len(settings.archives)} archives lie outside the range of time")
    return faults


@click.command()
@_inputs
@_chosen
def plan(
    inputs: tuple[str, ...],
    out: Path | None,
    sampling: str | None,
    slices: int | None,
    assignments: tuple[str, ...],
    since: str | None,
    until: str | None,
    retry_failed: bool,
) -> None:
    """Show what a run would reuse, read, compute and write, and about how long that takes; nothing is computed."""
    campaigns = settings_of(inputs, out, assignments, sampling=sampling, slices=slices)
    show_plans(campaigns, options_of(since, until, retry_failed))


@click.command()
@_inputs
@_chosen
@click.option("--scheduler", metavar="ADDRESS|FILE", help="Dask cluster to compute on; this machine without.")
@click.option("--no-prefect", is_flag=True, help="Without the Prefect server: the same results, a quicker start.")
@click.option("--dry-run", is_flag=True, help="Only say what would be done, as 'coslidar plan' does.")
@click.option(
    "--keep-going/--no-keep-going", default=True, show_default=True, help="Begin other archives after one has failed."
)
@click.option("--log-json", is_flag=True, help="One JSON object a line on stderr instead of progress.")
@click.option(
    "--log-level", type=click.Choice(["debug", "info", "warning"]), help="Log records on stderr instead of progress."
)
@click.option("-q", "--quiet", is_flag=True, help="Say only what went wrong.")
def run(
    inputs: tuple[str, ...],
    out: Path | None,
    sampling: str | None,
    slices: int | None,
    assignments: tuple[str, ...],
    since: str | None,
    until: str | None,
    retry_failed: bool,
    scheduler: str | None,
    no_prefect: bool,
    dry_run: bool,
    keep_going: bool,
    log_json: bool,
    log_level: str | None,
    quiet: bool,
) -> None:
    """Turn recordings into catalogued Cn2 profiles.

    Give campaign files, which are processed one after the other, or raw archives (folders, .zip files, URLs), with or
    without one campaign file. What the catalog already holds is not computed again; a run that was interrupted goes on
    where it was. One bad archive or batch does not stop the others.
    """
    from contextlib import ExitStack

    from .. import logs
    from ..cli import interrupted
    from ..progress import say
    from ..server import server

    campaigns = settings_of(inputs, out, assignments, scheduler, sampling=sampling, slices=slices)
    options = options_of(since, until, retry_failed, keep_going)
    if dry_run:
        show_plans(campaigns, options)
        return
    logged = log_json or log_level is not None
    worst = 0
    with ExitStack() as around:
        around.enter_context(logs.shown(log_level, log_json))
        if len(campaigns) > 1 and not no_prefect:
            around.enter_context(server())()
        for settings in campaigns:
            if interrupted.is_set() or (worst and not keep_going):
                break
            if len(campaigns) > 1 and not (quiet or logged):
                say(settings.origin)
            worst = max(worst, _run_one(settings, options, not no_prefect, quiet, logged))
    if interrupted.is_set():
        # Prefect can lose the exception of a signal while it makes a flow run, and end as if nothing had been.
        raise KeyboardInterrupt
    raise click.exceptions.Exit(worst)


def _run_one(settings: Settings, options: Options, prefect: bool, quiet: bool, logged: bool) -> int:
    """Process one campaign and say what became of it; the exit code."""
    from ..cli import complain
    from ..progress import counted, progress
    from ..run import run as process
    from ..settings import InputError

    try:
        with progress(len(settings.archives), quiet, silent=logged) as watcher:
            outcomes = process(settings, watcher, prefect=prefect, options=options)
    except InputError as error:  # its catalog cannot be used; that of the next one may
        complain(error.faults)
        return 2
    published = [outcome for outcome in outcomes if outcome.status in ("published", "present")]
    if not quiet and published:
        verb = "is" if len(published) == 1 else "are"
        click.echo(f"{len(published)} of {counted(len(outcomes), 'archive')} {verb} in {settings.output}")
        source = published[0].product if settings.origin == "command line" else settings.origin
        click.echo(f"Next: coslidar report {source} -o report.html")
    if any(outcome.input_fault for outcome in outcomes):
        return 2
    return int(any(outcome.status == "failed" or outcome.failed_batches for outcome in outcomes))
