"""Products one after the other in time."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import xarray as xr

from ...pipeline.products import SCHEMA
from .files import ExportError, ordered


def join(datasets: Sequence[xr.Dataset]) -> xr.Dataset:
    """Put products one after the other in time.

    Parameters
    ----------
    datasets : sequence of xarray.Dataset
        Products of one geometry: the same slices, separations and sources. Their grids of mu may differ; the criterion
        is NaN where it was not computed.

    Returns
    -------
    xarray.Dataset
        Attributes that differ are lists in the order of the batches' products; `product` (time) tells which.

    Raises
    ------
    ExportError
        They do not fit together, or two of them cover the same time.
    """
    products = ordered(datasets)
    if len(products) == 1:
        return products[0]
    first = products[0]
    static = [name for name, variable in SCHEMA.items() if "time" not in variable.dims]
    for other in products[1:]:
        for name in ("z", "dy", "dx", "source", *static):
            same = (name in first.variables) == (name in other.variables)
            if same and name in first.variables:
                a, b = first[name].values, other[name].values
                same = np.array_equal(a, b, equal_nan=a.dtype.kind == "f" == b.dtype.kind)
            if not same:
                labels = [f"{d.attrs['campaign']}/{d.attrs['archive']}" for d in (first, other)]
                raise ExportError(f"{labels[0]} and {labels[1]} differ in {name}; export them to a file each")
    marked = [
        dataset.assign(product=("time", np.full(dataset.sizes["time"], number, np.int32)))
        for number, dataset in enumerate(products)
    ]
    joined = xr.concat(
        [dataset.drop_vars(static, errors="ignore") for dataset in marked],
        dim="time",
        data_vars="all",
        coords="minimal",
        compat="equals",
        join="outer",
        combine_attrs="override",
    )
    joined = joined.assign({name: first[name] for name in static if name in first}).sortby("time")
    bounds = joined["time_bounds"].values
    if (bounds[1:, 0] < bounds[:-1, 1]).any():
        raise ExportError("two of the products cover the same time; export them to a file each")
    joined["product"].attrs = {"long_name": "number of the product in the lists among the attributes", "units": "1"}
    joined.attrs = dict(first.attrs)
    for name in ("campaign", "archive", "archive_identity", "wavelength", "lineage_key"):
        values = [str(dataset.attrs[name]) for dataset in products]
        joined.attrs[name] = values if len(set(values)) > 1 else values[0]
    for name in ("lineage", "provenance"):
        joined.attrs[name] = json.dumps([json.loads(dataset.attrs[name]) for dataset in products], sort_keys=True)
    names = joined.attrs["archive"]
    joined.attrs["title"] = f"Cn2 profiles of {names if isinstance(names, str) else ', '.join(names)}"
    return joined
