"""Settings of fans behind Modbus: which registers hold what, of drives and fan trays."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

from fantwin.pipeline.sources.polling import PolledConfig
from fantwin.schemas.channels import CHANNELS, Channel
from fantwin.schemas.tacho import LONGEST_WINDOW_S, Tacho
from fantwin.schemas.units import RAD_S_PER_UNIT

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

    @model_validator(mode="after")
    def _scale_is_not_zero(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale is 0: then the register says nothing")
        return self


_CHANNEL_FIELDS: Any = {each.key: (Register | None, Field(default=None, description=each.label)) for each in CHANNELS}
_Channels: Any = create_model("_Channels", __doc__="A register for each channel.", **_CHANNEL_FIELDS)


class ModbusFan(_Channels):
    """The registers of one fan."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    unit: int = Field(default=1, ge=0, le=255, description="unit id of the fan's device")
    speed: Register = Field(description="speed in rpm, after scale and offset")
    command: Register = Field(description="command that acts on the fan, in the command unit of the tray")
    write: Register | None = Field(
        default=None, description="where commands are written; without it, this fan takes none"
    )

    def channel(self, channel: Channel) -> Register | None:
        """Where a channel is; None: the device does not measure it."""
        return getattr(self, channel.key)


class ModbusConfig(PolledConfig, frozen=True):
    """Drives and fan trays by Modbus, TCP or RTU. It needs the extra `devices`."""

    kind: Literal["modbus"] = "modbus"
    host: str = Field(default="", description="name or address, for Modbus TCP")
    tcp_port: int = Field(default=502, ge=1, le=65535, description="TCP port of the host")
    port: str = Field(default="", description="serial port, for Modbus RTU")
    baud: int = Field(default=19200, gt=0, description="speed of the serial port, bits a second")
    parity: Literal["N", "E", "O"] = Field(
        default="E", description="none, even or odd; the serial port has 8 data bits"
    )
    stop_bits: Literal[1, 2] = Field(default=1, description="stop bits of the serial port")
    average_s: float | None = Field(
        default=None,
        gt=0,
        le=LONGEST_WINDOW_S,
        description="how long the device averages a speed (its filter); without it, readings count as instantaneous",
    )
    update_s: float = Field(
        default=0.0,
        ge=0,
        le=LONGEST_WINDOW_S,
        description="time between new speeds in the register; 0: average_s",
    )
    fan: tuple[ModbusFan, ...] = Field(min_length=1, description="one [[tray.source.fan]] for each fan, in their order")

    @model_validator(mode="after")
    def _one_connection(self) -> Self:
        if bool(self.host) == bool(self.port):
            raise ValueError("give either host, for Modbus TCP, or port, for Modbus RTU")
        return self

    @property
    def most_fans(self) -> int:
        """Columns whose registers are named."""
        return len(self.fan)

    @property
    def why_no_commands(self) -> str:
        """Commands need a fan with a register `write`."""
        return "" if any(fan.write for fan in self.fan) else "no fan of its source has a register `write`"

    def stated_tachos(self, fans: int) -> tuple[Tacho, ...] | None:
        """The mean over average_s, in the steps of the register of each fan."""
        if self.average_s is None or fans != len(self.fan):
            return None
        return tuple(
            Tacho(
                kind="average",
                window_s=self.average_s,
                update_s=self.update_s,
                step_rad_s=0.0 if each.speed.type == "f32" else abs(each.speed.scale) * RAD_S_PER_UNIT["rpm"],
            )
            for each in self.fan
        )
