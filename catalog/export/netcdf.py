"""Products as NetCDF4 after CF-1.11 and ACDD-1.3.

One exception to CF cannot be helped: UDUNITS, the judge of CF units, has no fractional exponents. It refuses
``m^(-2/3)`` and reads ``m-2/3`` as something else without a word. The default writes the unit as it is; `strict` leaves
it out of ``units`` and says it in ``comment``. ACDD wants a standard name for every variable; CF has none for most of
what we have, and we invent none.
"""

from __future__ import annotations

import os
import re
from collections.abc import Hashable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ...pipeline.units import QuantityError, parse, safe
from ..products import TIME_UNITS
from .files import ExportError, missing_package, write_whole
from .joined import join

#: What UDUNITS cannot read: powers that are no whole number.
_BEYOND_UDUNITS = re.compile(r"\^\([^)]*/")
#: Names that CF has for what is in a product.
_STANDARD_NAMES = {
    "n_frames": "number_of_observations",
    "quality_flag": "quality_flag",
    "quality_level": "status_flag",
}
#: Kinds of content after ISO 19115-1, by the beginning of a variable's name; the first that fits.
_CONTENT = (
    ("physicalMeasurement", ("cn2_path", "r0_direct", "scintillation_index_direct", "slope_correlation",
                             "intensity_correlation", "mean_flux", "zernike_variance", "log_amplitude_count")),
    ("qualityInformation", ("quality", "chi2", "stationarity", "valid", "zernike_misfit", "log_amplitude_d")),
    ("modelResult", ("cn2", "r0", "scintillation_index", "response", "averaging_kernel", "criterion", "mu")),
)  # fmt: skip
_TIMES = ("time", "time_bounds")
#: Attributes of a dataset that ACDD knows, which a user may give.
ACDD = (
    "acknowledgement", "comment", "contributor_name", "contributor_role", "creator_email", "creator_institution",
    "creator_name", "creator_type", "creator_url", "institution", "license", "metadata_link", "naming_authority",
    "processing_level", "program", "project", "publisher_email", "publisher_institution", "publisher_name",
    "publisher_type", "publisher_url", "references", "summary", "title",
)  # fmt: skip
METHOD = "Sauvage et al. 2021, Applied Optics 60 (34), 10499, https://doi.org/10.1364/AO.438170"


def export_netcdf(
    datasets: Sequence[xr.Dataset],
    path: str | os.PathLike[str],
    *,
    strict: bool = False,
    created: np.datetime64 | None = None,
    attributes: Mapping[str, str] | None = None,
) -> Path:
    """Write products as one NetCDF4 file after CF-1.11 and ACDD-1.3.

    Names of sources and of other labelled dimensions are auxiliary coordinates, as ``source_name`` (source), and time
    is the last dimension: so CF wants it. Times are microseconds since 1970 where that is exact or `strict`, else
    nanoseconds.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products; several are joined as :func:`~coslidar.catalog.export.join` does.
    path : path
        The file; replaced where it is there.
    strict : bool
        Leave out units that UDUNITS cannot read, and say them in ``comment``; round times to microseconds.
    created : datetime64, optional
        When the products were made, UTC; not said where it is absent, since a product does not know.
    attributes : mapping of str to str, optional
        Attributes of :data:`ACDD`, as ``creator_name``: who made the data, under which licence.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ExportError
        The package netCDF4 is not installed, the products do not fit together, or an attribute is not of ACDD.
    """
    try:
        import netCDF4  # noqa: F401
    except ImportError as error:
        raise missing_package("netCDF4", "netcdf", "NetCDF") from error
    for name in attributes or {}:
        if name not in ACDD:
            raise ExportError(f"{safe(name)}: no attribute that a user gives; there are: {', '.join(ACDD)}")
    written = _for_cf(join(datasets))
    written.attrs = {key: _printable(value) for key, value in written.attrs.items()}
    written.attrs |= _discovery(written, created) | dict(attributes or {})
    encoding: dict[Hashable, dict[str, Any]] = {}
    if strict:
        rounded = {name: written[name].values.astype("datetime64[us]").astype("datetime64[ns]") for name in _TIMES}
        written = written.assign(
            {name: (written[name].dims, values, written[name].attrs) for name, values in rounded.items()}
        )
    exact = not (written["time_bounds"].values.astype(np.int64) % 1000).any()
    for key, variable in written.variables.items():
        # Attributes of one variable must not reach the dataset it was copied from.
        variable.attrs = dict(variable.attrs)
        encoding[key] = {"_FillValue": None}
        if variable.dtype.kind == "M":
            units = TIME_UNITS.replace("nano", "micro") if exact else TIME_UNITS
            encoding[key] |= {"units": units, "calendar": "standard", "dtype": "int64"}
        elif variable.dtype.kind == "f" and key not in written.coords and key != "z_bounds":
            encoding[key] = {"_FillValue": np.nan}
        if variable.dtype.kind not in "UT" and variable.ndim > 1:
            encoding[key] |= {"zlib": True, "complevel": 4}
        for flags in ("flag_masks", "flag_values"):
            if flags in variable.attrs:
                variable.attrs[flags] = np.asarray(variable.attrs[flags], dtype=variable.dtype)
        if strict and _BEYOND_UDUNITS.search(variable.attrs.get("units", "")):
            unit = variable.attrs.pop("units")
            variable.attrs["comment"] = f"in {unit}, a unit that UDUNITS cannot read"
    target = Path(path)
    write_whole(
        target, lambda temporary: written.to_netcdf(temporary, engine="netcdf4", format="NETCDF4", encoding=encoding)
    )
    return target


