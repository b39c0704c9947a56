"""The detector band: its Gauss rules, what it makes of the diffraction factors, and how a configuration gives it."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import quad
from scipy.special import gamma, sici

from coslidar.flows.settings import load
from coslidar.pipeline.band import Band
from coslidar.pipeline.geometry import Geometry
from coslidar.pipeline.lineage import canonical
from coslidar.pipeline.parameters import ResponseParameters
from coslidar.pipeline.response import response
from coslidar.pipeline.units import faults
from coslidar.plugins.source_models import Point
from coslidar.plugins.turbulence_spectra import Kolmogorov

FLAT = Band((3.4e-6, 4.2e-6), (2.0, 2.0))
SKEWED = Band((2.0e-6, 2.5e-6, 4.0e-6, 5.0e-6), (0.0, 3.0, 1.0, 0.5))


def weight(wavelength: Any, band: Band) -> Any:
    """Normalised weight, by the trapezoidal rule that is exact for it."""
    return np.interp(wavelength, band.wavelengths, band.weights) / np.trapezoid(band.weights, band.wavelengths)


def factors(band: Band, zeta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean cos X and k sin X from the envelopes."""
    c, s = band.envelopes(zeta)
    turn = np.exp(1j * np.pi * band.centre * zeta)
    return (c * turn).real, (s * turn).imag


@pytest.mark.parametrize("reach", [1e5, 1e6, 1e7, 1e8])
def test_factors_of_a_flat_band_in_closed_form(reach: float) -> None:
    # cos integrates to a sine, sin(x) / x to the sine integral. At 1e8 the band spans 250 rad.
    zeta = reach * np.array([0.1, 0.37, 1.0])
    low, high = (math.pi * edge * zeta for edge in FLAT.limits)
    cosine, sine = factors(FLAT, zeta)
    width = 0.8e-6
    np.testing.assert_allclose(cosine, (np.sin(high) - np.sin(low)) / (math.pi * zeta * width), rtol=0, atol=1e-12)
    np.testing.assert_allclose(sine, 2 * math.pi / width * (sici(high)[0] - sici(low)[0]), rtol=0, atol=1e-12 * 1.7e6)


def mean(function: Callable[[np.ndarray], np.ndarray], band: Band) -> float:
    """Mean over a band, by a Gauss-Legendre rule over each piece of its weight that is far finer than needed."""
    nodes, rule = np.polynomial.legendre.leggauss(80)
    total = 0.0
    for low, high in pairwise(band.wavelengths):
        places = (low + high) / 2 + (high - low) / 2 * nodes
        total += float((high - low) / 2 * rule @ (weight(places, band) * function(places)))
    return total


def test_factors_of_a_table_by_quadrature() -> None:
    zeta = np.array([0.0, 3e5, 4e6])
    cosine, sine = factors(SKEWED, zeta)
    for number, value in enumerate(zeta):
        assert abs(cosine[number] - mean(lambda w, x=value: np.cos(math.pi * w * x), SKEWED)) < 1e-12
        expected = mean(lambda w, x=value: 2 * math.pi / w * np.sin(math.pi * w * x), SKEWED)
        assert abs(sine[number] - expected) < 1e-12 * 2e6


def test_rules_are_exact_for_polynomials_and_positive() -> None:
    places, shares = SKEWED.rule(6)
    assert places.size == 6
    assert np.all(shares > 0)
    assert np.all((places > 2e-6) & (places < 5e-6))
    for power in range(12):
        expected = mean(lambda w, p=power: (w / 5e-6) ** p, SKEWED)
        assert float(shares @ (places / 5e-6) ** power) == pytest.approx(expected, rel=1e-12)


def test_monochromatic_light_is_a_band_of_one_wavelength() -> None:
    one = Band((3.8e-6,), (5.0,))
    assert one.centre == 3.8e-6
    assert one.envelopes(np.ones(3)) == (1.0, 2 * math.pi / 3.8e-6)


