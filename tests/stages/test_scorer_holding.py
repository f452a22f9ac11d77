"""stages.scorer: one alarm for one fault."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from schemas.blocks import join
from schemas.enums import Statistic, Transition
from schemas.messages import Prediction, Raw
from schemas.tacho import Tacho
from schemas.units import NS_PER_S
from stages.resampler import ResamplerConfig, ResamplerCore
from stages.scorer import ScorerCore
from tests.support.scored_blocks import (
    CALIBRATION,
    EPOCH_NS,
    NEEDED,
    SIGMA,
    TWIN_SPEED,
    Floats,
    core_of,
    feed,
    prediction_of,
)

PERIOD_NS = 100_000_000
SECOND = 10
MISSING_SHARE = {"sensor": {"stuck_s": 20.0, "missing_share": 0.25}}
SLOW_TIMES = {"smoothing_s": 0.2, "baseline_s": 1.0, "adaptation_s": 60.0, "on_delay_s": 0.1}
CARD = CALIBRATION | {"detectors": CALIBRATION["detectors"] | MISSING_SHARE, "timing": SLOW_TIMES}


def core_after_commissioning() -> ScorerCore:
    core = core_of(calibration=CARD, off_delay_s=1.0, deadband=0.25)
    feed(core, [prediction(noise(30 * SECOND, seed=9), first=-30 * SECOND)])
    return core


def noise(samples: int, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(0, 0.2 * SIGMA, (samples, 1))


def prediction(residual: Floats, first: int = 0, speed: Floats | float = 300.0) -> Prediction:
    made = prediction_of(residual, first=first, period_ns=PERIOD_NS)
    made.measured_speed_rad_s[:] += speed - 300.0
    made.predicted_speed_rad_s[:] += speed - 300.0
    return made


def raised_and_cleared(core: ScorerCore, item: Prediction) -> list[Transition]:
    _, alarms = feed(core, [item])
    return [a.transition for a in alarms if a.transition in (Transition.RAISED, Transition.CLEARED)]


def on_the_grid(missing: Floats) -> Prediction:
    """A healthy fan, of whose raw samples, ten a second, these shares have no reading, as the resampler shows it."""
    samples = len(missing)
    speed = TWIN_SPEED + noise(samples, seed=3)
    speed[np.random.default_rng(5).random(samples) < missing] = np.nan
    t_ns = EPOCH_NS + PERIOD_NS * np.arange(samples)
    raw = Raw(fans=1, host_receive_t_ns=t_ns, command=np.full(speed.shape, NEEDED), speed_rad_s=speed)
    resampler = ResamplerCore(1, ResamplerConfig(rate_hz=10.0))
    grid = join([*resampler.step(raw), *resampler.close()])
    made = prediction_of(grid.speed_rad_s - TWIN_SPEED, grid.valid, period_ns=PERIOD_NS)
    assert np.array_equal(made.t_ns, grid.t_ns)
    return replace(made, invalid_reason=grid.invalid_reason, reading_missing=grid.reading_missing)


def test_a_loose_wire_is_one_alarm_though_the_grid_bridges_its_missing_readings() -> None:
    time_s = np.arange(460 * SECOND) / SECOND
    item = on_the_grid(np.where(time_s < 60, 0.002, np.where(time_s < 360, 0.35, 0.002)))
    own = {"missing_readings": {"healthy_share": 0.02}}
    core = core_of(calibration=CARD | {"detectors": CARD["detectors"] | own})
    feed(core, [prediction(noise(30 * SECOND, seed=9), first=-30 * SECOND)])
    _, alarms = feed(core, [item])
    found = [alarm for alarm in alarms if alarm.transition in (Transition.RAISED, Transition.CLEARED)]
    after_s = [(alarm.t_ns - EPOCH_NS) / 1e9 - 60.0 for alarm in found]
    assert [alarm.transition for alarm in found] == [Transition.RAISED, Transition.CLEARED]
    assert found[0].statistic == Statistic.SENSOR
    assert 0.0 < after_s[0] < 6.0
    assert 330.0 < after_s[1] < 360.0
    assert re.search(r"; a tacho that drops out, \d+ %: [34]\d % of the readings of the last ", found[0].message)


def test_a_touched_blade_is_one_alarm_while_a_thermostat_moves_the_fan() -> None:
    """A share of the speed that is beyond the limit at full speed is not at a fifth of it; the touch ends after 240 s
    and the alarm at the next time at full speed."""
    samples = 400 * SECOND
    at = np.arange(samples)
    speed = np.where(at // (30 * SECOND) % 2 == 0, 300.0, 60.0)[:, np.newaxis]
    touched = prediction(noise(samples) - np.where(at < 240 * SECOND, 0.02 * speed.T, 0.0).T, speed=speed)
    assert raised_and_cleared(core_after_commissioning(), touched) == [Transition.RAISED, Transition.CLEARED]


def test_at_other_speeds_than_those_of_its_fault_an_alarm_returns_after_ten_minutes() -> None:
    samples = 900 * SECOND
    at = np.arange(samples)[:, np.newaxis]
    residual = noise(samples) - np.where(at < 40 * SECOND, 3.0 * SIGMA, 0.0)
    touched = prediction(residual, speed=np.where(at < 40 * SECOND, 300.0, 240.0))
    _, alarms = feed(core_after_commissioning(), [touched])
    (cleared_s,) = [(a.t_ns - EPOCH_NS) / 1e9 - 40.0 for a in alarms if a.transition == Transition.CLEARED]
    assert 600.0 < cleared_s < 660.0


def test_while_an_alarm_is_active_the_baseline_of_the_fan_stays() -> None:
    samples = 120 * SECOND
    at = np.arange(samples)[:, np.newaxis]
    residual = noise(samples) + np.where(at < 20 * SECOND, -3.0 * SIGMA, -0.5 * SIGMA)
    speed = np.where(at < 20 * SECOND, 300.0, 60.0)
    (score,), alarms = feed(core_after_commissioning(), [prediction(residual, speed=speed)])
    assert alarms[-1].active
    assert score.speed_baseline_rad_s[-1, 0] == score.speed_baseline_rad_s[5 * SECOND, 0]


def test_a_fan_is_not_commissioned_from_its_run_up() -> None:
    """A twin that is late by half a second while the fan speeds up for eight seconds."""
    samples = 40 * SECOND
    speed = 50.0 + 30.0 * np.minimum(np.arange(samples) / SECOND, 8.0)[:, np.newaxis]
    residual = noise(samples) + np.where(np.arange(samples)[:, np.newaxis] < 8 * SECOND, 0.6 * SIGMA, 0.0)
    (score,), _ = feed(core_of(calibration=CARD), [prediction(residual, speed=speed)])
    assert abs(float(score.speed_baseline_rad_s[-1, 0])) < 0.1 * SIGMA


@pytest.mark.parametrize(("rate_hz", "tacho"), [(2, Tacho()), (10, Tacho(kind="count", window_s=1.0))])
def test_a_fan_that_speeds_up_as_its_session_begins_is_not_judged_by_its_first_reading(
    rate_hz: int, tacho: Tacho
) -> None:
    held = max(1, round(rate_hz * tacho.held_s))
    time_s = np.arange(120 * rate_hz)[:, np.newaxis] // held * held / rate_hz
    wrong = np.where(time_s < 2.0, -2.5 * SIGMA, 0.0)
    item = prediction_of(noise(len(time_s))[::held].repeat(held, axis=0) + wrong, period_ns=NS_PER_S // rate_hz)
    ramp = np.minimum(100.0 * time_s - 200.0, 0.0)
    item.measured_speed_rad_s[:] += ramp
    item.predicted_speed_rad_s[:] += ramp
    _, alarms = feed(core_of(calibration=CARD, tachos=(tacho,)), [item])
    assert not any(alarm.transition in (Transition.RAISED, Transition.CLEARED) for alarm in alarms)


def test_a_diagnosis_that_says_nothing_new_is_no_message() -> None:
    samples = 70 * SECOND
    residual = noise(samples) - np.where(np.arange(samples)[:, np.newaxis] > 10 * SECOND, 2.0 * SIGMA, 0.0)
    _, alarms = feed(core_after_commissioning(), [prediction(residual)])
    causes = [[(each.cause, each.probability) for each in alarm.causes] for alarm in alarms if alarm.causes]
    repeats = sum(
        [name for name, _ in one] == [name for name, _ in other]
        and all(abs(p - q) < 0.1 for (_, p), (_, q) in zip(one, other, strict=True))
        for one, other in pairwise(causes)
    )
    assert causes and repeats == 0
    assert all(p >= 0.15 for one in causes for _, p in one)


def test_the_limit_beside_a_drift_is_the_one_of_the_drift() -> None:
    """Half a sigma adds up; the smoothed residual may be nearly two away."""
    residual = noise(20 * SECOND) - np.where(np.arange(20 * SECOND)[:, np.newaxis] > 5 * SECOND, 1.2 * SIGMA, 0.0)
    _, alarms = feed(core_after_commissioning(), [prediction(residual)])
    assert alarms[0].statistic == Statistic.SPEED_DRIFT
    assert alarms[0].limit_rad_s == pytest.approx(2.0, abs=0.05)
    assert "rad/s below the twin (limit 2), for long" in alarms[0].message
