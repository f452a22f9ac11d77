"""Servers that receive messages in tests: mail, HTTP, Alertmanager. Each listens on loopback, and may go and come."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import threading
import time
import urllib.request
from email import message_from_bytes
from email.policy import default
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from aiosmtpd.controller import Controller
from aiosmtpd.smtp import SMTP, Envelope, Session

from tests.support.ports import free_port

ALERTMANAGER = shutil.which("prometheus-alertmanager") or shutil.which("alertmanager")


class MailServer:
    """Keeps subjects and bodies of mails."""

    def __init__(self, port: int | None = None) -> None:
        self.port = port or free_port()
        self.mails: list[tuple[str, str]] = []
        self.received_s: list[float] = []
        self.refuses = self.hangs_up = False
        """hangs_up: when it has taken a mail, before it says so"""
        self.answered: int | None = None
        """so many mails; the others it takes, and says nothing; None: all"""
        self.refused_subjects: set[str] = set()
        self._controller: Controller | None = None

    @property
    def url(self) -> str:
        return f"mailto://127.0.0.1:{self.port}/?from=fantwin@hall.example&to=ann@hall.example"

    def start(self) -> None:
        self._controller = Controller(self, hostname="127.0.0.1", port=self.port)
        self._controller.start()

    def stop(self) -> None:
        if self._controller is not None:
            self._controller.stop()
            self._controller = None

    def subjects(self) -> list[str]:
        return [subject for subject, _ in self.mails]

    async def handle_DATA(self, server: SMTP, _session: Session, envelope: Envelope) -> str:  # noqa: N802
        if self.refuses:
            return "552 Too much mail"
        assert isinstance(envelope.content, bytes)
        mail = message_from_bytes(envelope.content, policy=default)
        if mail["subject"] in self.refused_subjects:
            return "554 No"
        body = mail.get_body(("plain",))
        assert body is not None
        self.mails.append((mail["subject"], body.get_content()))
        self.received_s.append(time.time())
        number = len(self.mails)
        if self.hangs_up:
            assert isinstance(server.transport, asyncio.Transport)
            server.transport.abort()
        while self.answered is not None and number > self.answered:
            await asyncio.sleep(0.02)
        return "250 Taken"


class HttpReceiver:
    """Keeps the JSON of each POST; answers with `status`."""

    def __init__(self) -> None:
        self.received: list[Any] = []
        self.status = 200
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                data = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                if receiver.status < 300:
                    receiver.received.append(data)
                self.send_response(receiver.status)
                self.end_headers()

            def log_message(self, format: str, *args: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()


class RunningAlertmanager:
    """Debian's, with an empty configuration."""

    def __init__(self, folder: Path) -> None:
        assert ALERTMANAGER is not None
        self.port = free_port()
        config = folder / "alertmanager.yml"
        config.write_text("route: {receiver: none}\nreceivers: [{name: none}]\n")
        self._process = subprocess.Popen(
            [
                ALERTMANAGER,
                f"--config.file={config}",
                f"--storage.path={folder / 'alertmanager'}",
                f"--web.listen-address=127.0.0.1:{self.port}",
                "--cluster.listen-address=",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def alerts(self) -> list[dict[str, Any]] | None:
        """The active alerts; None: it does not answer yet."""
        try:
            with urllib.request.urlopen(f"{self.url}/api/v2/alerts", timeout=5) as answer:
                return json.loads(answer.read())
        except OSError:
            return None

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(20)
