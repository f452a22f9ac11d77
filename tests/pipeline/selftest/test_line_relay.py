"""pipeline.selftest.line_relay: what a held, cut or disturbed line delivers."""

from __future__ import annotations

import os
import select
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from fantwin.pipeline.selftest.line_relay import LineRelay
from fantwin.pipeline.sources.simulated.device import PseudoTerminal, wait_for_reader

LIMIT_S = 20.0


class RelayedDevice:
    """A device, the relay, and a reader."""

    def __init__(self, folder: Path) -> None:
        self.device = PseudoTerminal(folder / "device")
        self.relay = LineRelay(folder / "device", folder / "port")
        self.reader = os.open(folder / "port", os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.reader)
        self.relay.start()
        wait_for_reader(self.device, "text", threading.Event())
        assert self.device.write(b"begin")
        while not self.receive(1).endswith(b"n"):  # what was sent to find the reader comes before
            pass

    def send(self, data: bytes) -> None:
        """Send from the device and wait until the relay has taken it."""
        assert self.device.write(data)
        self.device.drain(LIMIT_S)

    def receive(self, count: int) -> bytes:
        got = b""
        while len(got) < count and select.select([self.reader], [], [], LIMIT_S)[0]:
            got += os.read(self.reader, count - len(got))
        return got

    def close(self) -> None:
        self.relay.close()
        os.close(self.reader)
        self.device.close()


@pytest.fixture
def line(tmp_path: Path) -> Iterator[RelayedDevice]:
    line = RelayedDevice(tmp_path)
    yield line
    line.close()


def test_what_is_held_is_delivered_in_order_on_release(line: RelayedDevice) -> None:
    line.relay.hold()
    for number in range(5):
        line.send(bytes([number]) * 700)
    assert not select.select([line.reader], [], [], 0)[0]
    line.relay.release()
    assert line.receive(3500) == b"".join(bytes([number]) * 700 for number in range(5))


def test_what_is_sent_while_the_line_is_cut_is_lost(line: RelayedDevice) -> None:
    line.relay.cut(True)
    line.send(b"lost")
    line.relay.cut(False)
    line.send(b"kept")
    assert line.receive(4) == b"kept"


def test_what_is_injected_arrives_whole(line: RelayedDevice) -> None:
    noise = bytes(range(256)) * 100
    line.relay.inject(noise)
    assert line.receive(len(noise)) == noise
