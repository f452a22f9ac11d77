"""Fans behind Modbus as a source of samples: the registers that the configuration names, read at each poll.

Registers that follow one another in one device are read by one request. One that the device refuses is halved, from
then on, until each register that it has is read; a register that is refused alone, or a number that is none, is NaN. A
device that does not answer is a failed poll.
"""

from __future__ import annotations

import logging
import math
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.sources.modbus.config import ModbusConfig, ModbusFan, Register
from fantwin.pipeline.sources.polling import DeviceError, Doubt, PollingSource
from fantwin.pipeline.sources.serial.same_port import SamePort, ports_there
from fantwin.pipeline.sources.source import Reading, SourceContext
from fantwin.schemas.channels import CHANNELS, Channel

if TYPE_CHECKING:
    from pymodbus.client.base import ModbusBaseSyncClient

TIMEOUT_S = 0.5
"""longest wait for the answer to a request"""
_FORMATS = {"u16": ">H", "s16": ">h", "u32": ">I", "s32": ">i", "f32": ">f"}


@dataclass(frozen=True)
class _Exception:
    """What an exception says, and the setting to correct after a request to read and one to write."""

    words: str
    read: str
    write: str


_EXCEPTIONS = {
    1: _Exception("it does not know this function", "table", "write_function"),
    2: _Exception("it has no such register", "address or table", "write"),
    3: _Exception("it does not take this value, or so many registers", "most_registers", "write and its scale"),
    4: _Exception("it has failed to do it", "", ""),
    6: _Exception("it is busy", "period_s", "period_s"),
    10: _Exception("the gateway cannot reach the unit", "unit", "unit"),
    11: _Exception("the unit does not answer the gateway", "unit", "unit"),
}
SLOWEST_RPM = 30.0
"""a smaller speed other than 0 was hardly measured"""

_Place: TypeAlias = tuple[int, str, int]
"""of a register: the unit id of its device, its table, and the address"""


@dataclass(frozen=True)
class _Request:
    """Registers that follow one another in one table of one device."""

    unit: int
    table: str
    registers: tuple[tuple[int, int], ...]
    """address and number of words of each, which are read together"""

    @property
    def first(self) -> int:
        """Its first address."""
        return self.registers[0][0]

    @property
    def count(self) -> int:
        """Number of words."""
        return max(address + words for address, words in self.registers) - self.first

    def halves(self) -> list[_Request]:
        """Two requests with half the registers each."""
        middle = len(self.registers) // 2
        return [replace(self, registers=self.registers[:middle]), replace(self, registers=self.registers[middle:])]


