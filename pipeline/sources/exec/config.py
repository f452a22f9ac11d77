"""Settings of samples that a program prints: `source = { kind = "exec", program = ["./fans.py", "--rack", "3"] }`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, StrictBool

from fantwin.pipeline.sources.own_json import OwnSamples
from fantwin.pipeline.sources.source import SourceConfig


class ExecConfig(SourceConfig, OwnSamples, frozen=True):
    """A program that prints a line of JSON for each sample, docs/reference/json-samples.md or its own by pointers, and
    runs on."""

    kind: Literal["exec"] = "exec"
    program: tuple[str, ...] = Field(min_length=1, description="the program and its arguments, read by no shell")
    commands: StrictBool = Field(default=False, description="whether it reads commands, a line of JSON each")

    @property
    def why_no_commands(self) -> str:
        """Commands are passed on only where the program reads them."""
        return "" if self.commands else "its source does not have commands = true"
