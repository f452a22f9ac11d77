"""Requests for missed messages on behalf of a stage: few at a time, each bounded in time, and without waiting.

The answers arrive in the inbox. A producer that does not answer in time is left alone for a while, so that it does not
hold the stream again and again. Bounds: docs/reference/bounds.md.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable

from fantwin.pipeline.bus.recovery import ALL_PRODUCERS, LAST_SEQUENCE, Answer, RecoveryRequest
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.runtime.inbox import Inbox, Recovered
from fantwin.pipeline.runtime.sequence_tracker import Found, Request
from fantwin.schemas.topics import topic_of

MOST_AT_A_TIME = 8
MOST_QUEUED = 4096
BACK_OFF_S = 10.0
"""pause before a producer that did not answer at all in time is asked again"""
MOST_BACKED_OFF = 256
IMPATIENT_S = 0.5
"""how long further catch-ups wait once one was not answered in time; a complete answer usually comes much sooner"""


class Recovery:
    """The requests of one stage."""

    def __init__(
        self, bus: Bus, inbox: Inbox, timeout_s: float, *, only_rare: bool, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """only_rare: recover no data, only what is published on change, such as the twin in force."""
        self._bus = bus
        self._inbox = inbox
        self._timeout_s = timeout_s
        self._only_rare = only_rare
        self._now_s = now_s
        self._running: dict[Request, RecoveryRequest] = {}
        self._queue: deque[tuple[Request, float]] = deque()
        """with the time at which each was asked"""
        self._later: deque[Request] = deque()
        """requests that are not to be sent yet"""
        self._asked_again_s: dict[tuple[str, str], float] = {}
        """by key and producer, of those that did not answer"""
        self._catching_up: deque[str] = deque()
        self._catch_up_request: Request | None = None
        self._catch_up_timeout_s = timeout_s

    @property
    def is_catching_up(self) -> bool:
        """Whether a key of `catch_up` has not been answered yet."""
        return self._catch_up_request is not None

    def catch_up(self, keys: Iterable[str]) -> None:
        """Request what all producers still keep, one key after the other."""
        self._catching_up.extend(keys)
        self._catch_up_next()

    def is_catch_up(self, request: Request) -> bool:
        """Whether a request is one of `catch_up`."""
        return request is self._catch_up_request

    def ask(self, request: Request) -> Found | None:
        """Request messages. None: the answer will be in the inbox. Otherwise no request is sent."""
        if self._only_rare and not topic_of(request.key).is_rare:
            return Found(was_asked=False)
        if request.not_before_s > self._now_s() and len(self._later) < MOST_QUEUED:
            self._later.append(request)
            return None
        if not request.not_before_s and self._now_s() < self._asked_again_s.get((request.key, request.producer), 0.0):
            return Found()
        if len(self._running) < MOST_AT_A_TIME:
            self._send(request, self._timeout_s)
        elif len(self._queue) < MOST_QUEUED:
            self._queue.append((request, self._now_s()))
        else:
            return Found()
        return None

    def send_due(self) -> None:
        """Send the requests that have waited until their time."""
        for _ in range(len(self._later)):
            request = self._later.popleft()
            if self.ask(request) is not None:
                self._inbox.put_at_once(Recovered(request, Answer()))

    def finish(self, item: Recovered) -> None:
        """An answer has been taken from the inbox and processed: go on with the next request."""
        running = self._running.pop(item.request, None)
        if running is None:
            return  # it had waited too long to be sent
        running.cancel()
        if item.request is self._catch_up_request:
            if item.answer.timed_out:
                self._catch_up_timeout_s = min(self._timeout_s, IMPATIENT_S)
            self._catch_up_next()
        elif item.answer.timed_out and item.answer.published is None and not item.answer.messages:
            self._asked_again_s.pop((item.request.key, item.request.producer), None)
            self._asked_again_s[item.request.key, item.request.producer] = self._now_s() + BACK_OFF_S
            if len(self._asked_again_s) > MOST_BACKED_OFF:
                del self._asked_again_s[next(iter(self._asked_again_s))]
        while self._queue and len(self._running) < MOST_AT_A_TIME:
            request, asked_s = self._queue.popleft()
            if self._now_s() - asked_s < self._timeout_s:
                self._send(request, self._timeout_s)
            else:
                self._inbox.put_at_once(Recovered(request, Answer()))

    def _send(self, request: Request, timeout_s: float) -> None:
        def receive(answer: Answer) -> None:
            self._inbox.put_at_once(Recovered(request, answer))

        self._running[request] = self._bus.request_missed(
            request.key, request.producer, request.first, request.last, timeout_s, receive
        )

    def _catch_up_next(self) -> None:
        self._catch_up_request = None
        if self._catching_up:
            self._catch_up_request = Request(self._catching_up.popleft(), ALL_PRODUCERS, 0, LAST_SEQUENCE)
            self._send(self._catch_up_request, self._catch_up_timeout_s)
