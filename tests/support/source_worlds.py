"""The far end of each kind of source: a device of two fans that is plugged in, shows a sample, sends nonsense, is gone.

A speed of a sample is 100 times its number, and 1 more for the second fan, in rpm.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import tty
import urllib.error
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion
from pymodbus.constants import ExcCodes

from fantwin.pipeline.sources.ipmi import source as ipmi_source
from fantwin.pipeline.sources.push.source import PushSource
from fantwin.pipeline.sources.source import SampleSource, SourceEvent
from fantwin.schemas.header import Header
from fantwin.schemas.messages import PushedSamples
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.schemas.wire import Sample, encode
from tests.support.hwmon_trees import add_chip
from tests.support.made_messages import filled
from tests.support.metrics_server import Metrics, metrics_server
from tests.support.modbus_server import modbus_server
from tests.support.mqtt_broker import MqttBroker
from tests.support.ports import free_port
from tests.support.redfish_server import Controller, redfish_server
from tests.support.snmp_agent import COMMUNITY, Agent, snmp_agent

COMMAND = 0.5
POLLED = {"period_s": 0.02}


class World:
    """Base of all kinds. A device is gone until it is plugged in."""

    settings: dict[str, Any]
    dies = True
    """the device can vanish while its source runs"""
    says_once = True
    """an attempt that fails like the one before is not reported again"""
    command = COMMAND

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.stack = ExitStack()

    def plug_in(self) -> None:
        """Make the device reachable."""

    def unplug(self) -> None:
        """Take it away again."""
        self.stack.close()

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        """Send a sample, or let the next poll read it."""
        raise NotImplementedError

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        """Send, or let the next poll read, what is no sample."""
        raise NotImplementedError


def speeds_of(number: int) -> tuple[float, float]:
    """Speeds of the two fans in rpm."""
    return 100.0 * number, 100.0 * number + 1.0


def json_sample(number: int) -> bytes:
    """A sample as text."""
    sample = {"t": 1_790_000_000 + number, "command": [COMMAND] * 2, "speed": speeds_of(number), "sequence": number}
    return json.dumps(sample).encode()


class SerialWorld(World):
    """A pseudo-terminal."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.path = folder / "ttyFAN"
        self.settings = {"port": str(self.path)}

    def plug_in(self) -> None:
        self.far, near = os.openpty()
        tty.setraw(near)
        self.path.symlink_to(os.ttyname(near))
        for undo in (lambda: os.close(near), lambda: os.close(self.far), self.path.unlink):
            self.stack.callback(undo)

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        os.write(self.far, encode("binary", Sample(number, number, (COMMAND,) * 2, speeds_of(number))))

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        os.write(self.far, b"\0no frame\0")


class MqttWorld(World):
    """A real broker, and a client that publishes."""

    says_once = False

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.broker = MqttBroker()
        self.settings = {"url": f"mqtt://127.0.0.1:{self.broker.port}", "topic": "plant/tray1"}

    def plug_in(self) -> None:
        self.broker.start()
        self.client = paho.Client(CallbackAPIVersion.VERSION2)
        self.client.connect("127.0.0.1", self.broker.port)
        self.client.loop_start()
        for undo in (self.broker.stop, self.client.loop_stop, self.client.disconnect):
            self.stack.callback(undo)

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self._publish(json_sample(number))

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self._publish(b'{"t": 1.0')

    def _publish(self, text: bytes) -> None:
        self.client.publish("plant/tray1", text, 1).wait_for_publish(10)


class HttpWorld(World):
    """A client of the source's own server; what can be gone is the port, which another program has."""

    dies = says_once = False

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.port = free_port()
        self.settings = {"port": self.port}
        self.stack.enter_context(socket.create_server(("127.0.0.1", self.port)))

    def plug_in(self) -> None:
        self.stack.close()

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self._post(json_sample(number))

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self._post(json_sample(1).replace(b'"speed"', b'"rpm"'))

    def _post(self, text: bytes) -> None:
        url = f"http://127.0.0.1:{self.port}/v1/trays/tray1/samples"
        with suppress(urllib.error.URLError):
            urllib.request.urlopen(urllib.request.Request(url, text), timeout=10).close()


