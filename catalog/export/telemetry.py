"""Slopes and fluxes in the AOT telemetry format of adaptive optics, which `aotpy` opens.

The format knows guide stars and one wavefront sensor for each of them: a source becomes a guide star, and its spots in
all lenslets a Shack-Hartmann sensor with slopes, intensities, lenslet map and detector. There is no corrector: the
loop is open.
"""

from __future__ import annotations

import os
import warnings
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...pipeline.units import safe
from .files import ExportError, missing_package, write_whole

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ...pipeline.parameters import Header
    from ...pipeline.products import Measurements

#: Longest text that the header of a FITS file takes in one piece.
MAX_TEXT = 60


def _ascii(text: str) -> str:
    """Text as a FITS header takes it: printable ASCII, short."""
    return safe(text).encode("ascii", "backslashreplace").decode()[:MAX_TEXT] or "unnamed"


def _moment(nanoseconds: int) -> datetime:
    return datetime.fromtimestamp(nanoseconds / 1e9, UTC).replace(tzinfo=None)


def export_telemetry(header: Header, batches: Sequence[Measurements], path: str | os.PathLike[str]) -> Path:
    """Write slopes and fluxes of a recording as AOT telemetry (a FITS file).

    Parameters
    ----------
    header : Header
        Header of the recording.
    batches : sequence of Measurements
        Its batches in the order of time, as :func:`coslidar.pipeline.batch.measure` makes them.
    path : path
        ``NAME.fits``; replaced where it is there.

    Returns
    -------
    Path
        The file. For each source a sensor ``wfs N`` with `measurements` (time, axis, subaperture) in rad, NaN where
        there is none, and `subaperture_intensities` (time, subaperture) in counts. Time stamps are seconds since 1970
        in double precision, which is good to 0.2 microseconds.

    Raises
    ------
    ExportError
        The package aotpy is not installed, there is nothing to write, the lenslet map is not square (the format has
        none other), or the folder is missing.
    """
    try:
        import aotpy
    except ImportError as error:
        raise missing_package("aotpy", "aot", "AOT telemetry") from error
    if not batches:
        raise ExportError("there are no measurements to export")
    instrument = header.instrument
    mask = np.asarray(instrument.subaperture_mask)
    if mask.shape[0] != mask.shape[1]:
        raise ExportError(f"AOT telemetry has square lenslet maps only; this one is {mask.shape[0]} x {mask.shape[1]}")
    time = np.concatenate([batch.time for batch in batches])
    slopes = np.concatenate([batch.slopes for batch in batches])
    flux = np.concatenate([batch.flux for batch in batches])
    numbers = np.where(mask == 1, np.cumsum(mask == 1).reshape(mask.shape) - 1, -1)

    clock = aotpy.Time(uid="exposures", timestamps=list(time / 1e9))
    detector = aotpy.Detector(
        uid="detector",
        frame_rate=instrument.frame_rate,
        integration_time=instrument.exposure,
        pixel_scale=instrument.pixel_scale,
        readout_noise=instrument.read_noise,
        gain=instrument.gain,
    )
    stars, sensors = [], []
    for number, source in enumerate(header.sources[: slopes.shape[2]]):
        star = aotpy.NaturalGuideStar(uid=f"{number + 1}: {_ascii(source.name)}")
        sensor = aotpy.ShackHartmann(
            uid=f"wfs {number + 1}",
            source=star,
            n_valid_subapertures=int((mask == 1).sum()),
            wavelength=instrument.wavelength,
            subaperture_mask=aotpy.Image(f"mask {number + 1}", numbers.astype(np.int32)),
            subaperture_size=float(min(instrument.lenslet_pitch)),
            measurements=aotpy.Image(f"slopes {number + 1}", slopes[:, :, number], unit="rad", time=clock),
            subaperture_intensities=aotpy.Image(f"fluxes {number + 1}", flux[:, number], unit="ADU", time=clock),
            detector=detector,
            centroid_gains=_gains(batches, number, slopes.shape[3], aotpy),
        )
        stars.append(star)
        sensors.append(sensor)
    system = aotpy.AOSystem(
        ao_mode="SCAO",  # the format wants one; without a corrector it says no more than one line of sight
        name=_ascii(instrument.name or "unnamed instrument"),
        date_beginning=_moment(int(time[0])),
        date_end=_moment(int(time[-1]) + round(1e9 / instrument.frame_rate)),
        config=_ascii(f"{header.campaign}/{header.archive}: open loop"),
        sources=stars,
        wavefront_sensors=sensors,
        main_telescope=aotpy.MainTelescope(
            uid="telescope", enclosing_diameter=float(len(mask) * instrument.subaperture_size)
        ),
    )
    target = Path(path)
    with warnings.catch_warnings():
        # That there is no corrector and no loop is no fault of ours.
        warnings.filterwarnings("ignore", message=".*contains no data")
        write_whole(target, lambda temporary: system.write_to_file(temporary, file_type="fits"))
    return target


def _gains(batches: Sequence[Measurements], number: int, lenslets: int, aotpy: Any) -> Any:
    """Gain of the slopes of one source, (axis, subaperture): the mean of the batches, alike for all lenslets."""
    gain = np.mean([batch.centroid_gain[:, number] for batch in batches], axis=0)
    return aotpy.Image(f"gains {number + 1}", np.repeat(gain[:, None], lenslets, axis=1))
