"""Theoretical covariance of slopes with fluxes and of x with y slopes against simulated signals."""

from __future__ import annotations

import numpy as np
import pytest

from coslidar.pipeline import experiment
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.simulation import BLOCK_FRAMES, Strength, TurbulentField
from coslidar.plugins.source_models import Gaussian
from coslidar.plugins.turbulence_spectra import Kolmogorov

GEOMETRY = experiment.scindar()
LAMP = Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm")
COUNT = 1500


@pytest.mark.slow
def test_products_of_two_kinds() -> None:
    """Sums of plane waves drawn at random against quadrature: every separation, both sources, both orders.

    Pairs of one separation are averaged, each within a draw, so that the scatter of the draws gives the error. No
    average deviates by 5 errors, and the factor between theory and simulation is 1 within 4 of its errors, which are
    small enough to see a lost sign, term or factor.
    """
    grid = SliceGrid.uniform(2670.0, 4)
    cn2 = np.array([1.0, 2.0, 0.5, 3.0]) * 1e-15
    field = TurbulentField(
        GEOMETRY, grid, Strength.constant(cn2), (3.0, 1.0), Kolmogorov(), [LAMP] * 2,
        frame_rate=BLOCK_FRAMES, seed=22, modes=64, lifetime=1.0, sampling="midpoint",
    )  # fmt: skip
    drawn = []
    for epoch in range(COUNT):
        slopes, flux = field.signals(epoch * field.epoch_frames, epoch * field.epoch_frames + 1)
        drawn.append(np.concatenate([slopes[0], flux - 1.0]))
    values = np.array(drawn)  # draws, kind, source, subaperture
    theory = experiment.channel_covariance(GEOMETRY, grid, cn2, Kolmogorov(), [LAMP] * 2).reshape(3, 2, 20, 3, 2, 20)
    i, j = GEOMETRY.subaperture_index.T
    place = ((i[:, None] - i + 4) * 9 + j[:, None] - j + 4).ravel()
    average = np.zeros((400, 81))
    average[np.arange(400), place] = 1.0 / GEOMETRY.pair_count.ravel()[place]
    seen = GEOMETRY.pair_count.ravel() > 0
    for one, two in ((0, 1), (0, 2), (1, 2)):
        scales = 0.0
        for first in range(2):
            for second in range(2):
                products = values[:, one, first, :, None] * values[:, two, second, None, :]
                found = (products.reshape(COUNT, 400) @ average)[:, seen]
                expected = (theory[one, first, :, two, second].ravel() @ average)[seen]
                error = found.std(axis=0) / np.sqrt(COUNT)
                assert np.abs((found.mean(axis=0) - expected) / error).max() < 5
                # Factor that brings theory to each draw.
                scales = scales + (found / error) @ (expected / error) / np.sum((expected / error) ** 2) / 4
        uncertainty = np.std(scales) / np.sqrt(COUNT)
        assert uncertainty < 0.15
        assert abs(np.mean(scales) - 1) < 4 * uncertainty
