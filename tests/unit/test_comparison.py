"""Comparison of two series: a published worked example, closed forms, and draws whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from coslidar.pipeline.comparison import compare, fit_line, on_windows
from coslidar.pipeline.timeseries import TimeSeries, joined, regular_windows

MINUTE = 60 * 10**9


def test_the_data_of_pearson_and_york() -> None:
    # Pearson's data (1901) with York's weights (1966); York et al. 2004 print the answer in Table II.
    x = np.array([0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4])
    y = np.array([5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5])
    wx = np.array([1000, 1000, 500, 800, 200, 80, 60, 20, 1.8, 1.0])
    wy = np.array([1, 1.8, 4, 8, 20, 20, 70, 70, 100, 500.0])
    line = fit_line(x, y, wx**-0.5, wy**-0.5)
    assert line.intercept == pytest.approx(5.47991022, rel=1e-8)
    assert line.slope == pytest.approx(-0.480533407, rel=1e-8)
    assert line.chi2 == pytest.approx(11.8663532, rel=1e-8)
    # York 1966 prints 0.29497 and 0.05799 for errors at the observed points; at the adjusted ones they are 0.6 % less.
    assert line.intercept_error == pytest.approx(0.295, rel=0.02)
    assert line.slope_error == pytest.approx(0.058, rel=0.02)


def test_a_line_with_errors_in_one_coordinate() -> None:
    rng = np.random.default_rng(1)
    x = np.linspace(0, 1, 20)
    y = 1 + 2 * x + 0.1 * rng.standard_normal(20)
    line = fit_line(x, y, np.zeros(20), np.full(20, 0.1))
    slope, intercept = np.polyfit(x, y, 1)
    assert [line.slope, line.intercept] == pytest.approx([slope, intercept], rel=1e-10)
    assert line.slope_error == pytest.approx(0.1 / np.sqrt(((x - x.mean()) ** 2).sum()), rel=1e-10)


def test_equal_series_and_factors() -> None:
    cn2 = 10.0 ** np.linspace(-15, -13, 30)
    none = np.zeros(30)
    same = compare(cn2, none, cn2, none)
    assert (same.ratio, same.bias, same.correlation) == pytest.approx((1, 0, 1), abs=1e-12)
    assert same.slope == pytest.approx(1, rel=1e-9)
    more = compare(1.2 * cn2, none, cn2, none)
    assert more.ratio == pytest.approx(1.2, rel=1e-12)
    assert more.offset == pytest.approx(np.log10(1.2), rel=1e-6)
    assert more.bias == pytest.approx(0.2 * cn2.mean(), rel=1e-12)
    assert more.scatter == pytest.approx(0, abs=1e-12)


def test_scatter_is_what_the_errors_make_it() -> None:
    rng = np.random.default_rng(7)
    n = 4000
    truth = 10 ** rng.uniform(-15, -13, n)
    ours, theirs = truth * (1 + 0.05 * rng.standard_normal(n)), truth * (1 + 0.12 * rng.standard_normal(n))
    found = compare(ours, 0.05 * truth, theirs, 0.12 * truth)
    # Chance: 1 / sqrt(2 n) = 1.1 %; the logarithm's second order: 2 %.
    assert found.scatter == pytest.approx(0.13, rel=0.05)
    assert found.expected_scatter == pytest.approx(found.scatter, rel=0.05)
    assert abs(found.slope - 1) < 4 * found.slope_error
    assert found.slope_error == pytest.approx(0.13 / np.log(10) / np.sqrt(n) / np.std(np.log10(truth)), rel=0.05)
    assert abs(np.log(found.ratio)) < 5 * found.ratio_error + 0.12**2 / 2


def test_too_few() -> None:
    nan = np.array([np.nan])
    assert compare(nan, nan, np.array([1e-14]), nan).count == 0
    assert np.isnan(compare(nan, nan, np.array([1e-14]), nan).ratio)
    one = compare(np.array([2e-14]), np.array([2e-15]), np.array([1e-14]), nan)
    assert (one.count, one.ratio) == (1, pytest.approx(2))
    assert one.ratio_error == pytest.approx(0.2)
    assert np.isnan(fit_line(np.ones(3), np.arange(3.0), np.ones(3), np.ones(3)).slope)


def series(values: list[float], start: int = 0, step: int = MINUTE) -> TimeSeries:
    at = start + step * np.arange(len(values), dtype=np.int64)
    return TimeSeries(at, at + step, {"cn2": np.array(values)}, "made")


def test_windows_weight_by_time() -> None:
    made = series([1.0, 2.0, 3.0, 4.0])
    half = np.array([[0, 2 * MINUTE], [MINUTE // 2, 2 * MINUTE + MINUTE // 2]])
    found = made.mean_over(half, "cn2")
    assert found.mean == pytest.approx([1.5, (0.5 * 1 + 2 + 0.5 * 3) / 2])
    assert found.coverage == pytest.approx([1, 1])
    assert found.count.tolist() == [2, 3]
    # Two values: half their difference is the standard error of their mean.
    assert found.error[0] == pytest.approx(0.5)


def test_gaps_and_their_limit() -> None:
    made = series([1.0, np.nan, np.nan, 4.0, 5.0])
    windows = regular_windows(0, 5 * MINUTE, 3 * MINUTE)
    assert windows.tolist() == [[0, 3 * MINUTE], [3 * MINUTE, 6 * MINUTE]]
    found = made.mean_over(windows, "cn2")
    assert found.coverage == pytest.approx([1 / 3, 2 / 3])
    assert np.isnan(found.mean[0])
    assert found.mean[1] == pytest.approx(4.5)
    assert made.mean_over(windows, "cn2", coverage=0.3).mean[0] == pytest.approx(1)
    assert np.isnan(made.mean_over(windows, "ct2").mean).all()


def test_means_of_values_with_errors() -> None:
    bounds = MINUTE * np.array([[0, 3], [3, 6], [6, 9], [20, 23]])
    found = on_windows(bounds, np.array([1.0, 3.0, 8.0, 5.0]), np.array([0.1, 0.2, 0.1, 0.3]),
                       MINUTE * np.array([[0, 6], [6, 12], [9, 15]]))  # fmt: skip
    assert found.mean[:2] == pytest.approx([2, 8])
    assert found.error[:2] == pytest.approx([np.hypot(0.1, 0.2) / 2, 0.1])
    assert np.isnan(found.mean[2])
    assert found.count.tolist() == [2, 1, 0]


def test_windows_before_1970() -> None:
    assert regular_windows(-5, 5, 10).tolist() == [[-10, 0], [0, 10]]


def test_series_that_overlap() -> None:
    with pytest.raises(ValueError, match="without overlap"):
        TimeSeries(np.array([0, 5]), np.array([10, 15]), {}, "made")
    # The same interval in two files counts once.
    both = joined([series([1.0, 2.0]), series([9.0, 3.0], start=MINUTE)], "both")
    assert both.values["cn2"].tolist() == [1.0, 2.0, 3.0]
    assert len(both.within(MINUTE, 2 * MINUTE)) == 1
    assert both.digest(["cn2"]) != series([1.0, 2.0]).digest(["cn2"])
    assert series([1.0]).digest(["cn2"]) == series([1.0]).digest(["cn2", "ct2"])
