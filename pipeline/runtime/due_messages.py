"""Messages in sequence that a stage has yet to process: those of a tray that differ only in samples come together.

What a message costs hardly depends on the number of its samples, and the output of a core does not depend on how its
input is cut (schemas.blocks). A stage that is behind joins what waits, so each sample costs it less. A stage that keeps
up finds one message at a time. A stage that processes several trays in one pass takes what waits of many of them at
once.

Requests of people wait behind samples: one of them is due for each time that samples are taken, and the others when
nothing else waits. So a flood of requests does not hold up what judges the fans.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from itertools import accumulate, islice

from fantwin.schemas.blocks import can_join, samples_of
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.topics import BY_NAME

MOST_JOINED_VALUES = 8192
"""samples times fans: beyond that a sample hardly costs less, and health and other trays wait for longer"""
MOST_TRAYS, MOST_VALUES = 64, 4 * MOST_JOINED_VALUES
"""at once, of all together"""
MOST_REQUESTS = 64
"""of people, of one tray, that wait; further ones are refused and counted"""


class DueMessages:
    """A queue of messages. Those of a tray keep their order; trays take turns."""

    def __init__(self, trays: Iterable[str], *, joins: bool) -> None:
        """trays: those with a core of their own; all other messages keep their order among them. joins: whether
        messages of these trays come together."""
        self._trays = frozenset(trays)
        self.joins = joins
        self._waiting: dict[str, deque[Envelope]] = {}
        """by tray, the next one to take its turn first; none is empty"""
        self._requests: deque[Envelope] = deque()
        self._requests_of: Counter[str] = Counter()
        """by tray: those that wait"""
        self.refused_requests = 0
        self.bytes = 0
        """of the payloads of all"""
        self._begun: set[str] = set()
        """the keys of which a message has been taken"""

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values())) + len(self._requests)

    def __bool__(self) -> bool:
        return bool(self._waiting or self._requests)

    @property
    def is_pressing(self) -> bool:
        """Whether anything but requests of people waits."""
        return bool(self._waiting)

    def __iter__(self) -> Iterator[Envelope]:
        for waiting in self._waiting.values():
            yield from waiting
        yield from self._requests

    def has(self, tray: str) -> bool:
        """Whether a message of a tray with a core of its own waits."""
        return tray in self._waiting or self._requests_of[tray] > 0

    def add(self, envelopes: Iterable[Envelope]) -> None:
        """Messages that are in sequence now."""
        for envelope in envelopes:
            tray = envelope.header.tray
            if self.joins and tray in self._trays and _is_request(envelope):
                self._add_request(tray, envelope)
                continue
            self.bytes += len(envelope.payload)
            self._waiting.setdefault(tray if tray in self._trays else "", deque()).append(envelope)

    def pop_request(self) -> list[Envelope]:
        """The request of people that has waited longest; empty if there is none."""
        if not self._requests:
            return []
        request = self._requests.popleft()
        self._requests_of[request.header.tray] -= 1
        self.bytes -= len(request.payload)
        return [request]

    def _add_request(self, tray: str, request: Envelope) -> None:
        if self._requests_of[tray] >= MOST_REQUESTS:
            self.refused_requests += 1
            return
        self._requests.append(request)
        self._requests_of[tray] += 1
        self.bytes += len(request.payload)

    def pop(self, most_values: int = MOST_JOINED_VALUES) -> list[Envelope]:
        """The next message; or several of one tray, topic and producer that differ only in their samples, but no more
        values together than `most_values`.

        The first of a key comes alone: so the position of the first output that is made of it shows whether a session
        had consumed anything before.

        Raises:
            StopIteration: none is left.
        """
        tray = next(iter(self._waiting))
        waiting = self._waiting.pop(tray)
        taken = [waiting.popleft()]
        is_first = taken[0].key not in self._begun
        self._begun.add(taken[0].key)
        if self.joins and tray and not is_first:
            left = most_values - _values(taken[0])
            while waiting and _differ_in_samples(taken[0], waiting[0]) and (left := left - _values(waiting[0])) >= 0:
                taken.append(waiting.popleft())
        if waiting:
            self._waiting[tray] = waiting
        self.bytes -= sum(len(each.payload) for each in taken)
        return taken

    def pop_of_each(self) -> list[list[Envelope]]:
        """What `pop` gives of each of the next trays, about MOST_VALUES of all together."""
        of_first = [_values(waiting[0]) for waiting in islice(self._waiting.values(), MOST_TRAYS)]
        trays = max(1, bisect_right(list(accumulate(of_first)), MOST_JOINED_VALUES))
        return [self.pop(min(MOST_JOINED_VALUES, MOST_VALUES // trays)) for _ in range(trays)]


def _is_request(envelope: Envelope) -> bool:
    topic = BY_NAME[envelope.topic]
    return topic.is_of_people and topic.is_rare


def _differ_in_samples(one: Envelope, other: Envelope) -> bool:
    same = one.key == other.key and one.header.producer == other.header.producer
    return same and can_join(one.message, other.message)


def _values(envelope: Envelope) -> int:
    return samples_of(envelope.message) * getattr(envelope.message, "fans", 1)
