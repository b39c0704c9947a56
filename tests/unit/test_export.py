"""Exports, read back with what a user would read them with."""

from __future__ import annotations

import builtins
import json
import warnings
from dataclasses import replace

import aotpy
import netCDF4
import numpy as np
import pandas
import pyarrow
import pyarrow.parquet
import pytest
import xarray as xr
from made_products import LENGTH, START, batch, failed, key, product

from coslidar.catalog.export import (
    ExportError,
    by_day,
    export_csv,
    export_netcdf,
    export_parquet,
    export_telemetry,
    file_name,
    join,
)
from coslidar.pipeline.parameters import Header
from coslidar.pipeline.products import QUALITY_FLAGS, SCHEMA, Measurements

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
    np.testing.assert_array_equal(profiles["cn2_interval_95[lower]"][:4], batch(0).values["cn2_interval_95"][:, 0])
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
    assert batches["centroid_gain[top,y]"][2] == batch(100).values["centroid_gain"][1, 1]
    assert batches["r0_interval_68[upper]"][0] == batch(0).values["r0_interval_68"][1]
    assert (
        batches["cn2_path_average_interval_68[LAS A,lower]"][0] == batch(0).values["cn2_path_average_interval_68"][0, 0]
    )
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
    for name, variable in made.variables.items():
        if variable.dtype.kind == "U":
            assert read[f"{name}_name"].values.tolist() == variable.values.tolist()
            continue
        found = read[name]
        np.testing.assert_array_equal(found.transpose(*variable.dims).values, variable.values, err_msg=name)
        assert found.dtype == variable.dtype, name
        if not name.endswith("_bounds"):  # they share the units of what they bound, and CF wants no repetition
            assert found.attrs.get("units") == variable.attrs.get("units"), name
    assert made["cn2"].dims == ("time", "z")
    assert made["source"].values.tolist() == ["bottom", "top"]  # untouched
    assert read.attrs["lineage_key"] == str(key())
    assert json.loads(read.attrs["lineage"])["key"] == str(key())
    assert made["quality_flag"].attrs["flag_masks"] == [bit for bit, _, _ in QUALITY_FLAGS.values()]  # untouched


def test_netcdf_as_other_tools_see_it(tmp_path):
    path = export_netcdf([product()], tmp_path / "p.nc")
    with netCDF4.Dataset(path) as file:
        assert file.Conventions == "CF-1.11, ACDD-1.3"
        assert file["time"].units == "nanoseconds since 1970-01-01"
        assert int(file["time"][0]) == START
        assert file["time"].bounds in file.variables
        assert file["z"].bounds in file.variables
        assert file["cn2"].units == "m^(-2/3)"
        assert file["quality_flag"].flag_masks.dtype == file["quality_flag"].dtype
        assert file["quality_level"].flag_values.dtype == file["quality_level"].dtype
        for name in ("time", "z", "dy", "dx", "z_true", "log_mu_grid", "time_bounds", "z_bounds"):
            assert "_FillValue" not in file[name].ncattrs(), name
        assert file["cn2"].dimensions == ("z", "time")
        assert np.ma.getmaskarray(file["cn2"][:, 2]).all()
        for name in SCHEMA:
            assert "units" in file[name].ncattrs() or name.endswith("_bounds"), name
            # CF has names for these only; none is invented.
            named = ("n_frames", "quality_flag", "quality_level")
            assert ("standard_name" in file[name].ncattrs()) == (name in named), name


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
    kernel = read["averaging_kernel"].isel(time=3).values
    np.testing.assert_array_equal(kernel, batch(101).values["averaging_kernel"])
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


@pytest.mark.parametrize(
    ("package", "extra", "export"),
    [("netCDF4", "netcdf", export_netcdf), ("pyarrow", "parquet", export_parquet)],
)
def test_without_the_package(tmp_path, monkeypatch, package, extra, export):
    real = builtins.__import__

    def refuse(name, *rest, **more):
        if name == package:
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ExportError, match=rf"pip install 'coslidar\[{extra}\]'"):
        export([product()], tmp_path / "p")
    assert list(tmp_path.iterdir()) == []


