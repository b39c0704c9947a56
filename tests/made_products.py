"""Products with drawn numbers, for tests of what keeps them."""

from __future__ import annotations

import numpy as np

from coslidar.catalog.products import assemble
from coslidar.pipeline.lineage import make_key
from coslidar.pipeline.products import FIXED_COORDINATES, SCHEMA, BatchResult

#: 2012-09-14T12:15:00 UTC, in ns; not a whole microsecond, so that rounding would show.
START = 1347624900000000123
LENGTH = 180 * 10**9
IDENTITY = "0123456789abcdef" * 4
_OWN = ("time_bounds", "quality_flag", "quality_level")


def batch(number=0, seed=0, *, slices=4, grid=5, flag=0):
    """A batch in which every variable of the schema has drawn values."""
    random = np.random.default_rng([seed, number])
    sizes = {"z": slices, "z_true": slices, "log_mu_grid": grid, "slope_kind": 4, "intensity_kind": 2}
    sizes |= {name: len(value) for name, value in FIXED_COORDINATES.items()}
    sizes |= {"dy": 5, "dx": 3, "source": 2, "axis": 2, "axis_kind": 3, "bound": 2, "scintillometer": 1, "frequency": 6}
    values = {
        name: (10 * random.random([sizes[dim] for dim in variable.dims[1:]])).astype(variable.dtype)
        for name, variable in SCHEMA.items()
        if variable.dims[:1] == ("time",) and name not in _OWN and all(dim in sizes for dim in variable.dims[1:])
    }
    values["log_mu_grid"] = np.linspace(25.0, 29.0, grid)
    return BatchResult(START + number * LENGTH, START + (number + 1) * LENGTH, values, flag)


def failed(number):
    return BatchResult(START + number * LENGTH, START + (number + 1) * LENGTH, {}, 1, "no light")


def static(slices=4):
    edges = np.linspace(0.0, 2670.0, slices + 1)
    return {
        "z": (edges[1:] + edges[:-1]) / 2,
        "z_bounds": np.stack([edges[:-1], edges[1:]], axis=1),
        "dy": np.arange(-2, 3) * 0.07,
        "dx": np.arange(-1, 2) * 0.07,
        "frequency": np.arange(6) + 0.5,
        "pair_count": np.arange(15).reshape(5, 3),
        "z_max": np.asarray(692.0),
        "z_first": np.asarray(214.8),
        "fresnel_scale": np.linspace(0.01, 0.1, slices),
        "height_above_ground": np.linspace(10.0, 30.0, slices),
        "flux_height": np.linspace(10.0, 30.0, slices),
        "border_height": np.stack([np.linspace(9, 29, slices), np.linspace(11, 31, slices)], axis=1),
        "scintillometer_offset": np.array([120.0]),
        "scintillometer_height": np.linspace(8.0, 28.0, slices)[None],
        "scintillometer_height_factor": np.ones((1, slices)),
        "scintillometer_weight": np.full((1, slices), 1 / slices),
        "effective_height": np.array([20.0]),
        **{name: np.ones(1, SCHEMA[name].dtype) for name in SCHEMA if name.startswith("comparison_")},
        "response_slope": np.linspace(0, 1, 60 * slices).reshape(4, 5, 3, slices),
        "response_intensity": np.linspace(0, 1, 30 * slices).reshape(2, 5, 3, slices),
    }


def key(seed=0):
    measured = make_key("measurements", 1, {"archive": IDENTITY})
    return make_key("profile", 1, {"seed": seed}, upstream=[measured])


def product(seed=0, results=None, **changes):
    """A product of two good batches and a failed one."""
    given = {
        "campaign": "test-campaign",
        "archive": "2012-09-14T1415",
        "archive_identity": IDENTITY,
        "lineage": key(seed),
        "wavelength": 3.8e-6,
        "sources": ["bottom", "top"],
        "scintillometers": ["LAS A"],
        "attributes": {"sampling": "mean"},
    } | changes
    batches = [batch(0, seed), batch(1, seed, flag=4), failed(2)] if results is None else results
    return assemble(batches, static(), **given)
