"""Alarm messages: one line per event, in the units of the tray."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from fantwin.schemas.enums import Severity, Statistic, Transition
from fantwin.schemas.messages import Alarm, Diagnosis
from fantwin.schemas.units import SpeedUnit
from fantwin.scoring.alarms.alarm_text import AlarmText, deviation_in


def line(
    transition: Transition = Transition.RAISED, *, unit: SpeedUnit = "rad/s", refusal: str = "", **more: Any
) -> str:
    reported: dict[str, Any] = {
        **{"fan": 2, "active": True, "severity": Severity.WARNING, "t_ns": 0, "onset_t_ns": 0, "message": ""},
        **{"residual_rad_s": -71.2, "residual_std_rad_s": 8.0, "statistic": Statistic.DEVIATION, "score": 8.9},
        **{"torque_balance_command": 12.34, "torque_balance_std_command": 3.0},
    }
    return AlarmText(unit, "%").of(Alarm(transition=transition, **reported | more), refusal)


BLOCKED = Diagnosis(cause="drag_up", probability=0.87, evidence="drag +62 % (95 %: 55 to 70)")
NOT_YET = Diagnosis(
    cause="cannot_tell",
    probability=0.9,
    evidence="cannot tell yet: too few speeds since the onset",
)


def test_a_deviation_of_the_speed_is_in_the_trays_unit() -> None:
    assert line() == "fan 2: 71 rad/s slower than when healthy (± 16)"
    assert line(unit="rpm", residual_rad_s=100.0) == "fan 2: 955 rpm faster than when healthy (± 153)"
    assert deviation_in(line(causes=(BLOCKED,)).removeprefix("fan 2: ")) == "71 rad/s slower than when healthy (± 16)"


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"residual_rad_s": 0.0}, "takes 12 % more than when healthy (± 6)"),
        ({"residual_rad_s": 0.0, "torque_balance_command": -0.5}, "takes 0.5 % less than when healthy (± 6)"),
        ({"statistic": Statistic.WEAR}, "slowly, 71 rad/s slower than when healthy (± 16)"),
        ({"statistic": Statistic.MISSING_READINGS}, "the tacho loses readings"),
        ({"statistic": Statistic.STANDSTILL}, "does not turn or stop as commanded"),
    ],
    ids=str,
)
def test_every_statistic_has_its_words(more: dict[str, Any], expected: str) -> None:
    assert line(**more) == f"fan 2: {expected}"
    assert line(Transition.SEVERITY, **more) == f"fan 2: {expected}"


def test_the_first_cause_is_named_with_its_probability_and_evidence_where_there_is_one() -> None:
    known = "more drag (airflow blocked, filter clogged), 87 %: drag +62 % (95 %: 55 to 70)"
    assert line(causes=(BLOCKED, NOT_YET)) == f"fan 2: 71 rad/s slower than when healthy (± 16); {known}"
    assert line(Transition.DIAGNOSED, causes=(BLOCKED, NOT_YET)) == f"fan 2: {known}"
    assert line(causes=(NOT_YET, BLOCKED)) == "fan 2: 71 rad/s slower than when healthy (± 16)"
    assert line(Transition.DIAGNOSED, causes=(NOT_YET,)) == "fan 2: cannot tell yet: too few speeds since the onset"
    assert line(Transition.DIAGNOSED, causes=(replace(NOT_YET, evidence=""),)) == "fan 2: cannot tell yet"
    assert line(Transition.DIAGNOSED) == "fan 2: cause unknown"


def test_causes_of_a_fan_that_comes_to_rest_are_named_beside_those_of_one_that_turns() -> None:
    no_power = Diagnosis(cause="no_power", probability=0.5, evidence="slows down to 40 % of its speed")
    weak = Diagnosis(cause="gain_down", probability=0.2)
    found = line(Transition.DIAGNOSED, causes=(no_power, weak))
    assert found == "fan 2: slows down to 40 % of its speed: no power 50 %, less drive (supply, driver) 20 %"
    assert line(causes=(no_power, weak)) == found, "how much slower it was some time ago would contradict it"
    assert deviation_in(found.removeprefix("fan 2: ")) == "slows down to 40 % of its speed"


@pytest.mark.parametrize("transition", [t for t in Transition if t != Transition.NONE])
def test_every_transition_is_one_line_that_names_the_fan(transition: Transition) -> None:
    reported = line(transition, refusal="it is active", causes=(BLOCKED,))
    assert reported.startswith("fan 2: ") and len(reported) > len("fan 2: ") and "\n" not in reported
