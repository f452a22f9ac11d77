"""What a user asks of a file, and says of it where it does not show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from fantwin.pipeline.errors import UsageError

ORDERS = ("dmy", "mdy", "ymd")
"""orders of the day, month and year of a date"""


@dataclass(frozen=True)
class Wanted:
    """What is read of a file, and how; empty: it is found.

    Attributes:
        command, speed: as for `fan_columns`; both empty: those that the program that wrote the file is known to write.
        time: column of the times of a table, `COLUMN`, `COLUMN:UNIT` with unit s, ms, us, ns or iso (dates), or
            `DATE+TIME`, two columns.
        period: time between rows of a table without times, such as `10ms`.
        channels: columns, by the name of their channel.
        dates: order of the parts of a date, dmy, mdy or ymd.
        zone: time zone of dates without one.
        decimal: decimal mark of the numbers.
        poles: magnetic poles of the motors, for electrical speeds.
        has_command: false where the file has none, and `command` names the speeds in its place.

    Raises:
        UsageError: there is no such order or mark, or both times and their period are given.
    """

    command: Sequence[str] = ()
    speed: Sequence[str] = ()
    time: str | None = None
    period: str | None = None
    channels: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])
    dates: str = ""
    zone: str = ""
    decimal: str = ""
    poles: int | None = None
    has_command: bool = True

    def __post_init__(self) -> None:
        if self.time and self.period:
            raise UsageError("--period is for tables without a time column: leave out --time or --period")
        if self.decimal not in ("", ".", ","):
            raise UsageError(f"--decimal {self.decimal}: give . or ,")
        if self.dates not in ("", *ORDERS):
            raise UsageError(f"--dates {self.dates}: give dmy, mdy or ymd, the order in the file")
