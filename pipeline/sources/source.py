"""Source of samples: where the readings of one tray come from and its commands go to.

A source delivers readings as the device gives them, in the units of its tray. Everything else is shared by all sources
and lives in pipeline/acquisition: range checks, unit conversion, message blocks, losses by sequence number.

To add a source, make a folder with a `SourceConfig` and a `SampleSource`, and add its row to
pipeline/sources/kinds.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Protocol, TypeAlias

from pydantic import BaseModel

from fantwin.schemas.channels import FanValues
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import RAD_S_PER_UNIT

MOST_FANS = 1024
"""fans of a tray: those whose samples come in one reading"""


class SourceConfig(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """Base of every kind's settings, `source = { kind = "...", ... }` of a [[tray]]: frozen, unknown keys refused."""

    takes_pushed: ClassVar[bool] = False
    """true if the samples of the tray are those that clients push over the bus"""

    takes_port: ClassVar[bool] = False
    """true if the source takes something that only one process can have, so that a check fails while it runs"""

    shares_process: ClassVar[bool] = False
    """true if one process of acquisition has all such trays of a site, unless the configuration says otherwise"""

    no_speed: ClassVar[str] = "is its tacho connected?"
    """what to look at where a fan has no speed"""

    kind: str

    @property
    def most_fans(self) -> int:
        """The most fans of a tray with this source."""
        return MOST_FANS

    @property
    def why_no_commands(self) -> str:
        """Why `fantwin command` cannot reach the fans, in a few words; empty if it can."""
        return ""

    @property
    def stated_tachos(self) -> tuple[Tacho, ...]:
        """Tachos of this source, one for all fans or one for each; empty if the kind of source does not determine them.
        `tacho` of the [[tray]] overrides them."""
        return ()


def too_many_fans(kind: str, fans: int, most: int) -> str:
    """The error of a tray with more fans than its source carries."""
    return f"fans = {fans}: a {kind} source carries at most {most} fans; make several trays of them"


FLOAT32_TOLERANCE = 1e-6


def limits_of_float32(low: float, high: float) -> tuple[float, float]:
    """The range from low to high, widened by the rounding of float32, so that 0.1 as float32 is not beyond 0.1."""
    tolerance = FLOAT32_TOLERANCE * max(abs(low), abs(high))
    return low - tolerance, high + tolerance


def within(value: float, low: float, high: float) -> bool:
    """Return whether a float32 value lies in a range given in decimals."""
    least, most = limits_of_float32(low, high)
    return least <= value <= most


@dataclass(frozen=True, slots=True)
class ReadingLimits:
    """Limits for accepted readings of a tray; commands in the tray's unit, speeds in its speed unit."""

    fans: int
    command_min: float
    command_max: float
    speed_max: float
    has_stand_in: bool = False
    """something stands for the command (pipeline.sources.stand_in): readings need none"""

    def why_refused(self, reading: Reading) -> Rejected | None:
        """Why a reading cannot be used; None: it can, maybe without some speeds."""
        if not len(reading.command) == len(reading.speed) == self.fans:
            detail = f"a reading of {len(reading.speed)} fans, this tray has {self.fans}"
            return Rejected("wrong_fan_count", detail, is_sample=True, setting=f"fans = {self.fans}")
        if self.has_stand_in:
            return None
        # Without its actual command a fan cannot be judged, and a command must not be invented: NaN is one not known.
        if all(map(math.isnan, reading.command)):
            detail = "the command of no fan is known, and no command_from stands for it"
            return Rejected("unknown_command", detail, is_sample=True, setting="source and command_from")
        for command in reading.command:
            if not (math.isnan(command) or within(command, self.command_min, self.command_max)):
                limits = f"command_min = {self.command_min:g} to command_max = {self.command_max:g}"
                detail = f"command {command:g} is outside {limits}"
                return Rejected("absurd_command", detail, is_sample=True, setting="command_min and command_max")
        return None

    def absurd_speeds(self, reading: Reading) -> int:
        """Number of speeds beyond the largest one: acquisition takes them for missing."""
        return sum(abs(speed) > self.speed_max for speed in reading.speed)


