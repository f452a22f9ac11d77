"""The bands and states of fans in a recording.

Each fan has one entity with its series side by side, and one `send_columns` per flush; the torque balances of a page of
fans are one entity, and so are their scores. Deviations in alarm, samples outside the band and samples without a score
are sent only if there are any.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from fantwin.pipeline.outputs.rerun.rerun_styles import (
    BALANCE,
    SCORE,
    TIMELINE,
    auxiliary_path,
    fan_path,
    judged_path,
    pages_of,
    state_path,
)
from fantwin.pipeline.site.trace import NO_SAMPLES, Trace
from fantwin.schemas.messages import Array

ABOVE_LIMIT = 1.2
"""times the limit of the score: an axis shows it up to here at least"""


class RerunBands:
    """Draws fans, each below its tray."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._open_paths: set[str] = set()

    def draw(self, trace: Trace, judged_together: int) -> None:
        """Send the next stretch of a tray. judged_together: how many fans have their scores in one entity."""
        for column in range(trace.fans):
            self._draw_fan(trace, column)
        for columns in pages_of(range(trace.fans), judged_together):
            page = trace.fan_numbers[columns[0]] // judged_together
            self._send_judged(trace, columns, *(judged_path(trace.tray, kind, page) for kind in (BALANCE, SCORE)))
        for name, values in trace.auxiliary.items():
            for number, of_fan in zip(trace.fan_numbers, values.T, strict=True):
                self._send_where(auxiliary_path(trace.tray, name, number), trace.t_ns, of_fan)

    def change_states(self, tray: str, fan: int, name: str, t_ns: Array, names: Sequence[str]) -> None:
        """Set the state of a fan's lane from each time on. name: of the fan."""
        self._send(state_path(tray, fan, name), t_ns, rr.StateChange.columns(state=list(names)))

    def _send_judged(self, trace: Trace, columns: Sequence[int], balance_path: str, score_path: str) -> None:
        balances = (trace.balance[:, columns], trace.expected_balance[:, columns])
        self._send_rows(balance_path, trace.t_ns, np.concatenate(balances, axis=1))
        limit = np.where((trace.state[:, columns] == NO_SAMPLES).all(axis=1), np.nan, 1.0)
        self._send_rows(score_path, trace.t_ns, np.column_stack([trace.score[:, columns], limit, ABOVE_LIMIT * limit]))

    def _draw_fan(self, trace: Trace, column: int) -> None:
        tray, fan = trace.tray, trace.fan_numbers[column]
        measured, predicted = trace.measured[:, column], trace.predicted[:, column]
        half_width, scored = trace.half_width[:, column], trace.valid[:, column]
        ends = _ends_of_band(predicted, half_width)
        shown = np.stack([np.where(scored, measured, np.nan), predicted, *ends], axis=1)
        none = np.zeros_like(half_width)
        variances = np.stack([none, half_width**2, none, none], axis=1)
        self._send_measurements(fan_path(tray, fan, "speed"), trace.t_ns, shown, variances)
        self._draw_deviation(trace, column, fan_path(tray, fan, "deviation"))
        outside = trace.outside[:, column]
        if outside.any():
            columns = rr.Scalars.columns(scalars=measured[outside])
            self._send(fan_path(tray, fan, "outside"), trace.t_ns[outside], columns)
        not_scored = np.where(scored, np.nan, measured)
        self._send_where(fan_path(tray, fan, "not_scored"), trace.t_ns, not_scored)

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
