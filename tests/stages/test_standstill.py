"""Stopping, standing and starting through twin integrator and scorer: states of a healthy fan, and what is not."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fantwin.pipeline.tray_scoring.healthy_twin import known_of
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.schemas.blocks import join
from fantwin.schemas.enums import FanState, Transition
from fantwin.schemas.messages import Alarm, Prediction, Score
from fantwin.schemas.reference_conditions import ReferenceConditions
from fantwin.schemas.standstill import Standstill
from fantwin.scoring.alarms.current_alarms import current_alarm
from tests.support.integrated_twins import core_of, grid_of, physical_twin, run_freely, split

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
    predicted_rad_s: Floats
    alarms: list[Alarm]

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


def since(from_s: float) -> slice:
    return slice(round(from_s / PERIOD_S), None)


def seen(
    runs: Mapping[str, tuple[Floats, Floats]],
    supply_v: Floats | None = None,
    conditions: ReferenceConditions | None = None,
) -> dict[str, Seen]:
    """What integrator and scorer make of the commands and readings of fans of one tray; each goes on as it ends."""
    fans, samples = len(runs), max(len(command) for command, _ in runs.values())
    command, speed = (
        np.column_stack([np.pad(pair[which], (0, samples - len(pair[0])), "edge") for pair in runs.values()])
        for which in (0, 1)
    )
    predicting = physical_twin(fans, standstill=HEALTHY)
    predicting = replace(predicting, card=replace(predicting.card, conditions=conditions))
    integrator = core_of(predicting, warm_up_s=1.0)
    scorer = ScorerCore(fans, "rad/s", ScorerConfig(), known_of(predicting))
    grid = grid_of(command, speed, period_ns=round(PERIOD_S * 1e9))
    if supply_v is not None:
        grid = replace(grid, supply_voltage_v=supply_v[:, np.newaxis])
    predictions = [each for part in split(grid, 32) for each in integrator.step(part) if isinstance(each, Prediction)]
    messages = [message for each in predictions for message in scorer.step(each)]
    score = join([message for message in messages if isinstance(message, Score)])
    found = {}
    for fan, (name, (own, _)) in enumerate(runs.items()):
        ends_ns = EPOCH_NS + len(own) * grid.period_ns
        alarms = [each for each in messages if isinstance(each, Alarm) and each.fan == fan and each.t_ns <= ends_ns]
        found[name] = Seen(score.state[:, fan], score.predicted_speed_rad_s[:, fan], alarms)
    return found


STOPPED_AND_STARTED = commands((80.0, 10.0), (0.0, 20.0), (25.0, 8.0))
AT_ITS_MINIMUM = commands((25.0, 13.0), (0.0, 4.0), (25.0, 18.0))
STARTED = commands((80.0, 10.0), (0.0, 12.0), (80.0, 4.0))
STOPPED = commands((80.0, 10.0), (0.0, 28.0))
TIMES_S = np.arange(len(STOPPED)) * PERIOD_S
RUNNING = commands((80.0, 24.0))
STANDING_RAD_S = HEALTHY.standing_below_rad_s


def with_speed(command: Floats, from_s: float, speed: Floats | float, driven: Floats | None = None) -> Any:
    """The command, and the speed under it or what drives the fan, which is another one from a time on."""
    found = speed_of(command if driven is None else driven)
    found[since(from_s)] = speed
    return command, found


def losing(level: float) -> tuple[Floats, Floats]:
    """The command of a fan at 80, and its speed while its drive gives `level` from 10 s on."""
    return RUNNING, speed_of(commands((80.0, 10.0), (level, 14.0)))


def coasting(constant_s: float) -> tuple[Floats, Floats]:
    return with_speed(STOPPED, 10.0, speed_of(STOPPED)[199] * np.exp(-(TIMES_S[since(10.0)] - 10.0) / constant_s))


def runs() -> dict[str, tuple[Floats, Floats]]:
    slower = commands((80.0, 18.0), (25.0, 8.0))
    again = commands((80.0, 20.0), (0.0, 5.0), (80.0, 6.0))
    loose = commands((80.0, 18.0), (0.0, 12.0), (80.0, 6.0))
    lost = np.random.default_rng(5).random(len(loose)) < np.where(np.arange(len(loose)) * PERIOD_S > 10.0, 0.4, 0.0)
    healthy = speed_of(STOPPED_AND_STARTED)
    blocked = speed_of(AT_ITS_MINIMUM)
    blocked[round(8.0 / PERIOD_S) : round(20.0 / PERIOD_S)] = 0.0
    since_s = np.arange(len(RUNNING)) * PERIOD_S - 10.0
    courses = {
        "held": 0.0 * since_s,
        "slow, then held": 0.8 * (since_s < 6.0),
        "at half speed, then held": 0.5 * (since_s < 6.0),
        "held, and jerking": 0.2 * (since_s % 3.0 > 2.7),
    }
    last = speed_of(slower)
    last[since(12.0)] *= 0.8
    last[since(22.0)] = 0.0
    return {
        "healthy": (STOPPED_AND_STARTED, healthy),
        "healthy, without readings at rest": (STOPPED_AND_STARTED, np.where(healthy < 60.0, np.nan, healthy)),
        "blocked": (AT_ITS_MINIMUM, blocked),
        "slower, then blocked": (slower, last),
        "without power": losing(0.0),
        "without power, then switched": (again, speed_of(commands((80.0, 10.0), (0.0, 21.0)))),
        "weak drive": losing(40.0),
        "does not start": with_speed(STARTED, 22.0, 0.0),
        "gives no reading": with_speed(STARTED, 22.0, np.nan),
        "driven on": (STOPPED, speed_of(commands((80.0, 18.0), (0.0, 20.0)))),
        "turns again": (STOPPED, speed_of(commands((80.0, 10.0), (0.0, 15.0), (40.0, 5.0), (0.0, 8.0)))),
        "coasts": coasting(2.5),
        "coasts for long": coasting(5.0),
        **{
            name: with_speed(RUNNING, 10.0, (speed_of(RUNNING) * shares)[since(10.0)])
            for name, shares in courses.items()
        },
        "loose contact": (loose, np.where(lost, np.nan, speed_of(loose))),
    }


@pytest.fixture(scope="module")
def found(one_reading_starts: None) -> dict[str, Seen]:
    """Of one tray: fans do not affect one another."""
    return seen(runs())


@pytest.mark.parametrize("name", ["healthy", "healthy, without readings at rest"])
def test_a_fan_that_is_stopped_stands_and_starts_again_is_healthy(found: dict[str, Seen], name: str) -> None:
    its = found[name]
    assert its.alarms == []
    assert {its.at(t) for t in (10.0, 11.0, 20.0, 29.9)} == {FanState.STOPPED}, "coasting and standing"
    assert (its.at(9.0), its.at(30.2), its.at(37.0)) == (FanState.NORMAL, FanState.STARTING, FanState.NORMAL)
    at_rest = np.isnan(its.predicted_rad_s[round(10.0 / PERIOD_S) : round(30.0 / PERIOD_S)])
    assert at_rest.all(), "the free run ends with the command that stops the fan"


def test_a_blocked_fan_at_its_minimum_is_an_alarm_that_a_stop_does_not_end(found: dict[str, Seen]) -> None:
    its = found["blocked"]
    (raised_s,) = its.times(Transition.RAISED)
    assert 8.0 < raised_s < 8.8
    raised = its.alarms[0]
    assert "does not turn although commanded to 25; it ran on for 0.0 s" in raised.message
    assert [each.cause for each in raised.causes[:2]] == ["blocked", "no_tacho"]
    assert its.times(Transition.DATA_LOST) == [], "it is judged by whether it stands"
    (cleared_s,) = its.times(Transition.CLEARED)
    assert 32.9 <= cleared_s < 34.0, "ten seconds after it is compared with its twin again"
    assert current_alarm(its.alarms).causes[0].cause == "blocked"


@pytest.mark.parametrize("name", ["held", "slow, then held", "at half speed, then held", "held, and jerking"])
def test_a_fan_that_is_held_is_blocked_whatever_it_did_before(found: dict[str, Seen], name: str) -> None:
    last = found[name].alarms[-1].causes[0]
    assert last.cause == "blocked" and re.search(r"it ran on for 0\.[01] s", last.evidence), last


@pytest.mark.parametrize("conditions", [None, ReferenceConditions(supply_voltage_v=12.0)])
def test_a_fan_whose_supply_is_gone_has_no_power_whether_or_not_its_twin_knows_the_voltage(
    conditions: ReferenceConditions | None,
) -> None:
    command = commands((60.0, 20.0))
    since_s = PERIOD_S * np.arange(len(command)) - 10.0
    speed = speed_of(command)
    coasts = np.where(since_s > 6.0, 0.0, speed[round(10.0 / PERIOD_S)] * np.exp(-np.maximum(since_s, 0.0)))
    run = {"": (command, np.where(since_s < 0.0, speed, coasts))}
    named = seen(run, np.where(since_s < 0.0, 12.0, 0.1), conditions)[""].alarms[-1]
    assert named.causes[0].cause == "no_power" and named.causes[0].probability > 0.85
    assert "does not turn although commanded to 60" in named.message
    assert (named.t_ns - EPOCH_NS) / 1e9 < 20.0


def test_the_command_that_a_fan_does_not_follow_is_the_one_of_now(found: dict[str, Seen]) -> None:
    assert "does not turn although commanded to 25" in found["slower, then blocked"].alarms[-1].message


def test_no_power_is_named_as_soon_as_the_fan_comes_to_rest_and_nothing_else_before(found: dict[str, Seen]) -> None:
    its, (_, speed) = found["without power"], losing(0.0)
    named = [alarm for alarm in its.alarms if alarm.causes and alarm.causes[0].cause != "cannot_tell"]
    assert {alarm.causes[0].cause for alarm in named} == {"no_power"}
    assert its.times(Transition.RAISED)[0] < 10.5
    at_rest_s = float(np.flatnonzero(speed[since(10.0)] < STANDING_RAD_S)[0]) * PERIOD_S + 10.0
    assert "does not turn although commanded to 80; it ran on for " in named[0].message
    assert at_rest_s - 0.5 < (named[0].t_ns - EPOCH_NS) / 1e9 < at_rest_s + 0.7


def test_a_fan_that_is_switched_off_and_does_not_start_again_keeps_the_cause_for_which_it_came_to_rest(
    found: dict[str, Seen],
) -> None:
    its = found["without power, then switched"]
    assert len(its.times(Transition.RAISED)) == 1
    last = its.alarms[-1].causes[0]
    assert last.cause == "no_power" and last.probability > 0.55 and "has not started" not in last.evidence


def test_a_weak_drive_is_not_taken_for_no_power_and_what_would_tell_an_unclear_cause_is_said(
    found: dict[str, Seen],
) -> None:
    causes = [alarm.causes for alarm in found["weak drive"].alarms if alarm.causes]
    assert "no_power" not in {each[0].cause for each in causes}
    later = causes[-1]
    if later[0].cause == "cannot_tell":
        assert ": move the command to " in later[0].evidence
    assert "gain_down" in [each.cause for each in later]


@pytest.mark.parametrize(
    ("name", "limit_s", "causes"),
    [("does not start", 3.0, ["blocked", "no_power", "no_tacho"]), ("gives no reading", 2.0, ["no_tacho"])],
)
def test_a_fan_that_does_not_start_is_an_alarm_after_three_times_the_longest_start(
    found: dict[str, Seen], name: str, limit_s: float, causes: list[str]
) -> None:
    (raised_s,) = found[name].times(Transition.RAISED)
    assert 22.0 + limit_s < raised_s < 22.3 + limit_s
    assert [each.cause for each in found[name].alarms[0].causes if each.probability > 0.15] == causes


def test_a_fan_that_turns_although_its_command_stops_it_is_an_alarm_that_returns_once_it_stands(
    found: dict[str, Seen],
) -> None:
    its, (_, speed) = found["driven on"], runs()["driven on"]
    (raised_s,) = its.times(Transition.RAISED)
    assert 11.5 < raised_s < 11.8, "three times as long as a healthy fan needs to lose 30 % of its speed"
    assert its.alarms[0].message.endswith(
        ": keeps its speed although the command of 0 stops it: still driven 70 %, turned by the air 30 %"
    )
    at_rest_s = float(np.flatnonzero((speed < STANDING_RAD_S) & (TIMES_S >= 18.0))[0]) * PERIOD_S
    (cleared_s,) = its.times(Transition.CLEARED)
    assert cleared_s == pytest.approx(at_rest_s + 2.0, abs=0.2)
    assert its.at(37.0) == FanState.STOPPED


def test_a_fan_that_turns_after_it_has_been_at_rest_is_an_alarm_and_one_that_coasts_slowly_is_not(
    found: dict[str, Seen],
) -> None:
    its, (_, speed) = found["turns again"], runs()["turns again"]
    (raised_s,) = its.times(Transition.RAISED)
    turns_s = float(np.flatnonzero(speed[since(25.0)] > STANDING_RAD_S)[0]) * PERIOD_S + 25.0
    assert turns_s + 1.0 <= raised_s < turns_s + 1.3
    (cleared_s,) = its.times(Transition.CLEARED)
    assert 32.0 < cleared_s < 37.0
    assert [len(found[name].times(Transition.RAISED)) for name in ("coasts", "coasts for long")] == [0, 1]


def test_a_stop_says_nothing_about_a_loose_contact(found: dict[str, Seen]) -> None:
    """The tacho loses 40 % of its readings; the alarm outlasts a stop."""
    its = found["loose contact"]
    assert len(its.times(Transition.RAISED)) == 1
    assert its.times(Transition.CLEARED) == []
