"""The bus: the only module that knows Zenoh.

Processes are peers that need no router. The first to start on a host listens on the configured endpoint, the
others connect there and learn of each other. When that process dies, the rest stay connected to one another, and
the next to start takes the endpoint over. (Trying again and again to listen would take it over at once, but a
session that still tries cannot be closed in less than ten seconds: measured with Zenoh 1.10.) A command that looks in
and goes again does not listen there: once it had gone, a newcomer would find nobody, and meet the others late.

Data is published with congestion control BLOCK, and each publisher keeps its last messages and answers
questions for them, so that a consumer that was not yet connected, or was restarted, asks for what it missed.
"""

from __future__ import annotations

import json
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self

import zenoh

from pipeline.config.models import BusConfig
from pipeline.errors import UserError
from schemas.topics import Topic

_RETRY = '{"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}'

KEPT_BYTES = 16 << 20
"""What a publisher keeps at most, whatever its history: large messages of a large fleet would fill the memory."""

_ROUTER_TIMEOUT_MS = "1000"
_ROUTER_RETRY_S = 0.2
_RECOVER = "/recover/"


class BusError(UserError):
    """The bus cannot be used: one line that says what, where and what to do."""


class Publisher:
    """One output of a stage: publishes bytes on a key and keeps the last ones for whoever missed them."""

    def __init__(self, session: zenoh.Session, key: str, topic: Topic, encoding: str, producer: str) -> None:
        self.key = key
        self.published = 0
        self._history = topic.history
        self._kept: deque[tuple[int, bytes]] = deque()
        self._kept_bytes = 0
        self._lock = threading.Lock()
        self._publisher = session.declare_publisher(
            key,
            encoding=f"application/protobuf;{encoding}",
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )
        self._recovery_key = recovery_key(key, producer)
        self._queryable = session.declare_queryable(self._recovery_key, self._answer, complete=True)

    def put(self, payload: bytes) -> None:
        """Publish the message whose sequence number is `published`."""
        with self._lock:
            self._kept.append((self.published, payload))
            self._kept_bytes += len(payload)
            while len(self._kept) > self._history or self._kept_bytes > KEPT_BYTES:
                _, forgotten = self._kept.popleft()
                self._kept_bytes -= len(forgotten)
        self.published += 1
        self._publisher.put(payload)

    def _answer(self, query: zenoh.Query) -> None:
        first = int(query.parameters.get("first") or 0)
        last = int(query.parameters.get("last") or 2**63)
        with self._lock:
            wanted = [(sequence, payload) for sequence, payload in self._kept if first <= sequence <= last]
        with query:
            for _, payload in wanted:
                query.reply(self._recovery_key, payload)


def recovery_key(key: str, producer: str) -> str:
    """Where a producer answers for what it published on `key`."""
    return f"{key}{_RECOVER}{producer}"


