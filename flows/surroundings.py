"""From the campaign file to the surroundings of one archive: files read, heights taken, weights known."""

from __future__ import annotations

from functools import lru_cache
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..catalog.elevation import read_transect
from ..catalog.series import Reading, SeriesError, read_series
from ..pipeline.beam_heights import scaled_weights, sight_heights
from ..pipeline.optical_parameters import fried_weights
from ..pipeline.scintillometer import slice_weights
from ..pipeline.surroundings import Instrument, Surroundings
from ..pipeline.terrain import Beam, Transect, beam_above_ground, heights
from ..pipeline.units import safe
from .settings import InputError

if TYPE_CHECKING:
    from ..pipeline.geometry import SliceGrid
    from ..pipeline.parameters import Header, SeriesFile
    from ..pipeline.timeseries import TimeSeries
    from .settings import Settings

#: Points at which the height of the line of sight is taken over a terrain.
POINTS = 200


@lru_cache(maxsize=64)
def _read(files: tuple[tuple[str, int, int], ...], reading: tuple[object, ...]) -> TimeSeries:
    """Read once for all archives of a campaign; sizes and times of the files tell when they have changed."""
    columns, units, timezone, interval, stamp = reading
    how = Reading(dict(columns), dict(units), timezone, interval, stamp)  # type: ignore[call-overload, arg-type]
    return read_series([Path(name) for name, _, _ in files], how)


def series_of(given: SeriesFile, folder: Path, key: str, origin: str) -> TimeSeries:
    """Read the files of a series.

    Parameters
    ----------
    given : SeriesFile
        What the campaign file says.
    folder : pathlib.Path
        Where relative paths begin.
    key, origin : str
        Place in the campaign file, for messages.

    Returns
    -------
    TimeSeries

    Raises
    ------
    InputError
        With every fault.
    """
    pattern = str(folder / given.file)
    names = sorted(glob(pattern)) if any(character in given.file for character in "*?[") else [pattern]
    if not names:
        raise InputError(
            [f"{origin}: {key}.file = '{safe(given.file)}': no file matches; looked in {safe(str(folder))}"]
        )
    missing = [name for name in names if not Path(name).is_file()]
    if missing:
        raise InputError([f"{origin}: {key}.file: {safe(name)}: there is no such file" for name in missing])
    files = tuple((name, Path(name).stat().st_size, Path(name).stat().st_mtime_ns) for name in names)
    reading = (
        tuple(sorted(given.columns.items())),
        tuple(sorted(given.units.items())),
        given.timezone,
        given.interval,
        given.stamp,
    )
    try:
        return _read(files, reading)
    except SeriesError as error:
        raise InputError([f"{origin}: {key}: {fault}" for fault in error.faults]) from error


def with_heights(header: Header, settings: Settings) -> Header:
    """The header with the heights of the line of sight above the terrain of the campaign, if it has one.

    Raises
    ------
    InputError
        The terrain cannot be read, or is in the way.
    """
    terrain = settings.surroundings.terrain
    if terrain is None:
        return header
    length = header.path.length
    if not np.isfinite(length):
        raise InputError([f"{settings.origin}: terrain: the path is infinite; a transect needs a finite one"])
    try:
        transect = read_transect(settings.folder / terrain.file, length, terrain.pupil, terrain.sources)
    except SeriesError as error:
        raise InputError([f"{settings.origin}: terrain: {fault}" for fault in error.faults]) from error
    beam = beam_above_ground(transect, length, terrain.pupil_height or 0.0, terrain.sources_height or 0.0)
    beam = Beam(
        length,
        beam.start if terrain.pupil_elevation is None else terrain.pupil_elevation,
        beam.end if terrain.sources_elevation is None else terrain.sources_elevation,
        terrain.refraction,
    )
    own = transect.distance[(transect.distance > 0) & (transect.distance < length)]
    z = np.unique(np.concatenate([np.linspace(0, length, POINTS + 1), own]))
    above = heights(Transect(np.clip(transect.distance, -np.inf, np.inf), transect.elevation), beam, z)
    above = np.where(np.isnan(above), np.interp(z, z[np.isfinite(above)], above[np.isfinite(above)]), above)
    if (above <= 0).any():
        at = z[np.argmin(above)]
        raise InputError(
            [
                f"{settings.origin}: terrain: the line of sight runs {-above.min():.1f} m below the ground at "
                f"{at:.0f} m; check heights, elevations and the direction of the transect (distances from the pupil)"
            ]
        )
    pairs = tuple((float(a), float(h)) for a, h in zip(z, above, strict=True))
    return header.model_copy(update={"path": header.path.model_copy(update={"heights": pairs})})


def surroundings_of(header: Header, grid: SliceGrid, settings: Settings, start: int, stop: int) -> Surroundings | None:
    """What is known around the path of one archive.

    Parameters
    ----------
    header : Header
        Of the archive, with heights.
    grid : SliceGrid
        Slices of its profiles.
    settings : Settings
        Campaign.
    start, stop : int
        Time that the archive covers, ns since 1970 UTC; series are cut to it.

    Returns
    -------
    Surroundings or None
        None where the campaign says nothing of them.

    Raises
    ------
    InputError
        A series cannot be read, or fluxes are wanted and the height is not known.
    """
    weather = settings.surroundings.meteorology
    length = header.path.length
    if weather is None and not header.scintillometers and header.path.heights is None:
        return None
    faults: list[str] = []
    found: dict[str, TimeSeries] = {}
    wanted = {f"scintillometers[{number}].series": one.series for number, one in enumerate(header.scintillometers)}
    for key, given in ({"meteorology": weather} | wanted).items():
        if given is not None:
            try:
                found[key] = series_of(given, settings.folder, key, settings.origin).within(start, stop)
            except InputError as error:
                faults += error.faults
    sight = sight_heights(header.path, grid)
    high = None if sight is None else sight.effective
    if weather is not None and high is None:
        faults.append(
            f"{settings.origin}: meteorology: heat fluxes need the height above ground; give path.height, "
            "path.heights, or a table [terrain]"
        )
    if weather is not None and "meteorology" in found:
        lacking = [name for name in ("temperature", "pressure") if name not in found["meteorology"].values]
        faults += [
            f"{settings.origin}: meteorology.file: there is no {name}; name its column, columns = {{ {name} = '…' }}"
            for name in lacking
        ]
    for number in range(len(header.scintillometers)):
        key = f"scintillometers[{number}].series"
        if key in found and "cn2" not in found[key].values:
            faults.append(f"{settings.origin}: {key}.file: there is no cn2; name its column, columns = {{ cn2 = '…' }}")
    instruments = []
    for number, one in enumerate(header.scintillometers):
        try:
            weights = slice_weights(grid, one.ends(length), *one.diameters, one.wavelength)
            scaled_weights(one, length, grid, weights, sight)
        except ValueError as error:
            faults.append(f"{settings.origin}: scintillometers[{number}]: {error}")
    if faults:
        raise InputError(faults)
    for number, one in enumerate(header.scintillometers):
        near, far = one.ends(length)
        series = found.get(f"scintillometers[{number}].series")
        instruments.append(Instrument(one.name, series, far - near, one.diameters, one.wavelength))
    return Surroundings(
        wavelength=header.instrument.wavelength,
        heights=high,
        meteorology=found.get("meteorology"),
        parameters=weather,
        instruments=tuple(instruments),
        model_weights=fried_weights(grid, length),
    )
