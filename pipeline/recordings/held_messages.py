"""Messages that wait in memory while the disk refuses them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from fantwin.schemas.envelope import Envelope


class HeldMessages:
    """A queue bounded in bytes of payload: when it is full, the oldest messages are dropped."""

    def __init__(self) -> None:
        self.size_bytes = 0
        self._queue: deque[Envelope] = deque()

    def __len__(self) -> int:
        return len(self._queue)

    @property
    def first_received_t_ns(self) -> int | None:
        """Time of receipt of the oldest message; None if the queue is empty."""
        return self._queue[0].received_t_ns if self._queue else None

    @property
    def messages(self) -> tuple[Envelope, ...]:
        """All of them, oldest first."""
        return tuple(self._queue)

    def add(self, messages: Iterable[Envelope], limit_bytes: int) -> list[Envelope]:
        """Append messages; returns those dropped to stay within the limit."""
        for envelope in messages:
            self._queue.append(envelope)
            self.size_bytes += len(envelope.payload)
        dropped = []
        while self.size_bytes > limit_bytes:
            dropped.append(self._queue.popleft())
            self.size_bytes -= len(dropped[-1].payload)
        return dropped

    def take_all(self) -> list[Envelope]:
        """Empty the queue; returns what it held."""
        held = list(self._queue)
        self._queue.clear()
        self.size_bytes = 0
        return held