class Bus:
    """One session on the bus."""

    def __init__(self, config: BusConfig, stop: threading.Event | None = None, *, listens: bool = True) -> None:
        """Open a session. Peers need nobody; a client needs its router, and with `stop` waits for it until that is set.

        listens: where nobody is there yet, at the endpoint; not for one that only looks in.

        Raises:
            BusError: the endpoint cannot be used, or a client's router is not there.
        """
        self._config = config
        self.came_second = _somebody_listens(config.endpoint)
        """Whether others were there before: it takes a moment until they are met."""
        self._session = _open(config, stop, listens)
        self._declared: list[zenoh.Subscriber[None] | zenoh.LivelinessToken] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def publisher(self, key: str, topic: Topic, encoding: str, producer: str) -> Publisher:
        """Declare an output; `encoding` is the full protobuf name of its messages."""
        return Publisher(self._session, key, topic, encoding, producer)

    def subscribe(self, key_expression: str, on_message: Callable[[str, bytes], None]) -> None:
        """Call `on_message(key, payload)` for what other sessions publish, from the bus's own thread.

        While it blocks, publishers wait; and what one session has published arrives in that order, over all keys.
        """

        def receive(sample: zenoh.Sample) -> None:
            on_message(str(sample.key_expr), sample.payload.to_bytes())

        # not indirect: a thread and a queue for each subscriber would mix the order of keys, and never hold back
        handler = zenoh.handlers.Callback(receive, indirect=False)
        self._declared.append(
            self._session.declare_subscriber(key_expression, handler, allowed_origin=zenoh.Locality.REMOTE)
        )

    def declare_alive(self, key: str) -> None:
        """Show a liveliness token until this session ends, however it ends."""
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """Call `on_change(key, alive)` for every token there is, comes or goes."""

        def receive(sample: zenoh.Sample) -> None:
            on_change(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        handler = zenoh.handlers.Callback(receive, indirect=False)
        self._declared.append(self._session.liveliness().declare_subscriber(key_expression, handler, history=True))

    def alive(self, key_expression: str) -> set[str]:
        """The keys of the tokens that are there now."""
        replies = self._session.liveliness().get(key_expression, timeout=self._config.recovery_timeout_s)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def recover(
        self, key: str, producer: str, first: int, last: int, while_waiting: Callable[[], None]
    ) -> Iterator[tuple[str, bytes]]:
        """Ask `producer` (or all, `*`) for its messages `first..last` on `key`; yields what it still has, with the key.

        `while_waiting` is called again and again so that the caller can keep its inbox from filling: replies come
        through the same threads that fill it.
        """
        replies = self._session.get(
            f"{recovery_key(key, producer)}?first={first};last={last}",
            target=zenoh.QueryTarget.ALL,
            timeout=self._config.recovery_timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        while True:
            try:
                reply = replies.try_recv()
            except zenoh.ZError:  # the last reply has come
                return
            if reply is None:
                while_waiting()
            elif reply.ok is not None:
                yield str(reply.ok.key_expr).partition(_RECOVER)[0], reply.ok.payload.to_bytes()

    def close(self) -> None:
        """Leave the bus; what was published before has left this process."""
        self._session.close()


@contextmanager
def open_router(endpoint: str) -> Iterator[None]:
    """A router that listens on `endpoint` until the block ends.

    Raises:
        BusError: it cannot listen there.
    """
    conf = zenoh.Config()
    try:
        conf.insert_json5("mode", '"router"')
        conf.insert_json5("listen/endpoints", json.dumps([endpoint]))
        conf.insert_json5("scouting/multicast/enabled", "false")
        session = zenoh.open(conf)
    except zenoh.ZError as error:
        reason = _reason(error)
        raise BusError(f"the router cannot listen on {endpoint!r}: {reason}; is one running already?") from error
    try:
        yield
    finally:
        session.close()


def _reason(error: zenoh.ZError) -> str:
    """What Zenoh says, without where in its sources it says so."""
    said = str(error)
    return (said.partition('msg: "')[2] or said).split(" at /")[0].strip()


def _somebody_listens(endpoint: str) -> bool:
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol != "tcp" or not port.isdecimal():
        return False
    with socket.socket() as probe:  # bound and not connected: the other end would take it for a peer
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, int(port)))
        except OSError:
            return True
    return False


def _open(config: BusConfig, stop: threading.Event | None, listens: bool) -> zenoh.Session:
    try:
        conf = _zenoh_config(config, listens)
        if config.mode == "peer":
            return zenoh.open(conf)
    except zenoh.ZError as error:
        raise BusError(f"bus.endpoint = {config.endpoint!r} cannot be used: {_reason(error)}") from error
    while True:  # Zenoh would wait for the router by itself, but deaf to Ctrl-C
        try:
            return zenoh.open(conf)
        except zenoh.ZError as error:
            if stop is None or stop.wait(_ROUTER_RETRY_S):
                raise BusError(
                    f"bus.endpoint = {config.endpoint!r}: no router answers: {_reason(error)}; start `fantwin router`"
                ) from error


def _zenoh_config(config: BusConfig, listens: bool) -> zenoh.Config:
    conf = zenoh.Config()
    conf.insert_json5("mode", json.dumps(config.mode))
    conf.insert_json5("connect/endpoints", json.dumps([config.endpoint]))
    conf.insert_json5("connect/timeout_ms", "-1" if config.mode == "peer" else _ROUTER_TIMEOUT_MS)
    conf.insert_json5("connect/exit_on_failure", "false")
    conf.insert_json5("connect/retry", _RETRY)
    conf.insert_json5("scouting/multicast/enabled", "false")
    if config.mode == "peer":
        host = config.endpoint.rsplit(":", 1)[0]
        endpoints = [*([config.endpoint] if listens else []), f"{host}:0"]
        conf.insert_json5("listen/endpoints", json.dumps(endpoints))
        conf.insert_json5("listen/timeout_ms", "0")
        conf.insert_json5("listen/exit_on_failure", "false")
        conf.insert_json5("scouting/gossip/enabled", "true")
    return conf