@dataclass(frozen=True, slots=True)
class SourceContext:
    """Context of a source: what it has to know of its tray."""

    fans: int
    speed_unit: str
    """unit of `Reading.speed`: rad/s or rpm"""
    folder: Path
    """relative paths of the configuration start here"""
    tray: str = ""
    """its name"""
    limits: ReadingLimits | None = None
    """limits of accepted readings, for a source that reports refused ones to their sender; None: not known"""
    run_folder: Path | None = None
    """folder where it may keep files; None: nowhere"""
    names: FanNames = NO_NAMES

    @property
    def units_per_rpm(self) -> float:
        """One rpm in the speed unit."""
        return RAD_S_PER_UNIT["rpm"] / RAD_S_PER_UNIT[self.speed_unit]


@dataclass(frozen=True, slots=True)
class Reading:
    """Sample of all fans of a tray, one value per fan.

    A source without a device clock gives no `clock_us`: the sample's time is then its time of receipt. Without a
    `sequence`, losses between device and host cannot be seen.
    """

    command: tuple[float, ...]
    """commands in the tray's command unit; NaN where it is not known"""
    speed: tuple[float, ...]
    """speeds in the tray's speed unit; NaN where there is no reading"""
    clock_us: int | None = None
    """device clock at the time of measurement, modulo 2^32"""
    sequence: int | None = None
    """number of the sample, modulo 2^32"""
    measured: FanValues = field(default_factory=dict[str, tuple[float, ...]])
    """by channel that the source measures: one value per fan, NaN where it is not known"""


@dataclass(frozen=True, slots=True)
class Rejected:
    """Input that is no reading of the tray. `kind` is the name of the counter it is counted under."""

    kind: str
    detail: str
    harmless: bool = False
    """True if it is not a sign of a bad connection"""
    is_sample: bool = False
    """True if it is a sample: it is lost"""
    setting: str = ""
    """the setting of the tray that does not fit, for example `fans = 4`; empty if it is not known"""


@dataclass(frozen=True, slots=True)
class Noted:
    """What a source has seen of its device that is no input. `kind` is the name of its counter; health shows the last
    `detail` of each kind, and how often there was one."""

    kind: str
    detail: str


@dataclass(frozen=True, slots=True)
class ReadingBatch:
    """Readings that arrived together. It may be empty: a source also reports input that completes no reading."""

    received_t_ns: int
    """host time, ns since the epoch"""
    items: Sequence[Reading | Rejected | Noted]
    byte_count: int = 0
    """bytes received, where the source counts them"""
    device_counts: Mapping[str, int] = field(default_factory=dict)
    """the advance of the counters of the device itself, such as that of damaged frames, since the batch before"""


@dataclass(frozen=True, slots=True)
class LinkUp:
    """The source is connected. The device may have been restarted since the last reading."""


@dataclass(frozen=True, slots=True)
class LinkDown:
    """The source is not connected; `reason` says why and what to do, in one line, without the name of the source."""

    reason: str


SourceEvent: TypeAlias = ReadingBatch | LinkUp | LinkDown


class SampleSource(Protocol):
    """An open source. It is built as `Source(config, context)`, which raises `UserError` if a setting is missing."""

    @property
    def name(self) -> str:
        """Name of the connection for people, for example its port."""
        ...

    @property
    def settings_to_check(self) -> str:
        """The settings to look at when no valid reading arrives, for example `baud = 115200`; may be empty."""
        ...

    def start(self, deliver: Callable[[SourceEvent], None]) -> None:
        """Begin to deliver from a thread of its own; `deliver` blocks while the stage is behind."""
        ...

    def stop(self) -> None:
        """Deliver what has already arrived, then end."""
        ...

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        """Send to the device. Returns why nothing was sent, in a few words; empty if it was. Never blocks for long,
        never raises.

        command: in the tray's command unit; set_point: in its speed unit. Each has one value per fan, where NaN leaves
        the fan as it is, or is empty.
        """
        ...

    def check(self) -> list[str]:
        """Problems that would keep the source from connecting now, one line each."""
        ...
