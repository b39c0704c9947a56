"""Intensity distributions of the sources.

P(x, y) is normalised to 1 and has its centroid at the source's position. With the Fourier transform
P~(f) = integral of P(s) exp(-2 pi i f.s), the transform of s_l P is (i / 2 pi) dP~/df_l. Extents are lengths, or
angles for sources at infinity; frequencies are their reciprocals.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator
from scipy.special import j1, jv

from ..pipeline.units import Extent
from .contract import SourceModelBase

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Pixels along each side of the largest image: it is part of the identity of every product made with it.
_LARGEST_IMAGE = 256


def _sinc_moment(f: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Transform of s over a uniform bar of `width`, divided by -i: (width / 2) j1(pi f width)."""
    x = np.pi * f * width
    small = np.abs(x) < 1e-2
    safe = np.where(small, 1.0, x)
    # (sin x - x cos x) / x^2 cancels near zero; three terms of its series hold to 1e-17 there.
    series = x / 3 * (1 - x**2 / 10 * (1 - x**2 / 28))
    return np.asarray(width / 2 * np.where(small, series, (np.sin(safe) / safe - np.cos(safe)) / safe))


class Gaussian(SourceModelBase):
    """Separable Gaussian.

    P = exp(-x^2 / beta_x^2 - y^2 / beta_y^2) up to a factor, beta = FWHM / (2 sqrt(ln 2)), and
    P~(f) = exp(-pi^2 beta_x^2 f_x^2 - pi^2 beta_y^2 f_y^2): Sauvage et al. 2021, https://doi.org/10.1364/AO.438170,
    text under Eq. (16). The transform of s_l P is -i pi beta_l^2 f_l P~.
    """

    name: ClassVar[str] = "gaussian"
    examples: ClassVar = ({"fwhm_x": "8.9 cm", "fwhm_y": "6.3 cm"},)

    fwhm_x: Extent = Field(ge=0)
    """Full width at half maximum along x."""

    fwhm_y: Extent = Field(ge=0)
    """Full width at half maximum along y."""

    def transfer(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> NDArray[np.float64]:
        """P~(f); see :meth:`SourceModelBase.transfer`."""
        bx, by = self._beta2()
        return np.asarray(np.exp((-(np.pi**2) * bx) * fx**2 - (np.pi**2 * by) * fy**2))

    def moment(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Transforms of x P and y P; see :meth:`SourceModelBase.moment`."""
        bx, by = self._beta2()
        transfer = self.transfer(fx, fy)
        return (-1j * np.pi * bx) * (fx * transfer), (-1j * np.pi * by) * (fy * transfer)

    def _beta2(self) -> tuple[float, float]:
        return self.fwhm_x**2 / (4 * np.log(2)), self.fwhm_y**2 / (4 * np.log(2))


class Point(SourceModelBase):
    """Point source: P~ = 1, and s_l P = 0."""

    name: ClassVar[str] = "point"

    def transfer(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> NDArray[np.float64]:
        """P~(f) = 1; see :meth:`SourceModelBase.transfer`."""
        return np.ones(np.broadcast(fx, fy).shape)

    def moment(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Zero; see :meth:`SourceModelBase.moment`."""
        zero = np.zeros(np.broadcast(fx, fy).shape)
        return zero, zero


class Disc(SourceModelBase):
    """Uniform disc.

    P~(f) = 2 J1(w) / w with w = pi D |f| (Born and Wolf, Principles of Optics, 7th ed., Sec. 8.5.2,
    https://doi.org/10.1017/CBO9781139644181). From
    (2 J1(w) / w)' = -2 J2(w) / w, the transform of s_l P is -i (D / 2) (f_l / |f|) 2 J2(w) / w.
    """

    name: ClassVar[str] = "disc"
    examples: ClassVar = ({"diameter": "8 cm"},)

    diameter: Extent = Field(gt=0)
    """Diameter D."""

    def transfer(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> NDArray[np.float64]:
        """P~(f); see :meth:`SourceModelBase.transfer`."""
        w = np.pi * self.diameter * np.hypot(fx, fy)
        safe = np.where(w == 0, 1.0, w)
        return np.asarray(np.where(w == 0, 1.0, 2 * j1(safe) / safe))

    def moment(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Transforms of x P and y P; see :meth:`SourceModelBase.moment`."""
        w = np.pi * self.diameter * np.hypot(fx, fy)
        safe = np.where(w == 0, 1.0, w)
        radial = -1j * np.pi * self.diameter**2 * np.where(w == 0, 0.125, jv(2, safe) / safe**2)
        return fx * radial, fy * radial


class Rectangle(SourceModelBase):
    """Uniform rectangle, such as the front glass of a halogen lamp.

    P~(f) = sinc(pi f_x a) sinc(pi f_y b) with sinc(w) = sin(w) / w (Born and Wolf, Principles of Optics, 7th ed.,
    Sec. 8.5.1, https://doi.org/10.1017/CBO9781139644181). From sinc'(w) = -j1(w), the spherical Bessel function, the
    transform of x P is -i (a / 2) j1(pi f_x a) sinc(pi f_y b).
    """

    name: ClassVar[str] = "rectangle"
    examples: ClassVar = ({"width_x": "16 cm", "width_y": "12.5 cm"},)

    width_x: Extent = Field(gt=0)
    """Width a along x."""

    width_y: Extent = Field(gt=0)
    """Width b along y."""

    def transfer(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> NDArray[np.float64]:
        """P~(f); see :meth:`SourceModelBase.transfer`."""
        return np.asarray(np.sinc(fx * self.width_x) * np.sinc(fy * self.width_y))

    def moment(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Transforms of x P and y P; see :meth:`SourceModelBase.moment`."""
        x, y = np.sinc(fx * self.width_x), np.sinc(fy * self.width_y)
        return -1j * _sinc_moment(fx, self.width_x) * y, -1j * x * _sinc_moment(fy, self.width_y)


class Image(SourceModelBase):
    """Measured intensity map, piecewise constant on square pixels.

    P~(f) = sinc(pi f_x h) sinc(pi f_y h) sum_ij I_ij exp(-2 pi i (f_x x_j + f_y y_i)) / sum_ij I_ij with pixels of
    side h: the transform of a pixel times the sum over the pixels' centres, taken about the centroid of the map. The
    transforms of x P and y P follow with x_j I_ij in the sum, and the moment of the pixel itself. The pixel
    values, not the name of their file, are part of the model's identity.
    """

    name: ClassVar[str] = "image"
    examples: ClassVar = ({"pixel_size": "1 cm", "intensity": ((0, 1, 2, 0), (3, 4, 1, 1), (0, 5, 0, 0))},)

    pixel_size: Extent = Field(gt=0)
    """Side h of a pixel at the source."""

    file: str = Field(default="", exclude=True)
    """File with the intensity: .npy, or text with one row of numbers per line; rows run along y, columns along x."""

    intensity: tuple[tuple[float, ...], ...] = ()
    """Intensity of each pixel, in any unit, read from `file` where that is given."""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not data.get("file"):
            return data
        if data.get("intensity"):
            raise ValueError("give either file or intensity, not both")
        path = Path(str(data["file"]))
        try:
            if path.suffix == ".npy":
                values = np.load(path, mmap_mode="r", allow_pickle=False)
            else:
                values = np.loadtxt(path, delimiter="," if path.suffix == ".csv" else None, ndmin=2)
        except (OSError, ValueError, EOFError) as error:
            raise ValueError(f"file: '{path}' holds no readable intensity map ({error})") from error
        if values.ndim != 2 or max(values.shape) > _LARGEST_IMAGE or values.dtype.kind not in "uif":
            raise ValueError(
                f"file: '{path}' must hold a two-dimensional map of real numbers of at most {_LARGEST_IMAGE} x "
                f"{_LARGEST_IMAGE} pixels; it has shape {values.shape} and type {values.dtype}"
            )
        rows = tuple(tuple(float(value) for value in row) for row in values)
        # The path is dropped: a model built from its own values is the same model.
        return {**{key: value for key, value in data.items() if key != "file"}, "intensity": rows}

    @model_validator(mode="after")
    def _usable(self) -> Image:
        lengths = {len(row) for row in self.intensity}
        if len(lengths) != 1 or 0 in lengths or max(len(self.intensity), *lengths) > _LARGEST_IMAGE:
            raise ValueError(
                f"intensity must be rows of one length, at most {_LARGEST_IMAGE} x {_LARGEST_IMAGE} pixels; give "
                "it, or the file that holds it"
            )
        values = np.asarray(self.intensity)
        if not np.all(np.isfinite(values)) or values.sum() <= 0:
            raise ValueError("intensity must be finite and have a positive sum; subtract the background first")
        return self

    def transfer(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> NDArray[np.complex128]:
        """P~(f); see :meth:`SourceModelBase.transfer`."""
        weights, x, y = self._pixels()
        along_x, along_y = self._waves(fx, x), self._waves(fy, y)
        bars = np.sinc(fx * self.pixel_size) * np.sinc(fy * self.pixel_size)
        return np.asarray(bars * _sum(along_y @ weights, along_x).reshape(bars.shape))

    def moment(self, fx: NDArray[np.float64], fy: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Transforms of x P and y P; see :meth:`SourceModelBase.moment`."""
        weights, x, y = self._pixels()
        along_x, along_y = self._waves(fx, x), self._waves(fy, y)
        bar_x, bar_y = np.sinc(fx * self.pixel_size), np.sinc(fy * self.pixel_size)
        own_x, own_y = _sinc_moment(fx, self.pixel_size), _sinc_moment(fy, self.pixel_size)
        rows = along_y @ weights
        plain, with_x = (_sum(rows, waves).reshape(bar_x.shape) for waves in (along_x, along_x * x))
        with_y = _sum((along_y * y) @ weights, along_x).reshape(bar_x.shape)
        return (
            np.asarray(bar_x * bar_y * with_x - 1j * own_x * bar_y * plain),
            np.asarray(bar_x * bar_y * with_y - 1j * bar_x * own_y * plain),
        )

    def _pixels(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Normalised weights (rows, columns), and the pixels' x and y from the centroid."""
        values = np.asarray(self.intensity)
        weights = values / values.sum()
        x = np.arange(values.shape[1]) * self.pixel_size
        y = np.arange(values.shape[0]) * self.pixel_size
        return weights, x - weights.sum(axis=0) @ x, y - weights.sum(axis=1) @ y

    def _waves(self, f: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.complex128]:
        """exp(-2 pi i f s) at every frequency and place, (f.size, places); the places are a pixel apart."""
        waves = np.empty((f.size, places.size), dtype=complex)
        waves[:, 0] = np.exp(-2j * np.pi * places[0] * f.ravel())
        waves[:, 1:] = np.exp(-2j * np.pi * self.pixel_size * f.reshape(-1, 1))
        return np.asarray(np.cumprod(waves, axis=1))


def _sum(rows: NDArray[np.complex128], waves: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Sum over the columns at every frequency."""
    return np.asarray(np.einsum("nj,nj->n", rows, waves))
