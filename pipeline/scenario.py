"""Scenarios: recordings to simulate, described in a file with units, and the frames and truth that follow
from one.

A scenario has the tables of an archive's header (`site`, `instrument`, `path`, `sources`) and says what the
path, the light, the detector and mishaps are like. The same scenario and seed give the same frames, bit for
bit.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AwareDatetime, Field, ValidationError, field_validator, model_validator

from .detector import Detector, bad_pixels, lenslet_boxes, spot_profile
from .geometry import SliceGrid
from .parameters import FORMAT, FORMAT_VERSION, Header, Name, Parameters, Text
from .simulation import Strength, TurbulentField
from .turbulence import fried_parameter
from .units import (
    AngularVariance,
    Duration,
    Frequency,
    Length,
    Level,
    Quantity,
    Speed,
    TurbulenceStrength,
    faults,
    rounded,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from .protocols import SourceModel, TurbulenceSpectrum

    Floats = NDArray[np.float64]

#: Tables of a scenario that are handed to the header of its archives.
HEADER_TABLES = ("site", "instrument", "path", "sources")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

AngularSpeed = Annotated[float, Quantity("rad/s")]
Lifetime = Annotated[float, Quantity("s", infinite=True)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]
Factor = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class ScenarioError(ValueError):
    """A scenario that cannot be simulated.

    Parameters
    ----------
    faults : list of str
        One sentence each.
    """

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.faults,))


class TurbulenceParameters(Parameters):
    """The air along the path."""

    cn2: tuple[Annotated[TurbulenceStrength, Field(ge=0.0)], ...] = Field(min_length=1, max_length=200)
    """Cn2 of equal slices from the pupil to the sources."""
    wind: tuple[Speed, Speed] | tuple[tuple[Speed, Speed], ...]
    """Velocity of the air across the path, (x, y): one for all slices, or one for each."""
    extent: Length | None = Field(default=None, gt=0)
    """Where the slices end; required for sources at infinity, the path length where it is absent."""
    time: tuple[Duration, ...] = ()
    """Times after the start of the first archive, for which `factor` gives the strength."""
    factor: tuple[Factor, ...] | tuple[tuple[Factor, ...], ...] = ()
    """Factors on `cn2`, one for each of `time` or one for each time and slice; interpolated in the
    logarithm."""
    modes: int = Field(default=512, ge=16, le=100_000)
    """Fourier modes per slice."""
    lifetime: Lifetime = Field(default="1 s", gt=0)  # type: ignore[assignment]
    """How long the air keeps its structure while the wind carries it; longer ones need more modes."""
    sampling: Literal["mean", "midpoint"] = "mean"
    """Turbulence all through each slice, or in one thin layer at its mid-point."""
    slope_response: Literal["centroid", "printed"] = "centroid"
    """With the scintillation of the source's points in the centroid, or as printed in the paper."""
    statistics: Literal["linear", "lognormal"] = "linear"
    """`linear`: fluxes with exactly the covariances of first-order theory; `lognormal`: always positive,
    with its variances."""

    @model_validator(mode="after")
    def _lengths_agree(self) -> TurbulenceParameters:
        slices = len(self.cn2)
        if isinstance(self.wind[0], tuple) and len(self.wind) != slices:
            raise ValueError(f"wind is given for {len(self.wind)} slices, but cn2 for {slices}")
        if len(self.time) != len(self.factor):
            raise ValueError(f"there are {len(self.time)} times, but {len(self.factor)} factors")
        if any(b <= a for a, b in zip(self.time, self.time[1:], strict=False)):
            raise ValueError("the times must increase")
        if any(isinstance(factor, tuple) and len(factor) != slices for factor in self.factor):
            raise ValueError(f"each time needs one factor, or one for each of the {slices} slices")
        return self


