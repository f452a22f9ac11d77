"""The bands and states of fans in a recording.

Each fan has one entity with its series side by side, and one `send_columns` per flush; the torque balances of a page of
fans are one entity, and so are their scores. Deviations in alarm, samples outside the band and samples without a score
are sent only if there are any.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from fantwin.pipeline.outputs.rerun.rerun_paths import (
    BALANCE,
    SCORE,
    TIMELINE,
    auxiliary_path,
    fan_path,
    judged_path,
    pages_of,
    place_beside,
    place_lane,
    place_root,
    state_path,
)
from fantwin.pipeline.outputs.rerun.rerun_styles import (
    LINE_WIDTH,
    balance_style,
    log_fan_styles,
    score_style,
    speed_style,
)
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.trace import NO_SAMPLES, Trace
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.messages import Array
from fantwin.schemas.units import SpeedUnit

FREE = "free"
"""the state of a place without a fan"""
ABOVE_LIMIT = 1.2
"""times the limit of the score: an axis shows it up to here at least"""


class RerunBands:
    """Draws fans: each below the root of its tray, or, in a fleet, below the place of the plot that shows it."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._open_paths: set[str] = set()
        self._places: dict[Fan, int] = {}
        self._styled: set[tuple[Fan, int]] = set()

    def show(self, fan: Fan, place: int, unit: SpeedUnit) -> None:
        """From now on a fan of a fleet is drawn in this place."""
        self._places[fan] = place
        if (fan, place) in self._styled:
            return
        self._styled.add((fan, place))
        root = place_root(place, fan.tray)
        log_fan_styles(self._recording, root, fan.number, speed_style(unit, LINE_WIDTH, str(fan)))
        fill = speed_style(unit, 0.0, str(fan))
        self._recording.log(fan_path(root, fan.number, "fill"), fill, static=True)
        # The name is that of the newest fan in this place.
        self._recording.log(place_beside(place, BALANCE), balance_style(1, name=str(fan)), static=True)
        self._recording.log(place_beside(place, SCORE), score_style(1, name=str(fan)), static=True)

    def hide(self, fan: Fan, t_ns: int) -> None:
        """From `t_ns` on a fan has no place: its lines end."""
        times = np.array([t_ns])
        speed = fan_path(self._root(fan), fan.number, "speed")
        self._send_measurements(speed, times, np.full((1, 4), np.nan), np.zeros((1, 4)))
        for column in CHANNELS:
            self._send_where(self._auxiliary_path(fan, column.name), times, np.array([np.nan]))
        for kind, series in ((BALANCE, 2), (SCORE, 3)):
            self._send_rows(place_beside(self._places[fan], kind), times, np.full((1, series), np.nan))
        self.change_states(fan.tray, fan.number, times, [FREE])
        del self._places[fan]

    def draw(self, trace: Trace) -> None:
        """Send the next stretch of a tray."""
        for column in range(trace.fans):
            self._draw_fan(trace, column)
        self._draw_judged(trace)
        for name, values in trace.auxiliary.items():
            for number, of_fan in zip(trace.fan_numbers, values.T, strict=True):
                self._send_where(self._auxiliary_path(Fan(trace.tray, number), name), trace.t_ns, of_fan)

    def change_states(self, tray: str, fan: int, t_ns: Array, names: Sequence[str]) -> None:
        """Set the state of a fan's lane from each time on."""
        place = self._places.get(Fan(tray, fan))
        path = state_path(tray, fan) if place is None else place_lane(place)
        self._send(path, t_ns, rr.StateChange.columns(state=list(names)))

    def _draw_judged(self, trace: Trace) -> None:
        """Send torque balance and score: of a fan in a place alone, of others a page at a time."""
        placed = [column for column, fan in enumerate(trace.fan_numbers) if Fan(trace.tray, fan) in self._places]
        for column in placed:
            place = self._places[Fan(trace.tray, trace.fan_numbers[column])]
            self._send_judged(trace, [column], place_beside(place, BALANCE), place_beside(place, SCORE))
        if not placed:
            for page, columns in enumerate(pages_of(range(trace.fans))):
                self._send_judged(trace, columns, *(judged_path(trace.tray, kind, page) for kind in (BALANCE, SCORE)))

    def _send_judged(self, trace: Trace, columns: Sequence[int], balance_path: str, score_path: str) -> None:
        balances = (trace.balance[:, columns], trace.expected_balance[:, columns])
        self._send_rows(balance_path, trace.t_ns, np.concatenate(balances, axis=1))
        limit = np.where((trace.state[:, columns] == NO_SAMPLES).all(axis=1), np.nan, 1.0)
        self._send_rows(score_path, trace.t_ns, np.column_stack([trace.score[:, columns], limit, ABOVE_LIMIT * limit]))

    def _root(self, fan: Fan) -> str:
        place = self._places.get(fan)
        return fan.tray if place is None else place_root(place, fan.tray)

    def _auxiliary_path(self, fan: Fan, column: str) -> str:
        place = self._places.get(fan)
        return auxiliary_path(fan.tray, column, fan.number) if place is None else place_beside(place, column)

    def _draw_fan(self, trace: Trace, column: int) -> None:
        fan = Fan(trace.tray, trace.fan_numbers[column])
        root = self._root(fan)
        measured, predicted = trace.measured[:, column], trace.predicted[:, column]
        half_width, scored = trace.half_width[:, column], trace.valid[:, column]
        ends = _ends_of_band(predicted, half_width)
        shown = np.stack([np.where(scored, measured, np.nan), predicted, *ends], axis=1)
        none = np.zeros_like(half_width)
        variances = np.stack([none, half_width**2, none, none], axis=1)
        self._send_measurements(fan_path(root, fan.number, "speed"), trace.t_ns, shown, variances)
        if fan in self._places:
            # A single band is faint. Where the layout does not know the fan, it cannot draw the same data twice.
            band = np.stack([np.full_like(predicted, np.nan), predicted], axis=1)
            self._send_measurements(fan_path(root, fan.number, "fill"), trace.t_ns, band, variances[:, :2])
        self._draw_deviation(trace, column, fan_path(root, fan.number, "deviation"))
        outside = trace.outside[:, column]
        if outside.any():
            columns = rr.Scalars.columns(scalars=measured[outside])
            self._send(fan_path(root, fan.number, "outside"), trace.t_ns[outside], columns)
        not_scored = np.where(scored, np.nan, measured)
        self._send_where(fan_path(root, fan.number, "not_scored"), trace.t_ns, not_scored)

    def _draw_deviation(self, trace: Trace, column: int, path: str) -> None:
        """Send the red area between twin and measured speed while an alarm is active."""
        measured, predicted = trace.measured[:, column], trace.predicted[:, column]
        middle = np.where(trace.in_alarm[:, column], (measured + predicted) / 2, np.nan)
        if self._has_news(path, middle):
            self._send_measurements(path, trace.t_ns, middle[:, None], ((measured - predicted)[:, None] / 2) ** 2)

    def _send_where(self, path: str, t_ns: Array, values: Array) -> None:
        if self._has_news(path, values):
            self._send(path, t_ns, rr.Scalars.columns(scalars=values))

    def _has_news(self, path: str, values: Array) -> bool:
        """Whether there are values, or a NaN is needed to end the line or zone that is still open."""
        was_open = path in self._open_paths
        if np.isfinite(values[-1]):
            self._open_paths.add(path)
        else:
            self._open_paths.discard(path)
        return was_open or bool(np.isfinite(values).any())

    def _send_measurements(self, path: str, t_ns: Array, values: Array, variances: Array) -> None:
        columns = rr.Measurements.columns(values=values.reshape(-1), variances=variances.reshape(-1))
        self._send(path, t_ns, columns.partition([values.shape[1]] * len(values)))

    def _send_rows(self, path: str, t_ns: Array, values: Array) -> None:
        columns = rr.Scalars.columns(scalars=values.reshape(-1))
        self._send(path, t_ns, columns.partition([values.shape[1]] * len(values)))

    def _send(self, path: str, t_ns: Array, columns: rr.ComponentColumnList) -> None:
        time = rr.TimeColumn(TIMELINE, timestamp=t_ns.astype("datetime64[ns]"))
        self._recording.send_columns(path, indexes=[time], columns=columns)


def _ends_of_band(predicted: Array, half_width: Array) -> tuple[Array, Array]:
    """The lowest and the highest value (n,) of a stretch of the band, each where it lies; NaN elsewhere."""
    low, high = np.full_like(predicted, np.nan), np.full_like(predicted, np.nan)
    if np.isfinite(predicted).any():
        lowest, highest = np.nanargmin(predicted - half_width), np.nanargmax(predicted + half_width)
        low[lowest], high[highest] = (predicted - half_width)[lowest], (predicted + half_width)[highest]
    return low, high
