"""Reports: the figures of a product, and one self-contained page with all of them.

Nothing here imports matplotlib, Jinja or xarray before a figure or a page is asked for.
"""

from __future__ import annotations

from .batch_panels import (
    draw_averaging_kernels,
    draw_correlation_cut,
    draw_correlation_map,
    draw_criterion,
    draw_kernel_sums,
    draw_profile,
)
from .check_panels import draw_log_amplitude, draw_spectrum, draw_zernike
from .flux_panels import draw_heat_flux, draw_height_model, draw_slice_flux
from .model_panels import draw_response, draw_sensitivity
from .page import BATCH_PANELS, TIME_PANELS, BatchPanel, TimePanel, figure, nothing_to_draw, render, write_report
from .printed import write_pdf, write_png
from .style import figure_style
from .time_panels import (
    draw_averages,
    draw_chi2,
    draw_fried_parameter,
    draw_log_mu,
    draw_quality,
    draw_relative,
    draw_scintillation,
    draw_selection,
    draw_time_distance,
)

__all__ = [
    "BATCH_PANELS",
    "TIME_PANELS",
    "BatchPanel",
    "TimePanel",
    "draw_averages",
    "draw_averaging_kernels",
    "draw_chi2",
    "draw_correlation_cut",
    "draw_correlation_map",
    "draw_criterion",
    "draw_fried_parameter",
    "draw_heat_flux",
    "draw_height_model",
    "draw_kernel_sums",
    "draw_log_amplitude",
    "draw_log_mu",
    "draw_profile",
    "draw_quality",
    "draw_relative",
    "draw_response",
    "draw_scintillation",
    "draw_selection",
    "draw_sensitivity",
    "draw_slice_flux",
    "draw_spectrum",
    "draw_time_distance",
    "draw_zernike",
    "figure",
    "figure_style",
    "nothing_to_draw",
    "render",
    "write_pdf",
    "write_png",
    "write_report",
]
