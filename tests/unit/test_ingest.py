"""Files written as cameras and their software write them, and the archives made of them."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from archives import START, small_frames, small_header, small_time
from astropy.io import fits
from click.testing import CliRunner, Result
from numpy.typing import NDArray

from coslidar.catalog import ingest as module
from coslidar.catalog import ingest_files
from coslidar.catalog.archive import open_archive
from coslidar.catalog.ingest import IngestError, find_sources, instant, plan_ingest, survey
from coslidar.catalog.ingest_files import FileFault, Reading, open_file
from coslidar.flows.cli import cli

N = 20
TIME = {"start": "2012-09-14T12:15:00Z"}


@pytest.fixture
def frames() -> NDArray[np.uint16]:
    return small_frames(small_header(), N)


def write_header(folder: Path, header: dict[str, Any] | None = None, **table: Any) -> Path:
    """A JSON header file with the table [ingest]; times from a start unless they are given."""
    path = folder / "header.json"
    path.write_text(json.dumps({**(header or small_header()), "ingest": {"time": TIME, **table}}))
    return path


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, ["ingest", *map(str, arguments)])


def faults(sources: list[Path], header: Path, **options: Any) -> list[str]:
    with pytest.raises(IngestError) as caught:
        plan_ingest(sources, header, **options)
    return caught.value.faults


# --- kinds of files ----------------------------------------------------------------------------------------


def as_fits(path: Path, frames: NDArray[Any]) -> None:
    fits.PrimaryHDU(frames).writeto(path)


def as_compressed_fits(path: Path, frames: NDArray[Any]) -> None:
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(frames)]).writeto(path)


def as_hdf5(path: Path, frames: NDArray[Any]) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "camera/frames", data=frames, chunks=(min(7, len(frames)), *frames.shape[1:]), compression="gzip"
        )
        file["temperature"] = 20.5


def as_npy(path: Path, frames: NDArray[Any]) -> None:
    np.save(path, frames)


def as_fortran(path: Path, frames: NDArray[Any]) -> None:
    np.save(path, np.asfortranarray(frames))


def as_npz(path: Path, frames: NDArray[Any]) -> None:
    np.savez_compressed(path, frames=frames, exposure=np.float64(1e-3))


def as_tiff(path: Path, frames: NDArray[Any]) -> None:
    tifffile.imwrite(path, frames, photometric="minisblack")


def as_big_endian_tiff(path: Path, frames: NDArray[Any]) -> None:
    tifffile.imwrite(path, frames, photometric="minisblack", byteorder=">")


def as_compressed_tiff(path: Path, frames: NDArray[Any]) -> None:
    tifffile.imwrite(path, frames, photometric="minisblack", compression="zlib")


def as_pages(path: Path, frames: NDArray[Any]) -> None:
    with tifffile.TiffWriter(path) as file:
        for frame in frames:
            file.write(frame, photometric="minisblack")


def as_imagej(path: Path, frames: NDArray[Any]) -> None:
    tifffile.imwrite(path, frames, imagej=True)


def as_matlab(path: Path, frames: NDArray[Any]) -> None:
    scipy.io.savemat(path, {"frames": frames, "rate": 100.0})


WRITERS = {
    "a.fits": as_fits,
    "a.fits.gz": as_fits,
    "b.fits": as_compressed_fits,
    "a.h5": as_hdf5,
    "a.npy": as_npy,
    "b.npy": as_fortran,
    "a.npz": as_npz,
    "a.tif": as_tiff,
    "b.tif": as_big_endian_tiff,
    "c.tiff": as_compressed_tiff,
    "d.tif": as_pages,
    "e.tif": as_imagej,
    "a.mat": as_matlab,
}


@pytest.mark.parametrize("name", WRITERS)
def test_round_trip(tmp_path: Path, frames: NDArray[Any], name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BLOCK_BYTES", 3 * frames[0].nbytes)  # many blocks, the last one shorter
    source = tmp_path / name
    WRITERS[name](source, frames)
    done = run(source, "--header", write_header(tmp_path), "-o", tmp_path / "out.zarr.zip")
    assert done.exit_code == 0, (done.output, done.exception)
    archive = open_archive(tmp_path / "out.zarr.zip")
    assert archive.dtype == frames.dtype
    np.testing.assert_array_equal(archive.read_chunk(0), frames)
    np.testing.assert_array_equal(archive.time, small_time(N))
    assert archive.attributes["ingest"]["first_file"] == name


@pytest.mark.parametrize("name", WRITERS)
def test_a_part_of_the_frames(tmp_path: Path, frames: NDArray[Any], name: str) -> None:
    """As an ingest that goes on reads them; blocks end where they do without `start`, at chunks of the file."""
    WRITERS[name](tmp_path / name, frames)
    blocks = list(open_file(tmp_path / name, Reading()).blocks(7, start=5, stop=17))
    assert [len(block) for block in blocks] == [2, 7, 3]
    np.testing.assert_array_equal(np.concatenate(blocks), frames[5:17])


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
@pytest.mark.parametrize("kind", ["fits", "h5", "npy", "tif"])
def test_every_type_of_the_format_passes_unchanged(tmp_path: Path, kind: str, dtype: str) -> None:
    shot = small_frames(small_header(), 4, dtype="uint8").astype(dtype)
    if dtype == "int16":
        shot -= 90
    if dtype == "float32":
        shot += np.float32(0.25)
    source = tmp_path / f"a.{kind}"
    WRITERS[f"a.{kind}"](source, shot)
    assert run(source, "--header", write_header(tmp_path), "-o", tmp_path / "o.zarr").exit_code == 0
    archive = open_archive(tmp_path / "o.zarr")
    assert archive.dtype.name == dtype
    np.testing.assert_array_equal(archive.read_chunk(0), shot)


@pytest.mark.parametrize(("dtype", "offset", "gap"), [("<u2", 0, 0), (">u2", 512, 0), ("<u2", 100, 36), ("<i4", 7, 5)])
@pytest.mark.parametrize("last_gap", [True, False])
def test_raw_binary(tmp_path: Path, frames: NDArray[Any], dtype: str, offset: int, gap: int, last_gap: bool) -> None:
    stored = frames.astype(dtype)
    content = bytes(offset) + b"".join(frame.tobytes() + b"\xee" * gap for frame in stored)
    (tmp_path / "a.raw").write_bytes(content if last_gap or not gap else content[:-gap])
    header = write_header(tmp_path, raw_dtype=dtype, raw_shape=[48, 30], raw_offset=offset, raw_gap=gap)
    done = run(tmp_path / "a.raw", "--header", header, "-o", tmp_path / "o.zarr")
    assert done.exit_code == 0, done.exception
    np.testing.assert_array_equal(open_archive(tmp_path / "o.zarr").read_chunk(0), frames)


def test_raw_binary_of_another_size_is_refused(tmp_path: Path, frames: NDArray[Any]) -> None:
    (tmp_path / "a.raw").write_bytes(frames.tobytes()[:-11])
    found = faults([tmp_path / "a.raw"], write_header(tmp_path, raw_dtype="<u2", raw_shape=[48, 30]))
    assert "2869 bytes are left over" in found[0]
    assert "needs the type and shape" in faults([tmp_path / "a.raw"], write_header(tmp_path))[0]


@pytest.mark.parametrize("axes", list(itertools.permutations(("time", "row", "col"))))
@pytest.mark.parametrize("kind", ["npy", "h5", "fits"])
def test_axes_in_any_order(tmp_path: Path, frames: NDArray[Any], axes: tuple[str, ...], kind: str) -> None:
    stored = frames.transpose([("time", "row", "col").index(name) for name in axes])
    source = tmp_path / f"a.{kind}"
    WRITERS[f"a.{kind}"](source, np.ascontiguousarray(stored))
    output = tmp_path / "o.zarr"
    done = run(source, "--header", write_header(tmp_path), "-o", output, "--axes", ",".join(axes))
    assert done.exit_code == 0, done.exception
    np.testing.assert_array_equal(open_archive(output).read_chunk(0), frames)


def test_region_of_interest_with_its_calibration(tmp_path: Path, frames: NDArray[Any]) -> None:
    wide = np.zeros((N, 60, 50), np.uint16)
    wide[:, 5:53, 8:38] = frames
    darks = np.random.default_rng(0).integers(0, 9, (7, 60, 50)).astype(np.uint16)
    flat = np.random.default_rng(1).uniform(0.9, 1.1, (48, 30)).astype(np.float32)  # of the region alone
    bad = np.zeros((60, 50), np.uint8)
    bad[6, 9] = 255
    np.save(tmp_path / "a.npy", wide)
    as_fits(tmp_path / "darks.fits", darks)
    np.save(tmp_path / "flat.npy", flat)
    as_tiff(tmp_path / "bad.tif", bad)
    header = write_header(tmp_path, dark="darks.fits", flat="flat.npy", rows=[5, 53])
    output = tmp_path / "o.zarr.zip"
    done = run(tmp_path / "a.npy", "--header", header, "-o", output, "--columns", "8:38", "--bad-pixel",
               tmp_path / "bad.tif")  # fmt: skip
    assert done.exit_code == 0, done.exception
    archive = open_archive(output)
    np.testing.assert_array_equal(archive.read_chunk(0), frames)
    # The mean of the darks, rounded once to float32.
    np.testing.assert_array_equal(archive.dark, darks.mean(axis=0)[5:53, 8:38].astype(np.float32))
    np.testing.assert_array_equal(archive.flat, flat)
    assert np.argwhere(archive.bad_pixel).tolist() == [[1, 1]]


def test_many_files_in_natural_order(tmp_path: Path, frames: NDArray[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    for number, frame in enumerate(frames):
        as_tiff(tmp_path / f"shot_{number}.tif", frame)
    header = write_header(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert run("shot_*.tif", "--header", header, "-o", "o.zarr").exit_code == 0
    np.testing.assert_array_equal(open_archive("o.zarr").read_chunk(0), frames)
    as_a_shell_does = sorted(path.name for path in tmp_path.glob("shot_*.tif"))
    done = run(*as_a_shell_does, "--header", header, "-o", "p.zarr")
    assert "shot_10.tif comes before shot_2.tif" in done.exception.faults[0]  # type: ignore[union-attr]
    assert run(*as_a_shell_does, "--header", header, "-o", "p.zarr", "--given-order").exit_code == 0
    order = [int(name[5:-4]) for name in as_a_shell_does]
    np.testing.assert_array_equal(open_archive("p.zarr").read_chunk(0), frames[order])


def test_sources_that_cannot_be_meant(tmp_path: Path) -> None:
    (tmp_path / "a.npy").touch()
    for sources, reason in (
        ([str(tmp_path / "*.fits")], "no file matches"),
        ([str(tmp_path / "a.npy")] * 2, "named twice"),
        ([], "no source file"),
    ):
        with pytest.raises(IngestError, match=reason):
            find_sources(sources)


# --- time --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("written", "zone", "expected"),
    [
        ("2012-09-14T12:15:00Z", None, START),
        ("2012-09-14 12:15:00.000000001 UTC", None, START + 1),
        ("2012-09-14T14:15:00.5+02:00", None, START + 500_000_000),
        ("2012-09-14T14:15", "Europe/Paris", START),
        ("2012-12-14T13:15:00", "Europe/Paris", START + 91 * 86400 * 10**9),  # winter time
        ("1969-12-31T23:59:59.75Z", None, -250_000_000),
    ],
)
def test_written_times(written: str, zone: str | None, expected: int) -> None:
    assert instant(written, zone) == expected


@pytest.mark.parametrize(
    "written", ["2012-09-14T12:15:00", "yesterday", "2012-13-14T12:15:00Z", "", "9999-01-01T00:00Z"]
)
def test_what_is_no_time(written: str) -> None:
    with pytest.raises(FileFault):
        instant(written)


def ingested(folder: Path, sources: list[Path], time: dict[str, Any]) -> NDArray[np.int64]:
    header = write_header(folder, time=time)
    return plan_ingest(sources, header).time


@pytest.mark.parametrize(
    ("unit", "epoch", "tolerance"),
    [("ns", None, 0), ("s", None, 400), ("ms", "2012-09-14T00:00:00Z", 1), ("us", "2012-09-14T12:00:00Z", 1),
     ("day", "1858-11-17T00:00:00Z", 700)],
)  # fmt: skip
def test_time_stamps_beside_the_frames(
    tmp_path: Path, frames: NDArray[Any], unit: str, epoch: str | None, tolerance: int
) -> None:
    """Two roundings to a double of seconds since 1970 are 1.8e-7 s each, those of days 6e-7 s; integers are exact."""
    expected = small_time(N) + np.random.default_rng(0).integers(0, 10**6, N)
    zero = 0 if epoch is None else int(np.datetime64(epoch.rstrip("Z"), "ns").astype(np.int64))
    factor = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "day": 86400 * 10**9}[unit]
    stamps = expected - zero if unit == "ns" else (expected - zero) / factor
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"], file["stamps"] = frames, stamps
    np.savez(tmp_path / "a.npz", frames=frames, stamps=stamps)
    column = fits.Column("stamps", "K" if unit == "ns" else "D", array=stamps)
    fits.HDUList([fits.PrimaryHDU(frames), fits.BinTableHDU.from_columns([column])]).writeto(tmp_path / "a.fits")
    scipy.io.savemat(tmp_path / "a.mat", {"frames": frames, "stamps": stamps})
    np.save(tmp_path / "stamps.npy", stamps)
    table = {"unit": unit, **({} if epoch is None else {"epoch": epoch})}
    for name in ("a.h5", "a.npz", "a.fits", "a.mat"):
        found = ingested(tmp_path, [tmp_path / name], {"dataset": "stamps", **table})
        assert np.abs(found - expected).max() <= tolerance, name
    found = ingested(tmp_path, [tmp_path / "a.fits"], {"file": "stamps.npy", **table})
    assert np.abs(found - expected).max() <= tolerance


def test_times_in_a_text_file(tmp_path: Path, frames: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", frames)
    stamps = [f"{np.datetime64(int(t), 'ns')}Z" for t in small_time(N)]
    (tmp_path / "times.txt").write_text(
        "# start of exposure, frame\n" + "".join(f"{t}, {i}\n" for i, t in enumerate(stamps))
    )
    np.testing.assert_array_equal(ingested(tmp_path, [tmp_path / "a.npy"], {"file": "times.txt"}), small_time(N))
    (tmp_path / "times.txt").write_text("\n".join(stamps[1:]))
    found = faults([tmp_path / "a.npy"], write_header(tmp_path, time={"file": "times.txt"}))
    assert "holds 19 times for 20 frames" in found[0]


def test_one_time_per_file(tmp_path: Path, frames: NDArray[Any]) -> None:
    """By keyword, name and list; frames of one file follow at the frame rate."""
    starts = [f"2012-09-14T12:15:0{k}.250" for k in range(4)]
    sources = []
    for number, start in enumerate(starts):
        unit = fits.PrimaryHDU(frames[5 * number : 5 * number + 5])
        unit.header["DATE-OBS"] = start
        unit.header["MJD"] = 56184.0 + (44100 + number + 0.25) / 86400
        sources.append(tmp_path / f"rec_2012-09-14T12150{number}.250.fits")
        unit.writeto(sources[-1])
    expected = np.concatenate([START + 250_000_000 + k * 10**9 + np.arange(5) * 10**7 for k in range(4)])
    mjd = {"keyword": "MJD", "unit": "day", "epoch": "1858-11-17T00:00:00Z"}
    for time, tolerance in (
        ({"keyword": "DATE-OBS"}, 0),
        (mjd, 700),  # a double holds such a day to 6e-7 s
        ({"pattern": "rec_%Y-%m-%dT%H%M%S.%f.fits", "zone": "UTC"}, 0),
        ({"per_file": [f"{start}Z" for start in starts]}, 0),
    ):
        assert np.abs(ingested(tmp_path, sources, time) - expected).max() <= tolerance, time
    shifted = ingested(tmp_path, sources, {"keyword": "DATE-OBS", "shift": "-1 ms"})
    np.testing.assert_array_equal(shifted, expected - 10**6)


def test_a_date_tag_of_tiff_is_local_time(tmp_path: Path, frames: NDArray[Any]) -> None:
    tifffile.imwrite(tmp_path / "a.tif", frames, photometric="minisblack", datetime="2012:09:14 14:15:00")
    time = {"keyword": "DateTime", "zone": "Europe/Paris"}
    np.testing.assert_array_equal(ingested(tmp_path, [tmp_path / "a.tif"], time), small_time(N))
    found = faults([tmp_path / "a.tif"], write_header(tmp_path, time={"keyword": "DateTime"}))
    assert "names no time zone" in found[0]


def test_times_that_disagree_with_the_frame_rate_are_refused(tmp_path: Path, frames: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", frames)
    found = faults([tmp_path / "a.npy"], write_header(tmp_path, time={**TIME, "rate": "90 Hz"}))
    assert "must agree within 1%" in found[0]
    np.save(tmp_path / "t.npy", np.zeros(N, np.int64))
    found = faults([tmp_path / "a.npy"], write_header(tmp_path, time={"file": "t.npy", "unit": "ns"}))
    assert "time must increase strictly" in found[0]


# --- types -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        (np.array([0, 65535], "i4"), "uint16"),
        (np.array([-5, 300], "i8"), "int16"),
        (np.array([-5, 70000], "i4"), "float32"),
        (np.array([0, 2**24], "u4"), "float32"),
        (np.array([3.0, 12.0], "f8"), "uint16"),
        (np.array([0.5, -1.25], "f8"), "float32"),
        (np.array([2.0, np.nan], "f8"), "float32"),
        (np.array([1.0, 2.5], "f2"), "float32"),
        (np.array([True, False]), "uint16"),
    ],
)
def test_the_smallest_exact_type_is_taken(tmp_path: Path, stored: NDArray[Any], expected: str) -> None:
    shot = np.resize(stored, (4, 48, 30))
    np.save(tmp_path / "a.npy", shot)
    output = tmp_path / "o.zarr"
    done = run(tmp_path / "a.npy", "--header", write_header(tmp_path), "-o", output)
    assert done.exit_code == 0, done.exception
    archive = open_archive(output)
    assert archive.dtype.name == expected
    np.testing.assert_array_equal(archive.read_chunk(0).astype(np.float64), shot.astype(np.float64))


@pytest.mark.parametrize(
    "stored", [np.array([0, 2**24 + 1], "i4"), np.array([0.1, 2.0]), np.array([-1, 2**40 + 1], "i8")]
)
def test_nothing_is_rounded(tmp_path: Path, stored: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", np.resize(stored, (4, 48, 30)))
    header = write_header(tmp_path)
    done = run(tmp_path / "a.npy", "--header", header, "-o", tmp_path / "o.zarr")
    assert isinstance(done.exception, IngestError)
    assert "holds them exactly" in str(done.exception)
    assert "save them as float32" in str(done.exception)
    assert not (tmp_path / "o.zarr").exists()


def test_a_type_that_was_asked_for_must_be_exact(tmp_path: Path, frames: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", frames)
    assert run(tmp_path / "a.npy", "--header", write_header(tmp_path, dtype="float32"), "-o",
               tmp_path / "f.zarr").exit_code == 0  # fmt: skip
    assert open_archive(tmp_path / "f.zarr").dtype == np.float32
    done = run(tmp_path / "a.npy", "--header", write_header(tmp_path, dtype="uint8"), "-o", tmp_path / "u.zarr")
    assert "are not all exact in uint8" in str(done.exception)
    assert os.listdir(tmp_path).count("u.zarr") == 0


# --- faults ------------------------------------------------------------------------------------------------


def test_every_fault_at_once(tmp_path: Path, frames: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", frames)
    np.save(tmp_path / "b.npy", frames[:, :40])
    np.save(tmp_path / "dark.npy", frames[0, :10, :10])
    header = small_header(instrument__wavelength="3.8", path__length=None, instrument__lenslet_origin=[40, 0])
    path = write_header(
        tmp_path,
        header,
        rows=[0, 99],
        dark="dark.npy",
        flat="none.fits",
        wrong=1,
        time={"start": "2012-09-14T12:15:00"},
    )
    found = faults([tmp_path / "a.npy", tmp_path / "b.npy", tmp_path / "c.npy", tmp_path / "d.xyz"], path)
    text = "\n".join(found)
    for part in (
        "header.json: instrument.wavelength = '3.8': the unit is missing",
        "header.json: path.length is missing",
        "instrument.lenslet_origin = [40, 0]",
        "header.json: ingest.wrong = 1: there is no such key",
        "ingest.rows = [0, 99]: the frames have 48 rows",
        "names no time zone",
        "b.npy: frames of uint16 [40, 30]",
        "c.npy: there is no such file",
        "d.xyz: there is no such file",
        "dark.npy: ingest.dark: it is [10, 10]",
        "none.fits: ingest.flat: there is no such file",
    ):
        assert part in text, part
    assert len(found) == len(set(found))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"time": {}}, "0 ways to tell the time are given"),
        ({"time": {**TIME, "file": "x"}}, "2 ways to tell the time are given (start, file)"),
        ({"time": {"dataset": "t"}}, "holds nothing but frames"),
        ({"time": {"keyword": "DATE"}}, "has no keywords"),
        ({"time": {**TIME, "zone": "Mars/Olympus"}}, "no such time zone"),
        ({"time": {**TIME, "rate": 100}}, "the unit is missing"),
        ({"axes": ["time", "row", "row"]}, "once each"),
        ({"rows": [10, 10]}, "the end must be larger"),
        ({"raw_dtype": "blob"}, "no such type"),
        ({"raw_dtype": "O"}, "counts are"),
        ({"format": "bmp"}, "ingest.format"),
        ({"dtype": "float64"}, "ingest.dtype"),
    ],
)
def test_faults_of_the_table(tmp_path: Path, frames: NDArray[Any], table: dict[str, Any], message: str) -> None:
    np.save(tmp_path / "a.npy", frames)
    found = faults([tmp_path / "a.npy"], write_header(tmp_path, **table))
    assert any(message in sentence for sentence in found), found


def test_a_missing_time_says_what_to_write(tmp_path: Path, frames: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", frames)
    (tmp_path / "h.json").write_text(json.dumps(small_header()))
    assert "ingest.time is missing; say where" in faults([tmp_path / "a.npy"], tmp_path / "h.json")[0]


def test_toml_with_a_date_and_a_name_from_the_command_line(tmp_path: Path, frames: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", frames)
    (tmp_path / "h.toml").write_text(
        """
