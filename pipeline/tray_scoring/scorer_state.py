"""The state of a scorer in a snapshot: one object, which is read as a whole or not at all."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from fantwin.schemas.messages import ScorerSnapshot
from fantwin.scoring.alarms.alarm_manager import AlarmsState
from fantwin.scoring.saved import Arrays, as_json, from_json
from fantwin.scoring.wear.wear_monitor import WearState

NEVER_NS = 1 << 62  # times from here on, and those up to 0, are marks and no times


@dataclass(eq=False)
class ScorerState:
    """What a scorer continues from: its arrays by name, alarms, and wear."""

    input_producer: str
    """producer of the last prediction"""
    arrays: Arrays
    alarms: AlarmsState
    wear: WearState

    @classmethod
    def of(cls, snapshot: ScorerSnapshot) -> ScorerState:
        """The state in a snapshot.

        Raises:
            ValueError, LookupError, TypeError, AttributeError, OverflowError: there is none that can be read.
        """
        return _STATE.validate_json(snapshot.state_json)

    def snapshot(self, t_ns: int, twin_sha256: str) -> ScorerSnapshot:
        """The message with this state. t_ns: of the last sample."""
        values = _STATE.dump_python(self, mode="json", exclude_defaults=True)
        return ScorerSnapshot(t_ns=t_ns, twin_sha256=twin_sha256, state_json=json.dumps(values, allow_nan=False))


_STATE = TypeAdapter(ScorerState)


def with_times_moved(snapshot: ScorerSnapshot, by_ns: int) -> ScorerSnapshot:
    """A snapshot with all absolute times moved, for a host clock that was set back while the site was stopped."""
    values = json.loads(snapshot.state_json)
    arrays = from_json(values["arrays"])
    for name, array in arrays.items():
        if name.endswith("t_ns"):
            arrays[name] = np.where((array > 0) & (array < NEVER_NS), np.maximum(array + by_ns, 1), array)
    moved = _moved(values, by_ns) | {"arrays": as_json(arrays)}
    return replace(snapshot, t_ns=snapshot.t_ns + by_ns, state_json=json.dumps(moved))


def _moved(value: Any, by_ns: int, *, is_time: bool = False) -> Any:
    """JSON values, with the times moved: what has a name that ends in t_ns."""
    if isinstance(value, dict):
        return {name: _moved(each, by_ns, is_time=is_time or name.endswith("t_ns")) for name, each in value.items()}
    if isinstance(value, list):
        return [_moved(each, by_ns, is_time=is_time) for each in value]
    if is_time and isinstance(value, int) and 0 < value < NEVER_NS:
        return max(1, value + by_ns)
    return value
