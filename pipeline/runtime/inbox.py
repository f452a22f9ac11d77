"""The bounded inbox of a stage: everything a stage reacts to arrives here, in order."""

from __future__ import annotations

import queue
from collections import deque
from dataclasses import dataclass
from typing import Any, TypeAlias

INBOX_SIZE = 4096
_BLOCKED_CHECK_S = 0.05
_SET_ASIDE_TIMEOUT_S = 0.005


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


Item: TypeAlias = FromBus | FromSource | Liveness


class Inbox:
    """A bounded queue. When it is full, `put` blocks, or drops the oldest item and counts it."""

    def __init__(self, drops_oldest: bool) -> None:
        self._queue: queue.Queue[Item] = queue.Queue(INBOX_SIZE)
        self._drops_oldest = drops_oldest
        self._aside: deque[Item] = deque()
        self._closed = False
        self.dropped = 0

    def put(self, item: Item) -> bool:
        """Add an item; False, and nothing is added, once the inbox is closed."""
        while not self._closed:
            try:
                self._queue.put(item, block=not self._drops_oldest, timeout=_BLOCKED_CHECK_S)
                return True
            except queue.Full:
                if self._drops_oldest:
                    self._drop_one()
        return False

    def get(self, timeout_s: float) -> Item | None:
        """The next item; None when there is none in time."""
        if self._aside:
            return self._aside.popleft()
        try:
            return self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def set_aside(self) -> None:
        """Move an item out of the queue and keep it for later, in order: makes room while the stage waits."""
        try:
            self._aside.append(self._queue.get(timeout=_SET_ASIDE_TIMEOUT_S))
        except queue.Empty:
            return

    def waiting(self) -> int:
        """How many items wait now."""
        return self._queue.qsize() + len(self._aside)

    def close(self) -> None:
        """Release any thread blocked in `put`: the bus cannot close while one of its threads is blocked."""
        self._closed = True

    def _drop_one(self) -> None:
        try:
            self._queue.get_nowait()
        except queue.Empty:
            return
        self.dropped += 1
