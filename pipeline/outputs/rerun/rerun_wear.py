"""The wear of fans in a recording: the change of each with its band of ± 2 standard errors, on its timeline."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from fantwin.pipeline.outputs.rerun.rerun_paths import DAYS, wear_path
from fantwin.pipeline.outputs.rerun.rerun_styles import FAN_COLORS, LINE_WIDTH
from fantwin.pipeline.outputs.rerun.wear_points import WearPoints
from fantwin.pipeline.site.fleet import Fan


class RerunWear:
    """Draws each point once. What a snapshot has merged since stays as it was drawn."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._drawn_t_ns: dict[Fan, int] = {}

    def draw(self, tray: str, points: Sequence[WearPoints]) -> None:
        """Send what is newer than what was drawn before."""
        for each in points:
            fan = Fan(tray, each.fan)
            drawn = self._drawn_t_ns.get(fan)
            path = wear_path(*fan)
            if drawn is None:
                style = rr.Measurements.from_fields(
                    names=str(fan), colors=FAN_COLORS[fan.number % len(FAN_COLORS)], widths=LINE_WIDTH
                )
                self._recording.log(path, style, static=True)
            newer = each if drawn is None else each.after(drawn)
            if len(newer.t_ns):
                self._drawn_t_ns[fan] = int(newer.t_ns[-1])
                days = rr.TimeColumn(DAYS, timestamp=newer.t_ns.astype("datetime64[ns]"))
                columns = rr.Measurements.columns(values=newer.change, variances=np.square(2.0 * newer.std_error))
                self._recording.send_columns(path, [days], columns)
