"""Settings of a Zenoh session: those of fantwin, those of `bus.security`, and those that a site passes through."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import zenoh

from fantwin.pipeline.bus.errors import BusError, reason

if TYPE_CHECKING:
    from fantwin.pipeline.bus.credentials import Credentials

TLS = "transport/link/tls"


class Settings:
    """What a session is opened with."""

    def __init__(self) -> None:
        self.config = zenoh.Config()
        self._own: list[str] = []

    def set(self, path: str, value: object) -> None:
        """Set what fantwin needs. Raises ZError if the value is unusable."""
        self.config.insert_json5(path, json.dumps(value))
        self._own.append(path)

    def secure(self, credentials: Credentials | None) -> None:
        """Take part in mutual TLS; None: without."""
        if credentials is None:
            return
        files = {
            "root_ca_certificate": credentials.ca,
            "listen_private_key": credentials.key,
            "listen_certificate": credentials.certificate,
            "connect_private_key": credentials.key,
            "connect_certificate": credentials.certificate,
        }
        wanted = {name: str(path) for name, path in files.items()}
        always = {"enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True}
        self.set(TLS, {**wanted, **always})

    def pass_through(self, values: Mapping[str, Any]) -> None:
        """Set what `[bus.zenoh]` says.

        Raises:
            BusError: Zenoh has no such setting, does not take the value, or fantwin sets it itself.
        """
        for path, value in _flattened(values):
            if any(_overlap(path, own) for own in self._own):
                raise BusError(f"bus.zenoh: fantwin sets {path!r} itself: leave it out")
            try:
                self.config.insert_json5(path, json.dumps(value))
            except zenoh.ZError as error:
                why = reason(error)
                unknown = "unknown key" in why
                what = "Zenoh has no setting of this name" if unknown else f"Zenoh does not take {value!r}: {why}"
                raise BusError(f"bus.zenoh: {path!r}: {what}") from error


def _flattened(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Tables within tables as paths: `{transport = {unicast = {...}}}` is `transport/unicast/...`."""
    for key, value in values.items():
        path = f"{before}{key}".strip("/")
        if isinstance(value, Mapping):
            yield from _flattened(value, f"{path}/")
        else:
            yield path, value


def _overlap(path: str, own: str) -> bool:
    return f"{path}/".startswith(f"{own}/") or f"{own}/".startswith(f"{path}/")
