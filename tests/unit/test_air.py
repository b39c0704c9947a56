"""Refractive index of humid air and its derivatives, against published values and other formulas."""

from __future__ import annotations

import numpy as np
import pytest

from coslidar.pipeline import air


@pytest.mark.parametrize(
    ("celsius", "pressure", "published"),
    # Ciddor 1996, Table 1: dry air with 450 ppm of CO2 at 633 nm, 1e8 (n - 1).
    [(20, 80e3, 21458.0), (20, 100e3, 26824.4), (20, 120e3, 32191.6), (10, 100e3, 27774.7), (30, 100e3, 25937.2)],
)
def test_dry_air_of_ciddor(celsius: float, pressure: float, published: float) -> None:
    found = 1e8 * air.refractivity(633e-9, celsius + 273.15, pressure, 0.0, co2=450e-6)
    assert float(found) == pytest.approx(published, rel=3e-6)  # one unit of the last digit


def test_vapour_at_633_nm() -> None:
    # Birch and Downs (1993, Metrologia 30, 155): -f (3.7345 - 0.0401 s^2) 1e-10 for a vapour pressure f in Pa, made at
    # 20 degC and one atmosphere; the two agree to a per cent of it.
    t, p, f = 293.15, 101325.0, 1000.0
    q = air.MOLAR_RATIO * f / (p - (1 - air.MOLAR_RATIO) * f)
    change = float(air.refractivity(633e-9, t, p, q) - air.refractivity(633e-9, t, p, 0.0))
    assert change == pytest.approx(-f * (3.7345 - 0.0401 / 0.633**2) * 1e-10, rel=0.02)


@pytest.mark.parametrize("wavelength", [1.3e-6, 1.5e-6, 1.69e-6])
@pytest.mark.parametrize("humidity", [0.0, 0.5])
def test_both_formulas_where_they_overlap(wavelength: float, humidity: float) -> None:
    t, p = np.array(290.0), np.array(1e5)
    f = humidity * air.saturation_pressure(t)
    one, other = air._ciddor(wavelength, t, p, f, 370e-6), air._mathar(wavelength, t, p, f, 0)
    assert one == pytest.approx(other, rel=3e-4)  # Mathar 2007 says 1e-7 of n - 1 = 2.7e-4


def test_slopes_in_visible_light() -> None:
    t, p = 288.0, 1.013e5
    q = air.specific_humidity(t, p, 0.6)
    slopes = air.index_slopes(0.88e-6, t, p, q)
    # Wesely (1976): A_T = -0.78e-6 p / T; the digits given.
    assert float(slopes.per_temperature * t) == pytest.approx(-0.78e-6 * p / t, rel=7e-3)
    # c_p b / (L_v a) = 0.03 in his (1 + 0.03 / beta)^2: one digit, and 0.026 with today's index of vapour.
    share = air.heat_capacity(q) / air.latent_heat(t) * slopes.per_humidity / slopes.per_temperature
    assert 0.025 < float(share) < 0.03


def test_vapour_weighs_more_in_the_mid_infrared() -> None:
    t, p, q = 288.0, 1.013e5, 0.008

    def share(wavelength: float) -> float:
        slopes = air.index_slopes(wavelength, t, p, q)
        return float(air.heat_capacity(q) / air.latent_heat(t) * slopes.per_humidity / slopes.per_temperature)

    # Colavita et al. 2004 (Publications of the Astronomical Society of the Pacific 116, 876) show the refractivity of
    # vapour fall from K to L band, that is away from dry air's; dry air itself hardly disperses.
    assert share(0.88e-6) < share(2.2e-6) < share(3.4e-6) < share(3.8e-6)
    dry = [float(air.refractivity(w, t, p)) for w in (2.2e-6, 3.8e-6)]
    assert dry[0] == pytest.approx(dry[1], rel=2e-3)


