"""Settings of a connection to an MQTT broker, for the source `mqtt` and the stage `mqtt`."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import BaseModel, Field, model_validator

KEEPALIVE_S = 30
"""a client sends the broker something at least this often"""


class BrokerSettings(BaseModel, frozen=True):
    """Address, user and certificates."""

    host: str = Field(min_length=1, description="name or address of the broker")
    port: int = Field(default=1883, ge=1, le=65535, description="port of the broker; with TLS usually 8883")
    username: str = Field(default="", description="user of the broker")
    password_file: Path | None = Field(
        default=None, description="file with the password in its first line; only its owner may be able to read it"
    )
    password_env: str = Field(
        default="", description="instead of password_file: environment variable that holds the password"
    )
    tls: bool = Field(default=False, description="whether to encrypt the connection and check the broker's certificate")
    ca: Path | None = Field(
        default=None,
        description="certificate of the authority that signed the broker's; without it, those of the system are used",
    )
    certificate: Path | None = Field(default=None, description="certificate of this client, if the broker asks for one")
    key: Path | None = Field(default=None, description="private key of that certificate")

    @model_validator(mode="after")
    def _secrets_fit(self) -> Self:
        if self.password_file and self.password_env:
            raise ValueError("give password_file or password_env, not both")
        if (self.password_file or self.password_env) and not self.username:
            raise ValueError("a password needs username")
        if not self.tls and (self.ca or self.certificate or self.key):
            raise ValueError("ca, certificate and key need tls = true")
        if bool(self.certificate) != bool(self.key):
            raise ValueError("give certificate and key, or neither")
        return self
