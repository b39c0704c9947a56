"""What a profile says with weather, heights and other instruments, against the formulas put together by hand."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from coslidar.pipeline import air, surface_layer
from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.optical_parameters import fried_weights
from coslidar.pipeline.products import SCHEMA, BatchResult
from coslidar.pipeline.surroundings import FLUX_STATES, Instrument, Meteorology, Surroundings, Terrain, compared
from coslidar.pipeline.timeseries import TimeSeries

MINUTE = 60 * 10**9
GRID = SliceGrid.uniform(2670.0, 6)
HEIGHTS = np.array([10.0, 14.0, 20.0, 25.0, 22.0, 18.0])
CN2 = np.array([3.0, 2.0, 1.0, 1.5, 2.0, 4.0]) * 1e-14
WEATHER = {
    "temperature": 293.0, "pressure": 0.95e5, "relative_humidity": 0.5, "wind_speed": 3.0, "net_radiation": 200.0,
}  # fmt: skip


def weather(minutes: int = 10, **changes: float) -> TimeSeries:
    start = MINUTE * np.arange(minutes, dtype=np.int64)
    values = {name: np.full(minutes, value) for name, value in (WEATHER | changes).items()}
    return TimeSeries(start, start + MINUTE, values, "made")


def parameters(**changes: object) -> Meteorology:
    given = {"file": "x.csv", "wind_height": "10 m", "roughness_length": "3 cm", "bowen_ratio": 0.5}
    return Meteorology.model_validate({k: v for k, v in (given | changes).items() if v is not None})


def around(series: TimeSeries | None = None, given: Meteorology | None = None, **changes: object) -> Surroundings:
    return Surroundings(
        **{
            "wavelength": 3.8e-6,
            "heights": HEIGHTS,
            "meteorology": weather() if series is None else series,
            "parameters": parameters() if given is None else given,
            "model_weights": fried_weights(GRID, 2670.0),
        }
        | changes  # type: ignore[arg-type]
    )


def derive(one: Surroundings, draws: np.ndarray | None = None) -> dict[str, np.ndarray]:
    found = one.derive(CN2, draws, 0, 3 * MINUTE)
    sizes = {"z": 6, "bound": 2, "scintillometer": len(one.instruments)}
    for name, value in found.items():
        promised = SCHEMA[name]
        assert value.shape == tuple(sizes[dim] for dim in promised.dims if dim != "time"), name
        assert value.dtype == promised.dtype, name
    return found


def test_the_chain_by_hand() -> None:
    found = derive(around())
    t, p = 293.0, 0.95e5
    q = air.specific_humidity(t, p, 0.5)
    slopes = air.index_slopes(3.8e-6, t, p, q)
    s = air.heat_capacity(q) / (air.latent_heat(t) * 0.5)
    ct2 = CN2 / float(slopes.per_temperature + s * slopes.per_humidity) ** 2
    assert found["ct2"] == pytest.approx(ct2, rel=1e-12)
    assert (found["flux_state"] == FLUX_STATES.index("converged")).all()
    # Similarity, from what was found: both equations and the definition of H.
    star, friction, length = found["temperature_scale"], found["friction_velocity"], found["obukhov_length"]
    lift = 1 + 0.61 * t * float(s)
    assert 1 / length == pytest.approx(0.4 * 9.81 * lift * star / (t * friction**2), rel=1e-8)
    assert ct2 * HEIGHTS ** (2 / 3) == pytest.approx(star**2 * 4.9 * (1 - 6.1 * HEIGHTS / length) ** (-2 / 3), rel=1e-8)
    heat = -float(air.density(t, p, q) * air.heat_capacity(q)) * friction * star
    assert found["sensible_heat_flux"] == pytest.approx(heat, rel=1e-10)
    assert found["stability"] == -1
    # Without draws there is no interval.
    assert np.isnan(found["sensible_heat_flux_interval_68"]).all()


def test_errors_are_carried_by_draws() -> None:
    rng = np.random.default_rng(5)
    draws = CN2 * (1 + 0.1 * rng.standard_normal((8192, 6)))
    found = derive(around(), draws)
    low, high = found["ct2_interval_68"].T
    assert (high - low) / 2 == pytest.approx(0.1 * found["ct2"], rel=0.1)
    low, high = found["sensible_heat_flux_interval_68"].T
    # H goes nearly as CT2^(3/4) by day: 7.5 % of it, and a little less where the wind matters.
    relative = (high - low) / 2 / found["sensible_heat_flux"]
    assert ((relative > 0.045) & (relative < 0.085)).all()
    assert (found["flux_solved_fraction"] == 1).all()
    assert ((low < found["sensible_heat_flux"]) & (found["sensible_heat_flux"] < high)).all()


def test_night() -> None:
    rng = np.random.default_rng(6)
    draws = CN2 * (1 + 0.1 * rng.standard_normal((2048, 6)))
    found = derive(around(weather(net_radiation=-50.0, wind_speed=8.0)), draws)
    assert (found["sensible_heat_flux"] < 0).all()
    assert found["stability"] == 1
    low, high = found["sensible_heat_flux_interval_68"].T
    assert ((low < found["sensible_heat_flux"]) & (found["sensible_heat_flux"] < high)).all()
    assert np.isnan(found["sensible_heat_flux_free_convection"]).all()
    still = derive(around(weather(net_radiation=-50.0, wind_speed=0.5)), draws)
    assert (still["flux_state"] == FLUX_STATES.index("no_solution")).all()
    assert np.isnan(still["sensible_heat_flux"]).all()


@pytest.mark.parametrize(
    ("series", "given", "state"),
    [
        (weather(wind_speed=np.nan), {}, "free_convection"),
        (weather(), {"wind_height": None}, "free_convection"),
        (weather(wind_speed=np.nan, net_radiation=-9.0), {}, "no_weather"),
        (weather(net_radiation=np.nan), {}, "unknown_stability"),
        (weather(temperature=np.nan), {}, "no_weather"),
        (weather(minutes=1), {}, "no_weather"),
        (weather(), {"displacement_height": "30 m"}, "no_height"),
    ],
)
def test_no_flux_without_a_reason(series: TimeSeries, given: dict[str, object], state: str) -> None:
    found = derive(around(series, parameters(**given)))
    assert {FLUX_STATES[code] for code in found["flux_state"]} == {state}
    assert np.isfinite(found["sensible_heat_flux"]).all() == (state == "free_convection")


def test_a_wavelength_that_nothing_is_known_of() -> None:
    found = derive(around(wavelength=10.6e-6))
    assert {FLUX_STATES[code] for code in found["flux_state"]} == {"no_index"}


def test_what_tells_day_from_night() -> None:
    def told(way: str | None, **values: float) -> int:
        return int(derive(around(weather(**values), parameters(stability=way)))["stability"])

    assert told(None, stability=2.0) == 1  # the series' own word comes first
    assert told("radiation", stability=2.0) == -1
    assert told(None, net_radiation=np.nan, global_radiation=300.0) == -1
    assert told(None, net_radiation=np.nan, global_radiation=0.0) == 1
    assert told("temperature", temperature_upper=290.0, temperature_lower=291.0) == -1
    assert told("stable") == 1
    assert told("temperature") == 0


def test_height_model_keeps_the_fried_parameter() -> None:
    found = derive(around())["cn2_height_model"]
    weights = fried_weights(GRID, 2670.0)
    assert weights @ found == pytest.approx(weights @ CN2, rel=1e-12)
    assert found * HEIGHTS ** (4 / 3) == pytest.approx(np.full(6, found[0] * 10 ** (4 / 3)), rel=1e-12)


def test_instruments() -> None:
    start = MINUTE * np.arange(4, dtype=np.int64)
    series = TimeSeries(start, start + MINUTE, {"cn2": np.array([1.0, 2.0, 3.0, 9.0]) * 1e-14}, "made")
    path = (2670.0, (0.05, 0.145), 0.88e-6)
    one = around(instruments=(Instrument("A", series, *path), Instrument("C", None, *path)))
    found = derive(one)
    assert found["cn2_scintillometer"][0] == pytest.approx(2e-14)
    assert found["cn2_scintillometer_standard_error"][0] == pytest.approx(1e-14 / np.sqrt(3))
    assert found["cn2_scintillometer_coverage"].tolist() == [1, 0]
    # 0.18 D^(5/3) lambda^(1/3) L^(-8/3) = 8.6e-15.
    assert found["scintillometer_saturated"].tolist() == [1, 0]
    assert found["scintillometer_log_amplitude_variance"][0] == pytest.approx(
        2e-14 * 2670.0**3 * 0.145 ** (-7 / 3) / 1.649, rel=1e-3
    )
    assert np.isnan(found["cn2_scintillometer"][1])


def test_statistics_of_a_product() -> None:
    def result(number: int, ratio: float) -> BatchResult:
        values = {
            "cn2_path_average": np.array([ratio * 1e-14 * (1 + number)]),
            "cn2_path_average_standard_error": np.array([1e-15]),
            "cn2_scintillometer": np.array([1e-14 * (1 + number)]),
            "cn2_scintillometer_standard_error": np.array([np.nan]),
        }
        return BatchResult(number * MINUTE, (number + 1) * MINUTE, values)

    results = [result(0, 1.2), result(1, 1.2), BatchResult(2 * MINUTE, 3 * MINUTE, {}), result(3, 1.2)]
    found = compared(results)
    assert {name for name in SCHEMA if name.startswith("comparison_")} == set(found)
    assert found["comparison_count"].tolist() == [3]
    assert found["comparison_ratio"] == pytest.approx([1.2])
    assert compared([BatchResult(0, MINUTE, {})]) == {}


def test_the_key_knows_what_changes_a_number() -> None:
    base = around().tracked()
    assert base == around().tracked()
    assert base == around(given=parameters(file="elsewhere.csv")).tracked()
    for other in (
        around(weather(pressure=0.96e5)),
        around(given=parameters(bowen_ratio=0.6)),
        around(heights=HEIGHTS + 1),
        around(instruments=(Instrument("A", weather(), 1.0, (1.0, 1.0), 1.0),)),
    ):
        assert other.tracked() != base


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"coefficients": "mine"}, "known: andreas-1988"),
        ({"wind_profile": "mine"}, "known: businger-1971"),
        ({"bowen_ratio": 0.0}, "not zero"),
        ({"stabilty": "stable"}, "Extra inputs"),
    ],
)
def test_faults_of_the_weather(changes: dict[str, object], fault: str) -> None:
    with pytest.raises(ValidationError, match=fault):
        parameters(**changes)


def test_faults_of_the_terrain() -> None:
    Terrain.model_validate({"file": "t.csv", "pupil_height": "3 m", "sources_elevation": "610 m"})
    for given in ({}, {"pupil_height": "3 m", "pupil_elevation": "600 m", "sources_height": "3 m"}):
        with pytest.raises(ValidationError, match="give either pupil_height"):
            Terrain.model_validate({"file": "t.csv"} | given)


def test_nothing_but_a_flag_is_nan_over_the_physical_range() -> None:
    rng = np.random.default_rng(11)
    for _ in range(60):
        series = weather(
            temperature=rng.uniform(250, 315), pressure=rng.uniform(0.6e5, 1.05e5), relative_humidity=rng.uniform(0, 1),
            wind_speed=rng.uniform(0.0, 15), net_radiation=rng.uniform(-100, 600),
        )  # fmt: skip
        cn2 = 10 ** rng.uniform(-17, -12, 6) * (rng.random(6) > 0.2)
        bowen = rng.choice([-3.0, -0.3, 0.1, 0.5, 5.0])
        found = around(series, parameters(bowen_ratio=float(bowen))).derive(cn2, None, 0, 3 * MINUTE)
        finite = np.isfinite(found["sensible_heat_flux"])
        solved = [FLUX_STATES[code] in ("converged", "free_convection") for code in found["flux_state"]]
        assert finite.tolist() == solved
        sign = found["sensible_heat_flux"][finite & (cn2 > 0)] * found["stability"]
        assert (sign < 0).all()
    assert FLUX_STATES[: len(surface_layer.STATES)] == surface_layer.STATES
