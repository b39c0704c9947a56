"""Heights of a scintillometer's beam over the terrain of the profiler, and what they make of Cn2."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from coslidar.pipeline.beam_heights import (
    SightHeights,
    beam_heights,
    carried_weights,
    height_factors,
    mean_separation,
    scaled_weights,
    sight_heights,
)
from coslidar.pipeline.comparison import Separation
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.parameters import Path, Scintillometer
from coslidar.pipeline.scintillometer import slice_weights, variance_weight

LENGTH = 2670.0
GRID = SliceGrid.uniform(LENGTH, 12)


def las(**changes: Any) -> Scintillometer:
    given = {"name": "A", "wavelength": "0.88 um", "diameters": ["14.5 cm", "14.5 cm"]}
    return Scintillometer.model_validate(given | changes)


def sight(path: dict[str, Any]) -> SightHeights:
    found = sight_heights(Path.model_validate({"length": "2670 m"} | path), GRID)
    assert found is not None
    return found


def shares(one: Scintillometer) -> np.ndarray:
    return slice_weights(GRID, one.ends(LENGTH), *one.diameters, one.wavelength)


def test_level_beams_over_level_ground() -> None:
    """(4 m / 20 m)^(-4/3) of the profile, whatever it is."""
    one = las(heights=["4 m", "4 m"], height_scaling="free_convection")
    line = sight({"height": "20 m"})
    assert beam_heights(one, LENGTH, GRID, line) == pytest.approx(np.full(12, 4.0), rel=1e-14)
    weights = scaled_weights(one, LENGTH, GRID, shares(one), line)
    assert weights == pytest.approx(shares(one) * 0.2 ** (-4 / 3), rel=1e-13)
    cn2 = np.linspace(1, 6, 12) * 1e-15
    assert weights @ cn2 == pytest.approx(5 ** (4 / 3) * (shares(one) @ cn2), rel=1e-13)


def test_not_unless_asked_for() -> None:
    one = las(heights=["4 m", "4 m"], offset="120 m")
    assert scaled_weights(one, LENGTH, GRID, shares(one), sight({"height": "20 m"})) == pytest.approx(shares(one))
    # On the line of sight there is nothing to carry.
    same = las(heights=["20 m", "20 m"], height_scaling="free_convection")
    assert scaled_weights(same, LENGTH, GRID, shares(same), sight({"height": "20 m"})) == pytest.approx(shares(one))


def test_separation_is_linear_whatever_the_ground_does() -> None:
    """The beam is 2 m below the line of sight at 300 m and 8 m below at 2300 m; a hill lifts the ground below both."""
    z = np.linspace(0, 2670, 60)
    above = 30 - 12 * np.exp(-(((z - 1300) / 500) ** 2))
    line = sight({"heights": [[f"{a} m", f"{h} m"] for a, h in zip(z, above, strict=True)]})
    borders = np.interp([300, 2300], GRID.edges, line.borders)
    one = las(heights=[f"{borders[0] - 2} m", f"{borders[1] - 8} m"], start="300 m", end="2300 m")
    found = beam_heights(one, LENGTH, GRID, line) - line.effective
    inner = (GRID.edges[:-1] > np.float64(300)) & (GRID.edges[1:] < np.float64(2300))
    assert found[inner] == pytest.approx(-2 - 6 * (GRID.centres[inner] - 300) / 2000, rel=1e-9)
    assert np.isnan(found[[0, 11]]).all()  # 0 to 222 m and 2447 to 2670 m, which it does not look through
    assert np.isfinite(found[1:11]).all()
    # Symmetric weights: the mean is that of mid-path.
    level = las(heights=["15 m", "15 m"])
    flat = sight({"height": "20 m"})
    assert mean_separation(beam_heights(level, LENGTH, GRID, flat), flat.effective, shares(level)) == pytest.approx(-5)


def test_against_the_integral_along_the_path() -> None:
    """Free convection over uniform ground, seen by both: the carried average is that of the beam itself.

    The line of sight rises from 20 to 30 m, the beam from 10 to 18 m. The profile holds the means of h^(-4/3) over its
    slices. Slices of one twelfth: weight and height vary along them together, which a mean per slice cannot know.
    """
    line = sight({"heights": [["0 m", "20 m"], ["2670 m", "30 m"]]})
    one = las(heights=["10 m", "18 m"], height_scaling="free_convection", diameters=["5 cm", "14.5 cm"])

    def profiler(z: float) -> float:
        return float((20 + 10 * z / LENGTH) ** (-4 / 3))

    cn2 = np.array([quad(profiler, a, b)[0] / (b - a) for a, b in zip(GRID.edges[:-1], GRID.edges[1:], strict=True)])
    z = (np.arange(1200) + 0.5) * LENGTH / 1200
    weight = variance_weight(z, LENGTH, 0.05, 0.145, 0.88e-6)
    beam = weight @ (10 + 8 * z / LENGTH) ** (-4 / 3) / weight.sum()
    carried = scaled_weights(one, LENGTH, GRID, shares(one), line) @ cn2
    assert carried == pytest.approx(beam, rel=3e-3)
    assert shares(one) @ cn2 < 0.6 * beam  # without carrying


def test_errors_are_carried_with_the_factors() -> None:
    """Draws of slices, each carried, against the quadratic form."""
    factors = height_factors(np.array([4.0, 5.0, 6.0]), np.array([8.0, 8.0, 8.0]))
    assert factors == pytest.approx(np.array([0.5, 0.625, 0.75]) ** (-4 / 3), rel=1e-14)
    weights = np.array([0.2, 0.5, 0.3])
    covariance = np.array([[4.0, -1.0, 0.0], [-1.0, 3.0, -0.5], [0.0, -0.5, 2.0]])
    draws = np.random.default_rng(1).multivariate_normal([20, 30, 40], covariance, 200_000)
    carried = carried_weights(weights, factors)
    # The deviation of so many draws is known to 0.16 %; four times that.
    assert np.sqrt(carried @ covariance @ carried) == pytest.approx((draws * factors @ weights).std(), rel=6.4e-3)


def test_a_height_that_nobody_looks_at_need_not_be_known() -> None:
    carried = carried_weights(np.array([0.0, 1.0]), height_factors(np.array([np.nan, 4.0]), np.array([8.0, 8.0])))
    assert carried == pytest.approx([0, 0.5 ** (-4 / 3)])
    assert np.isnan(height_factors(np.array([0.0, -1.0]), np.ones(2))).all()


def test_faults() -> None:
    low = las(heights=["1 m", "1 m"])
    valley = sight({"heights": [["0 m", "20 m"], ["1335 m", "10 m"], ["2670 m", "20 m"]]})
    with pytest.raises(ValueError, match=r"m below the ground at 1[24]\d\d m; check heights"):
        scaled_weights(low, LENGTH, GRID, shares(low), valley)
    carried = las(heights=["4 m", "4 m"], height_scaling="free_convection")
    with pytest.raises(ValueError, match="needs the height of the line of sight"):
        scaled_weights(carried, LENGTH, GRID, shares(carried), None)
    with pytest.raises(ValueError, match="it needs heights"):
        las(height_scaling="free_convection")


def test_separation_in_words() -> None:
    assert Separation().text() == "-"
    assert Separation(-120.0, -3.25, True).text() == "120 m left, 3.2 m below, carried as h^(-4/3)"
    assert Separation(15.0, 2.0).text() == "15 m right, 2.0 m above"
