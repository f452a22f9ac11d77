"""A baseboard controller on loopback: an HTTP server with the resources that a test gives it."""

from __future__ import annotations

import base64
import json
import ssl
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, TypeAlias

ROOT = "/redfish/v1"
CHASSIS = f"{ROOT}/Chassis/1U"
Answer: TypeAlias = Mapping[str, Any] | bytes | int | None
"""an object, a body that is none, the status of a refusal; None: 404"""


def link(path: str) -> dict[str, str]:
    """How Redfish names another resource."""
    return {"@odata.id": path}


def with_fans(fans: Mapping[str, Mapping[str, Any]], others: Mapping[str, Answer] | None = None) -> dict[str, Answer]:
    """The documents of a controller with fans in ThermalSubsystem, by id, and others over or beside them."""
    subsystem = f"{CHASSIS}/ThermalSubsystem"
    return {
        CHASSIS: {"Id": "1U", "ThermalSubsystem": link(subsystem)},
        subsystem: {"Fans": link(f"{subsystem}/Fans")},
        f"{subsystem}/Fans": {"Members": [link(f"{subsystem}/Fans/{name}") for name in fans]},
        **{f"{subsystem}/Fans/{name}": {"Id": name, **fan} for name, fan in fans.items()},
        **(others or {}),
    }


def with_thermal(*fans: Mapping[str, Any]) -> dict[str, Answer]:
    """The documents of a controller with fans in Thermal."""
    thermal = f"{CHASSIS}/Thermal"
    return {
        CHASSIS: {"Id": "1U", "Thermal": link(thermal)},
        thermal: {"Fans": list(fans), "Temperatures": [{"Name": "Inlet Temp", "ReadingCelsius": 23.5}]},
    }


class Documents:
    """A controller that answers with given documents; its users, what it was asked, and whether it answers now."""

    def __init__(self, documents: Mapping[str, Answer], *, user: str = "", password: str = "") -> None:
        self.documents = {
            f"{ROOT}/Chassis": {"Members": [link(each) for each in documents if each.count("/") == 4]},
            **documents,
        }
        self.user, self.password = user, password
        self.has_sessions = False
        self.may_answer = threading.Event()
        self.may_answer.set()
        self.status = 200
        self.asked: list[str] = []
        self.ended: list[str] = []
        """sessions that were ended"""

    def document(self, path: str) -> Answer:
        """The resource at a path; None if there is none."""
        if path == f"{ROOT}/":
            return {"Id": "Root", "RedfishVersion": "1.6.0", "Chassis": link(f"{ROOT}/Chassis")}
        return self.documents.get(path)


class Controller(Documents):
    """Two fans by the older or the newer schema, which a test changes while it is asked."""

    def __init__(self, *, is_new: bool, user: str = "", password: str = "") -> None:
        super().__init__({}, user=user, password=password)
        self.is_new = is_new
        self.rpm = [4000, 4200]
        self.percent: list[int | None] = [40, 42]

    def document(self, path: str) -> Answer:
        """The resource at a path; None if there is none."""
        rack = f"{ROOT}/Chassis/Rack"
        self.documents = {
            f"{ROOT}/Chassis": {"Members": [link(CHASSIS), link(rack)]},
            rack: {"Id": "Rack"},
            **(self._new() if self.is_new else self._old()),
        }
        return super().document(path)

    def _old(self) -> dict[str, Answer]:
        return with_thermal(
            *(
                {"MemberId": str(n), "FanName": f"FAN{n + 1}", "Reading": rpm, "ReadingUnits": "RPM"}
                | ({"Oem": {"Vendor": {"PWM": percent}}} if percent is not None else {})
                for n, (rpm, percent) in enumerate(zip(self.rpm, self.percent, strict=True))
            )
        )

    def _new(self) -> dict[str, Answer]:
        subsystem = f"{CHASSIS}/ThermalSubsystem"
        places = ({"Location": {"PartLocation": {"ServiceLabel": "Fan bay 1"}}}, {"PhysicalContext": "Intake"})
        fans = {
            str(n + 1): {
                "Name": f"FAN{n + 1}",
                "SpeedPercent": {"Reading": rpm / 100, "SpeedRPM": rpm},
                "SpeedControlPercent": {"SetPoint": percent},
                "Status": {"State": "Enabled"},
                **place,
            }
            for n, (rpm, percent, place) in enumerate(zip(self.rpm, self.percent, places, strict=True))
        }
        links = {name: link(f"{subsystem}/{name}") for name in ("Fans", "ThermalMetrics")}
        metrics = {"TemperatureSummaryCelsius": {"Intake": {"Reading": 22.0}}}
        return with_fans(fans, {subsystem: links, f"{subsystem}/ThermalMetrics": metrics})


@contextmanager
def redfish_server(controller: Documents, tls: ssl.SSLContext | None = None) -> Iterator[str]:
    """Serve it; gives its URL."""
    sessions = f"{ROOT}/SessionService/Sessions"

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        wbufsize = -1  # an answer in one packet

        def do_GET(self) -> None:
            controller.asked.append(self.path)
            controller.may_answer.wait()
            if self.path == f"{ROOT}/":
                self._answer(200, controller.document(self.path))
            elif not self._is_let_in():
                self._answer(401, {})
            else:
                self._answer(controller.status, controller.document(self.path))

        def do_POST(self) -> None:
            said = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            if not controller.has_sessions or self.path != sessions:
                self._answer(405, {})
            elif said != {"UserName": controller.user, "Password": controller.password}:
                self._answer(401, {})
            else:
                self._answer(201, {}, {"X-Auth-Token": "token", "Location": f"{sessions}/7"})

        def do_DELETE(self) -> None:
            controller.ended.append(self.path)
            self._answer(204, b"")

        def _is_let_in(self) -> bool:
            if controller.has_sessions:
                return self.headers.get("X-Auth-Token") == "token"
            expected = base64.b64encode(f"{controller.user}:{controller.password}".encode()).decode()
            return not controller.user or self.headers.get("Authorization") == f"Basic {expected}"

        def _answer(self, status: int, document: Answer, headers: Mapping[str, str] | None = None) -> None:
            if document is None or isinstance(document, int):
                status, document = document or 404, {}
            body = document if isinstance(document, bytes) else json.dumps(document).encode()
            self.send_response(status)
            for name, value in {"Content-Type": "application/json", **(headers or {})}.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    if tls:
        server.socket = tls.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    try:
        yield f"{'https' if tls else 'http'}://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join(5.0)
        server.server_close()
