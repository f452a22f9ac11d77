"""What operators ask by the methods of OPC UA, and what they are answered. No OPC UA library is needed here.

Status codes are named as in Part 4, table 179, and Part 9.
"""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.schemas.enums import Action, Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS

GOOD = "Good"


@dataclass(frozen=True)
class ConditionMethod:
    """A method of a condition.

    Attributes:
        name: browse name.
        action: what it asks of the scorer; None: it cannot be asked.
        arguments: names of its arguments.
        refusal: status of a method that is never granted.
    """

    name: str
    action: Action | None
    arguments: tuple[str, ...] = ()
    refusal: str = "BadNotImplemented"


EVENT_ID, COMMENT, SHELVING_TIME = "EventId", "Comment", "ShelvingTime"
METHODS = (
    ConditionMethod("Acknowledge", Action.ACKNOWLEDGE, (EVENT_ID, COMMENT)),
    ConditionMethod("AddComment", Action.COMMENT, (EVENT_ID, COMMENT)),
    ConditionMethod("Enable", None, refusal="BadConditionAlreadyEnabled"),
    ConditionMethod("Disable", None),
    ConditionMethod("RemoveFromService", Action.OUT_OF_SERVICE),
    ConditionMethod("RemoveFromService2", Action.OUT_OF_SERVICE, (COMMENT,)),
    ConditionMethod("PlaceInService", Action.IN_SERVICE),
    ConditionMethod("PlaceInService2", Action.IN_SERVICE, (COMMENT,)),
)
SHELVING_METHODS = (
    ConditionMethod("TimedShelve", Action.SHELVE, (SHELVING_TIME,)),
    ConditionMethod("TimedShelve2", Action.SHELVE, (SHELVING_TIME, COMMENT)),
    ConditionMethod("OneShotShelve", Action.SHELVE),
    ConditionMethod("OneShotShelve2", Action.SHELVE, (COMMENT,)),
    ConditionMethod("Unshelve", Action.UNSHELVE),
    ConditionMethod("Unshelve2", Action.UNSHELVE, (COMMENT,)),
)
FAN_METHODS = (ConditionMethod("Commission", Action.COMMISSION, (COMMENT,)),)


def status_of(answer: Alarm, action: Action) -> str:
    """The status code of a scorer's answer. A refused request leaves the alarm as it was: its state says why."""
    if answer.transition != Transition.REFUSED:
        return GOOD
    if action == Action.ACKNOWLEDGE:
        never_raised = answer.severity == Severity.NONE
        return "BadInvalidState" if never_raised else "BadConditionBranchAlreadyAcked"
    if action == Action.SHELVE:
        is_once = answer.shelved_until_t_ns == UNTIL_IT_CLEARS_T_NS
        return "BadConditionAlreadyShelved" if is_once else "BadShelvingTimeOutOfRange"
    if action == Action.UNSHELVE:
        return "BadConditionNotShelved"
    return "BadInvalidState"
