"""Identity on the bus: the id of a process's Zenoh session, with which the names of its producers end.

Zenoh marks each message and each answer with the id of the session that sent it. So a message in the name of another
session is known by itself, without asking anybody, and is refused. A program that also forges Zenoh's mark is kept away
by certificates only (`pipeline.bus.credentials`, docs/how-to/security.md).
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable

import zenoh

from fantwin.schemas.codec import CodecError, decode_header
from fantwin.schemas.topics import key_in_words, topic_of

SHOWN_S = 60.0
"""how long health names the last forged message"""
_DIGITS = 16
_NAMES_SESSION = re.compile(rf".*-([1-9a-f][0-9a-f]{{{_DIGITS - 1}}})", re.DOTALL)


def new_session_id() -> str:
    """A random id for a Zenoh session. Zenoh takes no leading zero."""
    return "f" + secrets.token_hex(_DIGITS // 2)[1:]


def names_another(producer: str, session_id: str) -> bool:
    """Whether the name of a producer is that of another session. A name without an id may be anybody's."""
    match = _NAMES_SESSION.fullmatch(producer)
    return match is not None and match[1] != session_id


def sender_of(sample: zenoh.Sample) -> str:
    """The id of the session that published a message; empty if it carries none."""
    info = sample.source_info
    return str(info.source_id.zid) if info else ""


def answerer_of(reply: zenoh.Reply) -> str:
    """The id of the session that has answered; empty if the answer carries none."""
    answerer = reply.replier_id
    return str(answerer.zid) if answerer else ""


class Forgeries:
    """Finds and counts messages whose producer is not the session that sent them."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self.count = 0
        self._now_s = now_s
        self._last, self._seen_s = "", 0.0

    def is_one(self, key: str, payload: bytes, session_id: str) -> bool:
        """Whether a message on this key is in the name of another session than sent it; it is then counted. One that
        cannot be read is in nobody's name."""
        try:
            producer = str(decode_header(topic_of(key).message, payload).producer)
        except (KeyError, CodecError):
            return False
        if not names_another(producer, session_id):
            return False
        self.count += 1
        self._last, self._seen_s = f"{key_in_words(key)} in the name of {producer}", self._now_s()
        return True

    def problem(self) -> str:
        """The last forged message, while it is recent; empty if there is none."""
        if not self._last or self._now_s() - self._seen_s >= SHOWN_S:
            return ""
        return f"another program publishes {self._last}: refused; stop that program"
