"""Who asks, and what he may do.

A page is read without a login on loopback; whoever acts is a user, by a session or by the header of a proxy. What
changes something must come from a page of this server: the browser says so (Sec-Fetch-Site, Origin), and the page sends
the token of its session, which no other page can read.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from fastapi import HTTPException, Request

from fantwin.pipeline.outputs.web.config import GatewayConfig
from fantwin.pipeline.site.security_log import LoginFailures, SecurityLog
from fantwin.pipeline.site.users import NAME, User, UserRole, Users

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
    """Sessions of users who are logged in, known to the server alone and found by a random cookie.

    Used in the thread of the web server only.
    """

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


COOKIE, SECURE_COOKIE = "fantwin", "__Host-fantwin"
CSRF_HEADER = "X-CSRF-Token"
MOST_LOGINS = 16
"""that wait for their password to be checked, which takes memory and time"""
_OWN_SITE = {"same-origin"}
_OF_PROXIES = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip", "via")
_UNREADABLE = "nobody can log in or use a token: the file of users cannot be read; health says why"
_ANY_TOKEN = ""
"""stands for the name of a user where wrong tokens are counted: no user has it"""


@dataclass(frozen=True)
class Visitor:
    """Who asks. name: of the user, empty if nobody is logged in. session: None without a login of this server."""

    name: str
    may_read: bool
    may_act: bool
    session: Session | None = None


class Access:
    """The rules of one gateway."""

    def __init__(
        self,
        config: GatewayConfig,
        users: Users | None,
        log: SecurityLog | None = None,
    ) -> None:
        """users: None where a proxy knows the users, or nobody may act."""
        self._config = config
        self._users = users
        self.sessions = LoginSessions()
        self.log = log or SecurityLog()
        self._failures = LoginFailures()
        self._logins = 0
        self._one_at_a_time = asyncio.Lock()

    @property
    def has_login(self) -> bool:
        """Whether users log in here."""
        return self._users is not None

    @property
    def problem(self) -> str:
        """What is wrong with the file of users; empty if nothing is."""
        return self._users.problem if self._users else ""

    @property
    def cookie_name(self) -> str:
        """Over https, browsers accept the cookie from this host only, and send it by https only."""
        return SECURE_COOKIE if self._config.is_https else COOKIE

    @property
    def cookie(self) -> dict[str, Any]:
        """How the cookie is set and deleted: no script reads it, no other site sends it."""
        is_secure = self._config.is_https
        return {"key": self.cookie_name, "httponly": True, "samesite": "strict", "secure": is_secure}

    def visitor(self, request: Request) -> Visitor:
        """Who sends a request.

        Raises:
            HTTPException: 401, 429 or 503, a program sends a token that is none, or cannot be looked up.
        """
        if self._config.user_header:
            return self._of_proxy(request)
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        if self._users is not None and kind.lower() == "bearer":
            return self._of_token(self._users, token.strip(), request)
        cookie = request.cookies.get(self.cookie_name, "")
        session = self.sessions.of(cookie) if cookie else None
        user = self._users.of(session.user) if session and self._users else None
        if session is not None and (user is None or user.password_hash != session.password_hash):
            self.sessions.end(cookie)
        elif session is not None and user is not None:
            return Visitor(user.name, may_read=True, may_act=user.role == UserRole.OPERATOR, session=session)
        return Visitor("", may_read=self._is_free(request), may_act=False)

    async def reader(self, request: Request) -> Visitor:
        """Who sends a request that only reads.

        Raises:
            HTTPException: 401, he may not read.
        """
        visitor = self.visitor(request)
        if not visitor.may_read:
            raise HTTPException(401, "log in first")
        return visitor

    def may_still_read(self, request: Request) -> bool:
        """Whether who has begun a long answer may go on."""
        try:
            return self.visitor(request).may_read
        except HTTPException:
            return False

    async def operator(self, request: Request) -> Visitor:
        """Who sends a request that changes something.

        Raises:
            HTTPException: 401 or 403, he may not, or it does not come from a page of this server.
        """
        name = ""
        try:
            await require_own_page(request)
            visitor = self.visitor(request)
            name = visitor.name
            if not name:
                raise HTTPException(401, self._who_acts(request))
            if visitor.session is not None:
                require_token(request, visitor.session)
            if not visitor.may_act:
                raise HTTPException(403, f"{name} may view but not act")
        except HTTPException as error:
            self.log.add("request refused", user=name, path=request.url.path, why=error.detail, **address_of(request))
            raise
        return visitor

    async def log_in(self, name: str, password: str, request: Request) -> tuple[str, Session]:
        """Begin a session, in place of the one before: its cookie, and what it is.

        Raises:
            HTTPException: 401, 404, 429 or 503.
        """
        if self._users is None:
            raise HTTPException(404, "nobody logs in here")
        user = await self._verified(self._users, name, password, request)
        self.log.add("login", user=user.name, role=str(user.role), **address_of(request))
        self.sessions.end(request.cookies.get(self.cookie_name, ""))
        return self.sessions.begin(user.name, user.password_hash)

    async def _verified(self, users: Users, name: str, password: str, request: Request) -> User:
        """The user with this name and password. To check one takes long; the server goes on meanwhile.

        Raises:
            HTTPException: 401, 429 or 503.
        """
        where = address_of(request)
        if self._logins >= MOST_LOGINS:
            raise HTTPException(503, "too many logins at once: try again")
        user = users.of(name)
        if users.problem:
            raise HTTPException(503, _UNREADABLE)
        if wait_s := self._failures.begin(name, where["address"]):
            self.log.add("login refused: too many wrong passwords", user=name, **where)
            raise HTTPException(429, "too many wrong passwords: try again later", {"Retry-After": f"{wait_s:.0f}"})
        self._logins += 1
        try:
            async with self._one_at_a_time:  # each takes 64 MB and much of a processor
                is_right = await asyncio.to_thread(users.is_password, user, password)
        finally:
            self._logins -= 1
        if user is None or not is_right:
            self.log.add("login refused: wrong name or password", user=name, **where)
            raise HTTPException(401, "wrong name or password")
        self._failures.succeed(name, where["address"])
        return user

    def _of_token(self, users: Users, text: str, request: Request) -> Visitor:
        """A program with a token; a session that it has beside it does not count."""
        found = users.of_token(text)
        if users.problem:
            raise HTTPException(503, _UNREADABLE)
        if found is not None:
            return Visitor(found.name, may_read=True, may_act=found.role == UserRole.OPERATOR)
        where = address_of(request)
        wait_s = self._failures.begin(_ANY_TOKEN, where["address"])
        self.log.add("token refused", path=request.url.path, **where)
        if wait_s:
            raise HTTPException(429, "too many wrong tokens: try again later", {"Retry-After": f"{wait_s:.0f}"})
        raise HTTPException(401, "no such token, or it has ended", {"WWW-Authenticate": "Bearer"})

    def _who_acts(self, request: Request) -> str:
        """What somebody without a name must do to act."""
        if self.has_login:
            return "log in first"
        header = self._config.user_header
        if not header:
            return "nobody can act here: [gateway] has no users"
        if plain_address(address_of(request)["address"]) not in self._config.proxies:
            return "users come through the proxy of this page: ask there"
        return f"the proxy has sent no {header} with the name of a user, or no valid one"

    def _is_free(self, request: Request) -> bool:
        """Whether whoever asks may read without a login: only on this host, and not through a proxy that has its users
        here."""
        if not self._config.is_loopback or self._config.user_header:
            return False
        is_through_proxy = self._config.has_other_hosts or any(name in request.headers for name in _OF_PROXIES)
        return not (self.has_login and is_through_proxy)

    def _of_proxy(self, request: Request) -> Visitor:
        """The name counts only if the proxy has sent it, and once; whoever else reaches the server is nobody."""
        names = request.headers.getlist(self._config.user_header)
        if plain_address(address_of(request)["address"]) not in self._config.proxies:
            return Visitor("", may_read=False, may_act=False)
        if len(names) != 1 or not NAME.fullmatch(names[0]):
            return Visitor("", may_read=False, may_act=False)
        return Visitor(names[0], may_read=True, may_act=names[0] in self._config.operators)


def address_of(request: Request) -> dict[str, str]:
    """From where a request comes, for the log: of the connection, whatever headers say."""
    return {"address": request.client.host if request.client else ""}


def plain_address(address: str) -> str:
    """Without the form that IPv4 has on a socket of IPv6."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(getattr(found, "ipv4_mapped", None) or found)


async def require_own_page(request: Request) -> None:
    """What changes something must come from a page of this server, or from a program that is no browser.

    Raises:
        HTTPException: 403, another site's page has sent it.
    """
    headers: Mapping[str, str] = request.headers
    site, origin = headers.get("sec-fetch-site", ""), headers.get("origin", "")
    if (site and site not in _OWN_SITE) or (origin and _host_of(origin) != headers.get("host", "")):
        raise HTTPException(403, "the request comes from a page of another site")


def require_token(request: Request, session: Session) -> None:
    """Raises:
    HTTPException: 403, the token of the session is missing or another one.
    """
    if not hmac.compare_digest(request.headers.get(CSRF_HEADER, "").encode(), session.csrf_token.encode()):
        raise HTTPException(403, f"{CSRF_HEADER} is missing or wrong: load the page again")


def _host_of(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None
