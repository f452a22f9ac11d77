"""Requests to one baseboard controller: one connection that is kept, and one session where it has users."""

from __future__ import annotations

import base64
import http.client
import json
import ssl
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any
from urllib.parse import urljoin, urlsplit

from fantwin.pipeline.sources.polling import DeviceError

Json = Mapping[str, Any]
ROOT = "/redfish/v1/"
TIMEOUT_S = 5.0
"""longest wait for a connection, and for each part of an answer"""
LARGEST_BYTES = 4 << 20
"""size of an answer"""
MOST_REDIRECTS = 3
LOGIN_RETRY_S = 300.0


class RedfishClient:
    """Asks one controller, one request at a time. Errors are `DeviceError`, whose text names the path and no secret."""

    def __init__(self, address: str, verify: bool | str, user: str, password: str | None) -> None:
        """address: scheme, host and port. verify: whether the certificate is, or the file of its authority."""
        parts = urlsplit(address)
        if user and parts.scheme == "http":
            raise DeviceError(f"{address} would send the password in the clear: use https")
        self._address = address
        host = parts.hostname or ""
        if parts.scheme == "http":
            self._line = http.client.HTTPConnection(host, parts.port, timeout=TIMEOUT_S)
        else:
            try:
                tls = _tls(verify)
            except OSError as error:
                raise DeviceError(f"source.verify = {verify}: {error.strerror or error}") from error
            self._line = http.client.HTTPSConnection(host, parts.port, timeout=TIMEOUT_S, context=tls)
        self._user, self._password = user, password or ""
        self._headers = {"Accept": "application/json", "OData-Version": "4.0", "User-Agent": "fantwin"}
        self._session = ""
        """path of the session that has begun"""

    def log_in(self) -> None:
        """Begin a session; a controller without sessions is sent user and password with each request."""
        if not self._user:
            return
        said = json.dumps({"UserName": self._user, "Password": self._password})
        status, headers, _ = self._send("POST", f"{ROOT}SessionService/Sessions", said)
        if token := headers.get("X-Auth-Token"):
            self._headers["X-Auth-Token"] = token
            self._session = urlsplit(headers.get("Location", "")).path
        elif status == http.client.UNAUTHORIZED:
            raise _refused_login()
        else:
            basic = base64.b64encode(f"{self._user}:{self._password}".encode()).decode()
            self._headers["Authorization"] = f"Basic {basic}"

    def get(self, path: str) -> Json:
        """The object at a path."""
        status, headers, body = self._send("GET", path)
        for _ in range(MOST_REDIRECTS):
            if status not in (301, 302, 303, 307, 308):
                break
            there = urlsplit(urljoin(f"{self._address}{path}", headers.get("Location", "")))
            if f"{there.scheme}://{there.netloc}" != self._address:
                raise DeviceError(f"{path}: sent to another host, so no Redfish service")
            status, headers, body = self._send("GET", there._replace(scheme="", netloc="").geturl())
        if status == http.client.UNAUTHORIZED:
            raise _refused_login()
        if status == http.client.FORBIDDEN:  # of this object: others may be read
            raise DeviceError(f"{path}: the user lacks rights (HTTP status 403)")
        if status >= http.client.MULTIPLE_CHOICES:
            raise DeviceError(f"{path}: refused with HTTP status {status}")
        try:
            found = json.loads(body)
        except (ValueError, RecursionError) as error:
            raise DeviceError(f"{path}: no JSON, so no Redfish service") from error
        if not isinstance(found, Mapping):
            raise DeviceError(f"{path}: no object")
        return found

    def close(self) -> None:
        """End the session and the connection."""
        if self._session:
            with suppress(DeviceError):
                self._send("DELETE", self._session)
        self._session = ""
        self._line.close()

    def _send(self, method: str, path: str, body: str | None = None) -> tuple[int, http.client.HTTPMessage, bytes]:
        headers = self._headers if body is None else {**self._headers, "Content-Type": "application/json"}
        is_kept = self._line.sock is not None
        try:
            self._line.request(method, path, body, headers)
            answer = self._line.getresponse()
            content = answer.read(LARGEST_BYTES + 1)
        except ConnectionError as error:
            self._line.close()
            if is_kept:  # the controller has ended it meanwhile
                return self._send(method, path, body)
            raise _lost() from error
        except ssl.SSLCertVerificationError as error:
            self._line.close()
            raise _lost("its certificate cannot be verified: name the authority by source.verify") from error
        except ssl.SSLError as error:
            self._line.close()
            raise _lost(f"no TLS connection: {error.reason}") from error
        except (OSError, UnicodeError) as error:  # UnicodeError: a name that can be no host
            self._line.close()
            raise _lost() from error
        except (http.client.HTTPException, ValueError) as error:
            self._line.close()
            raise DeviceError(f"{path}: no HTTP, so no Redfish service: {type(error).__name__}") from error
        if len(content) > LARGEST_BYTES:
            self._line.close()
            raise DeviceError(f"{path}: an answer of more than {LARGEST_BYTES:,} bytes")
        return answer.status, answer.headers, content


@lru_cache(maxsize=8)
def _tls(verify: bool | str) -> ssl.SSLContext:
    """One for all controllers: it holds every authority of this computer."""
    context = ssl.create_default_context(cafile=verify if isinstance(verify, str) else None)
    if verify is False:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    return context


def _lost(why: str = "") -> DeviceError:
    why = why or f"does not answer within {TIMEOUT_S:g} s, or cannot be reached"
    return DeviceError(f"{why}; waiting for it", is_lost=True)


def _refused_login() -> DeviceError:
    why = f"user or password is refused; asked again every {LOGIN_RETRY_S / 60:g} min, as controllers lock users out"
    return DeviceError(why, is_lost=True, retry_s=LOGIN_RETRY_S)
