"""The acquisition of one tray as it shows itself on the bus to a program that is no stage: its tokens, and its last
health.

Only this much is watched, and little is imported: a command is to be answered at once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.runtime.sessions import Session, Sessions
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.health import Health
from fantwin.schemas.topics import alive_key, health_key, sessions_key

STAGE = "acquisition"
MOST_SESSIONS = 64
"""number of last health messages that are kept"""


def _nothing() -> None:
    pass


class TrayAcquisition:
    """Tracks which session of acquisition has the tray, and what it says of itself."""

    def __init__(self, bus: Bus, site: str, tray: str, on_change: Callable[[], None] = _nothing) -> None:
        """on_change: called from a thread of the bus after a token or a health message has come; it must not block."""
        self._bus = bus
        self._site = site
        self._tray = tray
        self._on_change = on_change
        self._lock = threading.Lock()
        self._sessions = Sessions()
        self._tokens: set[str] = set()
        """liveliness tokens of stages that are at work"""
        self._healths: dict[str, Health] = {}
        """last health of each producer, in the order heard"""
        self._watched: set[str] = set()
        """the keys of health messages that are listened to"""
        self._ends = [
            bus.watch_alive(alive_key(site, STAGE, "*"), self._on_token),
            bus.watch_alive(sessions_key(site, STAGE), self._on_session),
        ]
        """functions that end the subscriptions"""

    def close(self) -> None:
        """Watch no longer. Not to be called from a thread of the bus."""
        while self._ends:
            self._ends.pop()()

    def at_work(self) -> Session | None:
        """The session that has the tray, once it is at work."""
        with self._lock:
            session = self._sessions.owner(STAGE, self._tray)
            is_there = session is not None and alive_key(self._site, STAGE, session.instance) in self._tokens
            return session if is_there else None

    def watch_health(self) -> Session | None:
        """Listen to the health of the process that has the tray, also after it was restarted, and fetch the last one;
        the session, None if there is none. Not to be called from a thread of the bus."""
        session = self.at_work()
        if session is None:
            return None
        key = health_key(self._site, STAGE, session.instance)
        if key not in self._watched:
            self._watched.add(key)
            self._ends.append(self._bus.subscribe(key, self._on_health))
            for its_key, payload in self._bus.recover(key):
                self._on_health(its_key, payload)
        return session

    def health(self) -> Health | None:
        """The last health of the session that has the tray and is at work."""
        session = self.at_work()
        with self._lock:
            return self._healths.get(session.producer) if session else None

    def _on_token(self, key: str, alive: bool) -> None:
        with self._lock:
            (self._tokens.add if alive else self._tokens.discard)(key)
        self._on_change()

    def _on_session(self, key: str, alive: bool) -> None:
        with self._lock:
            self._sessions.update(key, alive)
        self._on_change()

    def _on_health(self, _key: str, payload: bytes) -> None:
        try:
            health = decode(Health, payload)
        except CodecError:
            return
        with self._lock:
            before = self._healths.pop(health.header.producer, None)
            is_older = before is not None and before.header.sequence > health.header.sequence
            self._healths[health.header.producer] = before if before and is_older else health
            if len(self._healths) > MOST_SESSIONS:
                del self._healths[next(iter(self._healths))]
        self._on_change()