@pytest.mark.parametrize("band", [FLAT, SKEWED], ids=["flat", "skewed"])
def test_scintillation_of_a_vanishing_aperture_in_closed_form(band: Band) -> None:
    """Correlated turbulence: the mean over both wavelengths of the covariance of two colours.

    With sin X sin X' = [cos(X - X') - cos(X + X')] / 2 the covariance of the colours lambda, lambda' is that of one
    wavelength with (2 lambda)^(5/6) / lambda^2 replaced by [(lambda + lambda')^(5/6) - |lambda - lambda'|^(5/6)] /
    (lambda lambda'). The aperture of 10 um takes away 1e-6.
    """
    length, z = 2670.0, 1000.0
    one = Geometry(((1,),), 1e-5, length, 3.8e-6, ((0.0, 0.0),))
    constant = -4 * 0.033 * math.pi**2 * gamma(-5 / 6) * math.cos(5 * math.pi / 12)
    unit = constant * (2 * math.pi) ** (7 / 6) * (z * (1 - z / length)) ** (5 / 6) / 2 ** (5 / 6)

    def beside(a: float) -> float:
        """Mean over the second colour; the cusp at the first lies at the end of a piece."""

        def density(b: float) -> float:
            return float(weight(b, band)) * ((a + b) ** (5 / 6) - abs(a - b) ** (5 / 6)) / (a * b)

        edges = sorted({*band.wavelengths, a})
        return sum(quad(density, low, high, epsabs=0, epsrel=1e-8)[0] for low, high in pairwise(edges))

    nodes, rule = np.polynomial.legendre.leggauss(12)
    covariance = 0.0
    for low, high in pairwise(band.wavelengths):
        for node, share in zip((low + high) / 2 + (high - low) / 2 * nodes, rule * (high - low) / 2, strict=True):
            covariance += share * weight(node, band) * beside(node)
    found = response(one, z, Kolmogorov(), [Point()], band=band)[4, 0, 0]
    assert found == pytest.approx(unit * covariance, rel=5e-6)
    # Not the mean of the responses of single wavelengths.
    if band is SKEWED:
        assert found < 0.95 * unit * mean(lambda w: (2 * w) ** (5 / 6) / w**2, band)


