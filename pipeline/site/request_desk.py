"""Requests of operators on their way: from a page to the scorer of a tray, and its answers back."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from fantwin.pipeline.site.one_line import one_line
from fantwin.schemas.enums import Action
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Request
from fantwin.scoring.alarms.alarm_state import GIVES_FEEDBACK

LONGEST_SHELVING_S = 30 * 86400.0
LONGEST_COMMENT = 500

OperatorAction = Literal[
    "acknowledge",
    "shelve",
    "unshelve",
    "out_of_service",
    "in_service",
    "commission",
    "true_alarm",
    "false_alarm",
    "comment",
]
OneLine = Annotated[str, AfterValidator(one_line)]


class RequestForm(BaseModel):
    """What an operator asks of a fan, or of all fans of a tray, as a client sends it in JSON, checked.

    Attributes:
        action: what is asked.
        duration_s: how long to shelve, s; 0: until the alarm clears. Only for shelve.
        comment: why, for the record; false_alarm and comment need it.
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
        if self.action == "comment" and not self.comment.strip():
            raise ValueError("there is no comment")
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


ANSWERED_WITHIN_S = 10.0
MOST_UNDER_WAY = 256


@dataclass(eq=False)
class _UnderWay:
    fans: frozenset[int]
    sent_s: float
    answers: dict[int, Alarm] = field(default_factory=dict)
    done: Future[list[Alarm]] = field(default_factory=Future)


class RequestDesk:
    """Thread-safe. The stage takes what is to be sent and adds the answers; pages wait for them."""

    def __init__(self, producer: str, now_s: Callable[[], float] = time.monotonic) -> None:
        """producer: of this process, by which answers name the request. now_s: a clock that is never set."""
        self._now_s = now_s
        self._producer = producer
        self._lock = threading.Lock()
        self._waiting: list[tuple[Request, _UnderWay]] = []
        self._sent: Counter[str] = Counter()
        """requests sent, by tray: the next one has this number"""
        self._under_way: dict[str, _UnderWay] = {}
        """by the name of the request"""

    async def ask(self, tray: str, request: Request, fans: Sequence[int]) -> list[Alarm]:
        """Send a request and wait for the answers of its fans, in the order of their numbers.

        Raises:
            TimeoutError: an answer is missing after ANSWERED_WITHIN_S, or too many requests are under way.
        """
        return await asyncio.wait_for(asyncio.wrap_future(self.begin(tray, request, fans)), ANSWERED_WITHIN_S)

    def begin(self, tray: str, request: Request, fans: Sequence[int]) -> Future[list[Alarm]]:
        """Send a request; returns where the answers of its fans will be, in the order of their numbers. If one is
        missing after ANSWERED_WITHIN_S, none will come.

        Raises:
            TimeoutError: too many requests are under way.
        """
        under_way = _UnderWay(frozenset(fans), self._now_s())
        with self._lock:
            if len(self._under_way) + len(self._waiting) >= MOST_UNDER_WAY:
                raise TimeoutError(f"{MOST_UNDER_WAY} requests are waiting for their scorers")
            self._waiting.append((replace(request, header=Header(tray=tray)), under_way))
        return under_way.done

    def take(self) -> list[Request]:
        """The requests to be sent now, but for those that nobody waits for any more."""
        now_s = self._now_s()
        with self._lock:
            for name, each in list(self._under_way.items()):
                if each.done.done() or now_s - each.sent_s > ANSWERED_WITHIN_S:
                    del self._under_way[name]
            waiting, self._waiting = self._waiting, []
            taken = [each for each in waiting if not each[1].done.done()]
            for request, under_way in taken:
                tray = request.header.tray
                self._under_way[f"{self._producer}/{tray}/{self._sent[tray]}"] = under_way
                self._sent[tray] += 1
        return [request for request, _ in taken]

    def add(self, alarm: Alarm) -> None:
        """An alarm has been heard, which may be an answer."""
        producer, _, number = alarm.request.rpartition("/")
        if producer != self._producer:
            return
        with self._lock:
            under_way = self._under_way.get(f"{producer}/{alarm.header.tray}/{number}")
            if under_way is None or alarm.fan not in under_way.fans:
                return
            under_way.answers[alarm.fan] = alarm
            if under_way.answers.keys() < under_way.fans or under_way.done.done():
                return
        if under_way.done.set_running_or_notify_cancel():
            under_way.done.set_result([under_way.answers[fan] for fan in sorted(under_way.fans)])
