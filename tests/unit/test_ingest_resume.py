"""Ingests that are killed, and what the next one keeps of their work."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from archives import small_frames, small_header
from click.testing import CliRunner, Result
from numpy.typing import NDArray

from coslidar.catalog import ingest as module
from coslidar.catalog.archive import open_archive
from coslidar.catalog.ingest import IngestError
from coslidar.catalog.ingest_files import NumpyFile
from coslidar.catalog.ingest_resume import Partial, partial_folder
from coslidar.flows.cli import cli

N, CHUNK = 20, 4
#: Three frames, so that blocks and chunks end in different places.
BLOCK = 3 * 48 * 30 * 2


@pytest.fixture
def frames() -> NDArray[np.uint16]:
    shot = small_frames(small_header(), N)
    shot[12:16] = 0  # a chunk that holds nothing but the fill value is a chunk all the same
    return shot


@pytest.fixture
def source(tmp_path: Path, frames: NDArray[Any]) -> Path:
    np.save(tmp_path / "a.npy", frames)
    np.save(tmp_path / "wide.npy", frames.astype(np.float64))
    write_header(tmp_path)
    return tmp_path / "a.npy"


def write_header(folder: Path, **instrument: Any) -> None:
    header = small_header()
    header["instrument"] |= instrument
    ingest = {"time": {"start": "2012-09-14T12:15:00Z"}}
    (folder / "header.json").write_text(json.dumps({**header, "ingest": ingest}))


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """(file, frames) of everything that is read of the sources."""
    monkeypatch.setattr(module, "BLOCK_BYTES", BLOCK)
    seen: list[tuple[str, int]] = []
    slabs = NumpyFile._slabs

    def counted(self: NumpyFile, time: int | None, parts: list[Any]) -> Iterator[NDArray[Any]]:
        for slab in slabs(self, time, parts):
            seen.append((self.path.name, 1 if time is None else slab.shape[time]))
            yield slab

    monkeypatch.setattr(NumpyFile, "_slabs", counted)
    return seen


def run(output: Path, *sources: Path, options: tuple[str, ...] = ()) -> Result:
    header = sources[0].parent / "header.json"
    return CliRunner().invoke(
        cli,
        ["ingest", *map(str, sources), "--header", str(header), "-o", str(output), "--chunk-frames", "4", *options],
    )


def content(output: Path) -> dict[str, bytes]:
    """Every byte of an archive, by file."""
    if output.is_file():
        return {"": output.read_bytes()}
    return {str(path.relative_to(output)): path.read_bytes() for path in output.rglob("*") if path.is_file()}


def interrupt(output: Path, *sources: Path, after: int) -> Path:
    """Leave what a signal leaves after so many frames; the archive that is half made."""

    def stop(what: str, done: int, total: int) -> None:
        if what == "writing" and done >= after:
            raise KeyboardInterrupt

    plan = module.plan_ingest(list(sources), sources[0].parent / "header.json")
    with pytest.raises(KeyboardInterrupt):
        module.ingest(plan, output, chunk=CHUNK, progress=stop)
    return partial_folder(output) / "archive.zarr"


# Modules are loaded once, and a process is forked for each moment: zarr's thread starts after that.
_KILLED = """
import os, signal, sys, zipfile
from pathlib import Path
from coslidar.catalog import ingest as module
from coslidar.catalog.ingest_resume import Partial

module.BLOCK_BYTES = int(sys.argv[2])
folder = Path(sys.argv[1])
MOMENT = None

def die():
    os.kill(os.getpid(), signal.SIGKILL)

def progress(what, done, total):
    if (MOMENT, what) == ("survey", "reading") and done > total // 2:
        die()
    if MOMENT.startswith("chunks") and what == "writing" and done >= 8:
        die()

create_arrays, complete, writestr = module.create_arrays, Partial.complete, zipfile.ZipFile.writestr

def create_and_die(*arguments):
    create_arrays(*arguments)
    die()

def complete_or_die(self, chunk):
    if chunk == 3:
        path = self.archive / "frames" / "c" / "3" / "0" / "0"
        path.write_bytes(path.read_bytes()[:50])
        path.with_suffix(".1f2e.partial").write_bytes(b"half")
        die()
    complete(self, chunk)

def write_or_die(self, info, data):
    if info.filename == "frames/c/1/0/0":
        self.fp.flush()
        die()
    writestr(self, info, data)

def move_and_die(made, target, aside):
    os.rename(target, aside)
    die()

