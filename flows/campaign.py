"""Prefect: one flow per campaign, one task per archive.

The rule of this module: if it can be tested without Prefect, it lives elsewhere. Nothing is computed or decided here.
Results, retries and resuming are the catalog's business; Prefect's caching and result storage stay off.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.exceptions import TerminationSignal
from prefect.states import Completed, Failed
from prefect.task_runners import ThreadPoolTaskRunner
from prefect.utilities.annotations import unmapped

from .driver import ArchiveOutcome, Work, execute, process_archive
from .run import session
from .settings import Settings, load

if TYPE_CHECKING:
    from collections.abc import Callable


@task(name="archive", task_run_name="{url}", cache_policy=NO_CACHE, persist_result=False)
def archive_task(url: str, work: Work) -> State[ArchiveOutcome]:
    """Process one archive; its state says what became of it."""
    outcome = process_archive(url, work)
    words = f"{outcome.status}: {outcome.batches - outcome.failed_batches} of {outcome.batches} batches"
    if outcome.status in ("refused", "failed"):
        return Failed(message="; ".join(outcome.faults)[:2000], data=outcome)
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
    def campaign() -> list[ArchiveOutcome]:
        return execute(work, settings.archives, in_tasks)

    try:
        return campaign()
    except TerminationSignal as error:
        # Prefect's name for SIGTERM while a flow runs.
        raise KeyboardInterrupt from error


@flow(name="reprocess", persist_result=False)
def reprocess(campaign_file: str, output: str | None = None, assignments: list[str] | None = None) -> int:
    """Process a campaign file; the entry point of deployments.

    Parameters
    ----------
    campaign_file : str
        Campaign file, readable where the flow runs.
    output : str, optional
        Folder of the catalog instead of the file's.
    assignments : list of str, optional
        ``table.key=value`` on top of the file.

    Returns
    -------
    int
        Number of archives that were not published.
    """
    settings = load(Path(campaign_file), output=Path(output) if output else None, assignments=assignments or [])
    with session(settings) as work:
        outcomes = execute(work, settings.archives, in_tasks)
    return sum(outcome.status in ("refused", "failed") for outcome in outcomes)
