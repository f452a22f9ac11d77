"""scoring.calibration.calibration: limits keep the declared rate on fans of known residuals, and detect faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

from schemas.messages import Array
from schemas.units import NS_PER_S
from scoring.calibration.alarm_rate import dispersion, poisson_interval, rate_interval
from scoring.calibration.calibration import TooLittleError
from scoring.calibration.healthy_statistics import HealthyRun, MixedRatesError
from scoring.calibration.tail import Tail
from scoring.calibration.windows import Windows
from scoring.detectors.detector import SingleLimit
from scoring.detectors.deviation import smoothed_deviation
from scoring.detectors.drift import DriftSettings
from scoring.detectors.tacho import TachoSettings
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits, Timing
from scoring.samples import Samples
from tests.support.calibrated_runs import MadeRuns, calibrate, statistics_of
from tests.support.healthy_residuals import Raised, alarms_of, autoregressive, in_blocks, samples_of

TOP_RAD_S = 200.0
PERIOD_NS = 50_000_000
PER_S = NS_PER_S // PERIOD_NS
RUNS, SAMPLES = 2, 50 * PER_S
FANS = 120
"""three fan-hours at the least cost: the more fans and the fewer samples, the less there is to compute"""
FAN_DAYS = FANS * RUNS * SAMPLES / PER_S / 86_400
DECLARED = 600.0


def healthy(memory_s: float, seed: int, fans: int = FANS, runs: int = RUNS, samples: int = SAMPLES) -> MadeRuns:
    def each() -> Iterator[HealthyRun]:
        for run in range(runs):
            speed, balance = (
                autoregressive(samples, fans, memory_s, 1000 * seed + 2 * run + number, 1.0 / PER_S)
                for number in (0, 1)
            )
            yield HealthyRun(f"run {run}", fans, in_blocks(samples_of(speed, balance, period_ns=PERIOD_NS)))

    return each


def of_fans(block: Samples, fans: Array) -> Samples:
    """Some of the fans of a block."""
    columns = {field.name: getattr(block, field.name) for field in fields(block)}
    return replace(
        block, **{name: column[:, fans] for name, column in columns.items() if name not in ("t_ns", "period_ns")}
    )


@cache
def limits_of(memory_s: float) -> Limits:
    return calibrate(healthy(memory_s, 2), TOP_RAD_S, Timing(), DECLARED)


@pytest.fixture(scope="module")
def white_limits() -> Limits:
    """Limits for white residuals, at about the lowest false alarm rate that two and a half fan-hours can support."""
    return calibrate(healthy(0.0, 1, fans=60, runs=3), TOP_RAD_S, Timing(), 30.0)


def alarms_on_white(limits: Limits, seconds: float, shift: np.ndarray | float, fans: int = 4) -> list[Raised]:
    """Alarms on white residuals with `shift` added to those of the speed, (n, 1) or one for all."""
    samples = round(seconds * PER_S)
    speed, balance = autoregressive(samples, fans, 0.0, 50), autoregressive(samples, fans, 0.0, 51)
    return alarms_of(limits, in_blocks(samples_of(speed + shift, balance, period_ns=PERIOD_NS)), fans)


def count_alarms(limits: Limits, runs: MadeRuns) -> int:
    return sum(len(alarms_of(limits, run.blocks, run.fans)) for run in runs())


def limit_of(limits: Limits, name: str) -> float:
    settings = limits.detectors[name]
    assert isinstance(settings, SingleLimit)
    return settings.limit


# The declared rate


@pytest.mark.parametrize("memory_s", [0.3, 3.0])
def test_fresh_healthy_fans_alarm_as_often_as_declared(memory_s: float) -> None:
    limits = limits_of(memory_s)
    assert limits.declared_rate is not None
    low, high = limits.declared_rate.interval_95
    assert 0.5 * DECLARED < low < DECLARED < high < 2.0 * DECLARED
    assert not limits.declared_rate.extrapolated
    fresh_low, fresh_high = (count / FAN_DAYS for count in poisson_interval(count_alarms(limits, healthy(memory_s, 3))))
    assert fresh_low < 1.25 * high
    assert fresh_high > 0.75 * low


def test_limits_are_in_deviations_of_the_healthy_residuals_at_the_rate_of_the_runs() -> None:
    limits = limits_of(0.3)
    for residual in (limits.speed, limits.balance):
        assert residual.autocorrelation_time_s == pytest.approx(0.3, rel=0.1)
        assert residual.residual_std[0] == pytest.approx(1.0, rel=0.05)
    drift = limits.settings_of("speed", DriftSettings)
    assert drift and drift.period_s == 1.0 / PER_S


def test_limits_from_what_is_left_beside_alarms_keep_the_rate_if_these_are_counted() -> None:
    fresh = healthy(0.3, 3)
    raised, left = 0, []
    for run in healthy(0.3, 4)():
        blocks = list(run.blocks)
        alarms = alarms_of(limits_of(0.3), blocks, run.fans)
        raised += len(alarms)
        without = np.setdiff1d(np.arange(run.fans), [alarm.fan for alarm in alarms])
        left.append(HealthyRun(run.name, len(without), [of_fans(block, without) for block in blocks]))
    assert raised > 0.6 * DECLARED * FAN_DAYS
    forgotten, counted = (
        calibrate(lambda: left, TOP_RAD_S, Timing(), DECLARED, alarms_left_out=count) for count in (0, raised)
    )
    assert count_alarms(forgotten, fresh) > 1.5 * DECLARED * FAN_DAYS, "each calibration lowers the limits"
    assert count_alarms(counted, fresh) < 1.5 * DECLARED * FAN_DAYS


def test_too_little_running_is_refused_with_the_amount_needed() -> None:
    short = healthy(0.0, 5, fans=40, runs=1, samples=30 * PER_S)
    with pytest.raises(TooLittleError) as caught:
        calibrate(short, TOP_RAD_S, Timing(), 1.0)
    had = 40 * 29.0 / 3600  # the first second commissions
    assert caught.value.fan_hours == pytest.approx(had)
    assert caught.value.needed_fan_hours == pytest.approx(72.0)
    assert caught.value.least_per_day == pytest.approx(3.0 * 24 / had)
    enough = calibrate(short, TOP_RAD_S, Timing(), min(1.01 * caught.value.least_per_day, 8640))
    assert enough.declared_rate is not None
    assert not enough.declared_rate.extrapolated


def test_limits_from_few_data_say_so_lie_further_out_and_widen_in_motion_as_if_the_twin_were_late() -> None:
    runs, sigma_rad_s = healthy(0.0, 6, fans=40, runs=2), 4.0
    near = calibrate(runs, TOP_RAD_S, Timing(), DECLARED, sigma_rad_s=sigma_rad_s)
    assert near.speed == calibrate(runs, TOP_RAD_S, Timing(), DECLARED).speed
    far = calibrate(runs, TOP_RAD_S, Timing(), 1.0, extrapolate=True, sigma_rad_s=sigma_rad_s)
    assert far.declared_rate is not None
    assert far.declared_rate.extrapolated
    names = [name for name in near.detectors if name not in ("speed_drift", "sensor", "missing_readings")]
    assert len(names) == 5
    assert all(limit_of(far, name) > limit_of(near, name) for name in names)
    assert "speed_drift" not in far.detectors  # the residual at another speed is not known from so little
    scale_rad_s = far.speed.transient_scale_rad_s
    assert scale_rad_s is not None
    error_s = far.speed.mean_residual_std * sigma_rad_s / scale_rad_s
    assert error_s >= 0.2 + 0.5 / PER_S - 1e-9


def test_what_a_fan_has_run_counts_and_not_how_many_fans_there_are() -> None:
    """Of 20 s of four fans, limits came out at 0.6 of those from 15 minutes, or there was no value for one at all."""
    for too_few in (healthy(0.0, 7, fans=1, runs=1), healthy(0.0, 7, fans=4, runs=1)):
        with pytest.raises(TooLittleError):
            calibrate(too_few, TOP_RAD_S, Timing(), 1.0, extrapolate=True)
    enough = calibrate(healthy(0.0, 7, fans=4, runs=2), TOP_RAD_S, Timing(), 1.0, extrapolate=True)
    assert enough.declared_rate is not None
    assert enough.declared_rate.extrapolated


def test_limits_of_the_tacho_allow_for_a_coarse_one_and_stay_below_a_dead_one() -> None:
    def coarse_or_bad() -> Iterator[HealthyRun]:
        for name, fans, blocks, *_ in healthy(0.0, 9, fans=20, runs=1)():
            made = list(blocks)
            made[0].speed_rad_s[100 : 100 + 2 * PER_S, 3] = 77.0
            for number, block in enumerate(made):
                block.missing[number % 2 :: 2, 4] = True
            yield HealthyRun(name, fans, made)

    tacho = calibrate(coarse_or_bad, TOP_RAD_S, Timing(), DECLARED).settings_of("tacho", TachoSettings)
    assert tacho
    assert tacho.stuck_s == pytest.approx(3 * (2.0 - 1.0 / PER_S))
    assert 0.5 < tacho.missing_share < 1.0


# Differences between days


def days(
    seed: int,
    power: int,
    runs: int,
    fans: int = 20,
    seconds: int = 50,
    wrong_sigmas: float = 0.0,
    known_as: range | None = None,
) -> MadeRuns:
    """Runs in which speeds hold for ten seconds each; on every day the speed is off by a share, or by a constant.

    wrong_sigmas: the twin is wrong by about so much, of each fan otherwise at each speed.
    """
    held = 10 * PER_S
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
            made = samples_of(speed, balance, period_ns=PERIOD_NS)
            blocks = in_blocks(replace(made, speed_rad_s=levels + 1e-6 * made.speed_rad_s))
            yield HealthyRun(f"run {run}", fans, blocks, known_as)

    return each


@pytest.fixture(scope="module")
def limits_of_days() -> dict[int, Limits]:
    """By the power with which offsets go with the speed."""
    return {power: calibrate(days(20, power, 4), TOP_RAD_S, Timing(), 90.0) for power in (0, 1)}


@pytest.mark.parametrize("power", [0, 1])
def test_it_is_found_whether_the_differences_between_days_change_with_the_speed(
    limits_of_days: dict[int, Limits], power: int
) -> None:
    limits = limits_of_days[power]
    assert limits.speed.baseline.speed_exponent == power
    smoothed = limit_of(limits, "speed_smoothed") * smoothed_deviation(0.2, 0.0, 1.0 / PER_S)
    assert smoothed < 2.0, "sigma, as days differ: baselines follow them, limits need not allow for them"
    assert limits.balance.baseline.speed_exponent == 0


def test_another_day_raises_no_alarm_at_other_speeds_and_a_fault_does(
    limits_of_days: dict[int, Limits],
) -> None:
    limits = limits_of_days[1]
    assert count_alarms(limits, days(21, 1, 3)) <= 7  # three are declared
    _, fans, blocks, *_ = next(iter(days(22, 1, 1)()))
    late = [
        replace(b, speed_residual=b.speed_residual + 2.5 * (b.t_ns >= 30_000_000_000)[:, np.newaxis]) for b in blocks
    ]
    found = {alarm.fan for alarm in alarms_of(limits, late, fans) if alarm.t_s >= 30.0}
    assert found == set(range(fans))


def test_errors_of_the_twin_are_learned_for_each_fan_that_it_knows() -> None:
    unknown, known = (
        calibrate(days(23, 0, runs, 10, 60, wrong_sigmas=1.0, known_as=fans), TOP_RAD_S, Timing(), 120.0)
        for runs, fans in ((4, None), (12, range(10)))
    )
    assert unknown.speed.fan_offsets is None
    assert known.speed.fan_offsets is not None
    assert len(known.speed.fan_offsets.offset_sigmas) == 10
    assert known.speed.baseline.adaptation_limit_sigmas < 0.65 * unknown.speed.baseline.adaptation_limit_sigmas
    assert np.abs(known.speed.expected_residual_sigmas).max() < 0.3, "the offsets of the fans are not counted twice"
    assert known.speed.mean_residual_std < unknown.speed.mean_residual_std - 0.05
    assert count_alarms(known, days(24, 0, 3, 10, 60, wrong_sigmas=1.0)) <= 6  # two and a half are declared
    with pytest.raises(ValueError, match="limits of 10 fans for 3"):
        FanScorer(3, known)
    assert known.of(range(2, 5)).speed.fan_offsets == known.speed.fan_offsets.of(range(2, 5))
    assert known.of(None).speed.fan_offsets is None


def test_the_recordings_themselves_have_no_more_alarms_than_declared() -> None:
    # One fan goes much further than a tail of all would say, in every second run.
    runs = days(25, 0, 8, fans=10, seconds=60)

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
    assert count_alarms(limits, with_one_that_strays) <= declared * 8 * 60.0 * 10 / 86_400.0


# Alarms at these limits


@pytest.mark.parametrize(("size", "within_s"), [(6.0, 0.25), (3.0, 0.6), (1.5, 10.0)])
def test_a_step_is_found_the_faster_the_larger_it_is(white_limits: Limits, size: float, within_s: float) -> None:
    step = np.where(np.arange(90 * PER_S) < 60 * PER_S, 0.0, size)[:, np.newaxis]
    alarms = alarms_on_white(white_limits, 90.0, step)
    assert {alarm.fan for alarm in alarms} == {0, 1, 2, 3}
    assert all(60.0 <= alarm.t_s <= 60.0 + within_s for alarm in alarms)


def test_one_outlier_raises_no_alarm(white_limits: Limits) -> None:
    wild = np.zeros((90 * PER_S, 1))
    wild[[600, 1000, 1400]] = [[1e6], [-50.0], [12.0]]
    assert alarms_on_white(white_limits, 90.0, wild) == []


def test_a_run_alarms_if_it_starts_with_an_offset_beyond_healthy_ones(white_limits: Limits) -> None:
    commissioning_limit = white_limits.speed.baseline.commissioning_limit_sigmas
    assert alarms_on_white(white_limits, 60.0, 0.9 * commissioning_limit) == []
    alarms = alarms_on_white(white_limits, 60.0, commissioning_limit + 2.0)
    assert {alarm.fan for alarm in alarms} == {0, 1, 2, 3}
    assert max(alarm.t_s for alarm in alarms[:4]) < 2.0


def test_slow_wear_is_followed_for_a_while_and_then_alarms(white_limits: Limits) -> None:
    per_s = 2e-3
    farthest = white_limits.speed.baseline.adaptation_limit_sigmas
    seconds = 1.6 * farthest / per_s
    samples, fans = round(seconds * PER_S), 2
    wear = per_s * np.arange(samples)[:, np.newaxis] / PER_S
    speed = autoregressive(samples, fans, 0.0, 60) + wear
    blocks = in_blocks(samples_of(speed, autoregressive(samples, fans, 0.0, 61), period_ns=PERIOD_NS))
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
    for seed in range(20):
        values = np.random.default_rng(seed).exponential(2.0, 2000) + 5.0
        levels.append(Tail.fit(values, probability).level(probability))
    assert np.mean(levels) == pytest.approx(5.0 - 2.0 * np.log(probability), rel=0.03)


def test_the_level_of_a_normal_tail_errs_on_the_high_side() -> None:
    levels = [Tail.fit(np.random.default_rng(seed).normal(size=2000), 1e-5).level(1e-5) for seed in range(20)]
    assert 4.26 < np.mean(levels) < 6.0  # 4.26 is exact


def test_the_interval_of_a_rate_covers_it_as_often_as_it_says() -> None:
    rng = np.random.default_rng(3)
    covered = 0
    for seed in range(150):
        low, high = rate_interval(rng.poisson(0.6, 10).astype(float), np.full(10, 2.0), seed)
        covered += low <= 0.3 <= high
    assert covered / 150 > 0.93


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


def test_only_samples_with_a_score_are_counted(white_limits: Limits) -> None:
    found = statistics_of(healthy(0.0, 11, fans=2, runs=2, samples=25 * PER_S), white_limits, TOP_RAD_S)
    assert found.fan_s == pytest.approx(2 * 2 * 24.0)
    assert found.windows == 2 * 2 * 3


def test_runs_of_different_rates_are_refused_with_their_names() -> None:
    def mixed() -> Iterator[HealthyRun]:
        for run, period_ns in (("fast", 10_000_000), ("slow", 20_000_000)):
            speed, balance = (autoregressive(1000, 4, 0.0, seed) for seed in (1, 2))
            yield HealthyRun(run, 4, in_blocks(samples_of(speed, balance, period_ns=period_ns)))

    with pytest.raises(MixedRatesError) as refused:
        calibrate(mixed, TOP_RAD_S, Timing(), 600.0)
    assert (refused.value.first, refused.value.other) == (("fast", 10_000_000), ("slow", 20_000_000))
