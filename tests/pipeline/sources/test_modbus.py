"""Fans behind Modbus, against pymodbus's own server with a simulated rotor behind its registers."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusUdpServer

from fantwin.pipeline.cli.watch.line_check import check_line
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.sources.found import as_toml
from fantwin.pipeline.sources.modbus.config import ModbusConfig
from fantwin.pipeline.sources.modbus.models import MODELS, input_register
from fantwin.pipeline.sources.modbus.source import ModbusSource, refusal
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.source import SourceContext
from fantwin.schemas import channels as of
from fantwin.schemas.fan_names import FanNames
from fantwin.simulation.tray import SimulatedTray, TraySettings
from tests.support.delivered import Delivered
from tests.support.modbus_server import (
    COMMAND,
    CURRENT,
    REFUSED,
    SPEED,
    TEMPERATURE,
    VOLTAGE,
    WANTED,
    Drive,
    SerialLine,
    modbus_line,
    modbus_server,
)
from tests.support.running_chain import eventually

FAN: dict[str, Any] = {
    "unit": 3,
    "speed": {"address": SPEED, "scale": 2.0},
    "command": {"address": COMMAND, "scale": 0.001},
    "write": {"address": WANTED, "scale": 0.001},
    "current": {"address": CURRENT, "type": "f32"},
    "supply_voltage": {"address": VOLTAGE, "type": "u32", "word_order": "little", "scale": 0.001},
    "temperature": {"address": TEMPERATURE, "type": "s16", "scale": 0.1, "offset": 30.0},
}


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fantwin.pipeline.sources.modbus.source.TIMEOUT_S", 5.0)


def drive() -> Drive:
    return Drive(SimulatedTray(TraySettings(fans=1, rate_hz=100.0)))


NAMES = FanNames(("CPU", "rear"))


def config(port: int, *fans: dict[str, Any], **settings: Any) -> ModbusConfig:
    return ModbusConfig.model_validate({"line": f"127.0.0.1:{port}", "fan": fans or (FAN,), **settings})


def device(port: int, *fans: dict[str, Any], **settings: Any) -> ModbusSource:
    made = ModbusSource(config(port, *fans, **settings), SourceContext(len(fans) or 1, "rpm", Path(), names=NAMES))
    made.connect()
    return made


def test_what_a_drive_refuses_is_nan_or_an_error_and_a_command_must_be_there() -> None:
    without = {key: value for key, value in FAN.items() if key != "write"}
    with modbus_server({3: drive()}) as port:
        made = device(port, FAN | {"speed": {"address": REFUSED}})
        assert math.isnan(made.read().speed[0])
        made.disconnect()
        made = device(port, FAN | {"command": {"address": REFUSED, "table": "input"}})
        with pytest.raises(DeviceError, match=r"of CPU \(fan 0\) cannot be read: unit 3 refuses input register 200"):
            made.read()
        made.disconnect()
        made = device(port)
        wrong = r"unit 3 refuses 1.5 for register 100 \(exception 3: it does not take this value, .*\); correct write"
        with pytest.raises(DeviceError, match=wrong):
            made.write((1.5,))
        with pytest.raises(DeviceError, match=r"-10 does not fit into u16 of register 100"):
            made.write((-0.01,))
        made.disconnect()
        made = device(port, FAN, without)
        with pytest.raises(DeviceError, match=r"^rear \(fan 1\) has no register for commands"):
            made.write((math.nan, 0.5))
        made.disconnect()
        assert config(port, without).why_no_commands == "no fan of its source has a register `write`"


def test_doctor_names_the_setting_of_a_speed_that_is_none_and_what_was_read() -> None:
    """Five fans of one device, of which one is right: word order, scale, a register of something else, none at all."""
    plain = {"command": FAN["command"], "unit": 3}
    fans = [
        FAN,
        plain | {"speed": {"address": VOLTAGE, "type": "u32", "scale": 0.001}},
        plain | {"speed": {"address": SPEED, "scale": 20.0}},
        plain | {"speed": {"address": WANTED + 1}},
        plain | {"speed": {"address": 40_200}},
    ]
    with modbus_server({3: drive()}) as port:
        tray = {
            "name": "ahu",
            "fan": [{"name": name} for name in ("right", "order", "scale", "still", "none")],
            "speed_unit": "rpm",
            "speed_max": 4000.0,
            "source": {"kind": "modbus", "line": f"127.0.0.1:{port}", "fan": fans},
        }
        settings = parse_config(f"tray = [{as_toml(tray)}]", Path("fantwin.toml"), (), ("acquisition", "resampler"))
        context = Context("site", settings.trays, settings.sections["acquisition"], Path(), Path(), 0)
        found = check_line(context, settings, 1.0, is_running=False)
    by_kind = {
        kind: [line.removeprefix("ahu: ") for each, line in found if each is kind] for kind in (True, None, False)
    }
    order, scale, none = by_kind[False]
    assert order.startswith("order (fan 1): holding register 14 (u32) holds 0x3e5a 0x0008, which is 1.05e+06 rpm: ")
    assert order.endswith('rpm: word_order = "little" makes it 540 rpm')
    assert re.fullmatch(r"scale \(fan 2\): .*: scale = 2 makes it \d+ rpm", scale)
    prefix = "no speed of none (fan 4): unit 3 refuses holding register 40200 (exception 2: it has no such register; "
    assert none == f"{prefix}addresses begin at 0 and have no leading 4: 200, or 199)"
    (still,) = by_kind[None]
    assert re.match(r"still \(fan 3\) reads 0 at command 0\.\d+: does it turn\? \(holding register 101 ", still)
    assert [line.split(":")[0] for line in by_kind[True] if ", speeds" in line] == ["right (fan 0)"]
    gone = check_line(context, settings, 1.0, is_running=False)
    assert [(ok, line.endswith("cannot be opened or reached")) for ok, line in gone] == [(False, True)]


@pytest.mark.parametrize(
    ("written", "address", "code", "line"),
    [
        (None, 3, 1, "exception 1: it does not know this function); correct table"),
        (None, 3, 3, "exception 3: it does not take this value, or so many registers); correct most_registers"),
        (0.5, 3, 2, "exception 2: it has no such register); correct write"),
        (0.5, 3, 4, "exception 4: it has failed to do it)"),
        (None, 3, 6, "exception 6: it is busy); correct period_s"),
        (None, 3, 11, "exception 11: the unit does not answer the gateway); correct unit"),
        (None, 3, 99, "exception 99: see its manual)"),
        (
            None,
            30_012,
            2,
            "exception 2: it has no such register; addresses begin at 0 and have no leading 3: 12, or 11)",
        ),
    ],
)
def test_exceptions_are_said_in_words_with_the_setting(
    written: float | None, address: int, code: int, line: str
) -> None:
    what = f"holding register {address}" if written is None else f"{written} for register {address}"
    assert refusal(7, "holding", address, code, written) == f"unit 7 refuses {what} ({line}"


class Limited:
    """A device of one fan, like an ebm-papst of 1,500 rpm at half its speed, that knows less than others.

    functions: that it knows. most: registers in a request.
    """

    def __init__(self, functions: tuple[int, ...] = (3, 4, 6, 16), most: int = 125) -> None:
        self.functions, self.most = functions, most
        self.registers = {(4, 0xD010): 32_000, (4, 0xD019): 16_384, (3, 0xD119): 1500, (3, 0xD001): 0}
        self.asked: list[tuple[int, int, int]] = []
        self.count = 0x10000

    async def access(
        self, function: int, start: int, address: int, count: int, registers: list[int], values: Any
    ) -> Any:
        """Answer as it may."""
        if values is not None or function in (3, 4):  # the server reads what function 6 wrote
            self.asked.append((function, address, count))
        if function not in self.functions:
            return ExcCodes.ILLEGAL_FUNCTION
        if count > self.most:
            return ExcCodes.ILLEGAL_VALUE
        table = 4 if function == 4 else 3
        if any((table, address + word) not in self.registers for word in range(count)):
            return ExcCodes.ILLEGAL_ADDRESS
        if values is not None:
            self.registers[3, address] = int(values[0])
        for (its_table, place), value in self.registers.items():
            if its_table == table:
                registers[place - start] = value
        return None


EBM: dict[str, Any] = {"unit": 1, "model": "ebm-papst", "write": {"address": 0xD001, "scale": 100 / 65536}}


@pytest.mark.parametrize(
    ("functions", "settings", "asked"),
    [
        ((3, 4, 6, 16), {}, [16, 16]),
        ((3, 4, 6), {}, [16, 6, 6]),
        ((3, 4, 6), {"write_function": 6}, [6, 6]),
        ((3, 4, 16), {"write_function": 16}, [16, 16]),
    ],
)
def test_a_device_is_written_with_the_function_that_it_knows(
    functions: tuple[int, ...], settings: dict[str, Any], asked: list[int]
) -> None:
    limited = Limited(functions)
    with modbus_server({1: limited}) as port:
        made = device(port, EBM, **settings)
        made.write((50.0,))
        made.write((25.0,))
        made.disconnect()
    assert [function for function, *_ in limited.asked if function in (6, 16)] == asked
    assert limited.registers[3, 0xD001] == 16_384


def test_a_device_that_takes_no_commands_says_which_setting_chooses_the_function() -> None:
    with modbus_server({1: Limited((3, 4))}) as port:
        made = device(port, EBM)
        with pytest.raises(DeviceError, match=r"exception 1: it does not know this function\); correct write_function"):
            made.write((50.0,))
        made.disconnect()


@pytest.mark.parametrize(("most", "settings"), [(1, {}), (2, {}), (1, {"most_registers": 1})])
def test_a_request_that_is_too_long_is_halved_and_a_register_that_is_not_there_costs_no_other(
    most: int, settings: dict[str, Any]
) -> None:
    limited = Limited(most=most)
    limited.registers |= {(4, 0xD011): 300, (4, 0xD013): 7}
    more = {
        "current": input_register(0xD011),
        "supply_voltage": input_register(0xD012),
        "temperature": input_register(0xD013),
    }
    with modbus_server({1: limited}) as port:
        made = device(port, EBM | more, **settings)
        made._deliver = (delivered := Delivered()).append
        first, second = made.read(), made.read()
        made.disconnect()
    for found in (first, second):
        assert (found.speed, found.command) == ((750.0,), (25.0,)), "a share of the full speed of register D119"
        assert (found.measured[of.CURRENT], found.measured[of.TEMPERATURE]) == ((300.0,), (7.0,))
        assert math.isnan(found.measured[of.SUPPLY_VOLTAGE][0])
    lacks = "unit 1 refuses input register 53266 (exception 2: it has no such register); correct address or table"
    assert delivered.noted == [f"refused_registers: {lacks}"] * 2
    later = [(address, count) for function, address, count in limited.asked if function == 4][-5:]
    assert len(later) == 5 and all(count <= 2 for _, count in later), "the halves are asked from then on"


def test_frames_of_a_serial_line_come_over_tcp_and_datagrams_carry_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    with modbus_server({1: Limited()}, framer=FramerType.RTU) as port:
        made = device(port, EBM, framer="rtu")
        assert made.read().speed == (750.0,)
        made.disconnect()
        monkeypatch.setattr("fantwin.pipeline.sources.modbus.source.TIMEOUT_S", 0.2)
        with pytest.raises(DeviceError, match=r'a converter of a serial line may want framer = "rtu"'):
            device(port, EBM)
    monkeypatch.setattr("fantwin.pipeline.sources.modbus.source.TIMEOUT_S", 5.0)
    with modbus_server({1: Limited()}, kind=ModbusUdpServer) as port:
        made = device(port, EBM, udp=True)
        assert made.read().speed == (750.0,)
        made.disconnect()


@pytest.mark.parametrize("name", MODELS)
def test_a_model_fills_the_registers_and_what_is_named_comes_first(name: str) -> None:
    fan = ModbusConfig.model_validate({"line": "plc1", "fan": [{"model": name, "current": {"address": 7}}]}).fan[0]
    assert fan.current is not None and (fan.current.address, fan.current.table) == (7, "holding")
    assert fan.speed.address == MODELS[name].registers["speed"]["address"] and fan.write is None
    with pytest.raises(ValidationError, match="unknown model 'other'; known: ebm-papst, ziehl-abegg-ecblue"):
        ModbusConfig.model_validate({"line": "plc1", "fan": [{"model": "other"}]})


def over_serial(line: SerialLine, **settings: Any) -> tuple[ModbusConfig, SourceContext]:
    values = {"line": line.host, "serial": "19200 8N1", "fan": (FAN,), **settings}
    return ModbusConfig.model_validate(values), SourceContext(1, "rpm", Path())


def test_registers_of_all_types_are_read_by_one_request_and_a_command_moves_the_rotor() -> None:
    with modbus_line({3: drive()}) as line:
        made = ModbusSource(*over_serial(line))
        made.connect()
        first = made.read()
        assert (first.measured[of.CURRENT], first.measured[of.SUPPLY_VOLTAGE]) == ((1.5,), pytest.approx((540.25,)))
        assert first.measured[of.TEMPERATURE] == pytest.approx((24.5,))
        made.write((0.9,))
        eventually(lambda: made.read().speed[0] > first.speed[0] + 500.0, "it turns faster")
        second = made.read()
        assert second.command == (0.9,)
        assert second.speed[0] % 2.0 == 0.0
        made.disconnect()
    # unit, function, address, count or value, CRC: seven registers from 10 on, and 900 to register 100
    read, write = bytes.fromhex("0303000a000725e8"), bytes.fromhex("031000640001020384b787")
    assert line.transferred["device"].startswith(read + write + read)
    assert line.transferred["host"].startswith(bytes.fromhex("03030e"))


def test_a_unit_that_is_too_slow_on_a_serial_line_is_a_failed_poll_and_the_next_one_works(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fantwin.pipeline.sources.modbus.source.TIMEOUT_S", 2.0)
    slow = drive()
    with modbus_line({3: slow}) as line:
        made = ModbusSource(*over_serial(line))
        made.connect()
        made.read()
        slow.is_silent = True
        with pytest.raises(DeviceError, match=r"unit 3 does not answer within 2 s; check unit and wiring") as caught:
            made.read()
        assert not caught.value.is_lost
        received = len(line.transferred["host"])
        slow.is_silent = False
        eventually(lambda: len(line.transferred["host"]) == received + 19, "the answer comes, too late")
        assert made.read().measured[of.SUPPLY_VOLTAGE] == pytest.approx((540.25,))
        made.disconnect()


def test_a_host_may_have_a_port() -> None:
    addresses = [
        ModbusConfig.model_validate({"line": host, "fan": (FAN,)}).address
        for host in ("plc1", "plc1:1502", "[::1]:1502")
    ]
    assert addresses == [("plc1", 502), ("plc1", 1502), ("::1", 1502)]


def test_a_source_over_a_serial_port_opens_it_with_the_settings_of_the_line() -> None:
    settings = {"line": "/dev/ttyUSB7", "serial": "9600 8O2", "fan": (FAN,)}
    made = ModbusSource(ModbusConfig.model_validate(settings), SourceContext(1, "rpm", Path()))
    line = made._made_client().comm_params
    assert (line.host, line.baudrate, line.parity, line.stopbits) == ("/dev/ttyUSB7", 9600, "O", 2)
    assert made.check()[0].startswith("/dev/ttyUSB7: no such port")
    with pytest.raises(DeviceError, match=r"^no such port, is it unplugged\? ports there: .*; waiting for it$"):
        made.connect()
