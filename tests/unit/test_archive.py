"""Raw frame archives: what is written is read, whatever is wrong is said, and nothing crashes."""

from __future__ import annotations

import gzip
import http.server
import json
import math
import os
import pickle
import shutil
import struct
import subprocess
import sys
import textwrap
import threading
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import zarr
from archives import START, small_frames, small_header, small_time, write_small
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, GzipCodec, ShardingCodec, TransposeCodec, ZstdCodec

from coslidar.catalog.archive import Archive, ArchiveError, ChunkError, describe, notes, open_archive
from coslidar.catalog.archive_writer import write_archive


def contents(archive: Archive) -> np.ndarray:
    return np.concatenate([frames for _, frames in archive.chunks()])


def edit(path: Path, key: str, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change one JSON document of a folder archive in place."""
    file = path / key
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))


def edit_header(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    edit(path, "zarr.json", lambda document: change(document["attributes"]))


def put(group: dict[str, Any], where: str, value: Any) -> None:
    *parents, leaf = where.split(".")
    for parent in parents:
        group = group[int(parent)] if isinstance(group, list) else group[parent]
    if isinstance(group, list):
        group[int(leaf)] = value
    else:
        group[leaf] = value


def replace_array(path: Path, name: str, values: np.ndarray, dimensions: tuple[str, ...]) -> None:
    """Write one array again, with another shape, type or content, through zarr."""
    shutil.rmtree(path / name)
    array = zarr.open_group(path, mode="r+").create_array(
        name, shape=values.shape, dtype=values.dtype, dimension_names=dimensions
    )
    array[...] = values


def pack(folder: Path, target: Path, compression: int = zipfile.ZIP_STORED, prefix: str = "") -> Path:
    with zipfile.ZipFile(target, "w", compression) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, prefix + str(file.relative_to(folder)))
    return target


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A valid archive in a folder: 40 frames in chunks of 16."""
    return write_small(tmp_path / "small.zarr")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str, str]]:
    """A folder, its URL on a server without byte ranges, and its URL on one with them."""
    root = tmp_path_factory.mktemp("served")

    class Plain(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *args: Any) -> None:
            pass

    class Ranges(Plain):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range")
            file = Path(self.translate_path(self.path))
            if wanted is None or not file.is_file():
                return super().do_GET()
            begin, _, end = wanted.removeprefix("bytes=").partition("-")
            data = file.read_bytes()
            part = data[int(begin) : int(end) + 1 if end else None]
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {begin}-{int(begin) + len(part) - 1}/{len(data)}")
            self.send_header("Content-Length", str(len(part)))
            self.end_headers()
            self.wfile.write(part)
            return None

    servers = [
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(root)))
        for handler in (Plain, Ranges)
    ]
    for server in servers:
        threading.Thread(target=server.serve_forever, daemon=True).start()
    plain, ranges = (f"http://127.0.0.1:{server.server_port}" for server in servers)
    yield root, plain, ranges
    for server in servers:
        server.shutdown()
        server.server_close()


# --- round trips -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
@pytest.mark.parametrize("name", ["a.zarr", "a.zarr.zip"])
@pytest.mark.parametrize("codec", ["lz4", "zstd"])
def test_what_is_written_is_read(tmp_path: Path, dtype: str, name: str, codec: str) -> None:
    header = small_header()
    frames = small_frames(header, 40, dtype=dtype)
    path = write_small(tmp_path / name, dtype=dtype, codec=codec)
    archive = open_archive(path)
    assert archive.n_frames == 40
    assert archive.frame_shape == frames.shape[1:] == (48, 30)
    assert archive.dtype == np.dtype(dtype)
    assert (archive.chunk_frames, archive.n_chunks) == (16, 3)
    assert archive.attributes == header
    assert archive.header.instrument.wavelength == 3.8e-6
    np.testing.assert_array_equal(archive.time, small_time(40))
    np.testing.assert_array_equal(contents(archive), frames)
    assert archive.dark is not None
    assert archive.dark.dtype == np.float32
    assert archive.flat is not None
    assert archive.bad_pixel is not None
    assert archive.bad_pixel.dtype == np.bool_
    assert archive.bad_pixel.sum() == 1
    assert archive.missing_chunks == ()
    # zarr reads the same, so that anybody can.
    store = zarr.storage.ZipStore(path, mode="r") if path.suffix == ".zip" else path
    np.testing.assert_array_equal(zarr.open_group(store, mode="r")["frames"][:], frames)


def test_calibration_may_be_absent(tmp_path: Path) -> None:
    archive = open_archive(write_small(tmp_path / "a.zarr", calibrated=False))
    assert (archive.dark, archive.flat, archive.bad_pixel) == (None, None, None)
    assert any("no dark" in note for note in notes(archive))


def test_one_source_is_enough(tmp_path: Path) -> None:
    header = small_header()
    header["sources"] = header["sources"][:1]
    assert len(open_archive(write_small(tmp_path / "a.zarr", header=header)).header.sources) == 1


def test_all_zero_frames_are_stored(tmp_path: Path) -> None:
    path = write_archive(
        tmp_path / "a.zarr", small_header(), small_time(32), np.zeros((32, 48, 30), "u2"), chunk_frames=16
    )
    assert not contents(open_archive(path)).any()
    assert sorted(p.name for p in (path / "frames" / "c").iterdir()) == ["0", "1"]


