"""An independent OPC UA client: node-opcua of npm, in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

from tests.support.node_packages import node_modules

PACKAGE, VERSION, WHAT = "node-opcua-client", "2.182.2", "OPC UA client of another make"


class NodeOpcua:
    """A client that does what a test asks."""

    def __init__(self, folder: Path) -> None:
        """folder: for its certificate."""
        self._folder = folder
        environment = os.environ | {
            "NODE_PATH": str(node_modules(PACKAGE, VERSION, WHAT)),
            "HOME": str(folder),
        }
        folder.mkdir(parents=True, exist_ok=True)
        self._process = subprocess.Popen(
            ["node", str(Path(__file__).with_name("opcua_client.cjs"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            text=True,
        )

    def __call__(self, command: str, **arguments: Any) -> Any:
        """Its answer.

        Raises:
            RuntimeError: it has failed; says why.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({"command": command, **arguments}) + "\n")
        self._process.stdin.flush()
        for line in self._process.stdout:
            if line.startswith("ANSWER "):
                answer = json.loads(line.removeprefix("ANSWER "))
                if "error" in answer:
                    raise RuntimeError(answer["error"])
                return answer["result"]
        raise RuntimeError("the client has ended")

    def pause(self, *, is_paused: bool) -> None:
        """Let it hang, or go on."""
        self._process.send_signal(signal.SIGSTOP if is_paused else signal.SIGCONT)

    def connect(self, url: str, user: str = "", password: str = "", *, encrypted: bool = True) -> Any:
        folder = str(self._folder / "pki")
        return self("connect", url=url, user=user, password=password, encrypted=encrypted, folder=folder)

    def close(self) -> None:
        """End it; taking leave of the server would cost it seconds."""
        self._process.kill()
        self._process.wait()
