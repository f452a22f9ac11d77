"""Settings of samples that come by HTTP: `source = { kind = "http", port = 8765 }`."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from fantwin.pipeline.sources.host_address import is_of_this_host_only
from fantwin.pipeline.sources.own_json import OwnSamples
from fantwin.pipeline.sources.source import SourceConfig


class HttpConfig(SourceConfig, OwnSamples, frozen=True):
    """An HTTP server for one tray, in its acquisition: docs/how-to/sources.md, docs/reference/json-samples.md."""

    takes_port: ClassVar[bool] = True

    kind: Literal["http"] = "http"
    host: str = Field(
        default="127.0.0.1", min_length=1, description="address to listen on; beyond loopback, token_file is needed"
    )
    port: int = Field(default=8765, ge=1, le=65535, description="port to listen on, another one for each tray")
    token_file: Path | None = Field(
        default=None,
        description="file with the token that clients send, in its first line; only its owner may be able to read it",
    )
    certificate: Path | None = Field(default=None, description="certificate of the server, for https")
    key: Path | None = Field(default=None, description="private key of that certificate")

    @property
    def is_local(self) -> bool:
        """Return whether only this host can reach the server."""
        return is_of_this_host_only(self.host)

    @property
    def why_no_commands(self) -> str:
        """Reason why no command is sent to the program that posts samples."""
        return "the program that posts its samples moves the fans"

    @model_validator(mode="after")
    def _is_protected(self) -> Self:
        if not self.is_local and self.token_file is None:
            raise ValueError(
                f"host = {self.host!r} can be reached from other hosts: give token_file, a file with a token"
            )
        if bool(self.certificate) != bool(self.key):
            raise ValueError("give certificate and key, or neither")
        return self
