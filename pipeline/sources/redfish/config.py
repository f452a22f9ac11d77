"""Settings of a baseboard controller: `source = { kind = "redfish", url = "https://bmc1" }`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, field_validator, model_validator

from fantwin.pipeline.sources.polling import SLOWEST_S, PolledConfig
from fantwin.pipeline.sources.secret_file import LogIn


class RedfishConfig(PolledConfig, LogIn, frozen=True):
    """Fans of a server by its baseboard controller. It needs the extra `devices`."""

    kind: Literal["redfish"] = "redfish"
    period_s: float = Field(default=1.0, gt=0, le=SLOWEST_S, description="time between two readings")
    url: str = Field(description="address of the controller, for example https://bmc1; without user and password")
    chassis: str = Field(default="", description="id of the chassis; needed where the controller has several")
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
    verify: bool = Field(default=True, description="whether the certificate of the controller is checked")
    ca: Path | None = Field(default=None, description="certificate of the authority that signed the controller's")

    @field_validator("url")
    @classmethod
    def _plain_address(cls, value: str) -> str:
        parts = urlsplit(value)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError("write the address of the controller, for example https://bmc1")
        if parts.username is not None:
            raise ValueError("a configuration is recorded: give username, and password_file")
        return value

    @model_validator(mode="after")
    def _has_password(self) -> Self:
        if self.username and not (self.password_file or self.password_env):
            raise ValueError("username needs password_file or password_env")
        return self

    @property
    def why_no_commands(self) -> str:
        """fantwin never writes to a controller."""
        return "fans behind Redfish are only read"
