"""Readers of series: what is right, and one sentence for all that is wrong."""

from __future__ import annotations

from pathlib import Path

import netCDF4
import numpy as np
import pytest

from coslidar.catalog.elevation import great_circle, read_transect
from coslidar.catalog.series import Reading, SeriesError, read_series
from coslidar.pipeline.units import QuantityError, conversion

MND_HEAD = """FORMAT-1.1
2017-04-01T00:01:00+01:00
BLS900
4 4

Station Code:     Test
Network Name:     1
Serial Number:    2
Software:         SRun 1.27
Main Data
Time # time # # T3 # 1
Structure Function Constant # Cn2 # m^(-2/3) # S # 1 # N/A
Temperature # temp # deg C # S # 1 # N/A
Relative Humidity # humidity # % # S # 1 # N/A
Array # other #  # [S] # 1 # N/A

"""
MND = MND_HEAD + (
    "PT00H00M59S/2017-04-01T00:01:00+01:00\t5.0E-14\t8.5\t71\t[1,2]\n"
    "PT00H00M59S/2017-04-01T00:02:00+01:00\tN/A\t8.4\t72\t[1,2]\n"
)


def written(folder: Path, text: str, name: str = "series.csv") -> Path:
    path = folder / name
    path.write_text(text, "utf-8")
    return path


def faults(path: Path, **reading: object) -> list[str]:
    with pytest.raises(SeriesError) as caught:
        read_series(path, Reading(**reading))  # type: ignore[arg-type]
    return caught.value.faults


def test_mnd(tmp_path: Path) -> None:
    found = read_series(written(tmp_path, MND, "day.mnd"))
    assert np.array(found.stop, "datetime64[ns]").tolist()[0] == np.datetime64("2017-03-31T23:01", "ns").astype(int)
    assert ((found.stop - found.start) == 59 * 10**9).all()
    assert found.values["cn2"][0] == 5e-14
    assert np.isnan(found.values["cn2"][1])
    assert found.values["temperature"] == pytest.approx([281.65, 281.55])
    assert found.values["relative_humidity"] == pytest.approx([0.71, 0.72])
    assert not found.warnings


def test_a_record_cut_off_by_a_power_failure(tmp_path: Path) -> None:
    found = read_series(written(tmp_path, MND + "PT00H00M59S/2017-04-01T00:03:00+01:00\t5.0E", "day.mnd"))
    assert len(found) == 2
    assert "the last record is incomplete" in found.warnings[0]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("time,Cn2\n", "no 'FORMAT-1.1'"),
        (MND.replace("FORMAT-1.1", "FORMAT-1"), "'FORMAT-1' is unknown; FORMAT-1.1 can be read"),
        (MND.replace("Main Data", "Data"), "does not describe its columns"),
        (MND.replace("5.0E-14\t", ""), "4 fields, of 5"),
        (MND.replace("5.0E-14", "oops"), "'oops' is no number"),
        (MND_HEAD, "there are no records"),
        (MND.replace("m^(-2/3)", "m"), "'m' is a length"),
    ],
)
def test_faults_of_mnd(tmp_path: Path, text: str, fault: str) -> None:
    assert fault in faults(written(tmp_path, text, "day.mnd"))[0]


@pytest.mark.parametrize("unit", ["m^(-2/3)", "m^-2/3", "m-2/3", "m**(-2/3)", "m ^ -2 / 3"])
def test_common_but_wrong_units(tmp_path: Path, unit: str) -> None:
    path = written(tmp_path, f"time,Cn2 [{unit}]\n2012-09-14T12:00Z,1e-14\n2012-09-14T12:01Z,2e-14\n")
    found = read_series(path)
    assert found.values["cn2"].tolist() == [1e-14, 2e-14]
    assert bool(found.warnings) == (unit not in ("m^(-2/3)", "m**(-2/3)"))
    assert all(f"'{unit}' says another thing than is meant; read as 'm^(-2/3)'" in w for w in found.warnings)


@pytest.mark.parametrize(
    ("unit", "target", "factor", "offset"),
    [("deg C", "K", 1, 273.15), ("hPa", "Pa", 100, 0), ("%", "1", 0.01, 0), ("W m-2", "W/m^2", 1, 0), ("", "1", 1, 0),
     ("km/hour", "m/s", 1 / 3.6, 0), ("K2 m-2/3", "K^2 m^(-2/3)", 1, 0), ("g/kg", "1", 1e-3, 0)],
)  # fmt: skip
def test_conversions(unit: str, target: str, factor: float, offset: float) -> None:
    assert conversion(unit, target)[:2] == pytest.approx((factor, offset))


