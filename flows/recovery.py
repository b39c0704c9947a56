"""Does the chain find the truth? Many short recordings of one scenario, from frames to profiles, judged against it."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..pipeline import batch, strong_scintillation, turbulence
from ..pipeline.extraction import Calibration
from ..pipeline.products import Measurements
from .settings import InputError, load, with_plugin
from .simulate import CHUNK_FRAMES, recordings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from ..pipeline.geometry import SliceGrid
    from ..pipeline.products import BatchResult
    from ..pipeline.scenario import Recording, Scenario
    from .settings import Settings

    Floats = NDArray[np.float64]

#: What follows from a profile: name -> (variable of a product, its interval of 68 %).
INTEGRALS = {
    "r0": ("r0_profile", "r0_interval_68"),
    "path mean of Cn2": ("cn2_path_mean", "cn2_path_mean_interval_68"),
    "scintillation index": ("scintillation_index_profile", "scintillation_index_interval_68"),
}


class Integral(NamedTuple):
    """One number per recording, (R,), with its interval of 68 %, (R, 2), and its truth, (R,)."""

    truth: Floats
    found: Floats
    interval: Floats

    @property
    def held(self) -> float:
        """Share of the recordings whose interval holds the truth."""
        return float(_inside(self.truth, self.interval).mean())


@dataclass(frozen=True, eq=False)
class Recovery:
    """What the chain makes of R recordings of one scenario.

    Attributes
    ----------
    grid : SliceGrid
        The k slices.
    truth : ndarray, (R, k)
        Cn2 that each recording holds, m^(-2/3).
    cn2, posterior_mean : ndarray, (R, k)
        Profile and posterior mean of each.
    interval_68, interval_95 : ndarray, (R, k, 2)
        Intervals that their products state.
    error_map, error_ml : ndarray, (R, k)
        Standard errors with and without the prior.
    chi2 : ndarray, (R,)
        Reduced chi2.
    integrals : dict of str to Integral
        What follows from the profiles.
    failed : tuple of str
        Why recordings have no profile.
    """

    grid: SliceGrid
    truth: Floats
    cn2: Floats
    posterior_mean: Floats
    interval_68: Floats
    interval_95: Floats
    error_map: Floats
    error_ml: Floats
    chi2: Floats
    integrals: dict[str, Integral]
    failed: tuple[str, ...]

    @property
    def held_68(self) -> Floats:
        """Share of the recordings whose interval of 68 % holds the truth of a slice, (k,)."""
        return np.asarray(_inside(self.truth, self.interval_68).mean(axis=0))

    @property
    def held_95(self) -> Floats:
        """The same for 95 %."""
        return np.asarray(_inside(self.truth, self.interval_95).mean(axis=0))

    @property
    def held_by_bars(self) -> Floats:
        """Share of the recordings whose MAP bar, one standard error to either side, holds the truth, (k,)."""
        return np.asarray((np.abs(self.cn2 - self.truth) <= self.error_map).mean(axis=0))

    @property
    def mean_interval_68(self) -> Floats:
        """Stated interval of a single recording, mean of its ends, (k, 2)."""
        return np.asarray(self.interval_68.mean(axis=0))

    @property
    def mean_interval_95(self) -> Floats:
        """The same for 95 %."""
        return np.asarray(self.interval_95.mean(axis=0))

    @property
    def mean_within_95(self) -> NDArray[np.bool_]:
        """Where the stated interval of 95 %, mean of its ends over the recordings, holds the mean truth, (k,)."""
        return np.asarray(_inside(self.truth.mean(axis=0), self.mean_interval_95))


def _inside(values: Floats, interval: Floats) -> NDArray[np.bool_]:
    return np.asarray((interval[..., 0] <= values) & (values <= interval[..., 1]))


def settings_for(scenario: Scenario, assignments: Iterable[str] = ()) -> Settings:
    """Settings under which the chain assumes of path and light what a scenario says.

    Parameters
    ----------
    scenario : Scenario
        Its slices, sampling, form of the slopes, spectrum and source model are taken.
    assignments : iterable of str
        ``table.key=value`` on top, as for a run.

    Returns
    -------
    Settings

    Raises
    ------
    InputError
        The assignments have faults.
    """
    air, given = scenario.turbulence, tuple(assignments)
    own = [
        f"response.slices={len(air.cn2)}",
        f"response.sampling={air.sampling}",
        f"response.slope_response={air.slope_response}",
    ]
    if air.extent is not None:
        own.append(f"response.extent={air.extent!r} m")
    settings = load(assignments=[*own, *given])
    for key, plugin in (("spectrum", scenario.spectrum), ("source", scenario.source)):
        if not any(assignment.partition("=")[0].split(".")[0].strip() == key for assignment in given):
            settings = with_plugin(settings, key, dict(plugin))
    return settings


def recover(
    scenario: Scenario,
    *,
    records: int,
    seed: int = 0,
    duration: float | None = None,
    assignments: Iterable[str] = (),
    frames: bool = True,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Recovery:
    """Simulate recordings of a scenario, take each through the chain, and compare.

    Recordings are those of the scenario's first archive, one batch each, with turbulence and noise of their own.
    Frames go from the simulator to the chain without a file between, block by block.

    Parameters
    ----------
    scenario : Scenario
        What to simulate.
    records : int
        How many recordings.
    seed : int
        Seed of the first; recording i is the same however many there are.
    duration : float, optional
        Length of each, s; that of the scenario where it is absent.
    assignments : iterable of str
        Settings of the chain, ``table.key=value``.
    frames : bool
        Without, the simulator's own slopes and fluxes take the place of the frames: what is still wrong is the
        inversion's.
    threads : int, optional
        Recordings at once; one per core where absent. The result does not depend on it.
    progress : callable, optional
        Called with (recordings done, in all).

    Returns
    -------
    Recovery

    Raises
    ------
    InputError
        The settings have faults, the chain has other slices than the scenario, or every recording fails.
    """
    if duration is not None:
        first = scenario.archives[0].model_copy(update={"duration": duration})
        scenario = scenario.model_copy(update={"archives": (first, *scenario.archives[1:])})
    settings = settings_for(scenario, assignments)
    header, configuration = scenario.header, settings.configuration
    geometry, grid = header.geometry(), scenario.grid
    if geometry.n_sources > 1 and configuration.correlation.sources != "both":
        raise InputError(["correlation.sources: this experiment uses all sources of a scenario; leave it out"])
    if configuration.response.grid(geometry).edges != grid.edges:
        raise InputError(["response.slices and response.extent: a profile is compared slice by slice; leave them out"])
    sampling = configuration.response.sampling
    matrices = strong_scintillation.responses(
        geometry, grid, settings.spectrum(), settings.source_models(header, "scenario"), configuration.response
    )
    model = batch.Model(
        geometry=geometry,
        grid=grid,
        matrix=matrices["M"],
        sampling=sampling,
        regulariser=settings.regulariser(),
        selector=settings.selector(),
        inversion=configuration.inversion,
        strong=strong_scintillation.from_responses(matrices, geometry, grid, sampling),
    )

    def one(number: int) -> tuple[Floats, BatchResult]:
        own = int(np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0] >> 1)
        recording = recordings(scenario.model_copy(update={"seed": own}))[0]
        truth = recording.field.mean_profile(0, recording.n_recorded)
        try:
            measured = _measured(recording, settings) if frames else _ideal(recording)
            reduced = batch.reduce(
                measured,
                geometry,
                header.instrument.frame_rate,
                scenario.archives[0].duration,
                configuration.correlation,
            )
            return truth, batch.retrieve(reduced, model)
        except batch.BatchError as error:
            return truth, batch.failed(0, 0, str(error))

    found: list[tuple[Floats, BatchResult]] = []
    with ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        for done, outcome in enumerate(pool.map(one, range(records)), start=1):
            found.append(outcome)
            if progress is not None:
                progress(done, records)
    failed = tuple(result.reason for _, result in found if not result.values)
    good = [(truth, result.values) for truth, result in found if result.values]
    if not good:
        raise InputError([f"none of the {records} recordings gave a profile; the first says: {failed[0]}"])

    def each(name: str) -> Floats:
        return np.array([values[name] for _, values in good], dtype=np.float64)

    truth = np.array([profile for profile, _ in good])
    light = (grid, geometry.wavelength, geometry.path_length)
    true = {
        "r0": turbulence.fried_parameter(truth, *light, sampling=model.sampling),
        "path mean of Cn2": turbulence.path_average(truth, grid.thickness),
        "scintillation index": turbulence.scintillation_index(truth, model.matrix, geometry),
    }
    return Recovery(
        grid=grid,
        truth=truth,
        cn2=each("cn2"),
        posterior_mean=each("cn2_posterior_mean"),
        interval_68=each("cn2_interval_68"),
        interval_95=each("cn2_interval_95"),
        error_map=each("cn2_standard_error"),
        error_ml=each("cn2_standard_error_ml"),
        chi2=each("chi2_reduced"),
        integrals={
            name: Integral(np.asarray(true[name]), each(value), each(interval))
            for name, (value, interval) in INTEGRALS.items()
        },
        failed=failed,
    )


def _measured(recording: Recording, settings: Settings) -> Measurements:
    """Slopes and fluxes as the chain finds them on the frames."""
    detector, instrument = recording.detector, recording.scenario.header.instrument
    known = recording.scenario.detector.calibrated
    calibration = Calibration(
        dark=detector.dark if known else None,
        flat=detector.flat if known else None,
        bad_pixel=detector.bad_pixel > 0 if known else None,
        saturation=instrument.saturation,
    )
    count = recording.n_frames
    blocks = (recording.frames(start, min(start + CHUNK_FRAMES, count)) for start in range(0, count, CHUNK_FRAMES))
    return batch.measure(
        blocks, recording.time, recording.scenario.header, calibration, settings.configuration.extraction
    )


def _ideal(recording: Recording) -> Measurements:
    """Slopes and fluxes as they are, without noise."""
    slopes, flux = recording.signals(0, recording.n_frames)
    _, sources, subapertures = flux.shape
    return Measurements(
        recording.time,
        slopes,
        flux,
        np.zeros(flux.shape, dtype=np.uint8),
        flux_noise=np.zeros((sources, subapertures)),
        slope_noise=np.zeros((2, sources, subapertures)),
        centroid_gain=np.ones((2, sources)),
    )
