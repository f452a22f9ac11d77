"""Transitions of alarms on their way to the broker: in order, none left out, also over a restart of the stage.

They are in the history of alarms on disk. What the broker has acknowledged without a gap is done; the rest is sent
again after a restart, with the same number.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import suppress

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.schemas.messages import Alarm

READER = "mqtt"


class TransitionQueue:
    """lost: how many were dropped because too many waited."""

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
