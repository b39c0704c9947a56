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
from .page import BATCH_PANELS, TIME_PANELS, BatchPanel, TimePanel, figure, nothing_to_draw, render, write_report
from .printed import write_pdf, write_png
from .style import figure_style
from .time_panels import (
    draw_chi2,
    draw_fried_parameter,
    draw_log_mu,
    draw_quality,
    draw_scintillation,
    draw_time_distance,
)

__all__ = [
    "BATCH_PANELS",
    "TIME_PANELS",
    "BatchPanel",
    "TimePanel",
    "draw_averaging_kernels",
    "draw_chi2",
    "draw_correlation_cut",
    "draw_correlation_map",
    "draw_criterion",
    "draw_fried_parameter",
    "draw_kernel_sums",
    "draw_log_mu",
    "draw_profile",
    "draw_quality",
    "draw_scintillation",
    "draw_time_distance",
    "figure",
    "figure_style",
    "nothing_to_draw",
    "render",
    "write_pdf",
    "write_png",
    "write_report",
]
