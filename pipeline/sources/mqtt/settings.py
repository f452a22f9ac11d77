"""Settings of a connection to an MQTT broker, for the source `mqtt` and the stage `mqtt`."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from fantwin.pipeline.sources.secret_file import LogIn

KEEPALIVE_S = 30
"""a client sends the broker something at least this often"""


class BrokerSettings(LogIn, frozen=True):
    """Address, user and certificates."""

    host: str = Field(min_length=1, description="name or address of the broker")
    port: int = Field(default=1883, ge=1, le=65535, description="port of the broker; with TLS usually 8883")
    tls: bool = Field(default=False, description="whether to encrypt the connection and check the broker's certificate")
    ca: Path | None = Field(
        default=None,
        description="certificate of the authority that signed the broker's; without it, those of the system are used",
    )
    certificate: Path | None = Field(default=None, description="certificate of this client, if the broker asks for one")
    key: Path | None = Field(default=None, description="private key of that certificate")

    @model_validator(mode="after")
    def _certificates_fit(self) -> Self:
        if not self.tls and (self.ca or self.certificate or self.key):
            raise ValueError("ca, certificate and key need tls = true")
        if bool(self.certificate) != bool(self.key):
            raise ValueError("give certificate and key, or neither")
        return self
