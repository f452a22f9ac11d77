"""An independent OPC UA client: node-opcua of npm, in a process of its own."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

NODE = Path(__file__).parents[2] / "build" / "node"
"""where `npm install --prefix build/node node-opcua-client@2` has put it"""
PACKAGE = "node-opcua-client"
VERSION = "2.182.2"
_INSTALL_LIMIT_S = 240


def node_modules() -> Path:
    """The folder of the client, installed if it is not; skips the test where that cannot be done."""
    modules = NODE / "node_modules"
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("no OPC UA client of another make: needs node and npm")
    if not (modules / PACKAGE / "package.json").exists():
        NODE.mkdir(parents=True, exist_ok=True)
        command = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(NODE), f"{PACKAGE}@{VERSION}"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_INSTALL_LIMIT_S, check=False)
        except subprocess.TimeoutExpired:
            pytest.skip(f"no OPC UA client of another make: npm install {PACKAGE} takes too long")
        if done.returncode:
            pytest.skip(f"no OPC UA client of another make: npm install {PACKAGE}: {done.stderr[-200:]}")
    return modules


class NodeOpcua:
    """A client that does what a test asks."""

    def __init__(self, folder: Path) -> None:
        """folder: for its certificate."""
        self._folder = folder
        environment = os.environ | {"NODE_PATH": str(node_modules()), "HOME": str(folder)}
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
        if self._process.poll() is None:
            self.pause(is_paused=False)
            try:
                self("close")
                self._process.wait(10)
            except (RuntimeError, OSError, subprocess.TimeoutExpired):
                self._process.kill()
        self._process.wait()
