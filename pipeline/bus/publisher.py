"""Publishing with recovery: a publisher keeps its last messages and answers requests for those that were missed.

The last message on each key of a topic, kept by others than its producer: for whoever takes over when the producer,
its files and its host have gone.

Whoever keeps messages answers queries for the topic's own key. The messages are as it has received them: their headers
name those that published them.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import zenoh

from fantwin.pipeline.bus.recovery import (
    LAST_SEQUENCE,
    MOST_RECOVERED_BYTES,
    MOST_RECOVERED_MESSAGES,
    number_in,
    recovery_key,
)
from fantwin.schemas.topics import Topic, largest_bytes


@dataclass(frozen=True, slots=True)
class KeptQuery:
    """Somebody asks for the last message on `key`."""

    key: str
    _query: zenoh.Query

    def answer(self, payload: bytes) -> None:
        """Send the message; empty: this process would keep it, and there is none."""
        with self._query:
            self._query.reply(self.key, payload)

    def decline(self) -> None:
        """Say that this process keeps no messages of this key."""
        self._query.drop()


def answer_for_kept(
    session: zenoh.Session, key_expression: str, on_query: Callable[[KeptQuery], object]
) -> zenoh.Queryable[None]:
    """Call `on_query`, from a thread of the bus, when somebody asks. key_expression: of the topic, of any tray."""

    def receive(query: zenoh.Query) -> None:
        on_query(KeptQuery(str(query.key_expr), query))

    return session.declare_queryable(key_expression, zenoh.handlers.Callback(receive, indirect=False))


def ask_for_kept(session: zenoh.Session, key: str, timeout_s: float) -> tuple[list[bytes], bool]:
    """A message of each that keeps those of a key, empty if it has none, and whether all have answered in time."""
    found: list[bytes] = []
    have_answered = True
    replies = session.get(
        key,
        target=zenoh.QueryTarget.ALL,
        timeout=timeout_s,
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=zenoh.CongestionControl.BLOCK,
    )
    for reply in replies:
        if reply.ok is None:  # the only error of these queries: not all have answered in time
            have_answered = False
        elif len(reply.ok.payload) <= largest_bytes(key):
            found.append(reply.ok.payload.to_bytes())
    return found, have_answered


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