def test_infinity_is_a_value_and_nothing_is_none(tmp_path):
    made = product()
    made["cn2_standard_error_ml"].values[0, 0] = np.inf
    table = pandas.read_csv(export_csv([made], tmp_path / "x")[0])
    assert table["cn2_standard_error_ml"][0] == np.inf
    assert table["cn2_standard_error_ml"][8:].isna().all()
    table = pandas.read_parquet(export_parquet([made], tmp_path / "x")[0])
    assert table["cn2_standard_error_ml"][0] == np.inf
    assert table["cn2_standard_error_ml"][8:].isna().all()


def test_parquet_comes_back_with_its_units(tmp_path):
    products = [evening(), product(results=MORNING)]
    files = export_parquet(products, tmp_path / "profiles")
    assert [file.name for file in files] == ["profiles.parquet", "profiles.batches.parquet"]
    for file, csv in zip(files, export_csv(products, tmp_path / "profiles"), strict=False):
        read, text = pandas.read_parquet(file), pandas.read_csv(csv)
        assert read.columns.tolist() == text.columns.tolist()
        assert str(read["time"].dtype) == "datetime64[ns, UTC]"
        assert (read["time"] == pandas.to_datetime(text["time"])).all()
        for name in read.columns:
            if read[name].dtype.kind in "if":
                np.testing.assert_array_equal(read[name].to_numpy(float), text[name].to_numpy(float), err_msg=name)
    schema = pyarrow.parquet.read_schema(files[0])
    assert schema.field("cn2").metadata == {
        b"unit": b"m^(-2/3)",
        b"description": SCHEMA["cn2"].long_name.encode(),
    }
    assert schema.field("time").type == pyarrow.timestamp("ns", tz="UTC")
    assert json.loads(schema.metadata[b"coslidar"])["products"][1]["lineage_key"] == str(key(1))
    batches = pyarrow.parquet.read_schema(files[1])
    assert batches.field("quality_flag").type == pyarrow.int32()
    assert batches.field("mean_flux[top]").metadata[b"unit"] == b"count"


def header(**changes):
    content = {
        "format": "shwfs-frames", "format_version": 1, "campaign": "test-campaign", "archive": "a",
        "instrument": {
            "wavelength": "3.8 um", "frame_rate": "142 Hz", "pixel_scale": "27 urad", "subaperture_size": "7 cm",
            "subaperture_mask": [[0, 1], [1, 1]], "lenslet_origin": [0, 0], "lenslet_pitch": [32, 32],
            "name": "Scindar", "gain": "12 electron/count", "read_noise": "60 electron",
        },
        "path": {"length": "2670 m"},
        "sources": [
            {"name": "bottom", "position": ["0 m", "-0.4 m"], "fwhm": ["9 cm", "6 cm"], "spot": [10, 15]},
            {"name": "top", "position": ["0 m", "0.4 m"], "fwhm": ["9 cm", "6 cm"], "spot": [21, 15]},
        ],
    }  # fmt: skip
    return Header.model_validate(content | changes)


def measured(start, frames=5):
    random = np.random.default_rng(start)
    slopes = random.normal(0, 1e-6, (frames, 2, 2, 3))
    slopes[1, :, 0, 2] = np.nan
    time = START + (start + np.arange(frames)) * 7_042_254
    return Measurements(time, slopes, random.normal(1e4, 10, (frames, 2, 3)), np.zeros((frames, 2, 3), np.uint8),
                        np.zeros((2, 3)), np.zeros((2, 2, 3)), np.full((2, 2), 1.01))  # fmt: skip


def opened(path):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*contains no data")  # there is no corrector and no loop
        return aotpy.AOSystem.read_from_file(path)


