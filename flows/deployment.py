"""Campaigns that are processed again and again: a schedule that picks up new archives."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING, Any

from .settings import Unavailable, load

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from prefect.deployments.runner import RunnerDeployment


def deployment(campaigns: Sequence[Path], name: str, every: float | None, **parameters: Any) -> RunnerDeployment:
    """The flow `reprocess` with its parameters and its schedule.

    Parameters
    ----------
    campaigns : sequence of pathlib.Path
        Campaign files.
    name : str
        Name of the deployment.
    every : float or None
        Seconds from one start to the next; None for no schedule.
    **parameters
        Of :func:`coslidar.flows.campaign.reprocess`.

    Returns
    -------
    RunnerDeployment

    Raises
    ------
    InputError
        A campaign file cannot be used.
    """
    from prefect.client.schemas.objects import ConcurrencyLimitConfig, ConcurrencyLimitStrategy
    from prefect.types.entrypoint import EntrypointType

    from .campaign import reprocess

    for path in campaigns:
        load(path)
    return reprocess.to_deployment(  # type: ignore[return-value]
        name=name,
        interval=None if every is None else timedelta(seconds=every),
        # A run that takes longer than the interval is not joined by another one on the same archives.
        concurrency_limit=ConcurrencyLimitConfig(limit=1, collision_strategy=ConcurrencyLimitStrategy.CANCEL_NEW),
        parameters={"campaigns": [str(path.resolve()) for path in campaigns], **parameters},
        description="Profiles of every archive of these campaigns that the catalog has none of.",
        entrypoint_type=EntrypointType.MODULE_PATH,
    )


def serve(made: RunnerDeployment) -> None:
    """Run a deployment's flows in processes of this machine until interrupted."""
    import logging
    import warnings

    from prefect import serve as listen

    # Noise of Prefect's own when it is told to stop, which it does all the same.
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", message="coroutine 'Runner.astop'", category=RuntimeWarning)
    # Paused, so that runs that nobody started do not pile up until the next time.
    listen(made, pause_on_shutdown=True, print_starting_message=False, limit=1)


def deploy(made: RunnerDeployment, pool: str) -> str:
    """Register a deployment for the workers of a pool.

    Returns
    -------
    str
        Identity of the deployment.

    Raises
    ------
    Unavailable
        The server has no such pool.
    """
    from prefect.client.orchestration import get_client
    from prefect.exceptions import ObjectNotFound

    with get_client(sync_client=True) as client:
        try:
            client.read_work_pool(pool)
        except ObjectNotFound as error:
            raise Unavailable(
                f"the Prefect server has no work pool '{pool}'; make one with "
                f"'prefect work-pool create --type process {pool}', and start 'prefect worker start --pool {pool}' on "
                "the machine that sees the archives"
            ) from error
    return str(made.apply(work_pool_name=pool))