class ModbusSource(PollingSource):
    """A `SampleSource`."""

    def __init__(self, config: ModbusConfig, context: SourceContext) -> None:
        """Raises UserError if the extra is missing, or the fans are not those of the tray."""
        super().__init__(config, config.period_s)
        require("source modbus", "devices", "pymodbus")
        if context.fans != len(config.fan):
            raise UserError(
                f"fans = {context.fans}, and there are {len(config.fan)} [[tray.source.fan]]: name each fan"
            )
        self._config = config
        self._port = str(context.folder / config.port) if config.port else ""
        self._same = SamePort(self._port)
        self._units_per_rpm = context.units_per_rpm
        self._names = context.names
        self._requests = _requests(config.fan, config.most_registers)
        self._factors: dict[tuple[int, int], float] = {}
        """what values are multiplied by, by unit and address (Register.times)"""
        self._function_6: set[int] = set()
        """units that do not know function 16"""
        self._client: ModbusBaseSyncClient | None = None
        self._words: dict[_Place, int] = {}
        """those that were read last"""
        self._refused: dict[_Place, str] = {}
        """why, of those that the device refused then"""

    @property
    def name(self) -> str:
        """Host or port."""
        host, port = self._config.address
        return self._config.port or f"{host}:{port}"

    @property
    def settings_to_check(self) -> str:
        """Settings that may differ between the two ends."""
        config = self._config
        line = "" if not config.port else f'serial = "{config.serial}", '
        return f"{line}unit and registers"

    def connect(self) -> None:
        """Open the connection."""
        self._client = client = self._made_client()
        if not client.connect():
            raise self._lost("cannot be opened or reached")
        if self._port and (change := self._same.opened(str(client.comm_params.host))):
            self.note("port_changed", change)
        for fan in self._config.fan:
            for register in (*_registers(fan), fan.write):
                if register is not None and register.times is not None:
                    self._factors[fan.unit, register.times] = self._factor(fan.unit, register.times)

    def read(self) -> Reading:
        """Commands, speeds and what else has registers."""
        self._words.clear()
        self._refused.clear()
        for request in list(self._requests):
            self._ask(request, self._words, self._refused)
        fans = self._config.fan
        command = tuple(self._value(fan.unit, fan.command) for fan in fans)
        if all(map(math.isnan, command)):
            why = f": {next(iter(self._refused.values()))}" if self._refused else ""
            unread = self._names.label([*map(math.isnan, command)].index(True))
            raise DeviceError(f"the command of {unread} cannot be read{why}")
        for why in dict.fromkeys(self._refused.values()):
            self.note("refused_registers", why)
        return Reading(
            command=command,
            speed=tuple(self._value(fan.unit, fan.speed) * self._units_per_rpm for fan in fans),
            measured={each.name: self._column(each) for each in CHANNELS if any(fan.channel(each) for fan in fans)},
        )

    def doubts(self, fastest_rpm: float) -> dict[int, Doubt]:
        """See the base. Its remedy is another word order, type or scale with which the same words are a speed."""
        found: dict[int, Doubt] = {}
        for number, fan in enumerate(self._config.fan):
            speed, where = fan.speed, f"{fan.speed.table} register {fan.speed.address} ({fan.speed.type})"
            words = self._words_of(fan.unit, speed)
            if words is None:
                found[number] = Doubt(
                    self._refused.get((fan.unit, speed.table, speed.address), f"nothing is in {where}")
                )
                continue
            value = self._value(fan.unit, speed)
            if SLOWEST_RPM <= abs(value) <= fastest_rpm:
                continue
            fits = (
                remedy
                for other, remedy in _others(speed)
                if SLOWEST_RPM <= (rpm := self._value(fan.unit, other)) <= fastest_rpm
                for remedy in (f"{remedy} makes it {rpm:.0f} rpm",)
            )
            shown = " ".join(f"0x{word:04x}" for word in words)
            found[number] = Doubt(
                f"{where} holds {shown}, which is {value:.3g} rpm", next(fits, "") if any(words) else ""
            )
        return found

    def write(self, command: tuple[float, ...]) -> None:
        """Write commands to the registers that are declared for them."""
        wanted = [(fan, value) for fan, value in zip(self._config.fan, command, strict=True) if not math.isnan(value)]
        for number, (fan, value) in enumerate(zip(self._config.fan, command, strict=True)):
            if fan.write is None and not math.isnan(value):
                raise DeviceError(f"{self._names.label(number)} has no register for commands (write)")
        for fan, value in wanted:
            assert fan.write is not None
            self._write(fan.unit, fan.write, value)

    def disconnect(self) -> None:
        """Close the connection; the fans keep their commands."""
        client, self._client = self._client, None
        if client:
            client.close()

    def check(self) -> list[str]:
        """Problems before the start: the serial port is not there. A host is not asked."""
        if self._port and not os.access(self._port, os.R_OK | os.W_OK):
            there = f"; {ports_there(self._port)}" if not Path(self._port).exists() else ""
            why = f"no such port, or this user may not open it (group dialout); correct source.line{there}"
            return [f"{self._port}: {why}"]
        return []

    def _made_client(self) -> ModbusBaseSyncClient:
        from pymodbus import FramerType  # noqa: PLC0415  slow to import
        from pymodbus.client import ModbusSerialClient, ModbusTcpClient, ModbusUdpClient  # noqa: PLC0415

        config = self._config
        logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)  # a failure is a line of this source already
        if not config.port:
            host, port = config.address
            made = ModbusUdpClient if config.udp else ModbusTcpClient
            framer = FramerType(config.framer or "socket")
            return made(host, port=port, framer=framer, timeout=TIMEOUT_S, retries=0)
        return ModbusSerialClient(
            self._same.path(),
            framer=FramerType(config.framer or "rtu"),
            baudrate=config.baud,
            parity=config.serial[-2],
            stopbits=int(config.serial[-1]),
            timeout=TIMEOUT_S,
            retries=0,
        )

    def _factor(self, unit: int, address: int) -> float:
        """The content of a holding register that values are multiplied by."""
        words, refused = dict[_Place, int](), dict[_Place, str]()
        self._ask(_Request(unit, "holding", ((address, 1),)), words, refused)
        place = unit, "holding", address
        value = words.get(place, 0)
        if not value:
            why = refused.get(place, f"unit {unit} shows 0 in holding register {address}")
            raise DeviceError(f"{why}, which its values are multiplied by (times)", is_lost=True)
        return float(value)

    def _ask(self, request: _Request, words: dict[_Place, int], refused: dict[_Place, str]) -> None:
        """Add the words of registers; those that the device refuses are none, with the line why."""
        client = self._client
        assert client is not None
        unit, table = request.unit, request.table
        read = client.read_holding_registers if table == "holding" else client.read_input_registers
        answer = self._answer(unit, lambda: read(request.first, count=request.count, device_id=unit))
        if not answer.isError():
            for number, word in enumerate(answer.registers[: request.count]):
                words[unit, table, request.first + number] = word
        elif answer.exception_code in (2, 3) and len(request.registers) > 1:
            halves = request.halves()
            if request in self._requests:
                place = self._requests.index(request)
                self._requests[place : place + 1] = halves
            for half in halves:
                self._ask(half, words, refused)
        else:
            for address, _ in request.registers:
                refused[unit, table, address] = refusal(unit, table, request.first, answer.exception_code)

    def _write(self, unit: int, register: Register, value: float) -> None:
        client = self._client
        assert client is not None
        factor = self._factors.get((unit, register.times), 1.0) if register.times is not None else 1.0
        words = _packed(register, (value / factor - register.offset) / register.scale)
        chosen = self._config.write_function or (6 if unit in self._function_6 else 16)
        functions = (chosen,) if len(words) == 1 else (16,)
        if functions == (16,) and len(words) == 1 and not self._config.write_function:
            functions = (16, 6)
        code = 0
        for function in functions:
            write = client.write_registers if function == 16 else client.write_register
            values: Any = words if function == 16 else words[0]
            answer = self._answer(
                unit, lambda write=write, values=values: write(register.address, values, device_id=unit)
            )
            if not answer.isError():
                if function == 6:
                    self._function_6.add(unit)
                return
            code = answer.exception_code
            if code != 1:
                break
        raise DeviceError(refusal(unit, "holding", register.address, code, value))

    def _answer(self, unit: int, request: Any) -> Any:
        from pymodbus.exceptions import ConnectionException, ModbusException  # noqa: PLC0415

        try:
            return request()
        except ConnectionException as error:
            raise self._lost("the connection is gone") from error
        except ModbusException as error:
            hint = '; a converter of a serial line may want framer = "rtu"' if self._is_plain_tcp else ""
            raise DeviceError(
                f"unit {unit} does not answer within {TIMEOUT_S:g} s; check unit and wiring{hint}"
            ) from error
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from error

    @property
    def _is_plain_tcp(self) -> bool:
        return not self._port and self._config.framer in ("", "socket")

    def _lost(self, what: str) -> DeviceError:
        """The error of a lost line. For a port that no longer exists it says so, whatever failed."""
        if self._port and not Path(self._port).exists():
            what = f"no such port, is it unplugged? {ports_there(self._port)}"
        return DeviceError(f"{what}; waiting for it", is_lost=True)

    def _words_of(self, unit: int, register: Register) -> list[int] | None:
        """Words of a register as the device gave them last; None where one was refused."""
        found = [self._words.get((unit, register.table, register.address + word)) for word in range(_size(register))]
        known = [word for word in found if word is not None]
        return known if len(known) == len(found) else None

    def _value(self, unit: int, register: Register) -> float:
        """NaN where a register was refused, or holds no number."""
        found = self._words_of(unit, register)
        if found is None:
            return math.nan
        if register.word_order == "little":
            found.reverse()
        (number,) = struct.unpack(_FORMATS[register.type], struct.pack(f">{len(found)}H", *found))
        factor = self._factors[unit, register.times] if register.times is not None else 1.0
        return (number * register.scale + register.offset) * factor if math.isfinite(number) else math.nan

    def _column(self, channel: Channel) -> tuple[float, ...]:
        """A value for each fan, NaN for a fan without a register of this channel."""
        fans = self._config.fan
        return tuple(
            math.nan if (register := fan.channel(channel)) is None else self._value(fan.unit, register) for fan in fans
        )


