"""A baseboard controller with four fans, for trying: python controller.py [PORT]."""

from __future__ import annotations

import json
import math
import random
import sys
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

FANS = 4
CHASSIS = "/redfish/v1/Chassis/1U"
THERMAL = f"{CHASSIS}/ThermalSubsystem"


def link(path: str) -> dict[str, str]:
    """How Redfish names another resource."""
    return {"@odata.id": path}


def fan(number: int) -> dict[str, Any]:
    """A fan now: its duty follows a load that rises and falls within two minutes."""
    percent = 50 + 30 * math.sin(time.monotonic() / 20 + number / 4)
    rpm = round(random.gauss(160 * percent, 20))
    return {
        "Id": str(number),
        "Name": f"FAN{number}",
        "SpeedPercent": {"Reading": round(rpm / 160), "SpeedRPM": rpm},
        "SpeedControlPercent": {"SetPoint": round(percent)},
        "Status": {"State": "Enabled"},
    }


def document(path: str) -> dict[str, Any] | None:
    """The resource at a path; None if there is none."""
    fans = {f"{THERMAL}/Fans/{number}": number for number in range(1, FANS + 1)}
    if path in fans:
        return fan(fans[path])
    return {
        "/redfish/v1": {"Id": "Root", "RedfishVersion": "1.15.0", "Chassis": link("/redfish/v1/Chassis")},
        "/redfish/v1/Chassis": {"Members": [link(CHASSIS)]},
        CHASSIS: {"Id": "1U", "ThermalSubsystem": link(THERMAL)},
        THERMAL: {"Id": "ThermalSubsystem", "Fans": link(f"{THERMAL}/Fans")},
        f"{THERMAL}/Fans": {"Members": [link(each) for each in fans]},
    }.get(path)


class Handler(BaseHTTPRequestHandler):
    """Answers with the documents above."""

    def do_GET(self) -> None:
        """One document."""
        found = document(self.path.rstrip("/"))
        body = json.dumps(found or {}).encode()
        self.send_response(404 if found is None else 200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: it is asked every second."""


if __name__ == "__main__":
    port = int(sys.argv[1]) if len(sys.argv) > 1 else 8000
    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    print(f"a controller listens on http://127.0.0.1:{port}", file=sys.stderr, flush=True)
    server.serve_forever()
