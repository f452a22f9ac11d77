"""The bounded inbox of a stage: everything a stage reacts to arrives here, in order."""

from __future__ import annotations

import threading
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any, TypeAlias

from fantwin.pipeline.bus.kept_messages import KeptQuery
from fantwin.pipeline.bus.recovery import Answer
from fantwin.pipeline.runtime.tracked_streams import Request
from fantwin.schemas.topics import HEALTH_CHUNK

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
