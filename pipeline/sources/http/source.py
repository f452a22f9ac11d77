"""Samples that come by HTTP: a server in a thread of acquisition, for one tray.

A request is answered when its samples wait for acquisition. If it is behind, so that they have no room, none of them is
taken and the answer is 429 with the time to wait: so a caller knows of each sample what became of it.
"""

from __future__ import annotations

import hmac
import logging
import socket
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from fantwin.pipeline.sources.http.config import HttpConfig
from fantwin.pipeline.sources.json_samples import (
    LARGEST_BYTES,
    MOST_SAMPLES,
    JsonSamplesError,
    TimedReading,
    batches_of,
    parse_samples,
)
from fantwin.pipeline.sources.secret_file import read_secret
from fantwin.pipeline.sources.source import LinkDown, LinkUp, ReadingBatch, Rejected, SourceContext, SourceEvent
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.pipeline.timebase.receipt_times import ReceiptTimes

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response
    from uvicorn import Server

MOST_WAITING = 2 * MOST_SAMPLES
"""samples that wait for acquisition"""
RETRY_AFTER_S = 1
RETRY_S = 2.0
"""time between attempts to listen"""
MOST_CONNECTIONS = 32
STOP_LIMIT_S = 3.0
MOST_REASONS = 20
"""refused samples that an answer names"""