@pytest.mark.parametrize(("unit", "target"), [("foo", "K"), ("m", "K"), ("1e3 m", "m"), ("__import__('os')", "m")])
def test_no_conversions(unit: str, target: str) -> None:
    with pytest.raises(QuantityError):
        conversion(unit, target)


def test_local_time_and_the_hour_that_comes_twice(tmp_path: Path) -> None:
    rows = "".join(f"2012-10-28 {clock},1e-14\n" for clock in ("01:30", "02:00", "02:30", "02:00", "02:30", "03:00"))
    found = read_series(written(tmp_path, "time,Cn2 [m^(-2/3)]\n" + rows), Reading(timezone="Europe/Paris"))
    assert np.diff(found.start).tolist() == [30 * 60 * 10**9] * 5
    assert found.start[0] == np.datetime64("2012-10-27T23:30", "ns").astype(int)
    fixed = read_series(written(tmp_path, "time;Cn2 (m^(-2/3))\n2012-10-28 01:00;1e-14\n2012-10-28 02:00;1e-14\n"),
                        Reading(timezone="UTC+1", stamp="end", interval=600.0))  # fmt: skip
    assert fixed.stop[0] == np.datetime64("2012-10-28T00:00", "ns").astype(int)
    assert (fixed.stop - fixed.start).tolist() == [600 * 10**9] * 2


def test_a_heading_that_names_the_zone(tmp_path: Path) -> None:
    found = read_series(
        written(tmp_path, "time (UTC),Cn2 (m^(-2/3))\n2012-09-14T12:00:00,1e-14\n2012-09-14T12:01:00,1e-14\n")
    )
    assert found.start[0] == np.datetime64("2012-09-14T12:00", "ns").astype(int)


def test_missing_and_impossible_values(tmp_path: Path) -> None:
    text = "# remark\ntime,Cn2 [m^(-2/3)]\n" + "".join(
        f"2012-09-14T12:0{i}Z,{value}\n" for i, value in enumerate(["1e-14", "", "NaN", "-9.99", "0"])
    )
    found = read_series(written(tmp_path, text))
    assert np.isfinite(found.values["cn2"]).tolist() == [True, False, False, False, False]
    assert "2 values of Cn2 are zero or negative" in found.warnings[0]


@pytest.mark.parametrize(
    ("text", "reading", "fault"),
    [
        ("time,Cn2\n2012-09-14T12:00Z,1\n2012-09-14T12:01Z,1\n", {}, "'Cn2' has no unit"),
        ("time,Cn2 [m^(-2/3)]\n2012-09-14 12:00,1\n", {}, "have no time zone"),
        ("time,Cn2 [m^(-2/3)]\n2012-09-14 12:00,1\n", {"timezone": "Mars"}, "no such time zone"),
        ("time,Cn2 [m^(-2/3)]\n2012-09-14T12:00Z,1\n", {}, "one time tells no interval"),
        ("time,Cn2 [m^(-2/3)]\nnoon,1\n", {}, "line 2: 'noon' is no time"),
        ("a,b\n1,2\n", {}, "no column is called 'time'"),
        ("time;Cn2 [m^(-2/3)]\n2012-09-14T12:00Z;1,5\n2012-09-14T12:01Z;1,5\n", {}, "use a point as decimal sign"),
        ("time,foo\n2012-09-14T12:00Z,1\n2012-09-14T12:01Z,1\n", {}, "no column is known; it has foo"),
        ("time,T_1m [K],T_2m [K]\n2012-09-14T12:00Z,1,1\n2012-09-14T12:01Z,1,1\n", {}, "no column is known"),
        ("time,x [m^(-2/3)]\n2012-09-14T12:00Z,1\n2012-09-14T12:01Z,1\n", {"columns": {"cn2": "y"}}, "no such column"),
        ("time,x [m]\n2012-09-14T12:00Z,1\n2012-09-14T12:01Z,1\n", {"columns": {"c2": "x"}}, "no such quantity"),
        ("time,Cn2 [m^(-2/3)]\n2012-09-14T12:00Z,1\n2012-09-14T12:00Z,1\n2012-09-14T12:01Z,1\n", {}, "there twice"),
        ("time,Cn2 [m^(-2/3)]\n2012-09-14T12:00Z,1,2\n2012-09-14T12:01Z,1\n", {}, "line 2: 3 fields"),
        ("time\n", {}, "at least one line of values"),
    ],
)
def test_faults_of_csv(tmp_path: Path, text: str, reading: dict[str, object], fault: str) -> None:
    assert fault in faults(written(tmp_path, text), **reading)[0]


