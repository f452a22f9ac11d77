"""Scorer: one alarm for one fault, whatever the fan is told meanwhile."""

from __future__ import annotations

import re
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from fantwin.pipeline.tray_scoring import tray_scorer
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.schemas.blocks import join
from fantwin.schemas.enums import Severity, Statistic, Transition
from fantwin.schemas.messages import Prediction, Raw
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from tests.support.scored_blocks import EPOCH_NS, NEEDED, TWIN_SPEED, Floats, core_of, feed, prediction_of, twin_of

PERIOD_NS = 100_000_000
SECOND = 10
Times = NDArray[np.int64]
CHANGES = (Transition.RAISED, Transition.CLEARED)


def noise(samples: int, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(0.0, 1.0, (samples, 1))


def prediction(residual: Floats, first: int = 0) -> Prediction:
    return prediction_of(residual, first=first, period_ns=PERIOD_NS)


@cache
def _knowing() -> ScorerCore:
    core = core_of()
    feed(core, [prediction(noise(30 * SECOND, seed=9), first=-30 * SECOND)])
    return core


def core_that_knows_its_fan() -> ScorerCore:
    return deepcopy(_knowing())


def on_the_grid(missing: Floats) -> Prediction:
    """A healthy fan, of whose raw samples, ten a second, these shares have no reading."""
    is_missing = np.random.default_rng(5).random(len(missing)) < missing
    return resampled(np.where(is_missing[:, np.newaxis], np.nan, TWIN_SPEED + noise(len(missing), seed=3)), 10)


def resampled(
    speed: Floats, rate_hz: float, fans: int = 1, tachos: Sequence[Tacho] = INSTANTANEOUS, t_ns: Times | None = None
) -> Prediction:
    """Predictions of TWIN_SPEED beside these raw samples, as the resampler shows them."""
    t_ns = EPOCH_NS + round(NS_PER_S / rate_hz) * np.arange(len(speed)) if t_ns is None else t_ns
    raw = Raw(fans=fans, host_receive_t_ns=t_ns, command=np.full(speed.shape, NEEDED), speed_rad_s=speed)
    resampler = ResamplerCore(fans, ResamplerConfig(rate_hz=float(rate_hz)), tachos=tachos)
    grid = join([*resampler.step(raw), *resampler.close()])
    made = prediction_of(grid.speed_rad_s - TWIN_SPEED, grid.valid, period_ns=grid.period_ns)
    columns = ("t_ns", "invalid_reason", "reading_missing", "reading_repeated")
    return replace(made, **{name: getattr(grid, name) for name in columns})


@pytest.mark.parametrize(
    ("window_s", "update_s", "line_hz", "lost"), [(0.5, 0.0, 2, 0.1), (0.5, 0.0, 1, 0.0), (1.0, 0.25, 4, 0.0)]
)
def test_counts_of_which_some_are_not_seen_or_which_overlap_are_no_alarm(
    window_s: float, update_s: float, line_hz: int, lost: float
) -> None:
    counts, fans, lines = Tacho(kind="count", window_s=window_s, update_s=update_s), 8, 200
    rng = np.random.default_rng(8)
    time_s = np.arange(lines)[:, np.newaxis] / line_hz
    per_s, phase = (TWIN_SPEED + np.arange(fans)) / (counts.resolution_rad_s * window_s), rng.random(fans)
    counted = np.floor(phase + per_s * time_s) - np.floor(phase + per_s * (time_s - window_s))
    arrives = rng.random(lines) >= lost
    t_ns = EPOCH_NS + NS_PER_S // line_hz * np.flatnonzero(arrives)
    speed = counted[arrives] * counts.resolution_rad_s
    item = resampled(speed, line_hz, fans, (counts,), t_ns)
    twin = twin_of(fans, tachos=(counts,))
    twin = replace(twin, fans=replace(twin.fans, noise_rad_s=np.full(fans, 0.1)))
    assert feed(ScorerCore(fans, "rad/s", ScorerConfig(), twin), [item])[1] == []


def test_a_loose_wire_is_one_alarm_though_the_grid_bridges_its_missing_readings() -> None:
    time_s = np.arange(66 * SECOND) / SECOND
    item = on_the_grid(np.where(time_s < 20, 0.002, np.where(time_s < 50, 0.35, 0.002)))
    _, alarms = feed(core_that_knows_its_fan(), [item])
    found = [alarm for alarm in alarms if alarm.transition in CHANGES]
    after_s = [(alarm.t_ns - EPOCH_NS) / NS_PER_S - 20.0 for alarm in found]
    assert [alarm.transition for alarm in found] == [Transition.RAISED, Transition.CLEARED]
    assert found[0].statistic == Statistic.MISSING_READINGS
    assert 0.0 < after_s[0] < 6.0
    assert 30.0 < after_s[1] < 45.0
    assert re.search(r"; a tacho that drops out, 100 %: \d\d % of the readings are missing", found[0].message)
    assert {alarm.statistic for alarm in alarms} == {Statistic.MISSING_READINGS}
    assert len(alarms) < 6, "it is about nothing else while the line recovers"


def test_a_fault_of_the_fan_within_an_alarm_of_missing_readings_is_said_with_its_own_causes() -> None:
    item = on_the_grid(np.full(80 * SECOND, 0.35))
    falls = np.where(np.arange(len(item.t_ns))[:, np.newaxis] < len(item.t_ns) // 2, 0.0, 60.0)
    item = replace(item, measured_speed_rad_s=item.measured_speed_rad_s - falls)
    _, alarms = feed(core_that_knows_its_fan(), [item])
    assert [alarm.transition for alarm in alarms if alarm.transition in CHANGES] == [Transition.RAISED]
    said = [alarm for alarm in alarms if alarm.statistic == Statistic.DEVIATION]
    assert {alarm.causes[0].cause for alarm in alarms if alarm not in said} == {"sensor_dropout"}
    assert said and said[-1].severity == Severity.ALARM
    assert "sensor_dropout" not in {cause.cause for alarm in said for cause in alarm.causes}


def test_a_constant_fault_is_one_alarm_in_which_nothing_is_learned_and_no_diagnosis_repeats_another() -> None:
    at = np.arange(35 * SECOND)[:, np.newaxis]
    lost = prediction(noise(len(at)) - np.where(at >= 10 * SECOND, 0.2 * TWIN_SPEED, 0.0))
    (score,), alarms = feed(core_that_knows_its_fan(), [lost])
    (raised,) = [alarm for alarm in alarms if alarm.transition in CHANGES]
    assert raised.transition == Transition.RAISED
    assert 10.0 < (raised.t_ns - EPOCH_NS) / NS_PER_S < 12.0
    expected = score.expected_residual_rad_s[12 * SECOND :, 0]
    assert np.ptp(expected) < 1.0 and np.abs(expected).max() < 6.0
    told = [alarm for alarm in alarms if alarm.transition in (Transition.RAISED, Transition.DIAGNOSED)]
    causes = [[(each.cause, each.probability) for each in alarm.causes] for alarm in told if alarm.causes]
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
    return resampled(np.where(is_wrong[:, np.newaxis], shown, TWIN_SPEED + noise(len(is_wrong), seed=3)), 2)


def test_a_silence_that_a_loose_wire_makes_now_and_then_is_no_tacho_without_a_signal_and_a_long_one_is() -> None:
    missing = np.random.default_rng(5).random(340) < 0.35
    missing[:60], missing[160:170], missing[300:] = False, True, True
    _, alarms = feed(core_of(standstill=STANDSTILL), [at_2_hz(missing, np.nan)])
    named = [((each.t_ns - EPOCH_NS) / NS_PER_S, each.causes[0].cause) for each in alarms if each.causes]
    assert {cause for time_s, cause in named if time_s < 150.0} == {"sensor_dropout"}
    assert "no_tacho" in {cause for time_s, cause in named if time_s > 150.0}


def test_readings_of_zero_now_and_then_are_no_fan_that_stands_and_a_fan_that_stands_is_found() -> None:
    stands = np.zeros(320, np.bool_)
    stands[[60, 100, 101, 150, 200, 201, 250]] = True
    stands[300:] = True
    core = core_of(standstill=STANDSTILL, tachos=(Tacho(kind="average", window_s=0.5),))
    _, alarms = feed(core, [at_2_hz(stands, 0.0)])
    raised = [(each.t_ns - EPOCH_NS) / NS_PER_S for each in alarms if each.transition == Transition.RAISED]
    assert len(raised) == 1
    assert 150.0 < raised[0] <= 153.0


def test_a_tacho_of_many_wrong_readings_is_said_and_raises_no_alarm() -> None:
    is_wrong = np.arange(1200) % 20 == 19
    core = core_of(tachos=(Tacho(kind="average", window_s=0.5),))
    _, alarms = feed(core, [at_2_hz(is_wrong, 2.0 * TWIN_SPEED)])
    assert alarms == []
    assert "fan 0: 5% of the readings of its tacho are wrong: check the tacho and its wire" in core.notes()


CHIP = Tacho(kind="average", window_s=0.05, update_s=1.5)
WRONG = (0.0, 2.0 * TWIN_SPEED, 0.5 * TWIN_SPEED, 9917.0 * np.pi / 30.0, 65535.0 * np.pi / 30.0)


@pytest.mark.parametrize(
    ("rate_hz", "tacho"),
    [
        (rate_hz, tacho)
        for tacho in (Tacho(), CHIP)
        for rate_hz in (10, 2, 1, 1 / 1.5, 1 / 15)
        if rate_hz != 1 or tacho != CHIP
    ],
)
def test_one_wrong_reading_is_no_alarm_at_any_rate_and_a_slower_fan_is_found(rate_hz: float, tacho: Tacho) -> None:
    shown = max(1, round(tacho.held_s * rate_hz))  # samples of a reading
    reading = np.arange(220 * shown) // shown
    speed = TWIN_SPEED + noise(220, seed=3)[reading]
    for kind, wrong in enumerate(WRONG):
        speed[reading % (38 * len(WRONG)) == 38 * kind + 37] = wrong
    core = core_of(tachos=(tacho,), standstill=STANDSTILL)
    _, alarms = feed(core, [resampled(speed, rate_hz, tachos=(tacho,))])
    assert alarms == []
    speed[reading >= 200] *= 0.9
    core = core_of(tachos=(tacho,), standstill=STANDSTILL)
    _, alarms = feed(core, [resampled(speed, rate_hz, tachos=(tacho,))])
    raised = [(each.t_ns - EPOCH_NS) / NS_PER_S for each in alarms if each.transition == Transition.RAISED]
    assert len(raised) == 1
    after_s = raised[0] - 200 * max(tacho.held_s, 1 / rate_hz)
    assert 0.0 <= after_s <= 4.5 * max(tacho.held_s, 1 / rate_hz), after_s


def test_an_alarm_is_not_lost_between_the_counts_of_a_slow_tacho() -> None:
    residual = np.concatenate([noise(60), noise(60) - 60.0])
    core = core_of(tachos=(Tacho(kind="count", window_s=3.0),))
    _, alarms = feed(core, [prediction_of(residual, period_ns=NS_PER_S)])
    transitions = [each.transition for each in alarms]
    assert Transition.RAISED in transitions
    assert not {Transition.DATA_LOST, Transition.DATA_RESTORED} & set(transitions)


def test_an_alarm_of_missing_readings_goes_stale_two_seconds_into_a_silence_of_its_line() -> None:
    item = on_the_grid(np.where(np.arange(35 * SECOND) < 20 * SECOND, 0.002, 0.35))
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


def test_wear_goes_on_to_be_measured_in_its_own_alarm_so_that_it_can_be_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tray_scorer, "WEAR_EVERY_S", 2.0)
    core = core_of()
    feed(core, [prediction(noise(21 * SECOND))])
    core.tray.wear.is_over[0] = True
    _, alarms = feed(core, [prediction(noise(20 * SECOND), first=21 * SECOND)])
    assert [each.transition for each in alarms if each.transition in CHANGES] == list(CHANGES)
