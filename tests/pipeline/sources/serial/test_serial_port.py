"""The serial adapter on real pseudo-terminals: it waits, reads, writes, and reopens it when the device returns."""

from __future__ import annotations

import os
import queue
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar, cast

import pytest
import serial

from fantwin.pipeline.sources.serial.port import ReceivedBytes, SerialPort
from fantwin.pipeline.sources.source import LinkDown, LinkUp

TIMEOUT_S = 20.0  # of a wait that normally ends at once
T = TypeVar("T")


class Device:
    """The far end of a pseudo-terminal whose near end is found at `path` while it is plugged in."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ends: tuple[int, int] | None = None

    def plug_in(self) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        self._ends = master, slave
        self.path.symlink_to(os.ttyname(slave))

    def unplug(self) -> None:
        if self._ends:
            self.path.unlink()
            for end in self._ends:
                os.close(end)
            self._ends = None

    def send(self, data: bytes) -> None:
        assert self._ends
        assert os.write(self._ends[0], data) == len(data)

    def receive(self, size: int) -> bytes:
        assert self._ends
        data = b""
        while len(data) < size:
            data += os.read(self._ends[0], size - len(data))
        return data


class Items:
    """The items that a link delivered, in order."""

    def __init__(self) -> None:
        self.queue: queue.Queue[LinkUp | LinkDown | ReceivedBytes] = queue.Queue()

    def next(self, kind: type[T]) -> T:
        item = self.queue.get(timeout=TIMEOUT_S)
        assert isinstance(item, kind), item
        return item

    def bytes(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            data += self.next(ReceivedBytes).data
        return data

    def skip_until(self, kind: type[T]) -> T:
        while not isinstance(item := self.queue.get(timeout=TIMEOUT_S), kind):
            pass
        return item

    def rest(self) -> list[LinkUp | LinkDown | ReceivedBytes]:
        return [self.queue.get_nowait() for _ in range(self.queue.qsize())]


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "ttyFAN")
    yield device
    device.unplug()


@pytest.fixture
def line(device: Device) -> Iterator[SerialPort]:
    line = SerialPort(str(device.path), 115200)
    yield line
    line.stop()


def test_a_port_in_use_is_opened_when_it_is_free_and_a_file_that_is_no_port_is_reported(
    device: Device, line: SerialPort, tmp_path: Path
) -> None:
    device.plug_in()
    first, items = Items(), Items()
    other = SerialPort(str(device.path), 115200)
    other.start(first.queue.put)
    first.next(LinkUp)
    line.start(items.queue.put)
    assert items.next(LinkDown).reason == "in use by another program; stop that one"
    other.stop()
    items.next(LinkUp)
    assert line.write(bytes(range(256))) and device.receive(256) == bytes(range(256))
    line.stop()
    (file := tmp_path / "file").touch()
    no_port = SerialPort(str(file), 115200)
    no_port.start(items.queue.put)
    reason = items.skip_until(LinkDown).reason
    assert reason.startswith("cannot be opened (") and reason.endswith("check [[tray]] port and baud")
    no_port.stop()


def test_stop_delivers_the_bytes_that_had_arrived_and_no_more(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fantwin.pipeline.sources.serial.port.DRAIN_LIMIT_S", TIMEOUT_S)  # a pause ends it
    device.plug_in()
    items = Items()
    line = SerialPort(str(device.path), 115200)
    stopper = threading.Thread(target=line.stop)
    data = bytes(range(256)) * 12

    def deliver(item: LinkUp | LinkDown | ReceivedBytes) -> None:
        items.queue.put(item)
        if isinstance(item, ReceivedBytes) and not stopper.ident:  # as a stage that is behind when it is stopped
            device.send(data)
            stopper.start()
            assert line._stopping.wait(TIMEOUT_S)

    line.start(deliver)
    items.next(LinkUp)
    device.send(b"!")
    items.next(ReceivedBytes)
    assert items.bytes(len(data)) == data
    stopper.join(TIMEOUT_S)
    device.send(b"too late")
    assert items.rest() == []
    assert not line.write(b"too late")


def test_stop_ends_although_the_device_never_pauses(device: Device) -> None:
    device.plug_in()
    line = SerialPort(str(device.path), 115200)
    items = Items()

    def deliver(item: LinkUp | LinkDown | ReceivedBytes) -> None:
        items.queue.put(item)
        device.send(b"and on")

    line.start(deliver)
    items.next(LinkUp)
    items.next(ReceivedBytes)
    line.stop()
    assert items.rest()


def test_write_reports_a_device_that_accepts_no_bytes_instead_of_blocking(device: Device, line: SerialPort) -> None:
    device.plug_in()
    items = Items()
    line.start(items.queue.put)
    items.next(LinkUp)
    assert not all(line.write(bytes(4096)) for _ in range(100)), "a terminal holds less than that"


def test_a_byte_that_came_just_before_the_device_was_disconnected_is_delivered():
    class Unplugged:
        """A pipe whose far end has been closed."""

        def __init__(self) -> None:
            self.near, far = os.pipe()
            os.write(far, b"x")
            os.close(far)

        def fileno(self) -> int:
            return self.near

    delivered: list[ReceivedBytes] = []
    unplugged = Unplugged()
    port = cast("serial.Serial", unplugged)
    assert SerialPort("unused", 115200)._read_until_disconnected(port, delivered.append)
    os.close(unplugged.near)
    assert [each.data for each in delivered] == [b"x"]
