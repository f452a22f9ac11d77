"""The wear of the fans of a tray for people: what a scorer's snapshots carry of it."""

from __future__ import annotations

import json
from typing import Any

from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import ScorerSnapshot
from fantwin.scoring.wear.slow_change import LIMIT_SHARE, SlowChange

_SHOWN = ("seen_t_ns", "change", "change_std_error", "beside", "per_day", "days", "reached_t_ns", "unknown_reason")


def shown(found: SlowChange | None) -> dict[str, Any]:
    """The change of a fan as JSON values, shares of the speed; null where something is not known."""
    if found is None:
        return dict.fromkeys(_SHOWN)
    trend, forecast = found.trend, found.forecast
    reached = {"earliest": forecast.earliest_ns, "likely": forecast.likely_ns, "latest": forecast.latest_ns}
    values = (
        found.t_ns,
        found.change,
        found.std_error,
        found.beside,
        trend and {"value": trend.slope_per_day, "low": trend.low, "high": trend.high},
        trend and trend.days,
        reached if forecast.likely_ns else None,
        forecast.unknown_reason,
    )
    return dict(zip(_SHOWN, values, strict=True))


def wear_in(snapshot: ScorerSnapshot) -> dict[str, Any] | None:
    """The state of the wear monitor in a snapshot; None if there is none that can be read."""
    try:
        wear = json.loads(snapshot.state_json)["wear"]
        wear_rows("", 0, wear)
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
    return wear


def wear_rows(tray: str, t_ns: int, wear: dict[str, Any], names: FanNames = NO_NAMES) -> list[dict[str, Any]]:
    """A row for each fan with a point, for machines. t_ns: of the snapshot; its seen_t_ns: at which the values hold.
    names: of the fans."""
    return [
        {
            "tray": tray,
            "fan": number,
            "name": names.name(number),
            "parameter": "speed",
            "unit": "relative",
            "limit": LIMIT_SHARE,
            "t_ns": t_ns,
        }
        | {name: fan[name] for name in _SHOWN}
        for number, fan in enumerate(wear["fans"])
        if fan["seen_t_ns"]
    ]
