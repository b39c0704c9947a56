"""What runs are doing: from any machine that sees the catalog."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ...catalog.store import Catalog, RunRow

#: Runs in the list, and failures of one run, that are shown.
LISTED, FAILURES = 10, 20


def told(catalog: Catalog, run: RunRow, now: int) -> dict[str, Any]:
    """All that is known of a run, JSON-able; times in ns since 1970 UTC, durations in s."""
    from ...catalog.heartbeats import life

    progress: dict[str, Any] = run.progress or {}
    batches = progress.get("batches", {"todo": 0, "done": 0, "failed": 0})
    outcomes: dict[str, int] = progress.get("outcomes", {})
    total = int(progress.get("archives", run.configuration.get("archives", 0)))
    finished, begun = sum(outcomes.values()), len(progress.get("current", {}))
    spent = float(progress.get("seconds", 0.0))
    rate = batches["done"] / spent if spent > 0 else 0.0
    state = life(run, now)
    # Archives that have not begun are taken to be as long as those that have.
    mean = batches["todo"] / max(1, outcomes.get("published", 0) + outcomes.get("failed", 0) + begun)
    left = batches["todo"] - batches["done"] + mean * max(0, total - finished - begun)
    return {
        "run": run.id,
        "state": state,
        "started": run.started,
        "finished": run.finished,
        "heartbeat": run.heartbeat,
        "host": run.host,
        "process": run.pid,
        "command": run.command,
        "folder": run.configuration.get("folder"),
        "archives": {"total": total, **outcomes},
        "batches": batches,
        "frames_read": progress.get("frames", 0),
        "threads": progress.get("threads"),
        "batches_per_minute": 60 * rate,
        "seconds_left": left / rate if state == "running" and rate > 0 else None,
        "current": progress.get("current", {}),
        "failures": [
            {
                "archive": failure.archive,
                "start": failure.start,
                "reason": failure.reason.removeprefix("transient: "),
                "transient": failure.reason.startswith("transient: "),
            }
            for failure in catalog.failures(run.id)
        ],
    }


def _advice(about: dict[str, Any]) -> str | None:
    """What to do about a run that did not end well."""
    again = about["command"] if about["folder"] is None else f"cd {_quoted(about['folder'])} && {about['command']}"
    if about["state"] == "lost":
        return f"its driver is gone; what was finished is kept. Continue it with:  {again}"
    if about["state"] == "cancelled":
        return f"it was interrupted; what was finished is kept. Continue it with:  {again}"
    if about["state"] == "failed" and any(failure["transient"] for failure in about["failures"]):
        return f"what the machine or the network spoiled is tried again by:  {again}"
    if about["state"] == "failed" and any(failure["start"] is not None for failure in about["failures"]):
        return f"once the data are mended, try what failed again with:  {again} --retry-failed"
    return None


def _quoted(text: str) -> str:
    import shlex

    return shlex.quote(text)


def _ago(then: int | None, now: int) -> str:
    from ..estimate import duration

    return "never" if then is None else f"{duration(max(0.0, (now - then) / 1e9))} ago"


def text_lines(about: dict[str, Any], now: int) -> list[str]:
    """The same for people."""
    from ..estimate import duration
    from ..progress import counted
    from ..times import write_time

    archives, batches = about["archives"], about["batches"]
    outcomes = ", ".join(f"{number} {what}" for what, number in archives.items() if what != "total") or "none finished"
    rate = f"{about['batches_per_minute']:.3g} batches a minute"
    if about["threads"]:
        rate += f" on {counted(about['threads'], 'thread')}"
    said = [
        f"run {about['run'][:8]}: {about['state']}",
        f"  started    {write_time(about['started'])} on {about['host']} (process {about['process']})",
        f"  heartbeat  {_ago(about['heartbeat'], now)}"
        + ("" if about["finished"] is None else f"; ended {write_time(about['finished'])}"),
        f"  archives   {archives['total']} in all: {outcomes}",
        f"  batches    {batches['done']} of {batches['todo']} computed so far, {batches['failed']} failed; "
        f"{counted(about['frames_read'], 'frame')} read; {rate}",
    ]
    if about["seconds_left"] is not None:
        said.append(f"  time left  about {duration(about['seconds_left'])}")
    said += [
        f"  now        {name}: {one['done']} of {counted(one['todo'], 'batch')}"
        for name, one in about["current"].items()
    ]
    for failure in about["failures"][:FAILURES]:
        what = (
            failure["archive"]
            if failure["start"] is None
            else f"{failure['archive']} at {write_time(failure['start'])}"
        )
        kind = "failed for the moment" if failure["transient"] else "failed"
        said.append(f"  {kind}  {what}: {failure['reason'].removeprefix(failure['archive'] + ': ')}")
    if (more := len(about["failures"]) - FAILURES) > 0:
        said.append(f"  and {more} more; 'coslidar catalog runs --failures' lists all")
    if (advice := _advice(about)) is not None:
        said.append(f"  {advice}")
    return said


@click.command()
@click.argument("run", metavar="[CAMPAIGN.toml | RUN]", required=False)
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the catalog.  [default: output of the campaign file, or ./results]",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def status(run: str | None, out: Path | None, as_json: bool) -> None:
    """Show what a run has done: finished, skipped and failed archives with reasons, rate, time left.

    RUN is the beginning of its identity; without it the last run is shown, and one line for each of those before. A
    campaign file names the catalog. It works from any machine that sees the catalog. A run whose driver has died is
    shown as lost, with the command that continues it.
    """
    import json
    from time import time_ns

    from ...catalog.heartbeats import life
    from ...pipeline.units import safe
    from ..settings import InputError, load
    from ..times import write_time
    from .results import existing

    if run is not None and run.endswith(".toml"):
        out, run = out or load(Path(run)).output, None
    out = out or Path("results")
    now = time_ns()
    with existing(out) as opened:
        runs = opened.runs()
        if not runs:
            raise InputError([f"{safe(str(out))}: there has been no run yet; 'coslidar run' begins one"])
        found = [one for one in runs if run is None or one.id.startswith(run)]
        if not found or (run is not None and len(found) > 1):
            what = "no run begins" if not found else f"{len(found)} runs begin"
            raise InputError([f"{safe(str(out))}: {what} with '{safe(run or '')}'; 'coslidar catalog runs' lists them"])
        about = told(opened, found[-1], now)
    if as_json:
        click.echo(json.dumps(about, indent=1))
        return
    for line in text_lines(about, now):
        click.echo(safe(line))
    before = [] if run is not None else runs[-1 - LISTED : -1]
    if before:
        click.echo("before:")
    for one in reversed(before):
        click.echo(safe(f"  {one.id[:8]}  {write_time(one.started)}  {life(one, now):<9}  {one.command[:80]}"))
