"""Settings of a baseboard controller: `source = { kind = "redfish", url = "https://bmc1" }`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from pydantic import Field, field_validator

from fantwin.pipeline.sources.polling import SLOWEST_S, PolledConfig

USER_VARIABLE, PASSWORD_VARIABLE = "FANTWIN_REDFISH_USER", "FANTWIN_REDFISH_PASSWORD"


class RedfishConfig(PolledConfig, frozen=True):
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
    credentials: Path | None = Field(
        default=None,
        description=f"file of two lines, user and password; only its owner may be able to read it; without it the "
        f"environment variables {USER_VARIABLE} and {PASSWORD_VARIABLE}",
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
            raise ValueError("a configuration is recorded: put user and password into the file of `credentials`")
        return value

    @property
    def why_no_commands(self) -> str:
        """fantwin never writes to a controller."""
        return "fans behind Redfish are only read"
