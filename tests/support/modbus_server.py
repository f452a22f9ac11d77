"""A drive behind Modbus TCP, in this process: pymodbus's own server in front of simulated fans."""

from __future__ import annotations

import asyncio
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from simulation.tray import SimulatedTray

RPM = 30.0 / np.pi
SPEED, COMMAND, CURRENT, VOLTAGE, TEMPERATURE, WANTED, REFUSED = 10, 11, 12, 14, 16, 100, 200
"""addresses: speed u16 rpm/2, command u16 per mille, current f32 A, voltage u32 mV low word first, temperature s16"""


class Drive:
    """The registers of one device with one fan."""

    def __init__(self, tray: SimulatedTray) -> None:
        self.tray = tray
        self.started_s = time.monotonic()
        self.delay_s = 0.0
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
        await asyncio.sleep(self.delay_s)
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


@contextmanager
def modbus_server(drives: dict[int, Drive], port: int = 0) -> Iterator[int]:
    """Serve the drives by their unit ids; gives the TCP port."""
    devices = [
        SimDevice(unit, [SimData(0, count=300, values=0, datatype=DataType.REGISTERS)], action=drive.access)
        for unit, drive in drives.items()
    ]
    loop, found = asyncio.new_event_loop(), list[int]()
    ready = threading.Event()
    servers: list[ModbusTcpServer] = []

    async def serve() -> None:
        server = ModbusTcpServer(devices, address=("127.0.0.1", port))
        servers.append(server)
        await server.serve_forever(background=True)
        assert server.transport is not None
        found.append(server.transport.sockets[0].getsockname()[1])  # type: ignore[attr-defined]
        ready.set()

    def run() -> None:
        loop.run_until_complete(serve())
        loop.run_forever()

    thread = threading.Thread(target=run)
    thread.start()
    assert ready.wait(10.0)
    try:
        yield found[0]
    finally:
        asyncio.run_coroutine_threadsafe(servers[0].shutdown(), loop).result(5.0)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(5.0)
        loop.close()
