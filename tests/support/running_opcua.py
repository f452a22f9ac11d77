"""An OPC UA stage with its real server, fed with messages, and a scorer that answers."""

from __future__ import annotations

import gc
import os
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from asyncua.server.internal_server import InternalServer

from fantwin.pipeline.outputs.opcua.config import OpcuaConfig
from fantwin.stages.opcua import STAGE, OpcuaCore
from tests.support.ports import free_port
from tests.support.running_core import FANS, Answer, Fans, RunningCore
from tests.support.site_users import make_users

_make_standard_nodes = InternalServer.load_standard_address_space
_STANDARD_NODES = Path(__file__).parents[2] / "build" / f"asyncua-{version('asyncua')}-nodes"


async def _load_standard_nodes(server: InternalServer, shelf_file: Path | None = None) -> None:
    """Make the 6,000 nodes of the standard once, which takes seconds; load them from a file after that."""
    gc.disable()  # six times faster: it would look again and again at what is not garbage
    try:
        if _STANDARD_NODES.exists():
            server.aspace.load(_STANDARD_NODES)
            return
        await _make_standard_nodes(server, shelf_file)
    finally:
        gc.enable()
    _STANDARD_NODES.parent.mkdir(exist_ok=True)
    part = _STANDARD_NODES.with_name(f"{_STANDARD_NODES.name}.{os.getpid()}")
    server.aspace.dump(part)
    part.replace(_STANDARD_NODES)


class RunningOpcua(RunningCore[OpcuaCore]):
    """It listens at `url`, and has an operator and a viewer."""

    def __init__(self, folder: Path, answer: Answer | None = None, fans: Fans = FANS, **settings: Any) -> None:
        self.port = free_port()
        self.users = folder / "users.toml"
        folder.mkdir(parents=True, exist_ok=True)
        make_users(self.users)
        config = OpcuaConfig(port=self.port, users=self.users, **settings)
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(InternalServer, "load_standard_address_space", _load_standard_nodes)
            super().__init__(STAGE, config, folder, answer, fans)

    @property
    def url(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}/fantwin"
