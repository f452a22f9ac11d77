"""scoring.alarms.return_rule: which detectors hold an alarm, for how long, and at which samples they can let it go."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.enums import Action, FanState, Transition
from scoring.alarms.fan_condition import ConditionSettings
from scoring.alarms.return_rule import TOGETHER_NS, HoldingDetector
from scoring.alarms.tray_conditions import TrayConditions

STEP_NS = 10
SETTINGS = ConditionSettings(
    on_delay_ns=0,
    detectors=(
        HoldingDetector("speed_smoothed", 20, grows_with_speed=True, elsewhere_ns=1000),
        HoldingDetector("speed_drift", 100, grows_with_speed=True, elsewhere_ns=1000),
        HoldingDetector("sensor", 300, grows_with_speed=False),
    ),
)
UP, MID, LOW, NONE = 1.2, 0.9, 0.1, math.nan
FULL, SLOW = 200.0, 70.0
CALM = (LOW, LOW, LOW)
Sample = tuple[float, ...]


class Fan:
    """The alarm of one fan; `play` returns the numbers of the samples at which it was raised and cleared."""

    def __init__(self, conditions: ConditionSettings = SETTINGS) -> None:
        self.conditions = TrayConditions(1, conditions)
        self.samples = 0

    def play(self, samples: Sequence[Sample], speed: float = FULL) -> list[tuple[int, Transition]]:
        ratios = np.array(samples)[:, :, np.newaxis]
        score = np.nanmax(ratios, axis=1)
        t_ns = (self.samples + 1 + np.arange(len(samples))) * STEP_NS
        result = self.conditions.update(t_ns, STEP_NS, score, np.isfinite(score), ratios, np.full(score.shape, speed))
        events = [(self.samples + event.row, event.transition) for event in result.events]
        self.samples += len(samples)
        self.state = FanState(int(result.state[-1, 0]))
        return events


def test_a_detector_that_never_exceeded_does_not_keep_an_alarm_that_another_raised() -> None:
    fan = Fan()
    fan.play([(UP, LOW, LOW)])
    assert fan.play([(LOW, MID, LOW)] * 3) == [(3, Transition.CLEARED)], (
        "after 20 ns, the drift is just below its limit"
    )


def test_each_detector_that_exceeded_has_an_off_delay_of_its_own() -> None:
    fan = Fan()
    fan.play([(UP, LOW, LOW), (UP, UP, LOW)])
    assert fan.play([CALM] * 20) == [(12, Transition.CLEARED)], "the drift holds it for 100 ns"


def test_readings_that_come_back_for_a_moment_clear_nothing() -> None:
    fan = Fan()
    fan.play([(LOW, LOW, UP)])
    assert fan.play(([CALM] * 25 + [(LOW, LOW, UP)]) * 8) == []
    assert fan.play([CALM] * 40) == [(fan.samples - 10, Transition.CLEARED)]


def test_a_fault_too_small_to_be_seen_at_a_lower_speed_has_not_gone_there() -> None:
    fan = Fan()
    fan.play([(UP, LOW, LOW)])
    assert fan.play([CALM] * 500, SLOW) == []
    assert fan.state == FanState.RETURNING
    assert fan.play([CALM] * 3, FULL) == [(503, Transition.CLEARED)]


def test_a_fault_that_would_be_seen_there_has_gone_at_the_speeds_at_which_it_came_or_after_a_long_time_at_others() -> (
    None
):
    fan = Fan()
    fan.play([(2.9, LOW, LOW)] * 3)
    assert fan.play([CALM] * 90, SLOW) == [], "a twin may err there by as much"
    assert fan.play([(MID, LOW, LOW)], SLOW) == []
    assert fan.play([CALM] * 150, SLOW) == [(fan.samples - 150 + 99, Transition.CLEARED)], "after 1,000 ns"
    fan.play([(2.5, LOW, LOW)] * 3, SLOW)
    assert fan.play([CALM] * 3, 1.1 * SLOW) == [(fan.samples - 1, Transition.CLEARED)]


def test_a_fault_of_several_limits_has_gone_at_any_speed_at_which_it_would_be_seen() -> None:
    fan = Fan()
    fan.play([(4.0, LOW, LOW)])
    assert fan.play([CALM] * 3, SLOW) == [(3, Transition.CLEARED)]
    fan.play([(2.9, LOW, 4.0)] * 3)
    assert fan.play([CALM] * 90, SLOW) == [], "how long a tacho is stuck says nothing of the size of a fault"


def test_what_began_with_a_standstill_is_over_with_it_and_what_was_there_before_is_not() -> None:
    standing = replace(SETTINGS.detectors[2], off_delay_ns=30, standing_ns=TOGETHER_NS)
    of_standing = replace(SETTINGS, detectors=(*SETTINGS.detectors[:2], standing))
    for has_stood in (False, True):
        fan = Fan(of_standing)
        fan.play([(LOW, UP, UP if has_stood else LOW)], speed=FULL)
        cleared = fan.play([CALM] * 40, speed=SLOW)
        assert cleared == ([(4, Transition.CLEARED)] if has_stood else []), "after the off-delay of the standstill"
    fan = Fan(
        replace(of_standing, detectors=tuple(replace(each, elsewhere_ns=10**12) for each in of_standing.detectors))
    )
    before = TOGETHER_NS // STEP_NS
    fan.conditions.update(*one_long_sample((UP, LOW, LOW), before * STEP_NS))
    fan.play([(UP, LOW, UP)])
    assert fan.play([CALM] * 40, speed=SLOW) == []


def test_a_residual_that_begins_long_after_a_standstill_is_another_fault() -> None:
    """A fan that ran on, whose alarm stays while it is driven; an hour later something brakes it."""
    running_on = replace(SETTINGS.detectors[2], off_delay_ns=30, standing_ns=TOGETHER_NS)
    fan = Fan(replace(SETTINGS, detectors=(*SETTINGS.detectors[:2], running_on)))
    fan.play([(LOW, LOW, UP)])
    fan.conditions.update(*one_long_sample((LOW, LOW, NONE), 2 * TOGETHER_NS))
    fan.play([(LOW, UP, NONE)] * 3)
    assert fan.play([CALM] * 90, speed=SLOW) == []


def one_long_sample(ratios: Sample, period_ns: int) -> tuple[Any, ...]:
    score = np.full((1, 1), max(ratios))
    return (
        np.array([0]),
        period_ns,
        score,
        np.isfinite(score),
        np.array([ratios])[:, :, np.newaxis],
        np.full((1, 1), FULL),
    )


def test_an_alarm_that_came_at_no_known_speed_may_return_at_any() -> None:
    fan = Fan()
    fan.play([(UP, LOW, LOW)], 0.0)
    assert fan.play([CALM] * 3, SLOW) == [(3, Transition.CLEARED)]


def test_after_commissioning_every_speed_counts_again() -> None:
    fan = Fan()
    fan.play([(UP, LOW, LOW)])
    fan.conditions.request(Action.COMMISSION, [0], 0)
    assert fan.play([CALM] * 3, SLOW) == [(3, Transition.CLEARED)]


ratio = st.sampled_from([LOW, LOW, LOW, MID, UP, 3.0, NONE])


@settings(max_examples=30, deadline=None)
@given(
    history=st.lists(st.tuples(st.tuples(ratio, ratio, ratio), st.sampled_from([0.0, SLOW, FULL, NONE])), max_size=120),
    cut=st.integers(0, 120),
)
def test_neither_blocks_nor_a_restart_change_anything(history: list[tuple[Sample, float]], cut: int) -> None:
    def played(*stretches: list[tuple[Sample, float]]) -> tuple[list[Any], dict[str, Any]]:
        conditions, events, first = TrayConditions(1, SETTINGS), [], 0
        for stretch in stretches:
            if not stretch:
                continue
            restarted = TrayConditions(1, SETTINGS)
            restarted.restore(json.loads(json.dumps(conditions.snapshot(), allow_nan=False)))
            conditions = restarted
            ratios = np.array([sample for sample, _ in stretch])[:, :, np.newaxis]
            speed = np.array([speed for _, speed in stretch])[:, np.newaxis]
            score = np.where(np.isnan(ratios).all(axis=1), np.nan, np.nan_to_num(ratios).max(axis=1))
            t_ns = (first + np.arange(len(stretch))) * STEP_NS
            result = conditions.update(t_ns, STEP_NS, score, np.isfinite(score), ratios, speed)
            events += [(event.row + first, event.transition, event.alarm_state) for event in result.events]
            first += len(stretch)
        return events, conditions.snapshot()

    whole = played(history)
    assert played(history[:cut], history[cut:]) == whole
    assert played(*([sample] for sample in history)) == whole


def test_the_longer_an_alarm_has_stood_the_longer_it_must_be_gone() -> None:
    fan = Fan()
    fan.play([(UP, LOW, LOW)] * 100)
    assert fan.play([CALM] * 9 + [(UP, LOW, LOW)] + [CALM] * 10) == [], "hidden for a moment by an error of the twin"
    assert fan.play([CALM] * 5) == [(121, Transition.CLEARED)]
