"""The serial adapter on pseudo-terminals: how it opens, drains and writes, and what a device has counted."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import serial

from fantwin.pipeline.sources.serial import same_port
from fantwin.pipeline.sources.serial.discovery import discover_device
from fantwin.pipeline.sources.serial.port import ReceivedBytes, SerialPort
from fantwin.pipeline.sources.serial.source import DeviceCounterSteps
from fantwin.pipeline.sources.source import LinkDown, LinkUp, Noted
from fantwin.schemas.wire import UINT32, DeviceCounters
from tests.support.running_chain import eventually
from tests.support.source_worlds import SerialWorld

TIMEOUT_S = 20.0  # of a wait that normally ends at once


class Line(SerialPort):
    """A port, and what it has delivered."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path), 115200)
        self.items: list[LinkUp | LinkDown | Noted | ReceivedBytes] = []

    def begin(self) -> None:
        self.start(self.items.append)
        eventually(lambda: self.items, "it is open, or not")

    @property
    def data(self) -> bytes:
        return b"".join(item.data for item in self.items if isinstance(item, ReceivedBytes))


@pytest.fixture
def device(tmp_path: Path) -> Iterator[SerialWorld]:
    device = SerialWorld(tmp_path)
    device.plug_in()
    yield device
    device.unplug()


def test_a_port_in_use_is_opened_when_it_is_free_and_a_file_that_is_no_port_is_reported(
    device: SerialWorld, tmp_path: Path
) -> None:
    other, line = Line(device.path), Line(device.path)
    other.begin()
    line.begin()
    assert line.items == [LinkDown("in use by another program; stop that one")]
    other.stop()
    eventually(lambda: line.items[1:] == [LinkUp()], "it is open")
    assert line.write(bytes(range(256)))
    received = b""
    while len(received) < 256:
        received += os.read(device.far, 256)
    assert received == bytes(range(256))
    line.stop()
    (file := tmp_path / "file").touch()
    no_port = Line(file)
    no_port.begin()
    (down,) = no_port.items
    assert isinstance(down, LinkDown) and down.reason.startswith("cannot be opened (")
    assert down.reason.endswith("check [[tray]] port and baud")
    no_port.stop()