@pytest.mark.parametrize(
    "layout",
    [
        {"compressors": None},
        {"compressors": [Crc32cCodec()]},
        {"compressors": [GzipCodec(level=1)]},
        {"compressors": [ZstdCodec(level=1)]},
        {"compressors": [ZstdCodec(level=1, checksum=True), Crc32cCodec()]},
        {"compressors": [Crc32cCodec(), ZstdCodec(level=1)]},
        {"compressors": [BloscCodec(cname="zlib", shuffle="bitshuffle")]},
        {"compressors": [BloscCodec(cname="blosclz", shuffle="noshuffle"), GzipCodec(), Crc32cCodec()]},
        {"filters": [TransposeCodec(order=(2, 0, 1))], "compressors": [BloscCodec(), Crc32cCodec()]},
        {"filters": [TransposeCodec(order=(2, 0, 1)), TransposeCodec(order=(0, 2, 1))]},
        {"serializer": BytesCodec(endian="big"), "compressors": [ZstdCodec()]},
        {"chunks": (16, 20, 17)},
        {"chunks": (64, 64, 64)},
        {"chunk_key_encoding": {"name": "v2", "separator": "."}},
        {"chunk_key_encoding": {"name": "v2", "separator": "/"}},
        {"chunk_key_encoding": {"name": "default", "separator": "."}},
        {"chunks": (8, 48, 30), "shards": (24, 48, 30)},
        {"chunks": (8, 16, 15), "shards": (16, 48, 30), "compressors": [BloscCodec(), Crc32cCodec()]},
        {
            "chunks": (24, 48, 30),
            "compressors": None,
            "serializer": ShardingCodec(
                chunk_shape=(8, 48, 30),
                codecs=[BytesCodec(endian="big"), GzipCodec()],
                index_codecs=[BytesCodec(endian="big")],
                index_location="start",
            ),
        },
    ],
    ids=lambda layout: "-".join(layout),
)
@pytest.mark.parametrize("zipped", [False, True], ids=["folder", "zip"])
def test_every_layout_that_the_format_allows_is_read(tmp_path: Path, layout: dict[str, Any], zipped: bool) -> None:
    frames = small_frames(small_header(), 40)
    path = write_small(tmp_path / "a.zarr")
    shutil.rmtree(path / "frames")
    array = zarr.open_group(path, mode="r+").create_array(
        "frames",
        shape=frames.shape,
        dtype=frames.dtype,
        dimension_names=("time", "row", "col"),
        config={"write_empty_chunks": True},
        **{"chunks": (16, 48, 30), **layout},
    )
    array[...] = frames
    if zipped:
        path = pack(path, tmp_path / "a.zip")
    archive = open_archive(path)
    read = contents(archive)
    np.testing.assert_array_equal(read, frames)
    assert read.dtype == np.dtype("uint16")
    chunk = archive.read_chunk(archive.n_chunks - 1)
    assert chunk.flags.c_contiguous
    assert chunk.flags.writeable
    assert len(archive.identity) == 64
    for keep in (1, 2):
        held: list[tuple[int, np.ndarray]] = []
        for found in archive.chunks(3, 38, keep=keep):
            held = [*held, found][-keep:]
            for first, block in held:
                np.testing.assert_array_equal(block, frames[first : first + len(block)])
                assert block.flags.c_contiguous
                assert block.flags.writeable


def test_an_infinite_path_is_read(tmp_path: Path) -> None:
    header = small_header(path__length="inf m")
    for source, y in zip(header["sources"], ("-7 arcsec", "7 arcsec"), strict=True):
        source["position"], source["fwhm"] = ["0 rad", y], ["1 urad", "1 urad"]
    assert math.isinf(open_archive(write_small(tmp_path / "a.zarr", header=header)).header.path.length)


def test_unknown_keys_are_kept(tmp_path: Path) -> None:
    header = small_header(observer={"mood": ["fine", 3]})
    assert open_archive(write_small(tmp_path / "a.zarr", header=header)).attributes["observer"] == {"mood": ["fine", 3]}


def test_ranges_of_frames(small: Path) -> None:
    archive, frames = open_archive(small), small_frames(small_header(), 40)
    got = list(archive.chunks(10, 35))
    assert [(first, len(block)) for first, block in got] == [(10, 6), (16, 16), (32, 3)]
    np.testing.assert_array_equal(np.concatenate([block for _, block in got]), frames[10:35])
    assert list(archive.chunks(40)) == []
    assert list(archive.chunks(7, 7)) == []
    with pytest.raises(IndexError):
        archive.read_chunk(3)
    with pytest.raises(IndexError):
        archive.read_chunk(-1)


def test_memory_is_used_again_where_that_is_asked_for(small: Path) -> None:
    archive = open_archive(small)
    places = [block.ctypes.data for _, block in archive.chunks(0, 40, keep=2)]
    assert places[2] == places[0] != places[1]
    own = [block for _, block in archive.chunks(0, 40)]
    assert len({block.ctypes.data for block in own}) == 3


def test_gaps_are_found_and_told(tmp_path: Path) -> None:
    time = small_time(40)
    time[10:] += 30_000_000  # three frames of 10 ms are dropped after frame 9
    time[20:] += 4_000_000  # jitter: less than half a frame
    path = write_archive(tmp_path / "a.zarr", small_header(), time, small_frames(small_header(), 40))
    archive = open_archive(path)
    assert archive.gaps.tolist() == [[9, 3]]
    assert describe(archive)["frames_missing"] == 3
    assert any("3 frames were dropped" in note for note in notes(archive))


def test_description_is_json_with_units(small: Path) -> None:
    described = json.loads(json.dumps(describe(open_archive(small)), allow_nan=False))
    assert described["frames"] == 40
    assert described["start"] == "2012-09-14T12:15:00.000000Z"
    assert described["duration"] == "0.39 s"
    assert described["frame_rate"] == "100 Hz"
    assert described["bytes_raw"] == 40 * 48 * 30 * 2
    assert described["codecs"] == ["bytes", "blosc", "crc32c"]
    assert described["notes"] == []


