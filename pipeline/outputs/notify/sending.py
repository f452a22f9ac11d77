"""Delivers what waits in the outbox, each target in a thread of its own: one that does not answer holds up no other."""

from __future__ import annotations

import sqlite3
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.notify.outbox import Outbox, Waiting
from fantwin.pipeline.outputs.notify.wording import Text

FIRST_DELAY_S, LONGEST_DELAY_S = 1.0, 60.0
"""between attempts: it doubles from the one to the other"""
HUNG_AFTER_S = 90.0
"""a delivery that takes longer is a problem to report"""
IDLE_S = 1.0
REFUSED_ATTEMPTS = 5
"""a message that was refused so often is lost if the next one is taken"""
MAY_BE_REPEATED = "(This may be a repetition: it is not known whether the delivery before this one arrived.)"


@dataclass(frozen=True)
class Failure:
    """Why a delivery failed. is_uncertain: it may have arrived all the same. is_refusal: the target answers, and does
    not want it."""

    reason: str
    is_uncertain: bool = False
    is_refusal: bool = False


Deliver = Callable[[Text], Failure | None]
"""Delivers a text; None: it has arrived. It must not raise."""


def words_sent(waiting: Waiting) -> Text:
    """The text with what has to be said about its delivery."""
    lines = [waiting.text.body]
    if waiting.may_be_repeated:
        lines.append(MAY_BE_REPEATED)
    if waiting.lost:
        lines.append(f"Messages before this one that could not be delivered in time and are lost: {waiting.lost}")
    return replace(waiting.text, body="\n".join(lines))


class TargetThread(ABC):
    """A thread that delivers to one target, and tries again with growing delays where that fails."""

    def __init__(self, target: str, outbox: Outbox, again_s: float) -> None:
        """again_s: longest time between two looks for something to deliver."""
        self._target = target
        self._outbox = outbox
        self._again_s = again_s
        self._stop = threading.Event()
        self._wake = threading.Event()
        self._failing = ""
        self._delay_s = 0.0
        self.sent = self.attempts = 0
        self._thread = threading.Thread(target=self._run, name=f"sender of {target}", daemon=True)

    def start(self) -> None:
        """Begin to deliver."""
        self._thread.start()

    def wake(self) -> None:
        """Look for something to deliver at once."""
        self._wake.set()

    def stop(self, timeout_s: float) -> None:
        """End after the delivery that is under way. One that takes longer than timeout_s is left behind."""
        self._stop.set()
        self._wake.set()
        self._thread.join(timeout_s)

    def problem(self) -> str:
        """Why nothing arrives at the target; empty if all is well. The same words as long as the reason is the same."""
        return self._failing

    @abstractmethod
    def _deliver_all(self) -> Failure | None:
        """Deliver what there is, up to the first failure."""

    def _arrived(self) -> None:
        self._failing, self._delay_s = "", 0.0

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wake.clear()
            try:
                failure = self._deliver_all()
            except (sqlite3.Error, UserError) as error:
                failure = Failure(f"the outbox cannot be read or written: {error}")
            if failure is None:
                self._arrived()
                self._wake.wait(self._again_s)
            else:
                self._failing = f"target {self._target}: not delivered ({failure.reason}); tried again until it is"
                self._delay_s = min(LONGEST_DELAY_S, max(FIRST_DELAY_S, 2 * self._delay_s))
                self._stop.wait(self._delay_s)


class Sender(TargetThread):
    """Sends the messages of one target, in their order; tries again until they arrive or are too old. A message
    that is left behind by a stop is sent again after a restart."""

    def __init__(self, target: str, deliver: Deliver, outbox: Outbox, pause_s: float) -> None:
        """pause_s: least time between two messages."""
        super().__init__(target, outbox, IDLE_S)
        self._deliver = deliver
        self._pause_s = pause_s
        self._delivery_began_s: float | None = None
        self._taken: Waiting | None = None
        """the last message that has arrived, until the outbox knows it"""
        self._refused_number = self._refusals = 0
        """number of the message refused last, and how often it was"""

    def problem(self) -> str:
        """The problem of any target, or a delivery that does not end."""
        began_s = self._delivery_began_s
        if began_s is not None and time.monotonic() - began_s > HUNG_AFTER_S:
            return f"target {self._target}: a delivery has not ended for more than {HUNG_AFTER_S:.0f} s"
        return super().problem()

    def _deliver_all(self) -> Failure | None:
        self._forget_taken()
        while not self._stop.is_set() and (waiting := self._outbox.next_for(self._target)) is not None:
            failure = self._attempt(waiting)
            if failure is not None and failure.is_refusal and self._is_refused_alone(waiting):
                self._outbox.refuse(self._target, waiting)
            elif failure is not None:
                return failure
            self._arrived()
            self._stop.wait(self._pause_s)
        return None

    def _attempt(self, waiting: Waiting) -> Failure | None:
        self._outbox.begin(waiting)
        self.attempts += 1
        self._delivery_began_s = time.monotonic()
        failure = self._deliver(words_sent(waiting))
        self._delivery_began_s = None
        if failure is not None:
            self._outbox.failed(waiting, is_uncertain=failure.is_uncertain)
        else:
            self.sent += 1
            self._taken = waiting
            self._forget_taken()
        return failure

    def _forget_taken(self) -> None:
        """Take what has arrived out of the outbox. Where that fails, as on a full disk, it is not sent again."""
        if self._taken is not None:
            self._outbox.delivered(self._target, self._taken)
            self._taken = None

    def _is_refused_alone(self, waiting: Waiting) -> bool:
        """Whether the target refuses this message again and again, and takes the next one, which it then has."""
        self._refusals = self._refusals + 1 if waiting.number == self._refused_number else 1
        self._refused_number = waiting.number
        following = self._outbox.next_for(self._target, after=waiting.number)
        if self._refusals < REFUSED_ATTEMPTS or following is None:
            return False
        return self._attempt(following) is None
