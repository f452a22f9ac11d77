"""The last message on each key of a topic, kept by others than its producer: for whoever takes over when the producer,
its files and its host have gone.

Whoever keeps messages answers queries for the topic's own key. The messages are as it has received them: their headers
name those that published them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from fantwin.schemas.topics import largest_bytes


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
