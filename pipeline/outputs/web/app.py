"""The web application: which path answers what, and the headers of every answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fantwin.pipeline.outputs.web.api import Api, broken, failed
from fantwin.pipeline.outputs.web.config import GatewayConfig
from fantwin.pipeline.outputs.web.openapi import description
from fantwin.pipeline.outputs.web.shared_answer import COMPRESSION

PAGE = Path(__file__).parent / "page"
PREFIX = "/api/v1"
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_BY_HTTPS_ONLY = {"Strict-Transport-Security": "max-age=31536000"}

PATHS: Mapping[str, tuple[str, Callable[..., object]]] = {
    "/site": ("GET", Api.site),
    "/fans": ("GET", Api.fans),
    "/fans/{tray}/{fan}": ("GET", Api.fan),
    "/fans/{tray}/{fan}/curves": ("GET", Api.curves),
    "/fans/{tray}/{fan}/requests": ("POST", Api.act),
    "/alarms": ("GET", Api.alarms),
    "/alarms/history": ("GET", Api.alarm_history),
    "/alarm-rate": ("GET", Api.alarm_rate),
    "/clips": ("GET", Api.clips),
    "/clips/{name}": ("GET", Api.clip),
    "/stages": ("GET", Api.stages),
    "/events": ("GET", Api.events),
    "/me": ("GET", Api.me),
    "/login": ("POST", Api.log_in),
    "/logout": ("POST", Api.log_out),
}
"""of the API: method and handler"""


def application(api: Api, config: GatewayConfig) -> ASGIApp:
    """What answers all requests."""
    routes = [
        Route(f"{PREFIX}{path}", partial(handler, api), methods=[method]) for path, (method, handler) in PATHS.items()
    ]
    openapi = description(PREFIX, PATHS)

    async def describe(_request: Request) -> Response:
        return JSONResponse(openapi)

    async def page(_request: Request) -> Response:
        return FileResponse(PAGE / "index.html")

    async def health(_request: Request) -> Response:
        return JSONResponse({})

    routes += [
        Route(f"{PREFIX}/openapi.json", describe),
        Route("/metrics", partial(Api.metrics, api)),
        Route("/healthz", health),
        Route("/", page),
    ]
    app = Starlette(
        routes=[*routes, Mount("/page", StaticFiles(directory=PAGE))],
        middleware=[
            Middleware(TrustedHostMiddleware, allowed_hosts=sorted(config.known_hosts), www_redirect=False),
            Middleware(GZipMiddleware, minimum_size=1000, compresslevel=COMPRESSION),
        ],
        exception_handlers={HTTPException: failed, Exception: partial(broken, api)},
    )
    return _WithHeaders(app, _HEADERS | (_BY_HTTPS_ONLY if config.certificate else {}))


class _WithHeaders:
    """Adds headers to every answer, that to a failure too."""

    def __init__(self, app: ASGIApp, headers: Mapping[str, str]) -> None:
        self._app = app
        self._headers = [(name.lower().encode(), value.encode()) for name, value in headers.items()]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *self._headers]
            await send(message)

        await self._app(scope, receive, send_with_headers if scope["type"] == "http" else send)
