"""Settings of a tray whose samples clients push over the bus: `source = { kind = "push" }`."""

from __future__ import annotations

from typing import ClassVar, Literal

from fantwin.pipeline.sources.source import SourceConfig


class PushConfig(SourceConfig, frozen=True):
    """Samples come from a program that uses `fantwin.client`, or publishes topic `reading` itself."""

    takes_pushed: ClassVar[bool] = True

    kind: Literal["push"] = "push"

    @property
    def why_no_commands(self) -> str:
        """Reason why no command is sent to the program that pushes samples."""
        return "the program that pushes its samples moves the fans"
