"""Slopes and fluxes of a campaign's recordings, kept by a run or measured now, as AOT telemetry."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..catalog.export import export_telemetry, file_name
from ..catalog.measurements import MeasurementStore
from ..pipeline import batch as stages
from ..pipeline.extraction import Calibration
from .plan import ArchivePlan, plan_archive
from .settings import InputError, load
from .tasks import frames

if TYPE_CHECKING:
    from ..pipeline.parameters import ExtractionParameters
    from ..pipeline.products import Measurements


def export_recordings(campaign_file: Path, output: Path) -> list[Path]:
    """Write slopes and fluxes of every recording of a campaign.

    Parameters
    ----------
    campaign_file : Path
        Its settings say how slopes are measured.
    output : Path
        Folder for a file for each recording, named by site, quantity and day (and the recording where a day has
        several); or the file of the only recording.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InputError
        Several recordings for one file.
    coslidar.catalog.archive.ArchiveError
        A recording is not sound.
    """
    settings = load(campaign_file)
    if not output.is_dir() and len(settings.archives) > 1:
        raise InputError([f"{output}: the campaign has {len(settings.archives)} recordings; name an existing folder"])
    plans = [plan_archive(url, settings) for url in settings.archives]
    store = MeasurementStore(settings.output / "measurements")
    days = [str(np.datetime64(plan.windows[0].start_time, "ns").astype("datetime64[D]")) for plan in plans]
    count = Counter(days)
    written = []
    for plan, day in zip(plans, days, strict=True):
        target = output
        if output.is_dir():
            site = plan.header.site.name if plan.header.site is not None else None
            quantity = "slopes" if count[day] == 1 else f"slopes-{plan.header.archive}"
            target = output / file_name(site or plan.header.campaign, quantity, day, "fits")
        batches = measurements(plan, store, settings.configuration.extraction)
        written.append(export_telemetry(plan.header, batches, target))
    return written


def measurements(plan: ArchivePlan, store: MeasurementStore, parameters: ExtractionParameters) -> list[Measurements]:
    """Slopes and fluxes of the batches of an archive: from the store where they are kept, else from the frames."""
    archive, found = plan.archive, []
    for window in plan.windows:
        kept = store.load(plan.measurement_key(window))
        if kept is None:
            calibration = Calibration(
                dark=archive.dark,
                flat=archive.flat,
                bad_pixel=archive.bad_pixel,
                saturation=plan.header.instrument.saturation,
            )
            kept = stages.measure(
                frames(archive, window.start, window.stop),
                archive.time[window.start : window.stop],
                plan.header,
                calibration,
                parameters,
            )
        found.append(kept)
    return found