def test_derivatives_by_closed_form() -> None:
    # Of an ideal gas, T dn/dT = -(n - 1); the compressibility of air, Z = 1 - 3e-4 near 295 K and
    # nearer to 1 when it warms, adds 3e-3.
    t, p = 295.0, 0.95e5
    slopes = air.index_slopes(0.67e-6, t, p)
    assert float(slopes.per_temperature * t) == pytest.approx(-float(air.refractivity(0.67e-6, t, p)), rel=4e-3)


def test_outside_of_the_formulas() -> None:
    for wavelength in (0.2e-6, 2.6e-6, 4.3e-6, 10e-6):
        assert not air.covered(wavelength)
        with pytest.raises(ValueError, match="humid air is known from"):
            air.refractivity(wavelength, 290.0, 1e5)
    assert air.covered(0.88e-6)
    assert air.covered(3.8e-6)


def test_humid_air() -> None:
    # CIPM-2007 and Smithsonian tables: 2339 Pa at 20 degC, 611.2 Pa at 0 degC.
    assert air.saturation_pressure([273.15, 293.15]) == pytest.approx([611.2, 2339.0], rel=1e-3)
    # Psychrometric tables: 7.3 g/kg at 20 degC, 50 %, one atmosphere; density 1.1994 kg/m^3.
    q = air.specific_humidity(293.15, 101325.0, 0.5)
    assert float(q) == pytest.approx(7.24e-3, rel=5e-3)
    assert float(air.density(293.15, 101325.0, q)) == pytest.approx(1.1989, rel=1e-3)
    assert float(air.vapour_pressure(101325.0, q)) == pytest.approx(0.5 * 2339.0, rel=1e-3)


def test_ct2_of_wesely() -> None:
    t, p = 290.0, 1e5
    # Chosen so that s b / a = 0.03 / beta.
    a = -0.78e-6 * p / t**2
    s = float(air.heat_capacity() / air.latent_heat(t))
    slopes = air.IndexSlopes(np.array(a), np.array(0.03 * a / s))
    for bowen in (-2.0, 0.3, 1.0, 5.0):
        cn2 = 1e-14
        expected = cn2 * (t**2 / (0.78e-6 * p)) ** 2 / (1 + 0.03 / bowen) ** 2
        assert float(cn2 * air.ct2_factor(slopes, t, bowen)) == pytest.approx(expected, rel=1e-12)
    assert float(air.ct2_factor(slopes, t)) == pytest.approx(1 / a**2, rel=1e-12)
    # Uncorrelated fluctuations add up without the mixed term.
    assert float(air.ct2_factor(slopes, t, 0.3, correlation=0.0)) == pytest.approx(1 / a**2 / (1 + 0.01), rel=1e-12)


def test_ct2_where_it_cannot_be_told() -> None:
    slopes = air.IndexSlopes(np.array(-1e-6), np.array(-7e-5))
    s = float(air.heat_capacity() / air.latent_heat(290.0))
    assert np.isnan(air.ct2_factor(slopes, 290.0, 0.0))
    assert np.isnan(air.ct2_factor(slopes, 290.0, -70 * s))  # temperature and humidity cancel each other


def test_ct2_of_drawn_fluctuations() -> None:
    """The two structure parameters follow from the index of air whose temperature and humidity differ at random."""
    rng = np.random.default_rng(3)
    t, p, q, bowen, wavelength = 290.0, 0.95e5, 0.008, 0.4, 3.8e-6
    dt = 0.1 * rng.standard_normal(20_000)
    dq = dt * air.heat_capacity(q) / (air.latent_heat(t) * bowen)
    index = air.refractivity(wavelength, t + dt, p, q + dq)
    factor = air.ct2_factor(air.index_slopes(wavelength, t, p, q), t, bowen, q)
    # Second order in 0.1 K / 290 K.
    assert float(factor) == pytest.approx(dt.var() / index.var(), rel=2e-3)