def test_telemetry_opens_again(tmp_path):
    batches = [measured(0), measured(5)]
    path = export_telemetry(header(), batches, tmp_path / "x.fits")
    read = opened(path)
    assert read.name == "Scindar"
    assert [sensor.source.uid for sensor in read.wavefront_sensors] == ["1: bottom", "2: top"]
    slopes = np.concatenate([batch.slopes for batch in batches])
    for number, sensor in enumerate(read.wavefront_sensors):
        np.testing.assert_array_equal(sensor.measurements.data, slopes[:, :, number])
        assert sensor.measurements.unit == "rad"
        fluxes = np.concatenate([batch.flux[:, number] for batch in batches])
        np.testing.assert_array_equal(sensor.subaperture_intensities.data, fluxes)
        assert sensor.subaperture_mask.data.tolist() == [[-1, 0], [1, 2]]
        assert sensor.wavelength == 3.8e-6
        assert sensor.detector.frame_rate == 142
        assert sensor.detector.pixel_scale == pytest.approx(27e-6)
        stamps = np.array(sensor.measurements.time.timestamps)
        np.testing.assert_allclose(stamps - START / 1e9, np.arange(10) * 7.042254e-3, atol=3e-7)
    assert read.main_telescope.enclosing_diameter == pytest.approx(0.14)
    assert str(read.date_beginning).startswith("2012-09-14 12:15:00")


def test_telemetry_of_hostile_names(tmp_path):
    sources = [source.model_dump() for source in header().sources]
    texts = ["<script>望遠\n\x1b[31m" + "x" * 900, "' / END \x00"]
    for source, text in zip(sources, texts, strict=True):
        source |= {"name": text, "position": ["0 m", f"{len(text)} m"], "fwhm": ["9 cm", "6 cm"]}
    path = export_telemetry(header(sources=sources), [measured(0)], tmp_path / "x.fits")
    read = opened(path)
    names = [sensor.source.uid for sensor in read.wavefront_sensors]
    assert names[0].startswith("1: <script>\\u671b\\u9060\\n\\x1b[31mxxx")
    assert names[1] == "2: ' / END \\x00"
    assert all(name.isprintable() and len(name) < 70 for name in names)


def test_telemetry_refuses(tmp_path):
    with pytest.raises(ExportError, match="no measurements"):
        export_telemetry(header(), [], tmp_path / "x.fits")
    with pytest.raises(ExportError, match="no folder"):
        export_telemetry(header(), [measured(0)], tmp_path / "nowhere" / "x.fits")
    oblong = header().instrument.model_dump() | {
        "subaperture_mask": [[0, 1, 1], [1, 1, 1]], "wavelength": "3.8 um", "frame_rate": "142 Hz",
        "pixel_scale": "27 urad", "subaperture_size": "7 cm", "gain": None, "read_noise": None}  # fmt: skip
    with pytest.raises(ExportError, match="square lenslet maps only; this one is 2 x 3"):
        export_telemetry(header(instrument=oblong), [measured(0)], tmp_path / "x.fits")
    assert list(tmp_path.iterdir()) == []


# --- names and days ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("site", "name"),
    [
        ("CRA Lannemezan", "cra-lannemezan_cn2_2012-09-14.nc"),
        ("../../x", "x_cn2_2012-09-14.nc"),
        ("Été\x00\n/望遠", "ete_cn2_2012-09-14.nc"),
        ("<script>", "script_cn2_2012-09-14.nc"),
        ("", "site_cn2_2012-09-14.nc"),
        ("y" * 10_000_000, "y" * 60 + "_cn2_2012-09-14.nc"),
    ],
)
def test_names_follow_site_quantity_and_day(site, name):
    assert file_name(site, "cn2", "2012-09-14", "nc") == name


def test_batches_by_day():
    night = [batch(230), batch(234), batch(235)]  # 23:45, 23:57 and the next day
    days = by_day([product(1, night, archive="night"), evening()])
    assert list(days) == ["2012-09-14", "2012-09-15"]
    assert [part.sizes["time"] for part in days["2012-09-14"]] == [2, 2]
    assert days["2012-09-14"][0].attrs["archive"] == "evening"
    assert [part.attrs["archive"] for part in days["2012-09-15"]] == ["night"]
    with pytest.raises(ExportError, match="no product"):
        by_day([])


# --- conformance -------------------------------------------------------------------------------------------

HOSTILE = "<script>alert(1)</script>\x00\x1b[31m\u202e望遠'; DROP TABLE product; --" + "x" * 5000


