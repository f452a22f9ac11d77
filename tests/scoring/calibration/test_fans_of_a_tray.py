"""Limits of trays of fans that count their pulses: what they share, and what little data can say about them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from schemas.messages import Array
from schemas.tacho import INSTANTANEOUS, Tacho
from scoring.calibration.calibration import SHARED_SHARE
from scoring.calibration.healthy_statistics import HealthyRun
from scoring.detectors.detector import Signal
from scoring.detectors.drift import DriftSettings
from scoring.detectors.smoothed import SmoothedSettings
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits, Timing, default_timing
from scoring.samples import Samples
from tests.support.calibrated_runs import MadeRuns, calibrate
from tests.support.healthy_residuals import Raised, alarms_of, autoregressive, in_blocks, samples_of

PERIOD_NS = 100_000_000
SIGMA_RAD_S = 2.0
SPEED_RAD_S = 100.0
FANS = 4
SHARED_LIMIT_SIGMAS = SHARED_SHARE * SPEED_RAD_S / SIGMA_RAD_S


def tray(seed: int, seconds: float, shift_sigmas: Array | float = 0.0) -> Samples:
    """White residuals of fans that hold about one speed, with a shift (n, fans) of the speed residual."""
    samples = round(seconds * 10)
    speed, balance = autoregressive(samples, FANS, 0.0, seed), autoregressive(samples, FANS, 0.0, seed + 1)
    made = samples_of(speed + shift_sigmas, balance, period_ns=PERIOD_NS)
    sigma = np.full(speed.shape, SIGMA_RAD_S)
    return replace(made, speed_sigma_rad_s=sigma, balance_sigma=sigma)


def healthy(runs: int, seconds: float, tachos: tuple[Tacho, ...] = INSTANTANEOUS) -> MadeRuns:
    def each() -> Iterator[HealthyRun]:
        for run in range(runs):
            yield HealthyRun(f"run {run}", FANS, in_blocks(tray(10 * run, seconds)), tachos=tachos)

    return each


@pytest.fixture(scope="module")
def limits() -> Limits:
    return calibrate(healthy(2, 600.0), 200.0, default_timing(FANS), 60.0)


def shifted(limits: Limits, size_sigmas: float, fans: list[int]) -> list[Raised]:
    """Alarms in three minutes, when the residuals of some fans move by so much in the second one."""
    ramp = np.clip(np.arange(1800) / 600.0 - 1.0, 0.0, 1.0)[:, np.newaxis]
    return alarms_of(limits, in_blocks(tray(77, 180.0, size_sigmas * ramp * np.isin(np.arange(FANS), fans))), FANS)


def test_what_all_fans_share_raises_no_alarm_and_the_same_of_one_fan_does(limits: Limits) -> None:
    size = 0.6 * SHARED_LIMIT_SIGMAS
    assert shifted(limits, size, []) == shifted(limits, size, [0, 1, 2, 3]) == []
    assert {alarm.fan for alarm in shifted(limits, size, [2])} == {2}


def test_more_than_weather_raises_an_alarm_of_every_fan(limits: Limits) -> None:
    assert {alarm.fan for alarm in shifted(limits, 3.0 * SHARED_LIMIT_SIGMAS, [0, 1, 2, 3])} == {0, 1, 2, 3}


def test_a_fan_alone_shares_nothing() -> None:
    def alone() -> Iterator[HealthyRun]:
        for _, _, blocks, *_ in healthy(3, 300.0)():
            of_one = [
                replace(block, **{n: v[:, :1] for n, v in vars(block).items() if np.ndim(v) == 2}) for block in blocks
            ]
            yield HealthyRun("alone", 1, of_one)

    found = calibrate(alone, 200.0, Timing(), 600.0, extrapolate=True)
    assert (found.speed.shared_limit, found.balance.shared_limit) == (0.0, 0.0)


def test_few_runs_of_fans_with_a_drive_are_off_by_a_share_of_their_speed() -> None:
    plain, driven = (
        calibrate(healthy(2, 120.0), 200.0, default_timing(FANS), 1.0, extrapolate=True, has_drive=has_drive)
        for has_drive in (False, True)
    )
    assert (plain.speed.baseline.speed_exponent, driven.speed.baseline.speed_exponent) == (0, 1)
    assert "speed_drift" not in plain.detectors
    assert "speed_drift" in driven.detectors


def test_weather_that_fans_share_does_not_look_like_offsets_that_go_with_the_speed() -> None:
    def each() -> Iterator[HealthyRun]:
        for run in range(4):
            rng = np.random.default_rng(run)
            speed_rad_s = np.repeat(rng.uniform(40.0, 180.0, (30, FANS)), 100, axis=0)
            made = tray(10 * run, 300.0)
            weather = 0.02 * np.sin(np.arange(3000) / 300.0)[:, np.newaxis] * speed_rad_s / SIGMA_RAD_S
            of_day = rng.normal(size=FANS)
            yield HealthyRun(
                f"run {run}",
                FANS,
                in_blocks(
                    replace(
                        made,
                        speed_residual=made.speed_residual + weather + of_day,
                        speed_rad_s=speed_rad_s + 1e-6 * made.speed_rad_s,
                    )
                ),
            )

    found = calibrate(each, 200.0, default_timing(FANS), 60.0)
    assert found.speed.baseline.speed_exponent == 0
    assert found.speed.mean_residual_std < 1.1


@pytest.mark.parametrize(("expected_alarms", "has_margins"), [(5.0, True), (20.0, False)])
def test_of_a_tacho_that_counts_a_few_expected_alarms_declare_a_rate_and_keep_the_margins(
    expected_alarms: float, has_margins: bool
) -> None:
    counts = Tacho(kind="count", pulses=2, window_s=0.1)
    per_day = expected_alarms * 86_400.0 / (2 * 120.0 * FANS)

    def drift(tachos: tuple[Tacho, ...]) -> DriftSettings:
        found = calibrate(healthy(2, 120.0, tachos), 200.0, default_timing(FANS), per_day, has_drive=False)
        assert found.declared_rate
        assert not found.declared_rate.extrapolated
        settings = found.settings_of("speed", DriftSettings)
        assert settings, "such data show the residual at all speeds"
        return settings

    assert (drift((counts,)).large_limit is not None) == has_margins
    assert drift(INSTANTANEOUS).large_limit is None


def test_with_the_margins_of_few_data_the_recordings_have_no_more_alarms_than_declared() -> None:
    # Margins take a smaller reference value than the rarity of sums does: one fan that errs for some seconds,
    # twice in each run and so more often than declared, would then raise an alarm each time.
    fans, samples, runs = 60, 800, 3
    counts = (Tacho(kind="count", pulses=2, window_s=1.0),)

    def errs() -> Iterator[HealthyRun]:
        for run in range(runs):
            row = np.arange(samples)[:, np.newaxis]
            error = 4.0 * ((row % 400 >= 380) & (np.arange(fans) == 1))
            speed, balance = (autoregressive(samples, fans, 0.0, 2 * run + number) for number in (0, 1))
            made = samples_of(speed + error, balance, period_ns=5 * PERIOD_NS)
            sigma = np.full(speed.shape, SIGMA_RAD_S)
            yield HealthyRun(f"run {run}", fans, in_blocks(replace(made, speed_sigma_rad_s=sigma)), tachos=counts)

    per_day = 3.5 * 86_400.0 / (runs * samples * 0.5 * fans)
    limits = calibrate(errs, 200.0, default_timing(fans), per_day)
    settings = limits.settings_of("speed", DriftSettings)
    assert settings
    assert settings.large_limit is not None, "these are the margins of few data"
    scorers = [FanScorer(fans, limits, tachos=counts) for _ in range(runs)]
    alarms = [alarms_of(limits, run.blocks, fans, scorer) for run, scorer in zip(errs(), scorers, strict=True)]
    assert sum(map(len, alarms)) <= 3


def test_what_one_fan_alone_does_at_a_speed_is_not_expected_of_the_others() -> None:
    def each(slow_fans: range) -> MadeRuns:
        def runs() -> Iterator[HealthyRun]:
            made = tray(8, 1200.0)
            row = np.arange(len(made.t_ns))[:, np.newaxis]
            slow = (row % 300 >= 200) & np.isin(np.arange(FANS), slow_fans)
            speed_rad_s = np.where(slow, 30.0, 110.0 + 20.0 * (row // 50 % 5)) + 1e-3 * made.speed_rad_s
            residual = made.speed_residual + np.where(slow, -6.0, 0.0)
            yield HealthyRun("one", FANS, in_blocks(replace(made, speed_rad_s=speed_rad_s, speed_residual=residual)))

        return runs

    one, all_of_them = (calibrate(each(fans), 200.0, Timing(), 600.0).speed for fans in (range(1, 2), range(FANS)))
    assert one.expected_residual_sigmas[0] == pytest.approx(all_of_them.expected_residual_sigmas[0] / FANS, rel=0.15)
    assert all_of_them.expected_residual_sigmas[0] < -4.0
    assert one.persistent_std[0] > 2.0 * max(one.persistent_std[1:]), "but limits are wider there"
    assert all_of_them.persistent_std[0] < 0.5 * one.persistent_std[0]


def test_the_fewer_speeds_were_seen_the_wider_are_the_limits() -> None:
    def at(speeds_rad_s: list[float]) -> MadeRuns:
        def each() -> Iterator[HealthyRun]:
            for number, block in enumerate([tray(5, 240.0)]):
                rows = np.arange(len(block.t_ns)) * len(speeds_rad_s) // len(block.t_ns)
                speed = np.array(speeds_rad_s)[rows][:, np.newaxis] + 1e-3 * block.speed_rad_s
                yield HealthyRun(f"run {number}", FANS, in_blocks(replace(block, speed_rad_s=speed)))

        return each

    few, many = (
        calibrate(at(speeds), 200.0, Timing(), 1.0, extrapolate=True).settings_of("speed", SmoothedSettings)
        for speeds in ([100.0], [30.0, 50.0, 70.0, 90.0, 110.0, 130.0, 150.0, 170.0])
    )
    assert few
    assert many
    assert few.limit > 1.3 * many.limit


def test_a_speed_that_was_quiet_for_some_minutes_gets_no_narrow_limits_from_few_data() -> None:
    def two_speeds() -> Iterator[HealthyRun]:
        block = tray(6, 300.0)
        slow = np.arange(len(block.t_ns)) < len(block.t_ns) // 2
        speed = np.where(slow, 60.0, 140.0)[:, np.newaxis] + 1e-3 * block.speed_rad_s
        residual = np.where(slow, 1.0, 0.3)[:, np.newaxis] * block.speed_residual
        yield HealthyRun("one", FANS, in_blocks(replace(block, speed_rad_s=speed, speed_residual=residual)))

    def stds(per_day: float, *, extrapolate: bool) -> tuple[float, ...]:
        return calibrate(two_speeds, 200.0, Timing(), per_day, extrapolate=extrapolate).speed.residual_std

    slow, fast = stds(600.0, extrapolate=False)
    assert fast == pytest.approx(0.3 * slow, rel=0.1)
    cautious = stds(1.0, extrapolate=True)
    assert cautious == (slow, (slow + fast) / 2)


def test_a_fan_with_little_noise_gets_no_narrower_limits_on_what_lasts_from_few_data() -> None:
    shares: dict[Signal, Array] = {"speed": np.array([0.01, 0.02, 0.02, 0.03]), "balance": np.full(FANS, 0.02)}

    def found(per_day: float, *, extrapolate: bool) -> Limits:
        each = healthy(2, 120.0)
        return calibrate(each, 200.0, Timing(), per_day, extrapolate=extrapolate, sigma_shares=shares)

    enough, few = found(600.0, extrapolate=False), found(1.0, extrapolate=True)
    assert enough.speed.low_frequency_std_of_fans == ()
    mean = math.sqrt((0.01**2 + 0.02**2 + 0.02**2 + 0.03**2) / 4)
    wider = [mean / 0.01, mean / 0.02, mean / 0.02, 1.0]
    assert few.speed.low_frequency_std_of_fans == pytest.approx(wider, abs=1e-4)
    assert few.balance.low_frequency_std_of_fans == (1.0,) * FANS
    assert few.of(range(2, 4)).speed.low_frequency_std_of_fans == pytest.approx(wider[2:], abs=1e-4)
    assert few.of(None).speed.low_frequency_std_of_fans == ()

    shares["balance"] = np.array([0.01, 0.01, 0.02, 0.2])
    beside_a_noisy_one = found(1.0, extrapolate=True).balance.low_frequency_std_of_fans
    assert beside_a_noisy_one == pytest.approx([math.sqrt(2.0), math.sqrt(2.0), 1.0, 1.0], abs=1e-4)
