"""What a run would reuse, read, compute and write, and how long that may take. Computes nothing and writes nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..catalog.kept import Kept
from ..catalog.measurements import MeasurementStore
from ..catalog.scratch import Scratch
from ..pipeline import vibration
from ..pipeline.products import FIXED_COORDINATES, INTENSITY_KINDS, QUALITY_FLAGS, SCHEMA, SLOPE_KINDS
from .cluster import cores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..catalog.store import Catalog
    from .options import Options
    from .plan import ArchivePlan, BatchWindow
    from .settings import Settings

#: Where no earlier run tells: s of one thread for a million pixels to slopes and correlations, and for one batch of
#: correlations to its profile. The chain of benchmarks/bench_chain.py on a core of 2.9 GHz.
DEFAULT_RATES = (0.0045, 0.1)
#: As many earlier runs are looked at.
RUNS = 5


@dataclass(frozen=True)
class Forecast:
    """What a run would do with one archive.

    Parameters
    ----------
    name : str
        Campaign and archive.
    key : str
        Key of its product.
    batches : int
        In all.
    present : bool
        Whether the product is there and nothing is to be done.
    finished, correlations, measurements : int
        Batches of an interrupted run that are done; batches whose kept correlations, and whose kept slopes and fluxes,
        save their frames.
    todo : int
        Batches to compute.
    frames, pixels : int
        To be read.
    bytes_written : int
        Product and what is kept beside it.
    """

    name: str
    key: str
    batches: int
    present: bool = False
    finished: int = 0
    correlations: int = 0
    measurements: int = 0
    todo: int = 0
    frames: int = 0
    pixels: int = 0
    bytes_written: int = 0


@dataclass(frozen=True)
class Rates:
    """How fast this goes.

    Parameters
    ----------
    pixel, batch : float
        s of one thread for one pixel of a frame to correlations, and for one batch of correlations to its profile.
    basis : str
        How that is known.
    """

    pixel: float
    batch: float
    basis: str


def forecast(plan: ArchivePlan, settings: Settings, catalog: Catalog | None, options: Options) -> Forecast:
    """What a run would do with one archive.

    Parameters
    ----------
    plan : ArchivePlan
        The archive under the settings.
    settings : Settings
        What to compute.
    catalog : Catalog or None
        Where results would go; None where there is none yet.
    options : Options
        What the run is to do beside.

    Returns
    -------
    Forecast
    """
    root, key, windows = settings.output.absolute(), str(plan.profile_key), plan.windows
    failed = QUALITY_FLAGS["failed"][0]
    if catalog is not None and catalog.has(plan.archive.identity, key):
        lost = any(batch.quality_flag & failed for batch in catalog.batches(lineage_key=key))
        if not (lost and options.retry_failed):
            return Forecast(plan.name, key, len(windows), present=True)
    scratch, kept = Scratch(root / "scratch"), Kept(root / "correlations")
    measured = MeasurementStore(root / "measurements")
    done = set()
    for window in windows:
        result = scratch.load(plan.result_key(window))
        if result is not None and not (options.retry_failed and result.quality_flag & failed):
            done.add(window.index)
    todo = [window for window in windows if window.index not in done]
    # A selector that looks at neighbours needs their correlations too.
    wanted = {near.index: near for window in todo for near in plan.around(window)}
    reduce = [window for window in wanted.values() if not kept.has(plan.correlation_key(window))]
    read = [window for window in reduce if not measured.has(plan.measurement_key(window))]
    frames = sum(window.stop - window.start for window in read)
    return Forecast(
        plan.name,
        key,
        len(windows),
        finished=len(done),
        correlations=len(wanted) - len(reduce),
        measurements=len(reduce) - len(read),
        todo=len(todo),
        frames=frames,
        pixels=frames * math.prod(plan.archive.frame_shape),
        bytes_written=_bytes(plan, reduce, read if settings.keeps_measurements else []),
    )


def _bytes(plan: ArchivePlan, reduced: Sequence[BatchWindow], measured: Sequence[BatchWindow]) -> int:
    """Product, correlations, slopes and fluxes; attributes and metadata are small beside them."""
    geometry = plan.geometry
    rows, cols = geometry.map_shape
    sizes = {
        "time": len(plan.windows),
        "z": plan.grid.k,
        "z_true": plan.grid.k,
        "bound": 2,
        "source": geometry.n_sources,
        "scintillometer": len(plan.header.scintillometers),
        "axis": 2,
        "axis_kind": 3,
        "slope_kind": len(SLOPE_KINDS),
        "intensity_kind": len(INTENSITY_KINDS),
        "dy": rows,
        "dx": cols,
        "log_mu_grid": len(getattr(plan.selector, "log_mu", ())),
        "frequency": len(vibration.cells(plan.header.instrument.frame_rate)),
        **{name: len(values) for name, values in FIXED_COORDINATES.items()},
    }

    def size(variable: Any) -> int:
        return math.prod(sizes.get(name, 1) for name in variable.dims) * _itemsize(variable.dtype)

    product = sum(size(variable) for variable in SCHEMA.values())
    # The noise covariance is nearly all of what is kept of a batch.
    correlation = 8 * (len(geometry.independent) ** 2 + 6 * rows * cols)
    spots = len(plan.header.sources) * geometry.n_subapertures
    frames = sum(window.stop - window.start for window in measured)
    return product + correlation * len(reduced) + frames * (8 + spots * (3 * 8 + 1))


def _itemsize(dtype: str) -> int:
    return int("".join(filter(str.isdigit, dtype))) // 8


def rates(catalog: Catalog | None) -> Rates:
    """How fast earlier runs were; what is known of another machine where there is none.

    Parameters
    ----------
    catalog : Catalog or None
        Whose runs to look at.

    Returns
    -------
    Rates
    """
    told = [] if catalog is None else [run.progress for run in catalog.runs() if run.progress]
    reading = [one for one in told if one.get("pixels")][-RUNS:]
    retrieving = [one for one in told if one.get("retrieved")][-RUNS:]
    pixel, batch = DEFAULT_RATES[0] / 1e6, DEFAULT_RATES[1]
    if reading:
        pixel = sum(one["reduce_seconds"] for one in reading) / sum(one["pixels"] for one in reading)
    if retrieving:
        batch = sum(one["retrieve_seconds"] for one in retrieving) / sum(one["retrieved"] for one in retrieving)
    if reading and retrieving:
        number = len(reading)
        basis = f"by the rates of {'the last run' if number == 1 else f'the last {number} runs'} in this catalog"
    else:
        basis = "no earlier run in this catalog tells how fast this machine is: by the rates of a core of 2.9 GHz"
    return Rates(pixel, batch, basis)


def seconds(forecasts: Sequence[Forecast], known: Rates, threads: int) -> float:
    """Time that a run may take, s."""
    work = known.pixel * sum(one.pixels for one in forecasts) + known.batch * sum(one.todo for one in forecasts)
    # No more threads help than there are batches.
    return work / max(1, min(threads, sum(one.todo for one in forecasts)))


def threads(settings: Settings, catalog: Catalog | None) -> int:
    """Threads that a run would have: those asked for, those of the cluster's last run, or this machine's cores."""
    if settings.run.scheduler is not None or settings.run.jobs is not None:
        told = [] if catalog is None else [run.progress["threads"] for run in catalog.runs() if run.progress]
        return int(told[-1]) if told else 1
    return settings.run.threads or cores()


def duration(value: float) -> str:
    """A time for people: ``"40 s"``, ``"3 min"``, ``"2 h 5 min"``."""
    if value < 90:
        return f"{max(1, round(value))} s"
    minutes = round(value / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def size(count: int) -> str:
    """An amount of data for people: ``"3.1 MB"``."""
    value, unit = float(count), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if unit == "B" or value >= 100 else f"{value:.1f} {unit}"


def lines(forecasts: Sequence[Forecast], settings: Settings, catalog: Catalog | None) -> list[str]:
    """What is to be said of a run: one line per archive, and one for all of them."""
    from .progress import counted

    said = []
    for one in forecasts:
        if one.present:
            said.append(f"{one.name}: {counted(one.batches, 'batch')}, in the catalog already")
            continue
        reused = [
            f"{number} {words}"
            for number, words in (
                (one.finished, "finished by an earlier run"),
                (one.correlations, "from kept correlations"),
                (one.measurements, "from kept slopes and fluxes"),
            )
            if number
        ]
        work = ", ".join([f"{counted(one.todo, 'batch')} to compute", *reused])
        said.append(
            f"{one.name}: {work}; "
            f"{counted(one.frames, 'frame')} to read, {size(one.bytes_written)} to write  (key {one.key[:16]})"
        )
    todo, frames = sum(one.todo for one in forecasts), sum(one.frames for one in forecasts)
    total = f"in all {counted(todo, 'batch')} to compute, {counted(frames, 'frame')} to read"
    if not todo:
        return [*said, total]
    known, parallel = rates(catalog), threads(settings, catalog)
    return [
        *said,
        f"{total}, {size(sum(one.bytes_written for one in forecasts))} to write",
        f"about {duration(seconds(forecasts, known, parallel))} on {counted(parallel, 'thread')}, {known.basis}",
    ]
