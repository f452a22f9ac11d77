"""What a replay that verifies a recording compares of its alarms."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pipeline.replay.offline.comparison import Comparison
from pipeline.replay.offline.verify import compare_alarms
from schemas.enums import Severity, Transition
from schemas.messages import Alarm, Diagnosis


def alarm(transition: Transition, message: str) -> Alarm:
    return Alarm(
        fan=0, active=False, severity=Severity.ALARM, t_ns=7, onset_t_ns=5, residual_rad_s=3.0, limit_rad_s=2.0,
        message=message, transition=transition,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("transition", "equal", "different"), [(Transition.REPUBLISHED, 1, 0), (Transition.CLEARED, 0, 1)]
)
def test_lines_are_compared_but_those_of_republished_alarms(transition: Transition, equal: int, different: int) -> None:
    found = Comparison("tray1")
    compare_alarms([alarm(transition, "fan 0: new words")], [alarm(transition, "fan 0: former words")], 100, found)
    assert (found.alarms_equal, found.alarms_different) == (equal, different)


def drag_up(change: float) -> Diagnosis:
    return Diagnosis(cause="drag_up", probability=0.7, parameter="drag", change=change)


@pytest.mark.parametrize(("factor", "equal"), [(1.0, 1), (1.0 + 1e-11, 1), (1.0 + 1e-5, 0)])
def test_numbers_of_causes_may_differ_in_their_last_digits_only(factor: float, equal: int) -> None:
    made, recorded = (
        replace(alarm(Transition.DIAGNOSED, "fan 0: more drag"), causes=(drag_up(change),))
        for change in (0.2, 0.2 * factor)
    )
    found = Comparison("tray1")
    compare_alarms([made], [recorded], 100, found)
    assert (found.alarms_equal, found.alarms_different) == (equal, 1 - equal)
    compare_alarms([made], [replace(made, score=2.0)], 100, found)
    assert found.alarms_different == 2 - equal, "all else is compared to the bit"
