"""What a run would do: batches, keys, and what is already there. Imports neither Dask nor Prefect."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..catalog.archive import open_archive
from ..pipeline import batch as stages
from ..pipeline import description
from ..pipeline.lineage import Key, checkout, make_key
from ..pipeline.parameters import SOURCES_USED
from ..pipeline.units import safe, text
from .patience import patiently, unreachable
from .settings import InputError
from .surroundings import surroundings_of, with_heights

if TYPE_CHECKING:
    from ..catalog.archive import Archive
    from ..pipeline.geometry import Geometry, SliceGrid
    from ..pipeline.parameters import BatchParameters, Header
    from ..pipeline.surroundings import Surroundings
    from ..plugins.contract import (
        HyperparameterSelectorBase,
        RegulariserBase,
        SourceModelBase,
        TurbulenceSpectrumBase,
    )
    from .settings import Settings


@dataclass(frozen=True)
class BatchWindow:
    """Frames of one batch.

    Parameters
    ----------
    index : int
        Number of the batch in its archive.
    start, stop : int
        First frame and one past the last.
    start_time, stop_time : int
        Time stamp of the first frame, and of the last plus one frame period; ns since 1970 UTC.
    """

    index: int
    start: int
    stop: int
    start_time: int
    stop_time: int


@dataclass(frozen=True, eq=False)
class ArchivePlan:
    """Everything that is needed to process one archive under one setting.

    Parameters
    ----------
    url : str
        Where the archive is.
    archive : Archive
        The open archive.
    header : Header
        Its header with the campaign's tables on top.
    geometry : Geometry
        From the header.
    grid : SliceGrid
        Slices of the profile.
    sources, spectrum, regulariser, selector
        Plugins; as many source models as sources are used.
    source_names : tuple of str
        Names of the sources that are used.
    windows : tuple of BatchWindow
        Batches.
    measured_key, reduction_key, response_key, profile_key : Key
        Identity of slopes and fluxes, of the correlations, of the response matrix, and of the product.
    surroundings : Surroundings or None
        Weather, heights and other instruments, where the campaign tells of them.
    """

    url: str
    archive: Archive
    header: Header
    geometry: Geometry
    grid: SliceGrid
    sources: tuple[SourceModelBase, ...]
    source_names: tuple[str, ...]
    spectrum: TurbulenceSpectrumBase
    regulariser: RegulariserBase
    selector: HyperparameterSelectorBase
    windows: tuple[BatchWindow, ...]
    measured_key: Key
    reduction_key: Key
    response_key: Key
    profile_key: Key
    surroundings: Surroundings | None = None

    @property
    def name(self) -> str:
        """Campaign and archive, for people."""
        return f"{self.header.campaign}/{self.header.archive}"

    @property
    def reach(self) -> int:
        """How many batches before and after each one the selector looks at."""
        return int(getattr(self.selector, "neighbours", 0))

    def around(self, window: BatchWindow) -> tuple[BatchWindow, ...]:
        """A batch and those around it that the selector looks at."""
        return self.windows[max(0, window.index - self.reach) : window.index + self.reach + 1]

    def measurement_key(self, window: BatchWindow) -> Key:
        """Identity of the slopes and fluxes of one batch."""
        return make_key("measurement batch", 1, tracked=window.start_time, upstream=[self.measured_key])

    def correlation_key(self, window: BatchWindow) -> Key:
        """Identity of the correlations of one batch."""
        return make_key("correlation batch", 1, tracked=window.start_time, upstream=[self.reduction_key])

    def result_key(self, window: BatchWindow) -> Key:
        """Identity of what one batch contributes to the product."""
        return make_key("profile batch", 1, tracked=window.start_time, upstream=[self.profile_key])


def batch_windows(time: np.ndarray[Any, np.dtype[np.int64]], rate: float, batch: BatchParameters) -> list[BatchWindow]:
    """Cut a recording into batches.

    Batches begin at the first frame and follow each other without overlap; a gap in the recording does not shift
    them. A remainder shorter than `minimum` of a batch is left out, unless it is all there is.

    Parameters
    ----------
    time : ndarray of int64, (T,)
        Time stamps, ns.
    rate : float
        Frame rate, Hz.
    batch : BatchParameters
        Length of a batch.

    Returns
    -------
    list of BatchWindow
    """
    period = round(1e9 / rate)
    length = round(batch.duration * 1e9)
    first = int(time[0])
    end = int(time[-1]) + period
    count = max(1, -(-(end - first) // length))
    windows: list[BatchWindow] = []
    for number in range(count):
        # Half a period of slack: a time stamp that jitters around an edge belongs to the batch it begins.
        low, high = (int(np.searchsorted(time, first + edge * length - period // 2)) for edge in (number, number + 1))
        if number == count - 1:
            high = len(time)
            if count > 1 and end - (first + number * length) < batch.minimum * length:
                break
        if high > low:
            windows.append(BatchWindow(len(windows), low, high, int(time[low]), int(time[high - 1]) + period))
    return windows


def plan_archive(url: str, settings: Settings) -> ArchivePlan:
    """Open an archive and work out its batches and keys.

    Parameters
    ----------
    url : str
        Path or URL.
    settings : Settings
        What to compute.

    Returns
    -------
    ArchivePlan

    Raises
    ------
    coslidar.catalog.archive.ArchiveError
        The archive is not sound.
    InputError
        Archive and settings do not fit each other.
    """
    # A missing chunk spoils its batch only; `inspect` calls it a fault.
    archive = patiently(lambda: open_archive(url, complete=settings.header, allow_missing=True), unreachable)
    header = archive.header
    origin = safe(url)
    if settings.campaign is not None and header.campaign != settings.campaign:
        raise InputError(
            [
                f"{origin}: campaign = '{header.campaign}': {settings.origin} is about campaign "
                f"'{settings.campaign}'; leave this archive out, or process it under a campaign file of its own"
            ]
        )
    header = with_heights(header, settings)
    configuration = settings.configuration
    geometry = header.geometry()
    used = SOURCES_USED[configuration.correlation.sources][: geometry.n_sources]
    if max(used) >= geometry.n_sources:
        raise InputError([f"{origin}: correlation.sources = 'second': this recording has one source; write 'both'"])
    geometry = replace(geometry, positions=tuple(geometry.positions[number] for number in used))
    try:
        grid = configuration.response.grid(geometry)
        configuration.response.options(geometry)
    except ValueError as error:
        raise InputError([f"{settings.origin}: {error}"]) from error
    models = settings.source_models(header, origin)
    sources = tuple(models[number] for number in used)
    spectrum, regulariser, selector = settings.spectrum(), settings.regulariser(), settings.selector()

    mark = checkout().mark
    instrument = header.instrument
    measured = make_key(
        "measurements",
        stages.MEASURE_VERSION,
        tracked={
            "extraction": configuration.extraction.model_dump(),
            "batch": configuration.batch.model_dump(),
            "detector": {
                "pixel_scale": instrument.pixel_scale,
                "frame_rate": instrument.frame_rate,
                "saturation": instrument.saturation,
                "mask": instrument.subaperture_mask,
                "origin": instrument.lenslet_origin,
                "pitch": instrument.lenslet_pitch,
                "spots": [source.spot for source in header.sources],
            },
        },
        upstream=[archive.identity],
        mark=mark,
    )
    reduction = make_key(
        "correlation",
        stages.REDUCE_VERSION,
        tracked=configuration.correlation.model_dump(),
        upstream=[measured],
        mark=mark,
    )
    responses = make_key(
        "response",
        stages.RESPONSE_VERSION,
        tracked={
            **configuration.response.tracked(),
            "edges": grid.edges,
            "mask": geometry.mask,
            "subaperture_size": geometry.subaperture_size,
            "path_length": geometry.path_length,
            "wavelength": geometry.wavelength,
            "positions": geometry.positions,
        },
        plugins={"sources": [source.identity() for source in sources], "spectrum": spectrum.identity()},
        mark=mark,
    )
    if configuration.batch.duration * instrument.frame_rate < 1:
        # Their number would be bounded by nothing.
        raise InputError(
            [
                f"{settings.origin}: batch.duration = '{text(configuration.batch.duration, 's')}': shorter than one "
                f"frame of {origin} ({text(instrument.frame_rate, 'Hz')}); write for example '3 min'"
            ]
        )
    windows = tuple(batch_windows(archive.time, instrument.frame_rate, configuration.batch))
    surroundings = surroundings_of(header, grid, settings, windows[0].start_time, windows[-1].stop_time)
    profile = make_key(
        "profile",
        stages.RETRIEVE_VERSION,
        tracked={
            **configuration.inversion.model_dump(),
            **description.tracked(header),
            **({} if surroundings is None else {"surroundings": surroundings.tracked()}),
        },
        plugins={"regulariser": regulariser.identity(), "selector": selector.identity()},
        upstream=[reduction, responses],
        mark=mark,
    )
    return ArchivePlan(
        url=url,
        archive=archive,
        header=header,
        geometry=geometry,
        grid=grid,
        sources=sources,
        source_names=tuple(header.sources[number].name for number in used),
        spectrum=spectrum,
        regulariser=regulariser,
        selector=selector,
        windows=windows,
        measured_key=measured,
        reduction_key=reduction,
        response_key=responses,
        profile_key=profile,
        surroundings=surroundings,
    )
