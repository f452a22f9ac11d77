"""What a replay that verifies a recording compares of its alarms."""

from __future__ import annotations

import pytest

from pipeline.replay.offline.verify import Comparison, compare_alarms
from schemas.messages import Alarm, Severity, Transition


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
