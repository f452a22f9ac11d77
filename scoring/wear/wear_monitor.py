"""Slow wear of a tray: how far each fan's parameters have moved since commissioning, measured at regular intervals.

Drag, friction and gain are identified again over the last seconds (scoring.wear.reidentification), each as if it alone
had changed. They refer to the twin with which the fan was commissioned, also when other twins have taken over
(scoring.wear.reference). `balance` is the baseline of the torque balance, which follows the fan within bounds; it is
the only one with a limit, the value at which the alarm is raised. Baseline and limit belong to the present twin, so its
series starts again with each. Each is a series with a trend per day (scoring.wear.trend).
See docs/explanation/wear.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from schemas.messages import Array
from schemas.units import NS_PER_S
from scoring.diagnosis.diagnoser import Diagnoser
from scoring.former_snapshot_keys import FORMER_WEAR_KEYS, current_keys
from scoring.wear.reference import HealthyFan, WearReference
from scoring.wear.reidentification import parameter_shifts
from scoring.wear.slow_change import slow_changes
from scoring.wear.trend import NS_PER_DAY, LimitForecast, Trend, WearSeries, forecast_limit

UNITS = {"balance": "command", "drag": "relative", "friction": "command", "gain": "relative"}
"""unit of each parameter; `command`: that of the fan's command"""
TURN_NS = NS_PER_S
"""how long a fan is due after the one before it: points of all fans of a large tray at once would hold up its scores"""
ATTEMPT_PERIOD_TURNS = 10
"""how often a fan that is due for a point is tried, at most"""
FANS_OF_TURN = 4
"""that are tried at the same time, at most: in large trays a fan is tried less often"""
MIN_FORECAST_DAYS = 1.0
"""no forecast before: weather and warming bearings change more within a day than wear does"""
REPORT_WITHIN_DAYS = 7.0
"""health reports a limit that is likely to be reached sooner"""
WINDOW_S = 35.0
"""length of the window of a point"""
NEVER_NS = int(np.iinfo(np.int64).min)
MAX_CHANGE = 1e6
"""larger changes are ignored as implausible"""


@dataclass(frozen=True)
class ParameterWear:
    """The wear of one parameter of one fan. change: since commissioning, on the trend line if there is one."""

    change: float
    trend: Trend | None
    limit: float | None
    forecast: LimitForecast


@dataclass(frozen=True, eq=False)
class WearInputs:
    """What the points of a block are taken from, (n, fans) each but limit_command, (fans,).

    eligible: a point may be taken at this sample. commissioned_command: baseline of the balance at the end of
    commissioning, at the reference speed, NaN before. shared_command: what of the present one the fans of the tray have
    in common, which is no wear of one of them. held: the baseline is at its bound, so that its value says nothing about
    wear. limit_command: the alarm comes at this distance from the commissioned baseline.
    """

    eligible: Array
    commissioned_command: Array
    shared_command: Array
    held: Array
    limit_command: Array


