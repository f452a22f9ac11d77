"""Who is logged in: sessions that only the server knows, found by a random cookie."""

from __future__ import annotations

import hashlib
import secrets
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass

IDLE_S = 30 * 60.0
"""a session without a request for so long is over (ASVS 3.3.2)"""
LONGEST_S = 12 * 3600.0
MOST_SESSIONS = 1000
FAILURES, FAILURES_WITHIN_S = 5, 60.0
"""so many wrong passwords for one name, or from one address: then nobody logs in so until the first is that old"""
MOST_COUNTED = 4096


@dataclass(slots=True)
class Session:
    """A user who is logged in; times of a monotonic clock. csrf_token: a page sends it with all that it changes."""

    user: str
    csrf_token: str
    began_s: float
    seen_s: float


class LoginSessions:
    """Used in the thread of the web server only."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._sessions: OrderedDict[str, Session] = OrderedDict()
        """by the hash of the cookie; the ones seen last come last"""
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()

    def begin(self, user: str) -> tuple[str, Session]:
        """A new session and its cookie."""
        cookie, now_s = secrets.token_urlsafe(32), self._now_s()
        session = Session(user, secrets.token_urlsafe(32), now_s, now_s)
        self._sessions[_hashed(cookie)] = session
        while len(self._sessions) > MOST_SESSIONS:
            self._sessions.popitem(last=False)
        return cookie, session

    def of(self, cookie: str) -> Session | None:
        """The session of a cookie; None: there is none, or it is over."""
        session, now_s = self._sessions.get(_hashed(cookie)), self._now_s()
        if session is None:
            return None
        if now_s - session.seen_s > IDLE_S or now_s - session.began_s > LONGEST_S:
            self.end(cookie)
            return None
        session.seen_s = now_s
        self._sessions.move_to_end(_hashed(cookie))
        return session

    def end(self, cookie: str) -> None:
        """Log out."""
        self._sessions.pop(_hashed(cookie), None)

    def wait_s(self, *names: str) -> float:
        """How long nobody may log in under one of these names, or from one of these addresses; 0: at once."""
        now_s = self._now_s()
        waits = [
            FAILURES_WITHIN_S - (now_s - failures[0])
            for name in names
            if len(failures := self._failures.get(name, deque[float]())) == FAILURES
        ]
        return max(0.0, *waits) if waits else 0.0

    def add_failure(self, *names: str) -> None:
        """A password was wrong."""
        for name in names:
            self._failures.setdefault(name, deque(maxlen=FAILURES)).append(self._now_s())
            self._failures.move_to_end(name)
        while len(self._failures) > MOST_COUNTED:
            self._failures.popitem(last=False)

    def forget_failures(self, *names: str) -> None:
        """A password was right."""
        for name in names:
            self._failures.pop(name, None)


def _hashed(cookie: str) -> str:
    return hashlib.sha256(cookie.encode()).hexdigest()
