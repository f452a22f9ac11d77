"""The contents of frames of the serial line, and the reasons why a piece of the stream is not a frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import TypeAlias

from fantwin.schemas.channels import FanValues

VERSION = 1
MAX_FANS = 64
UINT16, UINT32 = 1 << 16, 1 << 32
DEVICE_COUNTERS = (
    *("frames", "bad_length", "bad_crc", "wrong_kind", "bad_value", "line_errors", "overruns", "unsent_samples"),
    *("lost_edges", "glitches", "host_silences", "watchdog_resets"),
)
"""the counters of a device, in the order of its frame; docs/reference/wire-protocol.md explains each"""


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample of a device.

    Attributes:
        clock_us, sequence: wrap at 2^32; None if a text device has none.
        command: one value per fan, in the tray's command unit.
        speed: one value per fan, in the tray's speed unit; NaN without a tacho reading.
        measured: by name of channel, one value per fan, NaN if unknown; without those that are not measured.
    """

    clock_us: int | None
    sequence: int | None
    command: tuple[float, ...]
    speed: tuple[float, ...]
    measured: FanValues = field(default_factory=dict[str, tuple[float, ...]])


@dataclass(frozen=True, slots=True)
class CommandFrame:
    """Commands, one per fan, in the tray's command unit; NaN leaves a fan unchanged."""

    command: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class SetPointFrame:
    """Speed set-points, one per fan, in the tray's speed unit, for a device with its own loop; NaN: unchanged."""

    set_point: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class DeviceCounters:
    """The counters of a device since it started.

    Attributes:
        uptime_s: whole seconds since the start. A smaller one than in the frame before shows a restart, or a wrap.
        counts: the first ones of `DEVICE_COUNTERS`; they wrap at 2^16.
    """

    uptime_s: int
    counts: tuple[int, ...]


class FaultKind(Enum):
    """Why a piece of the stream is not a frame."""

    RESYNC = "resync"  # the rest of a frame that began before listening started: harmless
    GARBAGE = "garbage"  # does not look like a frame
    TRUNCATED = "truncated"  # begins like a frame, but has the wrong length
    OVERSIZED = "oversized"  # longer than any frame
    WRONG_CRC = "wrong_crc"
    WRONG_VERSION = "wrong_version"
    UNKNOWN_TYPE = "unknown_type"  # a whole frame of a later version of the protocol: harmless
    WRONG_TYPE = "wrong_type"  # not for this end of the line, or with unknown columns
    WRONG_FAN_COUNT = "wrong_fan_count"
    BAD_NUMBER = "bad_number"  # a field of a text line is not a number, or is out of range
    BAD_COMMAND = "bad_command"  # a sample's command is NaN or infinite


@dataclass(frozen=True, slots=True)
class Fault:
    """A piece of the stream that is not a frame, and why."""

    kind: FaultKind
    detail: str


Frame: TypeAlias = Sample | DeviceCounters | CommandFrame | SetPointFrame


class FrameError(Exception):
    """A piece of the stream is not a frame, for the reason of `fault`."""

    def __init__(self, kind: FaultKind, detail: str) -> None:
        super().__init__(kind, detail)
        self.fault = Fault(kind, detail)