class LightParameters(Parameters):
    """Light on the detector."""

    flux: tuple[Annotated[Level, Field(gt=0.0)], ...]
    """Mean flux of the spot of each source in one lenslet."""
    background: Level = Field(default="0 count", ge=0)  # type: ignore[assignment]
    """Mean light on every pixel that does not come from the sources."""
    shape: Literal["diffraction", "gaussian"] = "diffraction"
    """Image by a square subaperture with its wings, or a Gaussian core of the same width at half maximum."""


class DetectorParameters(Parameters):
    """Imperfections of the detector."""

    offset: Level = Field(default="500 count", ge=0)  # type: ignore[assignment]
    """Mean level without light."""
    offset_rms: Level = Field(default="0 count", ge=0)  # type: ignore[assignment]
    """Fixed pattern of the offset, standard deviation."""
    flat_rms: Fraction = 0.0
    """Relative differences of response between pixels, standard deviation."""
    bad_pixels: Fraction = 0.0
    """Share of dead, hot and noisy pixels, a third each."""
    calibrated: bool = True
    """Whether the archive carries dark, flat and bad pixels, or leaves them to be found."""


class VibrationParameters(Parameters):
    """A line in the spectrum of all slopes alike."""

    frequency: Frequency = Field(gt=0)
    """Frequency of the line."""
    variance: tuple[AngularVariance, AngularVariance]
    """Variance of the slopes along x and y that it causes."""

    @field_validator("variance")
    @classmethod
    def _positive(cls, variance: tuple[float, float]) -> tuple[float, float]:
        if min(variance) < 0.0:
            raise ValueError("a variance is not negative")
        return variance


class CoverParameters(Parameters):
    """A span of time in which a source is dimmed."""

    source: int = Field(ge=0, le=1)
    """Which source, counted from 0."""
    start: Duration = Field(ge=0)
    """Begin, after the start of each archive."""
    duration: Duration = Field(gt=0)
    """Length."""
    transmission: Fraction = 0.0
    """What is left of the light."""


class DisturbanceParameters(Parameters):
    """What goes wrong during a recording."""

    dropped: Fraction = Field(default=0.0, lt=1.0)
    """Share of frames that are missing."""
    frozen: Fraction = Field(default=0.0, lt=1.0)
    """Share of frames that repeat the frame before."""
    drift: tuple[AngularSpeed, AngularSpeed] | None = None
    """Common motion of all spots along x and y."""
    trend: float = Field(default=0.0, gt=-1.0, le=10.0, allow_inf_nan=False)
    """Relative change of all fluxes from the start to the end of an archive."""
    cover: tuple[CoverParameters, ...] = ()
    """Spans in which a source is dimmed or out."""


class ArchiveParameters(Parameters):
    """One recording."""

    archive: Name
    """Name of the archive."""
    start: AwareDatetime
    """Start of the first exposure, with its offset from UTC."""
    duration: Duration = Field(gt=0)
    """Length of the recording."""


