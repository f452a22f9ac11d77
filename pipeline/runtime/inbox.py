"""The bounded inbox of a stage: everything a stage reacts to arrives here, in order; and the messages that are due."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import accumulate, islice
from typing import Any, TypeAlias

from fantwin.pipeline.bus.kept_messages import KeptQuery
from fantwin.pipeline.bus.recovery import Answer
from fantwin.pipeline.runtime.sequence_tracker import Request
from fantwin.schemas.blocks import can_join, samples_of
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.topics import BY_NAME, HEALTH_CHUNK

MOST_JOINED_VALUES = 8192
"""samples times fans: beyond that a sample hardly costs less, and health and other trays wait for longer"""
MOST_TRAYS, MOST_VALUES = 64, 4 * MOST_JOINED_VALUES
"""at once, of all together"""
MOST_REQUESTS = 64
"""of people, of one tray, that wait; further ones are refused and counted"""


class DueMessages:
    """A queue of messages in sequence that a stage has yet to process.

    Those of a tray keep their order, and come together where they differ only in samples; trays take turns.

    What a message costs hardly depends on the number of its samples, and the output of a core does not depend on how
    its input is cut (schemas.blocks). A stage that is behind joins what waits, so each sample costs it less. A stage
    that keeps up finds one message at a time. A stage that processes several trays in one pass takes what waits of many
    of them at once.

    Requests of people wait behind samples: one of them is due for each time that samples are taken, and the others when
    nothing else waits. So a flood of requests does not hold up what judges the fans.
    """

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


INBOX_SIZE = 4096
INBOX_BYTES = 128 << 20
"""the inbox is full when it holds as many messages or as many bytes"""
MOST_PATIENT = 64
"""so many items wait for the next tick, if none of them is urgent"""
_BLOCKED_CHECK_S = 0.05


@dataclass(frozen=True, slots=True)
class FromBus:
    """A message as it came off the bus. `received_t_ns` is host time."""

    key: str
    payload: bytes
    received_t_ns: int


@dataclass(frozen=True, slots=True)
class FromSource:
    """An item of a source, for the core called `core`."""

    core: str
    item: Any


@dataclass(frozen=True, slots=True)
class Liveness:
    """A stage session has appeared on the bus, or left it."""

    key: str
    alive: bool


@dataclass(frozen=True, slots=True)
class Recovered:
    """The answer to a request for missed messages."""

    request: Request
    answer: Answer


Item: TypeAlias = FromBus | FromSource | Liveness | Recovered | KeptQuery


class Inbox:
    """A bounded queue. When it is full, `put` blocks, or drops the oldest message of the bus and counts it."""

    def __init__(self, drops_oldest: bool) -> None:
        self._items: deque[Item] = deque()
        self._bytes = self._blocked = 0
        self._inputs: Counter[str] = Counter()
        """by tray: the items that wait from which the stage may make outputs"""
        self._changed = threading.Condition()
        self._drops_oldest = drops_oldest
        self._closed = False
        self.dropped = 0

    def put(self, item: Item, *, is_urgent: bool = True) -> bool:
        """Add an item; False, and nothing is added, once the inbox is closed.

        is_urgent: wake the stage for it. Otherwise it is taken with the next urgent one, or at the next tick: items
        that are taken together cost less.
        """
        with self._changed:
            while self._drops_oldest and self._is_full() and self._drop_oldest():
                self.dropped += 1
            self._blocked += 1
            while self._is_full() and not self._closed:
                self._changed.wait(_BLOCKED_CHECK_S)
            self._blocked -= 1
            return self._add(item, is_urgent=is_urgent or len(self._items) >= MOST_PATIENT)

    def put_at_once(self, item: Item) -> None:
        """Add an item even if the inbox is full: for items whose number is bounded elsewhere."""
        with self._changed:
            self._add(item, is_urgent=True)

    def get(self, timeout_s: float) -> Item | None:
        """The next item; None when there is none in time."""
        with self._changed:
            if not self._items:
                self._changed.wait(timeout_s)
            return self._take_first() if self._items else None

    def waiting(self) -> int:
        """How many items wait now."""
        return len(self._items)

    def has_input(self, tray: str) -> bool:
        """Whether an item of this tray may wait from which the stage may make outputs; an empty tray: of any tray.
        Health of others and liveliness do not count. While a `put` is blocked, it is not known what waits behind it."""
        with self._changed:
            return self._blocked > 0 or (tray in self._inputs if tray else bool(self._inputs))

    def close(self) -> None:
        """Release any thread blocked in `put`: the bus cannot close while one of its threads is blocked."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _is_full(self) -> bool:
        return len(self._items) >= INBOX_SIZE or self._bytes >= INBOX_BYTES

    def _add(self, item: Item, *, is_urgent: bool) -> bool:
        if self._closed:
            return False
        self._items.append(item)
        self._bytes += _size(item)
        self._count(item, 1)
        if is_urgent:
            self._changed.notify_all()
        return True

    def _drop_oldest(self) -> bool:
        """Drop the oldest message of the bus; False if there is none. Other items must not be dropped."""
        for place, item in enumerate(self._items):
            if isinstance(item, FromBus):
                del self._items[place]
                self._bytes -= _size(item)
                self._count(item, -1)
                return True
        return False

    def _count(self, item: Item, by: int) -> None:
        tray = _tray_of(item)
        if tray is None:
            return
        self._inputs[tray] += by
        if not self._inputs[tray]:
            del self._inputs[tray]

    def _take_first(self) -> Item:
        item = self._items.popleft()
        self._bytes -= _size(item)
        self._count(item, -1)
        self._changed.notify_all()
        return item


def _size(item: Item) -> int:
    return len(item.payload) if isinstance(item, FromBus) else 0


def _tray_of(item: Item) -> str | None:
    """The tray of an item from which outputs may be made, as its key or its source names it; None: none are made from
    it."""
    match item:
        case FromSource():
            return item.core
        case FromBus():
            key = item.key
        case Recovered():
            key = item.request.key
        case _:
            return None
    _, _, tray, *_ = (*key.split("/", 3), "", "", "")
    return None if tray == HEALTH_CHUNK else tray
