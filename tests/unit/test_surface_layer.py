"""Heat fluxes against closed forms, against the equations themselves, and over the whole physical range."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from coslidar.pipeline import surface_layer as sl
from coslidar.pipeline.air import GRAVITY, KARMAN

WIND = {"wind_height": 3.4, "roughness": 1e-3}
SETS = sorted(sl.SIMILARITIES)


@pytest.mark.parametrize("name", SETS)
def test_free_convection_against_its_analytic_form(name: str) -> None:
    """Far on the unstable side u* |T*| no longer depends on u*: take it from f_T there."""
    similarity = sl.SIMILARITIES[name]
    ct2, z, t = 0.2, 20.0, 295.0
    zeta = -1e7
    star = np.sqrt(ct2 * z ** (2 / 3) / similarity(zeta))
    friction = np.sqrt(KARMAN * GRAVITY * z * star / (t * -zeta))
    assert float(sl.free_convection(ct2, z, t, similarity=similarity)) == pytest.approx(
        float(friction * star), rel=1e-5
    )
    assert float(sl.free_convection(0.0, z, t)) == 0.0
    # CT2 falls as z^(-4/3) at a given flux, so that the flux goes as z CT2^(3/4).
    assert float(sl.free_convection(ct2 * 2 ** (-4 / 3), 2 * z, t)) == pytest.approx(
        float(sl.free_convection(ct2, z, t)), rel=1e-12
    )


def test_constant_of_andreas() -> None:
    # H = 0.48 rho c_p z (g / T)^(1/2) CT2^(3/4) in the literature on scintillometers, two digits.
    assert float(sl.free_convection(1.0, 1.0, GRAVITY)) == pytest.approx(0.48, abs=0.01)


def test_functions_are_what_their_sources_print() -> None:
    assert float(sl.SIMILARITIES["andreas-1988"](-1.0)) == pytest.approx(4.9 * 7.1 ** (-2 / 3), rel=1e-12)
    assert float(sl.SIMILARITIES["andreas-1988"](1.0)) == pytest.approx(4.9 * 3.2, rel=1e-12)
    assert float(sl.SIMILARITIES["hartogensis-2005"](8.0)) == pytest.approx(4.7 * (1 + 1.6 * 4), rel=1e-12)
    # 4 beta_1 kappa^(-2/3) = 6.34 with beta_1 = 0.86, as others write the functions of Thiermann and Grassl.
    assert float(sl.SIMILARITIES["thiermann-grassl-1992"](0.0)) == pytest.approx(6.34, rel=1e-3)
    for similarity in sl.SIMILARITIES.values():
        assert similarity.source
        far = np.array([-1e6, -1e7])
        assert similarity(far) * (-far) ** (2 / 3) == pytest.approx(similarity.free_convection, rel=1e-4)


@pytest.mark.parametrize("name", sorted(sl.WIND_PROFILES))
@pytest.mark.parametrize("zeta", [-20.0, -0.7, -0.01, 0.3])
def test_psi_is_the_integral_of_the_shear(name: str, zeta: float) -> None:
    profile = sl.WIND_PROFILES[name]

    def shear(s: float) -> float:
        return (1 - profile.unstable * s) ** -0.25 if s < 0 else 1 + profile.stable * s

    value, _ = quad(lambda s: (1 - shear(s)) / s, 0, zeta, epsabs=1e-13)
    assert float(profile.psi(zeta)) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("stable", [True, False])
def test_the_solution_that_was_put_in(name: str, stable: bool) -> None:
    """From u* and T* forward to wind and CT2 in closed form, and back."""
    similarity, profile = sl.SIMILARITIES[name], sl.WIND_PROFILES["businger-1971"]
    friction, t, z = 0.3, 290.0, 12.0
    star = 0.02 if stable else -0.4
    for lift in (1.0, 1.2):
        length = t * friction**2 / (KARMAN * GRAVITY * lift * star)
        ct2 = star**2 * z ** (-2 / 3) * float(similarity(z / length))
        wind = friction / KARMAN * (np.log(3400) - float(profile.psi(3.4 / length)) + float(profile.psi(1e-3 / length)))
        found = sl.solve(
            ct2, z, t, stable, wind=wind, similarity=similarity, wind_profile=profile, buoyancy=lift, **WIND
        )
        assert found.state == sl.CONVERGED
        assert float(found.friction_velocity) == pytest.approx(friction, rel=1e-8)
        assert float(found.temperature_scale) == pytest.approx(star, rel=1e-8)
        assert float(found.obukhov_length) == pytest.approx(length, rel=1e-8)
        assert float(found.kinematic) == pytest.approx(-friction * star, rel=1e-8)
        known = sl.solve(ct2, z, t, stable, friction_velocity=friction, similarity=similarity, buoyancy=lift)
        assert float(known.obukhov_length) == pytest.approx(length, rel=1e-8)


finite = {"allow_nan": False, "allow_infinity": False}


@settings(deadline=None, max_examples=60)
@given(
    ct2=st.one_of(st.just(0.0), st.floats(1e-8, 10.0, **finite)),  # type: ignore[arg-type]
    z=st.floats(0.5, 200.0, **finite),  # type: ignore[arg-type]
    t=st.floats(230.0, 320.0, **finite),  # type: ignore[arg-type]
    wind=st.floats(0.01, 30.0, **finite),  # type: ignore[arg-type]
    roughness=st.floats(1e-4, 1.0, **finite),  # type: ignore[arg-type]
    lift=st.floats(0.7, 1.7, **finite),  # type: ignore[arg-type]
    stable=st.booleans(),
    name=st.sampled_from(SETS),
    shear=st.sampled_from(sorted(sl.WIND_PROFILES)),
)
def test_nothing_is_nan_without_a_flag(
    ct2: float, z: float, t: float, wind: float, roughness: float, lift: float, stable: bool, name: str, shear: str
) -> None:
    """Over the physical range, a solution satisfies its own equations to 1e-8, or a state says why there is none."""
    similarity, profile = sl.SIMILARITIES[name], sl.WIND_PROFILES[shear]
    found = sl.solve(ct2, z, t, stable, wind=wind, wind_height=10.0, roughness=roughness, similarity=similarity,
                     wind_profile=profile, buoyancy=lift)  # fmt: skip
    numbers = [
        float(getattr(found, f)) for f in ("kinematic", "friction_velocity", "temperature_scale", "obukhov_length")
    ]
    if found.state != sl.CONVERGED:
        assert np.isnan(numbers).all()
        assert found.state == (sl.NO_SOLUTION if stable else sl.TOO_CONVECTIVE)
        return
    heat, friction, star, length = numbers
    assert not np.isnan(numbers).any()
    assert heat == -friction * star
    assert np.sign(length) == (1 if stable else -1)
    assert float(found.residual) < 1e-8
    if ct2 == 0:
        assert (heat, star) == (0, 0)
        return
    # Each equation for itself, from what was found.
    assert ct2 * z ** (2 / 3) == pytest.approx(star**2 * float(similarity(z / length)), rel=1e-8)
    assert 1 / length == pytest.approx(KARMAN * GRAVITY * lift * star / (t * friction**2), rel=1e-8)
    heights = np.log(10.0 / roughness) - float(profile.psi(10 / length)) + float(profile.psi(roughness / length))
    assert KARMAN * wind == pytest.approx(friction * heights, rel=1e-8)


def test_what_is_missing_is_told() -> None:
    bad = sl.solve(
        [np.nan, -1.0, 0.1, 0.1], [10.0, 10.0, -2.0, 10.0], [290.0, 290.0, 290.0, np.nan], False, wind=3.0, **WIND
    )
    assert bad.state.tolist() == [sl.NO_INPUT] * 4
    assert np.isnan(bad.kinematic).all()
    with pytest.raises(ValueError, match="wind or the friction velocity"):
        sl.solve(0.1, 10.0, 290.0, False)


def test_weak_wind_has_no_stable_solution() -> None:
    wind = np.geomspace(0.05, 10, 400)
    found = sl.solve(0.05, 4.07, 283.0, True, wind=wind, **WIND)
    solved = found.state == sl.CONVERGED
    # Beyond one wind speed all have a solution, below it none.
    assert not solved[0]
    assert solved[-1]
    assert np.diff(solved.astype(int)).sum() == 1
    edge = np.argmax(solved)
    finer = sl.solve(0.05, 4.07, 283.0, True, wind=np.linspace(wind[edge - 1], wind[edge], 200), **WIND)
    # Near the edge two solutions meet; the first is found there as well, and z / L grows toward the edge.
    zeta = 4.07 / finer.obukhov_length[finer.state == sl.CONVERGED]
    assert (np.diff(zeta) < 0).all()
    assert (finer.state == sl.CONVERGED).sum() > 10
    assert np.diff((finer.state == sl.CONVERGED).astype(int)).min() >= 0


def test_effective_height() -> None:
    weights = np.array([0.2, 0.5, 0.3])
    heights = np.array([10.0, 20.0, 40.0])
    assert sl.effective_height(np.full(3, 12.0), weights) == pytest.approx(12.0, rel=1e-12)
    free = sl.effective_height(heights, weights)
    # The flux of the effective height is that which the path gives: CT2 mean of h^(-4/3), H ~ z CT2^(3/4).
    ct2 = weights @ heights ** (-4 / 3)
    assert free * ct2**0.75 == pytest.approx(1.0, rel=1e-12)
    andreas = sl.SIMILARITIES["andreas-1988"]
    convective = sl.effective_height(heights, weights, obukhov_length=-1e-3, similarity=andreas)
    assert convective == pytest.approx(free, rel=1e-3)
    # Neutral: the mean of h^(-2/3).
    neutral = sl.effective_height(heights, weights, obukhov_length=1e9, similarity=andreas)
    assert neutral == pytest.approx((weights @ heights ** (-2 / 3)) ** -1.5, rel=1e-5)
    assert np.isnan(sl.effective_height(np.array([1.0, np.nan, 3.0]), weights))
    assert sl.effective_height(np.array([5.0, np.nan]), np.array([1.0, 0.0])) == pytest.approx(5.0)


def test_the_line_of_the_paper() -> None:
    # Sauvage et al. 2021, Sec. 5.3: Cn2(h) = 1e-14 at 10 m, as h^(-4/3); at 23 m that is 3.3e-15.
    assert float(sl.height_model(1e-14, 10.0, 23.0)) == pytest.approx(3.29e-15, rel=2e-3)
    assert np.isnan(sl.height_model(1e-14, 10.0, [0.0, -3.0])).all()


def test_buoyancy_of_humid_air() -> None:
    # 1 + 0.07 / beta in textbooks.
    assert float(sl.buoyancy_factor(293.0, 0.5)) == pytest.approx(1 + 0.07 / 0.5, rel=0.01)
    assert float(sl.buoyancy_factor(293.0)) == 1.0
