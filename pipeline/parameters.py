"""The typed configuration of the science stages, and the header of a raw archive.

Every model is frozen and refuses unknown keys (the header keeps them, as its format demands). Values with a
dimension are text with a unit outside and floats in SI units inside; see :mod:`coslidar.pipeline.units`.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping
from contextvars import ContextVar
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationInfo,
    field_validator,
    model_validator,
)

from .band import Band
from .geometry import Geometry, SliceGrid
from .units import (
    Angle,
    Duration,
    Electrons,
    Frequency,
    Gain,
    Length,
    Level,
    PathLength,
    Pixels,
    Quantity,
    QuantityError,
    Wavelength,
    parse,
    text,
)

#: Format of raw archives that this version reads and writes.
FORMAT, FORMAT_VERSION = "shwfs-frames", 1
#: Longest text in a header.
MAX_TEXT = 1000
#: Deepest nesting of a header.
MAX_DEPTH = 20
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


class Parameters(BaseModel):
    """Frozen parameters that refuse unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, use_attribute_docstrings=True)


class BatchParameters(Parameters):
    """The averaging window of the science."""

    duration: Duration = Field(default="3 min", gt=0)  # type: ignore[assignment]
    """Length of a batch; an archive is cut into batches from its first frame on."""
    minimum: float = Field(default=0.5, ge=0, le=1)
    """A remainder at the end of an archive becomes a batch of its own if it is at least this fraction of
    `duration`; shorter, it is left out. An archive shorter than one batch is one batch."""


class ExtractionParameters(Parameters):
    """How slopes and fluxes are measured on the frames."""

    method: Literal["subpixel_window", "moving_maximum", "thresholded", "weighted", "template"] = "subpixel_window"
    """`subpixel_window`: window with fractional edge weights re-centred on its own centroid;
    `moving_maximum`: whole-pixel window centred on the brightest pixel (Sauvage et al. 2021, section 3.2);
    `thresholded`: centroid of what exceeds a part of the brightest pixel; `weighted`: centroid under a Gaussian weight
    that follows it; `template`: fit of the mean spots of both sources. The flux is the plain sum over the window, or
    that of the fit."""
    window_x: Pixels | None = Field(default=None, gt=0)
    """Width of the window along x; as large as box and sources allow where it is absent."""
    window_y: Pixels | None = Field(default=None, gt=0)
    """Height of the window along y; as large as the other source allows where it is absent."""
    wings: Literal["removed", "kept"] = "removed"
    """Of `subpixel_window` with two sources: whether what the mean spot of the other source has in the window is taken
    off flux and centroid."""
    gain: Literal["reported", "corrected"] = "reported"
    """Response of the slopes to a known tilt of the mean spot, along each axis for each source: recorded only, or
    recorded and divided out."""
    passes: int = Field(default=3, ge=1, le=20)
    """How often window, threshold, weight or fit are re-centred on the position that they gave."""
    threshold: float = Field(default=0.1, ge=0, lt=1)
    """Of `thresholded`: part of the brightest pixel in the window."""
    weight_fwhm: Pixels | None = Field(default=None, gt=0)
    """Of `weighted`: full width at half maximum of the weight; twice that of the spot where it is absent."""
    search: Pixels = Field(default="4 pixel", ge=1)  # type: ignore[assignment]
    """How far from its mean position a spot is looked for, along each axis."""
    reference_frames: int = Field(default=256, ge=1)
    """Frames whose mean gives the fine position of the spots: those at the start of a batch, or the first so many in
    which both sources are lit."""
    follow: Pixels = Field(default="1 pixel", gt=0)  # type: ignore[assignment]
    """The spots are found again once those of a source have moved so far, on average over `reference_frames`."""


#: Sources whose data are used -> their places in the header.
SOURCES_USED = {"both": (0, 1), "first": (0,), "second": (1,)}


