"""What a user says of a file that does not show it."""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.pipeline.errors import UsageError

ORDERS = ("dmy", "mdy", "ymd")
"""of the day, month and year of a date"""


@dataclass(frozen=True)
class Reading:
    """How a file is to be read; empty: it is found.

    Attributes:
        dates: order of the parts of a date, dmy, mdy or ymd.
        zone: time zone of dates without one.
        decimal: decimal mark of the numbers.
        poles: magnetic poles of the motors, for electrical speeds.

    Raises:
        UsageError: there is no such order or mark.
    """

    dates: str = ""
    zone: str = ""
    decimal: str = ""
    poles: int | None = None

    def __post_init__(self) -> None:
        if self.decimal not in ("", ".", ","):
            raise UsageError(f"--decimal {self.decimal}: give . or ,")
        if self.dates not in ("", *ORDERS):
            raise UsageError(f"--dates {self.dates}: give dmy, mdy or ymd, the order in the file")


AS_FOUND = Reading()
