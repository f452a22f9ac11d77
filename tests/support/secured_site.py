"""A TLS router with the rules of a site, and a session for each of its roles, in this process."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import zenoh

from fantwin.pipeline.bus.credentials import Credentials, checked_credentials
from fantwin.pipeline.bus.rights import SiteRoles
from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.bus.settings import Settings
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.schemas.topics import rights_key
from tests.support.ports import free_port
from tests.support.site_certificates import SiteCertificates

SITE, TRAYS = "site", ("a", "b")
CONFIG = """
site = "site"
[bus]
mode = "client"
endpoint = "{endpoint}"
[bus.security]
folder = "."
controllers = ["dcim"]
[[tray]]
name = "a"
fans = 2
twin = "twin.onnx"
[[tray]]
name = "b"
fans = 2
twin = "twin.onnx"
"""
ANSWER_S = 30.0


def free_endpoint() -> str:
    """An endpoint on loopback that nothing else uses."""
    return f"tls/127.0.0.1:{free_port()}"


class SecuredSite:
    """Sessions are clients as any program with Zenoh could be: nothing of fantwin holds them back."""

    def __init__(self, folder: Path, endpoint: str, *, is_new: bool = True) -> None:
        """is_new: make the certificates; otherwise another process has made them in this folder."""
        self.endpoint = endpoint.replace("tcp/", "tls/")
        self.certificates = SiteCertificates(folder, is_new=is_new)
        self.config: Config = parse_config(CONFIG.format(endpoint=self.endpoint), folder / "site.toml", stages=())
        self.site = SiteRoles.of(self.config)
        if is_new:
            self.certificates.issue(*self.site.roles)
        self._stack = ExitStack()
        self.sessions: dict[str, zenoh.Session] = {}

    @contextmanager
    def running(self) -> Iterator[SecuredSite]:
        """Run the router; the sessions end with it."""
        with self._stack:
            self._stack.enter_context(open_router(self.endpoint, self.credentials("router"), self.site))
            yield self

    @contextmanager
    def sessions_of(self) -> Iterator[SecuredSite]:
        """Use a router that the caller runs; the sessions end with it."""
        with self._stack:
            yield self

    def credentials(self, role: str) -> Credentials:
        return checked_credentials(self.certificates.security, (role,))

    def session(self, role: str) -> zenoh.Session:
        """A session that shows the certificate of a role; one for each role."""
        if role not in self.sessions:
            settings = Settings()
            settings.set("mode", "client")
            settings.set("connect/endpoints", [self.endpoint])
            settings.set("scouting/multicast/enabled", False)
            settings.secure(self.credentials(role))
            session = self.sessions[role] = zenoh.open(settings.config)
            self._stack.callback(session.close)
        return self.sessions[role]

    def flush(self, role: str) -> None:
        """Return when the router has handled all that this session has sent: a connection keeps the order."""
        session = self.session(role)
        replies = list(session.get(rights_key(SITE, role), timeout=ANSWER_S))
        assert any(reply.ok for reply in replies), f"the router knows no role {role}"


def put(session: zenoh.Session, key: str, payload: bytes) -> None:
    """Publish as stages do: wait where the line is full. Zenoh's default drops, so that nothing arriving would say
    nothing about rights."""
    session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)


class Heard:
    """What one subscriber has heard, up to a sentinel that was sent last."""

    def __init__(self, session: zenoh.Session, key_expression: str) -> None:
        self.messages: list[tuple[str, bytes]] = []
        self._sentinel = threading.Event()
        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscriber = session.declare_subscriber(key_expression, handler)

    def _receive(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        if payload == b"sentinel":
            self._sentinel.set()
        else:
            self.messages.append((str(sample.key_expr), payload))

    def until_sentinel(self) -> list[tuple[str, bytes]]:
        """All that came before the sentinel."""
        assert self._sentinel.wait(ANSWER_S), "the sentinel has not arrived"
        return self.messages