class Computer:
    """Ports of USB devices, pseudo-terminals at paths such as ttyUSB0, as the system lists them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.worlds: dict[str, SerialWorld] = {}
        self.serials: dict[str, str | None] = {}

    def plug_in(self, name: str, serial_number: str | None) -> Path:
        world = self.worlds[name] = SerialWorld(self.folder)
        world.path = self.folder / name
        world.plug_in()
        self.serials[name] = serial_number
        return world.path

    def unplug(self, name: str) -> None:
        self.worlds.pop(name).unplug()

    def listed(self) -> list[Any]:
        return [
            SimpleNamespace(
                device=os.path.realpath(world.path), vid=1, pid=2, serial_number=self.serials[name], location="1-1"
            )
            for name, world in self.worlds.items()
        ]


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Computer]:
    computer = Computer(tmp_path)
    monkeypatch.setattr(same_port, "listed_ports", computer.listed)
    yield computer
    for name in list(computer.worlds):
        computer.unplug(name)


@pytest.mark.parametrize("serial_number", ["A50285BI", None], ids=["by its number", "by its socket"])
def test_a_board_that_comes_back_as_another_port_is_found_again(computer: Computer, serial_number: str | None) -> None:
    line = Line(computer.plug_in("ttyUSB0", serial_number))
    line.begin()
    computer.unplug("ttyUSB0")
    eventually(lambda: isinstance(line.items[-1], LinkDown), "it is gone")
    computer.plug_in("ttyUSB1", serial_number)
    eventually(lambda: isinstance(line.items[-1], Noted), "it is back")
    line.stop()
    first, second = computer.folder / "ttyUSB0", os.path.realpath(computer.folder / "ttyUSB1")
    assert line.items[-2:] == [
        LinkUp(),
        Noted("port_changed", f'{first} is {second} since it was plugged in again: write port = "{second}"'),
    ]


def test_another_board_is_not_taken_for_the_one_that_is_gone_but_named(computer: Computer) -> None:
    line = Line(computer.plug_in("ttyUSB0", "A"))
    line.begin()
    computer.unplug("ttyUSB0")
    other = computer.plug_in("ttyUSB1", "B")
    eventually(lambda: "ports there" in getattr(line.items[-1], "reason", ""), "it is looked for")
    (reason,) = {item.reason for item in line.items if isinstance(item, LinkDown) and "ports there" in item.reason}
    assert (
        reason.startswith("no such port; waiting for it; check [[tray]] port; ports there: ") and str(other) in reason
    )
    computer.plug_in("ttyUSB0", "C")
    eventually(lambda: isinstance(line.items[-1], Noted), "a board is there")
    line.stop()
    assert line.items[-1] == Noted("port_changed", f"another device than before is at {line._name}")


def test_the_name_that_lasts_is_written(computer: Computer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = computer.plug_in("ttyUSB0", "A")
    monkeypatch.setattr(same_port, "BY_ID", tmp_path / "by-id")
    assert same_port.lasting_name(str(port)) == str(port)
    (tmp_path / "by-id").mkdir()
    (link := tmp_path / "by-id" / "usb-FTDI_A-if00-port0").symlink_to(os.path.realpath(port))
    found = discover_device(str(port), listen_s=0.05)
    assert found.tray["source"]["port"] == str(link) and f'port = "{link}"' in found.toml


def test_stop_delivers_the_bytes_that_had_arrived_and_no_more(
    device: SerialWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fantwin.pipeline.sources.serial.port.DRAIN_LIMIT_S", TIMEOUT_S)  # a pause ends it
    line = Line(device.path)
    stopper = threading.Thread(target=line.stop)
    data = bytes(range(256)) * 12

    def deliver(item: LinkUp | LinkDown | Noted | ReceivedBytes) -> None:
        line.items.append(item)
        if isinstance(item, ReceivedBytes) and not stopper.ident:  # as a stage that is behind when it is stopped
            os.write(device.far, data)
            stopper.start()
            assert line._stopping.wait(TIMEOUT_S)

    line.start(deliver)
    eventually(lambda: line.items == [LinkUp()], "it is open")
    os.write(device.far, b"!")
    eventually(lambda: line.data == b"!" + data, "all comes")
    stopper.join(TIMEOUT_S)
    os.write(device.far, b"too late")
    assert line.data == b"!" + data
    assert not line.write(b"too late")


def test_stop_ends_although_the_device_never_pauses(device: SerialWorld) -> None:
    line = Line(device.path)

    def deliver(item: LinkUp | LinkDown | Noted | ReceivedBytes) -> None:
        line.items.append(item)
        os.write(device.far, b"and on")

    line.start(deliver)
    eventually(lambda: len(line.data) > 20, "it sends")
    line.stop()


def test_write_reports_a_device_that_accepts_no_bytes_instead_of_blocking(device: SerialWorld) -> None:
    line = Line(device.path)
    line.begin()
    assert not all(line.write(bytes(4096)) for _ in range(100)), "a terminal holds less than that"
    line.stop()


def test_a_byte_that_came_just_before_the_device_was_disconnected_is_delivered() -> None:
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


AT_100_HZ_S = UINT32 // 100
"""uptime after which the sample number of a device wraps"""


def steps(*frames: tuple[int, tuple[int, ...]]) -> list[int]:
    """The advance of each counter in the last of these frames, each an uptime in seconds and the counters."""
    its = DeviceCounterSteps()
    found = [list(its.steps(DeviceCounters(uptime_s, counts)).values()) for uptime_s, counts in frames]
    return found[-1]


@pytest.mark.parametrize(
    ("last", "now", "advance"),
    [
        pytest.param((70, (50, 0, 7)), (71, (60, 0, 9)), [10, 0, 2], id="it runs on"),
        pytest.param((70, (65_530, 0, 7)), (71, (3, 0, 7)), [9, 0, 0], id="a counter wraps"),
        pytest.param((70, (50, 0, 7)), (0, (60, 0, 9)), [60, 0, 9], id="restart: the uptime is smaller"),
        pytest.param((2, (50, 0, 7)), (3, (1, 0, 0)), [1, 0, 0], id="restart: only the counters show it"),
        pytest.param((2, (50, 0, 7)), (2, (1, 0, 0)), [1, 0, 0], id="restart within a second"),
        pytest.param((2, (50, 0, 7)), (2, (51, 0, 7)), [1, 0, 0], id="two frames within a second"),
        pytest.param((AT_100_HZ_S - 1, (50, 0, 7)), (0, (51, 0, 7)), [1, 0, 0], id="the uptime wraps"),
        pytest.param((AT_100_HZ_S - 9, (50, 0, 7)), (3, (51, 0, 7)), [1, 0, 0], id="frames before the wrap are lost"),
        pytest.param((UINT32 - 1, (50, 0, 7)), (0, (51, 0, 7)), [1, 0, 0], id="the uptime wraps at 32 bits"),
        pytest.param((AT_100_HZ_S, (50, 0, 7)), (0, (51, 0, 0)), [51, 0, 0], id="restart after years"),
        pytest.param((70, (50, 0, 7)), (71, (60, 0)), [0, 0], id="another number of counters"),
    ],
)
def test_what_is_counted_since_the_frame_before(
    last: tuple[int, tuple[int, ...]], now: tuple[int, tuple[int, ...]], advance: list[int]
) -> None:
    assert steps(last, now) == advance


def test_counters_that_wrapped_while_the_line_was_closed_show_no_restart() -> None:
    its = DeviceCounterSteps()
    its.steps(DeviceCounters(70, (50, 0, 7)))
    its.connection_interrupted()
    assert not any(its.steps(DeviceCounters(90_000, (40, 0, 7))).values())
