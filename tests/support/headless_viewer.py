"""A Rerun viewer without a display, which opens a view as a person would.

It needs a Vulkan driver; without a graphics card, Mesa's software driver works.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.ports import free_port

pytest.importorskip("rerun")
from rerun.experimental import ViewerClient

from fantwin.pipeline.outputs.rerun.rerun_sink import rerun_program
from fantwin.pipeline.site.loopback import LOOPBACK

TIMEOUT_S, POLL_S = 60.0, 0.2
_DRIVER_FOLDERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
_DRIVER_VARIABLES = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES", "VK_ADD_DRIVER_FILES")


def has_vulkan_driver() -> bool:
    """Whether the headless viewer can draw here. Other systems than Linux have what it needs."""
    if sys.platform != "linux":
        return True
    named = [Path(path) for name in _DRIVER_VARIABLES for path in os.environ.get(name, "").split(":") if path]
    if named:
        return any(path.is_file() for path in named)
    return any(any(Path(folder).glob("*.json")) for folder in _DRIVER_FOLDERS)


needs_a_driver = pytest.mark.skipif(
    not has_vulkan_driver(), reason="no Vulkan driver here: apt-get install mesa-vulkan-drivers"
)


@contextmanager
def headless_viewer() -> Iterator[ViewerClient]:
    """Start a viewer on a free port; it ends on exit."""
    port = free_port()
    window = ("--headless", "--window-size", "1920x1080", "--hide-welcome-screen", "--expect-data-soon")
    process = subprocess.Popen(
        [rerun_program(), *window, "--bind", LOOPBACK, "--port", str(port)],
        env={**os.environ, "RERUN_APP_ONLY": "true", "RUST_LOG": "error"},
    )
    try:
        yield _connect(process, port)
    finally:
        process.terminate()
        process.wait()


def _connect(process: subprocess.Popen[bytes], port: int) -> ViewerClient:
    deadline_s = time.monotonic() + TIMEOUT_S
    while process.poll() is None and time.monotonic() < deadline_s:
        with socket.socket() as probe:
            if probe.connect_ex((LOOPBACK, port)) == 0:
                return ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        time.sleep(POLL_S)
    raise ConnectionError("it did not start")
