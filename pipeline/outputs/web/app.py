"""The web application: which path answers what, and the headers of every answer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.middleware.gzip import GZipMiddleware
from fastapi.middleware.trustedhost import TrustedHostMiddleware
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.middleware import Middleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fantwin.pipeline.outputs.web.access import address_of
from fantwin.pipeline.outputs.web.api import Api
from fantwin.pipeline.outputs.web.config import GatewayConfig
from fantwin.pipeline.outputs.web.live_feed import COMPRESSION

PAGE = Path(__file__).parent / "page"
PREFIX = "/api/v1"
MOST_CONNECTIONS = 2000
LARGEST_BODY_BYTES = 16_384
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


def application(api: Api, config: GatewayConfig) -> ASGIApp:
    """What answers all requests."""

    async def broken(request: Request, error: Exception) -> Response:
        """The gateway itself has failed; why, only its log says."""
        why = f"{type(error).__name__}: {error}"
        api.access.log.add("gateway failed", path=request.url.path, why=why, **address_of(request))
        return JSONResponse({"error": "the gateway has failed; its log says why"}, 500)

    app = FastAPI(
        title="fantwin gateway",
        version="1",
        openapi_url=f"{PREFIX}/openapi.json",
        docs_url=None,  # its scripts come from other servers
        redoc_url=None,
        servers=[{"url": "/"}],
        generate_unique_id_function=lambda route: route.name,
        max_body_size=LARGEST_BODY_BYTES,
        telemetry={"tracing": False, "metrics": False, "logs": False, "auto_configure": False},
        middleware=[
            Middleware(TrustedHostMiddleware, allowed_hosts=sorted(config.known_hosts), www_redirect=False),
            Middleware(GZipMiddleware, minimum_size=1000, compresslevel=COMPRESSION),
        ],
        exception_handlers={StarletteHTTPException: _failed, RequestValidationError: _unfit, Exception: broken},
    )
    app.include_router(api.routes(), prefix=PREFIX)
    app.add_api_route("/metrics", api.metrics, include_in_schema=False)
    for path, answer in (("/healthz", _health), ("/", _page)):
        app.add_api_route(path, answer, methods=["GET", "HEAD"], include_in_schema=False)
    app.mount("/page", StaticFiles(directory=PAGE))
    return _WithHeaders(app, _HEADERS | (_BY_HTTPS_ONLY if config.is_https else {}))


async def _page() -> FileResponse:
    return FileResponse(PAGE / "index.html")


async def _health() -> dict[str, str]:
    return {}


async def _failed(_request: Request, error: Exception) -> Response:
    """What cannot be done: {"error": why}."""
    assert isinstance(error, StarletteHTTPException)
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)


async def _unfit(_request: Request, error: Exception) -> Response:
    """A parameter or a field that is wrong; what was sent is not repeated."""
    assert isinstance(error, RequestValidationError)
    found = error.errors()[0]
    where = ".".join(str(part) for part in found["loc"][1:])
    return JSONResponse({"error": f"{where}: {found['msg']}" if where else found["msg"]}, 422)


class _WithHeaders:
    """Adds headers to every answer, that to a failure too."""

    def __init__(self, app: ASGIApp, headers: Mapping[str, str]) -> None:
        self._app = app
        self._headers = [(name.lower().encode(), value.encode()) for name, value in headers.items()]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                before = [each for each in message.get("headers", ()) if each[0] != b"cache-control"]
                message["headers"] = [*before, *self._headers]
            await send(message)

        await self._app(scope, receive, send_with_headers if scope["type"] == "http" else send)
