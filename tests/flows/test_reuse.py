"""What a run reuses, and what it says of that before: counted, not assumed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_runs import ARCHIVES, BATCHES, FRAMES, SETTINGS, Finished, chunk, products, run_arguments, unpacked

from coslidar.catalog import archive as archives
from coslidar.catalog import open_catalog, open_product
from coslidar.catalog.measurements import MeasurementStore
from coslidar.catalog.products import fingerprint
from coslidar.flows import estimate
from coslidar.flows.driver import ArchiveOutcome
from coslidar.flows.options import Options
from coslidar.flows.plan import plan_archive
from coslidar.flows.run import run
from coslidar.flows.settings import InputError, Settings, load

Main = Callable[..., Finished]
PREVIOUS = "selector=previous:neighbours=1,criterion='evidence'"


def settings_for(recordings: Sequence[str | Path], out: Path, *assignments: str) -> Settings:
    return load(archives=[str(path) for path in recordings], output=out, assignments=[*SETTINGS, *assignments])


def run_here(
    recordings: Sequence[str | Path], out: Path, *assignments: str, options: Options | None = None
) -> list[ArchiveOutcome]:
    return run(settings_for(recordings, out, *assignments), prefect=False, options=options)


@pytest.fixture
def chunks_read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Every chunk of frames that is read, whoever reads it: the count of a run is not taken at its word."""
    read: list[int] = []
    honest = archives.Archive._chunk

    def counted(self: archives.Archive, i: int, *rooms: Any) -> Any:
        read.append(i)
        return honest(self, i, *rooms)

    monkeypatch.setattr(archives.Archive, "_chunk", counted)
    return read


