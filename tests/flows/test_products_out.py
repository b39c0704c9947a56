"""Reports and exports from the command line: what is chosen, where it goes, what is refused."""

from __future__ import annotations

import warnings
from pathlib import Path

import aotpy
import numpy as np
import pandas
import pytest
import xarray as xr
from click.testing import CliRunner, Result
from made_products import IDENTITY, batch, failed, product

from coslidar.catalog.archive import open_archive
from coslidar.catalog.measurements import MeasurementStore
from coslidar.catalog.products import open_product, write_product
from coslidar.catalog.report import page
from coslidar.flows.commands.export import export
from coslidar.flows.commands.report import report
from coslidar.flows.plan import plan_archive
from coslidar.flows.settings import InputError, load
from coslidar.flows.telemetry import measurements


def call(command, *arguments: object) -> Result:
    return CliRunner().invoke(command, [str(argument) for argument in arguments])


def faults(command, *arguments: object) -> list[str]:
    result = call(command, *arguments)
    assert isinstance(result.exception, InputError), result.output
    return result.exception.faults


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Two good batches from 12:15 and 12:18 UTC, and a failed one."""
    path = tmp_path / "p.zarr.zip"
    write_product(product(attributes={"site_name": "../../Été"}), path)
    return path


def test_the_ending_names_the_format(file: Path, tmp_path: Path) -> None:
    assert call(export, file, "-o", tmp_path / "x.nc").exit_code == 0
    with xr.open_dataset(tmp_path / "x.nc") as read:
        assert read.sizes["time"] == 3
    written = call(export, file, "-o", tmp_path / "x.parquet").output.splitlines()
    assert len(pandas.read_parquet(written[0])) == len(
        pandas.read_csv(call(export, file, "-o", tmp_path / "x.csv").output.splitlines()[0])
    )


@pytest.mark.parametrize("form", ["csv", "parquet", "netcdf"])
def test_a_folder_gets_a_file_a_day_named_by_site(file: Path, tmp_path: Path, form: str) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    result = call(export, file, "--format", form, "-o", folder)
    assert result.exit_code == 0, result.output
    written = [Path(line) for line in result.output.splitlines()]
    assert sorted(written) == sorted(folder.iterdir())
    assert all(path.name.startswith("ete_cn2_2012-09-14.") for path in written)
    expected = batch(0).values["cn2"]
    if form == "netcdf":
        with xr.open_dataset(written[0]) as read:
            np.testing.assert_array_equal(read["cn2"].isel(time=0).values, expected)
    else:
        read = pandas.read_csv(written[0]) if form == "csv" else pandas.read_parquet(written[0])
        np.testing.assert_array_equal(read["cn2"][:4], expected)


def test_only_the_batches_of_a_time(file: Path, tmp_path: Path) -> None:
    result = call(
        export, file, "--from", "2012-09-14T14:17+02:00", "--to", "2012-09-14T12:20Z", "-o", tmp_path / "x.csv"
    )
    assert result.exit_code == 0, result.output
    table = pandas.read_csv(tmp_path / "x.batches.csv")
    assert table["time"].tolist() == ["2012-09-14T12:18:00.000000123Z"]


def test_strict_netcdf_and_attributes(file: Path, tmp_path: Path) -> None:
    result = call(export, file, "--format", "netcdf", "--cf-strict", "--attribute", "license=CC BY 4.0",
                  "-o", tmp_path / "x.nc")  # fmt: skip
    assert result.exit_code == 0, result.output
    with xr.open_dataset(tmp_path / "x.nc") as read:
        assert read.attrs["license"] == "CC BY 4.0"
        assert "units" not in read["cn2"].attrs


def test_exports_that_are_refused(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.csv"
    assert "no such folder" in faults(export, file, "-o", tmp_path / "nowhere")[0]
    assert "no export ends so; write one of .csv" in faults(export, file, "-o", tmp_path / "table.xlsx")[0]
    (tmp_path / "campaign.toml").write_text('campaign = "here"')
    assert faults(export, tmp_path, "-o", out) == [
        f"{tmp_path}: there is no catalog, but a campaign; name {tmp_path / 'campaign.toml'}"
    ]
    assert "for --format netcdf" in faults(export, file, "--cf-strict", "-o", out)[0]
    assert (
        "no attribute that a user gives"
        in faults(export, file, "--format", "netcdf", "--attribute", "x=y", "-o", out)[0]
    )
    assert "one campaign file" in faults(export, file, "--format", "aot", "-o", tmp_path)[0]
    assert "no catalog" in faults(export, "demo/a", "--out", tmp_path / "none", "-o", out)[0]
    assert call(export, file, "--attribute", "novalue", "-o", out).exit_code == 2
    (tmp_path / "bad.zarr.zip").write_bytes(b"no zip")
    assert "no product" in faults(export, tmp_path / "bad.zarr.zip", "-o", out)[0]
    assert not out.exists()


def test_times_are_told_apart_from_no_times(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.html"
    found = faults(report, file, "--from", "noon", "--to", "2012-09-14T12:00", "-o", out)
    assert [fault.partition(":")[0] for fault in found] == ["--from", "--to"]
    assert (
        "is not before"
        in faults(report, file, "--from", "2013-01-01T00:00Z", "--to", "2012-01-01T00:00Z", "-o", out)[0]
    )
    assert "no batch starts" in faults(report, file, "--from", "2013-01-01T00:00Z", "-o", out)[0]
    assert "write .html, .pdf or .png" in faults(report, file, "-o", tmp_path / "x.doc")[0]
    assert not out.exists()


def test_report_of_a_time(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "BATCH_PANELS", page.BATCH_PANELS[:1])
    monkeypatch.setattr(page, "TIME_PANELS", page.TIME_PANELS[:1])
    result = call(report, file, "--to", "2012-09-14T12:16Z", "-o", tmp_path / "x.html")
    assert result.exit_code == 0, result.output
    assert result.output == f"{tmp_path / 'x.html'}: 1 batch. Open it in a browser.\n"
    assert "12:18:00" in (tmp_path / "x.html").read_text("utf-8")  # the end of the only batch
    assert "12:21:00" not in (tmp_path / "x.html").read_text("utf-8")


def test_nothing_but_failures_is_exported_and_reported(tmp_path: Path) -> None:
    path = tmp_path / "p.zarr.zip"
    write_product(product(results=[failed(0)], attributes={}), path)
    assert open_product(path).attrs["archive_identity"] == IDENTITY
    for arguments in ((export, path, "-o", tmp_path / "x.csv"), (report, path, "-o", tmp_path / "x.html")):
        assert call(*arguments).exit_code == 0
    assert pandas.read_csv(tmp_path / "x.batches.csv")["quality_level"].tolist() == [2]


def test_slopes_and_fluxes_from_frames_and_from_the_store(recordings: list[str], tmp_path: Path) -> None:
    campaign = tmp_path / "c.toml"
    campaign.write_text(f'archives = ["{recordings[0]}"]\noutput = "results"\n[batch]\nduration = "1.5 s"\n')
    folder = tmp_path / "out"
    folder.mkdir()
    result = call(export, campaign, "--format", "aot", "-o", folder)
    assert result.exit_code == 0, result.output
    (path,) = folder.iterdir()
    assert path.name == "cra-lannemezan_slopes_2012-09-14.fits"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # there is no corrector
        read = aotpy.AOSystem.read_from_file(path)
    archive = open_archive(recordings[0])
    data = read.wavefront_sensors[1].measurements.data
    assert data.shape == (archive.n_frames, 2, 9)
    # What a store holds is taken as it is.
    settings = load(campaign)
    plan = plan_archive(recordings[0], settings)
    store = MeasurementStore(tmp_path / "kept")
    store.folder.mkdir()
    measured = measurements(plan, store, settings.configuration.extraction)
    np.testing.assert_array_equal(np.concatenate([part.slopes[:, :, 1] for part in measured]), data)
    marked = measured[0].slopes.copy()
    marked[0] = 7.0
    kept = type(measured[0])(**{**vars(measured[0]), "slopes": marked})
    store.save(plan.measurement_key(plan.windows[0]), kept)
    again = measurements(plan, store, settings.configuration.extraction)
    assert (again[0].slopes[0] == 7.0).all()
    np.testing.assert_array_equal(again[1].slopes, measured[1].slopes)
