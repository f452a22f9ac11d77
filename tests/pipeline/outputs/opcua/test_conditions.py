"""Alarms as conditions of Part 9, and that the library can send each of them."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("asyncua")

from asyncua import ua
from asyncua.ua.ua_binary import variant_to_binary

from fantwin.pipeline.outputs.opcua.events import condition_event, condition_fields, system_event
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS
from fantwin.scoring.alarms.current_alarms import current_alarm
from tests.support.running_core import TRAY
from tests.support.site_messages import NOW_NS, alarm


def after(*alarms: Alarm, now_ns: int = NOW_NS) -> dict[str, Any]:
    """The values of the condition of fan 2 after these messages."""
    fields = condition_fields(Fan(TRAY, 2), current_alarm(alarms), now_ns, 2)
    values = {path: field.Value for path, field in fields.items()}
    return {path: each.Text if isinstance(each, ua.LocalizedText) else each for path, each in values.items()}


def test_raised_worse_acknowledged_and_cleared():
    raised = after(alarm(severity=Severity.WARNING))
    assert (raised["ActiveState/Id"], raised["AckedState/Id"], raised["Retain"]) == (True, False, True)
    assert (raised["Severity"], raised["LastSeverity"]) == (500, 0)
    worse = after(alarm(severity=Severity.WARNING), alarm(Transition.SEVERITY, 1))
    assert (worse["Severity"], worse["LastSeverity"]) == (900, 500)
    over = after(alarm(), alarm(Transition.CLEARED, 1, active=False))
    assert (over["ActiveState/Id"], over["Retain"]) == (False, True), "until it is acknowledged"
    done = after(alarm(), alarm(Transition.ACKNOWLEDGED, 1, active=False, acknowledged=True))
    assert done["Retain"] is False


def test_a_comment_stays_until_the_next_and_that_of_a_refused_request_does_not_count():
    said = alarm(Transition.ACKNOWLEDGED, 1, acknowledged=True, operator_name="ann", comment="seen")
    refused = alarm(Transition.REFUSED, 2, acknowledged=True, operator_name="bob", comment="no")
    cleared = alarm(Transition.CLEARED, 3, active=False, acknowledged=True)
    of_earlier = {"marked_onset_t_ns": 5, "comment": "a door was open"}
    marked = alarm(Transition.MARKED_FALSE, 4, active=False, acknowledged=True, **of_earlier)
    fields = after(alarm(), said, refused, cleared, marked)
    assert (fields["Comment"], fields["ClientUserId"]) == ("seen", "ann")


def test_shelving_counts_down():
    shelved = alarm(Transition.SHELVED, shelved_until_t_ns=NOW_NS + 60 * 10**9)
    fields = after(shelved, now_ns=NOW_NS + 10 * 10**9)
    assert (fields["ShelvingState/CurrentState"], fields["ShelvingState/UnshelveTime"]) == ("Timed Shelved", 50_000.0)
    assert fields["SuppressedOrShelved"] is True
    once = after(alarm(Transition.SHELVED, shelved_until_t_ns=UNTIL_IT_CLEARS_T_NS))
    assert once["ShelvingState/CurrentState"] == "One Shot Shelved"


@pytest.mark.parametrize(
    "alarms",
    [
        [alarm(causes=())],
        [alarm(), alarm(Transition.ACKNOWLEDGED, 1, acknowledged=True, operator_name="ann", comment="x")],
        [alarm(Transition.DATA_LOST, stale=True, t_ns=0)],
    ],
)
def test_every_field_can_be_sent(alarms):
    event = condition_event(current_alarm(alarms), 2)
    before_any = condition_fields(Fan(TRAY, 1), None, NOW_NS, 2)
    assert event.fields.keys() == {*before_any, "NodeId"}
    of_server = system_event("RefreshStartEventType", "x").fields
    for path, value in [*event.fields.items(), *before_any.items(), *of_server.items()]:
        assert variant_to_binary(value), path
