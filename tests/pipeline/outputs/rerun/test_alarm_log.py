"""The lines of the viewer's alarm log: what happened, how bad it is, and short enough to be read."""

from __future__ import annotations

from typing import Any

import pytest

from fantwin.pipeline.outputs.rerun.alarm_log import LINE_LENGTH, log_line
from fantwin.schemas.enums import Severity, Statistic, Transition
from fantwin.schemas.messages import Diagnosis
from tests.support import made_messages

RAISED, REPUBLISHED = Transition.RAISED, Transition.REPUBLISHED
DRAG = (Diagnosis(cause="external_torque", probability=0.64),)
CALM = {"active": False, "severity": Severity.NONE}


@pytest.mark.parametrize(
    ("transition", "more", "level", "text"),
    [
        (RAISED, {"statistic": Statistic.DEVIATION}, "WARN", "warning raised, speed off, evidence 1.7 x its limit"),
        (
            Transition.SEVERITY,
            {"severity": Severity.ALARM, "statistic": Statistic.STANDSTILL},
            "ERROR",
            "alarm severity, does not turn as commanded",
        ),
        (Transition.DIAGNOSED, {"causes": DRAG}, "INFO", "probably an external torque 64 %"),
        (REPUBLISHED, {"severity": Severity.ALARM}, "ERROR", "alarm goes on, after a restart"),
        (REPUBLISHED, CALM, "INFO", "no alarm, after a restart"),
        (REPUBLISHED, {"active": False}, "INFO", "back to normal, after a restart"),
        (Transition.ACKNOWLEDGED, {"operator_name": "ann"}, "INFO", "acknowledged by ann"),
        (
            Transition.REFUSED,
            {"operator_name": "ann", "message": "fan 0: refused: " + "it is not so " * 20},
            "INFO",
            "request by ann refused: it is not so it is not so it is…",
        ),
    ],
)
def test_a_line_says_what_happened_and_is_short(
    transition: Transition, more: dict[str, Any], level: str, text: str
) -> None:
    fields = {"severity": Severity.WARNING, "score": 1.73, "message": "so " * 99, "transition": transition}
    line = log_line(made_messages.alarm(0, 1, **fields | more))
    assert line == ("tray1", 1, level, f"fan 0: {text}")
    assert len(line.text) <= LINE_LENGTH