def _for_cf(dataset: xr.Dataset) -> xr.Dataset:
    """Labels as auxiliary coordinates, time last, bounds without attributes of their own, kinds of content."""
    labels = [str(name) for name in dataset.coords if dataset[name].dtype.kind in "UT"]
    dataset = dataset.drop_indexes(labels).rename_vars({name: f"{name}_name" for name in labels})
    variables = {}
    for key, variable in dataset.data_vars.items():
        name = str(key)
        changed = variable.variable.copy(deep=False)
        changed.attrs = dict(variable.attrs)
        if name in ("time_bounds", "z_bounds"):
            changed.attrs = {}
        else:
            changed = changed.transpose(..., "time", missing_dims="ignore")
            changed.attrs["coverage_content_type"] = _content(name)
            if name in _STANDARD_NAMES:
                changed.attrs["standard_name"] = _STANDARD_NAMES[name]
        variables[name] = changed
    dataset = dataset.assign(variables)
    for key in dataset.coords:
        dataset[key].attrs["coverage_content_type"] = "coordinate"
    for name, value, unit in _place(dataset.attrs):
        attributes = {"long_name": f"{name} of the pupil", "standard_name": name, "units": unit}
        dataset = dataset.assign({name: ((), value, attributes | {"coverage_content_type": "coordinate"})})
    # Seconds since 1970 as computers count them: days of 86400 s.
    dataset["time"].attrs["units_metadata"] = "leap_seconds: none"
    return dataset


def _content(name: str) -> str:
    for kind, beginnings in _CONTENT:
        if name.startswith(beginnings) and not name.endswith(("_model", "_kolmogorov")):
            return kind
    return "modelResult" if name.endswith(("_model", "_kolmogorov")) else "auxiliaryInformation"


def _printable(value: Any) -> Any:
    """Text without what would end it early or steer a terminal; numbers and lists as they are."""
    if isinstance(value, str):
        return "".join(c if c.isprintable() else " " for c in value)
    return [_printable(item) for item in value] if isinstance(value, (list, tuple)) else value


def _discovery(dataset: xr.Dataset, created: np.datetime64 | None) -> dict[str, Any]:
    """What ACDD-1.3 wants to find, as far as the products know."""
    attributes = dataset.attrs
    bounds = dataset["time_bounds"].values.astype("datetime64[us]")
    keys = attributes["lineage_key"]
    keys = [keys] if isinstance(keys, str) else list(keys)
    made = f"coslidar {version('coslidar')}"
    found: dict[str, Any] = {
        "Conventions": "CF-1.11, ACDD-1.3",
        "id": "+".join(keys),
        "naming_authority": "coslidar.lineage",
        "summary": (
            "Profiles of the refractive index structure parameter Cn2 along a line of sight, with error bars, "
            "averaging kernels, the correlations of slopes and scintillation that they were retrieved from, and checks."
        ),
        "keywords": "optical turbulence, refractive index structure parameter, Cn2, scintillation, Shack-Hartmann, "
        "CO-SLIDAR",
        "source": f"Shack-Hartmann recording of {attributes.get('instrument', 'an unnamed instrument')}",
        "history": f"retrieved and written to NetCDF by {made}; lineage and provenance hold every step",
        "references": METHOD,
        "project": str(attributes["campaign"]),
        "processing_level": "profiles retrieved from correlations of slopes and fluxes",
        "comment": "CF has no standard names for most of these quantities; long names say what they are.",
        "time_coverage_start": f"{bounds.min()}Z",
        "time_coverage_end": f"{bounds.max()}Z",
        "time_coverage_duration": _duration(bounds.max() - bounds.min()),
        "time_coverage_resolution": _duration(np.median(bounds[:, 1] - bounds[:, 0]).astype("timedelta64[us]")),
    }
    if created is not None:
        found["date_created"] = f"{created.astype('datetime64[s]')}Z"
    place = _place(attributes)
    for name, value, unit in place:
        short = f"geospatial_{name[:3]}"
        found |= {f"{short}_min": value, f"{short}_max": value, f"{short}_units": unit}
    if place:
        found["geospatial_bounds"] = "POINT ({:.7g} {:.7g})".format(*(value for _, value, _ in place))
        found["geospatial_bounds_crs"] = "EPSG:4326"
    return found


def _place(attributes: Mapping[Any, Any]) -> list[tuple[str, float, str]]:
    """Name, value and unit of the coordinates of the instrument; empty where the products do not know them."""
    try:
        return [
            (name, parse(attributes[f"site_{name}"], "deg"), unit)
            for name, unit in (("latitude", "degrees_north"), ("longitude", "degrees_east"))
        ]
    except (KeyError, QuantityError):
        return []


def _duration(length: Any) -> str:
    """ISO 8601 duration of a timedelta64."""
    return f"PT{int(length.astype('timedelta64[us]').astype(np.int64)) / 1e6:.6f}".rstrip("0").rstrip(".") + "S"


__all__ = ["ACDD", "export_netcdf"]
