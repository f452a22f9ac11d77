"""Scorer: one alarm for one fault, whatever the fan is told meanwhile."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from fantwin.pipeline.tray_scoring.healthy_twin import ScorerConfig
from fantwin.schemas.blocks import join
from fantwin.schemas.enums import Statistic, Transition
from fantwin.schemas.messages import Alarm, Prediction, Raw
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from fantwin.stages.scorer import ScorerCore
from tests.support.scored_blocks import EPOCH_NS, NEEDED, TWIN_SPEED, Floats, core_of, feed, prediction_of, twin_of

PERIOD_NS = 100_000_000
SECOND = 10
CHANGES = (Transition.RAISED, Transition.CLEARED)


def noise(samples: int, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(0.0, 1.0, (samples, 1))


def prediction(residual: Floats, first: int = 0, speed: Floats | float = TWIN_SPEED) -> Prediction:
    made = prediction_of(residual, first=first, period_ns=PERIOD_NS)
    made.measured_speed_rad_s[:] += speed - TWIN_SPEED
    made.predicted_speed_rad_s[:] += speed - TWIN_SPEED
    made.command[:] *= np.square(speed / TWIN_SPEED)
    return made


def core_that_knows_its_fan() -> ScorerCore:
    core = core_of()
    feed(core, [prediction(noise(30 * SECOND, seed=9), first=-30 * SECOND)])
    return core


def changes(core: ScorerCore, item: Prediction) -> list[tuple[Transition, float]]:
    """When alarms were raised and cleared, s."""
    _, alarms = feed(core, [item])
    return [(each.transition, (each.t_ns - EPOCH_NS) / NS_PER_S) for each in alarms if each.transition in CHANGES]


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


@pytest.mark.parametrize(
    ("window_s", "update_s", "line_hz", "lost"), [(0.5, 0.0, 2, 0.1), (0.5, 0.0, 1, 0.0), (1.0, 0.25, 4, 0.0)]
)
def test_counts_of_which_some_are_not_seen_or_which_overlap_are_no_alarm(
    window_s: float, update_s: float, line_hz: int, lost: float
) -> None:
    counts, fans, lines = Tacho(kind="count", window_s=window_s, update_s=update_s), 8, 2400
    rng = np.random.default_rng(8)
    time_s = np.arange(lines)[:, np.newaxis] / line_hz
    per_s, phase = (TWIN_SPEED + np.arange(fans)) / (counts.resolution_rad_s * window_s), rng.random(fans)
    counted = np.floor(phase + per_s * time_s) - np.floor(phase + per_s * (time_s - window_s))
    arrives = rng.random(lines) >= lost
    t_ns = EPOCH_NS + NS_PER_S // line_hz * np.flatnonzero(arrives)
    speed = counted[arrives] * counts.resolution_rad_s
    raw = Raw(fans=fans, host_receive_t_ns=t_ns, command=np.full(speed.shape, NEEDED), speed_rad_s=speed)
    resampler = ResamplerCore(fans, ResamplerConfig(rate_hz=float(line_hz)), tachos=(counts,))
    grid = join([*resampler.step(raw), *resampler.close()])
    item = prediction_of(grid.speed_rad_s - TWIN_SPEED, grid.valid, period_ns=grid.period_ns)
    item = replace(item, reading_missing=grid.reading_missing, reading_repeated=grid.reading_repeated)
    twin = twin_of(fans, tachos=(counts,))
    twin = replace(twin, fans=replace(twin.fans, noise_rad_s=np.full(fans, 0.1)))
    assert feed(ScorerCore(fans, "rad/s", ScorerConfig(), twin), [item])[1] == []


def test_a_loose_wire_is_one_alarm_though_the_grid_bridges_its_missing_readings() -> None:
    time_s = np.arange(200 * SECOND) / SECOND
    item = on_the_grid(np.where(time_s < 60, 0.002, np.where(time_s < 160, 0.35, 0.002)))
    _, alarms = feed(core_that_knows_its_fan(), [item])
    found = [alarm for alarm in alarms if alarm.transition in CHANGES]
    after_s = [(alarm.t_ns - EPOCH_NS) / NS_PER_S - 60.0 for alarm in found]
    assert [alarm.transition for alarm in found] == [Transition.RAISED, Transition.CLEARED]
    assert found[0].statistic == Statistic.MISSING_READINGS
    assert 0.0 < after_s[0] < 6.0
    assert 100.0 < after_s[1] < 115.0
    assert re.search(r"; a tacho that drops out, 100 %: \d\d % of the readings are missing", found[0].message)


def test_a_healthy_line_that_loses_a_reading_now_and_then_raises_nothing() -> None:
    assert changes(core_that_knows_its_fan(), on_the_grid(np.full(200 * SECOND, 0.004))) == []


def test_a_fault_that_takes_a_share_of_the_speed_is_one_alarm_while_a_thermostat_moves_the_fan() -> None:
    at = np.arange(240 * SECOND)[:, np.newaxis]
    speed = np.where(at // (20 * SECOND) % 2 == 0, 300.0, 120.0)
    residual = noise(len(at)) - np.where((at > 10 * SECOND) & (at < 150 * SECOND), 0.08 * speed, 0.0)
    (raised, _), (cleared, cleared_s) = changes(core_that_knows_its_fan(), prediction(residual, speed=speed))
    assert (raised, cleared) == CHANGES
    assert 160.0 <= cleared_s < 185.0


def with_share_lost(seconds: int, at_s: int, share: float) -> Prediction:
    at = np.arange(seconds * SECOND)[:, np.newaxis]
    return prediction(noise(len(at)) - np.where(at >= at_s * SECOND, share * TWIN_SPEED, 0.0))


@pytest.mark.parametrize("share", [0.05, 0.1, 0.2])
def test_a_constant_fault_is_one_alarm_that_stays(share: float) -> None:
    (raised,) = changes(core_that_knows_its_fan(), with_share_lost(90, 10, share))
    assert raised[0] == Transition.RAISED
    assert 10.0 < raised[1] < 12.0


def test_in_an_alarm_nothing_is_learned() -> None:
    core = core_that_knows_its_fan()
    (score,), alarms = feed(core, [with_share_lost(60, 5, 0.2)])
    assert alarms[-1].active
    expected = score.expected_residual_rad_s[6 * SECOND :, 0]
    assert np.ptp(expected) < 1.0 and np.abs(expected).max() < 6.0


def causes_of(alarms: list[Alarm]) -> list[list[tuple[str, float]]]:
    return [[(each.cause, each.probability) for each in alarm.causes] for alarm in alarms if alarm.causes]


def test_a_diagnosis_that_says_nothing_new_is_no_message() -> None:
    _, alarms = feed(core_that_knows_its_fan(), [with_share_lost(70, 10, 0.2)])
    causes = causes_of([alarm for alarm in alarms if alarm.transition in (Transition.RAISED, Transition.DIAGNOSED)])
    repeats = sum(
        [name for name, _ in one] == [name for name, _ in other]
        and all(abs(p - q) < 0.1 for (_, p), (_, q) in zip(one, other, strict=True))
        for one, other in pairwise(causes)
    )
    assert causes and repeats == 0
    assert all(p >= 0.15 for one in causes for _, p in one)


STANDSTILL = Standstill(
    turning_command=20.0, standing_below_rad_s=50.0, off_command=0.0, start_s=1.0, coast_s=4.0, slowing_s=0.5
)


def at_2_hz(is_wrong: NDArray[np.bool_], shown: float) -> Prediction:
    """A healthy fan, of whose raw samples, two a second, these show something else."""
    speed = np.where(is_wrong[:, np.newaxis], shown, TWIN_SPEED + noise(len(is_wrong), seed=3))
    t_ns = EPOCH_NS + NS_PER_S // 2 * np.arange(len(is_wrong))
    raw = Raw(fans=1, host_receive_t_ns=t_ns, command=np.full(speed.shape, NEEDED), speed_rad_s=speed)
    resampler = ResamplerCore(1, ResamplerConfig(rate_hz=2.0))
    grid = join([*resampler.step(raw), *resampler.close()])
    made = prediction_of(grid.speed_rad_s - TWIN_SPEED, grid.valid, period_ns=grid.period_ns)
    return replace(made, invalid_reason=grid.invalid_reason, reading_missing=grid.reading_missing)


def test_a_silence_that_a_loose_wire_makes_now_and_then_is_no_tacho_without_a_signal_and_a_long_one_is() -> None:
    missing = np.random.default_rng(5).random(800) < 0.35
    missing[:60], missing[300:310], missing[600:640] = False, True, True
    _, alarms = feed(core_of(standstill=STANDSTILL), [at_2_hz(missing, np.nan)])
    named = [((each.t_ns - EPOCH_NS) / NS_PER_S, each.causes[0].cause) for each in alarms if each.causes]
    assert {cause for time_s, cause in named if time_s < 300.0} == {"sensor_dropout"}
    assert "no_tacho" in {cause for time_s, cause in named if 300.0 < time_s < 325.0}


def test_readings_of_zero_now_and_then_are_no_fan_that_stands_and_a_fan_that_stands_is_found() -> None:
    stands = np.zeros(800, np.bool_)
    stands[[100, 200, 201, 300, 400, 401, 500]] = True
    stands[700:] = True
    core = core_of(standstill=STANDSTILL, tachos=(Tacho(kind="average", window_s=0.5),))
    _, alarms = feed(core, [at_2_hz(stands, 0.0)])
    raised = [(each.t_ns - EPOCH_NS) / NS_PER_S for each in alarms if each.transition == Transition.RAISED]
    assert len(raised) == 1
    assert 350.0 < raised[0] <= 353.0


def test_an_alarm_is_not_lost_between_the_counts_of_a_slow_tacho() -> None:
    residual = np.concatenate([noise(200), noise(200) - 60.0])
    core = core_of(tachos=(Tacho(kind="count", window_s=3.0),))
    _, alarms = feed(core, [prediction_of(residual, period_ns=NS_PER_S)])
    transitions = [each.transition for each in alarms]
    assert Transition.RAISED in transitions
    assert not {Transition.DATA_LOST, Transition.DATA_RESTORED} & set(transitions)


def test_an_alarm_of_missing_readings_goes_stale_two_seconds_into_a_silence_of_its_line() -> None:
    time_s = np.arange(100 * SECOND) / SECOND
    item = on_the_grid(np.where(time_s < 60, 0.002, 0.35))
    core = core_that_knows_its_fan()
    _, alarms = feed(core, [item])
    assert alarms[0].transition == Transition.RAISED
    silent = prediction_of(
        noise(5 * SECOND), np.zeros((5 * SECOND, 1), np.bool_), first=len(item.t_ns), period_ns=PERIOD_NS
    )
    _, alarms = feed(core, [silent])
    assert [(each.transition, (each.t_ns - int(item.t_ns[-1])) / NS_PER_S < 3.0) for each in alarms] == [
        (Transition.DATA_LOST, True)
    ]


def test_wear_goes_on_to_be_measured_in_its_own_alarm_so_that_it_can_be_over() -> None:
    core = core_of(config={"wear_every_s": 10.0})
    feed(core, [prediction(noise(104 * SECOND))])
    core.tray.wear.is_over[0] = True
    assert [each for each, _ in changes(core, prediction(noise(30 * SECOND), first=104 * SECOND))] == list(CHANGES)