class Scenario(Parameters):
    """Recordings to simulate. Read one with :func:`read`, which knows the header's rules too."""

    description: Text = ""
    """What the scenario is meant to show."""
    campaign: Name
    """Campaign of its archives."""
    seed: int = Field(ge=0, le=2**63 - 1)
    """Everything random follows from it."""
    turbulence: TurbulenceParameters
    light: LightParameters
    detector: DetectorParameters = DetectorParameters()
    vibration: VibrationParameters | None = None
    disturbances: DisturbanceParameters = DisturbanceParameters()
    codec: Literal["lz4", "zstd"] = "lz4"
    """Compression of its archives: quick, or small."""
    spectrum: dict[str, Any] = Field(default_factory=lambda: {"name": "kolmogorov"})
    """Turbulence spectrum, by name and parameters."""
    source: dict[str, Any] = Field(default_factory=lambda: {"name": "gaussian"})
    """Source model, by name and parameters; `fwhm` of the sources completes it."""
    archives: tuple[ArchiveParameters, ...] = Field(min_length=1, max_length=10_000)
    header_tables: dict[str, Any]
    """Tables of the archives' headers, as text."""

    def attributes(self, number: int) -> dict[str, Any]:
        """Header attributes of one archive, as they are written.

        Parameters
        ----------
        number : int
            Index of the archive.

        Returns
        -------
        dict
            Text with units, for :func:`coslidar.catalog.archive.write_archive`.
        """
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "campaign": self.campaign,
            "archive": self.archives[number].archive,
            **self.header_tables,
            "simulation": {"description": self.description, "seed": self.seed, "archive_number": number},
        }

    @cached_property
    def header(self) -> Header:
        """Header of the first archive; the others differ in their names."""
        return Header.model_validate(self.attributes(0))

    @cached_property
    def grid(self) -> SliceGrid:
        """Slices of the profile."""
        end = self.turbulence.extent or self.header.path.length
        return SliceGrid.uniform(end, len(self.turbulence.cn2))

    def recording(self, number: int, spectrum: TurbulenceSpectrum, sources: Sequence[SourceModel]) -> Recording:
        """Make one archive's frames available.

        Parameters
        ----------
        number : int
            Index of the archive.
        spectrum : TurbulenceSpectrum
            Spectrum of the refractive index, built from :attr:`spectrum`.
        sources : sequence of SourceModel
            One per source, built from :attr:`source`.

        Returns
        -------
        Recording
            Frames by number, times and truth.
        """
        plan, air = self.archives[number], self.turbulence
        instrument, geometry = self.header.instrument, self.header.geometry()
        count = max(1, round(plan.duration * instrument.frame_rate))
        shift = (plan.start - self.archives[0].start).total_seconds()
        cn2 = np.asarray(air.cn2)
        strength = Strength.constant(cn2)
        if air.time:
            strength = Strength(cn2, np.asarray(air.time) - shift, np.asarray(air.factor))
        # Every archive has turbulence of its own; the detector is the same one all along.
        seed = int(np.random.SeedSequence([self.seed, 2, number]).generate_state(1, np.uint64)[0])
        field = TurbulentField(
            geometry,
            self.grid,
            strength,
            np.asarray(air.wind),
            spectrum,
            sources,
            frame_rate=instrument.frame_rate,
            seed=seed,
            modes=air.modes,
            lifetime=air.lifetime,
            sampling=air.sampling,
            slope_response=air.slope_response,
            statistics=air.statistics,
        )
        random = np.random.default_rng([seed, 3])
        number_of_frame = np.arange(count)
        stays = random.random(count) < self.disturbances.frozen
        stays[0] = False
        shown = np.maximum.accumulate(np.where(stays, 0, number_of_frame))
        kept = random.random(count) >= self.disturbances.dropped
        kept[0] = True
        start = (plan.start - _EPOCH) // timedelta(microseconds=1) * 1000
        # One rounding from exact multiples: steps alternate between two neighbouring integers, and never drift.
        time = start + np.rint(number_of_frame * (1e9 / instrument.frame_rate)).astype(np.int64)
        return Recording(
            attributes=self.attributes(number),
            scenario=self,
            field=field,
            detector=self._detector(sources, seed),
            time=time[kept],
            index=shown[kept],
            n_recorded=count,
            vibration_phase=(float(random.uniform(0, 2 * np.pi)), float(random.uniform(0, 2 * np.pi))),
        )

    def _detector(self, sources: Sequence[SourceModel], seed: int) -> Detector:
        instrument, geometry, flaws = self.header.instrument, self.header.geometry(), self.detector
        pitch = instrument.lenslet_pitch
        shape = (
            instrument.lenslet_origin[0] + geometry.p * pitch[0],
            instrument.lenslet_origin[1] + geometry.q * pitch[1],
        )
        random = np.random.default_rng([self.seed, 4])
        offset = np.maximum(flaws.offset + flaws.offset_rms * random.standard_normal(shape), 0.0)
        flat = np.maximum(1.0 + flaws.flat_rms * random.standard_normal(shape), 0.1)
        return Detector(
            boxes=lenslet_boxes(geometry, instrument.lenslet_origin, pitch),
            pitch=pitch,
            spots=np.asarray([source.spot for source in self.header.sources]),
            flux=np.asarray(self.light.flux),
            profiles=np.stack(
                [spot_profile(geometry, s, instrument.pixel_scale, pitch, self.light.shape) for s in sources]
            ),
            pixel_scale=instrument.pixel_scale,
            gain=float(instrument.gain or 1.0),
            read_noise=float(instrument.read_noise or 0.0),
            background=self.light.background,
            saturation=float(instrument.saturation or 65535.0),
            offset=offset.astype(np.float32),
            flat=(flat / flat.mean()).astype(np.float32),
            bad_pixel=bad_pixels(random, shape, flaws.bad_pixels),
            seed=seed,
        )


