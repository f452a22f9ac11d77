"""The last message on each key of a topic, kept by others than its producer: for whoever takes over when the producer,
its files and its host have gone.

Whoever keeps messages answers at `<key>/kept/<producer>`, with its own name as a producer. The messages are as it has
received them: their headers name those that published them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from fantwin.schemas.topics import largest_bytes

_KEPT = "/kept/"


def kept_key(key: str, kept_by: str) -> str:
    """Where a producer answers for what others published on `key`; `kept_by` may be `*`."""
    return f"{key}{_KEPT}{kept_by}"


@dataclass(frozen=True, slots=True)
class KeptQuery:
    """Somebody asks for the last message on `key`."""

    key: str
    _kept_by: str
    _query: zenoh.Query

    def answer(self, payload: bytes | None) -> None:
        """Send the message; None: there is none."""
        with self._query:
            if payload is not None:
                self._query.reply(kept_key(self.key, self._kept_by), payload)


def answer_for_kept(
    session: zenoh.Session, key_expression: str, kept_by: str, on_query: Callable[[KeptQuery], object]
) -> zenoh.Queryable[None]:
    """Call `on_query`, from a thread of the bus, when somebody asks.

    key_expression: of the topic, of any tray; kept_by: the producer that keeps the messages.
    """

    def receive(query: zenoh.Query) -> None:
        on_query(KeptQuery(str(query.key_expr).rpartition(_KEPT)[0], kept_by, query))

    handler = zenoh.handlers.Callback(receive, indirect=False)
    return session.declare_queryable(kept_key(key_expression, kept_by), handler)


def ask_for_kept(session: zenoh.Session, key: str, timeout_s: float) -> tuple[list[bytes], bool]:
    """The messages that are kept for one key, and whether all who keep some have answered in time."""
    found: list[bytes] = []
    have_answered = True
    replies = session.get(
        kept_key(key, "*"),
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
