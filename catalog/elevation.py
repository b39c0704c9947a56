"""Transects of the terrain below the line of sight: CSV with units, or a GeoTIFF and two points on the map."""

from __future__ import annotations

import csv
import math
from typing import TYPE_CHECKING

import numpy as np

from ..pipeline.terrain import EARTH, Transect
from ..pipeline.units import QuantityError, conversion, safe
from .series import SeriesError, heading_of, numbers_of

if TYPE_CHECKING:
    from pathlib import Path

#: Points of a transect that is cut out of a map.
POINTS = 400


def read_transect(
    path: Path,
    path_length: float,
    pupil: tuple[float, float] | None = None,
    sources: tuple[float, float] | None = None,
) -> Transect:
    """Read the ground below a line of sight.

    Parameters
    ----------
    path : pathlib.Path
        ``.tif``/``.tiff`` (GeoTIFF of elevations in metres), or CSV with the columns ``distance [m]``, from the pupil,
        and ``elevation [m]``.
    path_length : float
        Distance of the sources, m.
    pupil, sources : (float, float), optional
        Latitude and longitude of both ends, rad; needed with a GeoTIFF.

    Returns
    -------
    Transect

    Raises
    ------
    SeriesError
        With every fault of the file.
    """
    origin = safe(str(path))
    if not path.is_file():
        raise SeriesError([f"{origin}: there is no such file"])
    try:
        if path.suffix.lower() in (".tif", ".tiff"):
            distance, elevation = _of_map(path, origin, path_length, pupil, sources)
        else:
            distance, elevation = _of_table(path, origin)
        found = Transect(distance, elevation)
    except (OSError, UnicodeDecodeError) as error:
        raise SeriesError([f"{origin}: cannot be read: {safe(str(error))}"]) from error
    except ValueError as error:
        if isinstance(error, SeriesError):
            raise
        raise SeriesError([f"{origin}: {error}"]) from error
    # A metre beyond the last point makes no difference to the ground.
    if distance[0] > 1 or distance[-1] < path_length - 1:
        raise SeriesError(
            [
                f"{origin}: the transect runs from {distance[0]:g} m to {distance[-1]:g} m, but the line of sight "
                f"from 0 m to {path_length:g} m"
            ]
        )
    return found


def _of_table(path: Path, origin: str) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]], ...]:
    lines = [line for line in path.read_text("utf-8-sig").splitlines() if line.strip() and not line.startswith("#")]
    if len(lines) < 3:
        raise SeriesError([f"{origin}: a heading and at least two points are needed"])
    rows = list(csv.reader(lines, delimiter=max(",;\t", key=lines[0].count)))
    heads = [heading_of(cell) for cell in rows[0]]
    names = [name.lower() for name, _ in heads]
    faults = [
        f"{origin}: line of {len(row)} fields, but the heading has {len(heads)}"
        for row in rows[1:]
        if len(row) != len(heads)
    ]
    found = []
    for wanted in ("distance", "elevation"):
        if wanted not in names:
            faults.append(
                f"{origin}: no column is called '{wanted}'; it has {', '.join(safe(name) for name, _ in heads)}"
            )
            continue
        at = names.index(wanted)
        try:
            factor, offset, _ = conversion(heads[at][1] or "", "m")
        except QuantityError as error:
            faults.append(f"{origin}: unit of column '{wanted}': {error}; write '{wanted} [m]'")
            continue
        if not faults:
            found.append(numbers_of([row[at] for row in rows[1:]], wanted, origin, faults) * factor + offset)
    if faults:
        raise SeriesError(faults[:10])
    return found[0], found[1]


def _of_map(
    path: Path,
    origin: str,
    path_length: float,
    pupil: tuple[float, float] | None,
    sources: tuple[float, float] | None,
) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]], ...]:
    try:
        import rasterio
        from rasterio.warp import transform
    except ImportError as error:
        raise SeriesError(
            [f"{origin}: GeoTIFF needs rasterio; install it with pip install 'coslidar[terrain]'"]
        ) from error
    if pupil is None or sources is None:
        raise SeriesError(
            [f"{origin}: a map needs both ends; give terrain.pupil and terrain.sources as [latitude, longitude]"]
        )
    apart = great_circle(pupil, sources)
    if abs(apart / path_length - 1) > 0.02:
        raise SeriesError(
            [
                f"{origin}: terrain.pupil and terrain.sources are {apart:.0f} m apart, but path.length is "
                f"{path_length:.0f} m; check latitude and longitude"
            ]
        )
    share = np.linspace(0.0, 1.0, POINTS + 1)
    # Over kilometres, straight in latitude and longitude is a great circle to a millimetre per metre of offset.
    lat, lon = (np.degrees(pupil[axis] + share * (sources[axis] - pupil[axis])) for axis in (0, 1))
    try:
        with rasterio.open(path) as opened:
            if opened.crs is None:
                raise SeriesError([f"{origin}: the map does not say its coordinate system"])
            xs, ys = transform("EPSG:4326", opened.crs, lon.tolist(), lat.tolist())
            band = opened.read(1, masked=True).astype(np.float64).filled(np.nan)
            a, b, c, d, e, f = (~opened.transform)[:6]
    except rasterio.errors.RasterioError as error:
        raise SeriesError([f"{origin}: this is no map that can be read: {safe(str(error))}"]) from error
    x, y = np.array(xs), np.array(ys)
    # Corners of pixels are whole numbers, elevations belong to their centres.
    cols, rows = a * x + b * y + c - 0.5, d * x + e * y + f - 0.5
    j, i = np.floor(cols).astype(int), np.floor(rows).astype(int)
    inside = (i >= 0) & (j >= 0) & (i < band.shape[0] - 1) & (j < band.shape[1] - 1)
    if not inside.all():
        raise SeriesError([f"{origin}: the map does not cover the line of sight"])
    down, right = rows - i, cols - j
    upper = (1 - right) * band[i, j] + right * band[i, j + 1]
    lower = (1 - right) * band[i + 1, j] + right * band[i + 1, j + 1]
    elevation = (1 - down) * upper + down * lower
    if not np.isfinite(elevation).all():
        raise SeriesError([f"{origin}: the map has holes below the line of sight"])
    return share * path_length, elevation


def great_circle(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Distance of two points of given latitude and longitude, rad, on the mean sphere, m."""
    half = math.sin((b[0] - a[0]) / 2) ** 2 + math.cos(a[0]) * math.cos(b[0]) * math.sin((b[1] - a[1]) / 2) ** 2
    return 2 * EARTH * math.asin(math.sqrt(half))