class WearMonitor:
    """The wear of one tray's fans. The result does not depend on how samples are cut into blocks."""

    def __init__(
        self,
        healthy: Sequence[HealthyFan],
        diagnoser: Diagnoser,
        every_s: float,
        command_unit: str,
        *,
        rounds_points: bool = True,
    ) -> None:
        """healthy: each fan by the present twin. diagnoser: holds the last seconds. every_s: interval between the
        points of a fan. rounds_points: as scoring.wear.trend says; False: by former rules."""
        self._healthy = healthy
        self._diagnoser = diagnoser
        self._every_ns = round(every_s * NS_PER_S)
        self._unit = command_unit
        self._rounds_points = rounds_points
        self._period_turns = max(ATTEMPT_PERIOD_TURNS, math.ceil(len(healthy) / FANS_OF_TURN))
        self._last_turn = 0
        self._disturbed_t_ns = np.full(len(healthy), NEVER_NS)
        """(fans,) the last sample that no point may look back on"""
        self._fans = [_FanWear() for _ in healthy]
        self._noticed_t_ns: list[int] = []
        """the last point of each fan when the notices were made"""
        self._notices: list[str] = []

    def update(
        self,
        t_ns: Array,
        origin_t_ns: int,
        disturbed: Array,
        inputs: Callable[[], WearInputs],
    ) -> None:
        """Process a block that the diagnoser has taken. t_ns: (n,).

        disturbed: (n, fans) this sample must not be within the window of a point. inputs: asked for only if a fan has
        its turn in the block.
        """
        if (int(t_ns[-1]) - origin_t_ns) // TURN_NS <= self._last_turn:
            self._see_disturbances(t_ns, disturbed)
            return
        of = inputs()
        turns = np.maximum((t_ns - origin_t_ns) // TURN_NS, self._last_turn)
        fans, begin = np.arange(len(self._fans)), 0
        for row in np.flatnonzero(np.diff(turns, prepend=self._last_turn) > 0).tolist():
            at_ns, turn = int(t_ns[row]), int(turns[row])
            has_turn = (turn - fans) // self._period_turns > (self._last_turn - fans) // self._period_turns
            self._last_turn = turn
            self._see_disturbances(t_ns[begin : row + 1], disturbed[begin : row + 1])
            begin = row + 1
            undisturbed = self._disturbed_t_ns <= at_ns - round(WINDOW_S * NS_PER_S)
            commissioned = np.isfinite(of.commissioned_command[row])
            for fan in np.flatnonzero(has_turn & of.eligible[row] & undisturbed & commissioned).tolist():
                slot = (at_ns - origin_t_ns - fan * TURN_NS) // self._every_ns
                due = slot > self._fans[fan].slot
                of_fan = (float(of_all[row, fan]) for of_all in (of.commissioned_command, of.shared_command))
                if due and self._add_point(fan, at_ns, *of_fan, held=bool(of.held[row, fan])):
                    self._fans[fan].slot = slot
                    self._fans[fan].evaluate(at_ns, float(of.limit_command[fan]))
        self._see_disturbances(t_ns[begin:], disturbed[begin:])

    def of(self, fan: int) -> Mapping[str, ParameterWear]:
        """The wear of a fan, by parameter; empty before its first point."""
        return self._fans[fan].wear

    def forget(self, fans: Array, t_ns: int) -> None:
        """Start again for some fans, (fans,) of bool, that are commissioned again after t_ns, the last sample."""
        for fan in np.flatnonzero(fans).tolist():
            self._fans[fan] = _FanWear()
            self._disturbed_t_ns[fan] = t_ns

    def problem(self, now_ns: int) -> str:
        """One line while a limit is likely to be reached within days; empty otherwise."""
        soon = []
        for number, fan in enumerate(self._fans):
            forecast = fan.wear["balance"].forecast if "balance" in fan.wear else LimitForecast()
            if forecast.likely_ns is None or forecast.earliest_ns is None or forecast.latest_ns is None:
                continue
            if now_ns > forecast.latest_ns:
                continue
            earliest, likely, latest = (
                max(t - now_ns, 0) / NS_PER_DAY for t in (forecast.earliest_ns, forecast.likely_ns, forecast.latest_ns)
            )
            if likely <= REPORT_WITHIN_DAYS:
                soon.append((likely, number, earliest, latest))
        if not soon:
            return ""
        likely, number, earliest, latest = min(soon)
        days = "day" if round(likely) == 1 else "days"
        when = f"in about {likely:.0f} {days} ({earliest:.0f} to {latest:.0f})" if likely > 0.5 else "within a day"
        others = ", ".join(str(other) for _, other, *_ in sorted(soon)[1:])
        advice = f"inspect it, and fan {others}" if others else "inspect it"
        return f"fan {number} is wearing: its torque balance will reach the limit {when}; {advice}"

    def notices(self) -> list[str]:
        """A line for each fan that has changed slowly against the fans beside it."""
        measured_t_ns = [fan.t_ns for fan in self._fans]
        if measured_t_ns != self._noticed_t_ns:
            self._noticed_t_ns = measured_t_ns
            has_drag = any(len(fan.series["drag"]) for fan in self._fans)
            parameter = "drag" if has_drag else "gain"  # the drag of some fans was identified as zero
            trends = [fan.wear[parameter].trend if parameter in fan.wear else None for fan in self._fans]
            self._notices = slow_changes(parameter, trends)
        return self._notices

    def snapshot(self) -> dict[str, Any]:
        """The whole state, as JSON values, and the present wear of each parameter for `fantwin wear`."""
        return {
            "command_unit": self._unit,
            "last_turn": self._last_turn,
            "disturbed_t_ns": self._disturbed_t_ns.tolist(),
            "fans": [fan.snapshot() for fan in self._fans],
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a snapshot of the same twin and number of fans. Nothing has changed if this raises.

        Raises:
            ValueError, KeyError, TypeError, AttributeError: it is not such a snapshot.
        """
        last_turn, disturbed_t_ns, fans = self._read(snapshot)
        for fan, healthy in zip(fans, self._healthy, strict=True):
            fan.keep_reference_unless_of(healthy)
        self._last_turn, self._disturbed_t_ns, self._fans = last_turn, disturbed_t_ns, fans

    def restore_of_earlier_twin(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a snapshot of the twin before: drag, friction and gain go on, the balance starts again.

        A fan without a reference in the snapshot starts again as a whole. Nothing has changed if this raises.

        Raises: as `restore`.
        """
        _, disturbed_t_ns, fans = self._read(snapshot)
        self._disturbed_t_ns, self._fans = disturbed_t_ns, [fan.with_next_twin() for fan in fans]

    def _read(self, snapshot: Mapping[str, Any]) -> tuple[int, Array, list[_FanWear]]:
        stored = current_keys(snapshot, FORMER_WEAR_KEYS)
        fans = [_FanWear.restore(fan) for fan in stored["fans"]]
        disturbed_t_ns = np.array(stored.get("disturbed_t_ns", self._disturbed_t_ns), np.int64)  # the first had none
        if len(fans) != len(self._fans) or disturbed_t_ns.shape != self._disturbed_t_ns.shape:
            raise ValueError("wear of another number of fans")
        former = int(stored.get("last_attempt", 0)) * ATTEMPT_PERIOD_TURNS  # of all fans at once
        return int(stored.get("last_turn", former)), disturbed_t_ns, fans

    def _see_disturbances(self, t_ns: Array, disturbed: Array) -> None:
        """Keep the time of the last disturbed sample of each fan; (n,) and (n, fans), n may be 0."""
        if not disturbed.any():
            return
        disturbed_t_ns = np.where(disturbed, t_ns[:, np.newaxis], NEVER_NS).max(axis=0, initial=NEVER_NS)
        self._disturbed_t_ns = np.maximum(self._disturbed_t_ns, disturbed_t_ns)

    def _add_point(self, fan: int, at_ns: int, commissioned: float, shared: float, *, held: bool) -> bool:
        """Add a point for each parameter; False where the last seconds are too few for it, or too slow."""
        window = self._diagnoser.window(fan, at_ns, at_ns, WINDOW_S)
        if window is None:
            return False
        wear, present = self._fans[fan], WearReference(self._healthy[fan], commissioned)
        reference = wear.reference if wear.reference and wear.reference.of_earlier_twin else present
        drifts = parameter_shifts(reference.applied_to(window), reference.healthy.balance)
        if not drifts:
            return False
        points = {drift.parameter: (drift.change, drift.std_error) for drift in drifts}
        if not held:
            own_offset = present.offset_at(float(window.speed_rad_s[-1]))
            points["balance"] = window.fan_offset - shared - own_offset, window.fan_offset_std_error
        for parameter, (change, std_error) in points.items():
            if max(abs(change), std_error) < MAX_CHANGE:
                wear.series[parameter].add(at_ns, change, std_error, is_rounded=self._rounds_points)
        wear.reference = reference
        return True


class _FanWear:
    """One fan: the series of its parameters, and the wear evaluated from them."""

    def __init__(self) -> None:
        self.slot = -1
        self.t_ns = 0
        self.limit: float | None = None
        self.reference: WearReference | None = None
        """of the last point; None before the first one, and in snapshots of earlier versions"""
        self.series = {parameter: WearSeries() for parameter in UNITS}
        self.wear: dict[str, ParameterWear] = {}

    def evaluate(self, t_ns: int, limit_command: float) -> None:
        """Compute trends and forecasts after a point was added."""
        self.t_ns = t_ns
        self.limit = limit_command if np.isfinite(limit_command) else None
        self.wear = {parameter: self._wear(parameter) for parameter in UNITS if len(self.series[parameter])}

    def keep_reference_unless_of(self, present: HealthyFan) -> None:
        """Keep the reference of a twin that was calibrated again since."""
        if self.reference and self.reference.healthy.snapshot() != present.snapshot():
            self.reference = replace(self.reference, of_earlier_twin=True)

    def with_next_twin(self) -> _FanWear:
        """The wear of the fan when another twin takes over. Its points count from the first sample again."""
        following = _FanWear()
        if self.reference is not None:
            following.reference = replace(self.reference, of_earlier_twin=True)
            following.series |= {name: series for name, series in self.series.items() if name != "balance"}
            following.evaluate(self.t_ns, np.inf)
        return following

    def _wear(self, parameter: str) -> ParameterWear:
        series = self.series[parameter]
        trend = series.trend()
        limit = self.limit if parameter == "balance" else None
        change = series.last
        if trend is not None:
            change = trend.level + trend.slope_per_day * (self.t_ns - trend.origin_ns) / NS_PER_DAY
        if limit is None:
            reason = "the twin is not calibrated" if parameter == "balance" else "it has no limit of its own"
            return ParameterWear(change, trend, None, LimitForecast(unknown_reason=reason))
        if trend is None:
            return ParameterWear(change, None, limit, LimitForecast(unknown_reason="too few points so far"))
        if trend.days < MIN_FORECAST_DAYS:
            return ParameterWear(change, trend, limit, LimitForecast(unknown_reason="less than a day was observed"))
        limit = float(np.copysign(limit, trend.slope_per_day))
        return ParameterWear(change, trend, limit, forecast_limit(trend, limit, self.t_ns))

    def snapshot(self) -> dict[str, Any]:
        parameters = {
            parameter: {
                "unit": UNITS[parameter],
                **_to_json(self.wear.get(parameter)),
                "series": {name: column.tolist() for name, column in series.snapshot().items()},
            }
            for parameter, series in self.series.items()
        }
        return {
            "slot": self.slot,
            "t_ns": self.t_ns,
            "limit_command": self.limit,
            "reference": self.reference and self.reference.snapshot(),
            "parameters": parameters,
        }

    @classmethod
    def restore(cls, snapshot: Mapping[str, Any]) -> _FanWear:
        """The series are restored; the wear is evaluated again from them."""
        fan = cls()
        fan.slot = int(snapshot["slot"])
        for parameter in UNITS:
            series = {name: np.asarray(column) for name, column in snapshot["parameters"][parameter]["series"].items()}
            fan.series[parameter] = WearSeries.restore(series)
        if snapshot.get("reference") is not None:
            fan.reference = WearReference.restore(snapshot["reference"])
        t_ns = int(snapshot["t_ns"])
        if t_ns > 0:
            limit = np.inf if snapshot["limit_command"] is None else float(snapshot["limit_command"])
            fan.evaluate(t_ns, limit)
        return fan


def _to_json(wear: ParameterWear | None) -> dict[str, Any]:
    """The wear of a parameter, as `fantwin wear` reads it from a snapshot."""
    if wear is None:
        return {}
    trend, forecast = wear.trend, wear.forecast
    return {
        "change": wear.change,
        "per_day": trend and {"value": trend.slope_per_day, "low": trend.low, "high": trend.high},
        "days": trend.days if trend else None,
        "limit": wear.limit,
        "reached_t_ns": None
        if forecast.likely_ns is None
        else {"earliest": forecast.earliest_ns, "likely": forecast.likely_ns, "latest": forecast.latest_ns},
        "unknown_reason": forecast.unknown_reason,
    }