@pytest.mark.parametrize(
    ("wavelengths", "weights", "message"),
    [
        ((), (), "0 wavelengths"),
        ((1e-6, 2e-6), (1.0,), "one weight for each"),
        ((2e-6, 1e-6), (1.0, 1.0), "increase"),
        ((0.0, 1e-6), (1.0, 1.0), "positive"),
        ((1e-6, math.inf), (1.0, 1.0), "increase"),
        ((1e-6, 2e-6), (1.0, -1.0), "none negative"),
        ((1e-6, 2e-6), (0.0, 0.0), "not all zero"),
        ((1e-6, 2e-6), (math.nan, 1.0), "finite"),
    ],
)
def test_impossible_bands_are_refused(wavelengths: tuple[float, ...], weights: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Band(wavelengths, weights)


# ------------------------------------------------------------------------------------------------ configuration


def test_a_band_is_known_by_its_values_however_it_is_written(tmp_path: Path) -> None:
    table = {"wavelength": ["3400 nm", "3.5 um", "4.2 um"], "weight": [0, 1, 0.25]}
    (tmp_path / "filter.csv").write_text("# um, weight\n3.4, 0\n3.5, 1\n\n4.2, 0.25\n")
    np.savetxt(tmp_path / "filter.txt", [[3400, 0], [3500, 1], [4200, 0.25]])
    written: list[Any] = [
        table,
        {"file": str(tmp_path / "filter.csv"), "unit": "um"},
        f"file={tmp_path / 'filter.csv'},unit=um",
        f"file={tmp_path / 'filter.txt'}, unit=nm",
    ]
    made = [ResponseParameters(band=band) for band in written]
    assert len({canonical(parameters.tracked()) for parameters in made}) == 1
    assert made[0].band is not None
    assert made[0].band.band() == Band((3.4e-6, 3.5e-6, 4.2e-6), (0.0, 1.0, 0.25))
    assert made[0].band.text() == "3.4 um to 4.2 um, weighted"
    again = ResponseParameters.model_validate(made[0].model_dump(mode="json", exclude_none=True))
    assert again == made[0]


def test_a_range_is_a_flat_band() -> None:
    band = ResponseParameters(band="3.4 um : 4.2 um").band
    assert band is not None
    assert band.band() == Band((3.4e-6, 4.2e-6), (1.0, 1.0))
    assert band.text() == "3.4 um to 4.2 um, flat"


@pytest.mark.parametrize(
    ("band", "message"),
    [
        ("3.4:4.2", "response.band.wavelength[0] = '3.4': the unit is missing"),
        ("3.4 s:4.2 s", "response.band.wavelength[1] = '4.2 s': 's' is a duration"),
        ("3.4 um", "2 to 2000 wavelengths, not 1"),
        ("4.2 um:3.4 um", "must be positive and increase"),
        ({"wavelength": ["3.4 um", "4.2 um"], "weight": [1]}, "give one weight for each"),
        ({"wavelength": ["3.4 um", "4.2 um"], "weight": [1, -1]}, "response.band.weight[1] = -1"),
        ({"wavelength": ["3.4 um", "4.2 um"], "unit": "um"}, "unit belongs to a file"),
        ({"file": "filter.csv"}, "has the keys file and unit"),
        ({"file": "nowhere.csv", "unit": "um"}, "'nowhere.csv' cannot be read"),
        ({"lower": "3.4 um"}, "response.band.lower"),
        (3.4, "write '3.4 um:4.2 um'"),
    ],
)
def test_faults_of_a_band_say_what_to_write(band: object, message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        ResponseParameters(band=band)  # type: ignore[arg-type]
    assert any(message in fault for fault in faults(caught.value, "campaign.toml", "response"))


def test_a_band_file_needs_two_columns(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "one.txt", [3.4, 4.2])
    with pytest.raises(ValidationError, match="two columns, wavelength and weight; it has 1"):
        ResponseParameters(band={"file": str(tmp_path / "one.txt"), "unit": "um"})  # type: ignore[arg-type]


def test_a_band_must_hold_the_wavelength_of_the_instrument() -> None:
    geometry = Geometry(((1,),), 0.07, 2670.0, 3.8e-6, ((0.0, 0.0),))
    parameters = ResponseParameters(band="3.4 um:4.2 um")  # type: ignore[arg-type]
    assert parameters.options(geometry)["band"] == Band((3.4e-6, 4.2e-6), (1.0, 1.0))
    nanometres = ResponseParameters(band="3.4 nm:4.2 nm")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="does not hold instrument"):
        nanometres.options(geometry)


def test_the_response_key_follows_every_option() -> None:
    plain = ResponseParameters()
    changed = [
        {"sampling": "midpoint"},
        {"slope_response": "printed"},
        {"aperture": "circular"},
        {"tilt": "zernike"},
        {"band": "3.4 um:4.2 um"},
        {"band": "3.5 um:4.2 um"},
        {"scintillation": "extended_rytov"},
    ]
    keys = {canonical(ResponseParameters(**change).tracked()) for change in ({}, *changed)}  # type: ignore[arg-type]
    assert len(keys) == len(changed) + 1
    # How many slices there are, and where they end, stands in the edges.
    assert ResponseParameters(slices=5).tracked() == plain.tracked()


def test_files_that_a_campaign_file_names_lie_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cal").mkdir()
    np.savetxt(tmp_path / "cal" / "filter.csv", [[3.4, 1], [4.2, 2]], delimiter=",")
    np.save(tmp_path / "cal" / "lamp.npy", np.ones((2, 3)))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    made = []
    for band, source in (
        ('{ file = "cal/filter.csv", unit = "um" }', '{ name = "image", file = "cal/lamp.npy", pixel_size = "1 cm" }'),
        ('"file=cal/filter.csv,unit=um"', '"image:file=cal/lamp.npy,pixel_size=1 cm"'),
    ):
        (tmp_path / "campaign.toml").write_text(f"source = {source}\n[response]\nband = {band}\n")
        settings = load(tmp_path / "campaign.toml")
        made.append((settings.configuration.response, settings.plugins["source"]))
    assert made[0] == made[1]
    assert made[0][0].band is not None
    assert made[0][0].band.weight == (1.0, 2.0)
    # What the command line names lies where the command is given.
    np.savetxt(elsewhere / "other.csv", [[3.5, 1], [4.2, 2]], delimiter=",")
    band = load(assignments=["response.band.file=other.csv", "response.band.unit=um"]).configuration.response.band
    assert band is not None
    assert band.wavelength[0] == 3.5e-6