class CorrelationParameters(Parameters):
    """What is correlated, and how the noise of the correlation maps is estimated."""

    sources: Literal["both", "first", "second"] = "both"
    """Sources whose data are used. With one there is no triangulation: the profile rests on the shape of the
    scintillation."""
    covariance: Literal["lagged", "independent"] = "lagged"
    """`lagged`: frames correlated in time, as they are; `independent`: as if no frame knew of the next
    (Sauvage et al. 2021)."""
    vibration: Literal["absorbed", "subtracted"] = "absorbed"
    """`absorbed`: the vibration line stays in the slope maps, for the inversion's constant to take up; `subtracted`:
    its variance and that of its harmonics are taken off every entry of the four slope maps (Sauvage et al. 2021,
    section 4.2). Recorded always."""
    flux_trend: Frequency | None = Field(default=None, gt=0)
    """Changes of a source's light slower than this, common to all subapertures, are divided out; nothing is where it is
    absent."""


#: Most points of a tabulated band.
_MAX_BAND = 2000


class BandParameters(Parameters):
    """Spectral weight of the detector, linear between the given wavelengths.

    Written as `"3.4 um:4.2 um"` (flat), as a table with `wavelength` and `weight`, or as a table with `file` and `unit`
    (on the command line `"file=filter.csv,unit=um"`): text with a wavelength in that unit and a weight on each line.
    """

    wavelength: tuple[Wavelength, ...]
    """Increasing wavelengths."""
    weight: tuple[Annotated[float, Field(ge=0, allow_inf_nan=False)], ...] = ()
    """Counts per wavelength interval at each of them, in any unit; flat where it is absent."""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any) -> Any:
        if isinstance(data, str):
            if "=" in data:
                data = dict(part.strip().split("=", 1) for part in data.split(",") if "=" in part)
            else:
                data = {"wavelength": [part.strip() for part in data.split(":")]}
        if not isinstance(data, dict):
            raise ValueError("write '3.4 um:4.2 um', or a table with wavelength and weight, or one with file and unit")
        if "file" not in data:
            if "unit" in data:
                raise ValueError("unit belongs to a file; wavelengths in a table carry their own, '3.4 um'")
            return data
        if set(data) != {"file", "unit"}:
            raise ValueError("a band from a file has the keys file and unit and no other, unit = 'um' for example")
        path = str(data["file"])
        try:
            values = np.loadtxt(path, delimiter="," if path.endswith(".csv") else None, ndmin=2)
        except (OSError, ValueError) as error:
            raise ValueError(f"'{path}' cannot be read as lines of a wavelength and a weight ({error})") from error
        if values.shape[1] != 2:
            raise ValueError(f"'{path}' must hold two columns, wavelength and weight; it has {values.shape[1]}")
        # The path is dropped: a band built from its own values is the same band.
        wavelengths = [f"{wavelength!r} {data['unit']}" for wavelength in values[:, 0].tolist()]
        return {"wavelength": wavelengths, "weight": values[:, 1].tolist()}

    @model_validator(mode="after")
    def _usable(self) -> BandParameters:
        if not 2 <= len(self.wavelength) <= _MAX_BAND:
            raise ValueError(f"a band has 2 to {_MAX_BAND} wavelengths, not {len(self.wavelength)}; '3.4 um:4.2 um'")
        self.band()
        return self

    def band(self) -> Band:
        """The weight as the response takes it."""
        return Band(self.wavelength, self.weight or (1.0,) * len(self.wavelength))

    def text(self) -> str:
        """The band in a few words."""
        low, high = (text(value * 1e6, "um") for value in (self.wavelength[0], self.wavelength[-1]))
        return f"{low} to {high}, {'weighted' if len(set(self.weight)) > 1 else 'flat'}"