def refusal(unit: int, table: str, address: int, code: int, written: float | None = None) -> str:
    """The line about an exception, in words, with what to correct. Its request read, or wrote a value."""
    exception = _EXCEPTIONS.get(code, _Exception("see its manual", "", ""))
    words, setting = exception.words, exception.read if written is None else exception.write
    what = f"{table} register {address}" if written is None else f"{written:g} for register {address}"
    if code == 2 and 30_000 < address < 50_000:
        number = address % 10_000
        words += f"; addresses begin at 0 and have no leading {address // 10_000}: {number}, or {number - 1}"
    elif setting:
        return f"unit {unit} refuses {what} (exception {code}: {words}); correct {setting}"
    return f"unit {unit} refuses {what} (exception {code}: {words})"


def _registers(fan: ModbusFan) -> Iterator[Register]:
    for register in (fan.speed, fan.command, *map(fan.channel, CHANNELS)):
        if register is not None:
            yield register


def _size(register: Register) -> int:
    return struct.calcsize(_FORMATS[register.type]) // 2


def _requests(fans: tuple[ModbusFan, ...], most: int) -> list[_Request]:
    """The requests of all fans: registers that follow one another are read together."""
    places = {
        (fan.unit, register.table, register.address, _size(register)) for fan in fans for register in _registers(fan)
    }
    requests: list[_Request] = []
    for unit, table, address, words in sorted(places):
        if requests:
            last = requests[-1]
            longer = replace(last, registers=(*last.registers, (address, words)))
            follows = (last.unit, last.table) == (unit, table) and address <= last.first + last.count
            if follows and longer.count <= most:
                requests[-1] = longer
                continue
        requests.append(_Request(unit, table, ((address, words),)))
    return requests


def _others(register: Register) -> Iterator[tuple[Register, str]]:
    """Other readings of the same words, the likeliest mistakes first, each with what the configuration says then."""
    if _size(register) == 2:
        order = "little" if register.word_order == "big" else "big"
        types = (register.type, "u32" if register.type == "f32" else "f32")
        for kind, words in ((types[0], order), (types[1], register.word_order), (types[1], order)):
            settings = {"type": kind, "word_order": words}
            named = [f'{name} = "{value}"' for name, value in settings.items() if value != getattr(register, name)]
            yield register.model_copy(update=settings), ", ".join(named)
    for share in (0.1, 0.01):
        scale = float(f"{register.scale * share:.9g}")
        yield register.model_copy(update={"scale": scale}), f"scale = {scale:g}"


def _packed(register: Register, number: float) -> list[int]:
    """The registers for a number. Raises DeviceError where it does not fit."""
    kind = _FORMATS[register.type]
    try:
        data = struct.pack(kind, number if register.type == "f32" else round(number))
    except (struct.error, OverflowError) as error:
        raise DeviceError(f"{number:g} does not fit into {register.type} of register {register.address}") from error
    words = list(struct.unpack(f">{len(data) // 2}H", data))
    return words[::-1] if register.word_order == "little" else words
