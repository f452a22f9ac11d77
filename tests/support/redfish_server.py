"""A baseboard controller on loopback: a small HTTP server with the older and the newer schema of fans."""

from __future__ import annotations

import base64
import json
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

ROOT = "/redfish/v1"


class Controller:
    """Its fans, which a test changes while it is asked."""

    def __init__(self, *, is_new: bool, user: str = "", password: str = "") -> None:
        self.is_new, self.user, self.password = is_new, user, password
        self.rpm = [4000, 4200]
        self.percent: list[int | None] = [40, 42]
        self.may_answer = threading.Event()
        self.may_answer.set()
        self.status = 200
        self.asked: list[str] = []

    def document(self, path: str) -> dict[str, Any] | None:
        """The resource at a path; None if there is none."""
        chassis = f"{ROOT}/Chassis/1U"
        if path == f"{ROOT}/":
            return {"Id": "Root", "RedfishVersion": "1.6.0", "Chassis": {"@odata.id": f"{ROOT}/Chassis"}}
        if path == f"{ROOT}/Chassis":
            return {"Members": [{"@odata.id": chassis}, {"@odata.id": f"{ROOT}/Chassis/Rack"}]}
        if path == f"{ROOT}/Chassis/Rack":
            return {"Id": "Rack"}
        if path == chassis:
            kind = "ThermalSubsystem" if self.is_new else "Thermal"
            return {"Id": "1U", kind: {"@odata.id": f"{chassis}/{kind}"}}
        return self._new(path, f"{chassis}/ThermalSubsystem") if self.is_new else self._old(path, f"{chassis}/Thermal")

    def _old(self, path: str, thermal: str) -> dict[str, Any] | None:
        if path != thermal:
            return None
        fans = [
            {"MemberId": str(n), "FanName": f"FAN{n + 1}", "Reading": rpm, "ReadingUnits": "RPM"}
            | ({"Oem": {"Vendor": {"PWM": percent}}} if percent is not None else {})
            for n, (rpm, percent) in enumerate(zip(self.rpm, self.percent, strict=True))
        ]
        return {"Fans": fans, "Temperatures": [{"Name": "Inlet Temp", "ReadingCelsius": 23.5}]}

    def _new(self, path: str, subsystem: str) -> dict[str, Any] | None:
        fan_paths = [f"{subsystem}/Fans/{n + 1}" for n in range(len(self.rpm))]
        if path == subsystem:
            links = {name: {"@odata.id": f"{subsystem}/{name}"} for name in ("Fans", "ThermalMetrics")}
            return {"Id": "ThermalSubsystem", **links}
        if path == f"{subsystem}/ThermalMetrics":
            return {"TemperatureSummaryCelsius": {"Intake": {"Reading": 22.0}}}
        if path == f"{subsystem}/Fans":
            return {"Members": [{"@odata.id": each} for each in fan_paths]}
        if path in fan_paths:
            n = fan_paths.index(path)
            speed = {"Reading": self.percent[n], "SpeedRPM": self.rpm[n]}
            return {"Id": str(n + 1), "Name": f"FAN{n + 1}", "SpeedPercent": speed, "Status": {"State": "Enabled"}} | (
                {"PhysicalContext": "Intake"} if n else {"Location": {"PartLocation": {"ServiceLabel": "Fan bay 1"}}}
            )
        return None


@contextmanager
def redfish_server(controller: Controller, tls: ssl.SSLContext | None = None) -> Iterator[str]:
    """Serve it; gives its URL."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            controller.asked.append(self.path)
            controller.may_answer.wait()
            expected = base64.b64encode(f"{controller.user}:{controller.password}".encode()).decode()
            is_let_in = not controller.user or self.headers.get("Authorization") == f"Basic {expected}"
            document = controller.document(self.path)
            status = controller.status if self.path != f"{ROOT}/" else 200
            if self.path != f"{ROOT}/" and not is_let_in:
                status = 401
            self._answer(404 if document is None else status, document or {})

        def do_POST(self) -> None:
            self._answer(405, {})

        def _answer(self, status: int, document: dict[str, Any]) -> None:
            body = json.dumps(document).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    if tls:
        server.socket = tls.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"{'https' if tls else 'http'}://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join(5.0)
        server.server_close()
