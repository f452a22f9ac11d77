"""Keys of alarm and wear snapshots that earlier versions wrote. Recordings and run folders contain them.

The FanScorer's part of a snapshot has its own table.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

FORMER_ALARM_KEYS = {"told": "last_emitted"}
FORMER_CONDITION_KEYS = {"lasted_ns": "held_ns"}
FORMER_WEAR_KEYS = {"tried": "last_attempt"}
FORMER_PARAMETER_KEYS = {"why_not": "unknown_reason", "invalid_reason": "unknown_reason"}


def current_keys(stored: Mapping[str, Any], former: Mapping[str, str]) -> dict[str, Any]:
    """The same values under the keys of today. former: former key -> key of today."""
    return {former.get(key, key): value for key, value in stored.items()}
