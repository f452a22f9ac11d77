"""scoring.calibration.calibration: limits keep the declared rate on fans of known residuals, and detect faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
import pytest

from schemas.messages import Array
from schemas.units import NS_PER_S
from scoring.calibration.alarm_rate import dispersion, poisson_interval, rate_interval
from scoring.calibration.calibration import TooLittleError, _with_alarms_at_most
from scoring.calibration.healthy_statistics import (
    HealthyRun,
    HealthyStatistics,
    MixedRatesError,
)
from scoring.calibration.tail import Tail
from scoring.calibration.windows import WindowMaxima, Windows, peaks
from scoring.detectors.detector import SingleLimit
from scoring.detectors.drift import DriftSettings
from scoring.detectors.table import rows
from scoring.detectors.tacho import TachoSettings
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits, Timing
from scoring.samples import Samples
from tests.support.calibrated_runs import MadeRuns, calibrate, statistics_of
from tests.support.healthy_residuals import STEP_NS, Raised, alarms_of, autoregressive, in_blocks, samples_of

TOP_RAD_S = 200.0
FANS, RUNS, RUN_SAMPLES = 40, 3, 5000
COARSE_NS = 5 * STEP_NS
"""a sampling period with a fifth of the samples, for claims that do not depend on it"""
MANY_FANS, SHORT_SAMPLES = 120, 1000
FAN_DAYS = MANY_FANS * RUNS * SHORT_SAMPLES * COARSE_NS / NS_PER_S / 86_400


def healthy(
    memory_s: float,
    seed: int,
    fans: int = FANS,
    runs: int = RUNS,
    samples: int = RUN_SAMPLES,
    period_ns: int = STEP_NS,
) -> MadeRuns:
    def each() -> Iterator[HealthyRun]:
        for run in range(runs):
            speed, balance = (
                autoregressive(samples, fans, memory_s, 1000 * seed + 2 * run + number, period_ns / NS_PER_S)
                for number in (0, 1)
            )
            yield HealthyRun(f"run {run}", fans, in_blocks(samples_of(speed, balance, period_ns=period_ns)))

    return each


def of_fans(block: Samples, fans: Array) -> Samples:
    """Some of the fans of a block."""
    columns = {field.name: getattr(block, field.name) for field in fields(block)}
    return replace(
        block, **{name: column[:, fans] for name, column in columns.items() if name not in ("t_ns", "period_ns")}
    )


def coarse_and_short(memory_s: float, seed: int, runs: int = RUNS) -> MadeRuns:
    """Five fan-hours at the least cost: the more fans and the fewer samples, the less there is to compute."""
    return healthy(memory_s, seed, MANY_FANS, runs, SHORT_SAMPLES, COARSE_NS)


@pytest.fixture(scope="module")
def white_limits() -> Limits:
    """Limits for white residuals, at about the lowest false alarm rate that two and a half fan-hours can support."""
    return calibrate(healthy(0.0, 1, fans=60), TOP_RAD_S, Timing(), 30.0)


def alarms_on_white(limits: Limits, seconds: float, shift: np.ndarray | float, fans: int = 4) -> list[Raised]:
    """Alarms on white residuals with `shift` added to those of the speed, (n, 1) or one for all."""
    samples = round(seconds * 100)
    speed, balance = autoregressive(samples, fans, 0.0, 50), autoregressive(samples, fans, 0.0, 51)
    return alarms_of(limits, in_blocks(samples_of(speed + shift, balance)), fans)


def limit_of(limits: Limits, name: str) -> float:
    settings = limits.detectors[name]
    assert isinstance(settings, SingleLimit)
    return settings.limit


def sensor_of(limits: Limits) -> TachoSettings:
    sensor = limits.settings_of("tacho", TachoSettings)
    assert sensor
    return sensor


# The declared rate


@pytest.mark.parametrize("memory_s", [0.0, 0.3, 3.0])
def test_fresh_healthy_fans_alarm_as_often_as_declared(memory_s: float) -> None:
    declared = 600.0
    limits = calibrate(coarse_and_short(memory_s, 2), TOP_RAD_S, Timing(), declared)
    assert limits.declared_rate is not None
    low, high = limits.declared_rate.interval_95
    assert 0.5 * declared < low < declared < high < 2.0 * declared
    assert not limits.declared_rate.extrapolated
    alarms = sum(len(alarms_of(limits, blocks, fans)) for _, fans, blocks, *_ in coarse_and_short(memory_s, 3)())
    fresh_low, fresh_high = (count / FAN_DAYS for count in poisson_interval(alarms))
    assert fresh_low < 1.25 * high
    assert fresh_high > 0.75 * low


def test_limits_from_what_is_left_beside_alarms_keep_the_rate_if_these_are_counted() -> None:
    declared = 600.0
    fresh = coarse_and_short(0.3, 3)
    limits = calibrate(coarse_and_short(0.3, 2), TOP_RAD_S, Timing(), declared)
    raised, left = 0, []
    for run in coarse_and_short(0.3, 4)():
        blocks = list(run.blocks)
        alarms = alarms_of(limits, blocks, run.fans)
        raised += len(alarms)
        without = np.setdiff1d(np.arange(run.fans), [alarm.fan for alarm in alarms])
        left.append(HealthyRun(run.name, len(without), [of_fans(block, without) for block in blocks]))
    assert raised > 0.6 * declared * FAN_DAYS
    rates = []
    for count in (0, raised):
        again = calibrate(lambda: left, TOP_RAD_S, Timing(), declared, alarms_left_out=count)
        alarms = sum(len(alarms_of(again, blocks, fans)) for _, fans, blocks, *_ in fresh())
        rates.append(alarms / FAN_DAYS)
    assert rates[0] > 1.5 * declared, "limits fall with each calibration on what the ones before left"
    assert rates[1] < 1.5 * declared


def test_correlation_time_and_deviation_of_healthy_residuals_are_found() -> None:
    for memory_s in (0.1, 1.0):
        limits = calibrate(healthy(memory_s, 4, 20, 1, 7500, 2 * STEP_NS), TOP_RAD_S, Timing(), 600.0)
        assert limits.speed.autocorrelation_time_s == pytest.approx(memory_s, rel=0.1)
        assert limits.speed.residual_std[0] == pytest.approx(1.0, rel=0.05)
        assert limits.balance.autocorrelation_time_s == pytest.approx(memory_s, rel=0.1)


def test_too_little_running_is_refused_with_the_amount_needed() -> None:
    with pytest.raises(TooLittleError) as caught:
        calibrate(healthy(0.0, 5, runs=1, samples=3000), TOP_RAD_S, Timing(), 1.0)
    had = FANS * 29.0 / 3600  # the first second commissions
    assert caught.value.fan_hours == pytest.approx(had)
    assert caught.value.needed_fan_hours == pytest.approx(72.0)
    assert caught.value.least_per_day == pytest.approx(3.0 * 24 / had)
    enough = calibrate(
        healthy(0.0, 5, runs=1, samples=3000), TOP_RAD_S, Timing(), min(1.01 * caught.value.least_per_day, 8640)
    )
    assert enough.declared_rate is not None
    assert not enough.declared_rate.extrapolated


def test_extrapolated_limits_say_so_and_lie_further_out() -> None:
    runs = healthy(0.0, 6, runs=2)
    near = calibrate(runs, TOP_RAD_S, Timing(), 600.0)
    far = calibrate(runs, TOP_RAD_S, Timing(), 1.0, extrapolate=True)
    assert far.declared_rate is not None
    assert far.declared_rate.extrapolated
    names = [name for name in near.detectors if name not in ("speed_drift", "sensor", "missing_readings")]
    assert len(names) == 5
    assert all(limit_of(far, name) > limit_of(near, name) for name in names)
    assert "speed_drift" not in far.detectors  # the residual at another speed is not known from so little


def test_few_data_in_which_fans_hardly_move_widen_limits_in_motion_as_if_the_twin_were_late() -> None:
    runs, period_s = healthy(0.0, 9), 0.01
    sigma_rad_s = 4.0
    far = calibrate(runs, TOP_RAD_S, Timing(), 1.0, extrapolate=True, sigma_rad_s=sigma_rad_s)
    scale_rad_s = far.speed.transient_scale_rad_s
    assert scale_rad_s is not None
    error_s = far.speed.mean_residual_std * sigma_rad_s / scale_rad_s
    assert error_s >= 0.2 + 0.5 * period_s - 1e-9
    enough = calibrate(runs, TOP_RAD_S, Timing(), 600.0, sigma_rad_s=sigma_rad_s)
    assert enough.speed == calibrate(runs, TOP_RAD_S, Timing(), 600.0).speed


def test_a_minute_of_one_fan_is_refused_even_with_extrapolate() -> None:
    with pytest.raises(TooLittleError):
        calibrate(healthy(0.0, 7, fans=1, runs=1, samples=3000), TOP_RAD_S, Timing(), 600.0, extrapolate=True)


def test_what_a_fan_has_run_counts_and_not_how_many_fans_there_are() -> None:
    """Of 20 s of four fans, limits came out at 0.6 of those from 15 minutes, or there was no value for one at all."""
    with pytest.raises(TooLittleError):
        calibrate(healthy(0.0, 7, fans=4, runs=1, samples=5000), TOP_RAD_S, Timing(), 1.0, extrapolate=True)
    enough = calibrate(healthy(0.0, 7, fans=4, runs=2, samples=5000), TOP_RAD_S, Timing(), 1.0, extrapolate=True)
    assert enough.declared_rate is not None
    assert enough.declared_rate.extrapolated


def test_the_same_seed_gives_the_same_limits() -> None:
    runs = healthy(0.0, 8, runs=1)
    assert calibrate(runs, TOP_RAD_S, Timing(), 600.0) == calibrate(runs, TOP_RAD_S, Timing(), 600.0)


def test_the_limit_of_repeated_readings_allows_for_a_coarse_healthy_tacho() -> None:
    def coarse() -> Iterator[HealthyRun]:
        for name, fans, blocks, *_ in healthy(0.0, 9, runs=1)():
            made = list(blocks)
            made[5].speed_rad_s[50:250, 3] = 77.0  # 2 s
            yield HealthyRun(name, fans, made)

    limits = calibrate(coarse, TOP_RAD_S, Timing(), 600.0)
    assert sensor_of(limits).stuck_s == pytest.approx(3 * 1.99)


def test_the_limit_of_missing_readings_stays_below_a_dead_tacho() -> None:
    def misses() -> Iterator[HealthyRun]:
        for name, fans, blocks, *_ in healthy(0.0, 10, runs=1)():
            made = list(blocks)
            for number, block in enumerate(made):
                block.missing[number % 2 :: 2, 3] = True
            yield HealthyRun(name, fans, made)

    limits = calibrate(misses, TOP_RAD_S, Timing(), 600.0)
    assert 0.5 < sensor_of(limits).missing_share < 1.0


# Differences between days


def days(
    seed: int,
    power: int,
    runs: int,
    fans: int = 30,
    seconds: int = 50,
    period_ns: int = STEP_NS,
    wrong_sigmas: float = 0.0,
    known_as: range | None = None,
) -> MadeRuns:
    """Runs in which speeds hold for ten seconds each; on every day the speed is off by a share, or by a constant.

    wrong_sigmas: the twin is wrong by about so much, of each fan otherwise at each speed.
    """
    held = 10 * NS_PER_S // period_ns
    samples = seconds // 10 * held
    wrong = wrong_sigmas * np.random.default_rng(5).normal(size=(5, fans))

    def each() -> Iterator[HealthyRun]:
        for run in range(runs):
            rng = np.random.default_rng(1000 * seed + run)
            levels = np.repeat(rng.uniform(40.0, 180.0, (seconds // 10, fans)), held, axis=0)
            off = 2.0 * rng.normal() * (levels / 100.0) ** power
            for fan in range(fans):
                off[:, fan] += np.interp(levels[:, fan], np.linspace(40.0, 180.0, 5), wrong[:, fan])
            speed = autoregressive(samples, fans, 0.0, 2000 * seed + 2 * run) + off
            balance = autoregressive(samples, fans, 0.0, 2000 * seed + 2 * run + 1)
            made = samples_of(speed, balance, period_ns=period_ns)
            blocks = in_blocks(replace(made, speed_rad_s=levels + 1e-6 * made.speed_rad_s))
            yield HealthyRun(f"run {run}", fans, blocks, known_as)

    return each


@pytest.fixture(scope="module")
def limits_of_days() -> dict[int, Limits]:
    """By the power with which offsets go with the speed."""
    return {power: calibrate(days(20, power, 4), TOP_RAD_S, Timing(), 60.0) for power in (0, 1)}


@pytest.mark.parametrize("power", [0, 1])
def test_it_is_found_whether_the_differences_between_days_change_with_the_speed(
    limits_of_days: dict[int, Limits], power: int
) -> None:
    limits = limits_of_days[power]
    assert limits.speed.baseline.speed_exponent == power
    assert (
        limit_of(limits, "speed_smoothed") * 0.16 < 1.0
    )  # sigma: baselines follow the day, limits need not allow for it
    assert limits.balance.baseline.speed_exponent == 0


def test_another_day_raises_no_alarm_at_other_speeds_and_a_fault_does(
    limits_of_days: dict[int, Limits],
) -> None:
    limits = limits_of_days[1]
    fresh = list(days(21, 1, 3)())
    assert sum(len(alarms_of(limits, blocks, fans)) for _, fans, blocks, *_ in fresh) <= 5  # two are declared
    _, fans, blocks, *_ = next(iter(days(22, 1, 1)()))
    late = [
        replace(b, speed_residual=b.speed_residual + 1.5 * (b.t_ns >= 30_000_000_000)[:, np.newaxis]) for b in blocks
    ]
    found = {alarm.fan for alarm in alarms_of(limits, late, fans) if alarm.t_s >= 30.0}
    assert found == set(range(fans))


def test_errors_of_the_twin_are_learned_for_each_fan_that_it_knows() -> None:
    unknown, known = (
        calibrate(days(23, 0, runs, 20, 60, COARSE_NS, wrong_sigmas=1.0, known_as=fans), TOP_RAD_S, Timing(), 60.0)
        for runs, fans in ((4, None), (12, range(20)))
    )
    assert unknown.speed.fan_offsets is None
    assert known.speed.fan_offsets is not None
    assert len(known.speed.fan_offsets.offset_sigmas) == 20
    assert known.speed.baseline.adaptation_limit_sigmas < 0.65 * unknown.speed.baseline.adaptation_limit_sigmas
    assert np.abs(known.speed.expected_residual_sigmas).max() < 0.3, "the offsets of the fans are not counted twice"
    assert known.speed.mean_residual_std < unknown.speed.mean_residual_std - 0.05
    fresh = list(days(24, 0, 3, 20, 60, COARSE_NS, wrong_sigmas=1.0)())
    assert sum(len(alarms_of(known, blocks, fans)) for _, fans, blocks, *_ in fresh) <= 7  # three are declared
    with pytest.raises(ValueError, match="limits of 20 fans for 3"):
        FanScorer(3, known)
    assert known.of(range(2, 5)).speed.fan_offsets == known.speed.fan_offsets.of(range(2, 5))
    assert known.of(None).speed.fan_offsets is None


def test_the_recordings_themselves_have_no_more_alarms_than_declared() -> None:
    # One fan goes much further than a tail of all would say, in every second run.
    runs = days(25, 0, 8, fans=10, seconds=60, period_ns=COARSE_NS)

    def with_one_that_strays() -> Iterator[HealthyRun]:
        for number, (name, fans, blocks, known_as, *_) in enumerate(runs()):
            strays = np.where((np.arange(fans) == 3) & (number % 2 == 0), 4.0, 0.0)
            late = [
                replace(b, speed_residual=b.speed_residual + strays * ((b.t_ns // 10_000_000_000) == 5)[:, np.newaxis])
                for b in blocks
            ]
            yield HealthyRun(name, fans, late, known_as)

    declared = 60.0
    limits = calibrate(with_one_that_strays, TOP_RAD_S, Timing(), declared)
    alarms = sum(len(alarms_of(limits, blocks, fans)) for _, fans, blocks, *_ in with_one_that_strays())
    assert alarms <= declared * 8 * 60.0 * 10 / 86_400.0


def test_the_tacho_has_its_own_limits_and_widens_no_others() -> None:
    # The row of the tacho is beyond its limit all the time: no factor of the others can help that.
    names = [row.name for row in rows()]
    maxima, ones = np.full((20, len(names), 3), 0.5), np.ones(len(names))
    maxima[::3, names.index("sensor")] = 1.5
    found = HealthyStatistics(TOP_RAD_S, maxima=[WindowMaxima(maxima, maxima.max(axis=1))])
    np.testing.assert_array_equal(_with_alarms_at_most(found, ones, 0), ones)
    maxima[::4, names.index("speed_variance_growth"), 1] = 3.0
    expected = np.where(np.array(names) == "speed_variance_growth", 3.0, 1.0)
    np.testing.assert_allclose(_with_alarms_at_most(found, ones, 0), expected)


# Alarms at these limits


@pytest.mark.parametrize(("size", "within_s"), [(3.0, 0.25), (1.5, 0.5), (0.5, 10.0)])
def test_a_step_is_found_the_faster_the_larger_it_is(white_limits: Limits, size: float, within_s: float) -> None:
    step = np.where(np.arange(9000) < 6000, 0.0, size)[:, np.newaxis]
    alarms = alarms_on_white(white_limits, 90.0, step)
    assert {alarm.fan for alarm in alarms} == {0, 1, 2, 3}
    assert all(60.0 <= alarm.t_s <= 60.0 + within_s for alarm in alarms)


def test_one_outlier_raises_no_alarm(white_limits: Limits) -> None:
    wild = np.zeros((9000, 1))
    wild[[3000, 5000, 7000]] = [[1e6], [-50.0], [12.0]]
    assert alarms_on_white(white_limits, 90.0, wild) == []


def test_a_run_alarms_if_it_starts_with_an_offset_beyond_healthy_ones(white_limits: Limits) -> None:
    commissioning_limit = white_limits.speed.baseline.commissioning_limit_sigmas
    assert alarms_on_white(white_limits, 60.0, 0.9 * commissioning_limit) == []
    alarms = alarms_on_white(white_limits, 60.0, commissioning_limit + 2.0)
    assert {alarm.fan for alarm in alarms} == {0, 1, 2, 3}
    assert max(alarm.t_s for alarm in alarms[:4]) < 2.0


def test_slow_wear_is_followed_for_a_while_and_then_alarms(white_limits: Limits) -> None:
    per_s = 3e-4
    farthest = white_limits.speed.baseline.adaptation_limit_sigmas
    seconds = farthest / per_s
    samples, fans = round(seconds * 100), 2
    wear = per_s * np.arange(samples)[:, np.newaxis] / 100
    speed = autoregressive(samples, fans, 0.0, 60) + wear
    blocks = in_blocks(samples_of(speed, autoregressive(samples, fans, 0.0, 61)))
    scorer = FanScorer(fans, white_limits)
    alarms = alarms_of(white_limits, blocks, fans, scorer)
    assert {alarm.fan for alarm in alarms} == {0, 1}
    first_s = [min(alarm.t_s for alarm in alarms if alarm.fan == fan) for fan in range(fans)]
    assert min(first_s) > 0.5 * farthest / per_s  # not at once: the baseline follows, and lags
    baseline = scorer.residuals["speed"].baseline
    followed = np.abs(baseline.value - baseline.commissioned)
    assert 0.2 * farthest < followed.min()
    assert followed.max() <= farthest


# The parts


@pytest.mark.parametrize("probability", [1e-2, 1e-4])
def test_the_tail_of_exponential_values_is_found_and_extrapolated(probability: float) -> None:
    levels = []
    for seed in range(40):
        values = np.random.default_rng(seed).exponential(2.0, 2000) + 5.0
        levels.append(Tail.fit(values, probability).level(probability))
    assert np.mean(levels) == pytest.approx(5.0 - 2.0 * np.log(probability), rel=0.03)


def test_the_level_of_a_normal_tail_errs_on_the_high_side() -> None:
    levels = [Tail.fit(np.random.default_rng(seed).normal(size=2000), 1e-5).level(1e-5) for seed in range(40)]
    assert 4.26 < np.mean(levels) < 6.0  # 4.26 is exact


def test_a_level_that_ten_values_are_above_needs_no_model() -> None:
    values = np.random.default_rng(1).uniform(size=1000)
    level = Tail.fit(values, 0.05).level(0.05)
    assert (values > level).sum() == 50


@pytest.mark.parametrize("probability", [0.5, 0.9])
def test_a_level_of_common_values_is_within_them(probability: float) -> None:
    values = np.random.default_rng(2).uniform(size=30)
    assert 0.0 < Tail.fit(values, probability).level(probability) < 1.0


def test_the_interval_of_a_rate_covers_it_as_often_as_it_says() -> None:
    rng = np.random.default_rng(3)
    covered = 0
    for seed in range(300):
        low, high = rate_interval(rng.poisson(0.6, 10).astype(float), np.full(10, 2.0), seed)
        covered += low <= 0.3 <= high
    assert covered / 300 > 0.93


def test_alarms_that_come_together_widen_the_interval_and_none_gives_an_upper_end() -> None:
    exposures = np.ones(10)
    spread, together = np.ones(10), np.array([10.0] + [0.0] * 9)
    assert dispersion(spread, exposures, 1) == 1.0
    assert dispersion(together, exposures, 1) > 4.0
    narrow, wide = rate_interval(spread, exposures, 1), rate_interval(together, exposures, 1)
    assert wide[0] < narrow[0] < 1.0 < narrow[1] < wide[1]
    assert rate_interval(np.zeros(10), exposures, 1) == (0.0, pytest.approx(0.369, abs=0.001))


def test_a_window_counts_the_score_held_for_the_on_delay_regardless_of_how_blocks_are_cut() -> None:
    score = np.zeros((2500, 1))
    score[500:511] = 3.0  # eleven samples last 0.1 s
    score[700:705] = 9.0
    score[995:1004] = 5.0  # too short, and over the edge of the window
    judged = np.ones((2500, 1), np.bool_)
    score[1500:1520], judged[1505:1514] = 7.0, False  # eleven that are judged
    ratios = np.zeros((7, 2500, 1))
    ratios[2] = score
    t_ns = 10_000_000 * np.arange(2500)
    for block in (1, 7, 2500):
        windows = Windows(1, len(ratios), 0.1)
        for row in range(0, 2500, block):
            rows = slice(row, row + block)
            windows.add(t_ns[rows], 10_000_000, ratios[:, rows], judged[rows])
        maxima = windows.end()
        np.testing.assert_array_equal(maxima.score[:, 0], [3.0, 7.0, 0.0])
        np.testing.assert_array_equal(maxima.statistics[:, 2, 0], maxima.score[:, 0])
        assert maxima.statistics[:, 0].max() == 0.0


def test_an_excursion_over_several_windows_counts_once() -> None:
    maxima = np.array([[0.2, 3.0], [2.0, np.nan], [5.0, 3.0], [5.0, 0.1], [0.1, 4.0]])
    np.testing.assert_array_equal(peaks(maxima), [[0.0, 3.0], [0.0, np.nan], [5.0, 3.0], [0.0, 0.0], [0.0, 4.0]])


def test_only_samples_with_a_score_are_counted(white_limits: Limits) -> None:
    found = statistics_of(healthy(0.0, 11, fans=2, runs=2, samples=2500), white_limits, TOP_RAD_S)
    assert found.fan_s == pytest.approx(2 * 2 * 24.0)
    assert found.windows == 2 * 2 * 3


def test_runs_of_different_rates_are_refused_with_their_names() -> None:
    def mixed() -> Iterator[HealthyRun]:
        for run, period_ns in (("fast", 10_000_000), ("slow", 20_000_000)):
            speed, balance = (autoregressive(10_000, 4, 0.0, seed) for seed in (1, 2))
            yield HealthyRun(run, 4, in_blocks(samples_of(speed, balance, period_ns=period_ns)))

    with pytest.raises(MixedRatesError) as refused:
        calibrate(mixed, TOP_RAD_S, Timing(), 600.0)
    assert (refused.value.first, refused.value.other) == (("fast", 10_000_000), ("slow", 20_000_000))


def test_the_drift_of_runs_at_another_rate_is_in_deviations_at_that_rate() -> None:
    def slow() -> Iterator[HealthyRun]:
        for run in healthy(0.0, 12, runs=1)():
            blocks = [replace(block, period_ns=2 * block.period_ns, t_ns=2 * block.t_ns) for block in run.blocks]
            yield run._replace(blocks=blocks)

    drift = calibrate(slow, TOP_RAD_S, Timing(), 600.0).settings_of("speed", DriftSettings)
    assert drift and drift.period_s == 0.02
