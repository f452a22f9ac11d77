"""Wear of a tray's fans: how their speeds have changed since they were commissioned, as shares of the speed.

The scorer's model of a healthy fan has slow states: by how much a fan turns faster or slower than its twin. A point of
each fan is taken from them at regular intervals. Its change is the difference from the first day. The first point by
another twin continues where the series by the twin before it ended. See docs/explanation/wear.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.saved import Saved
from fantwin.scoring.wear.recorded_wear import shown
from fantwin.scoring.wear.slow_change import LIMIT_SHARE, SlowChange, limit_ahead, own_change, shared_change
from fantwin.scoring.wear.trend import NS_PER_DAY, REACHED, LimitForecast, Point, Trend, WearSeries, forecast_limit

SETTLING_INTERVALS = 6
"""intervals from the first sample by a twin to the first point: the slow states are hardly known before"""
REFERENCE_DAYS = 1.0
"""a change is the difference from the mean of this time after commissioning, which levels day and night"""
HALF_INTERVAL = 1.96
"""half of a 95 % interval, in standard errors"""
MIN_CHANGE = 0.03
"""share of the speed; any healthy fan shows smaller changes"""
NOTICED_INTERVALS = 2.0
"""change that is noticed, in half intervals: every fan is tested again with every point"""
TOGETHER_NS = 1800 * NS_PER_S
"""fans whose first points are no farther apart were commissioned together"""
REPORT_WITHIN_DAYS = 7.0
"""health reports a limit that is likely to be reached sooner"""


@dataclass
class WearState:
    """The wear in a snapshot beside arrays: the present change of each fan for people (scoring.wear.recorded_wear), and
    its points."""

    fans: list[dict[str, Any]]
    series: list[WearSeries]


class WearMonitor(Saved):
    """The wear of one tray's fans. The result does not depend on how samples are cut into messages.

    All (fans,). due_t_ns: of the next point; 0: not known yet. first_t_ns: of the first point. t_ns, value, std_error:
    of the newest point. shift: from a share by the present twin to a value, once there is a point by it (has_shift).
    joined_variance: of the value, by the takeovers of other twins. is_over: the change has surely reached LIMIT_SHARE,
    and has not come back since. change, change_std_error: since commissioning.
    """

    KEPT = (
        *("due_t_ns", "first_t_ns", "t_ns", "value", "std_error", "shift", "has_shift"),
        *("joined_variance", "is_over"),
    )

    def __init__(self, fans: int, every_s: float, names: FanNames = NO_NAMES) -> None:
        """Begin without a point. every_s: interval between the points of a fan."""
        self._names = names
        self._every_ns = max(1, round(every_s * NS_PER_S))
        # the points of a large tray are not all due at once, which would hold up its scores
        self._settling_ns = SETTLING_INTERVALS * self._every_ns + np.arange(fans) * self._every_ns // fans
        self.due_t_ns, self.first_t_ns, self.t_ns = np.zeros((3, fans), np.int64)
        self.value, self.std_error, self.shift, self.joined_variance = np.zeros((4, fans))
        self.has_shift, self.is_over = np.zeros((2, fans), np.bool_)
        self.change, self.change_std_error = np.zeros((2, fans))
        self._series = [WearSeries([], [], []) for _ in range(fans)]
        self._trends: dict[int, Trend | None] = {}
        """those that were asked for since the newest point of their fan"""

    def update(self, t_ns: int, counts: Array, shares: Callable[[], tuple[Array, Array]]) -> None:
        """Take the points that are due at the end of a bin.

        counts: (fans,) a point may be taken now. shares: asked only if one is due; (fans,) how much faster (+) or
        slower (-) than its twin each fan turns, as a share of the speed, and its standard deviation.
        """
        self.due_t_ns = np.where(counts & (self.due_t_ns == 0), t_ns + self._settling_ns, self.due_t_ns)
        due = np.flatnonzero(counts & (t_ns >= self.due_t_ns))
        if not len(due):
            return
        self.due_t_ns[due] += self._every_ns * ((t_ns - self.due_t_ns[due]) // self._every_ns + 1)
        share, std_error = shares()
        for fan in due.tolist():
            self._add(fan, t_ns, float(share[fan]), float(std_error[fan]))

    def _add(self, fan: int, t_ns: int, share: float, std_error: float) -> None:
        series = self._series[fan]
        shift = float(self.shift[fan] if self.has_shift[fan] else self.value[fan] - share)
        joins = len(series) and not self.has_shift[fan]
        joined = self.std_error[fan] ** 2 + std_error**2 if joins else 0.0
        if not series.add(t_ns, share + shift, std_error):
            return
        self.first_t_ns[fan] = self.first_t_ns[fan] or t_ns
        self.t_ns[fan], self.value[fan], self.std_error[fan] = t_ns, share + shift, std_error
        self.shift[fan], self.has_shift[fan] = shift, True
        self.joined_variance[fan] += joined
        self._measure(fan)
        change = abs(self.change[fan])
        is_surely_over = change - HALF_INTERVAL * self.change_std_error[fan] >= LIMIT_SHARE
        self.is_over[fan] = is_surely_over or (self.is_over[fan] and change >= LIMIT_SHARE)

    def _measure(self, fan: int) -> None:
        """Set the change of a fan, and forget its trend before the newest point."""
        reference = self._reference(fan)
        self.change[fan] = self.value[fan] - reference.value
        self.change_std_error[fan] = math.hypot(self.std_error[fan], reference.std_error)
        self._trends.pop(fan, None)

    def _reference(self, fan: int) -> Point:
        """Reference of the change of a fan, with the error of the takeovers since."""
        reference = self._series[fan].mean_from(int(self.first_t_ns[fan]), REFERENCE_DAYS)
        return reference._replace(std_error=math.hypot(reference.std_error, math.sqrt(self.joined_variance[fan])))

    def of(self, fan: int) -> SlowChange | None:
        """The change of a fan; None before its first point."""
        if not self.t_ns[fan]:
            return None
        if fan not in self._trends:
            self._trends[fan] = self._series[fan].trend()
        trend, beside = self._trends[fan], self._beside(fan)
        return SlowChange(
            int(self.t_ns[fan]),
            float(self.change[fan]),
            float(self.change_std_error[fan]),
            beside and beside[0],
            trend,
            self._forecast(fan, trend),
        )

    def _forecast(self, fan: int, trend: Trend | None) -> LimitForecast:
        if trend is None:
            return LimitForecast(unknown_reason="too few points so far")
        reference = self._reference(fan)
        line = replace(trend, level_error=math.hypot(trend.level_error, reference.std_error))
        limit = reference.value + math.copysign(LIMIT_SHARE, trend.slope_per_day)
        return forecast_limit(line, limit, int(self.t_ns[fan]))

    def _beside(self, fan: int) -> tuple[float, float] | None:
        """Median change of the other fans since a fan was commissioned, with its standard error; None: there are none.

        A fan that was commissioned later than this one does not count.
        """
        later_ns = self.first_t_ns - self.first_t_ns[fan]
        counts = (self.t_ns > 0) & (later_ns <= TOGETHER_NS) & (np.arange(len(later_ns)) != fan)
        if not counts.any():
            return None
        change, std_error = self.change.copy(), self.change_std_error
        for older in np.flatnonzero(counts & (later_ns < -TOGETHER_NS)).tolist():
            since = self._series[older].mean_from(int(self.first_t_ns[fan]), REFERENCE_DAYS)
            change[older] = self.value[older] - since.value
        return float(np.median(change[counts])), float(np.median(std_error[counts])) / math.sqrt(counts.sum())

    def forget(self, fans: Array, t_ns: int) -> None:
        """Start again for some fans, (fans,) of bool, that are commissioned again after t_ns, the last sample."""
        for name in (*self.KEPT, "change", "change_std_error"):
            getattr(self, name)[fans] = 0
        self.due_t_ns[fans] = t_ns + self._settling_ns[fans]
        for fan in np.flatnonzero(fans).tolist():
            self._series[fan] = WearSeries([], [], [])

    def problem(self, now_ns: int) -> str:
        """Line about a fan that will likely reach its limit within REPORT_WITHIN_DAYS, or may have; empty otherwise,
        and once it surely has."""
        soon = []
        for fan in self._changed_fans():
            found = self.of(fan)
            if found is None or self.is_over[fan]:
                continue
            times_ns = found.forecast.likely_ns, found.forecast.earliest_ns, found.forecast.latest_ns
            days = [max((at_ns or 0) - now_ns, 0) / NS_PER_DAY for at_ns in times_ns]
            is_ahead = days[0] <= REPORT_WITHIN_DAYS and days[2] > 0.0
            if is_ahead or found.forecast.unknown_reason == REACHED:
                soon.append((days, fan, found.change))
        if not soon:
            return ""
        (days, fan, change), *others = sorted(soon)
        more = self._names.labels(sorted(other for _, other, _ in others)) if others else ""
        return limit_ahead(self._names.label(fan), more, change, days)

    def notices(self) -> list[str]:
        """A line on what most fans share, and one for each fan that has changed against the fans beside it."""
        lines = self._shared_change()
        for fan in self._changed_fans():
            beside = self._beside(fan)
            age_ns = int(self.t_ns[fan] - self.first_t_ns[fan])
            lines.append(own_change(self._names.label(fan), float(self.change[fan]), age_ns, beside and beside[0]))
        return lines

    def _shared_change(self) -> list[str]:
        """A line on the change that more than half of the fans have at least, if it is large."""
        change = np.sort(self.change[self.t_ns > 0])
        if len(change) < 2:
            return []
        least = _noticed_from(float(np.median(self.change_std_error[self.t_ns > 0])) / math.sqrt(len(change)))
        middle = len(change) // 2
        slower, faster = float(change[middle]), float(change[-1 - middle])
        return [shared_change(slower)] if slower <= -least else [shared_change(faster)] if faster >= least else []

    def _changed_fans(self) -> list[int]:
        """The fans that have changed much, by themselves and against the fans beside them."""
        found = []
        for fan in np.flatnonzero(np.abs(self.change) >= MIN_CHANGE).tolist():
            change, std_error = self.change[fan], self.change_std_error[fan]
            beside, of_beside = self._beside(fan) or (0.0, 0.0)
            least = _noticed_from(math.hypot(std_error, of_beside))
            if self.t_ns[fan] and min(abs(change), abs(change - beside)) >= least:
                found.append(fan)
        return found

    @property
    def state(self) -> WearState:
        """What a snapshot holds beside the arrays."""
        fans = [{**shown(self.of(fan)), "value": value} for fan, value in enumerate(self.value.tolist())]
        return WearState(fans, self._series)

    def continue_from(self, state: WearState, stored: Mapping[str, Array], *, same_twin: bool = True) -> None:
        """Continue from the state and arrays of another. same_twin: else the changes go on by another twin.

        Raises:
            ValueError, KeyError: they are damaged, or of other fans. A part may have been taken then.
        """
        self.restore(stored)
        has_points = [len(series) > 0 for _, series in zip(state.fans, state.series, strict=True)]
        if has_points != (self.t_ns > 0).tolist():
            raise ValueError("series of other fans, or without their newest point")
        self._series = state.series
        for fan in np.flatnonzero(self.t_ns).tolist():
            self._measure(fan)
        if not same_twin:
            self.due_t_ns[:], self.has_shift[:] = 0, False


def _noticed_from(std_error: float) -> float:
    """The least change that is noticed, as a share of the speed."""
    return max(MIN_CHANGE, NOTICED_INTERVALS * HALF_INTERVAL * std_error)