def test_threads_and_pickles_read_the_same(tmp_path: Path) -> None:
    for name in ("a.zarr", "a.zarr.zip"):
        archive = pickle.loads(pickle.dumps(open_archive(write_small(tmp_path / name, n_frames=200))))
        expected = small_frames(small_header(), 200)
        with ThreadPoolExecutor(4) as pool:
            chunks = list(pool.map(archive.read_chunk, list(range(archive.n_chunks)) * 3))
        np.testing.assert_array_equal(np.concatenate(chunks[: archive.n_chunks]), expected)
        np.testing.assert_array_equal(np.concatenate(chunks[-archive.n_chunks :]), expected)


def test_the_sample_opens(shared_sample: Path) -> None:
    archive = open_archive(shared_sample)
    assert (archive.n_frames, archive.frame_shape, archive.n_chunks) == (2800, (160, 160), 6)
    assert archive.header.geometry().n_subapertures == 20
    assert archive.read_chunk(5).shape == (300, 160, 160)


# --- identity ----------------------------------------------------------------------------------------------


def test_identity_is_of_the_content(tmp_path: Path) -> None:
    folder = write_small(tmp_path / "a.zarr")
    identity = open_archive(folder).identity
    assert open_archive(pack(folder, tmp_path / "b.zip")).identity == identity
    assert open_archive(write_small(tmp_path / "elsewhere" / "c.zarr.zip")).identity == identity
    assert pickle.loads(pickle.dumps(open_archive(folder))).identity == identity
    others = [
        write_small(tmp_path / "seed.zarr", seed=1),
        write_small(tmp_path / "header.zarr", header=small_header(comment="x")),
        write_small(tmp_path / "plain.zarr", calibrated=False),
        write_small(tmp_path / "chunks.zarr", chunk_frames=8),
    ]
    last = small_frames(small_header(), 40)
    last[-1, 5, 5] += 1
    bad = np.zeros((48, 30), bool)
    bad[0, 0] = True
    calibration = {"dark": np.full((48, 30), 100, "f4"), "flat": np.ones((48, 30), "f4"), "bad_pixel": bad}
    others.append(
        write_archive(tmp_path / "last.zarr", small_header(), small_time(40), last, chunk_frames=16, **calibration)
    )
    others.append(
        write_archive(
            tmp_path / "later.zarr",
            small_header(),
            small_time(40) + 1,
            small_frames(small_header(), 40),
            chunk_frames=16,
            **calibration,
        )
    )
    identities = {open_archive(path).identity for path in others}
    assert len(identities | {identity}) == len(others) + 1


# --- writing -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lengths", [[40], [1] * 40, [15, 1, 0, 17, 7], [39, 1]])
def test_blocks_of_any_length_give_the_same_archive(tmp_path: Path, small: Path, lengths: list[int]) -> None:
    frames = small_frames(small_header(), 40)
    blocks = iter(np.split(frames, np.cumsum(lengths)[:-1]))
    path = write_archive(tmp_path / "b.zarr", small_header(), small_time(40), blocks, chunk_frames=16)
    for chunk in ("frames/c/0/0/0", "frames/c/2/0/0", "frames/zarr.json", "time/c/0"):
        assert (path / chunk).read_bytes() == (small / chunk).read_bytes()


def test_writing_holds_one_chunk_at_a_time(tmp_path: Path) -> None:
    def blocks() -> Iterator[np.ndarray]:
        for _ in range(60):
            yield np.zeros((32, 48, 30), "u2")  # 92 kB

    tracemalloc.start()
    write_archive(tmp_path / "warm.zarr", small_header(), small_time(64), np.zeros((64, 48, 30), "u2"), chunk_frames=32)
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    write_archive(tmp_path / "a.zarr", small_header(), small_time(1920), blocks(), chunk_frames=32)
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    assert peak < 1_500_000  # of 5.5 MB in all


@pytest.mark.parametrize("name", ["a.zarr", "a.zip"])
def test_what_exists_is_only_replaced_when_told(tmp_path: Path, name: str) -> None:
    path = write_small(tmp_path / name)
    before = open_archive(path).identity
    with pytest.raises(FileExistsError, match="overwritten"):
        write_small(path, seed=1)
    assert open_archive(path).identity == before
    write_small(path, seed=1, overwrite=True)
    assert open_archive(path).identity != before
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["a.zarr", "a.zip"])
@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        ([np.zeros((30, 48, 30), "u2")], "30 frames but 40 times"),
        ([np.zeros((30, 48, 30), "u2")] * 2, "more frames than the 40 times"),
        ([np.zeros((30, 48, 30), "u2"), np.zeros((10, 48, 31), "u2")], "frames from 30 on"),
        ([np.zeros((30, 48, 30), "u2"), np.zeros((10, 48, 30), "i2")], "frames from 30 on"),
    ],
)
def test_a_failed_write_leaves_nothing(tmp_path: Path, name: str, blocks: list[np.ndarray], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_archive(tmp_path / name, small_header(), small_time(40), iter(blocks), chunk_frames=16)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_overwrite_keeps_what_was_there(small: Path) -> None:
    before = open_archive(small).identity
    with pytest.raises(ValueError, match="30 frames"):
        write_archive(small, small_header(), small_time(40), np.zeros((30, 48, 30), "u2"), overwrite=True)
    assert open_archive(small).identity == before


def test_everything_wrong_is_said_before_anything_is_written(tmp_path: Path) -> None:
    header = small_header(instrument__wavelength="3.8 s", instrument__lenslet_pitch=[16, 11], path__length=2670)
    with pytest.raises(ArchiveError) as caught:
        write_archive(
            tmp_path / "a.zarr",
            header,
            small_time(40, rate=50),
            np.zeros((40, 48, 30), "u2"),
            dark=np.zeros((4, 4), "f4"),
        )
    text = str(caught.value)
    for part in ("instrument.wavelength", "lenslet_pitch", "path.length", "frame_rate", "dark"):
        assert part in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [{"codec": "lzma"}, {"chunk_frames": 0}])
