"""Stopping, standing and starting through twin integrator and scorer: states of a healthy fan, and what is not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fantwin.pipeline.tray_scoring.healthy_twin import known_of
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.schemas.blocks import cut
from fantwin.schemas.enums import FanState, InvalidReason, Transition
from fantwin.schemas.messages import Alarm, Grid, Prediction, Score
from fantwin.schemas.reference_conditions import ReferenceConditions
from fantwin.schemas.standstill import Standstill
from fantwin.scoring.alarms.current_alarms import current_alarm
from tests.support.integrated_twins import core_of, physical_twin, run_freely

pytestmark = pytest.mark.usefixtures("one_reading_starts")

EPOCH_NS = 1_700_000_000_000_000_000
PERIOD_S = 0.05
HEALTHY = Standstill(
    turning_command=20.0,
    standing_below_rad_s=50.0,
    off_command=0.0,
    start_s=1.0,
    coast_s=4.0,
    slowing_s=0.5,
    coast_time_constant_s=1.0,
)
Floats = NDArray[np.float64]


@dataclass
class Seen:
    """What a scorer emitted for one fan; times in s since the first sample."""

    state: NDArray[np.uint8]
    scores: Floats
    predicted_rad_s: Floats
    alarms: list[Alarm]
    problem: str

    def at(self, seconds: float) -> FanState:
        return FanState(self.state[round(seconds / PERIOD_S)])

    def times(self, transition: Transition) -> list[float]:
        return [round((a.t_ns - EPOCH_NS) / 1e9, 3) for a in self.alarms if a.transition == transition]


def commands(*levels: tuple[float, float]) -> Floats:
    return np.concatenate([np.full(round(seconds / PERIOD_S), level) for level, seconds in levels])


def speed_of(command: Floats) -> Floats:
    """The speed of a healthy fan that begins at rest."""
    speed, _ = run_freely(np.zeros((1, 2)), command[:, np.newaxis], np.full(len(command), PERIOD_S))
    return np.asarray(speed[:, 0])


def seen(
    command: Floats,
    speed: Floats,
    *,
    block: int = 32,
    healthy: Standstill | None = HEALTHY,
    supply_v: Floats | None = None,
    conditions: ReferenceConditions | None = None,
) -> Seen:
    """What integrator and scorer make of readings."""
    predicting = physical_twin(standstill=healthy)
    predicting = replace(predicting, card=replace(predicting.card, conditions=conditions))
    integrator, scorer = (
        core_of(predicting, warm_up_s=1.0),
        ScorerCore(1, "rad/s", ScorerConfig(), known_of(predicting)),
    )
    messages, problems = [], set()
    valid = np.isfinite(speed)[:, np.newaxis]
    grid = Grid(
        fans=1,
        period_ns=round(PERIOD_S * 1e9),
        t_ns=EPOCH_NS + np.arange(len(command)) * round(PERIOD_S * 1e9),
        command=command[:, np.newaxis],
        speed_rad_s=speed[:, np.newaxis],
        valid=valid,
        invalid_reason=np.where(valid, InvalidReason.NONE, InvalidReason.NO_SPEED).astype(np.uint8),
        supply_voltage_v=np.zeros(0) if supply_v is None else supply_v[:, np.newaxis],
    )
    for first in range(0, len(command), block):
        for prediction in integrator.step(cut(grid, first, min(first + block, len(command)))):
            if isinstance(prediction, Prediction):
                messages += scorer.step(prediction)
                problems.add(scorer.problem())
    scores = [m for m in messages if isinstance(m, Score)]
    return Seen(
        np.concatenate([score.state[:, 0] for score in scores]),
        np.concatenate([score.score[:, 0] for score in scores]),
        np.concatenate([score.predicted_speed_rad_s[:, 0] for score in scores]),
        [m for m in messages if isinstance(m, Alarm)],
        "; ".join(sorted(problems - {""})),
    )


@pytest.mark.parametrize("unread_below_rad_s", [0.0, 60.0])
def test_a_fan_that_is_stopped_stands_and_starts_again_is_healthy_also_without_readings_at_rest(
    unread_below_rad_s: float,
) -> None:
    command = commands((80.0, 10.0), (0.0, 20.0), (25.0, 8.0))
    speed = speed_of(command)
    found = seen(command, np.where(speed < unread_below_rad_s, np.nan, speed))
    assert found.alarms == []
    assert {found.at(t) for t in (10.0, 11.0, 20.0, 29.9)} == {FanState.STOPPED}, "coasting and standing"
    assert (found.at(9.0), found.at(30.2), found.at(37.0)) == (FanState.NORMAL, FanState.STARTING, FanState.NORMAL)
    at_rest = np.isnan(found.predicted_rad_s[round(10.0 / PERIOD_S) : round(30.0 / PERIOD_S)])
    assert at_rest.all(), "the free run ends with the command that stops the fan"
    if not unread_below_rad_s:
        assert found.problem == "", "a fan that stands as commanded is judged"


def test_a_blocked_fan_at_its_minimum_is_an_alarm_that_a_stop_does_not_end() -> None:
    command = commands((25.0, 13.0), (0.0, 4.0), (25.0, 18.0))
    speed = speed_of(command)
    speed[round(8.0 / PERIOD_S) : round(20.0 / PERIOD_S)] = 0.0
    found = seen(command, speed, block=7)
    (raised_s,) = found.times(Transition.RAISED)
    assert 8.0 < raised_s < 8.8
    (raised, *_) = found.alarms
    assert "does not turn although commanded to 25; it ran on for 0.0 s" in raised.message
    assert [each.cause for each in raised.causes[:2]] == ["blocked", "no_tacho"]
    assert found.times(Transition.DATA_LOST) == [], "it is judged by whether it stands"
    (cleared_s,) = found.times(Transition.CLEARED)
    assert 33.0 <= cleared_s < 34.0, "ten seconds after it is compared with its twin again"
    alarm = current_alarm(found.alarms)
    assert alarm.causes[0].cause == "blocked"
    other = seen(command, speed, block=64)
    np.testing.assert_array_equal(found.scores, other.scores)
    assert [vars(alarm) for alarm in found.alarms] == [vars(alarm) for alarm in other.alarms]


@pytest.mark.parametrize("conditions", [None, ReferenceConditions(supply_voltage_v=12.0)])
def test_a_fan_whose_supply_is_gone_has_no_power_whether_or_not_its_twin_knows_the_voltage(
    conditions: ReferenceConditions | None,
) -> None:
    command = commands((60.0, 20.0))
    since_s = PERIOD_S * np.arange(len(command)) - 10.0
    speed = speed_of(command)
    coasting = np.where(since_s > 6.0, 0.0, speed[round(10.0 / PERIOD_S)] * np.exp(-np.maximum(since_s, 0.0)))
    supply_v = np.where(since_s < 0.0, 12.0, 0.1)
    found = seen(command, np.where(since_s < 0.0, speed, coasting), supply_v=supply_v, conditions=conditions)
    named = found.alarms[-1]
    assert named.causes[0].cause == "no_power" and named.causes[0].probability > 0.85
    assert "does not turn although commanded to 60" in named.message
    assert (named.t_ns - EPOCH_NS) / 1e9 < 20.0


def losing(level: float) -> tuple[Floats, Floats]:
    """The command of a fan at 80, and its speed while its drive gives `level` from 10 s on."""
    command = commands((80.0, 24.0))
    driven = command.copy()
    driven[round(10.0 / PERIOD_S) :] = level
    return command, speed_of(driven)


def test_the_command_that_a_fan_does_not_follow_is_the_one_of_now() -> None:
    command = commands((80.0, 18.0), (25.0, 8.0))
    speed = speed_of(command)
    speed[round(12.0 / PERIOD_S) :] *= 0.8
    speed[round(22.0 / PERIOD_S) :] = 0.0
    (*_, last) = seen(command, speed).alarms
    assert "does not turn although commanded to 25" in last.message


def test_no_power_is_named_as_soon_as_the_fan_comes_to_rest_and_nothing_else_before() -> None:
    command, speed = losing(0.0)
    found = seen(command, speed)
    named = [alarm for alarm in found.alarms if alarm.causes and alarm.causes[0].cause != "cannot_tell"]
    assert {alarm.causes[0].cause for alarm in named} == {"no_power"}
    assert found.times(Transition.RAISED)[0] < 10.5
    at_rest_s = float(np.flatnonzero(speed[200:] < HEALTHY.standing_below_rad_s)[0]) * PERIOD_S + 10.0
    assert "does not turn although commanded to 80; it ran on for " in named[0].message
    assert at_rest_s - 0.5 < (named[0].t_ns - EPOCH_NS) / 1e9 < at_rest_s + 0.7


def test_a_fan_that_is_switched_off_and_does_not_start_again_keeps_the_cause_for_which_it_came_to_rest() -> None:
    command = commands((80.0, 20.0), (0.0, 5.0), (80.0, 6.0))
    found = seen(command, speed_of(np.where(np.arange(len(command)) * PERIOD_S < 10.0, 80.0, 0.0)))
    assert len(found.times(Transition.RAISED)) == 1
    last = found.alarms[-1].causes[0]
    assert last.cause == "no_power" and last.probability > 0.55 and "has not started" not in last.evidence


def test_a_weak_drive_is_not_taken_for_no_power_and_what_would_tell_an_unclear_cause_is_said() -> None:
    found = seen(*losing(40.0))
    causes = [alarm.causes for alarm in found.alarms if alarm.causes]
    assert "no_power" not in {each[0].cause for each in causes}
    later = causes[-1]
    if later[0].cause == "cannot_tell":
        assert ": move the command to " in later[0].evidence
    assert "gain_down" in [each.cause for each in later]


@pytest.mark.parametrize(("reading", "causes"), [(0.0, ["blocked", "no_power", "no_tacho"]), (np.nan, ["no_tacho"])])
def test_a_fan_that_does_not_start_is_an_alarm_after_three_times_the_longest_start(
    reading: float, causes: list[str]
) -> None:
    command = commands((80.0, 10.0), (0.0, 12.0), (80.0, 4.0))
    speed = speed_of(command)
    speed[round(22.0 / PERIOD_S) :] = reading
    found = seen(command, speed)
    (raised_s,) = found.times(Transition.RAISED)
    limit_s = 3.0 if reading == 0.0 else 2.0
    assert 22.0 + limit_s < raised_s < 22.3 + limit_s
    assert [each.cause for each in found.alarms[0].causes if each.probability > 0.15] == causes


def test_a_fan_that_turns_although_its_command_stops_it_is_an_alarm_that_returns_once_it_stands() -> None:
    command = commands((80.0, 10.0), (0.0, 28.0))
    driven = np.where(np.arange(len(command)) * PERIOD_S < 18.0, 80.0, 0.0)
    speed = speed_of(driven)
    found = seen(command, speed, block=64)
    (raised_s,) = found.times(Transition.RAISED)
    assert 11.5 < raised_s < 11.8, "three times as long as a healthy fan needs to lose 30 % of its speed"
    assert found.alarms[0].message == (
        "fan 0: keeps its speed although the command of 0 stops it: still driven 70 %, turned by the air 30 %"
    )
    at_rest_s = float(np.flatnonzero((speed < HEALTHY.standing_below_rad_s) & (driven == 0.0))[0]) * PERIOD_S
    (cleared_s,) = found.times(Transition.CLEARED)
    assert cleared_s == pytest.approx(at_rest_s + 2.0, abs=0.2)
    assert found.at(37.0) == FanState.STOPPED


def test_a_fan_that_turns_after_it_has_been_at_rest_is_an_alarm_and_one_that_coasts_slowly_is_not() -> None:
    command = commands((80.0, 10.0), (0.0, 28.0))
    driven = commands((80.0, 10.0), (0.0, 15.0), (40.0, 5.0), (0.0, 8.0))
    found = seen(command, speed_of(driven))
    (raised_s,) = found.times(Transition.RAISED)
    turns_s = float(np.flatnonzero(speed_of(driven)[500:] > HEALTHY.standing_below_rad_s)[0]) * PERIOD_S + 25.0
    assert turns_s + 1.0 < raised_s < turns_s + 1.3
    (cleared_s,) = found.times(Transition.CLEARED)
    assert 32.0 < cleared_s < 37.0
    command = commands((80.0, 10.0), (0.0, 14.0))
    t_s = np.arange(len(command)) * PERIOD_S
    top = speed_of(command)[199]
    for slower, alarms in ((2.5, 0), (5.0, 1)):
        coast = np.where(t_s < 10.0, speed_of(command), top * np.exp(-(t_s - 10.0) / slower))
        assert len(seen(command, coast).times(Transition.RAISED)) == alarms


def test_a_stop_says_nothing_about_a_loose_contact() -> None:
    """The tacho loses 40 % of its readings; the alarm outlasts a stop."""
    command = commands((80.0, 18.0), (0.0, 12.0), (80.0, 6.0))
    lost = np.random.default_rng(5).random(len(command)) < np.where(np.arange(len(command)) * PERIOD_S > 10.0, 0.4, 0.0)
    found = seen(command, np.where(lost, np.nan, speed_of(command)))
    assert len(found.times(Transition.RAISED)) == 1
    assert found.times(Transition.CLEARED) == []
