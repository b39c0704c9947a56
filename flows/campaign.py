"""Prefect: one flow per campaign, one task per archive.

The rule of this module: if it can be tested without Prefect, it lives elsewhere. Nothing is computed or decided here.
Results, retries and resuming are the catalog's business; Prefect's caching and result storage stay off.
"""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.concurrency.sync import concurrency
from prefect.exceptions import CancelledRun, TerminationSignal
from prefect.states import Cancelled, Completed, Failed
from prefect.task_runners import ThreadPoolTaskRunner
from prefect.utilities.annotations import unmapped

from .artifacts import ProgressTable, link_report
from .cancelling import Cancellation
from .driver import ArchiveOutcome, Stopped, Work, execute, process_archive
from .run import session
from .settings import InputError, Settings, Unavailable, load

if TYPE_CHECKING:
    from collections.abc import Callable


#: Limit on the server that bounds the archives in flight of all runs: prefect gcl create coslidar-archive --limit N.
LIMIT = "coslidar-archive"
#: How long to wait for a turn before looking whether the run is to stop; after how long a dead run loses its turn; s.
TURN, LEASE = 5.0, 60.0


@task(name="archive", task_run_name="{url}", cache_policy=NO_CACHE, persist_result=False)
def archive_task(url: str, work: Work) -> State[ArchiveOutcome]:
    """Process one archive when it is its turn; its state says what became of it."""
    with ExitStack() as turn:
        # Not a tag of the task: Prefect would wait for its turn for ever, and hear of no interrupt.
        while not work.stopping.is_set():
            try:
                turn.enter_context(concurrency(LIMIT, timeout_seconds=TURN, lease_duration=LEASE))
                break
            except TimeoutError:
                continue
        outcome = process_archive(url, work)
    words = f"{outcome.status}: {outcome.batches - outcome.failed_batches} of {outcome.batches} batches"
    if outcome.status in ("refused", "failed"):
        return Failed(message="; ".join(outcome.faults)[:2000], data=outcome)
    if outcome.status == "cancelled":
        return Cancelled(message=words, data=outcome)
    return Completed(message=words, data=outcome)


def in_tasks(process: Callable[[str, Work], ArchiveOutcome], archives: list[str], work: Work) -> list[ArchiveOutcome]:
    """Fan out archives as Prefect tasks."""
    try:
        futures = archive_task.map(archives, work=unmapped(work))
        outcomes: list[ArchiveOutcome] = []
        for future in futures:
            future.wait()
            outcome = future.state.result(raise_on_failure=False)
            if isinstance(outcome, BaseException):
                raise outcome
            outcomes.append(outcome)
    except BaseException:
        # Prefect waits for its tasks before anybody else hears of this.
        work.stopping.set()
        raise
    return outcomes


def processing_flow(settings: Settings, work: Work) -> list[ArchiveOutcome]:
    """Run the archives of opened settings as one flow run.

    Parameters
    ----------
    settings : Settings
        Names the campaign and bounds how many archives are in flight.
    work : Work
        What the archives share.

    Returns
    -------
    list of ArchiveOutcome
    """

    @flow(
        name="coslidar",
        flow_run_name=f"{settings.campaign or 'archives'}",
        task_runner=ThreadPoolTaskRunner(max_workers=settings.run.archives_at_once),  # type: ignore[arg-type]
        validate_parameters=False,
        persist_result=False,
    )
    def campaign() -> list[ArchiveOutcome] | State[None]:
        with ProgressTable(work.progress, "progress"), Cancellation(work):
            try:
                return execute(work, settings.archives, in_tasks)
            except Stopped:
                return Cancelled(message="cancelled; what was finished is kept")

    try:
        return campaign()  # type: ignore[return-value]
    except (TerminationSignal, CancelledRun) as error:
        # Prefect's names for SIGTERM while a flow runs, and for a flow run that was cancelled on its server.
        raise KeyboardInterrupt from error


@flow(name="reprocess", persist_result=False, validate_parameters=False)
def reprocess(
    campaigns: list[str], output: str | None = None, assignments: list[str] | None = None, report: bool = True
) -> State[dict[str, int]]:
    """Process campaign files one after the other; the entry point of deployments.

    What a catalog has already is not computed again, so a schedule picks up what is new. One bad campaign never
    stops the others.

    Parameters
    ----------
    campaigns : list of str
        Campaign files, readable where the flow runs.
    output : str, optional
        Folder of the catalog instead of the files' own.
    assignments : list of str, optional
        ``table.key=value`` on top of each file.
    report : bool
        Write ``report.html`` beside the catalog, and link it from the flow run.

    Returns
    -------
    State
        Number of archives by outcome; failed where an archive or a campaign was refused or failed.
    """
    from ..catalog.products import open_product
    from ..catalog.report import write_report

    counts: Counter[str] = Counter()
    faults: list[str] = []
    for name in campaigns:
        try:
            settings = load(Path(name), output=Path(output) if output else None, assignments=assignments or [])
            with session(settings) as work, ProgressTable(work.progress, "progress"):
                outcomes = execute(work, settings.archives, in_tasks)
        except (InputError, Unavailable) as error:
            counts["campaign refused"] += 1
            faults += getattr(error, "faults", [str(error)])
            continue
        counts.update(outcome.status for outcome in outcomes)
        faults += [fault for outcome in outcomes for fault in outcome.faults]
        made = [outcome.product for outcome in outcomes if outcome.product]
        if report and made and any(outcome.status == "published" for outcome in outcomes):
            write_report([open_product(path) for path in made], page := settings.output / "report.html")
            link_report(page)
    words = ", ".join(f"{number} {status}" for status, number in sorted(counts.items())) or "no archive"
    if faults:
        return Failed(message=f"{words}: {'; '.join(faults)}"[:2000], data=dict(counts))
    return Completed(message=words, data=dict(counts))
