"""Arrays that pass from one stage to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Measurements:
    """Slopes and fluxes of consecutive frames.

    Parameters
    ----------
    time : ndarray of int64, (T,)
        Start of exposure, ns since 1970-01-01T00:00:00 UTC.
    slopes : ndarray of float64, (T, 2, S, A)
        Slopes along x and y for each source and subaperture, rad; NaN where there is none.
    flux : ndarray of float64, (T, S, A)
        Background-subtracted sum, counts; NaN where there is none.
    flag : ndarray of uint8, (T, S, A)
        Bits of :data:`coslidar.pipeline.extraction.FLAGS`.
    flux_noise : ndarray of float64, (S, A)
        Variance of a flux by detection noise, counts^2.
    slope_noise : ndarray of float64, (2, S, A)
        Variance of the slopes by detection noise, rad^2.
    centroid_gain : ndarray of float64, (2, S)
        Response of the slopes along x and y to a known tilt of the mean spot.
    """

    time: NDArray[np.int64]
    slopes: NDArray[np.float64]
    flux: NDArray[np.float64]
    flag: NDArray[np.uint8]
    flux_noise: NDArray[np.float64]
    slope_noise: NDArray[np.float64]
    centroid_gain: NDArray[np.float64]

    def of_source(self, number: int) -> Measurements:
        """Those of one source, as if it were the only one."""
        one = slice(number, number + 1)
        return Measurements(
            self.time,
            self.slopes[:, :, one],
            self.flux[:, one],
            self.flag[:, one],
            self.flux_noise[one],
            self.slope_noise[:, one],
            self.centroid_gain[:, one],
        )


@dataclass(frozen=True)
class Variable:
    """One variable of a product.

    Parameters
    ----------
    name : str
        Name in the file.
    dims : tuple of str
        Dimensions; `time` first where the variable changes from batch to batch.
    unit : str
        SI unit; ``"1"`` without dimension.
    dtype : str
        numpy dtype.
    long_name : str
        What it is.
    """

    name: str
    dims: tuple[str, ...]
    unit: str
    dtype: str
    long_name: str


def _schema(*rows: tuple[str, str, str, str, str]) -> dict[str, Variable]:
    return {
        name: Variable(name, tuple(dims.split()), unit, dtype, long_name) for name, dims, unit, dtype, long_name in rows
    }


#: Slope kinds and intensity kinds, in the order of :data:`coslidar.pipeline.geometry.MAP_KINDS`.
SLOPE_KINDS = ("xx_auto", "yy_auto", "xx_cross", "yy_cross")
INTENSITY_KINDS = ("ii_auto", "ii_cross")

#: Radial orders of the Zernike modes that are fitted to the slopes.
RADIAL_ORDERS = (1, 2, 3, 4, 5)
#: Width and centres of the bins of the log-amplitude histogram.
LOG_AMPLITUDE_STEP = 0.01
LOG_AMPLITUDES: NDArray[np.float64] = (np.arange(200) - 99.5) / 100
#: Multiples of the frequency of the vibration line at which its harmonics are looked for, at their aliases.
HARMONICS = (2, 3, 4, 5)
#: Parts of the chosen mu at which a profile is retrieved as well, to show what depends on it (Sauvage et al. 2021,
#: Sec. 4.3).
MU_FACTORS = (0.01, 100.0)

#: Coordinates of a product.
COORDINATES = _schema(
    ("time", "time", "ns", "int64", "start of the batch, UTC, nanoseconds since 1970-01-01T00:00:00"),
    ("z", "z", "m", "float64", "distance of the slice's mid-point from the pupil"),
    ("z_true", "z_true", "m", "float64", "distance of the slice that an averaging kernel looks at"),
    ("dy", "dy", "m", "float64", "separation of the subapertures along y, first minus second"),
    ("dx", "dx", "m", "float64", "separation of the subapertures along x, first minus second"),
    ("log_mu_grid", "log_mu_grid", "1", "float64", "log10 of the hyperparameter mu in m^(4/3)"),
    ("radial_order", "radial_order", "1", "int64", "radial order of Zernike modes"),
    ("log_amplitude", "log_amplitude", "1", "float64", "log-amplitude chi = ln(i / mean i) / 2, middle of a bin"),
    ("mu_factor", "mu_factor", "1", "float64", "mu of another profile, relative to the chosen one"),
    ("harmonic", "harmonic", "1", "int64", "multiple of the frequency of the vibration line"),
    ("frequency", "frequency", "Hz", "float64", "temporal frequency, middle of a cell of the spectrum"),
)

#: Coordinates that are the same in every product.
FIXED_COORDINATES: dict[str, NDArray[np.generic]] = {
    "radial_order": np.array(RADIAL_ORDERS, dtype=np.int64),
    "log_amplitude": LOG_AMPLITUDES,
    "mu_factor": np.array(MU_FACTORS),
    "harmonic": np.array(HARMONICS, dtype=np.int64),
}

#: Every other variable of a product, schema version 1.
SCHEMA = _schema(
    ("time_bounds", "time bound", "ns", "int64", "start and end of the batch"),
    ("z_bounds", "z bound", "m", "float64", "borders of the slices"),
    ("z_max", "", "m", "float64", "largest distance at which both sources share turbulence, of two sources"),
    ("z_first", "", "m", "float64", "distance that triangulation tells from the pupil, of two sources"),
    ("fresnel_scale", "z", "m", "float64", "size sqrt(lambda z L / (L - z)) of the scintillation on the pupil"),
    ("height_above_ground", "z", "m", "float64", "height of the line of sight above ground in mid-slice"),
    ("flux_height", "z", "m", "float64", "(mean of h^(-4/3) over the slice)^(-3/4), the height that fluxes are of"),
    ("border_height", "z bound", "m", "float64", "height of the line of sight above ground at the slice's borders"),
    ("scintillometer_offset", "scintillometer", "m", "float64", "lateral distance of its path, positive to the right"),
    ("scintillometer_height", "scintillometer z", "m", "float64", "height of its beam above ground, as flux_height"),
    ("scintillometer_height_factor", "scintillometer z", "1", "float64", "Cn2 at its height over Cn2 of the profile"),
    ("scintillometer_weight", "scintillometer z", "1", "float64", "part of a slice in the Cn2 of a scintillometer"),
    ("response_slope", "slope_kind dy dx z", "rad^2 m^(2/3)", "float64", "slope maps per Cn2 of a slice"),
    ("response_intensity", "intensity_kind dy dx z", "m^(2/3)", "float64", "scintillation maps per Cn2 of a slice"),
    ("cn2", "time z", "m^(-2/3)", "float64", "refractive index structure parameter Cn2"),
    ("cn2_standard_error", "time z", "m^(-2/3)", "float64", "MAP error bar of Cn2"),
    ("cn2_standard_error_ml", "time z", "m^(-2/3)", "float64", "maximum-likelihood error bar of Cn2"),
    ("cn2_interval_68", "time z bound", "m^(-2/3)", "float64", "shortest interval of the posterior holding 68 %"),
    ("cn2_interval_95", "time z bound", "m^(-2/3)", "float64", "shortest interval of the posterior holding 95 %"),
    ("cn2_posterior_mean", "time z", "m^(-2/3)", "float64", "mean of the positive posterior of Cn2"),
    ("resolution_length", "time z", "m", "float64", "path that an estimate stands for; NaN: not resolved"),
    ("cn2_path_mean", "time", "m^(-2/3)", "float64", "mean of Cn2 along the path"),
    ("cn2_path_mean_interval_68", "time bound", "m^(-2/3)", "float64", "shortest interval of it holding 68 %"),
    ("cn2_path_average", "time scintillometer", "m^(-2/3)", "float64", "mean of Cn2 as a scintillometer weights it"),
    (
        "cn2_path_average_interval_68",
        "time scintillometer bound",
        "m^(-2/3)",
        "float64",
        "shortest interval of it holding 68 %",
    ),
    ("cn2_path_average_standard_error", "time scintillometer", "m^(-2/3)", "float64", "its posterior deviation"),
    ("cn2_posterior_covariance", "time z z_true", "m^(-4/3)", "float64", "covariance of the positive posterior of Cn2"),
    ("cn2_scintillometer", "time scintillometer", "m^(-2/3)", "float64", "Cn2 that a scintillometer measured"),
    ("cn2_scintillometer_standard_error", "time scintillometer", "m^(-2/3)", "float64", "by its scatter in the batch"),
    ("cn2_scintillometer_coverage", "time scintillometer", "1", "float64", "part of the batch that its values cover"),
    ("scintillometer_log_amplitude_variance", "time scintillometer", "1", "float64", "variance behind that Cn2"),
    ("scintillometer_saturated", "time scintillometer", "1", "uint8", "1 where that Cn2 is beyond its range"),
    ("comparison_count", "scintillometer", "1", "int64", "batches in which profile and scintillometer have a value"),
    ("comparison_ratio", "scintillometer", "1", "float64", "geometric mean of cn2_path_average / cn2_scintillometer"),
    ("comparison_ratio_error", "scintillometer", "1", "float64", "standard error of it, from the scatter"),
    ("comparison_bias", "scintillometer", "m^(-2/3)", "float64", "mean of cn2_path_average - cn2_scintillometer"),
    ("comparison_bias_error", "scintillometer", "m^(-2/3)", "float64", "standard error of it"),
    ("comparison_slope", "scintillometer", "1", "float64", "line of the logarithms, with errors in both"),
    ("comparison_slope_error", "scintillometer", "1", "float64", "standard error of it"),
    ("comparison_offset", "scintillometer", "1", "float64", "log10 of the line's ratio at the middle of the data"),
    ("comparison_correlation", "scintillometer", "1", "float64", "correlation of the logarithms"),
    ("comparison_scatter", "scintillometer", "1", "float64", "standard deviation of the logarithm of the ratio"),
    ("comparison_expected_scatter", "scintillometer", "1", "float64", "the same if errors alone made it"),
    ("effective_height", "scintillometer", "m", "float64", "height that stands for its beam under free convection"),
    ("cn2_height_model", "time z", "m^(-2/3)", "float64", "Cn2 as (height above ground)^(-4/3), with the same r0"),
    ("ct2", "time z", "K^2 m^(-2/3)", "float64", "structure parameter of temperature CT2"),
    ("ct2_interval_68", "time z bound", "K^2 m^(-2/3)", "float64", "shortest interval of it holding 68 %"),
    ("sensible_heat_flux", "time z", "W/m^2", "float64", "sensible heat flux, upward"),
    ("sensible_heat_flux_interval_68", "time z bound", "W/m^2", "float64", "shortest interval of it holding 68 %"),
    ("sensible_heat_flux_free_convection", "time z", "W/m^2", "float64", "sensible heat flux of free convection"),
    ("friction_velocity", "time z", "m/s", "float64", "friction velocity"),
    ("temperature_scale", "time z", "K", "float64", "temperature scale of similarity, positive if stable"),
    ("obukhov_length", "time z", "m", "float64", "Obukhov length, positive if stable"),
    ("flux_state", "time z", "1", "uint8", "how the heat flux came about, or why there is none"),
    ("flux_solved_fraction", "time z", "1", "float64", "part of the posterior whose similarity equations are solved"),
    ("temperature", "time", "K", "float64", "air temperature"),
    ("pressure", "time", "Pa", "float64", "air pressure"),
    ("specific_humidity", "time", "1", "float64", "specific humidity"),
    ("bowen_ratio", "time", "1", "float64", "Bowen ratio; infinite where humidity does not fluctuate"),
    ("wind_speed", "time", "m/s", "float64", "wind speed"),
    ("stability", "time", "1", "int8", "-1 unstable, 1 stable, 0 unknown"),
    ("cn2_other_mu", "time mu_factor z", "m^(-2/3)", "float64", "most probable profile at another mu"),
    ("cn2_other_mu_standard_error", "time mu_factor z", "m^(-2/3)", "float64", "MAP error bar of cn2_other_mu"),
    ("cn2_at_bound", "time z", "1", "uint8", "1 where the positivity constraint is active"),
    ("averaging_kernel", "time z z_true", "1", "float64", "response of the retrieved to the true profile"),
    ("degrees_of_freedom", "time", "1", "float64", "degrees of freedom for signal"),
    ("mu", "time", "m^(4/3)", "float64", "regularisation hyperparameter"),
    ("criterion", "time log_mu_grid", "1", "float64", "criterion curve that mu was chosen from"),
    ("slope_correlation", "time slope_kind dy dx", "rad^2", "float64", "measured slope correlation maps"),
    ("slope_correlation_model", "time slope_kind dy dx", "rad^2", "float64", "slope maps of the profile"),
    ("slope_correlation_error", "time slope_kind dy dx", "rad^2", "float64", "convergence noise, 1 sigma"),
    (
        "slope_correlation_correction",
        "time slope_kind dy dx",
        "rad^2",
        "float64",
        "added before the fit, against weighting data with their own covariance",
    ),
    ("intensity_correlation", "time intensity_kind dy dx", "1", "float64", "measured scintillation maps"),
    ("intensity_correlation_model", "time intensity_kind dy dx", "1", "float64", "scintillation maps of the profile"),
    ("intensity_correlation_error", "time intensity_kind dy dx", "1", "float64", "convergence noise, 1 sigma"),
    (
        "intensity_correlation_correction",
        "time intensity_kind dy dx",
        "1",
        "float64",
        "added before the fit, against weighting data with their own covariance",
    ),
    ("pair_count", "dy dx", "1", "int64", "pairs of subapertures of a separation"),
    ("r0_profile", "time", "m", "float64", "Fried parameter of a spherical wave, from the profile"),
    ("r0_interval_68", "time bound", "m", "float64", "shortest interval of r0_profile holding 68 %"),
    ("scintillation_index_direct", "time source", "1", "float64", "variance of the relative flux, noise removed"),
    ("scintillation_index_profile", "time", "1", "float64", "aperture- and source-averaged index of the profile"),
    ("scintillation_index_interval_68", "time bound", "1", "float64", "shortest interval of it holding 68 %"),
    ("scintillation_index_point", "time", "1", "float64", "index of one point of the source, from the profile"),
    ("scintillation_index_point_slice", "time z", "1", "float64", "contribution of each slice to that index"),
    ("strong_slice", "time z", "1", "uint8", "1 where that contribution alone ends first-order theory"),
    ("scintillation_rounds", "time", "1", "int64", "rounds of the correction for strong scintillation"),
    ("mean_flux", "time source", "count", "float64", "mean flux of a spot"),
    ("noise_variance_slope", "time axis", "rad^2", "float64", "detection noise of the slopes, joint estimate"),
    ("noise_variance_intensity", "time", "1", "float64", "detection noise of the relative flux, joint estimate"),
    ("noise_variance_slope_error", "time axis", "rad^2", "float64", "standard error of noise_variance_slope"),
    ("noise_variance_intensity_error", "time", "1", "float64", "standard error of noise_variance_intensity"),
    ("slope_offset", "time axis", "rad^2", "float64", "constant of the slope maps, joint estimate"),
    ("slope_offset_error", "time axis", "rad^2", "float64", "standard error of slope_offset"),
    (
        "noise_variance_slope_detector",
        "time source axis",
        "rad^2",
        "float64",
        "detection noise of the slopes, predicted",
    ),
    ("noise_variance_intensity_detector", "time source", "1", "float64", "detection noise of relative flux, predicted"),
    ("centroid_gain", "time source axis", "1", "float64", "response of the slopes to a known tilt of the mean spot"),
    ("vibration_frequency", "time", "Hz", "float64", "vibration line, at its alias if above half the frame rate"),
    ("vibration_variance", "time axis", "rad^2", "float64", "variance of the slopes by the vibration line"),
    ("vibration_harmonic_variance", "time harmonic axis", "rad^2", "float64", "the same by harmonics of that line"),
    ("slope_spectrum", "time axis frequency", "rad^2/Hz", "float64", "spectral density of the pupil-mean slopes"),
    ("vibration_significance", "time", "1", "float64", "strongest line over the continuum, in its deviations"),
    ("zernike_variance", "time source radial_order", "rad^2", "float64", "variance per mode of phase, noise removed"),
    (
        "zernike_variance_kolmogorov",
        "time source radial_order",
        "rad^2",
        "float64",
        "the same of turbulence with r0_direct",
    ),
    ("zernike_misfit", "time source", "1", "float64", "rms of ln(variance / Kolmogorov) over radial orders 2 to 5"),
    ("r0_direct", "time source", "m", "float64", "Fried parameter from Zernike variances of the extended source"),
    ("log_amplitude_count", "time source log_amplitude", "1", "int64", "histogram of the log-amplitude"),
    ("log_amplitude_mean", "time source", "1", "float64", "mean of the Gaussian fitted to the log-amplitude"),
    ("log_amplitude_deviation", "time source", "1", "float64", "standard deviation of that Gaussian"),
    ("log_amplitude_distance", "time source", "1", "float64", "largest difference of its cumulative distribution"),
    ("stationarity_deviation", "time axis_kind", "1", "float64", "largest deviation of a third's variance, relative"),
    ("stationarity_error", "time axis_kind", "1", "float64", "the same by chance for one third, 1 sigma"),
    ("spot_drift", "time source axis", "rad", "float64", "linear drift of the spots over the batch"),
    ("flux_drift", "time source", "1", "float64", "linear drift of the light over the batch, relative"),
    ("frame_rate_measured", "time", "Hz", "float64", "frame rate from the time stamps, without gaps"),
    ("time_jitter", "time", "s", "float64", "scatter of the steps of the time stamps, without gaps"),
    ("n_missing", "time", "1", "int64", "frames missing in gaps of the time stamps"),
    ("n_repeated", "time", "1", "int64", "frames that repeat the one before, left out"),
    ("out_fraction", "time source", "1", "float64", "part of the frames in which the source is out, left out"),
    ("n_frames", "time", "1", "int64", "frames in the batch"),
    ("n_effective", "time axis_kind", "1", "float64", "effectively independent frames for x, y slopes and flux"),
    ("valid_fraction", "time source", "1", "float64", "fraction of slopes and fluxes that could be measured"),
    ("chi2_reduced", "time", "1", "float64", "misfit per independent datum"),
    ("quality_flag", "time", "1", "int32", "quality flags"),
    ("quality_level", "time", "1", "int8", "0 good, 1 usable with care, 2 bad"),
)

#: Bits of `quality_flag`: name -> (bit, level it sets, meaning).
QUALITY_FLAGS: dict[str, tuple[int, int, str]] = {
    "failed": (1, 2, "the batch could not be processed; its variables are NaN"),
    "short": (2, 1, "less than half of the requested batch length"),
    "gaps": (4, 1, "more than 1 % of the frames are missing"),
    "lost_spots": (8, 1, "more than 1 % of the spots could not be measured"),
    "saturated": (16, 1, "more than 1 % of the spots hold a saturated pixel"),
    "mu_at_edge": (32, 1, "the criterion has its minimum at the edge of the range of mu"),
    "negative_noise": (64, 1, "a joint noise variance is negative by more than three of its errors"),
    "poor_fit": (128, 1, "chi2 per datum above 3"),
    "strong_scintillation": (256, 1, "index of one point of the source above 0.3: first-order theory fails"),
    "irregular_time": (
        512,
        1,
        "time stamps run backward, scatter by a quarter of a frame, or are 1 % off the frame rate",
    ),
    "repeated_frames": (1024, 1, "more than 1 % of the frames repeat the one before; they are left out"),
    "source_out": (2048, 1, "a source is out in more than 1 % of the frames, which are left out"),
    "drifting_spots": (
        4096,
        1,
        "a minute or more in which a drift of the spots holds a quarter of the slope variance of a source",
    ),
    "drifting_flux": (
        8192,
        1,
        "a minute or more in which a drift of the light holds a tenth of the scintillation of a source",
    ),
    "vibration": (16384, 0, "a vibration line is found in the slopes"),
    "tilt_response": (32768, 1, "slopes answer to a known tilt with a gain that is 5 % or more off 1"),
    "not_kolmogorov": (65536, 1, "Zernike variances of radial orders 2 to 5 are not in Kolmogorov's ratio"),
    "not_lognormal": (131072, 1, "the log-amplitude is not Gaussian"),
    "rytov_limit": (262144, 2, "a measured scintillation index is above 1.2, the limit of weak perturbations"),
    "not_stationary": (524288, 1, "a variance differs between the thirds of the batch by more than 30 % and chance"),
    "unsettled_correction": (1048576, 1, "the rounds of the correction for strong scintillation do not settle"),
}


@dataclass(frozen=True)
class BatchResult:
    """Everything one batch contributes to a product.

    Parameters
    ----------
    start, stop : int
        Time bounds, ns since 1970-01-01T00:00:00 UTC.
    values : dict of str to ndarray
        Variables of :data:`SCHEMA` without their time dimension.
    quality_flag : int
        Bits of :data:`QUALITY_FLAGS`.
    reason : str
        Why the batch failed; empty where it did not.
    """

    start: int
    stop: int
    values: dict[str, NDArray[np.generic]]
    quality_flag: int = 0
    reason: str = ""

    @property
    def quality_level(self) -> int:
        """0 good, 1 usable with care, 2 bad."""
        return max([0, *(level for bit, level, _ in QUALITY_FLAGS.values() if self.quality_flag & bit)])
