"""Fans behind Modbus as a source of samples: the registers that the configuration names, read at each poll.

Registers that follow one another in one device are read by one request. A request that the device refuses, or a number
that is none, is NaN; a device that does not answer is a failed poll.
"""

from __future__ import annotations

import logging
import math
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.sources.modbus.config import ModbusConfig, ModbusFan, Register
from fantwin.pipeline.sources.polling import DeviceError, Doubt, PollingSource
from fantwin.pipeline.sources.source import Reading, SourceContext
from fantwin.schemas.channels import CHANNELS, Channel

if TYPE_CHECKING:
    from pymodbus.client.base import ModbusBaseSyncClient

MOST_REGISTERS = 120
"""registers of one request; the protocol allows 125"""
TIMEOUT_S = 0.5
"""longest wait for the answer to a request"""
_FORMATS = {"u16": ">H", "s16": ">h", "u32": ">I", "s32": ">i", "f32": ">f"}


_EXCEPTIONS = {
    1: "it does not know this function: is it the other table?",
    2: "it has no such register",
    3: "it does not take this value",
    4: "it has failed to do it",
}
SLOWEST_RPM = 30.0
"""a smaller speed other than 0 was hardly measured"""

_Place: TypeAlias = tuple[int, str, int]
"""of a register: the unit id of its device, its table, and the address"""


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
        self._units_per_rpm = context.units_per_rpm
        self._names = context.names
        self._requests = _requests(config.fan)
        self._client: ModbusBaseSyncClient | None = None
        self._words: dict[_Place, int] = {}
        """those that were read last"""
        self._refused: list[str] = []
        """requests that the device refused then"""

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

    def read(self) -> Reading:
        """Commands, speeds and what else has registers."""
        words, refused = self._words, self._refused = dict[_Place, int](), list[str]()
        for first, count in self._requests:
            self._ask(first, count, words, refused)
        fans = self._config.fan
        command = tuple(_value(words, fan.unit, fan.command) for fan in fans)
        if any(map(math.isnan, command)):
            why = f": {refused[0]}" if refused else ""
            unread = self._names.label([*map(math.isnan, command)].index(True))
            raise DeviceError(f"the command of {unread} cannot be read{why}")
        return Reading(
            command=command,
            speed=tuple(_value(words, fan.unit, fan.speed) * self._units_per_rpm for fan in fans),
            measured={
                each.name: _column(words, fans, each) for each in CHANNELS if any(fan.channel(each) for fan in fans)
            },
        )

    def doubts(self, fastest_rpm: float) -> dict[int, Doubt]:
        """See the base. Its remedy is another word order, type or scale with which the same words are a speed."""
        found: dict[int, Doubt] = {}
        for number, fan in enumerate(self._config.fan):
            speed, where = fan.speed, f"{fan.speed.table} register {fan.speed.address} ({fan.speed.type})"
            words = _words_of(self._words, fan.unit, speed)
            if words is None:
                found[number] = Doubt("; ".join(self._refused) or f"nothing is in {where}")
                continue
            value = _value(self._words, fan.unit, speed)
            if SLOWEST_RPM <= abs(value) <= fastest_rpm:
                continue
            fits = (
                remedy
                for other, remedy in _others(speed)
                if SLOWEST_RPM <= (rpm := _value(self._words, fan.unit, other)) <= fastest_rpm
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
            return [f"{self._port}: no such port, or this user may not open it (group dialout); correct source.line"]
        return []

    def _made_client(self) -> ModbusBaseSyncClient:
        from pymodbus.client import ModbusSerialClient, ModbusTcpClient  # noqa: PLC0415  slow to import

        config = self._config
        logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)  # a failure is a line of this source already
        if not config.port:
            host, port = config.address
            return ModbusTcpClient(host, port=port, timeout=TIMEOUT_S, retries=0)
        return ModbusSerialClient(
            self._port,
            baudrate=config.baud,
            parity=config.serial[-2],
            stopbits=int(config.serial[-1]),
            timeout=TIMEOUT_S,
            retries=0,
        )

    def _ask(self, first: _Place, count: int, words: dict[_Place, int], refused: list[str]) -> None:
        """Add the words of registers that follow one another, none if the device refuses the request."""
        unit, table, address = first
        client = self._client
        assert client is not None
        read = client.read_holding_registers if table == "holding" else client.read_input_registers
        answer = self._answer(unit, lambda: read(address, count=count, device_id=unit))
        if answer.isError():
            refused.append(f"unit {unit} refuses {table} register {address} ({_why(answer, address)})")
            return
        for number, word in enumerate(answer.registers[:count]):
            words[unit, table, address + number] = word

    def _write(self, unit: int, register: Register, value: float) -> None:
        client = self._client
        assert client is not None
        number = (value - register.offset) / register.scale
        packed = _packed(register, number)
        answer = self._answer(unit, lambda: client.write_registers(register.address, packed, device_id=unit))
        if answer.isError():
            raise DeviceError(
                f"unit {unit} refuses {value:g} for register {register.address} ({_why(answer, register.address)})"
            )

    def _answer(self, unit: int, request: Any) -> Any:
        from pymodbus.exceptions import ConnectionException, ModbusException  # noqa: PLC0415

        try:
            return request()
        except ConnectionException as error:
            raise self._lost("the connection is gone") from error
        except ModbusException as error:
            raise DeviceError(f"unit {unit} does not answer within {TIMEOUT_S:g} s; check unit and wiring") from error
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from error

    def _lost(self, what: str) -> DeviceError:
        """The error of a lost line. For a port that no longer exists it says so, whatever failed."""
        if self._port and not Path(self._port).exists():
            what = "no such port, is it unplugged?"
        return DeviceError(f"{what}; waiting for it", is_lost=True)


