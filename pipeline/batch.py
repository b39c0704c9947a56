"""One batch from frames to a profile: the only place where the stages meet.

Three steps, each a pure function, each with a version that enters the keys of what it makes: `measure` (frames to
slopes and fluxes), `reduce` (to correlation maps and their noise), `retrieve` (to a profile).
"""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from . import (
    checks,
    convergence,
    correlation,
    extraction,
    inversion,
    posterior,
    strong_scintillation,
    timing,
    turbulence,
    uncertainty,
    vibration,
)
from .beam_heights import carried_weights
from .geometry import MAP_KINDS
from .measurement import BatchError as BatchError
from .measurement import measure as measure  # the first stage of a batch
from .parameters import SOURCES_USED
from .products import INTENSITY_KINDS, MU_FACTORS, QUALITY_FLAGS, SCHEMA, SLOPE_KINDS, BatchResult, Measurements

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from .geometry import Geometry, SliceGrid
    from .parameters import (
        CorrelationParameters,
        InversionParameters,
    )
    from .protocols import HyperparameterSelector, Regulariser
    from .surroundings import Surroundings

#: Raise it whenever the same input gives other numbers.
MEASURE_VERSION = extraction.VERSION
REDUCE_VERSION = 5
RESPONSE_VERSION = 2
RETRIEVE_VERSION = 8

#: Fewer frames than this make no correlation worth the name.
MIN_FRAMES = 64
#: Shortest batch, s, in which a drift is told from slow turbulence.
DRIFT = 60.0