#: Batches at whole microseconds: the checker's library has no word for nanoseconds.
WHOLE = [replace(item, start=item.start // 1000 * 1000, stop=item.stop // 1000 * 1000) for item in (*MORNING, *EVENING)]


def complaints(path, checker, least=1):
    """Complaints of the IOOS compliance checker of this weight or more: 1 suggestions, 2 recommendations, 3 errors."""
    from compliance_checker.base import Result
    from compliance_checker.runner import CheckSuite

    CheckSuite.load_all_available_checkers()
    suite = CheckSuite()
    with warnings.catch_warnings(), suite.load_dataset(str(path)) as opened:
        warnings.simplefilter("ignore")  # what the checker's own libraries complain of
        ((groups, broken),) = suite.run_all(opened, [checker]).values()
    assert broken == {}
    found = []

    def walk(result: Result):
        reached, possible = result.value if isinstance(result.value, tuple) else (bool(result.value), 1)
        if reached < possible:
            # A result that is all right also has something to say.
            found.extend(result.msgs or [])
            for child in result.children or []:
                walk(child)

    for group in groups:
        if group.weight >= least:
            walk(group)
    return found


@pytest.mark.parametrize(("texts", "count"), [("plain", 1), ("hostile", 2)])
@pytest.mark.slow
def test_netcdf_passes_the_compliance_checker(tmp_path, texts, count):
    changes = (
        {"attributes": {"site_name": HOSTILE, "note": HOSTILE}, "sources": [HOSTILE, "\n"]}
        if texts == "hostile"
        else {}
    )
    products = [product(results=WHOLE[:2], **changes), product(1, WHOLE[2:], archive="b", **changes)][:count]
    assert complaints(export_netcdf(products, tmp_path / "s.nc", strict=True), "cf:1.11") == []
    found = complaints(export_netcdf(products, tmp_path / "p.nc"), "cf:1.11")
    assert len(found) == sum("/3)" in variable.unit for variable in SCHEMA.values())
    assert all("/3)" in text and "not recognized by UDUNITS" in text for text in found), found


@pytest.mark.slow
def test_netcdf_satisfies_acdd(tmp_path):
    """All it asks for is there, but for standard names, which CF does not have, and heights above the sea."""
    made = product(results=WHOLE[:2], attributes={"site_latitude": "43.1285 deg", "site_longitude": "0.3672 deg"})
    given = dict.fromkeys(("acknowledgement", "creator_name", "institution", "license", "publisher_name"), "x")
    given |= {f"{who}_{what}": value for who in ("creator", "publisher")
              for what, value in (("url", "https://example.org"), ("email", "a@example.org"))}  # fmt: skip
    path = export_netcdf([made], tmp_path / "p.nc", created=np.datetime64("2026-01-02T03:04:05"), attributes=given)
    found = [
        text for text in complaints(path, "acdd", least=2) if "standard_name" not in text and "vertical" not in text
    ]
    assert found == []
    with netCDF4.Dataset(path) as file:
        assert file.geospatial_bounds == "POINT (43.1285 0.3672)"
        assert file.time_coverage_duration == "PT360S"
        assert file.creator_url == "https://example.org"


def test_netcdf_takes_no_stranger_for_an_attribute(tmp_path):
    with pytest.raises(ExportError, match="lineage_key: no attribute that a user gives"):
        export_netcdf([product()], tmp_path / "p.nc", attributes={"lineage_key": "x"})
    assert list(tmp_path.iterdir()) == []


def test_hostile_texts_are_data_everywhere(tmp_path):
    made = product(attributes={"site_name": HOSTILE}, sources=[HOSTILE, "b"], scintillometers=[HOSTILE[:100]])
    files = [export_netcdf([made], tmp_path / "p.nc"), *export_csv([made], tmp_path / "p"),
             *export_parquet([made], tmp_path / "p")]  # fmt: skip
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(file.name for file in files)
    for file in files:
        assert b"\x1b[31m" not in file.read_bytes(), file.name
    with xr.open_dataset(files[0]) as read:
        assert read.attrs["site_name"].startswith("<script>alert(1)</script>  [31m 望遠'; DROP TABLE")
        assert read["source_name"].values[1] == "b"


def test_no_folder_to_write_to(tmp_path):
    with pytest.raises(ExportError, match="no folder"):
        export_csv([product()], tmp_path / "nowhere" / "x.csv")
    with pytest.raises(ExportError, match="no folder"):
        export_netcdf([product()], tmp_path / "nowhere" / "x.nc")
    with pytest.raises(ExportError, match="no product"):
        export_csv([], tmp_path / "x.csv")
