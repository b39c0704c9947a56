"""Two days of a BLS900 with its maker's own fluxes, and three months of a BLS450: real records of other instruments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coslidar.catalog.series import Reading, read_series
from coslidar.pipeline import air, surface_layer
from coslidar.pipeline.timeseries import TimeSeries, regular_windows


def record(shared_data: Path, name: str) -> Path:
    path = shared_data / "real" / name
    if not path.is_file():
        pytest.skip(f"no {path}: it is not part of the distribution")
    return path


@pytest.fixture(scope="module")
def bls(shared_data: Path) -> TimeSeries:
    return read_series([record(shared_data, f"read-mnd/2017-04-0{day}.mnd") for day in (1, 3)])


def test_two_days_are_whole(bls: TimeSeries) -> None:
    assert len(bls) == 2880
    assert not bls.warnings
    # The station keeps UTC+1: its days begin at 23:00 UTC, each record 59 s before the end of its minute.
    assert np.datetime64(int(bls.stop[0]), "ns") == np.datetime64("2017-03-31T23:01:00")
    assert (bls.stop - bls.start == 59 * 10**9).all()
    hours = bls.mean_over(regular_windows(int(bls.start[0]), int(bls.stop[-1]), 3600 * 10**9), "cn2")
    assert np.isfinite(hours.mean).sum() == 48
    assert hours.coverage[np.isfinite(hours.mean)] == pytest.approx(np.full(48, 59 / 60), rel=1e-3)


def test_ct2_as_the_maker_has_it(bls: TimeSeries) -> None:
    v = bls.values
    t, p = v["temperature"], v["pressure"]
    q = air.specific_humidity(t, p, v["relative_humidity"])
    ours = v["cn2"] * air.ct2_factor(air.index_slopes(0.88e-6, t, p, q), t)
    # The index of air of another formula, and no humidity: 0.4 %.
    assert ours / v["ct2"] == pytest.approx(np.full(len(bls), 1.0029), abs=0.0017)
    # With n - 1 = 77.6e-8 (1 + 7.52e-3 / lambda^2) p / T (Andrews and Phillips 2005, Ch. 3) the rounding is left: five
    # digits of CT2 and Cn2, four of temperature and pressure.
    index = 77.6e-8 * (1 + 7.52e-3 / 0.88**2) * p / t
    assert v["cn2"] * (t / index) ** 2 / v["ct2"] == pytest.approx(np.ones(len(bls)), abs=2e-4)


def test_heat_flux_as_the_maker_has_it(bls: TimeSeries) -> None:
    v = bls.values
    t, p = v["temperature"], v["pressure"]
    q = air.specific_humidity(t, p, v["relative_humidity"])
    capacity = air.density(t, p, q) * air.heat_capacity(q)
    makers = surface_layer.SIMILARITIES["thiermann-grassl-1992"]
    free = capacity * surface_layer.free_convection(v["ct2"], v["path_height"], t, similarity=makers)
    assert np.median(free / v["sensible_heat_flux_free_convection"]) == pytest.approx(1, abs=0.003)
    for regime, stable in (("unstable", False), ("stable", True)):
        found = surface_layer.solve(
            v["ct2"], v["path_height"], t, stable, wind=v["wind_speed"], wind_height=v["wind_height"],
            roughness=v["roughness_length"], similarity=makers,
        )  # fmt: skip
        theirs = {name: v[f"{name}_{regime}"] for name in ("sensible_heat_flux", "friction_velocity", "obukhov_length")}
        # Where the maker found no solution, there is none; where it did, so do we.
        assert ((found.state == surface_layer.CONVERGED) == np.isfinite(theirs["sensible_heat_flux"])).all()
        assert np.nanmax(found.residual) < 1e-8
        ours = {
            "sensible_heat_flux": capacity * found.kinematic,
            "friction_velocity": found.friction_velocity,
            "obukhov_length": found.obukhov_length,
        }
        for name, values in ours.items():
            ratio = values / theirs[name]
            # The file gives H to 0.1 W/m^2, u* to 1 mm/s, wind to 5 cm/s: per cents in calm air, nothing in the median.
            assert np.nanmedian(ratio) == pytest.approx(1, abs=2e-3), (regime, name)
            assert np.nanpercentile(np.abs(ratio - 1), 84) < 0.01, (regime, name)


def test_three_months_beside_the_water(shared_data: Path) -> None:
    path = record(shared_data, "otbench/usna_cn2_sm.nc")
    found = read_series(path, Reading(columns={"temperature": "T_5m"}))
    assert len(found) == 22081
    assert any("'m^-2/3' says another thing than is meant" in warning for warning in found.warnings)
    assert 1e-17 < np.nanmin(found.values["cn2"]) < np.nanmax(found.values["cn2"]) < 1e-12
    assert 280 < np.nanmin(found.values["temperature"]) < np.nanmax(found.values["temperature"]) < 315
    assert np.nanmax(found.values["relative_humidity"]) <= 1.0
    days = found.mean_over(regular_windows(int(found.start[0]), int(found.stop[-1]), 86400 * 10**9), "cn2")
    # 92 days and the one value of midnight of the next, which covers too little of its day.
    assert np.isfinite(days.mean).sum() == 92
    assert days.mean[:92] @ np.ones(92) / 92 == pytest.approx(np.nanmean(found.values["cn2"]), rel=1e-3)
