"""Slow wear of a tray: every so often, when a fan is quiet, how far its parameters have moved since commissioning.

Drag, friction and gain are identified again over the last seconds (scoring.wear.reidentification), each as if it
alone had
moved. `balance` is the torque balance's own baseline, that follows the fan as far as it may; of it a limit is known,
where its alarm comes. Each is a series with a trend per day (scoring.wear.trend). See docs/explanation/wear.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from schemas.messages import Array
from scoring.diagnosis.diagnoser import Diagnoser
from scoring.diagnosis.regression_window import HealthyBalance
from scoring.wear.reidentification import parameter_drifts
from scoring.wear.trend import NS_PER_DAY, Reached, Trend, WearSeries, reached

UNITS = {"balance": "command", "drag": "relative", "friction": "command", "gain": "relative"}
"""of what is watched; `command`: in units of it"""
TRY_NS = 10_000_000_000
"""so often it is looked whether a fan that is due is quiet"""
SHORTEST_DAYS = 1.0
"""a limit is foretold from a day and a night on: before that all is the weather, or a bearing that warms up"""
SOON_DAYS = 7.0
"""what lies nearer is told"""
WINDOW_S = 35.0
"""so far a point looks back"""
NEVER_NS = int(np.iinfo(np.int64).min)
LARGEST = 1e6
"""no fan changes so much: what is larger is left out"""


@dataclass(frozen=True)
class Wear:
    """What is known of one parameter of one fan. change: since commissioning, by the trend's line if there is one."""

    change: float
    trend: Trend | None
    limit: float | None
    reached: Reached