class ResponseParameters(Parameters):
    """The linear model that turns a Cn2 profile into correlation maps."""

    slices: int = Field(default=12, ge=1, le=200)
    """Number of equal slices between pupil and sources."""
    sampling: Literal["mean", "midpoint"] = "mean"
    """Response averaged over each slice, or taken at its mid-point."""
    slope_response: Literal["centroid", "printed"] = "centroid"
    """With the scintillation of the source's points in the centroid, or as printed in the paper."""
    aperture: Literal["square", "circular"] = "square"
    """Shape of a subaperture, whose side or diameter is the header's `subaperture_size`."""
    tilt: Literal["gradient", "zernike"] = "gradient"
    """What a slope is: the mean gradient over the subaperture, as the centre of gravity sees it, or the tilt of the
    best-fitting plane, as the peak of a sharp spot does."""
    band: BandParameters | None = None
    """Spectral weight of the detector; the header's wavelength alone where it is absent."""
    scintillation: Literal["first_order", "extended_rytov"] = "first_order"
    """Scintillation of weak turbulence, or corrected for moderate strength in several rounds of inversion."""
    extent: Length | None = Field(default=None, gt=0)
    """Where the slices end; required for sources at infinity, the path length where it is absent."""

    def grid(self, geometry: Geometry) -> SliceGrid:
        """Slices for a geometry.

        Raises
        ------
        ValueError
            The path is infinite and `extent` is absent, or `extent` lies beyond the sources.
        """
        end = self.extent if self.extent is not None else geometry.path_length
        if math.isinf(end):
            raise ValueError("response.extent is missing: the path is infinite; say where the slices end, '10 km'")
        if end > geometry.path_length:
            raise ValueError(f"response.extent = {end:g} m lies beyond the sources at {geometry.path_length:g} m")
        return SliceGrid.uniform(end, self.slices)

    def options(self, geometry: Geometry) -> dict[str, Any]:
        """Arguments of :func:`~coslidar.pipeline.response.response_matrix` beside geometry, slices and plugins.

        Raises
        ------
        ValueError
            The band does not hold the wavelength of the geometry, or a correction does not know its path.
        """
        if self.band is not None and not self.band.wavelength[0] <= geometry.wavelength <= self.band.wavelength[-1]:
            raise ValueError(
                f"response.band = '{self.band.text()}' does not hold instrument.wavelength = "
                f"'{text(geometry.wavelength * 1e6, 'um')}'; one of them is wrong"
            )
        if self.scintillation == "extended_rytov" and geometry.infinite:
            raise ValueError(
                "response.scintillation = 'extended_rytov' is for spherical waves, but the path is infinite; "
                "write 'first_order'"
            )
        return {
            "sampling": self.sampling,
            "slope_response": self.slope_response,
            "aperture": self.aperture,
            "tilt": self.tilt,
            "band": None if self.band is None else self.band.band(),
        }

    def tracked(self) -> dict[str, Any]:
        """What of them decides the response of given slices."""
        return self.model_dump(exclude={"slices", "extent"})


class InversionParameters(Parameters):
    """What is inverted, what is estimated beside the profile, and which profile is reported."""

    estimator: Literal["map", "posterior_mean"] = "map"
    """`map`: the most probable profile (Sauvage et al. 2021); `posterior_mean`: the mean of all profiles that are
    possible, weighted with their probability. Both are held at Cn2 >= 0."""
    subset: Literal["all", "slopes", "scintillation", "auto", "cross"] = "all"
    """Part of the correlation maps that is used."""
    noise_bias: Literal["joint", "none"] = "joint"
    """Detection noise on the zero separation of each auto-correlation map."""
    flux_noise: Literal["measured", "joint"] = "measured"
    """Where `noise_bias` is `joint`, that of the fluxes: `measured` from dark pixels and photons and subtracted, or one
    more unknown. It is known to a few per cent, while as an unknown it takes up whatever else distinguishes the zero
    separation, the most informative datum of the scintillation."""
    slope_offset: Literal["joint", "none"] = "joint"
    """One constant per slope axis: vibration, finite record, wind shake."""


class Configuration(Parameters):
    """Everything that changes a number, apart from the plugins."""

    batch: BatchParameters = BatchParameters()
    extraction: ExtractionParameters = ExtractionParameters()
    correlation: CorrelationParameters = CorrelationParameters()
    response: ResponseParameters = ResponseParameters()
    inversion: InversionParameters = InversionParameters()


