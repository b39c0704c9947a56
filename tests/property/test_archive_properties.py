"""Whatever an archive holds, opening gives an archive or an ArchiveError, and reading gives frames or a ChunkError."""

from __future__ import annotations

import copy
import json
import shutil
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from archives import small_frames, small_header, small_time, write_small
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coslidar.catalog.archive import Archive, ArchiveError, ChunkError, describe, open_archive
from coslidar.catalog.archive_writer import write_archive

QUICK = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
FEW = settings(QUICK, max_examples=30)

#: What a header may be spoiled with: any JSON, and values that are nearly right.
NEARLY = st.sampled_from(
    [
        *("3.8 um", "8,9 cm", "nan m", "inf m", "-1 m", "0 Hz", "1e999 m", "142", "m", "1 m m"),
        *("", " ", "../x", "\x00", "é", "x" * 1001),
        *(0, -1, 1, 2**63, 10**30, 1e308, True, None, [], {}, [[]], [0, 0], [1, 2, 3], ["0 m", "0 m"]),
    ]
)
ANY = NEARLY | st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path] if path else []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        found += places(item, (*path, key))
    return found


def spoiled(data: st.DataObject, document: dict[str, Any]) -> dict[str, Any]:
    """A document with one to three places replaced, removed or doubled."""
    document = copy.deepcopy(document)
    for _ in range(data.draw(st.integers(1, 3))):
        here = places(document)
        if not here:
            break
        *parents, leaf = data.draw(st.sampled_from(here))
        parent: Any = document
        for key in parents:
            parent = parent[key]
        match data.draw(st.sampled_from(["replace", "remove", "double"])):
            case "replace":
                parent[leaf] = copy.deepcopy(data.draw(ANY))
            case "remove":
                del parent[leaf]
            case "double" if isinstance(parent, list):
                parent.append(copy.deepcopy(parent[leaf]))
            case _:
                parent[f"{leaf}x"] = copy.deepcopy(parent[leaf])
    return document


def check(path: Path) -> Archive | None:
    """Open, describe and read; only the two errors of an archive may come out."""
    refused: list[str] | None = None
    try:
        archive = open_archive(path)
    except ArchiveError as error:
        refused = error.faults
    if refused is not None:
        assert refused
        assert all(fault.startswith(f"{path}: ") and fault.isprintable() for fault in refused)
        return None
    json.dumps(describe(archive), allow_nan=False)
    archive.header.geometry()
    with suppress(ChunkError):
        assert sum(len(frames) for _, frames in archive.chunks()) == archive.n_frames
    return archive


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small(tmp_path_factory.mktemp("original") / "a.zarr")


@QUICK
@given(data=st.data())
def test_any_header_is_an_archive_or_an_archive_error(original: Path, tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "a.zarr"
    if not path.exists():
        shutil.copytree(original, path)
    document = json.loads((original / "zarr.json").read_text())
    document["attributes"] = spoiled(data, document["attributes"])
    (path / "zarr.json").write_text(json.dumps(document))
    archive = check(path)
    if archive is not None:
        assert archive.attributes == json.loads(json.dumps(document))["attributes"]


@QUICK
@given(data=st.data(), name=st.sampled_from(["frames", "time", "dark", "bad_pixel", ""]))
def test_any_metadata_is_an_archive_or_an_archive_error(
    original: Path, tmp_path: Path, data: st.DataObject, name: str
) -> None:
    path = tmp_path / "a.zarr"
    if not path.exists():
        shutil.copytree(original, path)
    file = path / name / "zarr.json"
    good = file.read_text()
    file.write_text(json.dumps(spoiled(data, json.loads(good))))
    check(path)
    file.write_text(good)


@QUICK
@given(data=st.data())
def test_any_change_of_a_zip_is_noticed_or_harmless(original: Path, tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(original.rglob("*")):
            if file.is_file():
                archive.write(file, str(file.relative_to(original)))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        # The directory at the end decides what is found: change it more often than its length would have it.
        content[-data.draw(st.integers(1, 1200))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.none() | st.integers(0, len(content)))])
    opened = check(path)
    if opened is not None:
        assert opened.attributes == json.loads((original / "zarr.json").read_text())["attributes"]


@QUICK
@given(data=st.data())
def test_any_change_of_a_chunk_is_an_error(original: Path, tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "a.zarr"
    if not path.exists():
        shutil.copytree(original, path)
    chunk = path / "frames/c/1/0/0"
    whole = (original / "frames/c/1/0/0").read_bytes()
    content = bytearray(whole)
    if data.draw(st.booleans()):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    else:
        del content[data.draw(st.integers(1, len(content) - 1)) :]
    chunk.write_bytes(content)
    with pytest.raises(ChunkError):
        open_archive(path).read_chunk(1)


@FEW
@given(
    n_frames=st.integers(2, 60),
    chunk_frames=st.integers(1, 70),
    dtype=st.sampled_from(["uint8", "uint16", "int16", "float32"]),
    zipped=st.booleans(),
    data=st.data(),
)
def test_frames_come_back_whatever_the_chunks_and_blocks(
    tmp_path: Path, n_frames: int, chunk_frames: int, dtype: str, zipped: bool, data: st.DataObject
) -> None:
    header = small_header()
    frames = small_frames(header, n_frames, dtype=dtype)
    cuts = sorted(data.draw(st.lists(st.integers(0, n_frames), max_size=4)))
    path = write_archive(
        tmp_path / ("a.zip" if zipped else "a.zarr"),
        header,
        small_time(n_frames),
        iter(np.split(frames, cuts)),
        chunk_frames=chunk_frames,
        overwrite=True,
    )
    archive = open_archive(path)
    start = data.draw(st.integers(0, n_frames))
    stop = data.draw(st.integers(start, n_frames))
    position = start
    for first, block in archive.chunks(start, stop):
        assert first == position
        np.testing.assert_array_equal(block, frames[first : first + len(block)])
        position += len(block)
    assert position == stop
    (path.unlink if zipped else lambda: shutil.rmtree(path))()


@QUICK
@given(
    header=st.dictionaries(st.text(max_size=5) | st.sampled_from(["format", "campaign", "instrument"]), ANY, max_size=5)
)
def test_nothing_is_written_for_a_header_that_is_not_right(tmp_path: Path, header: dict[str, Any]) -> None:
    with pytest.raises(ArchiveError):
        write_archive(tmp_path / "a.zarr", header, small_time(4), np.zeros((4, 48, 30), "u2"))
    assert list(tmp_path.iterdir()) == []