def _registers(fan: ModbusFan) -> Iterator[Register]:
    for register in (fan.speed, fan.command, *map(fan.channel, CHANNELS)):
        if register is not None:
            yield register


def _size(register: Register) -> int:
    return struct.calcsize(_FORMATS[register.type]) // 2


def _requests(fans: tuple[ModbusFan, ...]) -> list[tuple[_Place, int]]:
    """The first register and the number of each request: those of all fans, together that follow one another."""
    places = {
        (fan.unit, register.table, register.address + word)
        for fan in fans
        for register in _registers(fan)
        for word in range(_size(register))
    }
    requests: list[tuple[_Place, int]] = []
    for place in sorted(places):
        if requests:
            first, count = requests[-1]
            unit, table, address = first
            if place == (unit, table, address + count) and count < MOST_REGISTERS:
                requests[-1] = first, count + 1
                continue
        requests.append((place, 1))
    return requests


def _value(words: dict[_Place, int], unit: int, register: Register) -> float:
    """NaN where a register was refused, or holds no number."""
    found = _words_of(words, unit, register)
    if found is None:
        return math.nan
    if register.word_order == "little":
        found.reverse()
    (number,) = struct.unpack(_FORMATS[register.type], struct.pack(f">{len(found)}H", *found))
    return number * register.scale + register.offset if math.isfinite(number) else math.nan


def _words_of(words: dict[_Place, int], unit: int, register: Register) -> list[int] | None:
    """As the device gives them; None where one was refused."""
    found = [words.get((unit, register.table, register.address + word)) for word in range(_size(register))]
    known = [word for word in found if word is not None]
    return known if len(known) == len(found) else None


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


def _why(answer: Any, address: int) -> str:
    """An exception in words."""
    code = answer.exception_code
    why = f"exception {code}: {_EXCEPTIONS[code]}" if code in _EXCEPTIONS else f"exception {code}"
    if code == 2 and 30_000 < address < 50_000:
        number = address % 10_000
        why += f"; addresses begin at 0 and have no leading {address // 10_000}: {number}, or {number - 1}"
    return why


def _packed(register: Register, number: float) -> list[int]:
    """The registers for a number. Raises DeviceError where it does not fit."""
    kind = _FORMATS[register.type]
    try:
        data = struct.pack(kind, number if register.type == "f32" else round(number))
    except (struct.error, OverflowError) as error:
        raise DeviceError(f"{number:g} does not fit into {register.type} of register {register.address}") from error
    words = list(struct.unpack(f">{len(data) // 2}H", data))
    return words[::-1] if register.word_order == "little" else words


def _column(words: dict[_Place, int], fans: tuple[ModbusFan, ...], channel: Channel) -> tuple[float, ...]:
    """A value for each fan, NaN for a fan without a register of this channel."""
    registers = [fan.channel(channel) for fan in fans]
    return tuple(
        math.nan if register is None else _value(words, fan.unit, register)
        for fan, register in zip(fans, registers, strict=True)
    )
