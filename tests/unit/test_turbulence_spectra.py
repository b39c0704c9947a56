"""Spectra of the index against structure functions, limits and printed values."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import quad
from scipy.special import kv

from coslidar.plugins.turbulence_spectra import Hill, Kolmogorov, PowerLaw, Tatarskii, VonKarman

F = np.logspace(-4, 4, 60)


def structure_function(psd: object, r: float, slope: float) -> float:
    """D_n(r) = 8 pi integral of kappa^2 Phi_n (1 - sin(kappa r) / (kappa r)), Phi_n = S_n(kappa / 2 pi) / (2 pi)^3.

    Beyond x = kappa r = 400 the oscillation leaves 1e-6, and the spectrum falls with the power `slope`.
    """

    def integrand(x: float) -> float:
        kappa = x / r
        phi = float(psd(np.array([kappa / (2 * np.pi)]))[0]) / (2 * np.pi) ** 3
        return kappa**2 * phi * (1 - math.sin(x) / x if x > 1e-3 else x**2 / 6) / r

    parts = [(0, 1e-3), (1e-3, 1), *((n, n + 10) for n in range(1, 401, 10))]
    total = sum(quad(integrand, a, b, limit=200, epsabs=0, epsrel=1e-9)[0] for a, b in parts)
    last = 401.0
    return 8 * np.pi * (total + integrand(last) * last / (slope - 3))


def test_kolmogorov_gives_the_two_thirds_law() -> None:
    # D_n = Cn2 r^(2/3); the constant 0.033 is that of 0.03300(54), so to 2e-4.
    for r in (0.01, 1.0):
        assert structure_function(Kolmogorov().psd, r, 11 / 3) == pytest.approx(r ** (2 / 3), rel=5e-4)


def test_kolmogorov_has_the_constant_of_the_paper() -> None:
    assert Kolmogorov().psd(np.array([1.0, 8.0])) == pytest.approx([0.0096916, 0.0096916 * 8 ** (-11 / 3)], rel=1e-4)


@pytest.mark.parametrize("exponent", [3.2, 3.5, 3.9])
def test_power_laws_meet_at_the_reference_separation(exponent: float) -> None:
    law = PowerLaw(exponent=exponent, reference="0.5 m")
    assert structure_function(law.psd, 0.5, exponent) == pytest.approx(0.5 ** (2 / 3), rel=2e-3)
    assert structure_function(law.psd, 0.1, exponent) / structure_function(law.psd, 0.5, exponent) == pytest.approx(
        0.2 ** (exponent - 3), rel=1e-5
    )


def test_von_karman_has_its_correlation_function() -> None:
    # Variance less half the structure function: B(r) ~ (r kappa_0)^(1/3) K_(1/3)(r kappa_0), kappa_0 = 2 pi / L0.
    outer = 2.0
    psd = VonKarman(outer_scale="2 m").psd
    kappa0 = 2 * np.pi / outer

    def correlation(r: float) -> float:
        x = kappa0 * r
        return x ** (1 / 3) * kv(1 / 3, x)

    limit = 2 ** (-2 / 3) * math.gamma(1 / 3)

    def density(kappa: float) -> float:
        return 4 * np.pi * kappa**2 * float(psd(np.array([kappa / (2 * np.pi)]))[0]) / (2 * np.pi) ** 3

    variance = quad(density, 0, np.inf)[0]
    for r in (0.1, 0.7):
        half = structure_function(psd, r, 11 / 3) / (2 * variance)
        assert half == pytest.approx(1 - correlation(r) / limit, rel=2e-4)


def test_limits() -> None:
    kolmogorov = Kolmogorov().psd(F)
    assert np.allclose(VonKarman(outer_scale="1e9 m").psd(F), kolmogorov, rtol=1e-9)
    assert np.allclose(Tatarskii(inner_scale="1e-9 m").psd(F), kolmogorov, rtol=1e-6)
    assert np.allclose(Hill(inner_scale="1e-9 m").psd(F), kolmogorov, rtol=1e-4)
    assert VonKarman(outer_scale="3 m").psd(np.array([0.0])) == pytest.approx(0.0096916 * 3 ** (11 / 3), rel=1e-4)
    for model in (Tatarskii, Hill):
        both = model(inner_scale="5 mm", outer_scale="10 m").psd(F)
        single = model(inner_scale="5 mm").psd(F) * VonKarman(outer_scale="10 m").psd(F) / kolmogorov
        assert np.allclose(both, single, rtol=1e-12)


def test_inner_scales() -> None:
    # kappa l0 = 5.92 cuts the Tatarskii spectrum by e. The bump of Hill adds a third to a half near kappa l0 = 1.7,
    # and the spectrum is gone at kappa l0 = 10.
    inner = 0.006
    f = np.array([5.92, 1.7, 10.0, 0.01]) / inner / (2 * np.pi)
    kolmogorov = Kolmogorov().psd(f)
    assert (Tatarskii(inner_scale="6 mm").psd(f) / kolmogorov)[0] == pytest.approx(math.exp(-1), rel=1e-12)
    hill = Hill(inner_scale="6 mm").psd(f) / kolmogorov
    r = 1.7 / 3.3
    assert hill[1] == pytest.approx((1 + 1.802 * r - 0.254 * r ** (7 / 6)) * math.exp(-(r**2)), rel=1e-12)
    assert 1.3 < hill[1] < 1.45
    assert hill[2] < 1e-3
    assert hill[3] == pytest.approx(1, abs=0.01)


def test_parameters_are_checked_and_models_are_values() -> None:
    for model in (Kolmogorov(), VonKarman(outer_scale="10 m"), Hill(inner_scale="5 mm"), PowerLaw(exponent=3.4)):
        assert pickle.loads(pickle.dumps(model)) == model
        assert np.all(model.psd(F) >= 0)
        assert np.all(np.isfinite(model.psd(F)))
    assert Hill(inner_scale="5 mm").identity() == Hill(inner_scale="0.005 m").identity()
    assert PowerLaw(exponent=3.4).reference == 1.0
    for bad in ({"outer_scale": "0 m"}, {"outer_scale": "10 s"}, {"outer_scale": 10.0}, {}):
        with pytest.raises(ValidationError):
            VonKarman(**bad)
    for exponent in (3.0, 4.0, math.nan):
        with pytest.raises(ValidationError):
            PowerLaw(exponent=exponent)
