"""Settings of fans behind Modbus: which registers hold what, of drives and fan trays."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from fantwin.pipeline.sources.host_address import host_and_port
from fantwin.pipeline.sources.modbus.models import MODELS
from fantwin.pipeline.sources.named_values import of_each_channel
from fantwin.pipeline.sources.polling import PolledConfig
from fantwin.schemas.channels import Channel

TCP_PORT = 502
MOST_REGISTERS = 120
"""registers of one request; the protocol allows 125"""
RegisterType = Literal["u16", "s16", "u32", "s32", "f32"]


class Register(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """Number in a device: its registers times `scale`, plus `offset`."""

    address: int = Field(ge=0, le=65535, description="address in the request: from 0, without a leading 3 or 4")
    type: RegisterType = Field(default="u16", description="unsigned, signed or float; 32 bits are in two registers")
    table: Literal["holding", "input"] = Field(
        default="holding", description="read by function 3 (holding) or 4 (input)"
    )
    word_order: Literal["big", "little"] = Field(default="big", description="which of two registers comes first")
    scale: float = Field(default=1.0, description="value of one count of the register")
    offset: float = Field(default=0.0, description="value at a register of 0")
    times: int | None = Field(
        default=None,
        ge=0,
        le=65535,
        description="address of a holding register that multiplies this, read at each connection: the full speed, "
        "where the speed is a share of it",
    )

    @model_validator(mode="after")
    def _scale_is_not_zero(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale is 0: then the register says nothing")
        return self


_Channels: Any = of_each_channel(Register)


class ModbusFan(_Channels):
    """The registers of one fan."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    unit: int = Field(default=1, ge=0, le=255, description="unit id of the fan's device")
    model: str = Field(
        default="",
        description="fills the registers that are not named, from documents of its maker: ebm-papst and others",
    )
    speed: Register = Field(description="speed in rpm, after scale and offset")
    command: Register = Field(description="command that acts on the fan, in the command unit of the tray")
    write: Register | None = Field(
        default=None, description="where commands are written; without it, this fan takes none"
    )

    @model_validator(mode="before")
    @classmethod
    def _registers_of_its_model(cls, values: Any) -> Any:
        name = values.get("model") if isinstance(values, Mapping) else None
        if not name:
            return values
        if name not in MODELS:
            raise ValueError(f"unknown model {str(name)[:40]!r}; known: {', '.join(MODELS)}")
        return {**MODELS[name].registers, **{key: each for key, each in values.items() if each is not None}}

    def channel(self, channel: Channel) -> Register | None:
        """Where a channel is; None: the device does not measure it."""
        return getattr(self, channel.key)


class ModbusConfig(PolledConfig, frozen=True):
    """Drives and fan trays by Modbus, TCP or RTU. It needs the extra `devices`."""

    kind: Literal["modbus"] = "modbus"
    line: str = Field(
        description="for Modbus TCP a name or address, plc1:1502 if its port is not 502; for Modbus RTU the path of a "
        "serial port, /dev/ttyUSB0"
    )
    serial: str = Field(
        default="19200 8E1",
        description="of a serial port: bits a second, data bits (8), parity (N, E or O) and stop bits (1 or 2)",
    )
    framer: Literal["", "socket", "rtu", "ascii"] = Field(
        default="",
        description="form of the frames; without it rtu on a serial port, socket (Modbus TCP) on a network",
    )
    udp: bool = Field(default=False, description="UDP instead of TCP")
    most_registers: int = Field(
        default=MOST_REGISTERS, ge=1, le=125, description="most registers in a request; after exception 2 or 3 fewer"
    )
    write_function: Literal[0, 6, 16] = Field(
        default=0,
        description="function that writes commands; 0: 16, and 6 after exception 1",
    )
    fan: tuple[ModbusFan, ...] = Field(min_length=1, description="one [[tray.source.fan]] for each fan, in their order")

    @field_validator("line")
    @classmethod
    def _is_path_or_address(cls, value: str) -> str:
        if "/" in value:
            return value
        try:
            host_and_port(value, TCP_PORT)
        except ValueError as error:
            raise ValueError(
                "give plc1, plc1:1502 or [fe80::1] for Modbus TCP, or a path, /dev/ttyUSB0, for Modbus RTU"
            ) from error
        return value

    @field_validator("serial")
    @classmethod
    def _is_of_a_serial_port(cls, value: str) -> str:
        if not re.fullmatch("[1-9][0-9]{1,6} 8[NEO][12]", value):
            raise ValueError("give bits a second, 8 data bits, parity N, E or O, and 1 or 2 stop bits: 19200 8E1")
        return value

    @model_validator(mode="after")
    def _functions_fit(self) -> Self:
        too_long = [fan for fan in self.fan if fan.write is not None and fan.write.type[1:] == "32"]
        if self.write_function == 6 and too_long:
            raise ValueError("write_function = 6 writes one register: a write of 32 bits needs 16")
        if self.udp and self.port:
            raise ValueError("udp = true is for a host, not for a serial port")
        return self

    @property
    def baud(self) -> int:
        """Speed of the serial port, bits a second."""
        return int(self.serial.split()[0])

    @property
    def port(self) -> str:
        """The serial port; empty for Modbus TCP."""
        return self.line if "/" in self.line else ""

    @property
    def address(self) -> tuple[str, int]:
        """Host and port, for Modbus TCP."""
        return host_and_port(self.line, TCP_PORT)

    @property
    def most_fans(self) -> int:
        """Columns whose registers are named."""
        return len(self.fan)

    @property
    def why_no_commands(self) -> str:
        """Commands need a fan with a register `write`."""
        return "" if any(fan.write for fan in self.fan) else "no fan of its source has a register `write`"
