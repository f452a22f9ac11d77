"""Requests to one baseboard controller: one connection that is kept, and one session where it has users."""

from __future__ import annotations

import json
import ssl
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from fantwin.pipeline.sources.polling import DeviceError

if TYPE_CHECKING:
    from urllib3 import HTTPConnectionPool

Json = Mapping[str, Any]
ROOT = "/redfish/v1/"
TIMEOUT_S = 5.0
"""longest wait for a connection, and for each part of an answer"""
LARGEST_BYTES = 4 << 20
"""of an answer"""
MOST_REDIRECTS = 3


class RedfishClient:
    """Asks one controller, one request at a time. Errors are `DeviceError`, whose text names the path and no secret."""

    def __init__(self, address: str, verify: bool | str, user: str, password: str | None) -> None:
        """address: scheme, host and port. verify: whether the certificate is, or the file of its authority."""
        import urllib3  # noqa: PLC0415  of an extra

        if user and urlsplit(address).scheme == "http":
            raise DeviceError(f"{address} would send the password in the clear: use https")
        options: dict[str, Any] = {}
        if address.startswith("https:"):
            try:
                options["ssl_context"] = _tls(verify)
            except OSError as error:
                raise DeviceError(f"source.verify = {verify}: {error.strerror or error}") from error
            if verify is False:
                options["assert_hostname"] = False
                urllib3.disable_warnings(urllib3.exceptions.InsecureRequestWarning)
        self._pool: HTTPConnectionPool = urllib3.connection_from_url(
            address,
            maxsize=1,
            timeout=urllib3.Timeout(connect=TIMEOUT_S, read=TIMEOUT_S),
            retries=urllib3.Retry(MOST_REDIRECTS, connect=0, read=0, redirect=MOST_REDIRECTS, status=0, other=0),
            headers={"Accept": "application/json", "OData-Version": "4.0", "User-Agent": "fantwin"},
            **options,
        )
        self._login: dict[str, str] = {}
        """headers that say who asks"""
        self._session = ""
        self._user, self._password = user, password or ""

    def log_in(self) -> None:
        """Begin a session; a controller without sessions is sent user and password with each request."""
        import urllib3  # noqa: PLC0415

        if not self._user:
            return
        said = json.dumps({"UserName": self._user, "Password": self._password})
        status, headers, _ = self._send("POST", f"{ROOT}SessionService/Sessions", said)
        if token := headers.get("X-Auth-Token", ""):
            self._login = {"X-Auth-Token": token}
            self._session = urlsplit(headers.get("Location", "")).path
        elif status == 401:
            raise _refused_login()
        else:
            self._login = urllib3.make_headers(basic_auth=f"{self._user}:{self._password}")

    def get(self, path: str) -> Json:
        """The object at a path."""
        status, _, body = self._send("GET", path)
        if status in (401, 403):
            raise _refused_login()
        if status >= 300:
            raise DeviceError(f"{path}: refused with HTTP status {status}")
        try:
            found = json.loads(body)
        except ValueError as error:
            raise DeviceError(f"{path}: no JSON, so no Redfish service") from error
        if not isinstance(found, Mapping):
            raise DeviceError(f"{path}: no object")
        return found

    def close(self) -> None:
        """End the session and the connection."""
        if self._session:
            with suppress(DeviceError):
                self._send("DELETE", self._session)
        self._session, self._login = "", {}
        self._pool.close()

    def _send(self, method: str, path: str, body: str | None = None) -> tuple[int, Mapping[str, str], bytes]:
        from urllib3 import exceptions  # noqa: PLC0415

        headers = {**self._pool.headers, **self._login}
        if body is not None:
            headers["Content-Type"] = "application/json"
        try:
            answer = self._pool.urlopen(method, path, body, headers, preload_content=False)
            content = answer.read(LARGEST_BYTES + 1, decode_content=True)
        except exceptions.HTTPError as error:
            cause = error.reason if isinstance(error, exceptions.MaxRetryError) else error
            if isinstance(cause, exceptions.SSLError) and "certificate" in str(cause).lower():
                why = "its certificate cannot be verified: name the authority by source.verify"
            elif isinstance(cause, exceptions.SSLError):
                why = f"no TLS connection: {cause}"
            elif isinstance(cause, exceptions.ResponseError | exceptions.HostChangedError):
                raise DeviceError(f"{path}: sent elsewhere, so no Redfish service") from error
            else:
                why = f"does not answer within {TIMEOUT_S:g} s, or cannot be reached"
            raise DeviceError(f"{why}; waiting for it", is_lost=True) from error
        if len(content) > LARGEST_BYTES:
            answer.close()
            raise DeviceError(f"{path}: an answer of more than {LARGEST_BYTES:,} bytes")
        answer.release_conn()
        return answer.status, answer.headers, content


@lru_cache(maxsize=8)
def _tls(verify: bool | str) -> ssl.SSLContext:
    """One for all controllers: it holds every authority of this computer."""
    context = ssl.create_default_context(cafile=verify if isinstance(verify, str) else None)
    if verify is False:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    return context


def _refused_login() -> DeviceError:
    return DeviceError("user or password is refused, or lacks rights", is_lost=True)
