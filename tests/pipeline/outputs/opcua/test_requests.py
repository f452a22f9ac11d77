"""What the scorer's answers are by OPC UA."""

from __future__ import annotations

import pytest

from fantwin.pipeline.outputs.opcua.requests import FAN_METHODS, METHODS, SHELVING_METHODS, status_of
from fantwin.schemas.enums import Action, Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_state import GIVES_FEEDBACK, FanCondition
from tests.support.site_messages import alarm

NOW_NS = 1_790_000_000_000_000_000


def answers(*actions: Action, raised: bool = True, duration_ns: float = 0.0) -> Alarm:
    """What a fan's condition answers to the last of several requests."""
    condition = FanCondition()
    if raised:
        condition.update(active=True, severity=Severity.ALARM, onset_t_ns=NOW_NS)
    transition = Transition.NONE
    for action in actions:
        transition, _ = condition.request(action, NOW_NS, duration_ns, "ann", "")
    now = condition.alarm_state
    return alarm(
        transition,
        active=now.active,
        severity=now.severity,
        acknowledged=now.acknowledged,
        shelved_until_t_ns=now.shelved_until_t_ns,
        out_of_service=now.out_of_service,
    )


A = Action


@pytest.mark.parametrize(
    ("actions", "raised", "duration_ns", "status"),
    [
        ((A.ACKNOWLEDGE,), True, 0, "Good"),
        ((A.ACKNOWLEDGE, A.ACKNOWLEDGE), True, 0, "BadConditionBranchAlreadyAcked"),
        ((A.ACKNOWLEDGE,), False, 0, "BadInvalidState"),
        ((A.SHELVE, A.SHELVE), True, 0, "BadConditionAlreadyShelved"),
        ((A.SHELVE,), True, float("inf"), "BadShelvingTimeOutOfRange"),
        ((A.UNSHELVE,), True, 0, "BadConditionNotShelved"),
        ((A.OUT_OF_SERVICE, A.IN_SERVICE), True, 0, "Good"),
        ((A.IN_SERVICE,), True, 0, "BadInvalidState"),
        ((A.COMMISSION,), True, 0, "Good"),
    ],
)
def test_a_refused_request_has_the_status_code_of_part_9(actions, raised, duration_ns, status):
    assert status_of(answers(*actions, raised=raised, duration_ns=duration_ns), actions[-1]) == status


def test_every_action_of_an_operator_has_a_method():
    asked = {method.action for method in (*METHODS, *SHELVING_METHODS, *FAN_METHODS)} - {None}
    otherwise = {Action.NONE, *GIVES_FEEDBACK, Action.SWEEP, Action.STOP_SWEEP}
    assert asked == set(Action) - otherwise, "feedback is given otherwise, and only the page may have fans moved"
