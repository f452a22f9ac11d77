"""Settings of a baseboard controller: `source = { kind = "redfish", url = "https://bmc1" }`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field, StrictBool, model_validator

from fantwin.pipeline.sources.secret_file import LogIn
from fantwin.pipeline.sources.source import SourceConfig


class RedfishConfig(SourceConfig, LogIn, frozen=True):
    """Fans of a server by its baseboard controller. It needs the extra `devices`."""

    schemes: ClassVar[Mapping[str, int]] = {"http": 80, "https": 443}

    kind: Literal["redfish"] = "redfish"
    url: str = Field(
        description="address of the controller, for example https://bmc1, or https://USER@bmc1 to log in; where it has "
        "several chassis, that of the chassis: https://bmc1/redfish/v1/Chassis/Sled2"
    )
    fans: tuple[str, ...] = Field(
        default=(),
        description="names or ids of the fans, in the order of the tray; without it all, in the controller's order",
    )
    command: str = Field(
        default="/SpeedPercent/Reading",
        pattern="^/",
        description="where the command is in the object of a fan (JSON pointer); its unit is the tray's",
    )
    temperature: str = Field(
        default="",
        description="sensor of the air: its name (Thermal), or a key of TemperatureSummaryCelsius (ThermalSubsystem)",
    )
    verify: StrictBool | Path = Field(
        default=True,
        description="whether the certificate of the controller is checked; or that of the authority that signed it",
    )

    @model_validator(mode="after")
    def _has_password(self) -> Self:
        if self.username and not self.password_file:
            raise ValueError("the user in url needs password_file")
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
