"""What has to be sent to the broker: the newest state of each fan, answers once, and every transition in order, also
over a restart.
"""

from __future__ import annotations

import sqlite3
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from pydantic_core import to_json

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.schemas.messages import Alarm

READER = "mqtt"


class TransitionQueue:
    """Transitions to be sent, from the history of alarms on disk.

    What the broker has acknowledged without a gap is done; the rest is sent again after a restart, with the same
    number. lost: how many were dropped because too many waited.
    """

    def __init__(self, history: AlarmHistory, most_waiting: int) -> None:
        """Raises:
        UserError: the history cannot be read.
        """
        self._history = history
        self._most_waiting = most_waiting
        self._newest = history.newest_number()
        position = history.position(READER)
        self._done = self._newest if position is None else position
        """all up to this number have been acknowledged; what was there before the first start is not sent"""
        self._sent = self._done
        """the last one that was taken"""
        self._under_way: dict[int, bool] = {}
        """by number, oldest first, whether each has been acknowledged"""
        self.lost = 0
        if position is None:
            self._keep_position()

    @property
    def waiting(self) -> int:
        """How many the broker has not acknowledged."""
        return self._newest - self._done

    def notice_new(self) -> None:
        """The history has grown."""
        with suppress(UserError):  # the history says it
            self._newest = self._history.newest_number()
        too_many = self._newest - self._sent - self._most_waiting
        if too_many > 0:
            self.lost += too_many
            self._sent += too_many
            self._settle()

    def take(self, most: int) -> Sequence[tuple[int, Alarm]]:
        """The next ones, each with its number."""
        if self._sent >= self._newest or most <= 0:
            return ()
        try:
            found = self._history.after(self._sent, most)
        except UserError:  # the history says it
            return ()
        self._under_way |= {number: False for number, _ in found}
        self._sent = found[-1][0] if found else self._newest
        self._settle()
        return found

    def acknowledge(self, number: int) -> None:
        """The broker has one."""
        if number in self._under_way:
            self._under_way[number] = True
            self._settle()

    def _settle(self) -> None:
        while self._under_way and next(iter(self._under_way.values())):
            del self._under_way[next(iter(self._under_way))]
        done = next(iter(self._under_way)) - 1 if self._under_way else self._sent
        if done != self._done:
            self._done = done
            self._keep_position()

    def _keep_position(self) -> None:
        with suppress(sqlite3.Error):  # after a restart, some are sent twice
            self._history.set_position(READER, self._done)


MOST_ANSWERS = 256
"""that wait; of more, the oldest are dropped: whoever asked has long given up"""


class Outgoing(NamedTuple):
    """A message to the broker."""

    topic: str
    text: str
    is_retained: bool


class Outbox:
    """Texts that wait for the broker: one a topic, however long the broker is away or slow.

    Urgent topics are sent first, each kind in the order in which its topics changed.
    """

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        """of all retained topics"""
        self._urgent: dict[str, None] = {}
        self._ordinary: dict[str, None] = {}
        """topics whose text has not been sent"""
        self._answers: deque[tuple[str, str]] = deque(maxlen=MOST_ANSWERS)

    def __len__(self) -> int:
        return len(self._urgent) + len(self._ordinary) + len(self._answers)

    def retain(self, topic: str, text: str, *, is_urgent: bool = False) -> None:
        """Send a text if the topic has another one now."""
        if self._texts.get(topic) == text:
            return
        self._texts[topic] = text
        if is_urgent:
            self._ordinary.pop(topic, None)
            self._urgent[topic] = None
        elif topic not in self._urgent:
            self._ordinary[topic] = None

    def answer(self, topic: str, text: str) -> None:
        """Send a text once, which nobody keeps."""
        self._answers.append((topic, text))

    def renew(self) -> None:
        """Send all retained topics again: the broker may have lost them."""
        for topic in self._texts:
            if topic not in self._urgent:
                self._ordinary[topic] = None

    def take(self, most: int) -> list[Outgoing]:
        """What is to be sent now; it is taken for sent."""
        taken: list[Outgoing] = []
        while len(taken) < most and self._urgent:
            taken.append(self._retained(self._urgent))
        while len(taken) < most and self._answers:
            taken.append(Outgoing(*self._answers.popleft(), is_retained=False))
        while len(taken) < most and self._ordinary:
            taken.append(self._retained(self._ordinary))
        return taken

    def _retained(self, waiting: dict[str, None]) -> Outgoing:
        topic = next(iter(waiting))
        del waiting[topic]
        return Outgoing(topic, self._texts[topic], is_retained=True)


def text_of(value: Any) -> str:
    """JSON that any program reads: NaN and infinity, which JSON does not have, become null."""
    return to_json(value, inf_nan_mode="null").decode()
