"""What a run is to do beside its settings. Light: commands read it before anything is computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .plan import ArchivePlan


@dataclass(frozen=True)
class Options:
    """What a run is to do beside its settings; no number depends on it.

    Parameters
    ----------
    retry_failed : bool
        Also compute batches again that failed in products which are there.
    keep_going : bool
        Begin the other archives although one has failed.
    since, until : int or None
        Only archives with frames at `since` or later, and before `until`; ns since 1970 UTC.
    """

    retry_failed: bool = False
    keep_going: bool = True
    since: int | None = None
    until: int | None = None

    def wants(self, plan: ArchivePlan) -> bool:
        """Whether an archive lies in the range of time."""
        first, last = int(plan.archive.time[0]), int(plan.archive.time[-1])
        return (self.since is None or last >= self.since) and (self.until is None or first < self.until)
