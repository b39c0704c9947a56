"""What a product says once: the geometry of its path, what its data answer to, and what else looks along it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from . import turbulence, vibration
from .beam_heights import beam_heights, height_factors, sight_heights
from .geometry import MAP_KINDS
from .products import INTENSITY_KINDS, SLOPE_KINDS
from .scintillometer import slice_weights
from .surface_layer import effective_height

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .batch import Model
    from .geometry import Geometry, SliceGrid
    from .parameters import Header

    Array = NDArray[np.float64]


def tracked(header: Header) -> dict[str, Any]:
    """What of a header enters a product beside geometry and detector."""
    return {
        "heights": header.path.heights,
        **({} if header.path.heights is not None or header.path.height is None else {"height": header.path.height}),
        "scintillometers": [
            (
                s.name,
                s.wavelength,
                s.diameters,
                *s.ends(header.path.length),
                *(s.offset, s.heights, s.height_scaling),
            )
            for s in header.scintillometers
        ],
    }


def scintillometer_weights(header: Header, grid: SliceGrid, sampling: turbulence.Sampling) -> Array:
    """Weight of each slice in the Cn2 of each scintillometer of the header, (n, k); n = 0 without any."""
    if not header.scintillometers:
        return np.empty((0, grid.k))
    return np.stack(
        [
            slice_weights(grid, other.ends(header.path.length), *other.diameters, other.wavelength, sampling=sampling)
            for other in header.scintillometers
        ]
    )


def scintillometer_factors(header: Header, grid: SliceGrid) -> Array:
    """Factor of Cn2 from the height of each slice to that of each scintillometer's beam, (n, k); 1 if not asked for."""
    sight = sight_heights(header.path, grid)
    factors = np.ones((len(header.scintillometers), grid.k))
    for row, one in zip(factors, header.scintillometers, strict=True):
        if one.height_scaling != "none" and sight is not None:
            row[:] = height_factors(beam_heights(one, header.path.length, grid, sight), sight.effective)
    return factors


def fresnel_scale(geometry: Geometry, z: Array) -> Array:
    """Size of the scintillation that a layer at z prints on the pupil, m.

    sqrt(lambda z L / (L - z)) in the spherical wave of a source at L (Sauvage et al. 2021, Sec. 3.2).
    """
    scaling = np.array([geometry.scaling(float(at)) for at in z])
    return np.asarray(np.sqrt(geometry.wavelength * z * scaling))


def describe(model: Model, header: Header) -> dict[str, NDArray[Any]]:
    """Coordinates and variables of a product that do not change from batch to batch.

    Parameters
    ----------
    model : Model
        What turns reduced data into profiles.
    header : Header
        Header of the archive.

    Returns
    -------
    dict of str to ndarray
        Under their names in :data:`coslidar.pipeline.products.COORDINATES` and
        :data:`coslidar.pipeline.products.SCHEMA`. Heights and scintillometers only where the header has them.
    """
    geometry, grid = model.geometry, model.grid
    d = geometry.subaperture_size
    responses = model.matrix.reshape(len(MAP_KINDS), *geometry.map_shape, grid.k)
    found: dict[str, NDArray[Any]] = {
        "z": grid.centres,
        "z_bounds": np.stack([grid.edges[:-1], grid.edges[1:]], axis=1),
        "dy": geometry.lags[:, 0, 1] * d,
        "dx": geometry.lags[0, :, 0] * d,
        "frequency": vibration.cells(header.instrument.frame_rate),
        "pair_count": geometry.pair_count,
        "z_max": np.asarray(turbulence.z_max(geometry)),
        "z_first": np.asarray(turbulence.resolution(geometry)),
        "fresnel_scale": fresnel_scale(geometry, grid.centres),
        "response_slope": responses[[MAP_KINDS.index(kind) for kind in SLOPE_KINDS]],
        "response_intensity": responses[[MAP_KINDS.index(kind) for kind in INTENSITY_KINDS]],
    }
    if header.path.heights is not None:
        at, height = np.array(header.path.heights).T
        inside = (grid.centres >= at[0]) & (grid.centres <= at[-1])
        found["height_above_ground"] = np.where(inside, np.interp(grid.centres, at, height), np.nan)
    sight = sight_heights(header.path, grid)
    if sight is not None:
        found["flux_height"] = sight.effective
        found["border_height"] = np.stack([sight.borders[:-1], sight.borders[1:]], axis=1)
    if header.scintillometers:
        beams = np.stack([beam_heights(one, header.path.length, grid, sight) for one in header.scintillometers])
        found["scintillometer_offset"] = np.array([one.offset for one in header.scintillometers])
        found["scintillometer_height"] = beams
        found["scintillometer_height_factor"] = scintillometer_factors(header, grid)
        found["scintillometer_weight"] = model.scintillometers
        if sight is not None:
            found["effective_height"] = np.array(
                [
                    # An instrument of unknown height is taken as on the line of sight.
                    effective_height(sight.effective if one.heights is None else beam, weights)
                    for one, beam, weights in zip(header.scintillometers, beams, model.scintillometers, strict=True)
                ]
            )
    return found
