"""The wear of the fans of a tray, as a scorer's snapshots carry it, for whoever shows it."""

from __future__ import annotations

import json
from typing import Any

from schemas.messages import ScorerSnapshot

_SHOWN = ("unit", "change", "per_day", "days", "limit", "reached_t_ns", "unknown_reason")


def wear_in(snapshot: ScorerSnapshot) -> dict[str, Any] | None:
    """The state of the wear monitor in a snapshot; None in one of a scorer that did not monitor wear yet."""
    try:
        wear = json.loads(snapshot.state_json)["wear"]
        wear_rows("", 0, wear)
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
    return wear


def wear_rows(tray: str, t_ns: int, wear: dict[str, Any]) -> list[dict[str, Any]]:
    """A row for each fan and parameter that has a value, for machines. t_ns: of the snapshot."""
    return [
        {
            "tray": tray,
            "fan": number,
            "parameter": parameter,
            **{name: values[name] for name in _SHOWN},
            "change_std_error": None if values["per_day"] else values["series"]["std_error"][-1],
            "command_unit": wear["command_unit"],
            "seen_t_ns": fan["t_ns"],
            "t_ns": t_ns,
        }
        for number, fan in enumerate(wear["fans"])
        for parameter, values in fan["parameters"].items()
        if "change" in values
    ]
