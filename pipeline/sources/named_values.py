"""Fans whose values a device gives by name: sensors, objects, series. Which of them is what of a fan say its settings.

[[tray.source.fan]]
speed = "FAN1"
command = { name = "PWM1", scale = 0.1 }
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, create_model

from fantwin.pipeline.sources.polling import DeviceError, PolledConfig, PollingSource
from fantwin.pipeline.sources.source import Reading, SourceContext
from fantwin.schemas.channels import CHANNELS

SPEED, COMMAND = "speed", "command"


def of_each_channel(kind: Any) -> Any:
    """Base of the settings of a fan: where each channel is, None where it is not measured."""
    fields: Any = {each.key: (kind | None, Field(default=None, description=each.label)) for each in CHANNELS}
    return create_model("_Channels", __doc__="Where each channel is.", **fields)


class NamedValue(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """A number of a device, times `scale`, plus `offset`."""

    name: str = Field(min_length=1, description="as the device calls it")
    scale: float = Field(default=1.0, description="value of one count")
    offset: float = Field(default=0.0, description="value at 0")


def _named(value: Any) -> Any:
    return {"name": value} if isinstance(value, str) else value


Named = Annotated[NamedValue, BeforeValidator(_named, json_schema_input_type=str | NamedValue)]
_Channels: Any = of_each_channel(Named)


class NamedFan(_Channels):
    """The names of one fan's values, each as `"NAME"`, or as `{ name = "NAME", scale = 0.1, offset = 0 }`."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    speed: Named = Field(description="speed in rpm")
    command: Named | None = Field(default=None, description="command, in the unit of the tray")

    def columns(self) -> Iterator[tuple[str, NamedValue]]:
        """What the fan has: `speed`, `command` or the name of a channel, and which value it is."""
        columns = {SPEED: SPEED, COMMAND: COMMAND, **{each.key: each.name for each in CHANNELS}}
        yield from ((column, value) for key, column in columns.items() if (value := getattr(self, key)))


class NamedFansConfig(PolledConfig, frozen=True):
    """Base of the settings of such a device."""

    shares_process: ClassVar[bool] = True

    fan: tuple[NamedFan, ...] = Field(min_length=1, description="one [[tray.source.fan]] for each fan, in their order")

    @property
    def most_fans(self) -> int:
        """Fans whose values are named."""
        return len(self.fan)

    @property
    def why_no_commands(self) -> str:
        """Nothing is written."""
        return f"fans behind {self.kind} are only read"


class NamedValuesSource(PollingSource):
    """Base of the sources that ask such a device."""

    def __init__(self, config: NamedFansConfig, context: SourceContext) -> None:
        """Ask nothing yet."""
        super().__init__(config, config.period_s)
        self._folder = context.folder
        self._units_per_rpm = context.units_per_rpm
        self._columns = [dict(fan.columns()) for fan in config.fan]
        self._measured = [each.name for each in CHANNELS if any(each.name in fan for fan in self._columns)]

    @property
    def settings_to_check(self) -> str:
        """Settings that may not fit the device."""
        return "source.fan"

    def names(self, *columns: str) -> list[str]:
        """The values that it asks for, each once. columns: only those of these."""
        found = [each.name for fan in self._columns for column, each in fan.items() if not columns or column in columns]
        return list(dict.fromkeys(found))

    def reading(self, values: Mapping[str, float], hint: str = "correct source.fan") -> Reading:
        """The reading of these values; one that is not there is unknown. Raises DeviceError: there is no speed."""
        speeds = self.names(SPEED)
        lacking = [name for name in speeds if math.isnan(values.get(name, math.nan))]
        if len(lacking) == len(speeds):
            others = " and the other speeds" if len(speeds) > 1 else ""
            raise DeviceError(f"no number at {speeds[0]}{others}: {hint}")
        if lacking:
            self.note("no_value", f"no number at {lacking[0]}")

        def of(fan: Mapping[str, NamedValue], column: str) -> float:
            each = fan.get(column)
            return values.get(each.name, math.nan) * each.scale + each.offset if each else math.nan

        speed, command, *measured = (
            tuple(of(fan, column) for fan in self._columns) for column in (SPEED, COMMAND, *self._measured)
        )
        speed = tuple(value * self._units_per_rpm for value in speed)
        return Reading(command, speed, measured=dict(zip(self._measured, measured, strict=True)))
