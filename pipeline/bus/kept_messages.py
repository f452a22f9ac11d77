"""The last message on each key of a topic, kept by others than its producer: for whoever takes over when the producer,
its files and its host have gone.

Whoever keeps messages answers at `<key>/kept/<producer>`, with its own name as a producer. The messages are as it has
received them: their headers name those that published them.
"""

from __future__ import annotations

import threading

import zenoh

from schemas.topics import largest_bytes

_KEPT = "/kept/"


class KeptMessages:
    """What one stage keeps for others, on the keys of one topic."""

    def __init__(self, session: zenoh.Session, key_expression: str, kept_by: str) -> None:
        """key_expression: of the topic, of any tray; kept_by: the producer that keeps them."""
        self._kept_by = kept_by
        self._messages: dict[str, bytes] = {}
        self._lock = threading.Lock()
        self._queryable = session.declare_queryable(f"{key_expression}{_KEPT}{kept_by}", self._answer)

    def put(self, key: str, payload: bytes) -> None:
        """The newest message on a key, which takes the place of the one before."""
        with self._lock:
            self._messages[key] = payload

    def _answer(self, query: zenoh.Query) -> None:
        asked = str(query.key_expr).partition(_KEPT)[0]
        with self._lock:
            payload = self._messages.get(asked)
        with query:
            if payload is not None:
                query.reply(f"{asked}{_KEPT}{self._kept_by}", payload)


def ask_for_kept(session: zenoh.Session, key: str, timeout_s: float) -> tuple[list[bytes], bool]:
    """The messages that are kept for one key, and whether all who keep some have answered in time."""
    found: list[bytes] = []
    have_answered = True
    replies = session.get(
        f"{key}{_KEPT}*",
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
