"""A gateway with its real web server, fed with messages, and a client that speaks HTTP to it."""

from __future__ import annotations

import http.client
import json
from pathlib import Path
from typing import Any

from fantwin.pipeline.outputs.web.config import GatewayConfig
from fantwin.stages.gateway import STAGE, GatewayCore
from tests.support.ports import free_port
from tests.support.running_core import FANS, Answer, Fans, RunningCore


class RunningGateway(RunningCore[GatewayCore]):
    """It listens at `port`."""

    def __init__(
        self,
        folder: Path,
        answer: Answer | None = None,
        fans: Fans = FANS,
        *,
        configuration: str = "",
        started_t_ns: int = 0,
        port: int = 0,
        **settings: Any,
    ) -> None:
        """configuration: the text of a configuration file in the folder; empty: there is none."""
        self.port = port or free_port()
        path = folder / "fantwin.toml" if configuration else None
        context = {"configuration_path": path, "configuration_text": configuration, "started_t_ns": started_t_ns}
        super().__init__(STAGE, GatewayConfig(port=self.port, **settings), folder, answer, fans, **context)


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
