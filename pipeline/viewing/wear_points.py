"""The wear of fans as it is drawn: the points in a scorer's snapshot, on a timeline of days."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from schemas.messages import Array, ScorerSnapshot


@dataclass(frozen=True)
class ParameterWords:
    """How a parameter is shown: its values times `scale`, in `unit`."""

    title: str
    unit: str
    scale: float


PARAMETERS = {
    "balance": ParameterWords("torque balance", "command", 1.0),
    "drag": ParameterWords("drag", "% of healthy", 100.0),
    "friction": ParameterWords("friction", "command", 1.0),
    "gain": ParameterWords("gain", "% of healthy", 100.0),
}
"""the parameters of `scoring.wear`"""


@dataclass(frozen=True, eq=False)
class WearPoints:
    """Points of one parameter of one fan: (n,) times in ns since the epoch, changes and standard errors as shown."""

    fan: int
    parameter: str
    t_ns: Array
    change: Array
    std_error: Array

    def after(self, t_ns: int) -> WearPoints:
        """Those that are newer."""
        newer = self.t_ns > t_ns
        return WearPoints(self.fan, self.parameter, self.t_ns[newer], self.change[newer], self.std_error[newer])


def wear_points(snapshot: ScorerSnapshot) -> list[WearPoints]:
    """The points in a snapshot; none in that of a scorer that did not monitor wear, or of an unknown version."""
    found: list[WearPoints] = []
    try:
        for number, fan in enumerate(json.loads(snapshot.state_json)["wear"]["fans"]):
            for parameter, words in PARAMETERS.items():
                series = fan["parameters"][parameter]["series"]
                t_ns = np.array(series["t_ns"], np.int64)
                change, error = (words.scale * np.array(series[name], np.float64) for name in ("value", "std_error"))
                if len(t_ns) and t_ns.shape == change.shape == error.shape:
                    found.append(WearPoints(number, parameter, t_ns, change, error))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
        return []
    return found
