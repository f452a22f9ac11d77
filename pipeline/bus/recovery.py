"""Requests for missed messages: asked without waiting, and bounded in messages, bytes and time.

A producer answers at `<key>/recover/<producer>` with the messages that it still keeps, and then with how many it has
published at all. That number ends the answer of a named producer.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import zenoh

from fantwin.pipeline.bus.identity import Forgeries, answerer_of, names_another
from fantwin.schemas.topics import CATCH_UP_MESSAGES, largest_bytes

MOST_RECOVERED_MESSAGES = 16_384
MOST_RECOVERED_BYTES = 64 << 20
"""of one answer; what exceeds either is not taken, and counts as missing"""
ALL_PRODUCERS = "*"
LAST_SEQUENCE = 2**63 - 1
_RECOVER = "/recover/"


def recovery_key(key: str, producer: str) -> str:
    """Where a producer answers requests for what it published on `key`; `producer` may be `*`."""
    return f"{key}{_RECOVER}{producer}"


def published_key(recovery_key: str) -> str:
    """The key whose messages are recovered at a recovery key."""
    return recovery_key.rpartition(_RECOVER)[0]  # a site or tray may have that name


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a request.

    Attributes:
        messages: (key, payload) of those that were still kept.
        published: how many messages the producer says it has published; None if it did not answer, or if all were
            asked.
        timed_out: a producer that was asked did not answer in time.
    """

    messages: list[tuple[str, bytes]] = field(default_factory=list)
    published: int | None = None
    timed_out: bool = False


OnAnswer: TypeAlias = Callable[[Answer], None]


class RecoveryRequest:
    """One request. `on_answer` is called once, from a thread of the bus, and must not block."""

    def __init__(
        self,
        session: zenoh.Session,
        forgeries: Forgeries,
        key: str,
        producer: str,
        first: int,
        last: int,
        timeout_s: float,
        on_answer: OnAnswer,
    ) -> None:
        """If all producers are asked, as many of the last messages of each as a consumer that begins may ask for."""
        self._is_of_one = producer != ALL_PRODUCERS
        self._producer = producer
        self._forgeries = forgeries
        self._on_answer = on_answer
        self._messages: list[tuple[str, bytes]] = []
        self._messages_left = min(MOST_RECOVERED_MESSAGES, last - first + 1)
        self._bytes_left = MOST_RECOVERED_BYTES
        self._largest_bytes = largest_bytes(key)
        self._timed_out = False
        self._lock = threading.Lock()
        self._has_ended = False
        self._cancellation = zenoh.CancellationToken()
        more = "" if self._is_of_one else f";newest={CATCH_UP_MESSAGES}"
        session.get(
            f"{recovery_key(key, producer)}?first={first};last={last}{more}",
            zenoh.handlers.Callback(self._receive, lambda: self._end(None), indirect=False),
            target=zenoh.QueryTarget.ALL,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            cancellation_token=self._cancellation,
        )

    def cancel(self) -> None:
        """Receive no more. Not to be called from a thread of the bus."""
        self._cancellation.cancel()

    def _receive(self, reply: zenoh.Reply) -> None:
        if self._has_ended:
            return
        sample = reply.ok
        if sample is None:  # the only error of these queries: not all have answered in time
            self._timed_out = True
            return
        answerer = answerer_of(reply)
        if sample.attachment is not None:
            if self._is_of_one and not names_another(self._producer, answerer):
                self._end(number_in(sample.attachment.to_bytes().decode(errors="replace")))
            return
        size = len(sample.payload)
        if self._messages_left < 1 or size > self._bytes_left:
            self._end(None)
            return
        if size > self._largest_bytes:
            return
        key, payload = published_key(str(sample.key_expr)), sample.payload.to_bytes()
        if self._forgeries.is_one(key, payload, answerer):
            return
        self._messages_left -= 1
        self._bytes_left -= size
        self._messages.append((key, payload))

    def _end(self, published: int | None) -> None:
        with self._lock:
            if self._has_ended:
                return
            self._has_ended = True
        messages, self._messages = self._messages, []
        self._on_answer(Answer(messages, published, self._timed_out))


def number_in(text: str) -> int | None:
    """A number in a query or an answer, which anybody may have sent; None if it is none."""
    return int(text) if text.isascii() and text.isdigit() and len(text) <= len(str(LAST_SEQUENCE)) else None
