"""Who is logged in: sessions that only the server knows, found by a random cookie."""

from __future__ import annotations

import hashlib
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

IDLE_S = 30 * 60.0
"""a session without a request, and without a page that is open, for so long is over"""
LONGEST_S = 12 * 3600.0
MOST_SESSIONS, MOST_OF_A_USER = 1000, 20
"""of more, those that were seen longest ago end"""


@dataclass(slots=True)
class Session:
    """A user who is logged in; times of a monotonic clock.

    Attributes:
        password_hash: with which he has logged in: with another password, the session is over.
        csrf_token: a page sends it with all that it changes.
    """

    user: str
    password_hash: str
    csrf_token: str
    began_s: float
    seen_s: float


class LoginSessions:
    """Used in the thread of the web server only."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._sessions: OrderedDict[str, Session] = OrderedDict()
        """by the hash of the cookie; the ones seen last come last"""

    def begin(self, user: str, password_hash: str) -> tuple[str, Session]:
        """A new session and its cookie."""
        cookie, now_s = secrets.token_urlsafe(32), self._now_s()
        of_user = [name for name, each in self._sessions.items() if each.user == user]
        for name in of_user[: len(of_user) + 1 - MOST_OF_A_USER]:
            del self._sessions[name]
        session = Session(user, password_hash, secrets.token_urlsafe(32), now_s, now_s)
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


def _hashed(cookie: str) -> str:
    return hashlib.sha256(cookie.encode()).hexdigest()
