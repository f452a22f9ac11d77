"""scoring.alarms.current_alarms: the messages of each fan reduced to the state of its alarm."""

from __future__ import annotations

import itertools
import json
from typing import Any

from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.messages import Alarm, Diagnosis
from fantwin.scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS
from fantwin.scoring.alarms.current_alarms import CurrentAlarm, current_alarm
from tests.support import made_messages

_numbers = itertools.count()


def alarm(
    transition: Transition = Transition.RAISED, t_ns: int = 1, *, tray: str = "a", producer: str = "p", **more: Any
) -> Alarm:
    fields: dict[str, Any] = {"severity": Severity.WARNING, "onset_t_ns": 1}
    fields |= {"transition": transition, "message": f"{transition.name} at {t_ns}", **more}
    return made_messages.alarm(0, t_ns, tray, producer, next(_numbers), **fields)


def one(*messages: Alarm) -> CurrentAlarm:
    return current_alarm(messages)


def test_an_answer_keeps_the_message_and_the_causes():
    causes = (Diagnosis(cause="drag_up", probability=0.8),)
    standing = one(
        alarm(),
        alarm(Transition.DIAGNOSED, 2, causes=causes),
        alarm(Transition.ACKNOWLEDGED, 3, acknowledged=True, operator_name="Ann"),
        alarm(Transition.REFUSED, 4, acknowledged=True, operator_name="Bob", message="it is acknowledged already"),
    )
    assert (standing.message, standing.causes, standing.acknowledged_by) == ("DIAGNOSED at 2", causes, "Ann")


def test_a_refusal_is_said_once_in_a_log():
    refused = one(alarm(Transition.REFUSED, active=False, message="fan 0: refused: no alarm has been raised"))
    assert refused.line() == "a  fan 0: refused: no alarm has been raised"


def test_a_new_occurrence_has_nothing_of_the_one_before():
    causes = (Diagnosis(cause="drag_up", probability=0.8),)
    standing = one(
        alarm(causes=causes),
        alarm(Transition.ACKNOWLEDGED, 2, acknowledged=True, operator_name="Ann"),
        alarm(t_ns=9, onset_t_ns=8),
    )
    assert (standing.message, standing.causes, standing.acknowledged_by) == ("RAISED at 9", (), "")


def test_who_acknowledged_is_known_from_alarms_that_a_restarted_scorer_republishes():
    standing = one(alarm(Transition.REPUBLISHED, acknowledged=True, operator_name="Ann"))
    assert standing.acknowledged_by == "Ann"


def test_states_in_words():
    assert one(alarm()).states() == ["active", "unacknowledged"]
    assert one(alarm(active=False, acknowledged=True)).states() == ["cleared", "acknowledged"]
    silenced = one(alarm(shelved_until_t_ns=UNTIL_IT_CLEARS_T_NS, out_of_service=True))
    assert silenced.states()[2:] == ["shelved until it clears", "out of service"]
    never = one(alarm(active=False, severity=Severity.NONE, acknowledged=True, out_of_service=True))
    assert never.states() == ["never raised", "out of service"]


def test_a_machine_gets_it_all_as_json():
    standing = one(alarm(causes=(Diagnosis(cause="drag_up", probability=0.8),), shelved_until_t_ns=7))
    shown = json.loads(json.dumps(standing.as_json()))
    assert shown["causes"] == [{"cause": "drag_up", "probability": 0.8, "evidence": ""}]
    assert (shown["severity"], shown["retained"], shown["presented"]) == ("warning", True, False)
    assert shown["shelved_until_t_ns"] == 7
