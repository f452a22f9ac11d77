"""Settings of a connection to an MQTT broker, for the source `mqtt` and the stage `mqtt`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Self

from pydantic import Field, model_validator

from fantwin.pipeline.sources.secret_file import LogIn

KEEPALIVE_S = 30
"""a client sends the broker something at least this often"""


class BrokerSettings(LogIn, frozen=True):
    """Address, user and certificates."""

    schemes: ClassVar[Mapping[str, int]] = {"mqtt": 1883, "mqtts": 8883}

    url: str = Field(
        description="mqtt://HOST; mqtts://HOST encrypts, and checks the broker's certificate; USER@HOST logs in; "
        "HOST:PORT, if not 1883 (mqtts: 8883)"
    )
    ca: Path | None = Field(
        default=None,
        description="authority that signed the broker's certificate; without it, those of the system",
    )
    certificate: Path | None = Field(default=None, description="certificate of this client, if the broker asks for one")
    key: Path | None = Field(default=None, description="private key of that certificate")

    @property
    def tls(self) -> bool:
        """Whether the connection is encrypted."""
        return self.parts.scheme == "mqtts"

    @model_validator(mode="after")
    def _certificates_fit(self) -> Self:
        if not self.tls and (self.ca or self.certificate or self.key):
            raise ValueError("ca, certificate and key need mqtts:// in url")
        if bool(self.certificate) != bool(self.key):
            raise ValueError("give certificate and key, or neither")
        return self
