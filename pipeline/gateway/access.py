"""Who asks, and what he may do.

A page is read without a login on loopback; whoever acts is a user, by a session or by the header of a proxy. What
changes something must come from a page of this server: the browser says so (Sec-Fetch-Site, Origin), and the page sends
the token of its session, which no other page can read.
"""

from __future__ import annotations

import hmac
from base64 import b64decode
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request

from pipeline.gateway.config import GatewayConfig
from pipeline.gateway.sessions import LoginSessions, Session
from pipeline.presenting.login_failures import LoginFailures
from pipeline.presenting.users import NAME, UserRole, Users

COOKIE, SECURE_COOKIE = "fantwin", "__Host-fantwin"
CSRF_HEADER = "X-CSRF-Token"
_OWN_SITE = {"same-origin"}
_ASK_FOR_PASSWORD = {"WWW-Authenticate": 'Basic realm="fantwin"'}


@dataclass(frozen=True)
class Visitor:
    """Who asks. name: of the user, empty if nobody is logged in. session: None without a login of this server."""

    name: str
    may_read: bool
    may_act: bool
    session: Session | None = None


class Access:
    """The rules of one gateway."""

    def __init__(self, config: GatewayConfig, users: Users | None) -> None:
        """users: None where a proxy knows them, or nobody may act."""
        self._config = config
        self._users = users
        self.sessions = LoginSessions()
        self._failures = LoginFailures()

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
        return SECURE_COOKIE if self._config.certificate else COOKIE

    def visitor(self, request: Request) -> Visitor:
        """Who sends a request."""
        is_free = self._config.is_loopback and not self._config.user_header
        if self._config.user_header:
            return self._of_proxy(request)
        cookie = request.cookies.get(self.cookie_name, "")
        session = self.sessions.of(cookie) if cookie else None
        user = self._users.of(session.user) if session and self._users else None
        if session is None or user is None:
            return Visitor("", may_read=is_free, may_act=False)
        return Visitor(user.name, may_read=True, may_act=user.role == UserRole.OPERATOR, session=session)

    def reader(self, request: Request) -> Visitor:
        """Who sends a request that only reads.

        Raises:
            HTTPException: 401, he may not read.
        """
        visitor = self.visitor(request)
        if not visitor.may_read:
            raise HTTPException(401, "log in first")
        return visitor

    def operator(self, request: Request) -> Visitor:
        """Who sends a request that changes something.

        Raises:
            HTTPException: 401 or 403, he may not, or it does not come from a page of this server.
        """
        require_own_page(request)
        visitor = self.visitor(request)
        if not visitor.name:
            raise HTTPException(
                401, "log in first" if self.has_login else "nobody can act here: [gateway] has no users"
            )
        if visitor.session is not None:
            require_token(request, visitor.session)
        if not visitor.may_act:
            raise HTTPException(403, f"{visitor.name} may look, and not act")
        return visitor

    def log_in(self, name: str, password: str, address: str) -> tuple[str, Session]:
        """Begin a session: its cookie, and what it is.

        Raises:
            HTTPException: 401, 404 or 429.
        """
        if self._users is None:
            raise HTTPException(404, "nobody logs in here")
        counted = self._counted(name, address)
        user = self._users.verified(name, password)
        if user is None:
            self._failures.add(*counted)
            raise HTTPException(401, "no such user, or another password")
        self._failures.forget(*counted)
        return self.sessions.begin(user.name)

    async def require_scraper(self, request: Request) -> None:
        """Let whoever may read have the metrics, and a program that sends name and password of a user each time (HTTP
        Basic). A password takes long to verify, in which the server goes on.

        Raises:
            HTTPException: 401 or 429, he may not.
        """
        kind, _, encoded = request.headers.get("authorization", "").partition(" ")
        if self._users is None or kind.lower() != "basic":
            try:
                self.reader(request)
            except HTTPException as error:
                error.headers = _ASK_FOR_PASSWORD if self.has_login else None
                raise
            return
        try:
            name, _, password = b64decode(encoded, validate=True).decode().partition(":")
        except ValueError as error:
            raise HTTPException(401, "this is no name and password", _ASK_FOR_PASSWORD) from error
        counted = self._counted(name, request.client.host if request.client else "")
        if await run_in_threadpool(self._users.verified, name, password) is None:
            self._failures.add(*counted)
            raise HTTPException(401, "no such user, or another password", _ASK_FOR_PASSWORD)
        self._failures.forget(*counted)

    def _counted(self, name: str, address: str) -> tuple[str, str]:
        """Under what a wrong password is counted.

        Raises:
            HTTPException: 429, there were too many.
        """
        counted = (f"name {name}", f"address {address}")
        if wait_s := self._failures.wait_s(*counted):
            raise HTTPException(429, "too many wrong passwords: try again later", {"Retry-After": f"{wait_s:.0f}"})
        return counted

    def _of_proxy(self, request: Request) -> Visitor:
        """The name counts only if the proxy has sent it; whoever else reaches the server is nobody."""
        address = request.client.host if request.client else ""
        name = request.headers.get(self._config.user_header, "")
        if address not in self._config.proxies or not NAME.fullmatch(name):
            return Visitor("", may_read=False, may_act=False)
        return Visitor(name, may_read=True, may_act=name in self._config.operators)


def require_own_page(request: Request) -> None:
    """What changes something must come from a page of this server, or from a program that is no browser.

    Raises:
        HTTPException: 403, another site's page has sent it.
    """
    headers: Mapping[str, str] = request.headers
    site, origin = headers.get("sec-fetch-site", ""), headers.get("origin", "")
    if (site and site not in _OWN_SITE) or (origin and urlsplit(origin).netloc != headers.get("host", "")):
        raise HTTPException(403, "the request comes from a page of another site")


def require_token(request: Request, session: Session) -> None:
    """Raises:
    HTTPException: 403, the token of the session is missing or another one.
    """
    if not hmac.compare_digest(request.headers.get(CSRF_HEADER, "").encode(), session.csrf_token.encode()):
        raise HTTPException(403, f"{CSRF_HEADER} is missing or wrong: load the page again")
