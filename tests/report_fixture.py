"""Products made of numbers that look right, in the shape that the schema declares; not physics."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import xarray as xr

from coslidar.pipeline.products import COORDINATES, FIXED_COORDINATES, INTENSITY_KINDS, SCHEMA, SLOPE_KINDS

START = 1_347_624_900_000_000_000  # 2012-09-14T12:15:00Z
MASK = np.array([[0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [1, 1, 0, 1, 1], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0]])
CN2 = np.array([34, 34, 34, 34, 34, 1.7, 1.7, 102, 102, 3.4, 204, 204]) * 1e-15
LENGTH = 2670.0
LINEAGE = {
    "scheme": 1,
    "key": "0f3c" * 16,
    "nodes": {
        "0f3c" * 16: {"stage": "profile", "version": 2, "tracked": {"noise_bias": "joint"}, "upstream": ["ab12" * 16],
                      "plugins": {"regulariser": {"name": "white", "version": 1}}},
        "ab12" * 16: {"stage": "response", "version": 3, "tracked": {"slices": 12}, "upstream": [], "plugins": {}},
    },
}  # fmt: skip
PROVENANCE = {"agent": {"coslidar:software": {"prov:label": "coslidar 0.1.0", "coslidar:commit": "57b8f58"}}}


def _pairs() -> np.ndarray:
    count = np.zeros((9, 9), dtype=np.int64)
    at = np.argwhere(MASK)
    for a in at:
        for b in at:
            count[a[0] - b[0] + 4, a[1] - b[1] + 4] += 1
    return count


def product(
    batches: int = 20,
    *,
    sources: int = 2,
    failed: tuple[int, ...] = (),
    gap_after: int | None = None,
    seconds: float = 180.0,
    seed: int = 1,
    slices: int = 12,
    start: int = START,
    decoded: bool = True,
    attributes: dict[str, Any] | None = None,
) -> xr.Dataset:
    """A product with every variable of the schema; failed batches are NaN."""
    random = np.random.default_rng(seed)
    step = int(seconds * 1e9)
    begin = start + step * np.arange(batches, dtype=np.int64)
    if gap_after is not None:
        begin[gap_after:] += 20 * step
    edges = np.linspace(0, LENGTH, slices + 1)
    centre = (edges[1:] + edges[:-1]) / 2
    lag = np.arange(-4, 5) * 0.07
    dy, dx = np.meshgrid(lag, lag, indexing="ij")
    pairs = _pairs()
    trend = 10 ** (-1.2 * np.arange(batches) / max(batches - 1, 1))
    truth = np.interp(centre, (np.arange(12) + 0.5) * LENGTH / 12, CN2)
    cn2 = truth * trend[:, None] * np.exp(0.15 * random.standard_normal((batches, slices)))
    bound = cn2 < 3e-15 * trend[:, None]
    cn2 = np.where(bound, 0, cn2)
    error = 0.12 * trend[:, None] * (2e-14 + truth) * (1 + centre / LENGTH)
    error_ml = error * np.where(centre > 1800, 10 ** ((centre - 1800) / 300), 1.2)

    def bump(width_y: float, width_x: float, shift: float = 0.0) -> np.ndarray:
        return np.exp(-((dy - shift) ** 2) / width_y**2 - dx**2 / width_x**2)

    slope_model = np.stack([0.4 + bump(0.3, 0.2), 0.4 + bump(0.2, 0.3), 0.3 + 0.6 * bump(0.35, 0.15, 0.14),
                            0.3 + 0.6 * bump(0.3, 0.2, 0.14)])  # fmt: skip
    slope_model = 8e-12 * trend[:, None, None, None] * slope_model
    intensity_model = np.stack([bump(0.07, 0.07), 0.35 * bump(0.15, 0.06, 0.1)]) * 0.12 * trend[:, None, None, None]
    slope_error = 0.04 * slope_model.max() * trend[:, None, None, None] * np.ones_like(slope_model)
    intensity_error = 0.04 * 0.12 * trend[:, None, None, None] * np.ones_like(intensity_model)
    slopes = slope_model + slope_error * random.standard_normal(slope_model.shape)
    intensities = intensity_model + intensity_error * random.standard_normal(intensity_model.shape)
    for values in (slopes, slope_model, slope_error, intensities, intensity_model, intensity_error):
        values[..., pairs == 0] = np.nan
    if sources == 1:
        for values in (slopes, slope_model, slope_error):
            values[:, 2:] = np.nan
        for values in (intensities, intensity_model, intensity_error):
            values[:, 1:] = np.nan
    index = 0.12 * trend
    grid = np.arange(23, 33.01, 0.25)
    log_mu = np.round(27 - 1.6 * np.log10(trend)) + 0.0
    distance = (centre[:, None] - centre[None, :]) / 150
    kernel = np.exp(-(distance**2)) / np.exp(-(distance**2)).sum(axis=1, keepdims=True) - 0.02
    kernel *= np.clip(1.3 - centre / LENGTH, 0.1, 1)[:, None]
    values: dict[str, Any] = {
        "time_bounds": np.stack([begin, begin + step], axis=1),
        "z_bounds": np.stack([edges[:-1], edges[1:]], axis=1),
        "cn2": cn2,
        "cn2_standard_error": error,
        "cn2_standard_error_ml": error_ml,
        "cn2_interval_68": np.stack([np.maximum(cn2 - error, 0), cn2 + error], axis=-1),
        "cn2_interval_95": np.stack([np.maximum(cn2 - 2 * error, 0), cn2 + 2 * error], axis=-1),
        "cn2_posterior_mean": cn2,
        "resolution_length": np.full((batches, centre.size), 500.0),
        "cn2_path_mean": cn2.mean(axis=1),
        "cn2_path_mean_interval_68": cn2.mean(axis=1)[:, None] * [0.9, 1.1],
        "cn2_at_bound": bound.astype("u1"),
        "averaging_kernel": np.repeat(kernel[None], batches, axis=0),
        "degrees_of_freedom": np.full(batches, np.trace(kernel)),
        "mu": 10**log_mu,
        "criterion": 1e-3 + 1e-5 * (2 * np.logaddexp(0, 3 * (grid - log_mu[:, None]))
                                    + np.logaddexp(0, log_mu[:, None] - grid)),
        "slope_correlation": slopes,
        "slope_correlation_model": slope_model,
        "slope_correlation_error": slope_error,
        "slope_correlation_correction": np.zeros_like(slopes),
        "intensity_correlation": intensities,
        "intensity_correlation_model": intensity_model,
        "intensity_correlation_error": intensity_error,
        "intensity_correlation_correction": np.zeros_like(intensities),
        "pair_count": pairs,
        "r0_profile": 0.11 * trend**-0.6,
        "r0_interval_68": (0.11 * trend**-0.6)[:, None] * [0.95, 1.05],
        "scintillation_index_interval_68": index[:, None] * [0.95, 1.05],
        "scintillation_index_direct": np.stack([index * 1.03, index * 0.97], axis=1)[:, :sources],
        "scintillation_index_profile": index * (1 + 0.02 * random.standard_normal(batches)),
        "scintillation_index_point": index * 4,
        "scintillation_index_point_slice": index[:, None] * 4 * np.full(slices, 1 / slices),
        "strong_slice": np.zeros((batches, slices), dtype="u1"),
        "scintillation_rounds": np.zeros(batches, dtype=np.int64),
        "mean_flux": np.full((batches, sources), 9_000.0),
        "noise_variance_slope": np.full((batches, 2), 3e-13),
        "noise_variance_intensity": np.full(batches, 1e-4),
        "noise_variance_slope_error": np.full((batches, 2), 3e-14),
        "noise_variance_intensity_error": np.full(batches, 1e-5),
        "slope_offset": np.full((batches, 2), 1e-12),
        "slope_offset_error": np.full((batches, 2), 3e-13),
        "n_frames": np.full(batches, round(142 * seconds), "i8"),
        "n_effective": np.full((batches, 3), 300.0),
        "valid_fraction": np.full((batches, sources), 0.9991),
        "chi2_reduced": 1 + 0.1 * random.standard_normal(batches),
        "quality_flag": np.where(index * 4 > 0.3, 256, 0).astype("i4"),
        "quality_level": np.where(index * 4 > 0.3, 1, 0).astype("i1"),
    }  # fmt: skip
    order = np.arange(1, 6)
    noll = 2e-1 * (order + 1) ** (-11 / 3) * trend[:, None, None] * np.ones((1, sources, 1))
    chi = FIXED_COORDINATES["log_amplitude"]
    deviation = np.sqrt(index / 4)[:, None] * np.ones(sources)
    frequency = np.arange(142) * 0.5 + 0.25
    spectrum = 1e-12 * trend[:, None, None] / (1 + (frequency / 2) ** (11 / 3)) * np.array([1, 2])[:, None] + 1e-16
    spectrum[..., 99:101] += 3e-13
    size = np.sqrt(3.8e-6 * centre * LENGTH / (LENGTH - centre))
    weight = centre * (LENGTH - centre) / LENGTH**2
    width_z = LENGTH / slices
    values |= {
        "z_max": np.asarray(692.0),
        "z_first": np.asarray(214.8),
        "fresnel_scale": size,
        "height_above_ground": 12 + 20 * weight,
        "flux_height": 12 + 20 * weight,
        "scintillometer_offset": np.array([0.0, 120.0]),
        "scintillometer_height": np.stack([np.full(slices, np.nan), 10 + 20 * weight]),
        "scintillometer_height_factor": np.ones((2, slices)),
        "scintillometer_weight": np.tile(weight / weight.sum(), (2, 1)),
        "cn2_path_average": cn2.mean(axis=1)[:, None] * [0.8, 1.2],
        "cn2_path_average_interval_68": cn2.mean(axis=1)[:, None, None] * np.array([[0.75, 0.85], [1.1, 1.3]]),
        "response_slope": 1e3 * width_z * (0.3 + bump(0.3, 0.2)[..., None]) * (1 - centre / LENGTH)
        * np.ones((4, 1, 1, 1)),
        "response_intensity": 1e11 * width_z * weight * np.exp(-(dy[..., None] ** 2 + dx[..., None] ** 2) / size**2)
        * np.ones((2, 1, 1, 1)),
        "cn2_other_mu": np.stack([cn2 * np.exp(0.4 * random.standard_normal(cn2.shape)), 0.6 * cn2], axis=1),
        "cn2_other_mu_standard_error": np.stack([3 * error, 0.4 * error], axis=1),
        "slope_spectrum": spectrum,
        "vibration_frequency": np.full(batches, 50.0),
        "vibration_variance": np.tile([1e-12, 4e-12], (batches, 1)),
        "vibration_harmonic_variance": np.tile([[1e-13, 4e-13], *[[0.0, 0.0]] * 3], (batches, 1, 1)),
        "zernike_variance": noll * np.exp(0.2 * random.standard_normal(noll.shape)),
        "zernike_variance_kolmogorov": noll,
        "log_amplitude_count": np.rint(1e5 * 0.01 * np.exp(-((chi / deviation[..., None]) ** 2) / 2)
                                       / deviation[..., None]).astype("i8"),
        "log_amplitude_mean": np.zeros((batches, sources)),
        "log_amplitude_deviation": deviation,
    }  # fmt: skip
    # Checks that no figure shows.
    sizes = {"time": batches, "source": sources, "axis": 2, "axis_kind": 3, "z": slices, "z_true": slices, "bound": 2,
             "scintillometer": 2, "dy": 9, "dx": 9, "slope_kind": 4, "intensity_kind": 2}  # fmt: skip
    sizes |= {name: len(value) for name, value in FIXED_COORDINATES.items()}
    for name in sorted(set(SCHEMA) - set(values) - {"r0_direct"}):
        values[name] = np.full([sizes[dim] for dim in SCHEMA[name].dims], 0.01).astype(SCHEMA[name].dtype)
    values["r0_direct"] = (0.13 * trend**-0.6)[:, None] * np.array([1.02, 0.98])[:sources]
    for batch in failed:
        for name, variable in SCHEMA.items():
            if variable.dims[:1] == ("time",) and variable.dtype == "float64":
                values[name][batch] = np.nan
        values["quality_flag"][batch], values["quality_level"][batch] = 1, 2
        values["cn2_at_bound"][batch] = 0
        values["n_frames"][batch] = 0
    times = begin.astype("datetime64[ns]") if decoded else begin
    if decoded:
        values["time_bounds"] = values["time_bounds"].astype("datetime64[ns]")
    coordinates = {
        "time": times,
        "z": centre,
        "z_true": centre,
        "dy": lag,
        "dx": lag,
        "log_mu_grid": grid,
        "frequency": frequency,
    }
    coordinates |= FIXED_COORDINATES
    assert set(values) == set(SCHEMA)
    assert set(coordinates) == set(COORDINATES)
    return xr.Dataset(
        {name: (SCHEMA[name].dims, value, {"units": SCHEMA[name].unit}) for name, value in values.items()},
        {
            **{name: ((name,), value) for name, value in coordinates.items()},
            "source": ["bottom", "top"][:sources],
            "scintillometer": ["LAS A", "LAS B"],
            "slope_kind": list(SLOPE_KINDS),
            "intensity_kind": list(INTENSITY_KINDS),
        },
        {
            "Conventions": "CF-1.11",
            "campaign": "lannemezan-2012",
            "archive": "2012-09-14T1415",
            "timezone": "Europe/Paris",
            "wavelength": "3.8e-06 m",
            "lineage_key": "0f3c" * 16,
            "lineage": json.dumps(LINEAGE),
            "provenance": json.dumps(PROVENANCE),
            **(attributes or {}),
        },
    )