class PushWorld(World):
    """A client on the bus, from which acquisition hands the source what comes."""

    dies = False

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.settings = {}

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self._push([number], source, deliver)

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self._push([7, 7], source, deliver)

    def _push(self, numbers: list[int], source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        assert isinstance(source, PushSource)
        t_ns = np.array(numbers, np.int64) * 1_000_000_000
        about = {"header": Header("client-1", numbers[0], "tray1"), "first_number": numbers[0]}
        about |= {"t_ns": t_ns, "newest_t_ns": int(t_ns[-1]), "command": COMMAND}
        speed_rad_s = np.array([speeds_of(number) for number in numbers]) * RAD_S_PER_UNIT["rpm"]
        message = filled(PushedSamples, len(numbers), 2, speed_rad_s=speed_rad_s, **about)
        for event in source.events(message, int(t_ns[-1])):
            deliver(event)


class HwmonWorld(World):
    """A tree of files."""

    command = 128.0

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.settings = {"chip": "emc2305", "root": str(folder / "hwmon"), **POLLED}
        (folder / "hwmon").mkdir()
        self.number = 0

    def plug_in(self) -> None:
        files: dict[str, int | str] = {"fan1_input": 0, "fan2_input": 0, "pwm1": 128, "pwm2": 128}
        self.chip = add_chip(self.folder / "hwmon", self.number, "emc2305", f"i2c-{self.number}", files)
        self.number += 1
        self.stack.callback(shutil.rmtree, self.chip)

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        speeds = {f"fan{fan}_input": f"{rpm:.0f}" for fan, rpm in enumerate(speeds_of(number), 1)}
        for name, text in {**speeds, "pwm1": "128"}.items():  # never a moment without content
            new = self.chip / "new"
            new.write_text(f"{text}\n")
            new.rename(self.chip / name)

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        (self.chip / "pwm1").write_text("\n")


class ModbusWorld(World):
    """A server with four registers."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.port = free_port()
        scaled = {"scale": 0.001}
        fans = [{"speed": {"address": fan}, "command": {"address": 10 + fan, **scaled}, "unit": 3} for fan in (0, 1)]
        self.settings = {"line": f"127.0.0.1:{self.port}", "fan": fans, **POLLED}
        self.speeds, self.refuses = (0.0, 0.0), False

    async def access(self, _function: int, start: int, address: int, count: int, registers: list[int], values: Any):
        """Show the registers, or refuse those of the commands."""
        if self.refuses and address + count > 10:
            return ExcCodes.ILLEGAL_ADDRESS
        for register, value in ((0, self.speeds[0]), (1, self.speeds[1]), (10, 500), (11, 500)):
            registers[register - start] = round(value)
        return None

    def plug_in(self) -> None:
        self.stack.enter_context(modbus_server({3: self}, self.port))  # type: ignore[dict-item]

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self.speeds, self.refuses = speeds_of(number), False

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self.refuses = True


class RedfishWorld(World):
    """A controller, which is gone while it refuses every request."""

    command = 40.0

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.controller = Controller(is_new=True)
        self.controller.percent = [40, 40]
        self.controller.status = 503
        self.settings = {"url": self.stack.enter_context(redfish_server(self.controller)), **POLLED}

    def plug_in(self) -> None:
        self.controller.status = 200

    def unplug(self) -> None:
        self.controller.status = 503

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self.controller.rpm = [round(speed) for speed in speeds_of(number)]
        self.controller.percent = [40, 40]

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self.controller.percent = [None, None]


class ExecWorld(World):
    """A program that prints what comes through a pipe."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.settings = {"program": ["./fans", "--of", "tray 1"]}
        self.pipe = folder / "pipe"
        os.mkfifo(self.pipe)

    def plug_in(self) -> None:
        program = self.folder / "fans"
        program.write_text("#!/bin/sh\nsed 's/^/ /' first\nexec cat pipe\n")
        program.chmod(0o755)
        (self.folder / "first").write_bytes(json_sample(0) + b"\n")
        self.far = os.open(self.pipe, os.O_RDWR)
        for undo in (program.unlink, lambda: os.close(self.far)):
            self.stack.callback(undo)

    def unplug(self) -> None:
        (self.folder / "fans").chmod(0)
        super().unplug()

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        os.write(self.far, json_sample(number) + b"\n")

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        os.write(self.far, b"Traceback (most recent call last):\n")


class PrometheusWorld(World):
    """A Prometheus, which is gone while it refuses every query."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.metrics = Metrics()
        self.metrics.status = 503
        url = self.stack.enter_context(metrics_server(self.metrics))
        fans = [{"speed": f'rpm{{fan="{fan}"}}', "command": f'pwm{{fan="{fan}"}}'} for fan in "ab"]
        self.settings = {"url": url, "fan": fans, **POLLED}
        self._show(0)

    def plug_in(self) -> None:
        self.metrics.status = 200

    def unplug(self) -> None:
        self.metrics.status = 503

    def _show(self, number: int) -> None:
        self.metrics.series = [
            ({"__name__": name, "fan": fan}, [(1_790_000_000.5 + number, str(value))])
            for fan, rpm in zip("ab", speeds_of(number), strict=True)
            for name, value in (("rpm", rpm), ("pwm", COMMAND))
        ]

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self.metrics.text = ""
        self._show(number)

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self.metrics.text = "<html>"


class IpmiWorld(World):
    """An ipmitool of our own, in the place of the real one."""

    command = 40.0

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.program = folder / "ipmitool"
        self.stack.callback(setattr, ipmi_source, "PROGRAM", ipmi_source.PROGRAM)
        ipmi_source.PROGRAM = str(self.program)
        self.settings = {"fan": [{"speed": name, "command": "PWM1"} for name in ("FAN1", "FAN2")], **POLLED}
        self._show(speeds_of(0), "RPM")

    def plug_in(self) -> None:
        new = self.folder / "new"
        new.write_text("#!/bin/sh\nexec cat sensors\n".replace("sensors", str(self.folder / "sensors")))
        new.chmod(0o755)
        new.rename(self.program)

    def unplug(self) -> None:
        self.program.unlink()

    def _show(self, speeds: tuple[float, float], unit: str) -> None:
        new = self.folder / "new-sensors"
        lines = [f"FAN{n} | 4{n}h | ok | 29.{n} | {rpm:.0f} {unit}" for n, rpm in enumerate(speeds, 1)]
        new.write_text("\n".join([*lines, "PWM1 | 50h | ok | 7.1 | 40 percent\n"]))
        new.rename(self.folder / "sensors")

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self._show(speeds_of(number), "RPM")

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self._show(speeds_of(1), "percent")


class SnmpWorld(World):
    """An agent; what is no sample are objects that are not there."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.port, self.agent = free_port(), Agent()
        (folder / "community").write_text(f"{COMMUNITY}\n")
        (folder / "community").chmod(0o600)
        command = {"name": ".1.3.6.1.4.2", "scale": 0.01}
        fans = [{"speed": f"1.3.6.1.4.1.{fan}", "command": command} for fan in (0, 1)]
        self.settings = {"host": f"127.0.0.1:{self.port}", "community_file": "community", "fan": fans, **POLLED}
        self._show(0)

    def plug_in(self) -> None:
        self.stack.enter_context(snmp_agent(self.agent, self.port))

    def _show(self, number: int) -> None:
        speeds = {f"1.3.6.1.4.1.{fan}": round(rpm) for fan, rpm in enumerate(speeds_of(number))}
        self.agent.objects = {**speeds, "1.3.6.1.4.2": 50}

    def show(self, number: int, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self._show(number)

    def garble(self, source: SampleSource, deliver: Callable[[SourceEvent], None]) -> None:
        self.agent.objects = {}


WORLDS: dict[str, type[World]] = {
    "serial": SerialWorld,
    "mqtt": MqttWorld,
    "http": HttpWorld,
    "push": PushWorld,
    "hwmon": HwmonWorld,
    "modbus": ModbusWorld,
    "redfish": RedfishWorld,
    "exec": ExecWorld,
    "prometheus": PrometheusWorld,
    "ipmi": IpmiWorld,
    "snmp": SnmpWorld,
}
