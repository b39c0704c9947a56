"""Parameters of optical links against the closed forms of textbooks and a quadrature of another kind."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import beta

from coslidar.pipeline import turbulence
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.optical_parameters import AT_R0, INDEX, PHASE, optical_parameters

L, CN2, WAVELENGTH = 2670.0, 2e-15, 1.55e-6
GRID = SliceGrid.uniform(L, 12)
K = 2 * np.pi / WAVELENGTH
UNIFORM = np.full(12, CN2)
PROFILE = np.linspace(1, 6, 12) * 1e-15


def test_constants() -> None:
    # Andreas and Phillips print 6.88, 2.91, 0.423 and 2.25.
    assert pytest.approx([6.88, 2.25], rel=2e-3) == [AT_R0, INDEX]
    assert pytest.approx(0.423, rel=1e-3) == PHASE / AT_R0


def test_uniform_path() -> None:
    plane = optical_parameters(UNIFORM, GRID, WAVELENGTH, L, wave="plane", wind=np.full(12, 3.0))
    spherical = optical_parameters(UNIFORM, GRID, WAVELENGTH, L, wind=np.full(12, 3.0))
    # Andrews and Phillips 2005: sigma_R^2 = 1.23 Cn2 k^(7/6) L^(11/6), beta_0^2 = 0.4 sigma_R^2;
    # r0 = [0.423 ...]^(-3/5), [3/8 ...]^(-3/5) for the spherical wave. Three printed digits.
    rytov = 1.23 * CN2 * K ** (7 / 6) * L ** (11 / 6)
    assert float(plane.rytov_variance) == pytest.approx(rytov, rel=5e-3)
    assert float(spherical.rytov_variance) == pytest.approx(0.404 * rytov, rel=5e-3)
    r0 = (0.423 * K**2 * CN2 * L) ** (-3 / 5)
    assert float(plane.fried_parameter) == pytest.approx(r0, rel=1e-3)
    assert float(spherical.fried_parameter) == pytest.approx(r0 * (3 / 8) ** (-3 / 5), rel=1e-3)
    # 0.314 r0 / h of Fried (1982), with h^(5/3) = 3/8 L^(5/3), and 0.314 r0 / v of Roddier (1981).
    assert float(plane.isoplanatic_angle) == pytest.approx(0.314 * r0 / ((3 / 8) ** 0.6 * L), rel=2e-3)
    assert float(plane.coherence_time) == pytest.approx(0.314 * r0 / 3.0, rel=2e-3)
    assert float(spherical.coherence_time) == float(plane.coherence_time)
    assert bool(plane.weak)


def test_as_the_instrument_sees_it() -> None:
    found = optical_parameters(PROFILE, GRID, 3.8e-6, L)
    # The same formula elsewhere, with the constant printed to three digits.
    assert float(found.fried_parameter) == pytest.approx(
        float(turbulence.fried_parameter(PROFILE, GRID, 3.8e-6, L)), rel=1e-3
    )
    assert float(found.rytov_variance) == pytest.approx(
        float(turbulence.point_source_index(PROFILE, GRID, 3.8e-6, L)), rel=1e-9
    )
    assert np.isnan(found.coherence_time)


def test_the_other_way_round() -> None:
    back = optical_parameters(PROFILE, GRID, WAVELENGTH, L, direction="toward_sources")
    mirrored = optical_parameters(PROFILE[::-1], GRID, WAVELENGTH, L)
    assert float(back.fried_parameter) == pytest.approx(float(mirrored.fried_parameter), rel=1e-12)
    assert float(back.isoplanatic_angle) == pytest.approx(float(mirrored.isoplanatic_angle), rel=1e-12)
    forward = optical_parameters(PROFILE, GRID, WAVELENGTH, L)
    # Strong turbulence beside the transmitter bends rays that hardly move the receiver's phase.
    assert float(back.fried_parameter) < float(forward.fried_parameter)
    # The scintillation of a point seen by a point is the same either way.
    assert float(back.rytov_variance) == pytest.approx(float(forward.rytov_variance), rel=1e-12)


@pytest.mark.parametrize("wave", ["spherical", "plane"])
def test_by_adaptive_quadrature(wave: str) -> None:
    found = optical_parameters(PROFILE, GRID, WAVELENGTH, L, wave=wave)  # type: ignore[arg-type]

    def integral(low: float, high: float) -> float:
        edges = np.array(GRID.edges)
        return sum(
            c * quad(lambda z: z**low * (1 - z / L) ** (high if wave == "spherical" else 0), a, b, epsabs=0)[0]
            for c, a, b in zip(PROFILE, edges[:-1], edges[1:], strict=True)
        )

    assert float(found.fried_parameter) == pytest.approx(
        (PHASE / AT_R0 * K**2 * integral(0, 5 / 3)) ** (-3 / 5), rel=1e-9
    )
    assert float(found.rytov_variance) == pytest.approx(INDEX * K ** (7 / 6) * integral(5 / 6, 5 / 6), rel=1e-9)


def test_a_link_shorter_than_the_profile() -> None:
    short = optical_parameters(UNIFORM, GRID, WAVELENGTH, 1000.0)
    expected = INDEX * K ** (7 / 6) * CN2 * 1000.0 ** (11 / 6) * beta(11 / 6, 11 / 6)
    assert float(short.rytov_variance) == pytest.approx(expected, rel=1e-10)


def test_many_profiles_and_none() -> None:
    found = optical_parameters(np.stack([PROFILE, 0 * PROFILE]), GRID, WAVELENGTH, L, wind=np.full(12, 2.0))
    assert found.fried_parameter.shape == (2,)
    assert found.fried_parameter[1] == np.inf
    assert found.coherence_time[1] == np.inf
    assert found.rytov_variance[1] == pytest.approx(0)
    assert not optical_parameters(PROFILE * np.nan, GRID, WAVELENGTH, L).weak
    with pytest.raises(ValueError, match="positive and finite"):
        optical_parameters(PROFILE, GRID, WAVELENGTH, np.inf)