@dataclass(frozen=True)
class Recording:
    """Frames of one archive, drawn when asked for.

    Parameters
    ----------
    attributes : dict
        Header of the archive.
    scenario : Scenario
        What it comes from.
    field : TurbulentField
        Slopes and fluxes of the turbulence.
    detector : Detector
        Draws the frames.
    time : ndarray of int64, (N,)
        Start of exposure, ns since 1970-01-01T00:00:00 UTC.
    index : ndarray of int64, (N,)
        Number of the exposure that each frame shows: larger steps where frames are dropped, none where one
        repeats.
    n_recorded : int
        Exposures from start to end, dropped ones included.
    vibration_phase : (float, float)
        Phases of the vibration along x and y at the first exposure, rad.
    """

    attributes: dict[str, Any]
    scenario: Scenario
    field: TurbulentField
    detector: Detector
    time: NDArray[np.int64]
    index: NDArray[np.int64]
    n_recorded: int
    vibration_phase: tuple[float, float]

    @property
    def n_frames(self) -> int:
        """Number of frames in the archive."""
        return self.index.size

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        rows, cols = self.detector.offset.shape
        return rows, cols

    def signals(self, start: int, stop: int) -> tuple[Floats, Floats]:
        """True motion and light of the spots of some frames, without noise.

        Parameters
        ----------
        start, stop : int
            Frames of the archive.

        Returns
        -------
        slopes : ndarray, (T, 2, S, A)
            Turbulence, vibration and drift, rad.
        flux : ndarray, (T, S, A)
            Flux over the mean flux of the scenario.
        """
        shown = self.index[start:stop]
        first = int(shown.min())
        slopes, flux = self.field.signals(first, int(shown.max()) + 1)
        slopes, flux = slopes[shown - first], flux[shown - first]
        seconds = shown / self.field.frame_rate
        vibration, mishaps = self.scenario.vibration, self.scenario.disturbances
        for axis in (0, 1):
            if vibration is not None:
                angle = 2.0 * np.pi * vibration.frequency * seconds + self.vibration_phase[axis]
                slopes[:, axis] += (np.sqrt(2.0 * vibration.variance[axis]) * np.sin(angle))[:, None, None]
            if mishaps.drift is not None:
                slopes[:, axis] += (mishaps.drift[axis] * seconds)[:, None, None]
        if mishaps.trend:
            flux *= (1.0 + mishaps.trend * shown / self.n_recorded)[:, None, None]
        for cover in mishaps.cover:
            covered = (seconds >= cover.start) & (seconds < cover.start + cover.duration)
            flux[covered, cover.source] *= cover.transmission
        return slopes, flux

    def frames(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Some frames of the archive.

        Parameters
        ----------
        start, stop : int
            Frames of the archive; what else is asked for changes nothing.

        Returns
        -------
        ndarray of uint16, (T, rows, cols)
            Raw counts.
        """
        slopes, flux = self.signals(start, stop)
        return self.detector.render(slopes, flux, self.index[start:stop])

    def truth(self, realised: Realised | None = None) -> dict[str, Any]:
        """What an analysis of this archive should find.

        Parameters
        ----------
        realised : Realised, optional
            Noise-free variances of this very recording.

        Returns
        -------
        dict
            Numbers in SI units, ready for JSON.
        """
        scenario, geometry, grid = self.scenario, self.field.geometry, self.field.grid
        cn2 = self.field.mean_profile(0, self.n_recorded)
        r0 = float(
            fried_parameter(cn2, grid, geometry.wavelength, geometry.path_length, sampling=scenario.turbulence.sampling)
        )
        tenths = np.linspace(0, self.n_recorded, 11).astype(int)
        air, vibration, gain = scenario.turbulence, scenario.vibration, self.detector.gain
        truth: dict[str, Any] = {
            "scenario": scenario.description,
            "archive": self.attributes["archive"],
            "seed": scenario.seed,
            "frames": self.n_frames,
            "path_length_m": None if geometry.infinite else geometry.path_length,
            "wavelength_m": geometry.wavelength,
            "subaperture_size_m": geometry.subaperture_size,
            "slice_edges_m": list(grid.edges),
            "z_m": grid.centres.tolist(),
            "dz_m": grid.thickness.tolist(),
            "cn2": [rounded(value) for value in cn2],
            "cn2_by_tenths_of_the_recording": [
                [rounded(value) for value in self.field.mean_profile(int(a), max(int(b), int(a) + 1))]
                for a, b in itertools.pairwise(tenths)
            ],
            "sampling": air.sampling,
            "slope_response": air.slope_response,
            "statistics": air.statistics,
            "wind_m_per_s": np.broadcast_to(np.asarray(air.wind), (grid.k, 2)).tolist(),
            "r0_m": r0 if math.isfinite(r0) else None,
            "vibration": None
            if vibration is None
            else {"frequency_Hz": vibration.frequency, "variance_rad2": list(vibration.variance)},
            "flux_counts_per_spot": list(scenario.light.flux),
            "noise_rms_counts_dark_pixel": math.sqrt(
                self.detector.background / gain + (self.detector.read_noise / gain) ** 2
            ),
            "frames_dropped": self.n_recorded - self.n_frames,
            "frames_repeated": int(np.count_nonzero(np.diff(self.index) == 0)),
        }
        if realised is not None:
            truth["of_this_record"] = realised.summary()
        return truth


class Realised:
    """Noise-free variances of a recording, added up while its frames are drawn."""

    def __init__(self) -> None:
        self._count = 0
        self._sums: Floats = np.zeros(())
        self._squares: Floats = np.zeros(())
        self._origin: Floats = np.zeros(())

    def add(self, slopes: Floats, flux: Floats) -> None:
        """Take in some frames.

        Parameters
        ----------
        slopes : ndarray, (T, 2, S, A)
            In rad.
        flux : ndarray, (T, S, A)
            Any unit.
        """
        values = np.concatenate([slopes, flux[:, None]], axis=1)
        if self._count == 0:
            # Near the mean, so that the difference of the two sums keeps its digits.
            self._origin = values.mean(axis=0)
            self._sums, self._squares = np.zeros_like(self._origin), np.zeros_like(self._origin)
        values = values - self._origin
        self._count += len(values)
        self._sums = self._sums + values.sum(axis=0)
        self._squares = self._squares + (values**2).sum(axis=0)

    def summary(self) -> dict[str, Any]:
        """Variances per source, averaged over the subapertures.

        Returns
        -------
        dict
            `sigma_I2` (1), `slope_variance_xx_rad2`, `slope_variance_yy_rad2`, each a list with one value
            per source.
        """
        shift = self._sums / self._count
        variance = self._squares / self._count - shift**2
        with np.errstate(invalid="ignore", divide="ignore"):
            index = variance[2] / (self._origin[2] + shift[2]) ** 2
        return {
            "sigma_I2": index.mean(axis=-1).tolist(),
            "slope_variance_xx_rad2": variance[0].mean(axis=-1).tolist(),
            "slope_variance_yy_rad2": variance[1].mean(axis=-1).tolist(),
        }


def read(table: Mapping[str, Any], origin: str) -> Scenario:
    """Check a scenario and complete it.

    Parameters
    ----------
    table : mapping
        Content of a scenario file.
    origin : str
        Where it comes from, for messages.

    Returns
    -------
    Scenario
        Frozen; sources without a `spot` get the one that their position gives.

    Raises
    ------
    ScenarioError
        With every fault.
    """
    found: list[str] = []
    rest = {key: value for key, value in table.items() if key not in HEADER_TABLES}
    tables = {key: table[key] for key in HEADER_TABLES if key in table}
    if "header_tables" in rest:
        found.append(f"{origin}: header_tables = …: there is no such key; check its spelling")
    scenario = None
    try:
        scenario = Scenario.model_validate({**rest, "header_tables": {}})
    except ValidationError as error:
        found += faults(error, origin)
    header = _header(tables, origin, found)
    if header is not None:
        tables["sources"] = [
            {**given, "spot": list(source.spot)}
            for given, source in zip(tables["sources"], header.sources, strict=True)
        ]
    if scenario is not None and header is not None:
        found += [f"{origin}: {fault}" for fault in _mismatches(scenario, header)]
    if found or scenario is None:
        raise ScenarioError(found)
    return scenario.model_copy(update={"header_tables": tables})


def _header(tables: Mapping[str, Any], origin: str, found: list[str]) -> Header | None:
    """Header that the tables make, spots filled in; None, and the faults added, if they make none."""
    names = {"format": FORMAT, "format_version": FORMAT_VERSION, "campaign": "scenario", "archive": "scenario"}
    sources, given = tables.get("sources"), dict(tables)
    incomplete = isinstance(sources, list) and all(isinstance(source, dict) for source in sources)
    if incomplete:
        given["sources"] = [{"spot": [0.0, 0.0], **source} for source in sources or []]
    try:
        header = Header.model_validate({**names, **given})
    except ValidationError as error:
        found += faults(error, origin)
        return None
    if not sources or all("spot" in source for source in sources):
        return header
    scale, pitch = header.instrument.pixel_scale, header.instrument.lenslet_pitch
    lever = 1.0 if math.isinf(header.path.length) else 1.0 / header.path.length
    for source, written in zip(header.sources, given["sources"], strict=True):
        x, y = source.position
        written["spot"] = [
            round((pitch[0] - 1) / 2 + y * lever / scale, 2),
            round((pitch[1] - 1) / 2 + x * lever / scale, 2),
        ]
    try:
        return Header.model_validate({**names, **given})
    except ValidationError as error:
        found += faults(error, origin)
        return None


def _mismatches(scenario: Scenario, header: Header) -> list[str]:
    """What each table allows, but both together do not."""
    found = []
    count = len(header.sources)
    if len(scenario.light.flux) != count:
        given = len(scenario.light.flux)
        found.append(f"light.flux has {given} values; give one to each of the {count} sources")
    for key in ("gain", "read_noise", "saturation"):
        if getattr(header.instrument, key) is None:
            found.append(f"instrument.{key} is missing; it is required to draw frames")
    if (header.instrument.saturation or 0.0) > 65535.0:
        found.append("instrument.saturation is above 65535 count, the largest level of the frames")
    extent, length = scenario.turbulence.extent, header.path.length
    if extent is None and math.isinf(length):
        found.append("turbulence.extent is missing: the path is infinite; say where the slices end, '10 km'")
    if extent is not None and extent > length:
        found.append(f"turbulence.extent = {extent:g} m lies beyond the sources at {length:g} m")
    for number, cover in enumerate(scenario.disturbances.cover):
        if cover.source >= count:
            place = f"disturbances.cover[{number}].source"
            found.append(f"{place} = {cover.source}: there are {count} sources, counted from 0")
    names = [plan.archive for plan in scenario.archives]
    repeated = sorted({name for name in names if names.count(name) > 1})
    found += [f"archives: the name '{name}' is used twice" for name in repeated]
    for number, plan in enumerate(scenario.archives):
        if plan.duration * header.instrument.frame_rate < 1.0:
            found.append(f"archives[{number}].duration is shorter than one frame")
    return found
