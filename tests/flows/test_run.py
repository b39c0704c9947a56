"""Runs in this process: what they publish, what they reuse, and that numbers depend on nothing they should not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_runs import BATCHES, FRAMES, SETTINGS, products

from coslidar.catalog import open_archive, open_catalog, open_product
from coslidar.catalog.archive_writer import write_archive
from coslidar.flows.driver import ArchiveOutcome
from coslidar.flows.plan import plan_archive
from coslidar.flows.run import run
from coslidar.flows.settings import InputError, Settings, load


def settings_for(recordings: Sequence[str | Path], out: Path, *assignments: str) -> Settings:
    return load(archives=[str(path) for path in recordings], output=out, assignments=[*SETTINGS, *assignments])


def run_here(recordings: Sequence[str | Path], out: Path, *assignments: str) -> list[ArchiveOutcome]:
    return run(settings_for(recordings, out, *assignments), prefect=False)


@pytest.fixture(scope="module")
def done(recordings: list[str], tmp_path_factory: pytest.TempPathFactory, cache: Path) -> tuple[Path, Any]:
    """A catalog with a finished run over the three recordings; not to be changed."""
    out = tmp_path_factory.mktemp("done")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSLIDAR_HOME", str(cache))
        return out, run_here(recordings, out)


def test_a_run_publishes_every_archive(done: tuple[Path, Any], recordings: list[str]) -> None:
    out, outcomes = done
    assert [(o.url, o.status, o.batches, o.failed_batches, o.reused, o.frames_read) for o in outcomes] == [
        (url, "published", BATCHES, 0, 0, FRAMES) for url in recordings
    ]
    with open_catalog(out) as catalog:
        rows = catalog.products()
        assert [row.archive for row in rows] == ["r0", "r1", "r2"]
        assert catalog.verify() == []
        assert len(catalog.batches()) == 3 * BATCHES
        assert all(batch.n_frames == FRAMES // BATCHES and np.isfinite(batch.r0) for batch in catalog.batches())
        (made,) = catalog.runs()
        assert (made.state, made.configuration["archives"]) == ("finished", 3)
        assert {row.run for row in rows} == {made.id}
        dataset = catalog.open(rows[0])
    assert dict(dataset.sizes)["time"] == BATCHES
    assert dataset.sizes["z"] == 6
    assert np.isfinite(dataset["cn2"].values).all()
    # Nothing of the scratch store remains once a product is there.
    assert not list((out / "scratch").rglob("*.npz"))


def test_the_second_run_does_nothing(done: tuple[Path, Any], recordings: list[str]) -> None:
    out, _ = done
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file() and "sqlite" not in path.name}
    outcomes = run_here(recordings, out)
    assert [(o.status, o.batches, o.frames_read) for o in outcomes] == [("present", BATCHES, 0)] * 3
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file() and "sqlite" not in path.name}
    assert after == before


@pytest.mark.parametrize(
    "assignment",
    [
        "regulariser=gradient",
        "selector=fixed:mu='1e27 m^(4/3)'",
        "response.sampling=midpoint",
        "spectrum=tatarskii:inner_scale=1 cm",
    ],
)
def test_what_comes_after_the_correlations_reads_no_frame(
    done: tuple[Path, Any], recordings: list[str], assignment: str
) -> None:
    out, first = done
    (outcome,) = run_here(recordings[:1], out, assignment)
    assert (outcome.status, outcome.frames_read, outcome.reused) == ("published", 0, 0)
    old, new = open_product(first[0].product), open_product(outcome.product)
    assert old.attrs["lineage_key"] != new.attrs["lineage_key"]
    assert not np.array_equal(old["cn2"].values, new["cn2"].values)
    np.testing.assert_array_equal(old["slope_correlation"].values, new["slope_correlation"].values)


@pytest.mark.parametrize("assignment", ["extraction.window_x=9 pixel", "correlation.covariance=independent"])
def test_what_comes_before_reads_them_again(done: tuple[Path, Any], recordings: list[str], assignment: str) -> None:
    (outcome,) = run_here(recordings[:1], done[0], assignment)
    assert (outcome.status, outcome.frames_read) == ("published", FRAMES)


def test_a_lost_product_file_is_made_again(recordings: list[str], tmp_path: Path) -> None:
    (first,) = run_here(recordings[:1], tmp_path)
    before = Path(first.product).read_bytes()
    Path(first.product).unlink()
    (second,) = run_here(recordings[:1], tmp_path)
    assert (second.status, second.frames_read) == ("published", 0)
    assert Path(second.product).read_bytes() == before
    with open_catalog(tmp_path) as catalog:
        assert catalog.verify() == []


def test_damaged_kept_correlations_are_computed_again(recordings: list[str], tmp_path: Path) -> None:
    (first,) = run_here(recordings[:1], tmp_path)
    expected = Path(first.product).read_bytes()
    kept = sorted((tmp_path / "correlations").rglob("*.npz"))
    assert len(kept) == BATCHES
    kept[0].write_bytes(kept[0].read_bytes()[:1000])
    content = bytearray(kept[1].read_bytes())
    content[len(content) // 2] ^= 1
    kept[1].write_bytes(content)
    kept[2].write_bytes(b"")
    Path(first.product).unlink()
    (second,) = run_here(recordings[:1], tmp_path)
    assert second.frames_read == 3 * FRAMES // BATCHES
    assert Path(second.product).read_bytes() == expected


def test_threads_and_order_change_no_bit(done: tuple[Path, Any], recordings: list[str], tmp_path: Path) -> None:
    expected = products(done[0])
    run_here(recordings[:1], tmp_path / "one", "run.threads=1", "run.archives_at_once=1")
    run_here(recordings[::-1], tmp_path / "many", "run.threads=5", "run.archives_at_once=3")
    assert products(tmp_path / "one").items() <= expected.items()
    assert products(tmp_path / "many").items() <= expected.items()
    assert len(products(tmp_path / "many")) == 3


def test_chunks_on_disk_change_nothing_but_the_identity(
    done: tuple[Path, Any], recordings: list[str], tmp_path: Path
) -> None:
    archive = open_archive(recordings[0])
    frames = np.concatenate([block for _, block in archive.chunks()])
    expected = open_product(done[1][0].product)
    for chunk_frames, name in ((97, "small.zarr"), (1000, "large.zarr.zip")):
        write_archive(
            tmp_path / name,
            archive.attributes,
            archive.time,
            frames,
            chunk_frames=chunk_frames,
            codec="lz4",
            dark=archive.dark,
            flat=archive.flat,
            bad_pixel=archive.bad_pixel,
        )
        (outcome,) = run_here([tmp_path / name], tmp_path / f"out-{chunk_frames}")
        assert outcome.status == "published"
        found = open_product(outcome.product)
        assert found.attrs["archive_identity"] != expected.attrs["archive_identity"]
        assert set(found.variables) == set(expected.variables)
        for variable, values in expected.variables.items():
            if values.dtype.kind not in "fiub":
                continue
            # Sums over frames are taken in the same order whatever the chunks are.
            np.testing.assert_allclose(
                found[variable].values, values.values, rtol=1e-12, atol=0, err_msg=str(variable), equal_nan=True
            )


def test_a_campaign_may_complete_headers(recordings: list[str], tmp_path: Path) -> None:
    whole = open_archive(recordings[0])
    path = tmp_path / "campaign.toml"
    path.write_text(
        f"archives = ['{recordings[0]}']\n[batch]\nduration = '1.5 s'\n[response]\nslices = 6\n"
        "[path]\nlength = '3 km'\n"
    )
    (outcome,) = run(load(path), prefect=False)
    assert outcome.status == "published"
    dataset = open_product(outcome.product)
    assert whole.header.path.length == 2670
    assert dataset.attrs["path_length"] == "3000 m"
    assert float(dataset["z_bounds"].values[-1, 1]) == 3000


def test_plan_counts_what_a_run_then_reads(recordings: list[str], tmp_path: Path) -> None:
    settings = settings_for(recordings[:1], tmp_path)
    planned = plan_archive(recordings[0], settings)
    assert [(w.start, w.stop) for w in planned.windows] == [(i * 213, (i + 1) * 213) for i in range(BATCHES)]
    assert planned.windows[0].stop_time - planned.windows[0].start_time == pytest.approx(1.5e9, abs=1e7)
    other = plan_archive(recordings[0], replace(settings, output=tmp_path / "elsewhere"))
    assert str(other.profile_key) == str(planned.profile_key)


def test_a_catalog_that_cannot_be_is_one_fault(recordings: list[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="the folder cannot be made"):
        run_here(recordings, tmp_path / "file" / "out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "catalog.sqlite").write_bytes(b"this is no database, as it should be one" * 50)
    with pytest.raises(InputError):
        run_here(recordings, tmp_path / "out")


def test_two_runs_into_one_catalog(recordings: list[str], done: tuple[Path, Any], tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda _: run_here(recordings[:2], tmp_path), range(2)))
    assert {o.status for outcomes in both for o in outcomes} <= {"published", "present"}
    assert products(tmp_path).items() <= products(done[0]).items()
    with open_catalog(tmp_path) as catalog:
        assert len(catalog.products()) == 2
        assert catalog.verify() == []
        assert json.dumps([made.state for made in catalog.runs()]) == '["finished", "finished"]'
