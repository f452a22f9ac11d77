"""A line to a device, as a core sees it: what comes from it, and how to write to it.

It carries bytes and knows no protocol.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class LinkUp:
    """The line is open. What comes next may begin in the middle of a frame."""

    port: str


@dataclass(frozen=True, slots=True)
class LinkDown:
    """The line is not open; `reason` says why and what to do, in one line."""

    reason: str


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes that arrived, and the host's time at which they did, ns since the epoch."""

    data: bytes
    t_ns: int


class ByteLink(Protocol):
    """Where a core writes what goes down the line."""

    def write(self, data: bytes) -> bool:
        """Send bytes; False if the line did not take all of them in time. Never blocks for long, never raises."""
        ...
