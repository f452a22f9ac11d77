"""Section `[opcua]`."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from fantwin.pipeline.runtime.stage import StageConfig
from fantwin.pipeline.sources.host_address import is_of_this_host_only


class OpcuaConfig(StageConfig):
    """Where fans and alarms are served by OPC UA, and who may see them and act.

    Beyond loopback it needs users. What a user sends and sees is signed and encrypted.
    """

    host: str = Field(default="127.0.0.1", description="address to listen on")
    port: int = Field(default=4840, ge=1, le=65535, description="port; shard K uses the K-th from here on")
    certificate: Path | None = Field(
        default=None,
        description="PEM or DER file: the server's certificate; without it, the stage makes one for the "
        "name of this host",
    )
    key: Path | None = Field(default=None, description="PEM file: its private key")
    users: Path | None = Field(
        default=None, description="file of users, written by `fantwin users`; without it nobody can act over OPC UA"
    )
    trusted: Path | None = Field(
        default=None,
        description="folder of client certificates (PEM or DER): only these clients may connect encrypted; without it, "
        "all may",
    )

    @property
    def is_loopback(self) -> bool:
        """Whether only this host reaches it."""
        return is_of_this_host_only(self.host)

    @model_validator(mode="after")
    def _check(self) -> OpcuaConfig:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together: give both, or none")
        if not self.is_loopback and self.users is None:
            raise ValueError(f"host {self.host} is beyond loopback: that needs users (`fantwin users add NAME`)")
        return self
