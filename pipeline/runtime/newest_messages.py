"""The newest message on keys that a stage does not read message by message.

A stage that looks at thousands of fans once a second need not receive every sample of theirs: it does not subscribe to
these keys, but asks their producers, which keep their last messages anyway. What a producer has not published since is
not sent again.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, field

from fantwin.pipeline.bus.recovery import ALL_PRODUCERS, LAST_SEQUENCE, RecoveryRequest
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.runtime.inbox import Inbox, Newest
from fantwin.schemas.envelope import Envelope

PERIOD_S = 1.0
TIMEOUT_S = 4.0
PAUSE_S = 5.0
"""how long a key is left alone after its producer did not answer in time"""
MOST_UNDER_WAY = 128
"""so many that the trays of a process that hangs do not keep those of others waiting"""


@dataclass(slots=True)
class _Watched:
    """What is known about a key.

    Attributes:
        producer: who published its newest message; `ALL_PRODUCERS` if nothing newer has come from it.
        next_sequences: by producer, the number after its newest message.
    """

    producer: str = ALL_PRODUCERS
    next_sequences: dict[str, int] = field(default_factory=dict[str, int])


class NewestMessages:
    """Asks for the newest message of each watched key, without waiting; the answers come through the inbox."""

    def __init__(self, bus: Bus, inbox: Inbox, now_s: Callable[[], float] = time.monotonic) -> None:
        self._bus = bus
        self._inbox = inbox
        self._now_s = now_s
        self._watched: dict[str, _Watched] = {}
        self._under_way: dict[str, RecoveryRequest] = {}
        self._due: list[tuple[float, str]] = []
        """a heap: when which key is asked for again"""

    def watch(self, keys: Set[str]) -> None:
        """From now on ask for these keys and no others."""
        if keys == self._watched.keys():
            return
        self._due = [(due_s, key) for due_s, key in self._due if key in keys]
        heapq.heapify(self._due)
        self._watched = {key: watched for key, watched in self._watched.items() if key in keys}
        for key in sorted(keys - self._watched.keys()):
            self._watched[key] = _Watched()
            if key not in self._under_way:
                heapq.heappush(self._due, (0.0, key))

    def ask(self) -> None:
        """Send the requests that are due, some at a time. To be called often."""
        now_s = self._now_s()
        while self._due and self._due[0][0] <= now_s and len(self._under_way) < MOST_UNDER_WAY:
            _, key = heapq.heappop(self._due)
            watched = self._watched[key]
            self._under_way[key] = self._bus.request_missed(
                key,
                watched.producer,
                watched.next_sequences.get(watched.producer, 0),
                LAST_SEQUENCE,
                TIMEOUT_S,
                lambda answer, key=key: self._inbox.put_at_once(Newest(key, answer)),
                newest=1,
            )

    def finish(self, item: Newest, envelopes: Sequence[Envelope]) -> Envelope | None:
        """The newest message that an answer has brought; None if there is none, or nobody asks for it any more.

        envelopes: those of the answer that count.
        """
        self._under_way.pop(item.key).cancel()
        watched = self._watched.get(item.key)
        if watched is None:
            return None
        heapq.heappush(self._due, (self._now_s() + (PAUSE_S if item.answer.timed_out else PERIOD_S), item.key))
        known = watched.next_sequences
        newer = [each for each in envelopes if each.header.sequence >= known.get(each.header.producer, 0)]
        if watched.producer == ALL_PRODUCERS:
            watched.next_sequences = {e.header.producer: e.header.sequence + 1 for e in envelopes} or known
        elif newer:
            known[watched.producer] = newer[-1].header.sequence + 1
        watched.producer = newer[-1].header.producer if newer else ALL_PRODUCERS
        return newer[-1] if newer else None
