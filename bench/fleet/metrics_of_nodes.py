"""Hundreds of exporters in one process, as one target a node, for benches.

Five exporters in turn, with the names that they really use. Fans follow their command with a lag of two seconds. From a
time on some nodes are dead, silent, broken or lie, and some fans are slower:

    python -m bench.fleet.metrics_of_nodes '{"port": 9100, "controllers": 400}'
"""

from __future__ import annotations

import json
import math
import random
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple

BAD = ("dead", "silent", "broken", "lying")
FANS = 2
SILENT_S = 60.0
RPM_PER_PERCENT, LAG_S, NOISE_RPM = 150.0, 2.0, 15.0
SPEED_LOSS = 0.15


@dataclass
class Plan:
    """What is served. Lists: numbers of nodes."""

    port: int
    controllers: int
    broken: list[int] = field(default_factory=list[int])
    silent: list[int] = field(default_factory=list[int])
    lying: list[int] = field(default_factory=list[int])
    dead: list[int] = field(default_factory=list[int])
    faulty: list[int] = field(default_factory=list[int])
    """those whose first fan becomes slower"""


class Exporter(NamedTuple):
    """Lines of a page: of the speed and of the command of a fan, in per cent times `scale`. command: its series where
    `init` cannot know it."""

    speed: str
    value: str
    command: str = ""
    scale: float = 1.0


EXPORTERS = {
    "node_exporter": Exporter(
        'node_hwmon_fan_rpm{{chip="platform_nct6775_656",sensor="fan{0}"}}',
        'node_hwmon_pwm{{chip="platform_nct6775_656",sensor="pwm{0}"}}',
        scale=2.55,
    ),
    "ipmi_exporter": Exporter(
        'ipmi_fan_speed_rpm{{id="{0}",name="FAN{0}_TACH"}}',
        'ipmi_fan_speed_ratio{{id="1{0}",name="FAN{0}_PWM"}}',
        'ipmi_fan_speed_ratio{{name="FAN{0}_PWM"}}',
        scale=0.01,
    ),
    "idrac_exporter": Exporter(
        'idrac_sensors_fan_speed{{id="{0}",name="System Board Fan{0}",units="rpm"}}',
        'idrac_sensors_temperature{{id="{0}",name="Inlet {0}",units="celsius"}}',
        'idrac_sensors_temperature{{id="{0}",units="celsius"}}',
    ),
    "snmp_exporter": Exporter(
        'entSensorValue{{entPhysicalIndex="{0}",entPhysicalName="Fan {0}",entSensorType="10"}}',
        'entSensorValue{{entPhysicalIndex="1{0}",entPhysicalName="Inlet {0}",entSensorType="8"}}',
        'entSensorValue{{entPhysicalName="Inlet {0}",entSensorType="8"}}',
    ),
    "telegraf": Exporter(
        'ipmi_sensor_value{{name="fan_{0}",server="bmc",unit="rpm"}}',
        'ipmi_sensor_value{{name="pwm_{0}",server="bmc",unit="percent"}}',
        'ipmi_sensor_value{{name="pwm_{0}",unit="percent"}}',
    ),
}


def fan_at(number: int, fan: int, now_s: float) -> tuple[float, float]:
    """Command in per cent and speed in rpm of a fan of a node at a time."""
    pace = 2.0 * math.pi / (120.0 + number % 7)
    phase = number / 3.0 + fan
    lagging = math.atan(pace * LAG_S)
    moved = 55.0 + 30.0 * math.cos(lagging) * math.sin(pace * now_s + phase - lagging)
    rpm = RPM_PER_PERCENT * moved + random.gauss(0.0, NOISE_RPM)
    return round(55.0 + 30.0 * math.sin(pace * now_s + phase)), round(rpm)


def page(number: int, *, is_bad: Callable[[str], bool]) -> str:
    """What the exporter of a node shows."""
    exporter = list(EXPORTERS.values())[number % len(EXPORTERS)]
    lines: list[str] = []
    for fan in range(FANS):
        command, rpm = fan_at(number, fan, time.time())
        if is_bad("faulty") and fan == 0:
            rpm = round(rpm * (1.0 - SPEED_LOSS))
        if is_bad("broken") and fan == FANS - 1:
            rpm = float("nan")
        lines += [f"{exporter.speed.format(fan + 1)} {1e9 if is_bad('lying') else rpm}"]
        lines += [f"{exporter.value.format(fan + 1)} {command * exporter.scale:g}"]
    return "\n".join([*lines, ""])


def serve(plan: Plan, bad_from: Path) -> None:
    """Serve all nodes, `/metrics?node=7`. bad_from: the bad and faulty ones are so once this file exists."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            number = int(self.path.rpartition("=")[2])

            def is_bad(kind: str) -> bool:
                return number in getattr(plan, kind) and bad_from.exists()

            if is_bad("silent"):
                time.sleep(SILENT_S)
            body = page(number, is_bad=is_bad).encode()
            self.send_response(500 if is_bad("dead") else 200)
            self.send_header("Content-Type", "text/plain; version=0.0.4")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            with suppress(BrokenPipeError):
                self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", plan.port), Handler)
    server.daemon_threads = True
    print("serving", flush=True)
    server.serve_forever()


if __name__ == "__main__":
    serve(Plan(**json.loads(sys.argv[1])), Path(sys.argv[2]))
