"""Lenslet grids on real frames of wavefront sensors, and on simulated recordings whose header is known.

The table of real frames is what the finder gave once its overlays had been looked at, frame by frame: it guards against
change. That the steps are right is shown by the autocorrelation of the frame, which knows nothing of spots. The number
of lenslets with light is soft at the border of the pupil. The limits between frames with faint spots and evenly lit
lenslets were set with these frames at hand, and no others are there to test them.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from scipy import ndimage

from coslidar.catalog.archive import open_archive
from coslidar.catalog.ingest import mean_frame
from coslidar.catalog.ingest_files import Reading, open_file
from coslidar.flows.cli import cli
from coslidar.flows.simulate import load_scenario, recordings, shipped
from coslidar.pipeline.lenslets import NoGrid, boxes, find_grid
from coslidar.pipeline.parameters import Header

#: File -> kind, steps (px), turn (deg; None where the array has no rows), lenslets with light, whether format 1 fits.
GRIDS = {
    "mmtwfs/1195.star.p2m18.fits": ("rectangular", (22.7, 22.3), 0.0, (130, 145), False),
    "mmtwfs/LED2sec_22.fits": ("rectangular", (19.99, 19.99), 0.05, (640, 680), True),
    "mmtwfs/TREX_p500_0000.fits": ("hexagonal", (29.1, 29.0), None, (138, 150), False),
    "mmtwfs/auto_wfs_0037_ave.fits": ("rectangular", (30.5, 30.35), 0.0, (140, 156), False),
    "mmtwfs/binospec_ref.fits": ("rectangular", (22.95, 22.95), -0.58, (485, 510), False),
    "mmtwfs/f5_hecto_ref.fits": ("rectangular", (29.64, 29.65), 0.0, (295, 306), False),
    "mmtwfs/f9_new_ref.fits": ("hexagonal", (39.05, 39.05), None, (169, 169), False),
    "mmtwfs/f9_ref.fits": ("hexagonal", (31.53, 31.53), None, (169, 169), False),
    "mmtwfs/f9wfs_20200225-205600.fits": ("hexagonal", (35.2, 34.9), None, (130, 160), False),
    "mmtwfs/mmirs_camera1_ref.fits": ("rectangular", (20.98, 21.0), -1.25, (215, 226), False),
    "mmtwfs/mmirs_camera2_ref.fits": ("rectangular", (22.68, 22.69), 0.51, (219, 230), False),
    "mmtwfs/mmirs_wfs_0150.fits": ("rectangular", (22.1, 22.1), 0.5, (150, 160), False),
    "mmtwfs/mmirs_wfs_rename_0566.fits": ("rectangular", (22.45, 22.45), 0.57, (92, 106), False),
    "mmtwfs/test_newf9.fits": ("hexagonal", (37.2, 36.9), None, (138, 150), False),
    "mmtwfs/wfs_ff_cal_img_2017.1113.111402.fits": ("rectangular", (23.35, 23.95), 0.6, (94, 106), False),
    "mshwfs/img.mat": ("hexagonal", (40.5, 40.5), None, (127, 127), False),
    "mshwfs/sh_flat.mat": ("hexagonal", (40.7, 40.7), None, (127, 127), False),
}
#: File -> why there is no grid.
BLANK = {
    "mmtwfs/mmirs_blank.fits": "no regular grid joins them",
    "mmtwfs/mmirs_bogus.fits": "lenslets without spots",
    "mshwfs/sh_flat_bg.mat": "no regular grid joins them",
}


def picture(folder: Path, name: str) -> NDArray[np.float64]:
    path = folder / "real" / name
    if not path.is_file():
        pytest.skip(f"no {path}")
    return mean_frame([open_file(path, Reading())])


@pytest.mark.parametrize("name", GRIDS)
def test_grid_of_a_real_frame(shared_data: Path, name: str) -> None:
    kind, pitch, turn, lit, fits = GRIDS[name]
    image = picture(shared_data, name)
    grid = find_grid(image)
    assert grid.kind == kind
    # The names of the two steps of a hexagonal array are arbitrary; star light is aberrated by about a pixel.
    assert sorted(grid.pitch) == pytest.approx(sorted(pitch), abs=0.2)
    if turn is not None:
        assert math.degrees(grid.rotation) == pytest.approx(turn, abs=0.12)
    assert lit[0] <= grid.mask.sum() <= lit[1]
    assert grid.n_sources == 1
    assert 1.5 < grid.fwhm < 20
    found = boxes(grid, (image.shape[0], image.shape[1]))
    assert (not found.faults) == fits, found.faults
    if not fits:
        assert ("hexagonal" if kind == "hexagonal" else "must be good to 1 px") in found.faults[0]


@pytest.mark.parametrize("name", GRIDS)
def test_steps_of_a_real_frame_are_peaks_of_its_autocorrelation(shared_data: Path, name: str) -> None:
    image = picture(shared_data, name)
    grid = find_grid(image)
    reach = 0.5 * min(grid.pitch)
    clipped = np.clip(image, *np.quantile(image, [0.02, 0.995]))  # cosmic rays correlate with themselves alone
    # Background and envelope of the pupil are wider than a step: without them its periods remain.
    fine = ndimage.gaussian_filter(clipped, 1) - ndimage.gaussian_filter(clipped, reach)
    power = np.abs(np.fft.rfft2(fine, [2 * n for n in image.shape])) ** 2
    correlation = np.fft.fftshift(np.fft.irfft2(power, [2 * n for n in image.shape]))
    zero = np.array(image.shape)
    half = int(0.35 * min(grid.pitch))
    for vector in grid.vectors:
        centre = zero + np.rint(vector).astype(int)
        near = correlation[centre[0] - half : centre[0] + half + 1, centre[1] - half : centre[1] + half + 1]
        top = np.unravel_index(np.argmax(near), near.shape)
        # Whole pixels, on a triangle of overlaps that pulls a wide peak inwards.
        assert np.hypot(*(np.array(top) - half + centre - zero - vector)) < 1.5
        # No multiple of a step: were half of it a period, the frame would agree with itself there at least as well.
        assert near.max() > 0.4 * correlation.max()
        middle = zero + np.rint(vector / 2).astype(int)
        assert correlation[tuple(middle)] < 0.6 * near.max()


@pytest.mark.parametrize("name", BLANK)
def test_frames_without_spots_are_refused(shared_data: Path, name: str) -> None:
    with pytest.raises(NoGrid, match=BLANK[name]):
        find_grid(picture(shared_data, name))


def test_the_whole_command_on_a_real_frame(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "real" / "mmtwfs" / "LED2sec_22.fits"
    if not source.is_file():
        pytest.skip(f"no {source}")
    drawn = tmp_path / "led.png"
    done = CliRunner().invoke(cli, ["inspect", str(source), "--find-grid", "-o", str(drawn)])
    assert done.exit_code == 0, done.output
    assert "lenslet_pitch = [20, 20]" in done.stdout
    assert drawn.read_bytes()[:4] == b"\x89PNG"


def agrees(image: NDArray[np.float64], header: Header, bad_pixel: NDArray[np.bool_] | None = None) -> None:
    found = boxes(find_grid(image, bad_pixel=bad_pixel), (image.shape[0], image.shape[1]))
    instrument = header.instrument
    assert not found.faults
    assert found.origin == instrument.lenslet_origin
    assert found.pitch == instrument.lenslet_pitch
    np.testing.assert_array_equal(found.mask, instrument.subaperture_mask)
    assert len(found.spots) == len(header.sources)
    # The tilt over all of a short recording moves every spot; a nominal spot is good to a pixel.
    np.testing.assert_allclose(found.spots, [source.spot for source in header.sources], atol=1.0)


def test_grid_of_the_wave_optics_recording_is_its_header(shared_sample: Path) -> None:
    archive = open_archive(shared_sample)
    frames = np.concatenate([archive.read_chunk(i) for i in (0, archive.n_chunks // 2, archive.n_chunks - 1)])
    agrees(frames.mean(axis=0), archive.header)


@pytest.mark.parametrize("name", shipped())
def test_grid_of_a_shipped_scenario_is_its_header(name: str) -> None:
    recording = recordings(load_scenario(name))[0]
    # From all over the recording, as `inspect --find-grid` does it.
    parts = [
        recording.detector.render(*recording.signals(start, start + 32), recording.index[start : start + 32])
        for start in np.linspace(0, recording.n_frames - 32, 4).astype(int).tolist()
    ]
    agrees(np.concatenate(parts).mean(axis=0), recording.scenario.header)
