"""Packages of npm that tests use: `.ci/run` installs them, and where it has not, the first test that needs one does."""

from __future__ import annotations

import fcntl
import shutil
import subprocess
from pathlib import Path

import pytest

NODE = Path(__file__).parents[2] / "build" / "node"
"""where `npm install --prefix build/node` puts them"""
_INSTALL_LIMIT_S = 240


def node_modules(package: str, version: str, what: str) -> Path:
    """The folder of all packages, with this one among them; skips the test where it cannot be had. what: in words."""
    modules = NODE / "node_modules"
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip(f"no {what}: needs node and npm")
    NODE.mkdir(parents=True, exist_ok=True)
    with (NODE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one worker installs, the others find it
        if not (modules / package / "package.json").exists():
            command = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(NODE), f"{package}@{version}"]
            try:
                done = subprocess.run(command, capture_output=True, text=True, timeout=_INSTALL_LIMIT_S, check=False)
            except subprocess.TimeoutExpired:
                pytest.skip(f"no {what}: npm install {package} takes too long")
            if done.returncode:
                pytest.skip(f"no {what}: npm install {package}: {done.stderr[-200:]}")
    return modules
