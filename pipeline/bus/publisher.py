"""Publishing with recovery: a publisher keeps its last messages and answers requests for those that were missed."""

from __future__ import annotations

import threading
from collections import deque

import zenoh

from pipeline.bus.recovery import LAST_SEQUENCE, recovery_key
from schemas.topics import Topic

KEPT_BYTES = 16 << 20
"""the most a publisher keeps, whatever its history: large messages of a large fleet would fill the memory"""


class Publisher:
    """One output: publishes bytes on a key, and keeps the last ones for consumers that missed them."""

    def __init__(self, session: zenoh.Session, key: str, topic: Topic, encoding: str, producer: str) -> None:
        self.key = key
        self.published = 0
        self._history = topic.history
        self._kept: deque[tuple[int, bytes]] = deque()
        self._kept_bytes = 0
        self._lock = threading.Lock()
        self._publisher = session.declare_publisher(
            key,
            encoding=f"application/protobuf;{encoding}",
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )
        self._recovery_key = recovery_key(key, producer)
        self._queryable = session.declare_queryable(self._recovery_key, self._answer, complete=True)

    def put(self, payload: bytes) -> None:
        """Publish the message whose sequence number is `published`."""
        with self._lock:
            self._kept.append((self.published, payload))
            self._kept_bytes += len(payload)
            while len(self._kept) > self._history or self._kept_bytes > KEPT_BYTES:
                _, discarded = self._kept.popleft()
                self._kept_bytes -= len(discarded)
            self.published += 1
        self._publisher.put(payload)

    def _answer(self, query: zenoh.Query) -> None:
        """Answer with what is kept of a range, and at the end with the number of published messages."""
        first = int(query.parameters.get("first") or 0)
        last = int(query.parameters.get("last") or LAST_SEQUENCE)
        with self._lock:
            wanted = [payload for sequence, payload in self._kept if first <= sequence <= last]
            published = self.published
        with query:
            for payload in wanted:
                query.reply(self._recovery_key, payload)
            if query.parameters.get("count"):  # earlier versions do not ask, and would take it for a message
                query.reply(self._recovery_key, b"", attachment=str(published).encode())
