"""Times of a recording, for people.

A recording of a line has dates. A table without dates that was imported counts from the zero of its time column: its
times are shown in seconds, not as the first hours of 1970.
"""

from __future__ import annotations

from datetime import UTC, datetime

from fantwin.schemas.units import NS_PER_S

_FIRST_DATE_NS = 365 * 86_400 * NS_PER_S
"""earlier times are no dates"""


def has_date(t_ns: int) -> bool:
    """Whether a time in ns since 1970 is a date, and not a count from the zero of a table."""
    return t_ns >= _FIRST_DATE_NS


def format_utc(t_ns: int) -> str:
    """A time in ns since 1970 as UTC in ISO 8601, to the millisecond; in seconds if it is no date."""
    if not has_date(t_ns):
        return _seconds(t_ns)
    return datetime.fromtimestamp(t_ns / NS_PER_S, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def format_local(t_ns: int) -> str:
    """A time in ns since 1970 as local date and time, to the millisecond; in seconds if it is no date."""
    if not has_date(t_ns):
        return _seconds(t_ns)
    return datetime.fromtimestamp(t_ns / NS_PER_S).isoformat(sep=" ", timespec="milliseconds")


def format_clock(t_ns: int) -> str:
    """A time in ns since 1970 as local time of day; in seconds if it is no date."""
    return datetime.fromtimestamp(t_ns / NS_PER_S).strftime("%H:%M:%S") if has_date(t_ns) else _seconds(t_ns)


def _seconds(t_ns: int) -> str:
    return f"{t_ns / NS_PER_S:.3f} s"
