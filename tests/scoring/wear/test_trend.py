"""Trends per day in compressed time: their intervals hold, and limits are forecast only where that is possible."""

import numpy as np
import pytest

from fantwin.scoring.wear.trend import CAPACITY, NS_PER_DAY, LimitForecast, Trend, WearSeries, forecast_limit

START_NS = 1_700_000_000_000_000_000


def series(
    days: float, per_day: int, slope: float, seed: int, correlation: float = 0.0, error: float = 0.01
) -> WearSeries:
    """Points with noise of standard deviation `error`, correlated from one to the next."""
    rng = np.random.default_rng(seed)
    points = WearSeries([], [], [])
    noise = rng.normal()
    for k in range(int(days * per_day)):
        noise = correlation * noise + np.sqrt(1.0 - correlation**2) * rng.normal()
        points.add(START_NS + round(k / per_day * NS_PER_DAY), slope * k / per_day + error * noise, error)
    return points


def trend_of(points: WearSeries) -> Trend:
    trend = points.trend()
    assert trend is not None
    return trend


def times_of(forecast: LimitForecast) -> tuple[int, int, int]:
    assert forecast.earliest_ns is not None and forecast.likely_ns is not None and forecast.latest_ns is not None
    return forecast.earliest_ns, forecast.likely_ns, forecast.latest_ns


def test_without_a_trend_one_is_found_about_as_rarely_as_declared() -> None:
    trends = [series(10, 20, 0.0, seed, 0.8).trend() for seed in range(100)]
    reported = [trend for trend in trends if trend is not None]  # residuals correlated for too long give no trend
    assert len(reported) > 95
    assert np.mean([trend.significant for trend in reported]) <= 0.12


def test_the_interval_holds_the_true_slope() -> None:
    trends = [trend_of(series(10, 20, 0.004, seed, 0.7)) for seed in range(100)]
    assert 0.88 <= np.mean([trend.low <= 0.004 <= trend.high for trend in trends]) <= 1.0


def test_the_forecast_interval_contains_the_day_on_which_the_limit_is_reached() -> None:
    held = []
    for seed in range(60):
        forecast = forecast_limit(trend_of(series(20, 24, 0.003, seed, 0.5)), 0.12, START_NS + 20 * NS_PER_DAY)
        earliest_ns, _, latest_ns = times_of(forecast)
        held.append(earliest_ns <= START_NS + 40 * NS_PER_DAY <= latest_ns)
    assert np.mean(held) >= 0.88


def test_there_is_no_forecast_without_a_basis_for_one() -> None:
    now_ns = START_NS + 20 * NS_PER_DAY
    rising = trend_of(series(20, 24, 0.003, 3))
    assert "no significant trend" in forecast_limit(trend_of(series(20, 24, 0.0, 3)), 0.1, now_ns).unknown_reason
    assert "already reached" in forecast_limit(rising, 0.03, now_ns).unknown_reason
    assert "times as far ahead" in forecast_limit(rising, 3.0, now_ns).unknown_reason
    assert forecast_limit(rising, 0.1, now_ns).unknown_reason == ""


def test_a_third_of_wild_points_does_not_carry_the_slope_away() -> None:
    rng = np.random.default_rng(4)
    points = WearSeries([], [], [])
    for k in range(200):
        wild = 0.5 if rng.random() < 0.25 else 0.0
        points.add(START_NS + k * NS_PER_DAY // 10, 0.002 * k / 10 + wild * rng.normal() + 0.01 * rng.normal(), 0.01)
    assert trend_of(points).slope_per_day == pytest.approx(0.002, abs=0.0007)


def test_memory_is_bounded_and_merging_keeps_the_trend() -> None:
    points = series(100, 200, 0.001, 5)
    assert len(points) <= CAPACITY
    trend = trend_of(points)
    assert trend.significant and trend.low <= 0.001 <= trend.high
    assert trend.slope_per_day == pytest.approx(0.001, rel=0.02)
    assert points.std_error[0] == 0.01, "the points of a filter err alike"


def test_few_points_give_no_trend_and_those_that_are_no_numbers_or_come_again_are_left_out() -> None:
    assert WearSeries([], [], []).trend() is None
    assert series(1, 5, 0.1, 6).trend() is None
    points = WearSeries([], [], [])
    refused = ((START_NS, 2.0, 0.1), (START_NS - 1, 2.0, 0.1), (START_NS + 1, np.nan, 0.1), (START_NS + 2, 1.0, 0.0))
    assert points.add(START_NS, 1.0, 0.1) and not any(points.add(*point) for point in refused)
    assert points.value == [1.0]
