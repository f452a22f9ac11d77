"""The wear of fans in a view: the points in a scorer's snapshot, on a timeline of days, each change with its band of
± 2 standard errors.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from fantwin.pipeline.outputs.rerun.rerun_styles import DAYS, FAN_COLORS, LINE_WIDTH, wear_path
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.fan_names import FanNames
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
        for number, (fan, series) in enumerate(zip(wear["fans"], wear["series"], strict=True)):
            t_ns = np.array(series["t_ns"], np.int64)
            value, error = (np.array(series[name], np.float64) for name in ("value", "std_error"))
            if len(t_ns) and t_ns.shape == value.shape == error.shape:
                change = value - fan["value"] + fan["change"]
                found.append(WearPoints(number, t_ns, 100.0 * change, 100.0 * error))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
        return []
    return found


class RerunWear:
    """Draws each point once. What a snapshot has merged since stays as it was drawn."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._drawn_t_ns: dict[Fan, int] = {}

    def draw(self, tray: str, points: Sequence[WearPoints], names: FanNames) -> None:
        """Send what is newer than what was drawn before. names: of the fans."""
        for each in points:
            fan = Fan(tray, each.fan)
            drawn = self._drawn_t_ns.get(fan)
            path = wear_path(*fan)
            if drawn is None:
                style = rr.Measurements.from_fields(
                    names=f"{tray}/{names.cell(each.fan)}",
                    colors=FAN_COLORS[fan.number % len(FAN_COLORS)],
                    widths=LINE_WIDTH,
                )
                self._recording.log(path, style, static=True)
            newer = each if drawn is None else each.after(drawn)
            if len(newer.t_ns):
                self._drawn_t_ns[fan] = int(newer.t_ns[-1])
                days = rr.TimeColumn(DAYS, timestamp=newer.t_ns.astype("datetime64[ns]"))
                columns = rr.Measurements.columns(values=newer.change, variances=np.square(2.0 * newer.std_error))
                self._recording.send_columns(path, [days], columns)
