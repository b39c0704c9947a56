"""Products in the formats of other tools: NetCDF4, CSV, Parquet; slopes and fluxes as AOT telemetry.

Every format takes products as :func:`coslidar.catalog.open_product` gives them, in any order, and writes files that
appear under their names only when they are complete.
"""

from __future__ import annotations

from .files import ExportError, by_day, file_name
from .joined import join
from .netcdf import export_netcdf
from .tables import export_csv, export_parquet
from .telemetry import export_telemetry

__all__ = [
    "ExportError",
    "by_day",
    "export_csv",
    "export_netcdf",
    "export_parquet",
    "export_telemetry",
    "file_name",
    "join",
]