for argument in sys.argv[3:]:
    MOMENT, name, source = argument.split(",")
    child = os.fork()
    if child == 0:
        if MOMENT == "skeleton":
            module.create_arrays = create_and_die
        if MOMENT == "within":
            Partial.complete = complete_or_die
        if MOMENT == "packing":
            zipfile.ZipFile.writestr = write_or_die
        if MOMENT == "renaming":
            module.replace = move_and_die
        plan = module.plan_ingest([folder / source], folder / "header.json")
        module.ingest(plan, folder / MOMENT / name, chunk=4, progress=progress, overwrite=MOMENT == "renaming")
        os._exit(0)
    print(MOMENT, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_what_was_done_before_a_kill_is_neither_read_nor_made_again(
    tmp_path: Path, source: Path, read: list[tuple[str, int]]
) -> None:
    """By SIGKILL at every stage; frames of the input that the next ingest reads are counted where they are read."""
    moments = {
        # moment: (output, source, frames that are still to be read, what is told)
        "survey": ("o.zarr.zip", "wide.npy", 2 * N, ""),
        "skeleton": ("o.zarr.zip", "a.npy", N, "all begins anew"),
        "chunks-zip": ("o.zarr.zip", "a.npy", N - 8, "2 of 5 chunks complete\n"),
        "chunks-folder": ("o.zarr", "a.npy", N - 8, "2 of 5 chunks complete\n"),
        "chunks-surveyed": ("o.zarr", "wide.npy", N - 8, "2 of 5 chunks complete\n"),
        "within": ("o.zarr", "a.npy", N - 12, "3 of 5 chunks complete\n"),
        "packing": ("o.zarr.zip", "a.npy", 0, "5 of 5 chunks complete\n"),
        "renaming": ("o.zarr", "a.npy", 0, "5 of 5 chunks complete\n"),
    }
    expected = {}
    for name, kind in {(name, kind) for name, kind, _, _ in moments.values()}:
        output = tmp_path / f"whole-{kind}" / name
        assert run(output, tmp_path / kind).exit_code == 0
        expected[name, kind] = content(output)
    (tmp_path / "renaming" / "o.zarr").mkdir(parents=True)
    (tmp_path / "renaming" / "o.zarr" / "old").touch()

    arguments = [f"{moment},{name},{kind}" for moment, (name, kind, _, _) in moments.items()]
    done = subprocess.run(
        [sys.executable, "-c", _KILLED, str(tmp_path), str(BLOCK), *arguments],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == [str(word) for moment in moments for word in (moment, -signal.SIGKILL)], done.stderr

    for moment, (name, kind, left, told) in moments.items():
        output = tmp_path / moment / name
        assert not output.exists(), moment
        if moment == "renaming":
            # What was to be replaced comes back, and without --force it stays.
            assert "is not of these sources" in str(run(output, tmp_path / kind).exception)
            assert os.listdir(output) == ["old"]
        read.clear()
        result = run(output, tmp_path / kind, options=("--force",) if moment == "renaming" else ())
        assert result.exit_code == 0, (moment, result.exception)
        assert sum(count for _, count in read) == left, moment
        assert told in result.output, (moment, result.output)
        assert content(output) == expected[name, kind], moment
        assert os.listdir(output.parent) == [name], moment


def test_other_options_need_no_second_look_at_the_pixels(
    tmp_path: Path, source: Path, read: list[tuple[str, int]]
) -> None:
    """The type that holds them is as it was, so that they are read once and not twice."""
    interrupt(tmp_path / "o.zarr", tmp_path / "wide.npy", after=8)
    read.clear()
    assert "begins anew" in run(tmp_path / "o.zarr", tmp_path / "wide.npy", options=("--codec", "zstd")).output
    assert sum(count for _, count in read) == N


def test_the_bytes_of_a_zip_do_not_depend_on_when_it_is_made(
    tmp_path: Path, source: Path, frames: NDArray[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(tmp_path / "a.zarr.zip", source).exit_code == 0
    monkeypatch.setattr(time, "time", lambda: 1.3e9)
    assert run(tmp_path / "b.zarr.zip", source).exit_code == 0
    assert content(tmp_path / "a.zarr.zip") == content(tmp_path / "b.zarr.zip")
    archive = open_archive(tmp_path / "b.zarr.zip")
    np.testing.assert_array_equal(np.concatenate([archive.read_chunk(k) for k in range(5)]), frames)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("touched", "a.npy: changed"),
        ("replaced", "a.npy: changed"),
        ("header", "header, table [ingest], calibration or times: changed"),
        ("codec", "codec: now zstd, lz4 before"),
        ("chunk", "chunk frames: now 5, 4 before"),
        ("dtype", "changed"),
        ("software", "versions: now"),
    ],
)
def test_nothing_is_kept_of_other_sources_or_options(
    tmp_path: Path, source: Path, frames: NDArray[Any], read: list[tuple[str, int]], change: str, told: str
) -> None:
    output, options = tmp_path / "o.zarr", ()
    half = interrupt(output, source, after=12)
    if change == "touched":
        os.utime(source, ns=(0, source.stat().st_mtime_ns + 1))
    elif change == "replaced":
        frames = frames + np.uint16(1)
        np.save(source, frames)
    elif change == "header":
        write_header(tmp_path, frame_rate="101 Hz")
    elif change == "dtype":
        header = json.loads((tmp_path / "header.json").read_text())
        header["ingest"]["dtype"] = "float32"
        (tmp_path / "header.json").write_text(json.dumps(header))
    elif change == "software":
        journal = half.parent / "journal"
        journal.write_text(journal.read_text().replace('"zarr": "', '"zarr": "0.'))
    else:
        options = {"codec": ("--codec", "zstd"), "chunk": ("--chunk-frames", "5")}[change]
    read.clear()
    result = run(output, source, options=options)
    assert result.exit_code == 0, result.exception
    assert "all begins anew" in result.output
    assert told in result.output
    assert sum(count for _, count in read) == N
    assert not half.parent.exists()
    assert run(tmp_path / "whole.zarr", source, options=options).exit_code == 0
    assert content(output) == content(tmp_path / "whole.zarr")


@pytest.mark.parametrize("fault", ["cut", "bit", "gone", "torn line", "other file", "time", "journal"])
def test_what_is_damaged_is_made_again(tmp_path: Path, source: Path, read: list[tuple[str, int]], fault: str) -> None:
    output = tmp_path / "o.zarr"
    half = interrupt(output, source, after=16)
    chunk, journal = half / "frames" / "c" / "1" / "0" / "0", half.parent / "journal"
    left, told = {
        "torn line": (8, "3 of 5 chunks complete\n"),
        "other file": (4, "4 of 5 chunks complete\n"),
        "time": (N, "begins anew"),
        "journal": (N, "begins anew"),
    }.get(fault, (8, "3 of 5 chunks complete; damaged and made again: 1"))
    if fault == "cut":
        chunk.write_bytes(chunk.read_bytes()[:-7])
    elif fault == "bit":
        data = bytearray(chunk.read_bytes())
        data[len(data) // 2] ^= 4
        chunk.write_bytes(data)
    elif fault == "gone":
        chunk.unlink()
    elif fault == "torn line":
        journal.write_text(journal.read_text()[:-9])
    elif fault == "other file":
        (half / "frames" / "c" / "1" / "0" / "0.1f2e.partial").write_bytes(b"half")
    elif fault == "time":
        (half / "time" / "c" / "0").write_bytes(b"")
    else:
        journal.write_bytes(b"\0" * 100)
    read.clear()
    result = run(output, source)
    assert result.exit_code == 0, result.exception
    assert told in result.output
    assert sum(count for _, count in read) == left
    assert run(tmp_path / "whole.zarr", source).exit_code == 0
    assert content(output) == content(tmp_path / "whole.zarr")


def test_files_whose_frames_are_complete_are_not_opened_for_them(
    tmp_path: Path, frames: NDArray[Any], read: list[tuple[str, int]]
) -> None:
    write_header(tmp_path)
    ends = [0, 3, 9, 10, 20]
    sources = [tmp_path / f"{number}.npy" for number in range(4)]
    for path, first, end in zip(sources, ends, ends[1:], strict=False):
        np.save(path, frames[first:end])
    output = tmp_path / "o.zarr"
    half = interrupt(output, *sources, after=16)
    (half / "frames" / "c" / "0" / "0" / "0").unlink()
    read.clear()
    assert run(output, *sources).exit_code == 0
    # Frames 0 to 3, and 16 to 19.
    assert read[:2] == [("0.npy", 3), ("1.npy", 1)]
    assert {name for name, _ in read[2:]} == {"3.npy"}
    assert sum(count for _, count in read[2:]) == 4
    assert run(tmp_path / "whole.zarr", *sources).exit_code == 0
    assert content(output) == content(tmp_path / "whole.zarr")


def test_a_source_that_changes_while_it_is_read_makes_no_archive(tmp_path: Path, source: Path) -> None:
    def touch(what: str, done: int, total: int) -> None:
        os.utime(source, ns=(0, done))

    plan = module.plan_ingest([source], tmp_path / "header.json")
    with pytest.raises(IngestError, match=r"a\.npy: changed while it was read"):
        module.ingest(plan, tmp_path / "o.zarr", progress=touch)
    assert not (tmp_path / "o.zarr").exists()


def test_a_type_that_does_not_fit_leaves_nothing_and_a_read_error_leaves_what_is_complete(
    tmp_path: Path, frames: NDArray[Any], read: list[tuple[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_header(tmp_path)
    source, output = tmp_path / "a.npy", tmp_path / "o.zarr"
    np.save(source, np.where(np.arange(N)[:, None, None] < 15, frames, np.int32(70000)))
    result = run(output, source)
    assert result.exit_code == 0  # float32
    header = json.loads((tmp_path / "header.json").read_text())
    header["ingest"]["dtype"] = "uint16"
    (tmp_path / "header.json").write_text(json.dumps(header))
    assert "are not all exact in uint16" in str(run(tmp_path / "p.zarr", source).exception)
    assert sorted(os.listdir(tmp_path)) == ["a.npy", "header.json", "o.zarr"]

    np.save(source, frames)
    slabs = NumpyFile._slabs

    def unplugged(self: NumpyFile, time: int | None, parts: list[Any]) -> Iterator[NDArray[Any]]:
        for number, slab in enumerate(slabs(self, time, parts)):
            if number == 4:
                raise OSError("the disk does not answer")
            yield slab

    with monkeypatch.context() as patch:
        patch.setattr(NumpyFile, "_slabs", unplugged)
        assert "the disk does not answer" in str(run(tmp_path / "p.zarr", source).exception)
    assert sorted(os.listdir(tmp_path)) == [".p.zarr.partial", "a.npy", "header.json", "o.zarr"]
    read.clear()
    assert run(tmp_path / "p.zarr", source).exit_code == 0
    assert sum(count for _, count in read) == N - 12
    np.testing.assert_array_equal(open_archive(tmp_path / "p.zarr").read_chunk(2), frames[8:12])


def test_runs_of_missing_chunks(tmp_path: Path) -> None:
    partial = Partial(tmp_path, {})
    for number in (0, 3, 4):
        partial._files[f"frames/c/{number}/0/0"] = (1, 1)
    assert partial.missing(8) == [(1, 3), (5, 8)]
    assert partial.missing(1) == []


# From a goal on it is slow, so that it cannot end before a busy machine lets the test kill it.
_COMMAND = """
import sys, time
from coslidar.catalog.ingest_resume import Partial
from coslidar.flows.cli import main
goal, complete = int(sys.argv.pop(1)), Partial.complete

def dawdle(self, chunk):
    complete(self, chunk)
    if chunk >= goal:
        time.sleep(0.2)

Partial.complete = dawdle
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["o.zarr", "o.zarr.zip"])
def test_the_command_is_killed_again_and_again(tmp_path: Path, name: str) -> None:
    """A recording of 370 MB and `kill -9` from outside, each time some chunks later, until it is whole."""
    write_header(tmp_path)
    header = json.loads((tmp_path / "header.json").read_text())
    header["ingest"] |= {"raw_dtype": "<u2", "raw_shape": [48, 30]}
    (tmp_path / "header.json").write_text(json.dumps(header))
    random = np.random.default_rng(1)
    with (tmp_path / "a.raw").open("wb") as file:
        for _ in range(64):
            file.write(random.integers(0, 4096, (2000, 48, 30), np.uint16).tobytes())
    total, n_chunks = 64 * 2000, 500

    def command(output: Path, goal: int = n_chunks) -> list[str]:
        told = ["--header", str(tmp_path / "header.json"), "-o", str(output), "--chunk-frames", str(total // n_chunks)]
        return [sys.executable, "-c", _COMMAND, str(goal), "ingest", str(tmp_path / "a.raw"), *told]

    subprocess.run(command(tmp_path / "whole" / name), check=True, capture_output=True)
    output = tmp_path / "killed" / name
    journal = partial_folder(output) / "journal"
    kept = []
    for goal in (1, 60, 150, 300, 450, n_chunks):
        process = subprocess.Popen(command(output, goal), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        while goal < n_chunks and process.poll() is None:
            if journal.exists() and journal.read_bytes().count(b"frames/c/") >= goal:
                process.kill()
            time.sleep(0.02)
        _, said = process.communicate()
        kept += [int(line.split(" with ")[1].split()[0]) for line in said.splitlines() if "goes on" in line]
        if goal < n_chunks:
            assert process.returncode == -signal.SIGKILL, said
            assert not output.exists()
    assert process.returncode == 0, said
    assert len(kept) == 5
    assert kept == sorted(kept)
    assert kept[-1] >= 450
    assert content(output) == content(tmp_path / "whole" / name)
    assert os.listdir(output.parent) == [name]
