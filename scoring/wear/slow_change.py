"""Slow change of one fan, and the notices about it before it reaches the limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.wear.trend import LimitForecast, Trend

LIMIT_SHARE = 0.1
"""share of the speed; an alarm is raised where a change has surely reached it"""
WEAR_HINT = "see fantwin status --wear"
"""each notice about one fan ends with it"""
MOST_FANS = "most fans turn"
"""a notice about what the fans of a tray share begins with it"""


@dataclass(frozen=True)
class SlowChange:
    """Change of a fan's speed since commissioning, at its newest point.

    change, std_error: shares of the speed. beside: the median change of the other fans since then; None without any.
    trend: of the points. forecast: of a change by LIMIT_SHARE.
    """

    t_ns: int
    change: float
    std_error: float
    beside: float | None
    trend: Trend | None
    forecast: LimitForecast


def is_of_slow_change(note: str) -> bool:
    """Return whether a note of a scorer is about fans that change slowly, one of them or most of a tray."""
    return note.endswith(WEAR_HINT) or note.startswith(MOST_FANS)


def own_change(fan: str, change: float, age_ns: int, beside: float | None) -> str:
    """The notice about a fan, by its label, that has changed against those beside it. Changes: shares of the speed."""
    hours = age_ns / (3600.0 * NS_PER_S)
    age = f"{hours:.0f} h" if hours < 48.0 else f"{hours / 24.0:.0f} days"
    compared = f", the fans beside it {100 * beside:+.1f} %" if beside is not None else ""
    return f"{fan}: speed {100 * change:+.1f} % in {age}{compared}: {WEAR_HINT}"


def shared_change(share: float) -> str:
    """The notice about a change that most fans of a tray share, as a share of the speed."""
    direction = "slower" if share < 0.0 else "faster"
    return (
        f"{MOST_FANS} {100 * abs(share):.0f} % {direction} than when they were commissioned: the air, the supply, or a "
        "filter in front of them all"
    )


def limit_ahead(fan: str, others: str, change: float, days: Sequence[float]) -> str:
    """The line about the fan that reaches its limit first, and the others that will, as they are shown.

    change: so far. days: until the limit is likely reached, at the earliest and at the latest; zeros: it may have been.
    """
    likely, earliest, latest = days
    limit = f"{100 * LIMIT_SHARE:.0f} %"
    reached = f"it will have lost {limit} of its speed" if change < 0.0 else f"it will turn {limit} faster"
    unit = "day" if round(likely) == 1 else "days"
    when = f"in about {likely:.0f} {unit} ({earliest:.0f} to {latest:.0f})" if likely > 0.5 else "within a day"
    if not latest:
        reached, when = "it has lost" if change < 0.0 else "it turns faster by", f"about {limit} of its speed"
    more = f", and {others}" if others else ""
    return f"{fan} is wearing: {reached} {when}; inspect it{more}"
