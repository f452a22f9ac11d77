"""An OPC UA stage with its real server, fed with messages, and a scorer that answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.opcua.config import OpcuaConfig
from stages.opcua import STAGE, OpcuaCore
from tests.support.running_core import FANS, Answer, RunningCore
from tests.support.running_gateway import free_port
from tests.support.site_users import make_users


class RunningOpcua(RunningCore[OpcuaCore]):
    """It listens at `url`, and has an operator and a viewer."""

    def __init__(self, folder: Path, answer: Answer | None = None, fans: int = FANS, **settings: Any) -> None:
        self.port = free_port()
        self.users = folder / "users.toml"
        folder.mkdir(parents=True, exist_ok=True)
        make_users(self.users)
        super().__init__(STAGE, OpcuaConfig(port=self.port, users=self.users, **settings), folder, answer, fans)

    @property
    def url(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}/fantwin"
