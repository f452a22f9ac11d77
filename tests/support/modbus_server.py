"""A drive behind Modbus, in this process: pymodbus's own server in front of simulated fans, by TCP or serial line."""

from __future__ import annotations

import asyncio
import os
import select
import struct
import threading
import time
import tty
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, TypeAlias

import numpy as np
from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusSerialServer, ModbusTcpServer, ModbusUdpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from fantwin.simulation.tray import SimulatedTray

RPM = 30.0 / np.pi
SPEED, COMMAND, CURRENT, VOLTAGE, TEMPERATURE, WANTED, REFUSED = 10, 11, 12, 14, 16, 100, 200
"""addresses: speed u16 rpm/2, command u16 per mille, current f32 A, voltage u32 mV low word first, temperature s16"""

_Server: TypeAlias = ModbusTcpServer | ModbusUdpServer | ModbusSerialServer


class Drive:
    """The registers of one device with one fan."""

    def __init__(self, tray: SimulatedTray) -> None:
        self.tray = tray
        self.started_s = time.monotonic()
        self.is_silent = False
        """it answers when this is over"""
        self.speed_rad_s = 0.0
        self.duty = 0.0

    async def access(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        registers: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Let the fan turn until now, and show it; take a command."""
        while self.is_silent:
            await asyncio.sleep(0.01)
        if address <= REFUSED < address + count:
            return ExcCodes.ILLEGAL_ADDRESS
        if values is not None and address == WANTED:
            if int(values[0]) > 1000:
                return ExcCodes.ILLEGAL_VALUE
            self.tray.command(np.array([values[0] / 1000.0]))
        while (due_s := self.tray.due_s()) is not None and due_s <= time.monotonic() - self.started_s:
            sample = self.tray.take()
            self.speed_rad_s, self.duty = float(sample.speed_rad_s[0]), float(sample.command[0])
        words = [round(self.speed_rad_s * RPM / 2), round(1000 * self.duty)]
        words += struct.unpack(">2H", struct.pack(">f", 1.5))
        words += struct.unpack(">2H", struct.pack(">I", 540_250))[::-1]
        words += struct.unpack(">H", struct.pack(">h", -55))
        registers[SPEED - start : SPEED - start + len(words)] = words
        return None


def _devices(drives: Mapping[int, Any]) -> list[SimDevice]:
    return [
        SimDevice(
            unit,
            [SimData(0, count=getattr(drive, "count", 300), values=0, datatype=DataType.REGISTERS)],
            action=drive.access,
        )
        for unit, drive in drives.items()
    ]


@contextmanager
def _serving(start: Callable[[], Awaitable[_Server]]) -> Iterator[Any]:
    """Run a server in a thread; gives it when it listens."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    async def started() -> _Server:
        server = await start()
        await server.serve_forever(background=True)
        return server

    try:
        server = asyncio.run_coroutine_threadsafe(started(), loop).result(10.0)
        try:
            yield server
        finally:
            asyncio.run_coroutine_threadsafe(server.shutdown(), loop).result(5.0)
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join(5.0)
        loop.close()


@contextmanager
def modbus_server(
    drives: Mapping[int, Any],
    port: int = 0,
    framer: FramerType = FramerType.SOCKET,
    kind: type[ModbusTcpServer | ModbusUdpServer] = ModbusTcpServer,
) -> Iterator[int]:
    """Serve the drives by their unit ids; gives the port."""

    async def start() -> ModbusTcpServer | ModbusUdpServer:
        return kind(_devices(drives), address=("127.0.0.1", port), framer=framer)

    with _serving(start) as server:
        is_udp = kind is ModbusUdpServer
        yield server.transport.get_extra_info("sockname")[1] if is_udp else server.transport.sockets[0].getsockname()[1]


class SerialLine:
    """Two serial ports, `device` and `host`, with a cable between them.

    transferred: the bytes that went over it, to the device and to the host.
    """

    def __init__(self) -> None:
        self._ends = [self._open(), self._open()]
        self.device, self.host = (os.ttyname(port) for _, port in self._ends)
        self.transferred = {"device": b"", "host": b""}
        self._is_cut = False
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    @staticmethod
    def _open() -> tuple[int, int]:
        end, port = os.openpty()
        tty.setraw(port)
        return end, port

    def _carry(self) -> None:
        (device, _), (host, _) = self._ends
        while not self._is_cut:
            for end in select.select([device, host], [], [], 0.02)[0]:
                to, other = ("device", device) if end == host else ("host", host)
                data = os.read(end, 4096)
                self.transferred[to] += data
                os.write(other, data)

    def unplug(self) -> None:
        """Take the adapter of the host away: its port hangs up, as that of a USB adapter does."""
        self._is_cut = True
        self._thread.join()
        for descriptor in (descriptor for end in self._ends for descriptor in end):
            with suppress(OSError):
                os.close(descriptor)


@contextmanager
def modbus_line(drives: dict[int, Drive]) -> Iterator[SerialLine]:
    """Serve the drives by their unit ids at one end of a serial line, as Modbus RTU; gives the line. A pseudo-terminal
    has no parity."""
    line = SerialLine()

    async def start() -> ModbusSerialServer:
        return ModbusSerialServer(_devices(drives), port=line.device, baudrate=19200, parity="N")

    try:
        with _serving(start):
            yield line
    finally:
        line.unplug()
