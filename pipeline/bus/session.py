"""A session on the bus. Only this room knows Zenoh.

Data is published with congestion control BLOCK. Each publisher keeps its last messages, so that a consumer that was not
yet connected, or was restarted, can request what it missed.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import ClassVar, Self

import zenoh

from fantwin.pipeline.bus.endpoint import endpoint_problem, somebody_listens
from fantwin.pipeline.bus.errors import BusError, NoAnswerError
from fantwin.pipeline.bus.identity import Forgeries, new_session_id, sender_of
from fantwin.pipeline.bus.kept_messages import KeptQuery, answer_for_kept, ask_for_kept
from fantwin.pipeline.bus.meeting import Meeting
from fantwin.pipeline.bus.opening import (
    MEETING_LIMIT_S,
    ROUTER_RETRY_S,
    answers,
    credentials_of,
    open_session,
    zenoh_config,
)
from fantwin.pipeline.bus.publisher import KeptBytes, Publisher
from fantwin.pipeline.bus.recovery import ALL_PRODUCERS, LAST_SEQUENCE, Answer, OnAnswer, RecoveryRequest, recovery_key
from fantwin.pipeline.bus.rights import (
    SiteRoles,
    awaited_rights,
    claims_of,
    granted_rights,
    refused_by_router,
    refused_in_words,
)
from fantwin.pipeline.config.roles import READERS
from fantwin.pipeline.config.settings import BusConfig, Config
from fantwin.schemas.topics import Topic, key_in_words, largest_bytes

SAID_AFTER_S = 3.0
"""a client that waits so long for its router says so"""
_MEETING_POLL_S = 0.01
_ALIVE_TIMEOUTS = 2
"""`Bus.alive` asks again for so many times the longest wait for an answer"""


class Bus:
    """One session on the bus."""

    answer_timeout_s: ClassVar[float] = 5.0
    """longest wait for the answer to a question; a complete one usually comes much sooner"""

    def __init__(
        self,
        config: BusConfig,
        stop: threading.Event | None = None,
        *,
        listens: bool = True,
        roles: Sequence[str] = READERS,
        site: SiteRoles | None = None,
        session_id: str = "",
    ) -> None:
        """Open a session. Peers need no other process. A client needs its router; with `stop` it waits for the router
        until `stop` is set.

        listens: whether to listen on the endpoint if no process does; not for a command that connects only briefly.
        roles: with `bus.security`, the certificate of the first of these that has one here is shown.
        site: with `bus.security`, what peers accept of one another, and what this session may do; None: not known.
        session_id: its id, with which the names of its producers end; empty: a new one.

        Raises:
            BusError: the endpoint or a certificate cannot be used, or a client's router is not there.
        """
        self._config = config
        problem = endpoint_problem(config.endpoint) if config.mode == "peer" else ""
        if problem:
            raise BusError(problem)
        self.credentials = credentials_of(config, roles)
        """what this session shows; None: without `bus.security`"""
        self.came_second = somebody_listens(config.endpoint)
        """Whether another process listened before: discovering the others takes a moment."""
        self._has_answered = config.mode == "client" or (self.came_second and answers(config, self.credentials, stop))
        self.id = session_id or new_session_id()
        self._session = open_session(config, self.credentials, stop, listens, site, self.id)
        self._site = site
        self._claims: list[tuple[str, str]] = []
        """what has been declared: kinds of messages of Zenoh, each with its key or key expression"""
        self._meeting = Meeting()
        self._stop = stop or threading.Event()
        self.refused_too_large = 0
        self.forgeries = Forgeries()
        self._kept_bytes = KeptBytes()
        self._declared: list[zenoh.Subscriber[None] | zenoh.Queryable[None] | zenoh.LivelinessToken] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def publisher(self, key: str, topic: Topic, encoding: str, producer: str) -> Publisher:
        """Declare an output; `encoding` is the full protobuf name of its messages."""
        self._claims.append(("put", key))
        self._claims.append(("declare_queryable", recovery_key(key, producer)))
        return Publisher(self._session, key, topic, encoding, producer, self._kept_bytes)

    def subscribe(
        self,
        key_expression: str,
        on_message: Callable[[str, bytes], None],
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> Callable[[], None]:
        """Call `on_message(key, payload)` for what other sessions publish, from a thread of the bus. Returns what ends
        that. A message that comes while `is_wanted` says no is not read.

        While it blocks, publishers wait. Messages of one session arrive in the order of publishing, over all keys. A
        message that is larger than any of its topic is refused, and counted in `refused_too_large`; one in the name of
        another session in `forgeries`.
        """
        limit = largest_bytes(key_expression)

        def receive(sample: zenoh.Sample) -> None:
            if not is_wanted():
                return
            if len(sample.payload) > limit:
                self.refused_too_large += 1
                return
            key, payload = str(sample.key_expr), sample.payload.to_bytes()
            if not self.forgeries.is_one(key, payload, sender_of(sample)):
                on_message(key, payload)

        # not indirect: with a thread and a queue for each subscriber, keys lose their order and publishers never wait
        handler = zenoh.handlers.Callback(receive, indirect=False)
        subscriber = self._session.declare_subscriber(key_expression, handler, allowed_origin=zenoh.Locality.REMOTE)
        return self._ended_by_call(subscriber, ("declare_subscriber", key_expression))

    def declare_alive(self, key: str) -> None:
        """Show a liveliness token until this session ends, however it ends."""
        self._claims.append(("liveliness_token", key))
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> Callable[[], None]:
        """Call `on_change(key, alive)` for every token that exists, appears or disappears. Returns what ends that."""

        def receive(sample: zenoh.Sample) -> None:
            on_change(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        handler = zenoh.handlers.Callback(receive, indirect=False)
        subscriber = self._session.liveliness().declare_subscriber(key_expression, handler, history=True)
        return self._ended_by_call(subscriber)

    def _ended_by_call(self, subscriber: zenoh.Subscriber[None], *claims: tuple[str, str]) -> Callable[[], None]:
        self._declared.append(subscriber)
        self._claims += claims

        def unsubscribe() -> None:
            for claim in claims:
                self._claims.remove(claim)
            self._declared.remove(subscriber)
            subscriber.undeclare()

        return unsubscribe

    def wait_for_others(self, stop: threading.Event) -> None:
        """Wait until another process is connected, or `stop` is set; not at all where none listened before.

        Before that, no token and no message of another process can be seen.
        """
        until_s = time.monotonic() + MEETING_LIMIT_S
        while self._has_answered and not (self._session.info.peers_zid() or self._session.info.routers_zid()):
            if time.monotonic() > until_s or stop.wait(_MEETING_POLL_S):
                return

    def meet_again(self) -> None:
        """Let peers meet again that a cut link has left apart; to be called while they are. A router does so itself."""
        if self._config.mode == "peer" and not self._meeting.is_under_way:
            self._meeting.begin(zenoh_config(self._config, self.credentials, self._site, listens=False))

    def alive(self, key_expression: str) -> set[str]:
        """The keys of the tokens that exist now. Asks again if there is no complete answer. That there is none must be
        answered twice: a client that has just lost its router gets that answer, too, until it has noticed.

        Raises:
            NoAnswerError: no complete answer came, or `stop` was set before: which tokens exist is not known.
        """
        timeout_s = self.answer_timeout_s
        until_s = time.monotonic() + _ALIVE_TIMEOUTS * timeout_s
        was_empty = self._config.mode == "peer"
        while True:
            replies = list(self._session.liveliness().get(key_expression, timeout=timeout_s))
            found = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
            is_complete = all(reply.ok is not None for reply in replies) and self._has_its_router()
            if is_complete and (found or was_empty):
                return found
            was_empty = is_complete
            if self._stop.wait(ROUTER_RETRY_S):
                raise NoAnswerError(f"bus.endpoint = {self._config.endpoint!r}: stopped before an answer came")
            if time.monotonic() > until_s:
                raise NoAnswerError(
                    f"bus.endpoint = {self._config.endpoint!r}: no complete answer within "
                    f"{_ALIVE_TIMEOUTS * timeout_s:g} s to the question who is on the bus: check that the router runs "
                    "and is not overloaded"
                )

    def _has_its_router(self) -> bool:
        """Whether a client is connected; without its router it sees no token. Peers need no router."""
        return self._config.mode == "peer" or bool(self._session.info.routers_zid())

    def request_missed(
        self,
        key: str,
        producer: str,
        first: int,
        last: int,
        timeout_s: float,
        on_answer: OnAnswer,
    ) -> RecoveryRequest:
        """Request messages `first..last` on `key` from `producer` (`*`: all) without waiting for the answer.

        `on_answer` is called once, from a thread of the bus: it must not block.
        """
        return RecoveryRequest(self._session, self.forgeries, key, producer, first, last, timeout_s, on_answer)

    def recover(self, key: str, producer: str = ALL_PRODUCERS) -> list[tuple[str, bytes]]:
        """All messages on `key` that `producer` still keeps, as (key, payload). Waits for the answer: not for a stage,
        whose inbox would fill up meanwhile."""
        answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        request = self.request_missed(key, producer, 0, LAST_SEQUENCE, self.answer_timeout_s, answers.put)
        answer = answers.get()
        request.cancel()
        return answer.messages

    def answer_for_kept(self, key_expression: str, on_query: Callable[[KeptQuery], object]) -> None:
        """Call `on_query` when somebody asks for the last message on a key that is kept here."""
        self._claims.append(("declare_queryable", key_expression))
        self._declared.append(answer_for_kept(self._session, key_expression, on_query))

    def ask_for_kept(self, key: str, timeout_s: float) -> tuple[list[bytes], bool]:
        """What each session that keeps messages of a key has, empty if nothing, and whether all answered in time.

        Waits for the answers.
        """
        return ask_for_kept(self._session, key, timeout_s)

    def require_rights(self, stop: threading.Event | None = None, *, of_role: bool = False) -> None:
        """Raises BusError if something that this session has declared is refused; waits a moment for the answer.

        of_role: or anything else that its role may do, of what the router grants: it will be declared later.
        """
        if not (self.credentials and self._site):
            return
        role, claims = self.credentials.role, tuple(self._claims)
        problem = refused_in_words(claims, role, self._site)
        if not problem and self._config.mode == "client":
            granted = awaited_rights(self._session, self._site.site, role, stop)
            wanted = claims_of(self._site, role) if of_role else claims
            if granted or self._has_its_router():  # one that is gone refuses nothing
                problem = refused_by_router(wanted, role, self._site, granted)
        if problem and not (stop and stop.is_set()):
            raise BusError(problem)

    def has_all_rights_of_its_role(self, site: SiteRoles) -> bool:
        """Whether the router grants what the role of this session may do in a site. Waits for the answer."""
        assert self.credentials
        role = self.credentials.role
        return granted_rights(self._session, site.site, role) == site.rights(role)

    def why_not_published(self, site: str, key: str) -> str:
        """Why the router refuses what this session publishes on a key of a site; empty if it accepts it, or without
        `bus.security`. For a program that knows no roles. Waits for the answer of the router.

        Raises:
            NoAnswerError: there is no router.
        """
        if self.credentials is None:
            return ""
        role = self.credentials.role
        granted = awaited_rights(self._session, site, role)
        whose = f"{self.credentials.certificate} is a certificate of role {role!r}"
        if granted is None and not self._has_its_router():
            raise NoAnswerError(f"no router answers at {self._config.endpoint}")
        if granted is None:
            no_answer = f"the router at {self._config.endpoint} does not say what it may do"
            return f"{whose}: {no_answer}; it has no such role in site {site!r}, or is overloaded"
        return "" if granted.allow("put", key) else f"{whose}, which may not publish {key_in_words(key)}"

    def certificate_warning(self) -> str:
        """That the certificate of this session expires soon; empty if it does not, or without `bus.security`."""
        return self.credentials.warning() if self.credentials else ""

    def close(self) -> None:
        """Leave the bus. What was published before has left this process."""
        self._session.close()


def join_bus(
    config: Config,
    stop: threading.Event | None = None,
    *,
    listens: bool = True,
    roles: Sequence[str] = READERS,
    session_id: str = "",
    say: Callable[[str], None] = lambda _line: None,
) -> Bus:
    """A session on the bus of a site, with the roles of the site where its bus has any. say: is given a line if a
    client has to wait for its router. Raises BusError as Bus does."""
    site = SiteRoles.of(config) if config.bus.security else None
    line = f"waiting for a router at {config.bus.endpoint}: start `fantwin router`"
    waiting = threading.Timer(SAID_AFTER_S, say, [line])
    if config.bus.mode == "client":
        waiting.start()
    try:
        return Bus(config.bus, stop, listens=listens, roles=roles, site=site, session_id=session_id)
    finally:
        waiting.cancel()
