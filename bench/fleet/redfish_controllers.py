"""Hundreds of baseboard controllers in one process, each at a loopback address of its own (Linux), for benches.

Five shapes of payload of real makers, in turn, of simulated fans (`hall_fans.py`); some controllers are broken, slow,
silent or lie:

    python -m bench.fleet.redfish_controllers '{"port": 8443, "controllers": 400}'
"""

from __future__ import annotations

import asyncio
import json
import ssl
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.fleet.hall_fans import HallFans

CHASSIS = "/redfish/v1/Chassis/1"
RATED_RPM, LIE_RPM = 15_000.0, 1e9
SLOW_S = 2.5
SIMULATED_S = 300.0
SHAPES = {
    "Thermal, ReadingRPM, a vendor's duty": "/Oem/Vendor/Duty",
    "ThermalSubsystem, SetPoint": "",
    "OpenBMC: Thermal with pwms": "",
    "OpenBMC: fans without speeds, sensors": "",
    "EnvironmentMetrics, an OEM resource": "/redfish/v1/Oem/Fans#/Duty",
}
"""source.command of each"""


@dataclass
class Plan:
    """What is served. Lists: numbers of controllers. A file of a certificate with its key makes it TLS."""

    port: int
    controllers: int
    certificate: str = ""
    broken: list[int] = field(default_factory=list[int])
    slow: list[int] = field(default_factory=list[int])
    silent: list[int] = field(default_factory=list[int])
    lying: list[int] = field(default_factory=list[int])
    dead: list[int] = field(default_factory=list[int])

    def address(self, number: int) -> str:
        """Where a controller is."""
        return f"127.{10 + number % len(SHAPES)}.{number // len(SHAPES) // 250}.{number // len(SHAPES) % 250 + 1}"


def link(path: str) -> dict[str, str]:
    """How Redfish names another resource."""
    return {"@odata.id": path}


def answer(number: int, path: str, fans: list[tuple[float, float]], *, is_broken: bool = False) -> tuple[int, Any]:
    """Status and object that a controller gives for a path. fans: command in per cent and speed in rpm of each."""
    if is_broken and path.endswith(("/Fans/2", "fantach_FAN2", "/Oem/Fans")):
        return 500, {}
    documents: dict[str, Any] = {"/redfish/v1": {"Id": "Root", "Chassis": link("/redfish/v1/Chassis")}}
    others = [link("/redfish/v1/Chassis/Gone")] if is_broken else []
    documents["/redfish/v1/Chassis"] = {"Members": [*others, link(CHASSIS)]}
    documents |= (_oem, _set_point, _pwms, _sensors, _metrics)[number % len(SHAPES)](fans)
    found = documents.get(path.rstrip("/"))
    return (404, {}) if found is None else (200, found)


class Hall:
    """All controllers of a plan, from when it was made."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._fans = HallFans(plan.controllers, SIMULATED_S, seed=1)
        self._began_s = time.monotonic()

    def answer(self, number: int, path: str) -> tuple[int, Any]:
        """Status and object now."""
        fans = self._fans.at(number, time.monotonic() - self._began_s)
        if number in self.plan.lying:
            fans = [(percent, LIE_RPM) for percent, _ in fans]
        return answer(number, path, fans, is_broken=number in self.plan.broken)


def _oem(fans: list[tuple[float, float]]) -> dict[str, Any]:
    each = [
        {"Name": f"Fan{n}", "ReadingRPM": rpm, "Oem": {"Vendor": {"Duty": percent}}, "Status": {"State": "Enabled"}}
        for n, (percent, rpm) in enumerate(fans, 1)
    ]
    return {CHASSIS: {"Thermal": link(f"{CHASSIS}/Thermal")}, f"{CHASSIS}/Thermal": {"Fans": each}}


def _set_point(fans: list[tuple[float, float]]) -> dict[str, Any]:
    there = f"{CHASSIS}/ThermalSubsystem"
    each = {
        f"{there}/Fans/{n}": {
            "Id": f"{n}",
            "SpeedPercent": {"Reading": round(100.0 * rpm / RATED_RPM), "SpeedRPM": rpm},
            "SpeedControlPercent": {"SetPoint": percent},
        }
        for n, (percent, rpm) in enumerate(fans, 1)
    }
    collection = {"Members": list(map(link, each))}
    return {
        CHASSIS: {"ThermalSubsystem": link(there)},
        there: {"Fans": link(f"{there}/Fans")},
        f"{there}/Fans": collection,
        **each,
    }


def _pwms(fans: list[tuple[float, float]]) -> dict[str, Any]:
    each = [{"Name": f"FAN{n} TACH", "Reading": rpm, "ReadingUnits": "RPM"} for n, (_, rpm) in enumerate(fans, 1)]
    each += [{"Name": f"FAN{n} PWM", "Reading": p, "ReadingUnits": "Percent"} for n, (p, _) in enumerate(fans, 1)]
    return {CHASSIS: {"Thermal": link(f"{CHASSIS}/Thermal")}, f"{CHASSIS}/Thermal": {"Fans": each}}


def _sensors(fans: list[tuple[float, float]]) -> dict[str, Any]:
    there = f"{CHASSIS}/Sensors"
    each = {
        f"{there}/fan{what}_FAN{n}": {"Id": f"fan{what}_FAN{n}", "Reading": f"{value:.6f}", "ReadingUnits": unit}
        for n, (percent, rpm) in enumerate(fans, 1)
        for what, value, unit in (("tach", rpm, "RPM"), ("pwm", percent, "%"))
    }
    return {CHASSIS: {"Sensors": link(there)}, there: {"Members": list(map(link, each))}, **each}


def _metrics(fans: list[tuple[float, float]]) -> dict[str, Any]:
    there = f"{CHASSIS}/EnvironmentMetrics"
    each = [{"DeviceName": f"Chassis Fan {n}", "SpeedRPM": rpm} for n, (_, rpm) in enumerate(fans, 1)]
    oem = {"/redfish/v1/Oem/Fans": {"Duty": fans[0][0]}}
    return {CHASSIS: {"EnvironmentMetrics": link(there)}, there: {"FanSpeedsPercent": each}, **oem}


class Connection(asyncio.Protocol):
    """One client."""

    def __init__(self, hall: Hall, number: int) -> None:
        self._hall, self._number, self._waiting = hall, number, b""
        self._transport: Any = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep it."""
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Answer requests that are complete; none has a body."""
        self._waiting += data
        while b"\r\n\r\n" in self._waiting:
            head, _, self._waiting = self._waiting.partition(b"\r\n\r\n")
            if self._number in self._hall.plan.silent:
                return
            wait_s = SLOW_S if self._number in self._hall.plan.slow else 0.0
            asyncio.get_running_loop().call_later(wait_s, self._answer, head.split()[1].decode())

    def _answer(self, path: str) -> None:
        status, found = self._hall.answer(self._number, path)
        body = json.dumps(found).encode()
        head = f"HTTP/1.1 {status} X\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        self._transport.write(head.encode() + body)


async def serve(plan: Plan) -> None:
    """Serve all but the dead ones, until the process ends."""
    hall, loop, tls = Hall(plan), asyncio.get_running_loop(), None
    if plan.certificate:
        tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        tls.load_cert_chain(Path(plan.certificate))
    for number in sorted(set(range(plan.controllers)) - set(plan.dead)):
        await loop.create_server(lambda n=number: Connection(hall, n), plan.address(number), plan.port, ssl=tls)
    print("serving", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(Plan(**json.loads(sys.argv[1]))))
