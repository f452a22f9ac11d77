"""An OPC UA stage with its real server, fed with messages, and a scorer that answers."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.config.models import TrayConfig
from pipeline.opcua.config import OpcuaConfig
from pipeline.presenting.users import User, UserRole, hasher, write_users
from pipeline.runtime.stage import Context
from schemas.envelope import Envelope
from schemas.header import Header
from schemas.messages import Alarm, Message, Request, Score
from schemas.topics import tray_key
from stages.opcua import OpcuaCore, build
from tests.support.running_gateway import free_port

SITE, TRAY, FANS = "hall", "tray1", 4
PRODUCER = "opcua-all-0123"
PASSWORD = "correct horse battery"
OPERATOR, VIEWER = "ann", "vic"
TICK_S = 0.02


class RunningOpcua:
    """answer: what the scorer says to a request; the answers are passed back as the bus would."""

    def __init__(
        self,
        folder: Path,
        answer: Callable[[Request], list[Alarm]] | None = None,
        fans: int = FANS,
        **settings: Any,
    ) -> None:
        self.port = free_port()
        self.users = folder / "users.toml"
        folder.mkdir(parents=True, exist_ok=True)
        hashed = hasher().hash(PASSWORD)
        roles = ((OPERATOR, UserRole.OPERATOR), (VIEWER, UserRole.VIEWER))
        write_users(self.users, {name: User(name, role, hashed) for name, role in roles})
        config = OpcuaConfig(port=self.port, users=self.users, **settings)
        trays = (TrayConfig(name=TRAY, fans=fans, speed_unit="rpm"),)
        built = build(Context(SITE, trays, config, folder, folder, 0, producer=PRODUCER))
        assert isinstance(built.core, OpcuaCore)
        self.core = built.core
        self.sent: list[Request] = []
        self._answer = answer or (lambda _request: [])
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._now_ns = 0
        self._thread = threading.Thread(target=self._tick, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}/fantwin"

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
                        header = Header("scorer-all-1", 900 + len(self.sent), TRAY)
                        self.core.step(replace(alarm, request=name, header=header))
