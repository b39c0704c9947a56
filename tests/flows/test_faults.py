"""Bad input among good: one clear message each, and the good is done."""

from __future__ import annotations

import json
import subprocess
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from small_runs import (
    BATCHES,
    FRAMES,
    SETTINGS,
    Finished,
    chunk,
    command,
    environment,
    family,
    products,
    run_arguments,
    unpacked,
    wait_for,
)

from coslidar.catalog import open_catalog
from coslidar.catalog.store import Catalog
from coslidar.flows.run import run
from coslidar.flows.settings import load
from coslidar.pipeline.products import QUALITY_FLAGS

Call = Callable[..., Finished]
FAILED = QUALITY_FLAGS["failed"][0]


def edit_header(archive: Path, change: Callable[[dict], None]) -> Path:
    path = archive / "zarr.json"
    document = json.loads(path.read_text())
    change(document["attributes"])
    path.write_text(json.dumps(document))
    return archive


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)


@pytest.fixture(scope="module")
def bad(recordings: list[str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One archive for each way to be bad, by what is wrong."""
    folder = tmp_path_factory.mktemp("bad")

    def copy(name: str) -> Path:
        (folder / name).mkdir()
        archive = unpacked(recordings[0], folder / name)
        return edit_header(archive, lambda attributes: attributes.update(archive=name))

    found = {name: copy(name) for name in ("key", "unit", "missing", "truncated", "flipped", "hopeless")}
    found["folder"] = folder / "no-archive"
    found["folder"].mkdir()
    (found["folder"] / "notes.txt").write_text("holiday pictures")
    found["absent"] = folder / "absent.zarr.zip"
    edit_header(found["key"], lambda attributes: attributes["instrument"].pop("pixel_scale"))
    edit_header(found["unit"], lambda attributes: attributes["path"].update(length="2670 s"))
    chunk(found["missing"], 1).unlink()
    path = chunk(found["truncated"], 2)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    flip(chunk(found["flipped"], 1))
    for number in range(4):
        flip(chunk(found["hopeless"], number))
    return found


#: What must be said of each: file or chunk, what is wrong, what to do.
SAID = {
    "folder": ["this is no raw frame archive", "name the folder, zip or URL"],
    "absent": ["there is no such file or folder", "check the path"],
    "key": ["instrument.pixel_scale", "missing"],
    "unit": ["path.length = '2670 s'", "'s' is a duration", "'2670 m'"],
    "missing": ["frames/c/1/0/0", "missing", "copy the archive again"],
    "truncated": ["frames/c/2/0/0", "damaged", "copy the archive again"],
    "flipped": ["frames/c/1/0/0", "crc32c", "copy the archive again"],
    "hopeless": ["frames/c/0/0/0", "crc32c", "copy the archive again"],
}


def check_messages(err: str, bad: dict[str, Path]) -> None:
    assert "Traceback" not in err
    lines = err.splitlines()
    assert all(line.startswith("coslidar: ") for line in lines), err
    for name, path in bad.items():
        about = [line for line in lines if str(path) in line and not line.startswith("coslidar: [")]
        assert about, (name, err)
        assert any(all(word in line for word in SAID[name]) for line in about), (name, about)
        # One message for a bad archive, one for each batch that a bad chunk spoils.
        spoiled = {"missing": 2, "truncated": 2, "flipped": 2, "hopeless": BATCHES}.get(name, 1)
        assert len(about) == spoiled, (name, about)
        assert len(set(about)) == len(about)


def check_catalog(out: Path, good: str, bad: dict[str, Path]) -> None:
    with open_catalog(out) as catalog:
        rows = {row.archive: row for row in catalog.products()}
        assert set(rows) == {"r0", "missing", "truncated", "flipped"}
        assert catalog.verify() == []
        failures = catalog.failures(catalog.runs()[-1].id)
        assert {failure.archive for failure in failures} == {str(path) for path in bad.values()}
        for name, path in bad.items():
            mine = [failure for failure in failures if failure.archive == str(path)]
            assert any(all(word in failure.reason for word in SAID[name]) for failure in mine)
        assert catalog.runs()[-1].state == "failed"
        for name, lost in (("missing", [1, 2]), ("truncated", [2, 3]), ("flipped", [1, 2])):
            batches = catalog.batches(archive_name=name)
            assert [batch.number for batch in batches if batch.quality_flag & FAILED] == lost
            assert all(batch.r0 is not None for batch in batches if batch.number not in lost)


@pytest.fixture(scope="module")
def spoiled(
    recordings: list[str], bad: dict[str, Path], tmp_path_factory: pytest.TempPathFactory, cache: Path
) -> tuple[Path, list[object], Finished]:
    """One run over a good archive and all the bad ones."""
    out = tmp_path_factory.mktemp("spoiled") / "out"
    arguments = run_arguments([*map(str, bad.values()), recordings[0]], out)
    done = subprocess.run(
        command(*arguments), capture_output=True, text=True, timeout=240, env=environment(cache), cwd=out.parent
    )
    return out, arguments, Finished(done.returncode, done.stdout, done.stderr, 0)


def test_the_good_is_done_and_the_bad_is_named(
    spoiled: tuple[Path, list[object], Finished], recordings: list[str], bad: dict[str, Path]
) -> None:
    out, _, done = spoiled
    assert done.code == 2, done.err
    check_messages(done.err, bad)
    check_catalog(out, recordings[0], bad)
    assert "4 of 9 archives are in" in done.out


def test_again_it_says_the_same_and_computes_nothing_that_is_there(
    spoiled: tuple[Path, list[object], Finished], coslidar: Call, bad: dict[str, Path]
) -> None:
    out, arguments, _ = spoiled
    before = products(out)
    again = coslidar(*arguments)
    assert again.code == 2
    assert products(out) == before
    # Only the archive of which nothing could be read is tried again.
    assert f"{BATCHES} batches computed, {FRAMES} frames read" in again.err
    for name in ("missing", "truncated", "flipped"):
        assert f"demo/{name}: 2 batches, in the catalog already, 2 of 4 failed" in again.err


def test_what_chunks_spoil_is_missing_in_the_product_and_nothing_else(
    spoiled: tuple[Path, list[object], Finished], recordings: list[str], tmp_path: Path
) -> None:
    out, _, _ = spoiled
    with open_catalog(out) as catalog:
        whole = catalog.open(catalog.find("demo/r0"))
        for name, lost in (("missing", [1, 2]), ("truncated", [2, 3]), ("flipped", [1, 2])):
            part = catalog.open(catalog.find(f"demo/{name}"))
            kept = [number for number in range(BATCHES) if number not in lost]
            assert part["cn2"].isel(time=lost).isnull().all()
            # The same frames, in an archive of another name: the same numbers, to the last bit.
            assert (part["cn2"].values[kept] == whole["cn2"].values[kept]).all()
            assert [int(flag) & FAILED for flag in part["quality_flag"].values[lost]] == [FAILED, FAILED]


def test_all_batches_bad_is_no_product(bad: dict[str, Path], tmp_path: Path) -> None:
    (outcome,) = run(
        load(archives=[str(bad["hopeless"])], output=tmp_path / "out", assignments=SETTINGS), prefect=False
    )
    assert (outcome.status, outcome.failed_batches, outcome.input_fault) == ("failed", BATCHES, True)
    assert len(outcome.faults) == BATCHES
    assert not products(tmp_path / "out")
    # A copy that arrived whole is computed: nothing of the failure is kept, although the identity may be the same.
    with Catalog(tmp_path / "out") as catalog:
        assert not list(catalog.scratch.folder.rglob("*.npz"))


def test_a_mended_chunk_is_read_again(recordings: list[str], tmp_path: Path) -> None:
    archive = unpacked(recordings[0], tmp_path)
    middle = [chunk(archive, number) for number in (1, 2)]
    whole = {path: path.read_bytes() for path in middle}
    for path in middle:
        flip(path)
    settings = load(archives=[str(archive)], output=tmp_path / "out", assignments=[*SETTINGS, "batch.duration=6 s"])
    (outcome,) = run(settings, prefect=False)
    assert outcome.status == "failed"
    for path, content in whole.items():
        path.write_bytes(content)
    (outcome,) = run(settings, prefect=False)
    assert (outcome.status, outcome.failed_batches) == ("published", 0)


def test_too_few_frames_is_said_and_kept(recordings: list[str], tmp_path: Path) -> None:
    settings = load(
        archives=recordings[:1], output=tmp_path / "out", assignments=["batch.duration=0.3 s", "response.slices=6"]
    )
    (outcome,) = run(settings, prefect=False)
    assert (outcome.status, outcome.input_fault) == ("failed", True)
    assert all("43 frames are too few" in fault or "42 frames are too few" in fault for fault in outcome.faults)
    (again,) = run(settings, prefect=False)
    assert (again.status, again.frames_read, again.faults) == ("failed", 0, outcome.faults)


def test_batches_without_end_are_refused(main_here: Call, recordings: list[str], tmp_path: Path) -> None:
    done = main_here("run", recordings[0], "--out", tmp_path / "out", "--no-prefect", "--set", "batch.duration=1 ns")
    assert done.code == 2
    assert "batch.duration = '1e-09 s': shorter than one frame" in done.err


#: Metadata that would run code, or fill memory or time, if anybody believed it: file, change, words of the message.
CRAFTED: dict[str, tuple[str, Callable[[dict], None], str]] = {
    "more frames than there are": ("frames", lambda d: d.update(shape=[2**40, *d["shape"][1:]]), "chunks are missing"),
    "frames of a terapixel": ("frames", lambda d: d.update(shape=[d["shape"][0], 2**20, 2**20]), "at most 4096 x 4096"),
    "one chunk of all": (
        "frames",
        lambda d: d["chunk_grid"]["configuration"].update(chunk_shape=[10**7, *d["shape"][1:]]),
        "at most 256 MiB are allowed",
    ),
    "time without end": ("time", lambda d: d.update(shape=[2**50]), "one time stamp per frame"),
    "objects": ("frames", lambda d: d.update(data_type="object"), "must be uint8 or uint16 or int16 or float32"),
    "pickles": (
        "frames",
        lambda d: d["codecs"].append({"name": "numcodecs.pickle", "configuration": {}}),
        "this codec is not allowed",
    ),
}


def test_crafted_archives_are_refused_before_anything_is_allocated(
    main_here: Call, recordings: list[str], tmp_path: Path
) -> None:
    made = {}
    for name, (array, change, words) in CRAFTED.items():
        (tmp_path / name).mkdir()
        archive = unpacked(recordings[0], tmp_path / name)
        path = archive / array / "zarr.json"
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))
        made[archive] = words
    tracemalloc.start()
    done = main_here(*run_arguments([*map(str, made)], tmp_path / "out"))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert done.code == 2
    for archive, words in made.items():
        assert any(str(archive) in line and words in line for line in done.err.splitlines()), (archive, done.err)
    assert most < 64 * 2**20
    assert not products(tmp_path / "out")


# --- the same through Prefect ------------------------------------------------------------------------------


@pytest.mark.cluster
def test_through_prefect(
    started: Callable[..., subprocess.Popen[str]],
    recordings: list[str],
    bad: dict[str, Path],
    spoiled: tuple[Path, list[object], Finished],
    tmp_path: Path,
) -> None:
    """The same messages, exit code and bytes; nothing of Prefect or Dask said, nothing beyond loopback."""
    out = tmp_path / "out"
    process = started(*run_arguments([*map(str, bad.values()), recordings[0]], out, prefect=True))
    one = psutil.Process(process.pid)
    heard: set[str] = set()
    called: set[str] = set()

    def over() -> bool:
        for each in [one, *family(process.pid)]:
            with suppress(psutil.Error):
                connections = each.net_connections("inet")
                heard.update(c.laddr.ip for c in connections if c.status == psutil.CONN_LISTEN)
                called.update(c.raddr.ip for c in connections if c.raddr)
        return process.poll() is not None

    assert wait_for(over, 240, step=0.05)
    _, err = process.communicate()
    assert process.returncode == 2, err
    check_messages(err, bad)
    check_catalog(out, recordings[0], bad)
    assert products(out) == products(spoiled[0])
    assert heard == {"127.0.0.1"}
    assert called == {"127.0.0.1"}
    assert family(process.pid) == []
    with open_catalog(out) as catalog:
        assert len(catalog.products()) == 4
