"""Settings of fans behind SNMP: which object of an agent is the speed and the command of each."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from fantwin.pipeline.sources.host_address import host_and_port
from fantwin.pipeline.sources.named_values import NamedFansConfig

PORT = 161


class SnmpConfig(NamedFansConfig, frozen=True):
    """Fans of an SNMP agent, version 2c with a community or 3 with a user. Names are identifiers with index,
    1.3.6.1.2.1.99.1.1.1.4.1001. It needs the extra `devices`."""

    kind: Literal["snmp"] = "snmp"
    host: str = Field(description="the agent, switch7:1161 if its port is not 161")
    community_file: Path | None = Field(default=None, description="version 2c: community")
    user: str = Field(default="", max_length=32, description="version 3: the user")
    password_file: Path | None = Field(default=None, description="version 3: authentication password")
    privacy_file: Path | None = Field(default=None, description="version 3: privacy password")
    protocols: str = Field(
        default="SHA AES",
        pattern=r"^(MD5|SHA|SHA-224|SHA-256|SHA-384|SHA-512)( (DES|AES|AES-192|AES-256))?$",
        description="version 3: of password_file and privacy_file, from MD5 DES to SHA-512 AES-256",
    )
    period_s: float = Field(default=1.0, gt=0, le=60, description="time between two readings")

    @field_validator("host")
    @classmethod
    def _is_address(cls, value: str) -> str:
        try:
            host_and_port(value, PORT)
        except ValueError as error:
            raise ValueError("give a name or an address, switch7 or switch7:1161") from error
        return value

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        return host_and_port(self.host, PORT)

    @model_validator(mode="after")
    def _has_one_log_in_and_identifiers(self) -> Self:
        if bool(self.community_file) == bool(self.user and self.password_file):
            raise ValueError("give community_file (version 2c), or user and password_file (version 3)")
        for name in (value.name for fan in self.fan for _, value in fan.columns()):
            if not re.fullmatch(r"\.?[0-2](\.\d{1,10}){1,127}", name):
                raise ValueError(f"{name!r} is no identifier with numbers: snmptranslate -On shows them")
        return self
