"""The variables of a fan: their values now, each with its status and the time of its sample.

An old value is never good: of a silent tray it is uncertain, and where a fan is not judged there is none. No OPC UA
library is needed here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fantwin.pipeline.site.fan_history import CURVES
from fantwin.pipeline.site.fleet import SILENT, Fan, FanNow
from fantwin.pipeline.site.site_model import TrayNow
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Array
from fantwin.schemas.units import RAD_S_PER_UNIT

GOOD, SILENT_TRAY, OLD = "Good", "UncertainNoCommunicationLastUsableValue", "UncertainLastUsableValue"
NONE_YET, NO_VALUE = "BadWaitingForInitialData", "BadNoData"
_LINE_IS_SILENT = (InvalidReason.STALE, InvalidReason.GAP)
_Numbers: TypeAlias = tuple[Array, Array]


class Value(NamedTuple):
    """value: None where the status is bad. t_ns: of the sample, or since when a state lasts; 0: unknown."""

    value: Any
    status: str
    t_ns: int


@dataclass(frozen=True)
class FanVariable:
    """A variable of every fan.

    Attributes:
        empty: a value of its built-in type.
        about: for people.
        curve: of `CURVES`; empty: none.
        is_speed: in rpm.
    """

    empty: float | str | bool
    about: str
    curve: str = ""
    is_speed: bool = False


_JUDGED = (
    "whether the newest sample is judged, or the fan stands or starts as commanded: if not, no alarm can be raised"
)
_BAND = "half width of the band around the speed of the twin"
VARIABLES = {
    "Speed": FanVariable(0.0, "measured speed", "measured_speed_rad_s", True),
    "PredictedSpeed": FanVariable(0.0, "speed of the twin at the same commands", "predicted_speed_rad_s", True),
    "BandHalfWidth": FanVariable(0.0, _BAND, "band_half_width_rad_s", True),
    "Score": FanVariable(0.0, "how near the fan is to its limit: 1 is at the limit", "score"),
    "State": FanVariable("", "state of the fan, in words"),
    "Judged": FanVariable(False, _JUDGED),
}
"""by browse name, which is the last part of the node's identifier"""


class FanValues:
    """All fans at one moment."""

    def __init__(
        self, trays: Sequence[TrayNow] = (), states: Sequence[FanNow] = (), before: FanValues | None = None
    ) -> None:
        """before: whose numbers are the last usable ones of fans of which no sample arrives."""
        self._usable = {each.tray: _usable(each, before._usable.get(each.tray) if before else None) for each in trays}
        self._trays: Mapping[str, TrayNow] = {each.tray: each for each in trays}
        self._states: Mapping[Fan, FanNow] = {each.fan: each for each in states}

    def of(self, fan: Fan, name: str) -> Value:
        """The value of one of `VARIABLES`."""
        tray = self._trays.get(fan.tray)
        if name == "State":
            state = self._states.get(fan)
            return Value(state.state, GOOD, state.since_t_ns) if state else Value(SILENT, GOOD, 0)
        if tray is None:
            return Value(False, GOOD, 0) if name == "Judged" else Value(None, NONE_YET, 0)
        if name == "Judged":
            state = self._states.get(fan)
            is_judged = tray.is_heard and bool(tray.is_judged[fan.number])
            return Value(is_judged, GOOD, state.since_t_ns if state else tray.t_ns)
        variable = VARIABLES[name]
        place = fan.number, CURVES.index(variable.curve)
        values, times_ns = self._usable[fan.tray]
        value, t_ns = float(values[place]), int(times_ns[place])
        value /= RAD_S_PER_UNIT["rpm"] if variable.is_speed else 1.0
        reason = int(tray.invalid_reason[fan.number])
        is_silent = not tray.is_heard or reason == InvalidReason.STALE
        if math.isnan(value) or (t_ns != tray.t_ns and not is_silent and name != "Speed"):
            return Value(None, NO_VALUE, tray.t_ns)
        return Value(value, SILENT_TRAY if is_silent else OLD if reason in _LINE_IS_SILENT else GOOD, t_ns)


def _usable(tray: TrayNow, before: _Numbers | None) -> _Numbers:
    """The newest number of each curve, and the time of its sample: of before where no sample has arrived."""
    values = tray.values[:, : len(CURVES)]
    times_ns = np.full(values.shape, tray.t_ns)
    if before is None:
        return values, times_ns
    is_old = np.isnan(values) & np.isin(tray.invalid_reason, _LINE_IS_SILENT)[:, np.newaxis]
    return np.where(is_old, before[0], values), np.where(is_old, before[1], times_ns)
