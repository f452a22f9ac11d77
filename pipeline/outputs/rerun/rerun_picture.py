"""A picture of a view file without a display: a headless Rerun viewer opens it as a person would.

It needs a Vulkan driver; without a graphics card, Mesa's software driver works.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.rerun.rerun_sink import LOOPBACK, rerun_program
from fantwin.pipeline.outputs.rerun.rerun_styles import DAYS, TIMELINE

SIZE = "1920x1080"
TIMEOUT_S, POLL_S = 60.0, 0.2
NOTICE_S = 6.0
"""for about five seconds the viewer covers a corner of the window with a notice"""
ROUNDED_NS = 1_000
"""the viewer reports times rounded to floating point"""
_DRIVER_FOLDERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
_DRIVER_VARIABLES = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES", "VK_ADD_DRIVER_FILES")


@dataclass(frozen=True)
class Picture:
    """A PNG of the window, and the warnings of each view by name."""

    png: bytes
    reports: dict[str, list[str]]


def has_vulkan_driver() -> bool:
    """Whether the headless viewer can draw here. Other systems than Linux have what it needs."""
    if sys.platform != "linux":
        return True
    named = [Path(path) for name in _DRIVER_VARIABLES for path in os.environ.get(name, "").split(":") if path]
    if named:
        return any(path.is_file() for path in named)
    return any(any(Path(folder).glob("*.json")) for folder in _DRIVER_FOLDERS)


def draw_picture(view_file: Path) -> Picture:
    """Draw a view file in its own layout, at its end.

    Raises:
        UserError: no driver, no such file, no view file, or the viewer did not draw it in time.
    """
    ends_ns = _ends_ns(view_file)
    if not has_vulkan_driver():
        raise UserError("no Vulkan driver found, which the headless viewer needs: apt-get install mesa-vulkan-drivers")
    with headless_viewer(view_file) as viewer:
        began_s = time.monotonic()
        _wait_until_loaded(viewer, ends_ns)
        time.sleep(max(0.0, began_s + NOTICE_S - time.monotonic()))
        png = _stable_screenshot(viewer)
        return Picture(png, {shown.name: [str(each) for each in shown.reports] for shown in viewer.get_state().views})


@contextmanager
def headless_viewer(*files: Path) -> Iterator[ViewerClient]:
    """Start a viewer on a free loopback port with these view files; it ends on exit.

    Raises:
        UserError: it failed.
    """
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    command = [rerun_program(), "--headless", "--bind", LOOPBACK, "--port", str(port), "--window-size", SIZE]
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            [*command, "--hide-welcome-screen", "--expect-data-soon", *files],
            stdout=output,
            stderr=output,
            env={**os.environ, "RERUN_APP_ONLY": "true", "RUST_LOG": "error"},
        )
        try:
            yield _connect(process, port)
        except (ConnectionError, TimeoutError, RuntimeError) as error:
            output.seek(0)
            lines = output.read().decode(errors="replace").strip().splitlines()
            said = lines[-1] if lines else "none"
            raise UserError(f"the headless viewer failed: {error}; its output: {said}") from error
        finally:
            process.terminate()
            process.wait()


def _ends_ns(view_file: Path) -> dict[str, int]:
    """The newest time of each timeline, ns."""
    if not view_file.is_file():
        raise UserError(f"{view_file}: no such file; make one: fantwin view RECORDING -o {view_file}")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*no footer")
            chunks = [chunk.to_record_batch() for chunk in RrdReader(view_file).stream()]
    except (RuntimeError, ValueError, OSError) as error:
        raise UserError(f"{view_file}: not a Rerun file: {error}") from error
    ends_ns: dict[str, int] = {}
    for chunk in chunks:
        for timeline in {TIMELINE, DAYS}.intersection(chunk.schema.names):
            times_ns = np.asarray(chunk.column(timeline)).astype("datetime64[ns]").astype(np.int64)
            ends_ns[timeline] = max(ends_ns.get(timeline, 0), int(times_ns.max()))
    if not ends_ns:
        raise UserError(f"{view_file}: holds nothing that the viewer stage draws")
    return ends_ns


def _connect(process: subprocess.Popen[bytes], port: int) -> ViewerClient:
    deadline_s = time.monotonic() + TIMEOUT_S
    while process.poll() is None and time.monotonic() < deadline_s:
        with socket.socket() as probe:
            if probe.connect_ex((LOOPBACK, port)) == 0:
                return ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        time.sleep(POLL_S)
    raise ConnectionError("it did not start")


def _wait_until_loaded(viewer: ViewerClient, ends_ns: dict[str, int]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline_s:
        state = viewer.get_state()
        loaded_ns = {line.name: line.end or 0 for each in state.recordings for line in each.timelines}
        if state.views and all(loaded_ns.get(name, 0) >= end_ns - ROUNDED_NS for name, end_ns in ends_ns.items()):
            return
        time.sleep(POLL_S)
    raise ConnectionError(f"it did not load the file in {TIMEOUT_S:.0f} s")


def _stable_screenshot(viewer: ViewerClient) -> bytes:
    """The first screenshot that equals the one before it. One that a busy machine draws too slowly is left out."""
    deadline_s = time.monotonic() + TIMEOUT_S
    before = b""
    while time.monotonic() < deadline_s:
        with suppress(TimeoutError):
            now = viewer.take_screenshot()
            if now == before:
                return now
            before = now
        time.sleep(POLL_S)
    raise ConnectionError(f"the picture still changed after {TIMEOUT_S:.0f} s")