class HttpSource:
    """A `SampleSource`."""

    def __init__(self, config: HttpConfig, context: SourceContext) -> None:
        """Prepare the server; it does not listen yet.

        Raises:
            UserError: the token cannot be read.
        """
        self._config = config
        self._context = context
        self._token = read_secret(context.folder / config.token_file) if config.token_file else ""
        self._receipts = ReceiptTimes()
        self._changed = threading.Condition()
        self._waiting: deque[SourceEvent] = deque()
        """events for acquisition"""
        self._waiting_samples = 0
        self._accepted = self._refused = self._turned_away = self._over_limit = 0
        self._stopping = False
        self._server: Server | None = None
        self._threads: list[threading.Thread] = []

    @property
    def name(self) -> str:
        """Address at which it listens."""
        scheme = "https" if self._config.certificate else "http"
        return f"{scheme}://{self._config.host}:{self._config.port}"

    @property
    def settings_to_check(self) -> str:
        """None: what is sent wrongly is refused with the reason."""
        return ""

    def start(self, deliver: Callable[[SourceEvent], None]) -> None:
        """Listen, and deliver what comes, in threads of their own."""
        self._threads = [
            threading.Thread(target=self._serve, name="http server", daemon=True),
            threading.Thread(target=self._deliver_all, args=(deliver,), name="http samples", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Answer what is being asked, deliver what was accepted, then end."""
        with self._changed:
            self._stopping = True
            if self._server is not None:
                self._server.should_exit = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(STOP_LIMIT_S)

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        """Send nothing."""
        return self._config.why_no_commands

    def check(self) -> list[str]:
        """Problems before the start: the port is not free."""
        try:
            self._listen().close()
        except OSError as error:
            return [self._cannot_listen(error)]
        return []

    def app(self) -> Starlette:
        """Application that answers the requests."""
        from starlette.applications import Starlette  # noqa: PLC0415  slow to import
        from starlette.routing import Route  # noqa: PLC0415

        path = f"/v1/trays/{self._context.tray}"
        return Starlette(
            routes=[
                Route(path, self._get, methods=["GET"]),
                Route(f"{path}/samples", self._post, methods=["POST"]),
            ]
        )

    async def _get(self, request: Request) -> Response:
        return self._refusal(request) or _answer(200, {"tray": self._context.tray, **self._limits(), **self._counts()})

    async def _post(self, request: Request) -> Response:
        refusal = self._refusal(request)
        if refusal is not None:
            return refusal
        body = bytearray()
        async for part in request.stream():
            body += part
            if len(body) > LARGEST_BYTES:
                return _answer(413, {"error": f"at most {LARGEST_BYTES} bytes are accepted at once"})
        try:
            found = parse_samples(bytes(body))
        except JsonSamplesError as error:
            return _answer(400, {"error": str(error)})
        return self._take(found, len(body))

    def _take(self, found: Sequence[TimedReading | Rejected], byte_count: int) -> Response:
        limits = self._context.limits
        reasons: list[tuple[int, Rejected]] = []
        for number, each in enumerate(found):
            why = each if isinstance(each, Rejected) else limits.why_refused(each.reading) if limits else None
            if why is not None:
                reasons.append((number, why))
        with self._changed:
            if self._stopping or self._waiting_samples + len(found) > MOST_WAITING:
                self._turned_away += len(found)
                error = "acquisition stops" if self._stopping else "acquisition is behind"
                status = 503 if self._stopping else 429
                return _answer(status, {"error": error, "accepted": 0}, {"Retry-After": str(RETRY_AFTER_S)})
            batches = batches_of(found, HOST_CLOCK.now_ns(), self._receipts, byte_count)
            self._waiting += batches  # refused ones, too: acquisition counts them
            self._waiting_samples += len(batches)
            self._accepted += len(found) - len(reasons)
            self._refused += len(reasons)
            self._changed.notify_all()
        refused = [{"sample": n, "kind": why.kind, "reason": why.detail} for n, why in reasons[:MOST_REASONS]]
        accepted = len(found) - len(reasons)
        answer: dict[str, Any] = {"accepted": accepted, "refused": len(reasons)}
        if refused:
            answer["reasons"] = refused
        absurd = (
            sum(limits.absurd_speeds(each.reading) for each in found if isinstance(each, TimedReading)) if limits else 0
        )
        if absurd:
            answer["speeds_beyond_speed_max"] = absurd
        return _answer(200 if accepted or not reasons else 422, answer)

    def _refusal(self, request: Request) -> Response | None:
        return self._too_many_connections() or self._unauthorized(request)

    def _too_many_connections(self) -> Response | None:
        if self._server is None or len(self._server.server_state.connections) < MOST_CONNECTIONS:
            return None
        error = f"{MOST_CONNECTIONS} connections are open"
        with self._changed:
            self._over_limit += 1
            if self._waiting_samples < MOST_WAITING:  # acquisition counts it, too
                rejected = Rejected("too_many_connections", error, harmless=True)
                self._waiting.append(ReadingBatch(HOST_CLOCK.now_ns(), (rejected,)))
                self._waiting_samples += 1
                self._changed.notify_all()
        return _answer(503, {"error": error, "accepted": 0}, {"Retry-After": str(RETRY_AFTER_S), "Connection": "close"})

    def _unauthorized(self, request: Request) -> Response | None:
        given = request.headers.get("authorization", "").encode()
        if not self._token or hmac.compare_digest(given, f"Bearer {self._token}".encode()):
            return None
        return _answer(401, {"error": "send the header Authorization: Bearer TOKEN"}, {"WWW-Authenticate": "Bearer"})

    def _limits(self) -> dict[str, Any]:
        limits = self._context.limits
        if limits is None:
            return {}
        return {
            "fans": limits.fans,
            "command_min": limits.command_min,
            "command_max": limits.command_max,
            "speed_max": limits.speed_max,
            "speed_unit": self._context.speed_unit,
        }

    def _counts(self) -> dict[str, int]:
        with self._changed:
            return {
                "accepted": self._accepted,
                "refused": self._refused,
                "turned_away": self._turned_away,
                "too_many_connections": self._over_limit,
                "waiting": self._waiting_samples,
            }

    def _deliver_all(self, deliver: Callable[[SourceEvent], None]) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping)
                if not self._waiting:
                    return
                event = self._waiting.popleft()
            deliver(event)  # waits while acquisition is behind
            with self._changed:
                self._waiting_samples -= not isinstance(event, LinkUp | LinkDown)

    def _serve(self) -> None:
        """Listen until it is stopped; try again while the port is taken."""
        while True:
            try:
                listening = self._listen()
            except OSError as error:
                self._add(LinkDown(self._cannot_listen(error)))
            else:
                with listening:
                    self._serve_on(listening)
            with self._changed:
                if self._changed.wait_for(lambda: self._stopping, RETRY_S):
                    return

    def _serve_on(self, listening: socket.socket) -> None:
        import uvicorn  # noqa: PLC0415  slow to import

        from fantwin.pipeline.sources.http.protocol import LimitedProtocol  # noqa: PLC0415

        logging.getLogger("uvicorn.error").setLevel(logging.ERROR)
        folder, certificate, key = self._context.folder, self._config.certificate, self._config.key
        config = uvicorn.Config(
            self.app(),
            http=LimitedProtocol,
            lifespan="off",
            access_log=False,
            log_config=None,
            timeout_graceful_shutdown=1,
            ssl_certfile=str(folder / certificate) if certificate else None,
            ssl_keyfile=str(folder / key) if key else None,
        )
        try:
            config.load()
        except (OSError, ValueError) as error:  # a certificate that cannot be read
            self._add(LinkDown(f"certificate and key cannot be used: {error}"))
            return
        server = uvicorn.Server(config)
        with self._changed:
            if self._stopping:
                return
            self._server = server
        self._add(LinkUp())
        server.run(sockets=[listening])

    def _add(self, event: SourceEvent) -> None:
        with self._changed:
            self._waiting.append(event)
            self._changed.notify_all()

    def _listen(self) -> socket.socket:
        """A socket that accepts connections. Raises OSError."""
        family = socket.AF_INET6 if ":" in self._config.host else socket.AF_INET
        return socket.create_server((self._config.host, self._config.port), family=family)

    def _cannot_listen(self, error: OSError) -> str:
        return (
            f"cannot listen on {self._config.host}:{self._config.port}: {error.strerror}; choose another host or port"
        )


def _answer(status: int, values: dict[str, Any], headers: dict[str, str] | None = None) -> Response:
    from starlette.responses import JSONResponse  # noqa: PLC0415  slow to import

    return JSONResponse(values, status, headers)
