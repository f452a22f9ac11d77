"""Settings of fans behind IPMI: `source = { kind = "ipmi", url = "ipmi://USER@bmc7", password_file = "secret" }`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from fantwin.pipeline.sources.named_values import NamedFansConfig
from fantwin.pipeline.sources.secret_file import LogIn

HERE = "ipmi://localhost"
"""address of this computer, whose controller is read by its driver"""


class IpmiConfig(NamedFansConfig, LogIn, frozen=True):
    """Fans of a server by IPMI. It needs the program ipmitool, which shows the names, or ids such as 41h, by `sdr`."""

    schemes: ClassVar[Mapping[str, int]] = {"ipmi": 623}

    kind: Literal["ipmi"] = "ipmi"
    url: str = Field(default=HERE, description="the controller: ipmi://USER@HOST; without it, that of this computer")
    cipher: int | None = Field(default=None, ge=0, le=17, description="cipher suite; without it ipmitool asks")
    period_s: float = Field(default=5.0, gt=0, le=60, description="time between two readings")

    @model_validator(mode="after")
    def _has_user(self) -> Self:
        if self.url != HERE and not (self.username and self.password_file):
            raise ValueError("a controller in the network needs a user in url, ipmi://USER@HOST, and password_file")
        return self