@dataclass(frozen=True, eq=False)
class ReducedBatch:
    """What remains of a batch once its frames have been read.

    Parameters
    ----------
    start, stop : int
        First and last time stamp, plus one frame period; ns since 1970-01-01T00:00:00 UTC.
    quality_flag : int
        Bits of :data:`coslidar.pipeline.products.QUALITY_FLAGS` known so far.
    arrays : dict of str to ndarray
        `maps` (6, 2p - 1, 2q - 1), `noise_covariance` (m, m), `weighting_correction` (m,) of a fit weighted with it,
        `n_effective` (3,), `mean_flux` (S,),
        `scintillation_index` (S,), `valid_fraction` (S,), `n_frames`, and checks under their names in
        :data:`coslidar.pipeline.products.SCHEMA`.
    """

    start: int
    stop: int
    quality_flag: int
    arrays: dict[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Model:
    """What turns reduced data into a profile; the same for all batches of an archive.

    Parameters
    ----------
    geometry : Geometry
        Pupil, path and sources.
    grid : SliceGrid
        Slices of the profile.
    matrix : ndarray, (n, k)
        Response matrix M, slice thickness included.
    sampling : {"mean", "midpoint"}
        How M was sampled; integrals of the profile follow it.
    regulariser, selector
        Plugins.
    inversion : InversionParameters
        Data used, unpenalised unknowns, estimator.
    scintillometers : ndarray, (n, k)
        Weight of each slice in the Cn2 of each scintillometer on the path; n = 0 without any.
    height_factors : ndarray, (n, k), optional
        Factor that carries Cn2 of each slice to the height of each scintillometer; 1 where it is absent.
    strong : StrongScintillation, optional
        Correction of the scintillation response; first order where it is absent.
    surroundings : Surroundings, optional
        What is known of air and ground around the path.
    """

    geometry: Geometry
    grid: SliceGrid
    matrix: NDArray[np.float64]
    sampling: Literal["mean", "midpoint"]
    regulariser: Regulariser
    selector: HyperparameterSelector
    inversion: InversionParameters
    scintillometers: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    height_factors: NDArray[np.float64] | None = None
    strong: strong_scintillation.StrongScintillation | None = None
    surroundings: Surroundings | None = None


def reduce(
    measurements: Measurements,
    geometry: Geometry,
    frame_rate: float,
    duration: float,
    parameters: CorrelationParameters,
) -> ReducedBatch:
    """Correlation maps of a batch and their noise.

    Parameters
    ----------
    measurements : Measurements
        Slopes and fluxes.
    geometry : Geometry
        Pupil and sources.
    frame_rate : float
        Hz.
    duration : float
        Requested length of a batch, s.
    parameters : CorrelationParameters
        How the noise is estimated.

    Returns
    -------
    ReducedBatch

    Raises
    ------
    BatchError
        There are too few frames, or a source is not seen.
    """
    frames = len(measurements.time)
    if frames < MIN_FRAMES:
        raise BatchError(f"{frames} frames are too few for correlations; at least {MIN_FRAMES} are needed")
    if geometry.n_sources == 1 and measurements.flux.shape[1] == 2:
        measurements = measurements.of_source(SOURCES_USED[parameters.sources][0])
    slopes, flux, flag = measurements.slopes, measurements.flux, measurements.flag
    repeated = timing.repeated(slopes, flux)
    if repeated.sum() > 0.5 * frames:
        raise BatchError(f"{repeated.sum()} of {frames} frames repeat the one before: the camera was frozen")
    light, out = _light(flux, frame_rate)
    if repeated.any() or out.any():
        slopes, flux = slopes.copy(), flux.copy()
        lost = out | repeated[:, None]
        slopes[np.broadcast_to(lost[:, None], slopes.shape[:3])] = np.nan
        flux[lost] = np.nan
        light[lost] = np.nan
    seen = np.isfinite(flux)
    valid = seen.mean(axis=(0, 2))
    for number, fraction in enumerate(valid):
        if fraction < 0.5:
            never = int((~seen[:, number].any(axis=0)).sum())
            raise BatchError(
                f"source {number + 1} could be measured in {fraction:.1%} of its spots "
                f"({never} of {flux.shape[2]} subapertures never); at least half is needed"
            )
    if parameters.flux_trend is not None:
        flux = flux / timing.slow_part(light, frame_rate, parameters.flux_trend)[:, :, None]
    found = correlation.finalise(correlation.accumulate(slopes, flux), geometry)
    if parameters.covariance == "lagged":
        lagged = convergence.lagged(slopes, flux, geometry)
        covariance, n_effective, correction = lagged
    else:
        covariance = convergence.independent(found.covariance, frames, geometry, found.valid_fraction)
        n_effective = np.full(3, float(frames))
        correction = np.zeros(len(covariance))
    detection = _mean(measurements.flux_noise / found.mean_flux**2)

    tilt = timing.pupil_mean(slopes)
    common = timing.regular(timing.pupil_mean(tilt), measurements.time, frame_rate)
    line = vibration.find_line(common, frame_rate)
    shaken = line.variance + line.harmonics.sum(axis=0)
    maps = found.maps
    if parameters.vibration == "subtracted":
        maps = maps.copy()
        for number, kind in enumerate(MAP_KINDS):
            if kind in SLOPE_KINDS:
                maps[number] -= shaken["xy".index(kind[0])]

    stamps = timing.stamps(measurements.time, frame_rate)
    index = found.scintillation_index - detection
    modes = checks.zernike_check(found, measurements.slope_noise, geometry)
    logarithm = checks.log_amplitude(flux, found.mean_flux)
    steady = checks.stationarity(slopes, flux, found, covariance, geometry)
    spot_drift, flux_drift = timing.trend(tilt).T, timing.trend(light)
    slope_variance = _mean(np.diagonal(found.covariance).reshape(3, *flux.shape[1:])[:2]).T
    period = round(1e9 / frame_rate)
    quality = 0
    span = (int(measurements.time[-1]) - int(measurements.time[0]) + period) / 1e9
    for name, applies in (
        ("short", span < 0.5 * duration),
        ("gaps", stamps.missing > 0.01 * frames),
        ("lost_spots", float(seen.mean()) < 0.99),
        ("saturated", float(((flag & extraction.FLAGS["saturated"]) > 0).mean()) > 0.01),
        (
            "irregular_time",
            stamps.backward > 0 or abs(stamps.rate / frame_rate - 1) > 0.01 or stamps.jitter * frame_rate > 0.25,
        ),
        ("repeated_frames", repeated.sum() > 0.01 * frames),
        ("source_out", (out.mean(axis=0) > 0.01).any()),
        # A line from -a/2 to a/2 has the variance a^2 / 12. Over seconds turbulence itself drifts.
        ("drifting_spots", span >= DRIFT and (spot_drift**2 / 12 > 0.25 * slope_variance).any()),
        ("drifting_flux", span >= DRIFT and (flux_drift**2 / 12 > 0.1 * index).any()),
        ("vibration", np.isfinite(line.frequency)),
        ("tilt_response", (np.abs(measurements.centroid_gain - 1) > 0.05).any()),
        # Few independent frames leave room for chance.
        ("not_kolmogorov", (modes.misfit > np.fmax(checks.MISFIT, 2 * np.sqrt(2 / 3 / n_effective[:2].min()))).any()),
        ("not_lognormal", (logarithm.distance > np.fmax(checks.DISTANCE, 1.5 / np.sqrt(n_effective[2]))).any()),
        ("rytov_limit", (index > checks.RYTOV).any()),
        ("not_stationary", (steady.deviation > np.maximum(checks.UNSTEADY, 4 * steady.error)).any()),
    ):
        quality |= QUALITY_FLAGS[name][0] * bool(applies)
    return ReducedBatch(
        start=int(measurements.time[0]),
        stop=int(measurements.time[-1]) + period,
        quality_flag=quality,
        arrays={
            "maps": maps,
            "noise_covariance": covariance,
            "weighting_correction": correction,
            "n_effective": n_effective,
            "mean_flux": _mean(found.mean_flux),
            "scintillation_index": index,
            "valid_fraction": valid,
            "n_frames": np.asarray(frames),
            "noise_variance_slope_detector": _mean(measurements.slope_noise).T,
            "noise_variance_intensity_detector": detection,
            "centroid_gain": measurements.centroid_gain.T,
            "vibration_frequency": np.asarray(line.frequency),
            "vibration_variance": line.variance,
            "vibration_harmonic_variance": line.harmonics,
            "vibration_significance": np.asarray(line.significance),
            "slope_spectrum": vibration.spectrum(common, frame_rate),
            "zernike_variance": modes.variance,
            "zernike_variance_kolmogorov": modes.kolmogorov,
            "zernike_misfit": modes.misfit,
            "r0_direct": modes.r0,
            "log_amplitude_count": logarithm.histogram,
            "log_amplitude_mean": logarithm.mean,
            "log_amplitude_deviation": logarithm.deviation,
            "log_amplitude_distance": logarithm.distance,
            "stationarity_deviation": steady.deviation,
            "stationarity_error": steady.error,
            "spot_drift": spot_drift,
            "flux_drift": flux_drift,
            "frame_rate_measured": np.asarray(stamps.rate),
            "time_jitter": np.asarray(stamps.jitter),
            "n_missing": np.asarray(stamps.missing),
            "n_repeated": np.asarray(int(repeated.sum())),
            "out_fraction": out.mean(axis=0),
        },
    )


def _light(flux: NDArray[np.float64], frame_rate: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Relative light of each source over the pupil, (T, S), and the frames in which it is out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a spot that is never measured has no mean
        usual = np.nanmean(flux[:: checks.EVERY], axis=0)
    light = timing.pupil_mean(flux / np.where(usual > 0, usual, np.nan))
    return light, timing.outages(light, frame_rate)


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the subapertures that have a value."""
    seen = np.isfinite(values)
    total = np.where(seen, values, 0.0).sum(axis=-1)
    return np.where(seen.any(axis=-1), total / np.maximum(seen.sum(axis=-1), 1), np.nan)


def retrieve(reduced: ReducedBatch, model: Model, neighbours: Sequence[ReducedBatch] = ()) -> BatchResult:
    """Profile of a batch, its uncertainty, and what follows from it.

    Parameters
    ----------
    reduced : ReducedBatch
        Result of :func:`reduce`.
    model : Model
        Response and plugins.
    neighbours : sequence of ReducedBatch
        Batches before and after it, for selectors that choose mu from several.

    Returns
    -------
    BatchResult

    Raises
    ------
    BatchError
        The data admit no inversion.
    """
    geometry, grid, arrays = model.geometry, model.grid, reduced.arrays
    around = []
    for other in neighbours:
        # A neighbour that cannot be inverted says nothing about mu; it fails on its own account.
        with contextlib.suppress(ValueError, np.linalg.LinAlgError):
            around.append(_whitened(other, model).problem(*_known(other, model), grid=grid))
    try:
        known = _known(reduced, model)

        def estimate(model: Model) -> tuple[inversion.Reduction, inversion.Profile]:
            reduction = _whitened(reduced, model)
            profile = inversion.estimate(
                reduction,
                *known,
                model.selector,
                grid=grid,
                neighbours=around,
                estimator=model.inversion.estimator,
                # Another seed for each batch, so that what sampling adds to the intervals averages out over a campaign.
                seed=reduced.start // 1_000_000 % 2**31,
            )
            return reduction, profile

        reduction, profile = estimate(model)
        rounds, unsettled, first_order = 0, model.strong is not None, model.matrix
        while model.strong is not None and unsettled and rounds < strong_scintillation.ROUNDS:
            before, rounds = model.matrix, rounds + 1
            model = replace(model, matrix=model.strong.matrix(first_order, profile.cn2))
            reduction, profile = estimate(model)
            unsettled = strong_scintillation.moved(before, model.matrix)
        problem = reduction.problem(*known, grid=grid)
        others = profile.mu * np.array(MU_FACTORS)
        other_cn2 = np.stack([inversion.solve_positive(problem, mu) for mu in others])
        other_error = np.stack([uncertainty.map_error(problem, mu) for mu in others])
    except (ValueError, np.linalg.LinAlgError) as error:
        raise BatchError(f"the inversion failed: {error}") from error

    shape = (len(MAP_KINDS), *geometry.map_shape)
    fitted = profile.model.reshape(shape)
    deviation = convergence.deviation_maps(arrays["noise_covariance"], geometry)
    correction = convergence.on_maps(arrays["weighting_correction"], geometry)
    slope = [MAP_KINDS.index(kind) for kind in SLOPE_KINDS]
    intensity = [MAP_KINDS.index(kind) for kind in INTENSITY_KINDS]
    unknown = dict(zip(profile.nuisance_names, zip(profile.nuisance, profile.nuisance_error, strict=True), strict=True))

    def joint(*names: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values and standard errors of unpenalised unknowns, NaN for those that were left out."""
        found = np.array([unknown.get(name, (np.nan, np.nan)) for name in names])
        return found[:, 0], found[:, 1]

    def interval(quantity: Callable[[NDArray[np.float64]], Any]) -> NDArray[np.float64]:
        """Interval of 68 % of what follows from a profile, from that of each draw of the posterior."""
        if profile.posterior is None:
            return np.array([0.0, np.inf])
        return posterior.highest_density_interval(np.asarray(quantity(profile.posterior.draws)), 0.68)

    def fried(cn2: NDArray[np.float64]) -> Any:
        return turbulence.fried_parameter(cn2, *light, sampling=model.sampling)

    def index(cn2: NDArray[np.float64]) -> Any:
        return turbulence.scintillation_index(cn2, model.matrix, geometry)

    def path_mean(cn2: NDArray[np.float64]) -> Any:
        return turbulence.path_average(cn2, grid.thickness)

    light = (grid, geometry.wavelength, geometry.path_length)
    point = profile.cn2 * turbulence.point_source_weights(*light, sampling=model.sampling)
    slope_noise, slope_noise_error = joint("noise_bias_x", "noise_bias_y")
    intensity_noise, intensity_noise_error = joint("noise_bias_i")
    offset, offset_error = joint("slope_offset_x", "slope_offset_y")
    values: dict[str, Any] = {
        "cn2": profile.cn2,
        "cn2_standard_error": profile.error_map,
        "cn2_standard_error_ml": profile.error_ml,
        "cn2_interval_68": profile.interval_68,
        "cn2_interval_95": profile.interval_95,
        "cn2_posterior_mean": profile.posterior_mean,
        "resolution_length": profile.resolution_length,
        "cn2_path_mean": path_mean(profile.cn2),
        "cn2_path_mean_interval_68": interval(path_mean),
        "cn2_other_mu": other_cn2,
        "cn2_other_mu_standard_error": other_error,
        "cn2_at_bound": profile.at_bound,
        "averaging_kernel": profile.averaging_kernel,
        "degrees_of_freedom": profile.degrees_of_freedom,
        "mu": profile.mu,
        "log_mu_grid": profile.log_mu_grid,
        "criterion": profile.criterion,
        "slope_correlation": arrays["maps"][slope],
        "slope_correlation_model": fitted[slope],
        "slope_correlation_error": deviation[slope],
        "slope_correlation_correction": correction[slope],
        "intensity_correlation": arrays["maps"][intensity],
        "intensity_correlation_model": fitted[intensity],
        "intensity_correlation_error": deviation[intensity],
        "intensity_correlation_correction": correction[intensity],
        "r0_profile": fried(profile.cn2),
        "r0_interval_68": interval(fried),
        "scintillation_index_direct": arrays["scintillation_index"],
        "scintillation_index_profile": index(profile.cn2),
        "scintillation_index_interval_68": interval(index),
        "scintillation_index_point": point.sum(),
        "scintillation_index_point_slice": point,
        "strong_slice": ~turbulence.is_weak(point),
        "scintillation_rounds": rounds,
        "mean_flux": arrays["mean_flux"],
        "noise_variance_slope": slope_noise,
        "noise_variance_slope_error": slope_noise_error,
        "noise_variance_intensity": intensity_noise[0],
        "noise_variance_intensity_error": intensity_noise_error[0],
        "slope_offset": offset,
        "slope_offset_error": offset_error,
        "n_frames": arrays["n_frames"],
        "n_effective": arrays["n_effective"],
        "valid_fraction": arrays["valid_fraction"],
        "chi2_reduced": profile.chi2_reduced,
    }
    draws = None if profile.posterior is None else profile.posterior.draws
    # Who compares the product with an instrument that was not known here carries the errors with this.
    values["cn2_posterior_covariance"] = (
        np.full((grid.k, grid.k), np.nan) if draws is None else np.atleast_2d(np.cov(draws, rowvar=False))
    )
    if len(model.scintillometers):
        shares = model.scintillometers / model.scintillometers.sum(axis=1, keepdims=True)
        if model.height_factors is not None:
            shares = carried_weights(shares, model.height_factors)
        values["cn2_path_average"] = shares @ profile.cn2
        values["cn2_path_average_interval_68"] = np.stack([interval(partial(np.inner, row)) for row in shares])
        values["cn2_path_average_standard_error"] = np.sqrt(
            np.einsum("ik,kl,il->i", shares, values["cn2_posterior_covariance"], shares)
        )
    if model.surroundings is not None:
        values |= model.surroundings.derive(profile.cn2, draws, reduced.start, reduced.stop)
    # Checks that were made with the correlations.
    values |= {name: value for name, value in arrays.items() if name in SCHEMA and name not in values}
    negative = any(
        value < -3 * error for name, (value, error) in unknown.items() if name.startswith("noise") and error > 0
    )
    quality = reduced.quality_flag
    for name, applies in (
        ("mu_at_edge", profile.selection.at_edge),
        ("negative_noise", negative),
        ("poor_fit", profile.chi2_reduced > 3),
        ("strong_scintillation", not turbulence.is_weak(point.sum())),
        ("unsettled_correction", unsettled),
    ):
        quality |= QUALITY_FLAGS[name][0] * bool(applies)
    return BatchResult(
        start=reduced.start,
        stop=reduced.stop,
        values={name: np.asarray(value) for name, value in values.items()},
        quality_flag=quality,
    )


def _known(reduced: ReducedBatch, model: Model) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Data vector and precision of the prior."""
    maps = reduced.arrays["maps"]
    if model.inversion.noise_bias == "joint" and model.inversion.flux_noise == "measured":
        maps = maps.copy()
        centre = (maps.shape[1] // 2, maps.shape[2] // 2)
        maps[(MAP_KINDS.index("ii_auto"), *centre)] -= reduced.arrays["noise_variance_intensity_detector"].mean()
    correction = convergence.on_maps(reduced.arrays["weighting_correction"], model.geometry)
    return correlation.data_vector(maps + correction), model.regulariser.precision(model.grid)


def _whitened(reduced: ReducedBatch, model: Model) -> inversion.Reduction:
    """Whitening for the noise of a batch."""
    unknown = {"none": "", "joint": "xy" if model.inversion.flux_noise == "measured" else "xyi"}
    return inversion.prepare(
        correlation.data_vector(reduced.arrays["maps"]),
        reduced.arrays["noise_covariance"],
        model.matrix,
        rows=model.geometry.independent,
        subset=model.inversion.subset,
        noise_bias=unknown[model.inversion.noise_bias],
        slope_offset=model.inversion.slope_offset == "joint",
    )


def failed(start: int, stop: int, reason: str) -> BatchResult:
    """The result of a batch that could not be processed."""
    return BatchResult(start, stop, {}, QUALITY_FLAGS["failed"][0], reason)
