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

from fantwin.pipeline.sources.push.source import PushSource
from fantwin.pipeline.sources.source import SampleSource, SourceEvent
from fantwin.schemas.header import Header
from fantwin.schemas.messages import PushedSamples
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.schemas.wire import Sample, encode
from tests.support.hwmon_trees import add_chip
from tests.support.made_messages import filled
from tests.support.modbus_server import modbus_server
from tests.support.mqtt_broker import MqttBroker
from tests.support.ports import free_port
from tests.support.redfish_server import Controller, redfish_server

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


WORLDS: dict[str, type[World]] = {
    "serial": SerialWorld,
    "mqtt": MqttWorld,
    "http": HttpWorld,
    "push": PushWorld,
    "hwmon": HwmonWorld,
    "modbus": ModbusWorld,
    "redfish": RedfishWorld,
}