@pytest.fixture(scope="module")
def done(recordings: list[str], tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """A catalog with the three recordings and their slopes and fluxes; copies of it may be changed."""
    out = tmp_path_factory.mktemp("reuse") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSLIDAR_HOME", str(cache))
        run_here(recordings, out, 'keep=["measurements"]')
    return out


# --- slopes and fluxes -------------------------------------------------------------------------------------


def test_other_correlations_of_kept_measurements_read_no_frame(
    done: Path, recordings: list[str], chunks_read: list[int], tmp_path: Path
) -> None:
    (kept,) = run_here(recordings[:1], done, "correlation.covariance=independent")
    assert (kept.status, kept.frames_read) == ("published", 0)
    assert chunks_read == []
    (read,) = run_here(recordings[:1], tmp_path, "correlation.covariance=independent")
    assert read.frames_read == FRAMES
    assert len(chunks_read) > 0
    # What was kept is what the frames give, to the last bit.
    assert Path(kept.product).read_bytes() == Path(read.product).read_bytes()


def test_nothing_is_kept_unless_asked(recordings: list[str], tmp_path: Path) -> None:
    run_here(recordings[:1], tmp_path)
    assert not (tmp_path / "measurements").exists()
    with pytest.raises(InputError, match=r"keep = \['slopes'\]: it must be a list of what can be kept: measurements"):
        settings_for(recordings, tmp_path, 'keep=["slopes"]')


def test_keeping_changes_no_key_and_no_byte(done: Path, recordings: list[str], tmp_path: Path) -> None:
    run_here(recordings[:1], tmp_path)
    assert products(tmp_path).items() <= products(done).items()


def test_damaged_measurements_are_read_again(
    done: Path, recordings: list[str], chunks_read: list[int], tmp_path: Path
) -> None:
    """A flipped bit, a file cut short, an empty one: never other numbers, always the frames."""
    keeping = ('keep=["measurements"]', "batch.duration=3 s", "batch.minimum=1.0")
    run_here(recordings[:1], tmp_path, *keeping)
    files = sorted((tmp_path / "measurements").rglob("*.zarr.zip"))
    assert len(files) == 2
    content = bytearray(files[0].read_bytes())
    content[len(content) // 2] ^= 1
    files[0].write_bytes(content)
    files[1].write_bytes(files[1].read_bytes()[:-1])
    (other,) = run_here(recordings[:1], tmp_path, *keeping, "correlation.covariance=independent")
    assert other.frames_read == 2 * (FRAMES // 2)
    del chunks_read[:]
    (again,) = run_here(recordings[:1], tmp_path, *keeping, "correlation.vibration=subtracted")
    assert (again.frames_read, chunks_read) == (0, [])  # written anew


def test_measurements_open_with_any_zarr_reader(done: Path, recordings: list[str]) -> None:
    import xarray

    plan = plan_archive(recordings[0], settings_for(recordings, done))
    store = MeasurementStore(done / "measurements")
    kept = store.load(plan.measurement_key(plan.windows[1]))
    assert kept is not None
    from zarr.storage import ZipStore

    with xarray.open_zarr(
        ZipStore(store.path(plan.measurement_key(plan.windows[1])), mode="r"), consolidated=False
    ) as seen:
        assert seen["slopes"].dims == ("time", "axis", "source", "subaperture")
        assert seen["slopes"].attrs["units"] == "rad"
        np.testing.assert_array_equal(seen["flux"].values, kept.flux)
    assert len(kept.time) == plan.windows[1].stop - plan.windows[1].start


def test_a_disk_that_the_worker_does_not_see_is_said_and_costs_nothing(recordings: list[str], tmp_path: Path) -> None:
    settings = settings_for(recordings[:1], tmp_path / "out", 'keep=["measurements"]')
    heard: list[str] = []

    class Listener:
        def planned(self, archive: str, batches: int) -> None:
            (tmp_path / "out" / "measurements").rmdir()

        def advanced(self, archive: str, index: int, reason: str) -> None: ...
        def finished(self, outcome: ArchiveOutcome) -> None: ...

        def warned(self, message: str) -> None:
            heard.append(message)

    (outcome,) = run(settings, Listener(), prefect=False)
    assert (outcome.status, outcome.failed_batches) == ("published", 0)
    assert len(heard) == 1  # once, not for every batch
    assert re.match(r"slopes and fluxes are not kept: .*measurements on \S+: No such file", heard[0])


# --- neighbours --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def neighbourly(recordings: list[str], tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """A catalog made with a selector that looks at neighbours, in one go."""
    out = tmp_path_factory.mktemp("previous") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSLIDAR_HOME", str(cache))
        run_here(recordings, out, PREVIOUS)
    return out


def test_the_curve_is_the_mean_over_neighbours(neighbourly: Path, done: Path, recordings: list[str]) -> None:
    """Compared with the curves of each batch alone, which know of no neighbour."""
    run_here(recordings[:1], done, "selector=evidence")
    with open_catalog(done) as catalog:
        (row,) = [row for row in catalog.products() if catalog.open(row).attrs["selector"] == "evidence"]
        alone = catalog.open(row)["criterion"].values
    with open_catalog(neighbourly) as catalog:
        together = catalog.open(catalog.find("demo/r0"))["criterion"].values
    for i in range(BATCHES):
        near = alone[max(0, i - 1) : i + 2]
        assert len(near) in (2, 3)
        # The order of a sum of three is all that differs.
        np.testing.assert_allclose(together[i], near.mean(axis=0), rtol=1e-12)
    assert not np.allclose(together, alone)


@pytest.mark.slow
def test_order_of_workers_changes_no_bit(neighbourly: Path, recordings: list[str], tmp_path: Path) -> None:
    run_here(recordings[:1], tmp_path / "one", PREVIOUS, "run.threads=1", "run.archives_at_once=1")
    run_here(recordings[::-1], tmp_path / "many", PREVIOUS, "run.threads=5", "run.archives_at_once=3")
    expected = products(neighbourly)
    assert products(tmp_path / "one").items() <= expected.items()
    assert products(tmp_path / "many") == expected


@pytest.mark.parametrize(
    "lost", [(1,), pytest.param((), marks=pytest.mark.slow), pytest.param((0, 3), marks=pytest.mark.slow)]
)
def test_resuming_changes_no_bit(
    lost: tuple[int, ...], neighbourly: Path, recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after two batches, kept correlations partly gone: the same bytes, and only what is gone is read."""
    from coslidar.flows.batches import Batches

    class Killed(BaseException):
        pass

    taken: list[int] = []
    honest = Batches._take

    def take(self: Batches, outcome: Any) -> None:
        honest(self, outcome)
        if outcome.result is not None:
            taken.append(outcome.window.index)
        if len(taken) == 2:
            raise Killed

    settings = settings_for(recordings[:1], tmp_path, PREVIOUS, "run.threads=1")
    with monkeypatch.context() as patch:
        patch.setattr(Batches, "_take", take)
        with pytest.raises(Killed):
            run(settings, prefect=False)
    plan = plan_archive(recordings[0], settings)
    with open_catalog(tmp_path) as catalog:
        assert sum(catalog.scratch.load(plan.result_key(window)) is not None for window in plan.windows) == 2
    for number in lost:
        key = str(plan.correlation_key(plan.windows[number]))
        (tmp_path / "correlations" / key[:2] / f"{key}.npz").unlink()
    (outcome,) = run(settings, prefect=False)
    needed = {near for i in range(BATCHES) if i not in taken for near in (i - 1, i, i + 1)}
    assert outcome.frames_read == len(needed & set(lost)) * FRAMES // BATCHES
    assert products(tmp_path).items() <= products(neighbourly).items()


def test_a_failed_neighbour_is_left_out_and_its_return_changes_those_beside_it(
    neighbourly: Path, recordings: list[str], tmp_path: Path
) -> None:
    archive = unpacked(recordings[0], tmp_path)
    path = chunk(archive, 1)  # of batches 1 and 2
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] + bytes([whole[len(whole) // 2] ^ 1]) + whole[len(whole) // 2 + 1 :])
    (spoiled,) = run_here([archive], tmp_path / "out", PREVIOUS)
    assert (spoiled.status, spoiled.failed_batches) == ("published", 2)
    path.write_bytes(whole)
    (mended,) = run_here([archive], tmp_path / "out", PREVIOUS, options=Options(retry_failed=True))
    assert (mended.status, mended.failed_batches) == ("published", 0)
    assert mended.frames_read == 2 * FRAMES // BATCHES
    with open_catalog(tmp_path / "out") as catalog:
        assert fingerprint(open_product(mended.product)) == fingerprint(catalog.open(catalog.find("demo/r0")))
        assert catalog.verify() == []
    assert set(products(tmp_path / "out").values()) <= set(products(neighbourly).values())


# --- what a plan says --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("assignment", "read"),
    [
        ("regulariser=gradient", 0),
        ("selector=fixed:mu='1e27 m^(4/3)'", 0),
        pytest.param("spectrum=tatarskii:inner_scale=1 cm", 0, marks=pytest.mark.slow),
        ("response.slices=5", 0),
        ("correlation.covariance=independent", 0),
        ("extraction.window_x=9 pixel", FRAMES),
        ("batch.duration=3 s", FRAMES),
    ],
)
def test_a_plan_counts_what_a_run_then_reads(
    assignment: str, read: int, done: Path, recordings: list[str], chunks_read: list[int]
) -> None:
    settings = settings_for(recordings[:1], done, assignment)
    with open_catalog(done) as catalog:
        told = estimate.forecast(plan_archive(recordings[0], settings), settings, catalog, Options())
    assert (told.frames, told.present) == (read, told.present)
    if told.present:  # by an earlier test of this module
        assert assignment == "correlation.covariance=independent"
        return
    (outcome,) = run(settings, prefect=False)
    assert (outcome.frames_read, bool(chunks_read)) == (read, bool(read))


def test_bytes_to_write_are_those_written(recordings: list[str], tmp_path: Path) -> None:
    settings = settings_for(recordings[:1], tmp_path, 'keep=["measurements"]')
    told = estimate.forecast(plan_archive(recordings[0], settings), settings, None, Options())
    run(settings, prefect=False)
    written = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.suffix in (".zip", ".npz"))
    # Names, attributes, the lineage and zip directories come on top: some 150 kB for each product, 4 kB for each file.
    assert told.bytes_written < written < told.bytes_written + 200_000 + 4_000 * 3 * BATCHES


def test_dry_run_and_plan_say_the_same_and_write_nothing(
    main_here: Main, recordings: list[str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    dry = main_here(*run_arguments(recordings, out, "--dry-run"))
    planned = main_here("plan", *run_arguments(recordings, out)[1:-1])
    assert (dry.code, dry.out) == (0, planned.out)
    assert not out.exists()
    lines = dry.out.splitlines()
    assert len(lines) == len(ARCHIVES) + 2
    assert re.fullmatch(r"about \d+ s on \d+ threads?, no earlier run in this catalog tells .*", lines[-1])
    assert main_here(*run_arguments(recordings[:1], out)).code == 0
    after = main_here(*run_arguments(recordings, out, "--dry-run")).out.splitlines()
    assert after[0] == "demo/r0: 4 batches, in the catalog already"
    assert re.fullmatch(r"about \d+ s on \d+ threads?, by the rates of the last run in this catalog", after[-1])


def test_the_estimate_follows_the_rates_of_earlier_runs(recordings: list[str], tmp_path: Path) -> None:
    told = [estimate.Forecast("a", "k", 10, todo=10, frames=5, pixels=2_000_000)]
    rates = estimate.Rates(pixel=3e-6, batch=0.5, basis="")
    assert estimate.seconds(told, rates, threads=2) == pytest.approx((6 + 5) / 2)
    assert estimate.seconds(told, rates, threads=100) == pytest.approx(11 / 10)  # no batch is cut in two
    run_here(recordings[:1], tmp_path)
    with open_catalog(tmp_path) as catalog:
        (made,) = catalog.runs()
        found = estimate.rates(catalog)
    assert made.progress is not None
    assert made.progress["frames"] == FRAMES
    rows, cols = open_archive_shape(recordings[0])
    assert found.pixel * FRAMES * rows * cols == pytest.approx(made.progress["reduce_seconds"])
    assert found.batch * BATCHES == pytest.approx(made.progress["retrieve_seconds"])


def open_archive_shape(path: str) -> tuple[int, int]:
    from coslidar.catalog import open_archive

    return open_archive(path).frame_shape


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.2, "1 s"), (89, "89 s"), (200, "3 min"), (7500, "2 h 5 min"), (86400, "24 h 0 min")]
)
def test_durations(seconds: float, words: str) -> None:
    assert estimate.duration(seconds) == words


def test_sizes() -> None:
    assert [estimate.size(n) for n in (0, 999, 1000, 123_456, 7_800_000, 3 * 10**12)] == [
        "0 B", "999 B", "1.0 kB", "123 kB", "7.8 MB", "3.0 TB",
    ]  # fmt: skip


# --- a product made again from its lineage -----------------------------------------------------------------


@pytest.mark.parametrize(
    "assignments",
    [
        ("regulariser=gradient", "selector=fixed:mu='1e27 m^(4/3)'", "inversion.estimator=posterior_mean"),
        pytest.param(
            ("preset=sauvage-2021", "response.slices=6", "spectrum=von_karman:outer_scale=3 m", "path.length=3 km"),
            marks=pytest.mark.slow,
        ),
        ("correlation.sources=second", "extraction.window_x=9 pixel", PREVIOUS),
    ],
)
def test_show_prints_the_campaign_file_that_makes_the_product_again(
    assignments: tuple[str, ...], main_here: Main, recordings: list[str], tmp_path: Path
) -> None:
    (made,) = run_here(recordings[:1], tmp_path / "results", *assignments)
    key = open_product(made.product).attrs["lineage_key"]
    shown = main_here("show", key[:12], "--out", tmp_path / "results")
    assert shown.code == 0, shown.err
    assert f"key {key}" in shown.out
    assert "ATTENTION" not in shown.out
    (tmp_path / "again.toml").write_text(shown.out)
    (again,) = run(load(tmp_path / "again.toml"), prefect=False)
    assert Path(again.product).parents[2] == tmp_path / "reproduced"
    # The same software, and so the same bytes.
    assert Path(again.product).read_bytes() == Path(made.product).read_bytes()


def test_show_names_what_will_differ(
    main_here: Main, done: Path, recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from coslidar.flows import reproduce
    from coslidar.plugins.regularisers import White

    monkeypatch.setitem(reproduce.VERSIONS, "correlation", reproduce.VERSIONS["correlation"] + 1)
    monkeypatch.setattr(White, "version", White.version + 3)
    with open_catalog(done) as catalog:
        key = next(row.lineage_key for row in catalog.products(archive_name="r1"))
    shown = main_here("show", key, "--out", done)
    now = reproduce.VERSIONS["correlation"]
    assert f"# ATTENTION: stage correlation was of version {now - 1}, this coslidar has version {now}" in shown.out
    assert (
        f"# ATTENTION: regulariser 'white' was of version {White.version - 3}, version {White.version} is inst"
        in shown.out
    )


def test_other_software_changes_the_bytes_and_not_the_fingerprint(
    recordings: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A product's provenance names the versions of packages, which are no part of its key."""
    from coslidar.catalog import provenance

    (made,) = run_here(recordings[:1], tmp_path / "a")
    honest = provenance.software
    monkeypatch.setattr(provenance, "software", lambda *a: {**honest(*a), "numpy": "9.9.9"})
    (other,) = run_here(recordings[:1], tmp_path / "b")
    assert Path(made.product).name == Path(other.product).name
    assert Path(made.product).read_bytes() != Path(other.product).read_bytes()
    first, second = open_product(made.product), open_product(other.product)
    assert json.loads(second.attrs["provenance"])["agent"]["coslidar:software"]["package:numpy"] == "9.9.9"
    assert fingerprint(first) == fingerprint(second)
