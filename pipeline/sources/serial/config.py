"""Settings of a serial line: `source = { kind = "serial", port = "/dev/ttyUSB0" }`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from fantwin.pipeline.sources.source import MOST_FANS, SourceConfig

MOST_FANS_ON_LINE = 64
"""fans in a frame: `schemas.wire.MAX_FANS`, which is not imported for reading a configuration"""


class SerialConfig(SourceConfig, frozen=True):
    """A serial port and the form of the wire protocol on it (docs/reference/wire-protocol.md)."""

    kind: Literal["serial"] = "serial"
    port: str = Field(
        default="",
        description="serial port, /dev/ttyUSB0, or /dev/serial/by-id/NAME, which stays the same; only acquisition "
        "needs it",
    )
    baud: int = Field(default=115200, gt=0, description="bits a second")
    protocol: Literal["binary", "text"] = Field(default="binary", description="form of the frames on the line")

    @property
    def most_fans(self) -> int:
        """Columns of a frame. Without a port there is no line: the samples come from elsewhere, such as a replay."""
        return MOST_FANS_ON_LINE if self.port else MOST_FANS
