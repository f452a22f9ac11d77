"""Whether what a session declares is accepted. Zenoh drops what is not allowed without a word to whoever sent it, so a
session asks the router, which answers from the rules that it enforces; peers all have the same rules.

Where a site has two routers, that of the session counts: what other routers pass on, each accepts.

A role may only ask for its own rights. So no answer means that the router does not know the role, and refuses all; but
only while the router is there: an answer is awaited for longer than a dead link goes unnoticed.
"""

from __future__ import annotations

import json
import threading
import time

import zenoh

from fantwin.pipeline.bus.access_rules import Rights, SiteRoles
from fantwin.pipeline.bus.link import LEASE_MS
from fantwin.pipeline.config.roles import OPERATOR
from fantwin.schemas.topics import key_in_words, rights_key

PERIOD_S = 2.0
"""so often a session asks"""
ANSWER_LIMIT_S = 3.0
UNANSWERED_LIMIT_S = float(LEASE_MS) / 1000 + 1.0
"""a router that is there all this time and does not answer refuses the question"""
_START_LIMIT_S = UNANSWERED_LIMIT_S + 1.0
"""how long a session that begins waits for an answer"""
_POLL_S = 0.1
_SHOWN = 3
_WORDS = {
    "put": "publish",
    "declare_subscriber": "read",
    "declare_queryable": "answer for",
    "liveliness_token": "show that it runs as",
}


def granted_rights(session: zenoh.Session, site: str, role: str) -> Rights | None:
    """What the router grants a role; None if it does not answer: it does not know the role, has just started, or is
    overloaded. Waits for the answer."""
    replies = session.get(rights_key(site, role), timeout=ANSWER_LIMIT_S, consolidation=zenoh.ConsolidationMode.NONE)
    return next(filter(None, (_rights_in(reply, session) for reply in replies)), None)


class OwnRights:
    """What one session has declared, and whether it may. Used from one thread, but for answers of the bus."""

    def __init__(self, session: zenoh.Session, site: SiteRoles, role: str, *, is_client: bool) -> None:
        self._session = session
        self._site = site
        self._role = role
        self._is_client = is_client
        self._claims: dict[tuple[str, str], None] = {}
        self._own = site.rights(role)
        """by this process's own configuration"""
        self._granted: Rights | None = None
        """by the router"""
        self._routers: set[str] = set()
        self._asked_s: float | None = None
        """since when there is a question without an answer and the same router, monotonic; None: there is none"""
        self._next_s = 0.0
        self._lock = threading.Lock()

    def add(self, message: str, key: str) -> None:
        """The session sends messages of this kind on this key or key expression."""
        self._claims[message, key] = None

    def discard(self, message: str, key: str) -> None:
        """It does so no longer."""
        self._claims.pop((message, key), None)

    def ask(self) -> None:
        """Ask the router, if it is time to. To be called often; the answer changes `problem`."""
        now_s = time.monotonic()
        if self._is_client and now_s >= self._next_s and self._is_connected():
            self._next_s = now_s + PERIOD_S
            with self._lock:
                self._asked_s = self._asked_s or now_s
            self._ask()

    def problem(self) -> str:
        """What is refused, and what to do; empty if all is accepted, as far as is known."""
        role = self._role
        if self._own is None:
            return f"its certificate says {role!r}, which is no role of site {self._site.site!r}; all is refused"
        if refused := self._refused(self._own):
            return (
                f"its certificate says {role!r}, which may not {refused}; use the certificate of {self._fitting_role()}"
            )
        is_connected = self._is_connected()
        with self._lock:
            granted, asked_s = self._granted, self._asked_s
        if is_connected and asked_s and time.monotonic() - asked_s > UNANSWERED_LIMIT_S:
            return (
                f"the router refuses all of role {role!r}: restart it, `fantwin router -c`, with a configuration of "
                f"site {self._site.site!r} that has this role"
            )
        if granted and (refused := self._refused(granted)):
            return f"the router does not let {role!r} {refused}: restart the router with this configuration"
        return ""

    def wait(self, stop: threading.Event | None = None) -> str:
        """The problem once the router has answered; waits for it a moment."""
        until_s = time.monotonic() + _START_LIMIT_S
        pause = stop or threading.Event()
        while self._is_client and not (self._granted or self.problem()) and time.monotonic() < until_s:
            self.ask()
            if pause.wait(_POLL_S):
                break
            self._next_s = min(self._next_s, time.monotonic() + _POLL_S)
        return self.problem()

    def _is_connected(self) -> bool:
        """Whether a router is there now. What another one was asked counts no longer."""
        routers = {str(each) for each in self._session.info.routers_zid()}
        with self._lock:
            if routers != self._routers:
                self._routers, self._asked_s = routers, None
        return bool(routers)

    def _fitting_role(self) -> str:
        """The role that may send all that this session declares, in words: the operator's, or that of its stage."""
        rights = self._site.rights(OPERATOR)
        is_operator = rights is not None and all(rights.allow(*claim) for claim in tuple(self._claims))
        return f"role {OPERATOR!r}" if is_operator else "its own role"

    def _refused(self, rights: Rights) -> str:
        refused = [(message, key) for message, key in tuple(self._claims) if not rights.allow(message, key)]
        # a role that may not publish may not answer for published messages either: that is not named as well
        found = [claim for claim in refused if claim[0] != "declare_queryable"] or refused
        words = list(dict.fromkeys(f"{_WORDS.get(message, message)} {key_in_words(key)}" for message, key in found))
        more = f" and {len(words) - _SHOWN} more" if len(words) > _SHOWN else ""
        return ", ".join(words[:_SHOWN]) + more

    def _ask(self) -> None:
        answers: list[Rights | None] = []

        def receive(reply: zenoh.Reply) -> None:
            answers.append(_rights_in(reply, self._session))

        def finish() -> None:
            rights = next(filter(None, answers), None)
            if rights:
                with self._lock:
                    self._granted, self._asked_s = rights, None

        self._session.get(
            rights_key(self._site.site, self._role),
            zenoh.handlers.Callback(receive, finish, indirect=False),
            timeout=ANSWER_LIMIT_S,
            consolidation=zenoh.ConsolidationMode.NONE,
        )


def answer_rights(session: zenoh.Session, site: SiteRoles) -> zenoh.Queryable[None]:
    """Answer, in a router, what each role may do."""

    def receive(query: zenoh.Query) -> None:
        with query:
            rights = site.rights(str(query.key_expr).rpartition("/")[2])
            if rights is not None:
                query.reply(query.key_expr, json.dumps(dict(rights.of_message)).encode())

    return session.declare_queryable(rights_key(site.site, "*"), zenoh.handlers.Callback(receive, indirect=False))


def _rights_in(reply: zenoh.Reply, session: zenoh.Session) -> Rights | None:
    """The rights in an answer of the router of a session. Another router of the site, which does not decide what this
    session may do, answers as well."""
    router = reply.replier_id
    if reply.ok is None or (router is not None and router.zid not in session.info.routers_zid()):
        return None
    return _decoded(reply.ok.payload.to_bytes())


def _decoded(answer: bytes) -> Rights | None:
    try:
        found = json.loads(answer)
        return Rights({str(message): tuple(map(str, keys)) for message, keys in found.items()})
    except (ValueError, AttributeError, TypeError):
        return None