class WearMonitor:
    """Of one tray's fans. What it finds does not depend on how samples are cut into blocks."""

    def __init__(
        self, healthy: Sequence[HealthyBalance], diagnoser: Diagnoser, every_s: float, command_unit: str
    ) -> None:
        """diagnoser: has the last seconds. every_s: a point of each fan so often."""
        self._healthy = healthy
        self._diagnoser = diagnoser
        self._every_ns = round(every_s * 1e9)
        self._unit = command_unit
        self._tried = 0
        self._disturbed_t_ns = np.full(len(healthy), NEVER_NS)
        """(fans,) the last sample that no point may look back on"""
        self._fans = [_Fan() for _ in healthy]

    def update(
        self,
        t_ns: Array,
        origin_t_ns: int,
        quiet: Array,
        disturbed: Array,
        commissioned_command: Array,
        held: Array,
        limit_command: Array,
    ) -> None:
        """Take a block that the diagnoser has taken; (n, fans) each but t_ns, (n,), and limit_command, (fans,).

        quiet: a point may be taken here. disturbed: nor is one for as long as it would look back on this.
        commissioned_command: baseline of the balance at the end of commissioning, NaN before. held: it may go no
        further, and says nothing more. limit_command: how far the balance may be from that until its alarm comes.
        """
        tries = np.maximum((t_ns - origin_t_ns) // TRY_NS, self._tried)
        for row in np.flatnonzero(np.diff(tries, prepend=self._tried) > 0).tolist():
            at_ns = int(t_ns[row])
            slot = (at_ns - origin_t_ns) // self._every_ns
            undisturbed = self._last_disturbed(t_ns[: row + 1], disturbed[: row + 1]) <= at_ns - round(WINDOW_S * 1e9)
            for fan in np.flatnonzero(quiet[row] & undisturbed & np.isfinite(commissioned_command[row])).tolist():
                due = slot > self._fans[fan].slot
                if due and self._look(fan, at_ns, float(commissioned_command[row, fan]), bool(held[row, fan])):
                    self._fans[fan].slot = slot
                    self._fans[fan].tell(at_ns, float(limit_command[fan]))
        self._tried = int(tries[-1])
        self._disturbed_t_ns = self._last_disturbed(t_ns, disturbed)

    def of(self, fan: int) -> Mapping[str, Wear]:
        """What is known of a fan, by parameter; empty before its first point."""
        return self._fans[fan].told

    def forget(self, fans: Array, t_ns: int) -> None:
        """Begin anew with some fans, (fans,) of bool: after t_ns, the last sample taken, they are commissioned anew."""
        for fan in np.flatnonzero(fans).tolist():
            self._fans[fan] = _Fan()
            self._disturbed_t_ns[fan] = t_ns

    def problem(self, now_ns: int) -> str:
        """One line while a limit is likely to be reached within days; empty otherwise."""
        soon = []
        for number, fan in enumerate(self._fans):
            when = fan.told["balance"].reached if "balance" in fan.told else Reached()
            if when.likely_ns is None or when.earliest_ns is None or when.latest_ns is None or now_ns > when.latest_ns:
                continue
            earliest, likely, latest = (
                max(t - now_ns, 0) / NS_PER_DAY for t in (when.earliest_ns, when.likely_ns, when.latest_ns)
            )
            if likely <= SOON_DAYS:
                soon.append((likely, number, earliest, latest))
        if not soon:
            return ""
        likely, number, earliest, latest = min(soon)
        days = "day" if round(likely) == 1 else "days"
        about = f"in about {likely:.0f} {days} ({earliest:.0f} to {latest:.0f})" if likely > 0.5 else "within a day"
        others = ", ".join(str(other) for _, other, *_ in sorted(soon)[1:])
        look = f"look at it, and at fan {others}" if others else "look at it"
        return f"fan {number} wears: its balance reaches the limit {about}; {look}"

    def snapshot(self) -> dict[str, Any]:
        """All it knows, as JSON can hold it, with what it tells of each parameter."""
        return {
            "command_unit": self._unit,
            "tried": self._tried,
            "disturbed_t_ns": self._disturbed_t_ns.tolist(),
            "fans": [fan.snapshot() for fan in self._fans],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a snapshot of a watch of as many fans; without it nothing has changed when this raises.

        Raises:
            ValueError, KeyError, TypeError: it is not one.
        """
        fans = [_Fan.restore(fan) for fan in state["fans"]]
        disturbed_t_ns = np.array(state.get("disturbed_t_ns", self._disturbed_t_ns), np.int64)  # not kept at first
        if len(fans) != len(self._fans) or disturbed_t_ns.shape != self._disturbed_t_ns.shape:
            raise ValueError("wear of another number of fans")
        self._tried, self._disturbed_t_ns, self._fans = int(state["tried"]), disturbed_t_ns, fans

    def _last_disturbed(self, t_ns: Array, disturbed: Array) -> Array:
        """(fans,) when each was disturbed last, up to the end of these rows."""
        return np.where(disturbed, t_ns[:, np.newaxis], self._disturbed_t_ns).max(axis=0)

    def _look(self, fan: int, at_ns: int, commissioned: float, held: bool) -> bool:
        """Add a point of each parameter; False where the last seconds are too few for it, or too slow."""
        window = self._diagnoser.window(fan, at_ns, at_ns, WINDOW_S)
        if window is None:
            return False
        drifts = parameter_drifts(replace(window, offset=commissioned), self._healthy[fan])
        points = {drift.parameter: (drift.change, drift.std_error) for drift in drifts}
        if points and not held:
            points["balance"] = window.offset - commissioned, window.offset_std_error
        for parameter, (change, std_error) in points.items():
            if max(abs(change), std_error) < LARGEST:
                self._fans[fan].series[parameter].add(at_ns, change, std_error)
        return bool(points)


class _Fan:
    """One fan: its series, and what follows from them."""

    def __init__(self) -> None:
        self.slot = -1
        self.t_ns = 0
        self.limit: float | None = None
        self.series = {parameter: WearSeries() for parameter in UNITS}
        self.told: dict[str, Wear] = {}

    def tell(self, t_ns: int, limit_command: float) -> None:
        """After a point: work out the trends anew."""
        self.t_ns = t_ns
        self.limit = limit_command if np.isfinite(limit_command) else None
        self.told = {parameter: self._wear(parameter) for parameter in UNITS if len(self.series[parameter])}

    def _wear(self, parameter: str) -> Wear:
        series = self.series[parameter]
        trend = series.trend()
        limit = self.limit if parameter == "balance" else None
        change = series.last
        if trend is not None:
            change = trend.level + trend.slope_per_day * (self.t_ns - trend.origin_ns) / NS_PER_DAY
        if limit is None:
            why = "the twin is not calibrated" if parameter == "balance" else "it has no limit of its own"
            return Wear(change, trend, None, Reached(invalid_reason=why))
        if trend is None:
            return Wear(change, None, limit, Reached(invalid_reason="too little was seen so far"))
        if trend.days < SHORTEST_DAYS:
            return Wear(change, trend, limit, Reached(invalid_reason="less than a day was seen"))
        limit = float(np.copysign(limit, trend.slope_per_day))
        return Wear(change, trend, limit, reached(trend, limit, self.t_ns))

    def snapshot(self) -> dict[str, Any]:
        parameters = {
            parameter: {
                "unit": UNITS[parameter],
                **_plain(self.told.get(parameter)),
                "series": {name: column.tolist() for name, column in series.snapshot().items()},
            }
            for parameter, series in self.series.items()
        }
        return {"slot": self.slot, "t_ns": self.t_ns, "limit_command": self.limit, "parameters": parameters}

    @classmethod
    def restore(cls, state: Mapping[str, Any]) -> _Fan:
        fan = cls()
        fan.slot = int(state["slot"])
        for parameter in UNITS:
            series = {name: np.asarray(column) for name, column in state["parameters"][parameter]["series"].items()}
            fan.series[parameter] = WearSeries.restore(series)
        if fan.slot >= 0:
            fan.tell(int(state["t_ns"]), np.inf if state["limit_command"] is None else float(state["limit_command"]))
        return fan


def _plain(wear: Wear | None) -> dict[str, Any]:
    """What is told of a parameter, for machines."""
    if wear is None:
        return {}
    trend, when = wear.trend, wear.reached
    return {
        "change": wear.change,
        "per_day": trend and {"value": trend.slope_per_day, "low": trend.low, "high": trend.high},
        "days": trend.days if trend else None,
        "limit": wear.limit,
        "reached_t_ns": None
        if when.likely_ns is None
        else {"earliest": when.earliest_ns, "likely": when.likely_ns, "latest": when.latest_ns},
        "invalid_reason": when.invalid_reason,
    }
