"""Product files: what the writer refuses, what comes back, and that the bytes are the same every time."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from made_products import IDENTITY, LENGTH, START, batch, failed, key, product, static
from zarr.storage import ZipStore

from coslidar.catalog import open_product
from coslidar.catalog.products import ProductError, check, fingerprint, product_bytes, write_product
from coslidar.pipeline import lineage
from coslidar.pipeline.products import COORDINATES, QUALITY_FLAGS, SCHEMA


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "p.zarr.zip"
    write_product(product(), path)
    return path


def test_everything_comes_back(written):
    made, read = product(), open_product(written)
    xr.testing.assert_equal(read, made)
    assert read.attrs == made.attrs
    for name, variable in made.variables.items():
        assert read[name].dtype == variable.dtype, name
        assert read[name].attrs == variable.attrs, name
    first = batch(0)
    np.testing.assert_array_equal(read["cn2"].values[0], first.values["cn2"])
    np.testing.assert_array_equal(read["averaging_kernel"].values[1], batch(1).values["averaging_kernel"])


def test_time_is_exact_and_utc(written):
    read = open_product(written)
    assert read["time"].dtype == "datetime64[ns]"
    assert read["time"].values.view(np.int64).tolist() == [START + i * LENGTH for i in range(3)]
    assert read["time_bounds"].values.view(np.int64)[1].tolist() == [START + LENGTH, START + 2 * LENGTH]
    assert read["time"].attrs["bounds"] == "time_bounds"


def test_failed_batch_is_nan_and_flagged(written):
    read = open_product(written)
    for name, variable in SCHEMA.items():
        if variable.dims[:1] == ("time",) and variable.dtype == "float64" and name in read:
            assert np.isnan(read[name].values[2]).all(), name
            assert np.isfinite(read[name].values[:2]).all(), name
    assert read["n_frames"].values[2] == 0
    assert read["quality_flag"].values.tolist() == [0, 4, 1]
    assert read["quality_level"].values.tolist() == [0, 1, 2]


def test_product_of_nothing_but_failures_has_its_variables():
    made = product(results=[failed(0), failed(1)], attributes={})
    assert made["cn2"].shape == (2, 4)
    assert np.isnan(made["cn2"]).all()
    assert "criterion" not in made  # nobody knows the grid of mu
    product_bytes(made)


def test_every_variable_says_its_unit(written):
    group = zarr.open_group(ZipStore(written, mode="r"), mode="r")
    for name, array in group.arrays():
        attributes = dict(array.attrs)
        assert attributes["long_name"]
        promised = SCHEMA.get(name) or COORDINATES.get(name)
        if promised is None:
            assert name in ("source", "axis", "axis_kind", "slope_kind", "intensity_kind", "scintillometer")
        elif promised.unit == "ns":
            assert attributes["units"] == "nanoseconds since 1970-01-01T00:00:00"
        else:
            assert attributes["units"] == promised.unit
        assert "_FillValue" not in attributes
    assert set(SCHEMA) <= set(dict(group.arrays()))


def test_plain_zarr_reads_it(written):
    group = zarr.open_group(ZipStore(written, mode="r"), mode="r")
    assert group["cn2"].metadata.dimension_names == ("time", "z")
    np.testing.assert_array_equal(group["cn2"][0], batch(0).values["cn2"])
    assert group["source"][:].tolist() == ["bottom", "top"]
    assert group["slope_kind"][:].tolist() == ["xx_auto", "yy_auto", "xx_cross", "yy_cross"]
    assert group["time"][0] == START
    assert group.attrs["Conventions"] == "CF-1.11"


def test_flags_after_cf(written):
    attributes = open_product(written)["quality_flag"].attrs
    meanings = attributes["flag_meanings"].split()
    assert dict(zip(meanings, attributes["flag_masks"], strict=True)) == {
        n: bit for n, (bit, _, _) in QUALITY_FLAGS.items()
    }


def test_lineage_and_provenance_are_inside(written):
    attributes = open_product(written).attrs
    document = json.loads(attributes["lineage"])
    lineage.check(document)
    assert document["key"] == attributes["lineage_key"] == str(key())
    assert attributes["archive_identity"] == IDENTITY
    assert attributes["wavelength"] == "3.8e-06 m"
    prov = json.loads(attributes["provenance"])
    source, result = f"coslidar:archive.{IDENTITY}", f"coslidar:result.{key()}"
    assert {source, result} <= set(prov["entity"])
    derived = {(d["prov:generatedEntity"], d["prov:usedEntity"]) for d in prov["wasDerivedFrom"].values()}
    reached, frontier = set(), {result}
    while frontier:
        reached |= frontier
        frontier = {used for made, used in derived if made in frontier} - reached
    assert source in reached  # the product leads back to the recording
    for section, references in (("used", ("prov:activity", "prov:entity")), ("wasAssociatedWith", ("prov:agent",))):
        for relation in prov[section].values():
            assert all(relation[r] in prov["activity"] | prov["entity"] | prov["agent"] for r in references)
    agent = prov["agent"]["coslidar:software"]
    assert agent["package:numpy"] == np.__version__


def test_nothing_that_changes_from_run_to_run_is_inside(written):
    content = written.read_bytes()
    for secret in (os.uname().nodename, str(Path.home()), sys.executable, "prov:startTime"):
        if len(secret) > 4:
            assert secret.encode() not in content


_SCRIPT = """
import sys, hashlib
sys.path.insert(0, sys.argv[1])
from made_products import product
from coslidar.catalog.products import product_bytes
print(hashlib.sha256(product_bytes(product(provenance={"by": "hand"}))).hexdigest())
"""


def test_same_bytes_in_every_process_and_thread(tmp_path):
    # Provenance by hand: the mark of a checkout changes while somebody edits it.
    def made(_=None):
        return product(provenance={"by": "hand"})

    expected = write_product(made(), tmp_path / "p.zarr.zip")
    with ThreadPoolExecutor(4) as pool:
        hashes = {hashlib.sha256(product_bytes(dataset)).hexdigest() for dataset in pool.map(made, range(4))}
    assert hashes == {expected}
    helpers = str(Path(__file__).parents[1])
    for seed in ("0", "77"):
        environment = os.environ | {"PYTHONHASHSEED": seed, "TZ": "Asia/Tokyo", "LC_ALL": "C"}
        run = subprocess.run([sys.executable, "-c", _SCRIPT, helpers], env=environment, capture_output=True, check=True)
        assert run.stdout.decode().strip() == expected


def test_fingerprint_follows_numbers_and_lineage_only():
    made = product()
    assert fingerprint(made) == fingerprint(product(provenance={"by": "hand"}))
    assert fingerprint(made) != fingerprint(product(lineage=key(1)))
    other = product()
    other["cn2"].values[0, 0] = np.nextafter(other["cn2"].values[0, 0], 1)
    assert fingerprint(made) != fingerprint(other)


def test_bytes_do_not_depend_on_the_order_of_anything():
    made = product()
    shuffled = made[sorted(made.variables, reverse=True)].assign_attrs(dict(reversed(made.attrs.items())))
    shuffled.attrs = dict(reversed(made.attrs.items()))
    assert product_bytes(shuffled) == product_bytes(made)
    assert product_bytes(product(results=[failed(2), batch(1, flag=4), batch(0)])) == product_bytes(made)


def test_sign_of_nan_does_not_count():
    made, other = product(), product()
    other["cn2"].values[2] = -np.float64("nan")
    assert np.signbit(other["cn2"].values[2]).all() != np.signbit(made["cn2"].values[2]).all()
    assert product_bytes(other) == product_bytes(made)


def test_one_bit_counts():
    made, other = product(), product()
    other["cn2"].values[0, 0] = np.nextafter(other["cn2"].values[0, 0], 1)
    assert product_bytes(other) != product_bytes(made)


def test_members_are_sorted_undated_and_stored(written):
    with zipfile.ZipFile(written) as archive:
        entries = archive.infolist()
    names = [entry.filename for entry in entries]
    assert names == sorted(names)
    assert {entry.date_time for entry in entries} == {(1980, 1, 1, 0, 0, 0)}
    assert {entry.compress_type for entry in entries} == {zipfile.ZIP_STORED}


def spoil(name, **attributes):
    def change(dataset):
        return dataset.assign({name: dataset[name].assign_attrs(attributes)})

    return change


REFUSED = {
    "unit": (spoil("cn2", units="m^(1/3)"), r"cn2: promised unit 'm\^\(-2/3\)', delivered 'm\^\(1/3\)'"),
    "no unit": (lambda d: d.assign(mu=("time", d["mu"].values)), r"mu: promised unit 'm\^\(4/3\)', delivered none"),
    "dtype": (lambda d: d.assign(cn2=d["cn2"].astype("f4")), "cn2: promised dtype float64, delivered float32"),
    "dims": (lambda d: d.assign(cn2=d["cn2"].T), r"cn2: promised dims \('time', 'z'\), delivered \('z', 'time'\)"),
    "stranger": (lambda d: d.assign(extra=("time", [1.0] * 3)), "extra: a product has no such variable"),
    "map": (lambda d: d.rename(dy="map"), "map: a product has no such variable"),
    "lost": (lambda d: d.drop_vars("quality_flag"), "quality_flag: promised, not delivered"),
    "coordinate": (lambda d: d.set_coords("pair_count"), "pair_count: promised as data variable"),
    "campaign": (lambda d: d.assign_attrs(campaign="../../x"), "campaign = '../../x'"),
    "archive": (lambda d: d.assign_attrs(archive="a\x1b[31m/b"), r"archive = 'a\\x1b\[31m/b'"),
    "key": (lambda d: d.assign_attrs(lineage_key="A" * 64), "lineage_key"),
    "attribute": (lambda d: d.assign_attrs(note=float("nan")), "cannot be written"),
    "type": (lambda d: d.assign_attrs(note=object()), "cannot be written"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_writer_refuses(case, tmp_path):
    change, message = REFUSED[case]
    path = tmp_path / "p.zarr.zip"
    with pytest.raises(ProductError, match=message):
        write_product(change(product()), path)
    assert list(tmp_path.iterdir()) == []


def test_all_faults_are_told_at_once():
    made = spoil("cn2", units="x")(product()).drop_vars("quality_level")
    with pytest.raises(ProductError) as caught:
        check(made)
    assert len(str(caught.value).splitlines()) == 2


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("cn2", np.zeros(5), r"cn2: promised dims \(z\) of shape \(4,\), delivered \(5,\)"),
        ("cn2", np.zeros(4, np.float32), "cn2: promised dtype float64, delivered float32"),
        ("cn2", np.zeros((1, 4)), "cn2: promised dims"),
        ("n_frames", np.float64(3), "n_frames: promised dtype int64, delivered float64"),
        ("criterion", np.zeros(3), "criterion: promised shape"),
        ("tvv", np.zeros(4), "tvv: a product has no such variable"),
        ("pair_count", np.zeros((5, 3), np.int64), "pair_count: promised once"),
        ("quality_flag", np.int32(1), "quality_flag: the product takes it from the batch"),
    ],
)
def test_assembly_refuses_what_a_stage_must_not_deliver(name, value, message):
    good = batch(0)
    bad = replace(good, values={**good.values, name: value})
    with pytest.raises(ProductError, match=message):
        product(results=[bad, batch(1)])


def test_a_truth_value_is_taken_as_a_flag():
    good = batch(0)
    made = product(results=[replace(good, values={**good.values, "cn2_at_bound": np.array([True, False] * 2)})])
    assert made["cn2_at_bound"].dtype == np.uint8
    assert made["cn2_at_bound"].values.tolist() == [[1, 0, 1, 0]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"results": []}, "at least one batch"),
        ({"results": [batch(0), batch(0, 1)]}, "overlaps"),
        ({"results": [replace(batch(0), stop=START)]}, "ends"),
        ({"archive_identity": "abc"}, "archive_identity = 'abc'"),
        ({"campaign": "a/../.."}, "campaign"),
        ({"archive": "x" * 101}, "archive"),
        ({"attributes": {"lineage": "forged"}}, "lineage is written by the product"),
    ],
)
def test_assembly_refuses(changes, message):
    with pytest.raises(ProductError, match=message):
        product(**changes)


def test_grids_of_mu_that_differ_are_united():
    results = [batch(0, grid=3), batch(1, grid=5)]  # 25, 27, 29 and 25, 26, 27, 28, 29
    made = product(results=results)
    assert made["log_mu_grid"].values.tolist() == [25, 26, 27, 28, 29]
    np.testing.assert_array_equal(made["criterion"].values[0, ::2], results[0].values["criterion"])
    assert np.isnan(made["criterion"].values[0, 1::2]).all()
    np.testing.assert_array_equal(made["criterion"].values[1], results[1].values["criterion"])


def test_no_grid_of_mu_at_all(tmp_path):
    path = tmp_path / "p.zarr.zip"
    made = product(results=[batch(0, grid=0)])
    write_product(made, path)
    assert open_product(path)["criterion"].shape == (1, 0)


def test_names_of_sources_in_any_script(tmp_path):
    path = tmp_path / "p.zarr.zip"
    write_product(product(sources=["Sud-Été", "<script>望遠"]), path)
    assert open_product(path)["source"].values.tolist() == ["Sud-Été", "<script>望遠"]


def test_static_variables_are_checked_too():
    from coslidar.catalog.products import assemble

    common = {
        "campaign": "c",
        "archive": "a",
        "archive_identity": IDENTITY,
        "lineage": key(),
        "wavelength": 3.8e-6,
        "sources": ["bottom", "top"],
        "scintillometers": ["LAS A"],
    }
    with pytest.raises(ProductError, match="pair_count: promised dtype int64, delivered float64"):
        assemble([batch(0)], static() | {"pair_count": np.zeros((5, 3))}, **common)
    with pytest.raises(ProductError, match="nothing: a product has no such variable"):
        assemble([batch(0)], static() | {"nothing": np.zeros(3)}, **common)


def damage_head(path):
    path.write_bytes(b"no zip")


def damage_tail(path):
    path.write_bytes(path.read_bytes()[:-100])


def damage_middle(path):
    data = bytearray(path.read_bytes())
    place = data.index(np.ascontiguousarray(batch(0).values["cn2"]).tobytes())
    data[place] ^= 1
    path.write_bytes(bytes(data))


def make_archive(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "zarr.json", '{"zarr_format": 3, "node_type": "group", "attributes": {"format": "shwfs-frames"}}'
        )


def make_newer(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("zarr.json", '{"zarr_format": 3, "node_type": "group", "attributes": {"product_schema": 9}}')


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (Path.unlink, "there is no such file"),
        (damage_head, "no product"),
        (damage_tail, "no product"),
        (damage_middle, "is damaged|damaged one"),
        (make_archive, "but no product"),
        (make_newer, "schema 9; this version reads 1"),
    ],
)
def test_reader_refuses(written, damage, message):
    damage(written)
    with pytest.raises(ProductError, match=message):
        open_product(written)


def test_a_product_can_be_written_over_and_nothing_is_left(tmp_path, monkeypatch):
    path = tmp_path / "p.zarr.zip"
    first = write_product(product(), path)

    def refuse(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="disk full"):
        write_product(product(seed=1), path)
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["p.zarr.zip"]
    assert hashlib.sha256(path.read_bytes()).hexdigest() == first
    assert write_product(product(seed=1), path) != first


def test_nothing_heavy_is_imported_by_the_package():
    script = "import sys, coslidar.catalog; print([m for m in ('zarr', 'xarray', 'sqlalchemy') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, check=True).stdout.strip() == b"[]"
