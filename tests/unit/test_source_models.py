"""Source models against their intensity, integrated over the source itself."""

from __future__ import annotations

import math
import pickle
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from coslidar.plugins.contract import SourceModelBase
from coslidar.plugins.source_models import Disc, Gaussian, Image, Point, Rectangle

FX = np.array([0.0, 1e-5, 0.7, 3.0, -6.0, 11.0])
FY = np.array([0.0, 2e-5, -0.4, 5.0, 2.0, -9.0])

LAMP = ((0.0, 1.0, 2.0, 0.5), (1.0, 4.0, 3.0, 0.0), (0.2, 0.0, 2.5, 1.0))


def grid(half_x: float, half_y: float, n: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on a rectangle."""
    nodes, rule = np.polynomial.legendre.leggauss(n)
    x, y = np.meshgrid(half_x * nodes, half_y * nodes)
    return x, y, half_x * half_y * np.outer(rule, rule)


def intensity(source: SourceModelBase) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a source, x and y, and the light that each stands for."""
    if isinstance(source, Gaussian):
        x, y, weight = grid(0.3, 0.3)
        sigma = source.fwhm_x / math.sqrt(8 * math.log(2)), source.fwhm_y / math.sqrt(8 * math.log(2))
        weight = weight * np.exp(-((x / sigma[0]) ** 2) / 2 - (y / sigma[1]) ** 2 / 2)
    elif isinstance(source, Rectangle):
        x, y, weight = grid(source.width_x / 2, source.width_y / 2, 60)
    elif isinstance(source, Disc):
        r, angle, weight = grid(source.diameter / 4, np.pi, 60)
        r = r + source.diameter / 4
        x, y, weight = r * np.cos(angle), r * np.sin(angle), weight * r
    elif isinstance(source, Image):
        u, v, inside = grid(source.pixel_size / 2, source.pixel_size / 2, 12)
        i, j = np.indices((3, 4))
        x = (j[..., None, None] * source.pixel_size + u).ravel()
        y = (i[..., None, None] * source.pixel_size + v).ravel()
        weight = (np.array(LAMP)[..., None, None] * inside).ravel()
        x, y = x - (weight @ x) / weight.sum(), y - (weight @ y) / weight.sum()
    else:
        x = y = np.zeros(1)
        weight = np.ones(1)
    return x.ravel(), y.ravel(), (weight / weight.sum()).ravel()


SOURCES = [
    Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm"),
    Point(),
    Disc(diameter="14.5 cm"),
    Rectangle(width_x="16 cm", width_y="12.5 cm"),
    Image(pixel_size="2 cm", intensity=LAMP),
]


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.name)
def test_transfer_and_moments_are_integrals_over_the_source(source: SourceModelBase) -> None:
    x, y, light = intensity(source)
    turn = np.exp(-2j * np.pi * (np.outer(FX, x) + np.outer(FY, y)))
    mx, my = source.moment(FX, FY)
    assert np.allclose(source.transfer(FX, FY), turn @ light, rtol=0, atol=1e-10)
    assert np.allclose(mx, turn @ (light * x), rtol=0, atol=1e-12)
    assert np.allclose(my, turn @ (light * y), rtol=0, atol=1e-12)


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.name)
def test_moments_agree_with_the_derivative_of_the_transfer_function(source: SourceModelBase) -> None:
    for own, numerical in zip(source.moment(FX, FY), SourceModelBase.moment(source, FX, FY), strict=True):
        assert np.allclose(own, numerical, rtol=0, atol=1e-9)


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.name)
def test_a_source_is_frozen_normalised_and_centred(source: SourceModelBase) -> None:
    zero = np.zeros((2, 3))
    assert np.all(source.transfer(zero, zero) == 1)
    assert all(np.abs(moment).max() < 1e-15 for moment in source.moment(zero, zero))
    assert source.transfer(zero, zero).shape == zero.shape
    assert pickle.loads(pickle.dumps(source)) == source
    assert source.version == 1


def test_half_maximum_of_a_gaussian() -> None:
    # |P~| of a Gaussian falls to exp(-pi^2 beta^2 f^2), beta = FWHM / (2 sqrt(ln 2)): Sauvage et al. 2021.
    source = Gaussian(fwhm_x="8.9 cm", fwhm_y="0 m")
    beta = 0.089 / (2 * math.sqrt(math.log(2)))
    assert source.transfer(np.array([4.0]), np.array([50.0]))[0] == pytest.approx(
        math.exp(-((math.pi * beta * 4) ** 2))
    )


def test_extents_may_be_angles_but_not_times() -> None:
    assert Disc(diameter="2 arcsec").diameter == pytest.approx(2 / 206264.806, rel=1e-6)
    with pytest.raises(ValidationError, match="must be a length"):
        Disc(diameter="2 s")
    with pytest.raises(ValidationError):
        Gaussian(fwhm_x="8 cm", fwhm_y="-1 cm")


@pytest.mark.parametrize("name", ["lamp.npy", "lamp.txt", "lamp.csv"])
def test_an_image_is_read_from_its_file_and_known_by_its_pixels(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if path.suffix == ".npy":
        np.save(path, np.array(LAMP))
    else:
        np.savetxt(path, np.array(LAMP), delimiter="," if path.suffix == ".csv" else " ")
    image = Image(pixel_size="2 cm", file=str(path))
    assert image == SOURCES[-1]
    assert image.identity() == SOURCES[-1].identity()
    path.unlink()
    assert image.transfer(FX, FY) == pytest.approx(SOURCES[-1].transfer(FX, FY))


def test_bad_images_are_refused_with_a_reason(tmp_path: Path) -> None:
    (tmp_path / "text.txt").write_text("one two\n")
    np.save(tmp_path / "cube.npy", np.zeros((2, 2, 2)))
    np.save(tmp_path / "large.npy", np.zeros((300, 2)))
    np.save(tmp_path / "objects.npy", np.array([[{}]]), allow_pickle=True)
    for name, message in (
        ("missing.npy", "no readable"),
        ("text.txt", "no readable"),
        ("cube.npy", "two-dimensional"),
        ("large.npy", "at most 256"),
        ("objects.npy", "no readable"),
    ):
        with pytest.raises(ValidationError, match=message):
            Image(pixel_size="1 mm", file=str(tmp_path / name))
    for rows, message in (
        ((), "rows of one length"),
        (((1.0,), (1.0, 2.0)), "one length"),
        (((0.0, 0.0),), "positive sum"),
        (((math.nan, 1.0),), "finite"),
    ):
        with pytest.raises(ValidationError, match=message):
            Image(pixel_size="1 mm", intensity=rows)
    np.save(tmp_path / "good.npy", np.ones((2, 2)))
    with pytest.raises(ValidationError, match="not both"):
        Image(pixel_size="1 mm", file=str(tmp_path / "good.npy"), intensity=((1.0,),))
