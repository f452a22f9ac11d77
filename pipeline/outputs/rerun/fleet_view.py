"""Which fans of a fleet are drawn, and what was before: a plot that begins with an alarm shows the window before it.

It is fed with the newest sample of each tray, once or twice a second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.outputs.rerun.plot_places import PlotPlaces
from fantwin.pipeline.site.fleet import Fan, last_sample
from fantwin.pipeline.site.trace import MEASURED_COLUMNS
from fantwin.schemas.messages import Score
from fantwin.schemas.units import NS_PER_S

ADDED_EVERY_NS = NS_PER_S // 2
"""the newest samples come no faster"""


class FleetView:
    """The plots of a fleet, and the last window of all fans."""

    def __init__(self, trays: Sequence[TrayConfig], places: PlotPlaces, window_ns: int) -> None:
        """window_ns: how far back a plot begins."""
        self._places = places
        self._window_ns = window_ns
        self._history = {tray.name: deque[Score](maxlen=math.ceil(window_ns / ADDED_EVERY_NS)) for tray in trays}

    @property
    def places(self) -> Mapping[Fan, int]:
        """The fans that have a plot, with the number of its place."""
        return self._places.taken()

    def history(self, tray: str) -> Sequence[Score]:
        """The samples of a tray that were added within the last window, one score each, with `MEASURED_COLUMNS`."""
        kept = self._history[tray]
        return [score for score in kept if 0 <= int(kept[-1].t_ns[0] - score.t_ns[0]) < self._window_ns]

    def add_newest(self, score: Score) -> None:
        """Take the last sample of a score with `MEASURED_COLUMNS`."""
        self._history[score.header.tray].append(last_sample(score, MEASURED_COLUMNS))

    def update(self, in_alarm: Sequence[Fan], now_ns: int) -> None:
        """Give plots to the fans in alarm, the first first. now_ns: host time."""
        self._places.update(in_alarm, now_ns)
