"""Exports, read back with what a user would read them with."""

from __future__ import annotations

import builtins
import json

import netCDF4
import numpy as np
import pandas
import pytest
import xarray as xr
from made_products import LENGTH, START, batch, failed, key, product

from coslidar.catalog.export import ExportError, export_csv, export_netcdf, join
from coslidar.pipeline.products import QUALITY_FLAGS, SCHEMA

MORNING = [batch(0), failed(1)]
EVENING = [batch(100, flag=4), batch(101)]


def evening(**changes):
    return product(1, EVENING, **({"archive": "evening", "archive_identity": "e" * 64} | changes))


@pytest.fixture
def tables(tmp_path):
    files = export_csv([evening(), product(results=MORNING)], tmp_path / "profiles.csv")
    return files, pandas.read_csv(files[0]), pandas.read_csv(files[1]), json.loads(files[2].read_text())


def test_csv_profiles(tables):
    files, profiles, _, _ = tables
    assert [file.name for file in files] == ["profiles.csv", "profiles.batches.csv", "profiles.units.json"]
    assert len(profiles) == 4 * 4
    np.testing.assert_array_equal(profiles["cn2"][:4], batch(0).values["cn2"])
    np.testing.assert_array_equal(profiles["cn2_standard_error_ml"][12:], batch(101).values["cn2_standard_error_ml"])
    assert profiles["cn2"][4:8].isna().all()
    assert profiles["z"][:4].tolist() == [333.75, 1001.25, 1668.75, 2336.25]
    assert profiles["z_upper"][3] == 2670.0
    assert profiles["archive"].tolist() == ["2012-09-14T1415"] * 8 + ["evening"] * 8
    assert set(profiles["lineage_key"]) == {str(key(0)), str(key(1))}


def test_csv_times_are_exact_utc(tables):
    _, profiles, batches, _ = tables
    times = pandas.to_datetime(batches["time"])
    assert str(times.dt.tz) == "UTC"
    expected = [START, START + LENGTH, START + 100 * LENGTH, START + 101 * LENGTH]
    assert times.dt.as_unit("ns").astype("int64").tolist() == expected
    assert pandas.to_datetime(batches["time_end"]).dt.as_unit("ns").astype("int64")[0] == START + LENGTH
    assert profiles["time"][0] == "2012-09-14T12:15:00.000000123Z"


def test_csv_batches(tables):
    _, _, batches, _ = tables
    first = batch(0).values
    assert batches["mu"][0] == float(first["mu"])
    assert batches["mean_flux[bottom]"][0] == first["mean_flux"][0]
    assert batches["mean_flux[top]"][0] == first["mean_flux"][1]
    assert batches["n_effective[i]"][3] == batch(101).values["n_effective"][2]
    assert batches["quality_flag"].tolist() == [0, 1, 4, 0]
    assert np.isnan(batches["r0_profile"][1])


def test_csv_sidecar_knows_every_column(tables):
    files, profiles, batches, sidecar = tables
    said = {(column["file"], column["name"]) for column in sidecar["columns"]}
    assert said == {(files[0].name, c) for c in profiles.columns} | {(files[1].name, c) for c in batches.columns}
    units = {column["name"]: column["unit"] for column in sidecar["columns"]}
    assert units["cn2"] == "m^(-2/3)"
    assert units["mean_flux[top]"] == "count"
    assert units["time"] == "UTC"
    assert sidecar["products"][0]["lineage"]["key"] == str(key(0))


def test_csv_of_sources_that_differ(tmp_path):
    files = export_csv([product(), evening(sources=["left", "right"])], tmp_path / "x")
    batches = pandas.read_csv(files[1])
    assert batches["mean_flux[top]"].notna().tolist() == [True, True, False, False, False]
    assert batches["mean_flux[left]"].notna().tolist() == [False, False, False, True, True]


def test_csv_names_cannot_steer_a_terminal(tmp_path):
    files = export_csv([product(sources=['a",\n=cmd()', "\x1b[31m"])], tmp_path / "x")
    assert b"\x1b" not in files[1].read_bytes()
    assert list(pandas.read_csv(files[1]).filter(like="mean_flux").columns) == [
        'mean_flux[a",\\n=cmd()]',
        "mean_flux[\\x1b[31m]",
    ]


