"""Settings of a baseboard controller: `source = { kind = "redfish", url = "https://bmc1" }`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, StrictBool, field_validator, model_validator

from fantwin.pipeline.sources.polling import SLOWEST_S, PolledConfig
from fantwin.pipeline.sources.redfish.fan_objects import MEASURED_PERCENT
from fantwin.pipeline.sources.secret_file import LogIn


def _several(value: object) -> object:
    return (value,) if isinstance(value, str) and value else value or ()


class RedfishConfig(PolledConfig, LogIn, frozen=True):
    """Fans of a server by its baseboard controller."""

    schemes: ClassVar[Mapping[str, int]] = {"http": 80, "https": 443}
    shares_process: ClassVar[bool] = True
    no_speed: ClassVar[str] = "its controller gives none now"

    kind: Literal["redfish"] = "redfish"
    period_s: float = Field(default=1.0, gt=0, le=SLOWEST_S, description="time between two readings")
    url: str = Field(
        description="address of the controller, for example https://bmc1, or https://USER@bmc1 to log in; where it has "
        "several chassis, that of the chassis: https://bmc1/redfish/v1/Chassis/Sled2"
    )
    fans: tuple[str, ...] = Field(
        default=(),
        description="names or ids of the fans, in the order of the tray; without it all, in the controller's order",
    )
    command: Annotated[tuple[str, ...], BeforeValidator(_several, json_schema_input_type=str | tuple[str, ...])] = (
        Field(
            default=(),
            description="where the command of each fan is, or of all: a JSON pointer in the fan's object "
            "(/Oem/Vendor/PWM), a sensor (fanpwm_FAN1), or PATH#POINTER; without it, set-point or pwm are looked for",
        )
    )
    speed: str = Field(
        default="",
        pattern="^(/.*)?$",
        description="where the speed in rpm is in the fan's object, if the controller does not say so (/Reading)",
    )
    rated_rpm: float | None = Field(
        default=None,
        gt=0,
        description="speed at 100 %, where the controller gives the measured speed in per cent alone",
    )
    temperature: str = Field(
        default="",
        description="sensor of the air: its name, or a key of TemperatureSummaryCelsius",
    )
    verify: StrictBool | Path = Field(
        default=True,
        description="whether the certificate of the controller is checked; or that of the authority that signed it",
    )

    @field_validator("command")
    @classmethod
    def _is_no_measurement(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if MEASURED_PERCENT in value:
            raise ValueError(f"{MEASURED_PERCENT} is the measured speed in per cent of the rated one: no command")
        return value

    @model_validator(mode="after")
    def _has_password(self) -> Self:
        if self.username and not self.password_file:
            raise ValueError("the user in url needs password_file")
        if self.speed and self.speed in self.command:
            raise ValueError(f"speed and command are both {self.speed}: a twin of it could never be wrong")
        return self

    @property
    def address(self) -> str:
        """Its URL without the user and the chassis."""
        return f"{self.parts.scheme}://{self.parts.netloc.rpartition('@')[2]}"

    @property
    def chassis(self) -> str:
        """The path of the chassis; empty: the only one with fans."""
        return self.parts.path.rstrip("/")

    @property
    def why_no_commands(self) -> str:
        """fantwin never writes to a controller."""
        return "fans behind Redfish are only read"
