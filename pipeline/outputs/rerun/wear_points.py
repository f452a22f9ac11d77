"""The wear of fans as it is drawn: the points in a scorer's snapshot, on a timeline of days."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from fantwin.schemas.messages import Array, ScorerSnapshot


@dataclass(frozen=True, eq=False)
class WearPoints:
    """Points of one fan: (n,) times in ns since the epoch, changes of its speed and standard errors, in %."""

    fan: int
    t_ns: Array
    change: Array
    std_error: Array

    def after(self, t_ns: int) -> WearPoints:
        """Those that are newer."""
        newer = self.t_ns > t_ns
        return WearPoints(self.fan, self.t_ns[newer], self.change[newer], self.std_error[newer])


def wear_points(snapshot: ScorerSnapshot) -> list[WearPoints]:
    """The points in a snapshot; none in one without wear, or of an unknown version."""
    found: list[WearPoints] = []
    try:
        wear = json.loads(snapshot.state_json)["wear"]
        for number, (fan, newest) in enumerate(zip(wear["fans"], wear["state"]["value"], strict=True)):
            t_ns = np.array(fan["series"]["t_ns"], np.int64)
            value, error = (np.array(fan["series"][name], np.float64) for name in ("value", "std_error"))
            if len(t_ns) and t_ns.shape == value.shape == error.shape:
                change = value - newest + fan["change"]
                found.append(WearPoints(number, t_ns, 100.0 * change, 100.0 * error))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
        return []
    return found