def test_two_columns_that_could_be_one_quantity(tmp_path: Path) -> None:
    path = written(
        tmp_path, "time,Cn2 [m^(-2/3)],T_1m [K],T_2m [K]\n2012-09-14T12:00Z,1,280,281\n2012-09-14T12:01Z,1,1,1\n"
    )
    found = read_series(path)
    assert set(found.values) == {"cn2"}
    assert "could both be temperature; neither is read" in found.warnings[0]
    chosen = read_series(path, Reading(columns={"temperature": "T_2m"}))
    assert chosen.values["temperature"][0] == 281
    assert not chosen.warnings


def test_every_fault_at_once(tmp_path: Path) -> None:
    one = written(tmp_path, "time,Cn2,T [m]\n2012-09-14T12:00Z,1,2\n2012-09-14T12:01Z,1,2\n", "one.csv")
    with pytest.raises(SeriesError) as caught:
        read_series([one, tmp_path / "two.csv"])
    assert len(caught.value.faults) == 3
    assert "there is no such file" in caught.value.faults[2]


def test_netcdf(tmp_path: Path) -> None:
    path = tmp_path / "series.nc"
    with netCDF4.Dataset(path, "w") as file:
        file.createDimension("time", 3)
        time = file.createVariable("time", "i4", ("time",))
        time.units, time[:] = "minutes since 2021-06-01 00:00:00", [0, 6, 12]
        cn2 = file.createVariable("Cn2_3m", "f8", ("time",), fill_value=-999.0)
        cn2.units, cn2[:] = "m^-2/3", [1e-14, -999.0, 3e-14]
        warm = file.createVariable("T_5m", "f8", ("time",))
        warm.units, warm[:] = "degC", [20, 21, 22]
    found = read_series(path)
    assert found.start[0] == np.datetime64("2021-06-01", "ns").astype(int)
    assert (found.stop - found.start == 360 * 10**9).all()
    assert np.isnan(found.values["cn2"]).tolist() == [False, True, False]
    assert found.values["temperature"] == pytest.approx([293.15, 294.15, 295.15])
    local = read_series(path, Reading(timezone="America/New_York"))
    assert local.start[0] - found.start[0] == 4 * 3600 * 10**9
    path.write_bytes(b"nothing")
    assert "no NetCDF file that can be read" in faults(path)[0]


def test_transect_of_a_table(tmp_path: Path) -> None:
    path = written(tmp_path, "distance [km],elevation [m]\n0,600\n1.5,590\n2.67,605\n")
    found = read_transect(path, 2670.0)
    assert found.distance == pytest.approx([0, 1500, 2670])
    for text, fault in (
        ("distance [m],height [m]\n0,1\n2,3\n", "no column is called 'elevation'"),
        ("distance [m],elevation\n0,1\n2,3\n", "write 'elevation [m]'"),
        ("distance [m],elevation [m]\n0,1\n2000,3\n", "runs from 0 m to 2000 m"),
        ("distance [m],elevation [m]\n0,1\n0,3\n2670,1\n", "must increase"),
    ):
        with pytest.raises(SeriesError, match=fault.replace("[", r"\[")):
            read_transect(written(tmp_path, text), 2670.0)


def test_transect_of_a_map(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "map.tif"
    # A plane that rises 100 m per degree of latitude and 50 m per degree of longitude.
    size, west, north, step = 80, 0.30, 43.20, 0.002
    lon, lat = west + (np.arange(size) + 0.5) * step, north - (np.arange(size) + 0.5) * step
    plane = (100 * lat[:, None] + 50 * lon).astype("float64")
    with rasterio.open(path, "w", driver="GTiff", height=size, width=size, count=1, dtype="float64", crs="EPSG:4326",
                       transform=rasterio.Affine(step, 0.0, west, 0.0, -step, north)) as file:  # fmt: skip
        file.write(plane, 1)
    # The two ends of the path of the paper.
    pupil, sources = np.radians([43.1285, 0.36725]), np.radians([43.15178, 0.37650])
    length = great_circle(tuple(pupil), tuple(sources))
    assert length == pytest.approx(2670, rel=0.02)
    found = read_transect(path, 2670.0, tuple(pupil), tuple(sources))
    expected = [100 * np.degrees(end[0]) + 50 * np.degrees(end[1]) for end in (pupil, sources)]
    assert [found.elevation[0], found.elevation[-1]] == pytest.approx(expected, rel=1e-9)
    assert found.elevation == pytest.approx(np.linspace(*expected, len(found.elevation)), rel=1e-9)
    with pytest.raises(SeriesError, match="check latitude and longitude"):
        read_transect(path, 2000.0, tuple(pupil), tuple(sources))
    with pytest.raises(SeriesError, match="needs both ends"):
        read_transect(path, 2670.0)
    far = tuple(np.radians([44.1285, 0.36725])), tuple(np.radians([44.15178, 0.37650]))
    with pytest.raises(SeriesError, match="does not cover"):
        read_transect(path, 2670.0, *far)
