"""What a product says of itself, as rows of the database."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .database import number, plain_text

if TYPE_CHECKING:
    from xarray import Dataset


def timezone_of(header: Mapping[str, Any] | None) -> str | None:
    """Time zone of an archive's site, where its header gives one."""
    site = (header or {}).get("site")
    zone = site.get("timezone") if isinstance(site, Mapping) else None
    return zone if isinstance(zone, str) and len(zone) <= 64 else None


def plugin_rows(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rows of the plugins that a lineage document names."""
    return [
        {
            "lineage_key": document["key"],
            "role": plain_text(role, 20),
            "number": number,
            "name": plain_text(identity["name"], 100),
            "version": identity["version"],
            "parameters": identity.get("parameters", {}),
        }
        for node in document["nodes"].values()
        for role, given in node["plugins"].items()
        for number, identity in enumerate(given if isinstance(given, list) else [given])
    ]


def batch_rows(dataset: Dataset, product_id: int) -> list[dict[str, Any]]:
    """Rows of the batches of a product: what queries ask for."""
    count = dataset.sizes["time"]

    def column(name: str) -> list[float | None]:
        if name not in dataset:
            return [None] * count
        values = np.asarray(dataset[name].values, dtype=np.float64).reshape(count, -1)
        # Of several sources the mean of those that could be measured.
        return [number(np.mean(row[np.isfinite(row)])) if np.isfinite(row).any() else None for row in values]

    bounds = dataset["time_bounds"].values.astype(np.int64)
    flags, levels = dataset["quality_flag"].values, dataset["quality_level"].values
    frames = [int(n) for n in dataset["n_frames"].values] if "n_frames" in dataset else [None] * count
    columns = {
        "r0": column("r0_profile"),
        "scintillation_index": column("scintillation_index_direct"),
        "scintillation_index_profile": column("scintillation_index_profile"),
        "scintillation_index_point": column("scintillation_index_point"),
        "mu": column("mu"),
        "chi2": column("chi2_reduced"),
    }
    return [
        {
            "product_id": product_id,
            "number": i,
            "start": int(bounds[i, 0]),
            "stop": int(bounds[i, 1]),
            "quality_flag": int(flags[i]),
            "quality_level": int(levels[i]),
            "n_frames": frames[i],
            **{name: values[i] for name, values in columns.items()},
        }
        for i in range(count)
    ]
