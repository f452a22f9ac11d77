"""A request of an operator as a client sends it in JSON, checked."""

from __future__ import annotations

import time
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from fantwin.pipeline.site.one_line import one_line
from fantwin.schemas.enums import Action
from fantwin.schemas.messages import Request
from fantwin.scoring.alarms.alarm_state import GIVES_FEEDBACK

LONGEST_SHELVING_S = 30 * 86400.0
LONGEST_COMMENT = 500

OperatorAction = Literal[
    "acknowledge",
    "confirm",
    "reset",
    "shelve",
    "unshelve",
    "suppress",
    "unsuppress",
    "out_of_service",
    "in_service",
    "commission",
    "true_alarm",
    "false_alarm",
]
OneLine = Annotated[str, AfterValidator(one_line)]


class RequestForm(BaseModel):
    """What an operator asks of a fan, or of all fans of a tray.

    Attributes:
        action: what is asked.
        duration_s: how long to shelve, s; 0: until the alarm clears. Only for shelve.
        comment: why, for the record; false_alarm needs it.
        onset_t_ns: for true_alarm and false_alarm, onset of the alarm that is meant, to within a second; 0: the last
            one of the fan.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    action: OperatorAction
    duration_s: Annotated[float, Field(ge=0, le=LONGEST_SHELVING_S, allow_inf_nan=False)] = 0.0
    comment: Annotated[OneLine, Field(max_length=LONGEST_COMMENT)] = ""
    onset_t_ns: Annotated[int, Field(ge=0, lt=2**63)] = 0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.action == "false_alarm" and not self.comment.strip():
            raise ValueError("a false alarm needs a reason: give a comment")
        if self.onset_t_ns and self.message_action not in GIVES_FEEDBACK:
            raise ValueError("onset_t_ns is for true_alarm and false_alarm only")
        return self

    @property
    def message_action(self) -> Action:
        """As the scorer is asked."""
        return Action[self.action.upper()]

    def message(self, fan: int, operator_name: str) -> Request:
        """The request to the scorer. fan: -1 for all of the tray."""
        return Request(
            t_ns=time.time_ns(),
            action=self.message_action,
            fan=fan,
            duration_s=self.duration_s,
            operator_name=operator_name,
            comment=self.comment,
            onset_t_ns=self.onset_t_ns,
        )
