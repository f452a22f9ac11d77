"""A gateway with its real web server, fed with messages, and a client that speaks HTTP to it."""

from __future__ import annotations

import http.client
import json
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.config.models import TrayConfig
from pipeline.gateway.config import GatewayConfig
from pipeline.runtime.stage import Context
from schemas.envelope import Envelope
from schemas.header import Header
from schemas.messages import Alarm, Message, Request, Score
from schemas.topics import tray_key
from stages.gateway import GatewayCore, build

SITE, TRAY, FANS = "hall", "tray1", 4
PRODUCER = "gateway-all-0123"
TICK_S = 0.02


def free_port() -> int:
    """A port on loopback that nothing else uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class RunningGateway:
    """answer: what the scorer says to a request; the answers are passed back as the bus would."""

    def __init__(
        self,
        folder: Path,
        answer: Callable[[Request], list[Alarm]] | None = None,
        *,
        configuration: str = "",
        started_t_ns: int = 0,
        **settings: Any,
    ) -> None:
        """configuration: the text of a configuration file in the folder; empty: there is none."""
        self.port = free_port()
        config = GatewayConfig(port=self.port, **settings)
        trays = (TrayConfig(name=TRAY, fans=FANS, speed_unit="rpm"),)
        context = Context(SITE, trays, config, folder, folder, started_t_ns, producer=PRODUCER)
        if configuration:
            path = folder / "fantwin.toml"
            context = replace(context, configuration_path=path, configuration_text=configuration)
        built = build(context)
        assert isinstance(built.core, GatewayCore)
        self.core = built.core
        self.sent: list[Request] = []
        self._answer = answer or (lambda _request: [])
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._now_ns = 0
        self._thread = threading.Thread(target=self._tick, daemon=True)
        self._thread.start()

    def feed(self, *messages: Message) -> None:
        """Pass messages to the core as the runner does: scores as envelopes."""
        with self._lock:
            for message in messages:
                is_score = isinstance(message, Score)
                item = Envelope.of(tray_key(SITE, TRAY, "score"), message, 0) if is_score else message
                self.core.step(item)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self.core.close()

    def _tick(self) -> None:
        while not self._ended.wait(TICK_S):
            with self._lock:
                self._now_ns += 1_000_000_000
                for message in self.core.tick(self._now_ns):
                    assert isinstance(message, Request)
                    name = f"{PRODUCER}/{len(self.sent)}"
                    self.sent.append(message)
                    for alarm in self._answer(message):
                        self.core.step(
                            replace(alarm, request=name, header=Header("scorer-all-1", 900 + len(self.sent), TRAY))
                        )


class Client:
    """A browser's requests, with its cookie."""

    def __init__(self, gateway: RunningGateway) -> None:
        self._port = gateway.port
        self.cookie = self.token = ""

    def ask(
        self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> tuple[int, Any, dict[str, str]]:
        """Status, body (decoded if it is JSON) and headers of an answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=20)
        sent = {"X-CSRF-Token": self.token, "Content-Type": "application/json"}
        sent |= {"Cookie": self.cookie} if self.cookie else {}
        try:
            connection.request(method, path, json.dumps(body) if body is not None else None, sent | (headers or {}))
            answer = connection.getresponse()
            data = answer.read()
        finally:
            connection.close()
        is_json = answer.getheader("content-type", "").startswith("application/json")
        return (
            answer.status,
            json.loads(data) if is_json else data.decode(),
            {k.lower(): v for k, v in answer.getheaders()},
        )

    def log_in(self, name: str, password: str) -> int:
        """The status of the answer."""
        status, body, headers = self.ask("POST", "/api/v1/login", {"name": name, "password": password})
        if status == 200:
            self.cookie, self.token = headers["set-cookie"].partition(";")[0], body["csrf_token"]
        return status
