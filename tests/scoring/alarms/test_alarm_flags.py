"""scoring.alarms.alarm_state: retained, silenced, presented and listed, for a scorer's state and for a message."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fantwin.schemas.enums import Action, Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_state import (
    UNTIL_IT_CLEARS_T_NS,
    AlarmState,
    FanCondition,
    is_listed,
    is_presented,
    is_retained,
    is_silenced,
)

ACTIVE = {"active": True, "acknowledged": False}
OVER = {"active": False, "acknowledged": True}


@pytest.mark.parametrize(
    ("flags", "retained", "silenced"),
    [
        (ACTIVE, True, False),
        (ACTIVE | {"acknowledged": True}, True, False),
        (ACTIVE | {"active": False}, True, False),
        (OVER, False, False),
        (OVER | {"out_of_service": True}, False, True),
        (ACTIVE | {"shelved_until_t_ns": 5}, True, True),
        (ACTIVE | {"shelved_until_t_ns": UNTIL_IT_CLEARS_T_NS}, True, True),
        (ACTIVE | {"out_of_service": True}, True, True),
    ],
    ids=str,
)
def test_a_state_and_its_message_agree_on_retained_silenced_presented_and_listed(flags, retained, silenced):
    message = Alarm(
        fan=0,
        severity=Severity.ALARM,
        t_ns=1,
        onset_t_ns=1,
        residual_rad_s=0.0,
        residual_std_rad_s=0.0,
        message="",
        **flags,
    )
    for alarm in (AlarmState(**flags), message):
        assert (is_retained(alarm), is_silenced(alarm)) == (retained, silenced)
        assert is_presented(alarm) == (retained and not silenced)
        assert is_listed(alarm) == (retained or silenced)


def test_an_alarm_that_was_never_raised_is_on_no_list():
    assert not is_listed(AlarmState())


def test_a_comment_changes_nothing_else_and_needs_an_alarm_and_words():
    condition = FanCondition()
    asked = (Action.COMMENT, 7, 0.0, "ann")
    assert condition.request(*asked, "seen") == (Transition.REFUSED, "no alarm has been raised")
    condition.update(active=True, severity=Severity.ALARM, onset_t_ns=3)
    before = condition.alarm_state
    assert condition.request(*asked, " ") == (Transition.REFUSED, "there is no comment")
    assert condition.request(*asked, "the part is ordered") == (Transition.COMMENTED, "")
    assert condition.alarm_state == replace(before, comment="the part is ordered")
