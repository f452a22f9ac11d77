"""Publishing with recovery: a publisher keeps its last messages and answers requests for those that were missed."""

from __future__ import annotations

import threading
from collections import deque
from itertools import islice

import zenoh

from fantwin.pipeline.bus.recovery import (
    LAST_SEQUENCE,
    MOST_RECOVERED_BYTES,
    MOST_RECOVERED_MESSAGES,
    number_in,
    recovery_key,
)
from fantwin.schemas.topics import Topic

KEPT_BYTES = 16 << 20
"""the most a publisher keeps, whatever its history: large messages of a large fleet would fill the memory"""
KEPT_BYTES_OF_ALL = 256 << 20
"""the most that all publishers of a process keep together; what is published only on change is kept beyond that"""


class KeptBytes:
    """How much the publishers of a session keep together."""

    def __init__(self) -> None:
        self.total = 0
        self.lock = threading.Lock()


class Publisher:
    """One output: publishes bytes on a key, and keeps the last ones for consumers that missed them."""

    def __init__(
        self, session: zenoh.Session, key: str, topic: Topic, encoding: str, producer: str, kept_bytes: KeptBytes
    ) -> None:
        self.key = key
        self.published = 0
        self._topic = topic
        self._kept: deque[tuple[int, bytes]] = deque()
        self._kept_bytes = 0
        self._of_all = kept_bytes
        self._publisher = session.declare_publisher(
            key,
            encoding=f"application/protobuf;{encoding}",
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )
        self._sender = zenoh.SourceInfo(self._publisher.id, 0)
        self._recovery_key = recovery_key(key, producer)
        self._queryable = session.declare_queryable(self._recovery_key, self._answer, complete=True)

    def put(self, payload: bytes) -> None:
        """Publish the message whose sequence number is `published`."""
        with self._of_all.lock:
            self._kept.append((self.published, payload))
            self._add(len(payload))
            self.published += 1
            while self._keeps_too_much():
                self._add(-len(self._kept.popleft()[1]))
        self._publisher.put(payload, source_info=self._sender)

    def forget(self, before: int) -> None:
        """Keep no message with a sequence number below `before`: its consumer has it."""
        with self._of_all.lock:
            while self._kept and self._kept[0][0] < before:
                self._add(-len(self._kept.popleft()[1]))

    def _add(self, size: int) -> None:
        self._kept_bytes += size
        if not self._topic.is_rare:
            self._of_all.total += size

    def _keeps_too_much(self) -> bool:
        if len(self._kept) > self._topic.kept:
            return True
        is_full = self._kept_bytes > KEPT_BYTES
        is_full |= self._of_all.total > KEPT_BYTES_OF_ALL and not self._topic.is_rare
        return is_full and len(self._kept) > 1  # the newest is kept, however large it is

    def _answer(self, query: zenoh.Query) -> None:
        """Answer with the kept messages of a range, and at the end with the number of published messages.

        A consumer that starts asks only for the newest messages, and gets no number. The number is also left out if
        more is kept than a consumer takes in one answer: the consumer then asks for the rest.
        """
        first, last, newest = (number_in(query.parameters.get(name) or "") for name in ("first", "last", "newest"))
        first, last = first or 0, LAST_SEQUENCE if last is None else last
        with self._of_all.lock:
            published = self.published
            oldest = published - len(self._kept)  # sequence numbers have no gaps
            end = min(last + 1, published)
            if newest:
                first = max(first, end - min(newest, self._topic.history))
            begin = max(first, oldest)
            kept = [payload for _, payload in islice(self._kept, begin - oldest, max(begin, end) - oldest)]
        messages, size = 0, 0
        with query:
            for payload in kept:
                messages, size = messages + 1, size + len(payload)
                if messages > MOST_RECOVERED_MESSAGES or (size > MOST_RECOVERED_BYTES and messages > 1):
                    return
                query.reply(self._recovery_key, payload)
            if not newest:
                query.reply(self._recovery_key, b"", attachment=str(published).encode())
