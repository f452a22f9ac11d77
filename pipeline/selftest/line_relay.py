"""A serial line that can be held, cut and disturbed: it passes bytes between a simulated device and its reader."""

from __future__ import annotations

import os
import select
import threading
import tty
from collections import deque
from pathlib import Path

from fantwin.pipeline.sources.simulated.device import PseudoTerminal

_POLL_S = 0.002
_READ_BYTES = 2048
_WRITE_BYTES = 1024
"""bytes in one write: a pseudo-terminal accepts a write of this size completely or not at all"""


class LineRelay:
    """Relays in a thread of its own from `start` to `close`.

    What arrives while nobody reads, or while the line is cut, is lost, as on a real line. What arrives while the line
    is held is delivered on `release`.
    """

    def __init__(self, device: Path, port: Path) -> None:
        """device: the port of the simulated device. port: the name under which the reader finds the line."""
        self._line = PseudoTerminal(port)
        self._device_path = device
        self._device: int | None = None
        self._queue: deque[bytes] = deque()
        self._held = False
        self._cut = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begin to relay. The device's port is opened once the line has a reader."""
        self._thread.start()

    def hold(self) -> None:
        """Keep what the device sends."""
        self._held = True

    def release(self) -> None:
        """Deliver what was kept, as fast as the reader takes it."""
        self._held = False

    def cut(self, is_cut: bool) -> None:
        """Start or stop losing what the device sends."""
        self._cut = is_cut

    def inject(self, data: bytes) -> None:
        """Send bytes that the device did not send."""
        for first in range(0, len(data), _WRITE_BYTES):
            self._queue.append(data[first : first + _WRITE_BYTES])

    def close(self) -> None:
        """End the thread and the line."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._device is not None:
            os.close(self._device)
        self._line.close()

    def _run(self) -> None:
        while not self._ended.wait(_POLL_S):
            if not self._line.has_reader():
                self._queue.clear()
            elif self._device is None:
                self._device = _open(self._device_path)
            if self._device is not None:
                self._receive(self._device)
                self._send(self._device)

    def _receive(self, device: int) -> None:
        while select.select([device], [], [], 0)[0]:
            data = os.read(device, _READ_BYTES)
            if not data:
                return
            if not self._cut:
                self.inject(data)

    def _send(self, device: int) -> None:
        while self._queue and not self._held and self._line.write(self._queue[0]):
            self._queue.popleft()
        if to_device := self._line.wait(0):
            os.write(device, to_device)


def _open(path: Path) -> int | None:
    try:
        device = os.open(path, os.O_RDWR | os.O_NOCTTY)
    except FileNotFoundError:  # not there yet
        return None
    tty.setraw(device)
    return device
