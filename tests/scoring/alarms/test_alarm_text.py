"""scoring.alarms.alarm_text: one line per event, in the units of the tray."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from schemas.enums import Severity, Statistic, Transition
from schemas.messages import Alarm, Diagnosis
from schemas.units import SpeedUnit
from scoring.alarms.alarm_text import AlarmText
from scoring.diagnosis.diagnosis import CANNOT_TELL, DROPOUT, STUCK
from scoring.diagnosis.hypotheses import CAUSES as HYPOTHESES
from scoring.diagnosis.shown_causes import CAUSES, STANDSTILL_CAUSES, short_name


def line(
    transition: Transition = Transition.RAISED, *, unit: SpeedUnit = "rad/s", refusal: str = "", **more: Any
) -> str:
    reported: dict[str, Any] = {
        **{"fan": 2, "active": True, "severity": Severity.WARNING, "t_ns": 0, "onset_t_ns": 0, "message": ""},
        **{"residual_rad_s": -71.2, "limit_rad_s": 8.0, "statistic": Statistic.SPEED_SMOOTHED, "score": 8.9},
        **{"torque_balance_command": 12.34, "torque_balance_limit_command": 3.0},
    }
    return AlarmText(unit, "%").of(Alarm(transition=transition, **reported | more), refusal)


BLOCKED = Diagnosis(cause="drag_up", probability=0.87, evidence="drag +62 % (95 %: 55 to 70)")
NOT_YET = Diagnosis(
    cause="cannot_tell",
    probability=0.9,
    evidence="cannot tell yet: too few speeds since the onset",
)


def test_a_deviation_of_the_speed_is_in_the_trays_unit() -> None:
    assert line() == "fan 2: 71 rad/s below the twin (limit 8)"
    assert line(unit="rpm", residual_rad_s=100.0) == "fan 2: 955 rpm above the twin (limit 76)"


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"statistic": Statistic.SPEED_DRIFT}, "71 rad/s below the twin (limit 8), for long"),
        ({"statistic": Statistic.SPEED_VARIANCE_GROWTH}, "unsteady, 8.9 times the limit"),
        ({"statistic": Statistic.BALANCE_VARIANCE_GROWTH}, "unsteady, 8.9 times the limit"),
        ({"statistic": Statistic.BALANCE_SMOOTHED}, "takes 12 % more than a healthy one (limit 3)"),
        (
            {"statistic": Statistic.BALANCE_DRIFT, "torque_balance_command": -0.5},
            "takes 0.5 % less than a healthy one (limit 3), for long",
        ),
        ({"statistic": Statistic.SENSOR}, "the tacho repeats one reading, or gives none"),
    ],
)
def test_every_statistic_has_its_words(more: dict[str, Any], expected: str) -> None:
    assert line(**more) == f"fan 2: {expected}"
    assert line(Transition.SEVERITY, **more) == f"fan 2: {expected}"


def test_the_first_cause_is_named_with_its_probability_and_evidence_where_there_is_one() -> None:
    known = "more drag (airflow blocked, filter clogged), 87 %: drag +62 % (95 %: 55 to 70)"
    assert line(causes=(BLOCKED, NOT_YET)) == f"fan 2: 71 rad/s below the twin (limit 8); {known}"
    assert line(Transition.DIAGNOSED, causes=(BLOCKED, NOT_YET)) == f"fan 2: {known}"
    assert line(causes=(NOT_YET, BLOCKED)) == "fan 2: 71 rad/s below the twin (limit 8)"
    assert line(Transition.DIAGNOSED, causes=(NOT_YET,)) == "fan 2: cannot tell yet: too few speeds since the onset"
    assert line(Transition.DIAGNOSED, causes=(replace(NOT_YET, evidence=""),)) == "fan 2: cannot tell yet"
    assert line(Transition.DIAGNOSED) == "fan 2: cause unknown"


def test_causes_of_a_fan_that_comes_to_rest_are_named_beside_those_of_one_that_turns() -> None:
    no_power = Diagnosis(cause="no_power", probability=0.5, evidence="slows down to 40 % of its speed")
    weak = Diagnosis(cause="gain_down", probability=0.2)
    found = line(Transition.DIAGNOSED, causes=(no_power, weak))
    assert found == "fan 2: slows down to 40 % of its speed: no power 50 %, less drive (supply, driver) 20 %"


def test_every_cause_that_can_be_found_has_words() -> None:
    assert set(CAUSES) == {cause.name for cause in HYPOTHESES} | {CANNOT_TELL, STUCK, DROPOUT} | set(STANDSTILL_CAUSES)
    assert [cause for cause in CAUSES if "_" in short_name(cause) or "(" in short_name(cause)] == []


@pytest.mark.parametrize("transition", [t for t in Transition if t != Transition.NONE])
def test_every_transition_is_one_line_that_names_the_fan(transition: Transition) -> None:
    reported = line(transition, refusal="it is active", causes=(BLOCKED,))
    assert reported.startswith("fan 2: ") and len(reported) > len("fan 2: ") and "\n" not in reported