campaign = "c"
[ingest.time]
start = 2012-09-14T12:15:00Z
[instrument]
wavelength = "3.8 um"
frame_rate = "100 Hz"
pixel_scale = "27 urad"
subaperture_size = "7 cm"
subaperture_mask = [[1, 1, 1], [1, 0, 1], [1, 1, 1]]
lenslet_origin = [0, 0]
lenslet_pitch = [16, 10]
[path]
length = "2670 m"
[[sources]]
name = "one"
position = ["0 m", "0 m"]
fwhm = ["1 cm", "1 cm"]
spot = [3.9, 4.5]
"""
    )
    plan = plan_ingest([tmp_path / "a.npy"], tmp_path / "h.toml", archive="evening")
    np.testing.assert_array_equal(plan.time, small_time(N))
    assert plan.attributes["archive"] == "evening"
    later = plan_ingest(
        [tmp_path / "a.npy"], tmp_path / "h.toml", archive="e", changes={"time": {"start": "2013-01-01T00:00:00Z"}}
    )
    assert later.time[0] == 1356998400 * 10**9


@pytest.mark.parametrize("name", ["a.fits", "a.h5", "a.npz", "a.tif", "c.tiff", "a.mat", "a.npy"])
@pytest.mark.parametrize("part", [0.0, 0.02, 0.5, 0.98])
def test_files_that_were_cut_off(tmp_path: Path, frames: NDArray[Any], name: str, part: float) -> None:
    """Whatever a library makes of half a file, it is a fault of the file, told in a sentence: there is no archive."""
    source = tmp_path / name
    WRITERS[name](source, frames)
    whole = source.read_bytes()
    # Blocks of 2880 bytes end FITS files: what is cut off must be pixels.
    source.write_bytes(whole[: min(int(part * len(whole)), len(whole) - 3000)])
    done = run(source, "--header", write_header(tmp_path), "-o", tmp_path / "o.zarr.zip")
    assert isinstance(done.exception, IngestError), (done.exit_code, done.exception)
    assert str(source) in str(done.exception)
    assert not (tmp_path / "o.zarr.zip").exists()


def test_frames_that_are_none(tmp_path: Path) -> None:
    header = write_header(tmp_path)
    np.save(tmp_path / "four.npy", np.zeros((2, 3, 4, 5)))
    np.save(tmp_path / "text.npy", np.array([["a", "b"]]))
    np.savez(tmp_path / "two.npz", a=np.zeros((3, 48, 30)), b=np.zeros((3, 48, 30)))
    tifffile.imwrite(tmp_path / "rgb.tif", np.zeros((48, 30, 3), np.uint8), photometric="rgb")
    fits.HDUList(
        [fits.PrimaryHDU(), fits.ImageHDU(np.zeros((48, 30)), name="A"), fits.ImageHDU(np.zeros((48, 30)))]
    ).writeto(tmp_path / "two.fits")
    with h5py.File(tmp_path / "none.h5", "w") as file:
        file["x"] = np.zeros(3)
    (tmp_path / "empty.fits").touch()
    (tmp_path / "object.npy").write_bytes(b"")
    np.save(tmp_path / "object.npy", np.array([{}], dtype=object), allow_pickle=True)
    for name, reason in (
        ("four.npy", "the data have shape [2, 3, 4, 5]"),
        ("text.npy", "counts are"),
        ("two.npz", "there are 2 arrays that may be frames (a, b)"),
        ("rgb.tif", "in colour"),
        ("two.fits", "there are 2 images"),
        ("none.h5", "there are 0 datasets"),
        ("empty.fits", "the file is empty"),
        ("object.npy", "cannot be read"),
    ):
        assert reason in faults([tmp_path / name], header)[0], name
    assert "this is a folder" in faults([tmp_path], header)[0]
    assert open_file(tmp_path / "two.fits", Reading(dataset="A")).frame_shape == (48, 30)
    assert open_file(tmp_path / "two.npz", Reading(dataset="b")).n_frames == 3


def test_a_library_that_is_missing_is_named(
    tmp_path: Path, frames: NDArray[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    as_tiff(tmp_path / "a.tif", frames)

    def missing(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(ingest_files, "import_module", missing)
    assert "needs the package tifffile" in faults([tmp_path / "a.tif"], write_header(tmp_path))[0]
    assert "pip install 'coslidar[ingest]'" in faults([tmp_path / "a.tif"], write_header(tmp_path))[0]


# --- the command -------------------------------------------------------------------------------------------


def test_a_dry_run_writes_nothing_and_tells_what_it_would(tmp_path: Path, frames: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", frames.astype(np.int32))
    before = sorted(os.listdir(tmp_path))
    header = write_header(tmp_path)
    done = run(tmp_path / "a.npy", "--header", header, "-o", tmp_path / "o.zarr.zip", "--dry-run", "--json")
    assert done.exit_code == 0
    told = json.loads(done.stdout)
    assert told["dtype"] == "uint16"
    assert told["frames"] == N
    assert told["highest_count"] == frames.max()
    assert told["lowest_count"] == frames.min()
    assert told["pixels_at_highest"] == np.sum(frames == frames.max())
    assert told["bytes_raw"] == frames.nbytes
    assert sorted(os.listdir(tmp_path)) == sorted([*before, "header.json"])


def test_the_exit_code_of_bad_input_is_2(tmp_path: Path, frames: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", frames)
    program = [sys.executable, "-m", "coslidar.flows.cli"]
    code = "from coslidar.flows.cli import main; main()"
    arguments = [
        "ingest",
        str(tmp_path / "a.npy"),
        "--header",
        str(tmp_path / "none.toml"),
        "-o",
        str(tmp_path / "o.zarr"),
    ]
    done = subprocess.run([program[0], "-c", code, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("coslidar: ")
    assert "cannot be read" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_same_command_again_keeps_what_is_done(tmp_path: Path, frames: NDArray[Any]) -> None:
    np.save(tmp_path / "a.npy", frames)
    command = [tmp_path / "a.npy", "--header", write_header(tmp_path), "-o", tmp_path / "o.zarr.zip"]
    assert run(*command).exit_code == 0
    written = (tmp_path / "o.zarr.zip").stat().st_mtime_ns
    assert run(*command).exit_code == 0
    assert (tmp_path / "o.zarr.zip").stat().st_mtime_ns == written
    np.save(tmp_path / "a.npy", frames + np.uint16(1))
    done = run(*command)
    assert "is there already and is not of these sources" in str(done.exception)
    assert run(*command, "--force").exit_code == 0
    np.testing.assert_array_equal(open_archive(tmp_path / "o.zarr.zip").read_chunk(0), frames + 1)


def test_two_ingests_of_one_archive_keep_out_of_each_others_way(tmp_path: Path, frames: NDArray[Any]) -> None:
    import fcntl

    np.save(tmp_path / "a.npy", frames)
    header = write_header(tmp_path)
    with (tmp_path / ".o.zarr.ingest").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = run(tmp_path / "a.npy", "--header", header, "-o", tmp_path / "o.zarr")
    assert "another ingest is writing" in str(done.exception)
    assert run(tmp_path / "a.npy", "--header", header, "-o", tmp_path / "o.zarr").exit_code == 0


_MEASURED = """
import resource, sys
from pathlib import Path
from coslidar.catalog import ingest as module
folder = Path(sys.argv[1])
small = module.plan_ingest([folder / "small.raw"], folder / "header.json", archive="small")
module.ingest(small, folder / "small.zarr")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
plan = module.plan_ingest([folder / "large.raw"], folder / "header.json")
module.ingest(plan, folder / "large.zarr")
print(before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, plan.n_frames)
"""


def test_a_long_recording_does_not_take_more_memory(tmp_path: Path) -> None:
    """400 MB of frames are ingested with less than a quarter of that beyond what a short recording takes."""
    frame = 48 * 30 * 2
    for name, size in (("small.raw", 60 * 2**20), ("large.raw", 400 * 2**20)):
        with (tmp_path / name).open("wb") as file:
            file.truncate(size // frame * frame)  # holes: no disk, read as zeros
    write_header(tmp_path, raw_dtype="<u2", raw_shape=[48, 30])
    done = subprocess.run([sys.executable, "-c", _MEASURED, str(tmp_path)], capture_output=True, text=True, check=True)
    before, after, frames = (int(number) for number in done.stdout.split())
    assert frames * frame > 399 * 2**20
    assert (after - before) / 1024 < 100, (before, after)


def test_survey_counts_what_is_not_finite(tmp_path: Path) -> None:
    shot = np.ones((3, 48, 30), np.float32)
    shot[1, 2, 3:5] = np.nan
    shot[0, 0, 0] = 7
    np.save(tmp_path / "a.npy", shot)
    found = survey(plan_ingest([tmp_path / "a.npy"], write_header(tmp_path)))
    assert (found.dtype, found.low, found.high, found.not_finite, found.at_top) == ("float32", 1.0, 7.0, 2, 1)


# --- inspect --find-grid -----------------------------------------------------------------------------------


def test_the_printed_grid_completes_a_header(tmp_path: Path, frames: NDArray[Any]) -> None:
    import tomllib

    np.save(tmp_path / "a.npy", frames)
    done = CliRunner().invoke(
        cli, ["inspect", str(tmp_path / "a.npy"), "--find-grid", "-o", str(tmp_path / "grid.svg")]
    )
    assert done.exit_code == 0, done.exception
    found, known = tomllib.loads(done.stdout), small_header()
    for key in ("subaperture_mask", "lenslet_origin", "lenslet_pitch"):
        assert found["instrument"][key] == known["instrument"][key]
    for source, expected in zip(found["sources"], known["sources"], strict=True):
        assert source["spot"] == pytest.approx(expected["spot"], abs=0.15)
    assert "<svg" in (tmp_path / "grid.svg").read_text()
    as_json = CliRunner().invoke(cli, ["inspect", str(tmp_path / "a.npy"), "--find-grid", "--json"])
    assert json.loads(as_json.stdout) == found


def test_raw_frames_are_inspected_with_a_header_file(tmp_path: Path, frames: NDArray[Any]) -> None:
    (tmp_path / "a.raw").write_bytes(frames.tobytes())
    header = tmp_path / "h.toml"
    header.write_text('[ingest]\nraw_dtype = "<u2"\nraw_shape = [48, 30]\nrows = [16, 48]\n')
    done = CliRunner().invoke(cli, ["inspect", str(tmp_path / "a.raw"), "--find-grid", "--header", str(header)])
    assert done.exit_code == 0, done.exception
    assert "lenslet_pitch = [16, 10]" in done.stdout
    assert "[1, 0, 1],\n  [1, 1, 1],\n]" in done.stdout


def test_no_grid_is_told_and_drawn(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(100, 3, (64, 64)).astype(np.float32))
    done = CliRunner().invoke(cli, ["inspect", str(tmp_path / "a.npy"), "--find-grid", "-o", str(tmp_path / "g.png")])
    assert "a grid needs 4" in str(done.exception)
    assert (tmp_path / "g.png").exists()


def test_the_header_file_of_the_page_works(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "ingest.md").read_text()
    (tmp_path / "header.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    as_fits(tmp_path / "dark.fits", np.zeros((4, 200, 180), np.uint16))
    as_fits(tmp_path / "frames.fits", np.ones((30, 200, 180), np.uint16))
    plan = plan_ingest([tmp_path / "frames.fits"], tmp_path / "header.toml")
    assert plan.frame_shape == (160, 160)
    assert plan.time[1] - plan.time[0] == round(1e9 / 142)
    assert plan.planes["dark"].shape == (160, 160)