def test_netcdf_comes_back(tmp_path):
    made = product()
    path = export_netcdf([made], tmp_path / "p.nc")
    with xr.open_dataset(path) as read:
        read.load()
    xr.testing.assert_equal(read, made)
    for name, variable in made.variables.items():
        assert read[name].dtype.kind == variable.dtype.kind or variable.dtype.kind == "U", name
        if not name.endswith("_bounds"):  # they share the units of what they bound, and CF wants no repetition
            assert read[name].attrs.get("units") == variable.attrs.get("units"), name
    assert read.attrs["lineage_key"] == str(key())
    assert json.loads(read.attrs["lineage"])["key"] == str(key())
    assert made["quality_flag"].attrs["flag_masks"] == [bit for bit, _, _ in QUALITY_FLAGS.values()]  # untouched


def test_netcdf_as_other_tools_see_it(tmp_path):
    path = export_netcdf([product()], tmp_path / "p.nc")
    with netCDF4.Dataset(path) as file:
        assert file.Conventions == "CF-1.11"
        assert file["time"].units == "nanoseconds since 1970-01-01"
        assert int(file["time"][0]) == START
        assert file["time"].bounds in file.variables
        assert file["z"].bounds in file.variables
        assert file["cn2"].units == "m^(-2/3)"
        assert file["quality_flag"].flag_masks.dtype == file["quality_flag"].dtype
        assert file["quality_level"].flag_values.dtype == file["quality_level"].dtype
        for name in ("time", "z", "dy", "dx", "z_true", "log_mu_grid", "time_bounds", "z_bounds"):
            assert "_FillValue" not in file[name].ncattrs(), name
        assert np.ma.getmaskarray(file["cn2"][2]).all()
        for name in SCHEMA:
            assert "units" in file[name].ncattrs() or name.endswith("_bounds"), name
            assert "standard_name" not in file[name].ncattrs(), name  # CF has none for these


def test_netcdf_strict_leaves_out_what_udunits_refuses(tmp_path):
    path = export_netcdf([product()], tmp_path / "p.nc", strict=True)
    with netCDF4.Dataset(path) as file:
        assert "units" not in file["cn2"].ncattrs()
        assert "m^(-2/3)" in file["cn2"].comment
        assert "m^(4/3)" in file["mu"].comment
        assert file["z"].units == "m"
        assert not any("^(" in getattr(variable, "units", "") for variable in file.variables.values())


def test_netcdf_of_several(tmp_path):
    path = export_netcdf([evening(), product(results=MORNING)], tmp_path / "p.nc")
    with xr.open_dataset(path) as read:
        read.load()
    assert read["time"].values.astype(np.int64).tolist() == [START + i * LENGTH for i in (0, 1, 100, 101)]
    assert read["product"].values.tolist() == [0, 0, 1, 1]
    assert list(read.attrs["archive"]) == ["2012-09-14T1415", "evening"]
    assert read.attrs["campaign"] == "test-campaign"
    assert list(read.attrs["lineage_key"]) == [str(key(0)), str(key(1))]
    np.testing.assert_array_equal(read["averaging_kernel"].values[3], batch(101).values["averaging_kernel"])
    assert read["pair_count"].dims == ("dy", "dx")
    assert read["quality_flag"].dtype == np.int32


def test_join_of_grids_of_mu_that_differ():
    joined = join([product(results=[batch(0, grid=3)]), evening()])
    assert joined["log_mu_grid"].values.tolist() == [25, 26, 27, 28, 29]
    assert np.isnan(joined["criterion"].values[0]).tolist() == [False, True, False, True, False]
    assert joined["n_frames"].dtype == np.int64


def test_join_refuses_what_does_not_fit():
    with pytest.raises(ExportError, match="test-campaign/evening differ in source"):
        join([product(), evening(sources=["a", "b"])])
    with pytest.raises(ExportError, match="cover the same time"):
        join([product(), product(1)])
    with pytest.raises(ExportError, match="no product"):
        join([])


def test_without_the_package(tmp_path, monkeypatch):
    real = builtins.__import__

    def refuse(name, *rest, **more):
        if name == "netCDF4":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ExportError, match=r"pip install 'coslidar\[netcdf\]'"):
        export_netcdf([product()], tmp_path / "p.nc")
    assert list(tmp_path.iterdir()) == []


def test_no_folder_to_write_to(tmp_path):
    with pytest.raises(ExportError, match="no folder"):
        export_csv([product()], tmp_path / "nowhere" / "x.csv")
    with pytest.raises(ExportError, match="no folder"):
        export_netcdf([product()], tmp_path / "nowhere" / "x.nc")
    with pytest.raises(ExportError, match="no product"):
        export_csv([], tmp_path / "x.csv")
