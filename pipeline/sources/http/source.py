"""Samples that come by HTTP: a server in a thread of acquisition, for one tray.

A request is answered when its samples wait for acquisition. If it is behind, so that they have no room, none of them is
taken and the answer is 429 with the time to wait: so a caller knows of each sample what became of it.
"""

from __future__ import annotations

import hmac
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fantwin.pipeline.errors import UserError, refusals
from fantwin.pipeline.http_server import HttpServer, listen
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

MOST_WAITING = 2 * MOST_SAMPLES
"""samples that wait for acquisition"""
RETRY_AFTER_S = 1
RETRY_S = 2.0
"""time between attempts to listen"""
MOST_CONNECTIONS = 100
STOP_LIMIT_S = 3.0
MOST_REASONS = 20
"""refused samples that an answer names"""


class HttpSource:
    """A `SampleSource`."""

    def __init__(self, config: HttpConfig, context: SourceContext) -> None:
        """Prepare the server; it does not listen yet.

        Raises:
            UserError: the token cannot be read, or a pointer is not of each fan.
        """
        config.require_each_fan(context.fans)
        self._config = config
        self._context = context
        self._token = read_secret(context.folder / config.token_file) if config.token_file else ""
        self._receipts = ReceiptTimes()
        self._changed = threading.Condition()
        self._waiting: deque[ReadingBatch] = deque()
        """samples for acquisition, one in each"""
        self._accepted = self._refused = self._turned_away = 0
        self._stopping = False
        self._thread: threading.Thread | None = None

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
        """Listen, and deliver what comes, in a thread of its own."""
        self._thread = threading.Thread(target=self._run, args=(deliver,), name="http samples", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Answer what is being asked, deliver what was accepted, then end."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._thread:
            self._thread.join(STOP_LIMIT_S)

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        """Send nothing."""
        return self._config.why_no_commands

    def check(self) -> list[str]:
        """Problems before the start: the port is not free, or the certificate cannot be used."""
        from fantwin.pipeline.certificates import check_pair, require_valid  # noqa: PLC0415  slow to import

        attempts: list[Callable[[], object]] = [lambda: listen(self._config.host, self._config.port, "source").close()]
        if files := self._files_of_tls():
            attempts.append(lambda: require_valid(check_pair(*files)))
        return refusals(*attempts)

    def app(self) -> Starlette:
        """Application that answers the requests."""
        from starlette.applications import Starlette  # noqa: PLC0415  slow to import
        from starlette.middleware import Middleware  # noqa: PLC0415
        from starlette.middleware.body_limit import RequestBodyLimitMiddleware  # noqa: PLC0415
        from starlette.routing import Route  # noqa: PLC0415

        path = f"/v1/trays/{self._context.tray}"
        return Starlette(
            routes=[
                Route(path, self._get, methods=["GET"]),
                Route(f"{path}/samples", self._post, methods=["POST"]),
            ],
            middleware=[Middleware(RequestBodyLimitMiddleware, max_body_size=LARGEST_BYTES)],
        )

    async def _get(self, request: Request) -> Response:
        limits = self._context.limits
        about = {**asdict(limits), "speed_unit": self._context.speed_unit} if limits else {}
        with self._changed:
            about |= {"accepted": self._accepted, "refused": self._refused}
            about |= {"turned_away": self._turned_away, "waiting": len(self._waiting)}
        return self._unauthorized(request) or _answer(200, {"tray": self._context.tray, **about})

    async def _post(self, request: Request) -> Response:
        refusal = self._unauthorized(request)
        if refusal is not None:
            return refusal
        body = await request.body()
        config, context = self._config, self._context
        try:
            found = parse_samples(body, config, context.fans, context.speed_unit)
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
            if self._stopping or len(self._waiting) + len(found) > MOST_WAITING:
                self._turned_away += len(found)
                error = "acquisition stops" if self._stopping else "acquisition is behind"
                status = 503 if self._stopping else 429
                return _answer(status, {"error": error, "accepted": 0}, {"Retry-After": str(RETRY_AFTER_S)})
            batches = batches_of(found, HOST_CLOCK.now_ns(), self._receipts, byte_count)
            self._waiting += batches  # refused ones, too: acquisition counts them
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

    def _unauthorized(self, request: Request) -> Response | None:
        given = request.headers.get("authorization", "").encode()
        if not self._token or hmac.compare_digest(given, f"Bearer {self._token}".encode()):
            return None
        return _answer(401, {"error": "send the header Authorization: Bearer TOKEN"}, {"WWW-Authenticate": "Bearer"})

    def _run(self, deliver: Callable[[SourceEvent], None]) -> None:
        """Deliver samples until it is stopped and none waits; try again while it cannot listen."""
        server: HttpServer | None = None
        while True:
            if server is None and not self._stopping:
                server = self._listening(deliver)
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping, None if server else RETRY_S)
                batch = self._waiting[0] if self._waiting else None
            if batch is None and self._stopping:
                break
            if batch is not None:
                deliver(batch)  # waits while acquisition is behind
                with self._changed:
                    self._waiting.popleft()
        if server is not None:
            server.stop()

    def _listening(self, deliver: Callable[[SourceEvent], None]) -> HttpServer | None:
        from fantwin.pipeline.certificates import server_context  # noqa: PLC0415  slow to import

        files = self._files_of_tls()
        try:
            tls = server_context(*files) if files else None
            listening = listen(self._config.host, self._config.port, "source")
        except UserError as error:
            deliver(LinkDown(str(error)))
            return None
        server = HttpServer(self.app(), listening, tls, MOST_CONNECTIONS)
        deliver(LinkUp())
        return server

    def _files_of_tls(self) -> tuple[Path, Path] | None:
        """Certificate and key; None: without TLS."""
        certificate, key, folder = self._config.certificate, self._config.key, self._context.folder
        return (folder / certificate, folder / key) if certificate and key else None


def _answer(status: int, values: dict[str, Any], headers: dict[str, str] | None = None) -> Response:
    from starlette.responses import JSONResponse  # noqa: PLC0415  slow to import

    return JSONResponse(values, status, headers)