def overlay(base: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested tables; lists of tables are merged item by item, everything else is replaced."""
    merged = dict(base)
    for key, value in above.items():
        below = merged.get(key)
        if isinstance(value, dict) and isinstance(below, dict):
            merged[key] = overlay(below, value)
        elif (
            isinstance(value, list)
            and isinstance(below, list)
            and len(value) == len(below)
            and all(isinstance(item, dict) for item in [*value, *below])
        ):
            merged[key] = [overlay(*pair) for pair in zip(below, value, strict=True)]
        else:
            merged[key] = value
    return merged


# --- header of a raw archive -------------------------------------------------------------------------------

_angular: ContextVar[bool] = ContextVar("_angular", default=False)


class _SourceQuantity(Quantity):
    """A length, or an angle where the path is infinite."""

    def read(self, value: object) -> float:
        return Quantity("rad" if _angular.get() else "m").read(value)

    def note(self) -> str:
        return " (path.length is infinite)" if _angular.get() else ""


SourceLength = Annotated[float, _SourceQuantity("m")]


def _name(value: str) -> str:
    if not _NAME.fullmatch(value):
        raise ValueError("use 1 to 100 letters, digits, '.', '_' and '-', beginning with a letter or digit")
    return value


Name = Annotated[str, AfterValidator(_name)]
#: Text of a header; its length is judged with that of all other texts, see :func:`text_faults`.
Text = str
Pixel = Annotated[float, Field(strict=False, allow_inf_nan=False)]


def _time_zone(value: str) -> str:
    from zoneinfo import ZoneInfo

    try:
        ZoneInfo(value)
    except (ValueError, OSError, KeyError) as error:
        raise ValueError("no such time zone; write for example 'Europe/Paris' or 'UTC'") from error
    return value


#: Name of a time zone, as in the IANA data base.
TimeZone = Annotated[str, AfterValidator(_time_zone)]


class HeaderPart(BaseModel):
    """Part of a header: frozen, unknown keys kept and handed on."""

    model_config = ConfigDict(frozen=True, extra="allow", use_attribute_docstrings=True)


class Site(HeaderPart):
    """Where the instrument stands."""

    name: Text | None = None
    latitude: Annotated[float, Quantity("deg")] | None = Field(default=None, ge=-90, le=90)
    longitude: Annotated[float, Quantity("deg")] | None = Field(default=None, ge=-180, le=360)
    timezone: TimeZone | None = None


class Instrument(HeaderPart):
    """Shack-Hartmann sensor and its detector."""

    wavelength: Wavelength = Field(gt=0)
    frame_rate: Frequency = Field(gt=0)
    pixel_scale: Angle = Field(gt=0)
    subaperture_size: Length = Field(gt=0)
    subaperture_mask: tuple[tuple[Literal[0, 1], ...], ...]
    lenslet_origin: tuple[int, int]
    lenslet_pitch: tuple[int, int]
    name: Text | None = None
    exposure: Duration | None = Field(default=None, gt=0)
    gain: Gain | None = Field(default=None, gt=0)
    read_noise: Electrons | None = Field(default=None, ge=0)
    saturation: Level | None = Field(default=None, gt=0)

    @field_validator("subaperture_mask")
    @classmethod
    def _mask(cls, mask: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
        if not mask or not mask[0] or any(len(row) != len(mask[0]) for row in mask):
            raise ValueError("the mask must be a rectangle of 0 and 1, one row of lenslets per line")
        if len(mask) > 64 or len(mask[0]) > 64:
            raise ValueError("at most 64 x 64 lenslets are supported")
        if not any(any(row) for row in mask):
            raise ValueError("no lenslet is exploited; write 1 for each that is")
        return mask

    @field_validator("lenslet_pitch")
    @classmethod
    def _pitch(cls, pitch: tuple[int, int]) -> tuple[int, int]:
        if min(pitch) < 3:
            raise ValueError("a lenslet box must be at least 3 pixels along each axis")
        return pitch


class Path(HeaderPart):
    """Line of sight."""

    length: PathLength = Field(gt=0)
    height: Length | None = None
    """Mean height above ground."""
    heights: tuple[tuple[Length, Annotated[Length, Field(gt=0)]], ...] | None = None
    """(z, height of the line of sight above ground at z), z from the pupil and increasing."""

    @field_validator("heights")
    @classmethod
    def _increasing(cls, heights: tuple[tuple[float, float], ...] | None) -> tuple[tuple[float, float], ...] | None:
        if heights is not None and (len(heights) < 2 or any(a[0] >= b[0] for a, b in pairwise(heights))):
            raise ValueError("list at least two pairs of distance and height, with increasing distance from the pupil")
        return heights


class SeriesFile(Parameters):
    """Where a series of another instrument is, and what its files do not say."""

    file: str = Field(min_length=1, max_length=MAX_TEXT)
    """Path or pattern, beside the campaign file: Scintec ``.mnd``, NetCDF (``.nc``), or CSV with units."""
    columns: dict[str, str] = {}
    """Quantity -> column, where the names of the columns do not tell."""
    units: dict[str, str] = {}
    """Quantity -> unit, where the file has none or a wrong one."""
    timezone: str | None = Field(default=None, max_length=100)
    """Of times without an offset: `Europe/Paris`, `UTC+1`."""
    interval: Duration | None = Field(default=None, gt=0)
    """Length of the intervals; the most frequent step of the times where it is absent."""
    stamp: Literal["start", "middle", "end"] | None = None
    """What of its interval a time stamp means."""


class Scintillometer(HeaderPart):
    """A large-aperture scintillometer on the same path, for comparison."""

    # A header hands on what it does not know; a misspelt key of a campaign file would be lost without a word.
    model_config = ConfigDict(extra="forbid", validate_default=True)

    name: Text
    wavelength: Wavelength = Field(gt=0)
    diameters: tuple[Annotated[Length, Field(gt=0)], Annotated[Length, Field(gt=0)]]
    """Of its apertures, at the pupil's end and at the sources' end."""
    start: Length = "0 m"  # type: ignore[assignment]
    """Distance of the aperture at the pupil's end from the pupil."""
    end: Length | None = None
    """Distance of the aperture at the sources' end from the pupil; that of the sources where it is absent."""
    offset: Length = "0 m"  # type: ignore[assignment]
    """Lateral distance of its path from the line of sight, positive to the right of who looks from the pupil to the
    sources. It is told beside the comparison and changes no number: turbulence counts as uniform across the path."""
    heights: tuple[Annotated[Length, Field(gt=0)], Annotated[Length, Field(gt=0)]] | None = None
    """Of its beam above the ground, at the pupil's end and at the sources' end."""
    height_scaling: Literal["none", "free_convection"] = "none"
    """Whether each slice of a profile is carried from the height of the line of sight to that of the beam, as
    h^(-4/3)."""
    transmitter: Literal["pupil", "sources"] = "sources"
    """End at which it emits; it does not matter to the weighting, and names the diameter that alpha belongs to."""
    series: SeriesFile | None = None
    """What it measured."""

    @field_validator("height_scaling")
    @classmethod
    def _heights_to_scale_to(cls, scaling: str, info: ValidationInfo) -> str:
        # Not of the whole model, which is not looked at while any of its keys is wrong. Wrong heights are not in data.
        if scaling != "none" and info.data.get("heights", ()) is None:
            raise ValueError("it needs heights, those of the beam above the ground at both of its ends")
        return scaling

    def ends(self, path_length: float) -> tuple[float, float]:
        """Distances of both apertures from the pupil, m."""
        return self.start, path_length if self.end is None else self.end

    @property
    def reference(self) -> float:
        """Diameter of the transmitter, m."""
        return self.diameters[0 if self.transmitter == "pupil" else 1]


class Source(HeaderPart):
    """One source of light."""

    name: Text
    position: tuple[SourceLength, SourceLength]
    """(x, y) in m, or as angles where the path is infinite."""
    fwhm: tuple[Annotated[SourceLength, Field(ge=0)], Annotated[SourceLength, Field(ge=0)]]
    """Full width at half maximum along x and y."""
    spot: tuple[Pixel, Pixel]
    """Nominal (row, col) of the spot in a lenslet box, in pixels."""


def text_faults(attributes: object) -> list[str]:
    """What is too long or nested too deeply in a header, whatever the keys are called."""
    found = []

    def walk(value: object, key: str, depth: int) -> None:
        if depth > MAX_DEPTH:
            found.append(f"{key[:MAX_TEXT]} is nested more than {MAX_DEPTH} levels deep")
        elif isinstance(value, str) and len(value) > MAX_TEXT:
            found.append(f"{key} holds {len(value)} characters; at most {MAX_TEXT} are allowed")
        elif isinstance(value, Mapping):
            for name, item in value.items():
                walk(item, f"{key}.{name}" if key else str(name)[:MAX_TEXT], depth + 1)
        elif isinstance(value, (list, tuple)):
            for number, item in enumerate(value):
                walk(item, f"{key}[{number}]", depth + 1)

    walk(attributes, "", 0)
    return found


def spot_faults(attributes: Mapping[str, Any]) -> list[str]:
    """Spots outside their lenslet box, as far as the header can be read."""
    try:
        rows, cols = (float(size) for size in attributes["instrument"]["lenslet_pitch"])
        spots = [tuple(float(x) for x in source["spot"]) for source in attributes["sources"]]
        return [
            f"sources[{number}].spot = [{row:g}, {col:g}] lies outside the lenslet box of {rows:g} x {cols:g} pixels"
            for number, (row, col) in enumerate(spots)
            if not (-0.5 <= row < rows - 0.5 and -0.5 <= col < cols - 0.5)
        ]
    except (KeyError, TypeError, ValueError):
        return []  # the fields say what is wrong with themselves


class Header(HeaderPart):
    """Attributes of a raw archive, format 1."""

    format: Literal["shwfs-frames"]
    format_version: Literal[1]
    campaign: Name
    archive: Name
    instrument: Instrument
    path: Path
    sources: tuple[Source, ...]
    site: Site | None = None
    scintillometers: tuple[Scintillometer, ...] = ()

    @model_validator(mode="wrap")
    @classmethod
    def _dimension_of_sources(cls, data: Any, handler: ModelWrapValidatorHandler[Header]) -> Header:
        infinite = False
        # A path.length that cannot be read has a fault of its own, reported by its field.
        with contextlib.suppress(QuantityError, KeyError, TypeError, IndexError):
            infinite = math.isinf(parse(data["path"]["length"], "m", allow_infinite=True))
        token = _angular.set(infinite)
        try:
            return handler(data)
        finally:
            _angular.reset(token)

    @field_validator("sources")
    @classmethod
    def _one_or_two(cls, sources: tuple[Source, ...]) -> tuple[Source, ...]:
        if len(sources) not in (1, 2):
            raise ValueError(f"there are {len(sources)} sources; list one or two")
        if len(sources) == 2:
            if sources[0].name == sources[1].name:
                raise ValueError(f"both sources are called '{sources[0].name}'; give each a name of its own")
            if sources[0].position == sources[1].position:
                raise ValueError("both sources are at the same position; their separation is what profiles the path")
        return sources

    @field_validator("scintillometers")
    @classmethod
    def _told_apart(cls, scintillometers: tuple[Scintillometer, ...]) -> tuple[Scintillometer, ...]:
        names = [scintillometer.name for scintillometer in scintillometers]
        if len(set(names)) < len(names):
            raise ValueError("two of them have one name; give each a name of its own")
        return scintillometers

    @model_validator(mode="after")
    def _finite_for_scintillometers(self) -> Header:
        if self.scintillometers and math.isinf(self.path.length):
            raise ValueError("scintillometers need a path of finite length")
        return self

    @model_validator(mode="after")
    def _texts_and_spots(self) -> Header:
        if faults := [*text_faults(self.model_dump()), *spot_faults(self.model_dump())]:
            raise ValueError("; ".join(faults))
        return self

    def geometry(self) -> Geometry:
        """What the response functions need of this header."""
        return Geometry(
            mask=self.instrument.subaperture_mask,
            subaperture_size=self.instrument.subaperture_size,
            path_length=self.path.length,
            wavelength=self.instrument.wavelength,
            positions=tuple(source.position for source in self.sources),
        )