def test_impossible_options_are_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        write_small(tmp_path / "a.zarr", **options)
    assert list(tmp_path.iterdir()) == []


# --- faults ------------------------------------------------------------------------------------------------


def header_fault(where: str, value: Any) -> Callable[[Path], None]:
    return lambda path: edit_header(path, lambda attributes: put(attributes, where, value))


def array_fault(name: str, where: str, value: Any) -> Callable[[Path], None]:
    return lambda path: edit(path, f"{name}/zarr.json", lambda document: put(document, where, value))


def removed(*keys: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        for key in keys:
            (path / key).unlink()

    return change


def without(where: str) -> Callable[[Path], None]:
    def change(attributes: dict[str, Any]) -> None:
        *parents, leaf = where.split(".")
        for parent in parents:
            attributes = attributes[parent]
        del attributes[leaf]

    return lambda path: edit_header(path, change)


def written(key: str, data: bytes) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        (path / key).write_bytes(data)

    return change


def rewritten(old: str, new: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        text = (path / "zarr.json").read_text()
        assert old in text
        (path / "zarr.json").write_text(text.replace(old, new))

    return change


def as_format_2(path: Path) -> None:
    (path / "zarr.json").unlink()
    (path / ".zgroup").write_text('{"zarr_format": 2}')


def with_time(time: np.ndarray) -> Callable[[Path], None]:
    return lambda path: replace_array(path, "time", time, ("time",))


FAULTS: dict[str, tuple[Callable[[Path], None], list[str]]] = {
    "wrong unit": (
        header_fault("instrument.wavelength", "3.8 s"),
        ["instrument.wavelength = '3.8 s'", "duration", "length", "2670 m"],
    ),
    "no unit": (header_fault("path.length", 2670), ["path.length = 2670", "unit is missing", "'2670 m'"]),
    "missing key": (without("instrument.pixel_scale"), ["instrument.pixel_scale is missing"]),
    "no format": (without("format"), ["no raw frame archive", "format is missing", "shwfs-frames"]),
    "other format": (header_fault("format", "pictures"), ["format = 'pictures'", "shwfs-frames"]),
    "other version": (header_fault("format_version", 2), ["format_version = 2", "reads format 1"]),
    "bad version": (header_fault("format_version", True), ["format_version = True"]),
    "campaign climbs": (header_fault("campaign", "../../etc"), ["campaign = '../../etc'", "letters, digits"]),
    "archive with space": (header_fault("archive", "a b"), ["archive = 'a b'"]),
    "archive too long": (header_fault("archive", "a" * 101), ["archive = 'aaa"]),
    "archive hides a line": (header_fault("archive", "a\n"), ["archive = 'a\\n'"]),
    "long text": (header_fault("site.name", "x" * 1001), ["site.name", "1001", "1000"]),
    "three sources": (
        lambda path: edit_header(path, lambda a: a["sources"].append({**a["sources"][0], "name": "third"})),
        ["3 sources", "one or two"],
    ),
    "no source": (header_fault("sources", []), ["0 sources"]),
    "ragged mask": (header_fault("instrument.subaperture_mask", [[1, 1], [1]]), ["subaperture_mask", "rectangle"]),
    "boxes outside": (
        header_fault("instrument.lenslet_pitch", [16, 11]),
        ["lenslet_pitch = [16, 11]", "48 x 30", "lenslet (0, 2)"],
    ),
    "spot outside": (header_fault("sources.1.spot", [16.0, 4.5]), ["sources[1].spot", "outside", "16 x 10"]),
    "no frames": (removed("frames/zarr.json"), ["frames is missing", "frames/zarr.json"]),
    "no time": (removed("time/zarr.json"), ["time is missing"]),
    "frames type": (array_fault("frames", "data_type", "float64"), ["frames.data_type = 'float64'", "uint16"]),
    "object type": (array_fault("frames", "data_type", {"name": "pickle"}), ["frames.data_type"]),
    "frames dimensions": (array_fault("frames", "shape", [40, 1440]), ["frames.shape = [40, 1440]", "time, row, col"]),
    "frames names": (
        array_fault("frames", "dimension_names", ["t", "y", "x"]),
        ["frames.dimension_names = ['t', 'y', 'x']", "['time', 'row', 'col']"],
    ),
    "no names": (array_fault("frames", "dimension_names", None), ["frames.dimension_names = None"]),
    "frame too large": (array_fault("frames", "shape", [40, 5000, 30]), ["frames.shape", "4096 x 4096"]),
    "chunk too large": (
        array_fault("frames", "chunk_grid.configuration.chunk_shape", [100_000, 48, 30]),
        ["frames.chunk_grid = [100000, 48, 30]", "275 MiB", "at most 256 MiB"],
    ),
    "zero chunk": (array_fault("frames", "chunk_grid.configuration.chunk_shape", [0, 48, 30]), ["frames.chunk_grid"]),
    "negative size": (array_fault("frames", "shape", [-1, 48, 30]), ["frames.shape = [-1, 48, 30]"]),
    "codec of code": (
        array_fault("frames", "codecs.1", {"name": "numcodecs.pickle", "configuration": {}}),
        ["frames.codecs[1]", "numcodecs.pickle", "allowed: bytes, transpose, blosc, zstd, gzip, crc32c, sharding"],
    ),
    "codecs in disorder": (
        array_fault("frames", "codecs", ["crc32c", {"name": "bytes", "configuration": {"endian": "little"}}]),
        ["frames.codecs[0]"],
    ),
    "no codecs": (array_fault("frames", "codecs", []), ["frames.codecs = []"]),
    "irregular grid": (array_fault("frames", "chunk_grid.name", "rectilinear"), ["frames.chunk_grid"]),
    "key encoding": (array_fault("frames", "chunk_key_encoding.name", "hash"), ["frames.chunk_key_encoding"]),
    "transformers": (array_fault("frames", "storage_transformers", [{"name": "x"}]), ["frames.storage_transformers"]),
    "extension": (array_fault("frames", "lens", {"name": "x"}), ["frames.lens"]),
    "a group for an array": (array_fault("dark", "node_type", "group"), ["dark.node_type = 'group'"]),
    "fewer times": (with_time(small_time(39)), ["time.shape = [39]", "must be [40]"]),
    "time type": (with_time(small_time(40).astype("f8")), ["time.data_type = 'float64'", "int64"]),
    "time stands": (
        with_time(np.where(np.arange(40) == 7, small_time(40)[6], small_time(40))),
        [f"time[7] = {START + 60_000_000}", "time[6]", "strictly"],
    ),
    "time backwards": (with_time(small_time(40)[::-1].copy()), ["time[1]", "39 such steps"]),
    "frame rate": (
        header_fault("instrument.frame_rate", "102 Hz"),
        ["instrument.frame_rate = '102 Hz'", "10 ms (100 Hz)", "9.80392 ms", "1%"],
    ),
    "missing chunk": (removed("frames/c/1/0/0"), ["1 of 3 chunks", "frames/c/1/0/0", "never zeros", "copy"]),
    "empty chunk": (written("frames/c/1/0/0", b""), ["frames/c/1/0/0"]),
    "missing chunk of dark": (removed("dark/c/0/0"), ["dark: 1 of 1 chunks", "dark/c/0/0"]),
    "missing chunk of time": (removed("time/c/0"), ["time: 1 of 1 chunks"]),
    "damaged chunk of flat": (written("flat/c/0/0", b"x" * 100), ["flat/c/0/0", "damaged", "crc32c"]),
    "dark shape": (
        lambda path: replace_array(path, "dark", np.ones((48, 31), "f4"), ("row", "col")),
        ["dark.shape = [48, 31]", "must be [48, 30]"],
    ),
    "bad pixel type": (
        lambda path: replace_array(path, "bad_pixel", np.ones((48, 30), "u1"), ("row", "col")),
        ["bad_pixel.data_type = 'uint8'", "bool"],
    ),
    "no json": (written("zarr.json", b"{"), ["zarr.json is no valid JSON"]),
    "no text": (written("zarr.json", b"\xff\xfe\x00"), ["zarr.json is no valid JSON"]),
    "a list": (written("zarr.json", b"[1]"), ["zarr.json = [1]", "JSON object"]),
    "huge json": (written("zarr.json", b" " * 5_000_000), ["zarr.json holds 5000000"]),
    "deep json": (written("zarr.json", b"[" * 100_000), ["zarr.json is no valid JSON"]),
    "nested header": (rewritten('"somewhere"', "[" * 500 + "]" * 500), ["zarr.json is no valid JSON", "nested"]),
    "not a number": (rewritten('"43.1285 deg"', "NaN"), ["zarr.json is no valid JSON", "NaN is no finite number"]),
    "not finite": (rewritten("11.1", "1e999"), ["zarr.json is no valid JSON", "1e999 is no finite number"]),
    "twice the same key": (rewritten('"campaign":', '"archive": "x", "campaign":'), ["'archive' appears twice"]),
    "half a character": (header_fault("observer", "\ud800"), ["zarr.json is no valid JSON", "surrogate"]),
    "bad array json": (written("frames/zarr.json", b"nonsense"), ["frames/zarr.json is no valid JSON"]),
    "zarr format 2": (as_format_2, ["format 2", "expected format 3"]),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_each_fault_has_one_clear_message(small: Path, kind: str) -> None:
    spoil, parts = FAULTS[kind]
    spoil(small)
    with pytest.raises(ArchiveError) as caught:
        open_archive(small)
    faults = caught.value.faults
    assert len(faults) == 1, faults
    assert faults[0].startswith(f"{small}: ")
    assert "\n" not in faults[0]
    for part in parts:
        assert part in faults[0]
    assert pickle.loads(pickle.dumps(caught.value)).faults == faults


@pytest.mark.parametrize("kind", ["wrong unit", "missing chunk", "frames type", "no json", "damaged chunk of flat"])
def test_faults_are_the_same_in_a_zip(small: Path, tmp_path: Path, kind: str) -> None:
    spoil, parts = FAULTS[kind]
    spoil(small)
    with pytest.raises(ArchiveError) as caught:
        open_archive(pack(small, tmp_path / "a.zip"))
    assert all(part in str(caught.value) for part in parts)


def test_all_faults_are_said_at_once(small: Path) -> None:
    several = ["wrong unit", "missing key", "archive with space", "boxes outside", "frame rate", "missing chunk"]
    several += ["bad pixel type", "dark shape", "fewer times", "damaged chunk of flat"]
    for kind in several:
        FAULTS[kind][0](small)
    with pytest.raises(ArchiveError) as caught:
        open_archive(small)
    for kind in several:
        if kind == "frame rate":
            continue  # cannot be judged while time has another length than frames
        assert any(all(part in fault for part in FAULTS[kind][1]) for fault in caught.value.faults), kind


def test_places_that_are_no_archive(tmp_path: Path, small: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    text = tmp_path / "notes.zip"
    text.write_text("not a zip")
    cut = tmp_path / "cut.zip"
    whole = pack(small, tmp_path / "whole.zip").read_bytes()
    cut.write_bytes(whole[: len(whole) // 2])
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for url, parts in {
        str(tmp_path / "absent.zarr"): ["no such file or folder"],
        str(empty): ["no raw frame archive", "no zarr.json"],
        str(text): ["no zip file", "copy it again"],
        str(cut): ["no zip file", "cut off"],
        str(pack(small, tmp_path / "c.zip", zipfile.ZIP_DEFLATED)): ["compressed", "stored"],
        str(pack(small, tmp_path / "n.zip", prefix="small.zarr/")): ["root of the zip", "small.zarr/zarr.json"],
        str(small / "frames"): ["no raw frame archive", "'array'"],
        str(pipe): ["neither a folder nor a file"],
        "nosuch://place/a.zarr": ["not read from this kind of URL"],
        "memory://nothing/here.zarr": ["no raw frame archive"],
        "memory://nothing/here.zip": ["no such file"],
    }.items():
        with pytest.raises(ArchiveError) as caught:
            open_archive(url)
        assert len(caught.value.faults) == 1
        assert caught.value.faults[0].startswith(f"{url}: ")
        for part in parts:
            assert part in str(caught.value)


def test_a_pipe_in_the_place_of_a_chunk_does_not_block(small: Path) -> None:
    (small / "frames/c/0/0/0").unlink()
    os.mkfifo(small / "frames/c/0/0/0")
    with pytest.raises(ArchiveError, match="frames/c/0/0/0"):
        open_archive(small)


def test_credentials_of_a_url_are_not_shown() -> None:
    with pytest.raises(ArchiveError) as caught:
        open_archive("http://user:secret@127.0.0.1:1/a.zarr?token=secret")
    assert "secret" not in str(caught.value)


def test_control_characters_of_a_file_do_not_reach_the_terminal(small: Path) -> None:
    edit_header(small, lambda attributes: put(attributes, "campaign", "\x1b[2Jgone"))
    with pytest.raises(ArchiveError) as caught:
        open_archive(small)
    assert "\x1b" not in str(caught.value)


def test_huge_claims_are_refused_without_allocation(small: Path) -> None:
    claims = [
        {"shape": [10**12, 48, 30]},
        {"shape": [10**15, 4096, 4096], "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [1, 1, 1]}}},
        {"shape": [2**60, 48, 30]},
        {"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2**62, 48, 30]}}},
    ]
    original = (small / "frames/zarr.json").read_text()
    times = (small / "time/zarr.json").read_text()
    for claim in claims:
        (small / "frames/zarr.json").write_text(original)
        (small / "time/zarr.json").write_text(times)
        edit(small, "frames/zarr.json", lambda document, claim=claim: document.update(claim))
        if "shape" in claim:
            edit(small, "time/zarr.json", lambda document, claim=claim: document.update(shape=claim["shape"][:1]))
        tracemalloc.start()
        with pytest.raises(ArchiveError):
            open_archive(small)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 10_000_000


# --- damage ------------------------------------------------------------------------------------------------


def test_a_missing_chunk_can_be_set_aside(small: Path, tmp_path: Path) -> None:
    frames = small_frames(small_header(), 40)
    (small / "frames/c/1/0/0").unlink()
    for path in (small, pack(small, tmp_path / "a.zip")):
        archive = open_archive(path, allow_missing=True)
        assert archive.missing_chunks == ("frames/c/1/0/0",)
        np.testing.assert_array_equal(archive.read_chunk(0), frames[:16])
        np.testing.assert_array_equal(archive.read_chunk(2), frames[32:])
        with pytest.raises(ChunkError) as caught:
            archive.read_chunk(1)
        assert (caught.value.chunk, caught.value.reason) == ("frames/c/1/0/0", "missing")
        assert str(path) in str(caught.value)
        assert pickle.loads(pickle.dumps(caught.value)).chunk == "frames/c/1/0/0"
        assert len(archive.identity) == 64
        assert any("missing" in note for note in notes(archive))
    (small / "frames/c/0/0/0").unlink()
    (small / "frames/c/2/0/0").unlink()
    with pytest.raises(ArchiveError, match="3 of 3 chunks"):
        open_archive(small, allow_missing=True)


def test_a_chunk_that_vanishes_later_is_one_error(small: Path) -> None:
    archive = open_archive(small)
    (small / "frames/c/1/0/0").unlink()
    with pytest.raises(ChunkError, match="frames/c/1/0/0"):
        archive.read_chunk(1)


@pytest.mark.parametrize("codec", ["lz4", "zstd"])
@pytest.mark.parametrize("change", ["cut", "flip", "grow"])
def test_a_changed_chunk_is_one_error(tmp_path: Path, codec: str, change: str) -> None:
    path = write_small(tmp_path / "a.zarr", codec=codec)
    chunk = path / "frames/c/1/0/0"
    data = bytearray(chunk.read_bytes())
    if change == "cut":
        data = data[: len(data) // 2]
    elif change == "flip":
        data[len(data) // 2] ^= 4
    else:
        data += bytes(2**20)
    chunk.write_bytes(data)
    archive = open_archive(path)
    for _ in range(5):
        with pytest.raises(ChunkError) as caught:
            archive.read_chunk(1)
        assert caught.value.chunk == "frames/c/1/0/0"
    archive.read_chunk(0)
    archive.read_chunk(2)


def test_a_flip_inside_a_zip_is_noticed_without_crc32c(small: Path, tmp_path: Path) -> None:
    frames = small_frames(small_header(), 40)
    replace_frames(small, frames, compressors=None)
    path = pack(small, tmp_path / "a.zip")
    assert notes(open_archive(path)) == []
    assert any("checksum" in note for note in notes(open_archive(small)))
    data = bytearray(path.read_bytes())
    where = data.index(frames[:16].tobytes()[:1000]) + 500
    data[where] ^= 1
    path.write_bytes(data)
    with pytest.raises(ChunkError, match="zip file's checksum"):
        open_archive(path).read_chunk(0)


def replace_frames(path: Path, frames: np.ndarray, **layout: Any) -> None:
    shutil.rmtree(path / "frames")
    array = zarr.open_group(path, mode="r+").create_array(
        "frames",
        shape=frames.shape,
        dtype=frames.dtype,
        dimension_names=("time", "row", "col"),
        config={"write_empty_chunks": True},
        **{"chunks": (16, 48, 30), **layout},
    )
    array[...] = frames


def test_shards_are_looked_into(small: Path) -> None:
    frames = small_frames(small_header(), 40)
    replace_frames(small, frames, chunks=(8, 48, 30), shards=(16, 48, 30))
    shard = small / "frames/c/1/0/0"
    data = bytearray(shard.read_bytes())
    shard.write_bytes(data[:10])
    with pytest.raises(ArchiveError, match="frames/c/1/0/0 is truncated"):
        open_archive(small)
    flipped = bytearray(data)
    flipped[-10] ^= 1
    shard.write_bytes(flipped)
    with pytest.raises(ArchiveError, match="index of the shard is damaged"):
        open_archive(small)
    # An index that marks a chunk as missing, with a right checksum.
    google_crc32c = pytest.importorskip("google_crc32c")
    index = bytearray(data[-36:-4])
    index[:16] = b"\xff" * 16
    shard.write_bytes(data[:-36] + index + struct.pack("<I", google_crc32c.value(bytes(index))))
    with pytest.raises(ArchiveError, match=r"frames/c/1/0/0 \(chunk 2, 0, 0 inside\)"):
        open_archive(small)
    archive = open_archive(small, allow_missing=True)
    with pytest.raises(ChunkError, match="missing"):
        archive.read_chunk(2)
    np.testing.assert_array_equal(archive.read_chunk(3), frames[24:32])
    shard.unlink()
    with pytest.raises(ArchiveError, match="frames/c/1/0/0"):
        open_archive(small)


@pytest.mark.parametrize("compressor", [BloscCodec(), ZstdCodec(), GzipCodec()], ids=["blosc", "zstd", "gzip"])
def test_a_decompression_bomb_is_refused_without_allocation(small: Path, compressor: Any) -> None:
    replace_frames(small, small_frames(small_header(), 40), compressors=[compressor])
    bomb = np.zeros((200_000_000,), "u1")
    if isinstance(compressor, GzipCodec):
        data = gzip.compress(bytes(bomb), 1)
    else:
        store = zarr.storage.MemoryStore()
        array = zarr.create_array(
            store,
            name="b",
            shape=bomb.shape,
            chunks=bomb.shape,
            dtype="u1",
            compressors=[compressor],
            config={"write_empty_chunks": True},
        )
        array[...] = bomb
        data = next(v.to_bytes() for k, v in store._store_dict.items() if k.endswith("c/0"))
    del bomb
    (small / "frames/c/0/0/0").write_bytes(data)
    archive = open_archive(small)
    tracemalloc.start()
    with pytest.raises(ChunkError):
        archive.read_chunk(0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2_000_000


@pytest.mark.parametrize("change", ["cut", "promise less", "promise more", "no block", "no type", "version"])
def test_a_blosc_header_is_checked_before_the_decoder_sees_it(
    small: Path, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_frames(small, small_frames(small_header(), 40), compressors=[BloscCodec()])
    chunk = small / "frames/c/0/0/0"
    data = bytearray(chunk.read_bytes())
    size = 16 * 48 * 30 * 2
    match change:
        case "cut":
            data = data[:-100]
        case "promise less":
            data[4:8] = struct.pack("<I", size - 2)
        case "promise more":
            data[4:8] = struct.pack("<I", size + 2)
        case "no block":
            data[8:12] = bytes(4)
        case "no type":
            data[3] = 0
        case "version":
            data[0] = 77
    chunk.write_bytes(data)
    archive = open_archive(small)

    def decompress(*args: Any) -> None:
        raise AssertionError("the decoder was called")

    monkeypatch.setattr("numcodecs.blosc.decompress", decompress)
    with pytest.raises(ChunkError, match="blosc header"):
        archive.read_chunk(0)


@pytest.mark.parametrize("checksum", [True, False], ids=["crc32c", "bare"])
@pytest.mark.parametrize("cname", ["lz4", "zstd", "blosclz"])
def test_damaged_blosc_chunks_never_crash_the_process(small: Path, cname: str, checksum: bool) -> None:
    # Truncated, flipped and with a header that was made to fit: in another process, since the fault was a crash.
    codecs: list[Any] = [BloscCodec(cname=cname, shuffle="shuffle")]
    replace_frames(
        small, small_frames(small_header(), 40), compressors=[*codecs, Crc32cCodec()] if checksum else codecs
    )
    script = textwrap.dedent("""
        import struct, sys
        from pathlib import Path
        import numpy as np
        from coslidar.catalog.archive import ChunkError, open_archive

        root, checksum = Path(sys.argv[1]), sys.argv[2] == "True"
        chunk = root / "frames/c/1/0/0"
        archive, whole = open_archive(root), chunk.read_bytes()
        good = archive.read_chunk(1)
        random = np.random.default_rng(0)
        wrong = 0
        for trial in range(200):
            data = bytearray(whole)
            if trial % 4 == 0:
                data = data[: int(random.integers(1, len(data)))]
            elif trial % 4 == 1:
                data[int(random.integers(0, len(data)))] ^= 1 << int(random.integers(0, 8))
            elif trial % 4 == 2:
                data = data[: int(random.integers(20, len(data)))]
                data[12:16] = struct.pack("<I", len(data))
            else:
                data[16:64] = random.integers(0, 256, 48, dtype=np.uint8).tobytes()
            chunk.write_bytes(data)
            archive = open_archive(root)
            try:
                got = archive.read_chunk(1)
            except ChunkError:
                continue
            assert got.shape == good.shape
            wrong += not np.array_equal(got, good)
        assert not (checksum and wrong), wrong
        sys.stdout.write("finished")
    """)
    done = subprocess.run(
        [sys.executable, "-c", script, str(small), str(checksum)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, "finished"), done.stderr


# --- URLs --------------------------------------------------------------------------------------------------


def test_memory_urls(small: Path, tmp_path: Path) -> None:
    memory = fsspec.filesystem("memory")
    local = open_archive(small)
    try:
        memory.put(str(small), "/bucket/small.zarr", recursive=True)
        memory.put(str(pack(small, tmp_path / "a.zip")), "/bucket/small.zip")
        for url in ("memory://bucket/small.zarr", "memory://bucket/small.zarr/", "memory://bucket/small.zip"):
            archive = pickle.loads(pickle.dumps(open_archive(url)))
            assert archive.identity == local.identity
            np.testing.assert_array_equal(contents(archive), contents(local))
        memory.rm("/bucket/small.zarr/frames/c/2/0/0")
        with pytest.raises(ArchiveError, match=r"memory://bucket/small\.zarr: frames: 1 of 3 chunks"):
            open_archive("memory://bucket/small.zarr")
        archive = open_archive("memory://bucket/small.zarr", allow_missing=True)
        memory.rm("/bucket/small.zarr/frames/c/1/0/0")
        with pytest.raises(ChunkError, match="missing since"):
            archive.read_chunk(1)
    finally:
        memory.rm("/bucket", recursive=True)


def test_file_urls(small: Path) -> None:
    assert open_archive(f"file://{small}").identity == open_archive(small).identity


def test_http_urls(small: Path, served: tuple[Path, str, str]) -> None:
    pytest.importorskip("aiohttp")
    root, plain, ranges = served
    local = open_archive(small)
    shutil.copytree(small, root / "small.zarr", dirs_exist_ok=True)
    pack(small, root / "small.zip")
    for url in (f"{plain}/small.zarr", f"{ranges}/small.zarr/", f"{ranges}/small.zip"):
        archive = open_archive(url)
        assert archive.identity == local.identity
        with ThreadPoolExecutor(3) as pool:
            got = np.concatenate(list(pool.map(archive.read_chunk, range(3))))
        np.testing.assert_array_equal(got, contents(local))
    with pytest.raises(ArchiveError, match="support byte ranges: download it"):
        open_archive(f"{plain}/small.zip")
    (root / "small.zarr/frames/c/1/0/0").unlink()
    with pytest.raises(ArchiveError, match="frames/c/1/0/0"):
        open_archive(f"{plain}/small.zarr")
    with pytest.raises(ArchiveError, match="no raw frame archive"):
        open_archive(f"{plain}/absent.zarr")
    with pytest.raises(ArchiveError, match="no such file"):
        open_archive(f"{ranges}/absent.zip")
    with pytest.raises(ArchiveError, match="does not answer"):
        open_archive("http://127.0.0.1:9/a.zarr")


@pytest.mark.parametrize(
    "url",
    [
        "reference::file:///tmp/references.json",
        "simplecache::http://127.0.0.1:9/a.zarr",
        "jupyter://127.0.0.1:9/a.zarr",
        "dask://a.zarr",
        "python://os/system",
    ],
)
def test_urls_that_are_more_than_a_place_are_refused(url: str) -> None:
    with pytest.raises(ArchiveError, match=r"not read from this kind of URL; write one of http://, https://, s3://"):
        open_archive(url)


@pytest.mark.parametrize(
    ("url", "package", "modules"),
    [
        ("https://127.0.0.1:9/a.zarr", r"coslidar\[http\]", ("aiohttp", "fsspec.implementations.http")),
        ("s3://bucket/a.zarr", r"coslidar\[s3\]", ("s3fs",)),
        ("gs://bucket/a.zarr", "gcsfs", ("gcsfs",)),
        ("az://bucket/a.zarr", "adlfs", ("adlfs",)),
    ],
)
def test_what_to_install_for_a_kind_of_url(
    url: str, package: str, modules: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, url.partition(":")[0], raising=False)
    with pytest.raises(ArchiveError, match=rf"is not installed: pip install '{package}', on every worker too"):
        open_archive(url)


@pytest.mark.parametrize(("status", "transient"), [(403, False), (400, False), (429, True), (503, True)])
def test_a_server_that_may_be_back_soon_is_told_from_one_that_refuses(
    small: Path, monkeypatch: pytest.MonkeyPatch, status: int, transient: bool
) -> None:
    class Answer(Exception):
        """As of an HTTP client."""

    error = Answer(f"{status} from the server")
    error.status = status  # type: ignore[attr-defined]

    def info(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(type(fsspec.filesystem("memory")), "info", info)
    with pytest.raises(ArchiveError, match="does not answer as it should") as caught:
        open_archive("memory://bucket/small.zarr")
    assert pickle.loads(pickle.dumps(caught.value)).transient is transient


def test_a_failed_replacement_puts_back_what_was_there(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = open_archive(small).identity

    def replace(*args: Any) -> None:
        raise OSError("disk is full")

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(OSError, match="disk is full"):
        write_small(small, seed=1, overwrite=True)
    assert open_archive(small).identity == before
    assert [p.name for p in small.parent.iterdir()] == [small.name]
