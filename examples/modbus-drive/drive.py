"""A frequency converter with one fan on Modbus TCP, for trying: python drive.py [PORT]."""

from __future__ import annotations

import asyncio
import random
import sys
import time

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

WANTED, FREQUENCY, SPEED, CURRENT = 8193, 8450, 8451, 8452
RPM_PER_HZ, TIME_CONSTANT_S, RAMP_HZ_S = 29.0, 1.5, 5.0


class Drive:
    """Ramps to the wanted frequency; the fan follows with a time constant."""

    def __init__(self) -> None:
        self.wanted_hz = self.hz = 20.0
        self.rpm = RPM_PER_HZ * self.hz
        self.time_s = time.monotonic()

    async def access(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        registers: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Take a written frequency, and show the fan as it is now."""
        if values is not None and address == WANTED:
            self.wanted_hz = values[0] / 100
        step_s, self.time_s = time.monotonic() - self.time_s, time.monotonic()
        self.hz += max(-RAMP_HZ_S * step_s, min(RAMP_HZ_S * step_s, self.wanted_hz - self.hz))
        self.rpm += (RPM_PER_HZ * self.hz - self.rpm) * min(1.0, step_s / TIME_CONSTANT_S)
        shown = {FREQUENCY: 100 * self.hz, SPEED: random.gauss(self.rpm, 2.0), CURRENT: 10 + 0.6 * self.hz}
        for register, value in shown.items():
            registers[register - start] = max(0, round(value))
        return None


async def main(port: int) -> None:
    """Serve until Ctrl-C."""
    registers = SimData(0, count=9000, values=0, datatype=DataType.REGISTERS)
    server = ModbusTcpServer([SimDevice(1, [registers], action=Drive().access)], address=("127.0.0.1", port))
    print(f"a drive listens on 127.0.0.1:{port}", file=sys.stderr, flush=True)
    await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]) if len(sys.argv) > 1 else 5020))
