"""The fans of a fleet that are drawn: those asked for always, and those in alarm for as long as there is room.

What was before is kept too: the plot of a fan that goes into alarm begins with the window before it. It is fed with the
newest sample of each tray, once or twice a second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.site.fleet import Fan, last_sample
from fantwin.pipeline.site.trace import MEASURED_COLUMNS
from fantwin.schemas.messages import Score
from fantwin.schemas.units import NS_PER_S

FLEET_ABOVE = 64
"""with more fans than this on the site, only those in alarm and those asked for are drawn"""
ALARM_PLOTS = 8
HOLD_S = 60.0
"""how long the plot of a fan stays after its alarm has cleared"""
ADDED_EVERY_NS = NS_PER_S // 2
"""the newest samples come no faster"""


def is_fleet(trays: Sequence[TrayConfig]) -> bool:
    """Return whether a site has more fans than are drawn at once."""
    return sum(tray.fans for tray in trays) > FLEET_ABOVE


class FleetView:
    """The fans that are drawn, and the last window of all fans.

    A fan in alarm is drawn until its alarm has been over for `hold_ns`; if there is no room, a new one replaces the fan
    whose alarm has been over for longest. A fan in alarm never gives way to another.
    """

    def __init__(
        self, trays: Sequence[TrayConfig], asked: Sequence[Fan], most_in_alarm: int, hold_ns: int, window_ns: int
    ) -> None:
        """asked: fans that are always drawn. window_ns: how far back a plot begins."""
        self._asked = tuple(asked)
        self._most_in_alarm = most_in_alarm
        self._hold_ns = hold_ns
        self._window_ns = window_ns
        self._alarm_ns: dict[Fan, int] = {}
        """when each fan was in alarm last, host time"""
        self._history = {tray.name: deque[Score](maxlen=math.ceil(window_ns / ADDED_EVERY_NS)) for tray in trays}

    @property
    def drawn(self) -> tuple[Fan, ...]:
        """The fans that are drawn."""
        return (*self._asked, *self._alarm_ns)

    def history(self, tray: str) -> Sequence[Score]:
        """The samples of a tray that were added within the last window, one score each, with `MEASURED_COLUMNS`."""
        kept = self._history[tray]
        return [score for score in kept if 0 <= int(kept[-1].t_ns[0] - score.t_ns[0]) < self._window_ns]

    def add_newest(self, score: Score) -> None:
        """Take the last sample of a score with `MEASURED_COLUMNS`."""
        self._history[score.header.tray].append(last_sample(score, MEASURED_COLUMNS))

    def update(self, in_alarm: Sequence[Fan], now_ns: int) -> None:
        """Draw the fans in alarm, the first first. now_ns: host time."""
        self._alarm_ns |= {fan: now_ns for fan in in_alarm if fan in self._alarm_ns}
        self._alarm_ns = {fan: t_ns for fan, t_ns in self._alarm_ns.items() if now_ns - t_ns <= self._hold_ns}
        for fan in in_alarm:
            if fan in self._alarm_ns or fan in self._asked:
                continue
            if len(self._alarm_ns) >= self._most_in_alarm:
                over = [each for each, t_ns in self._alarm_ns.items() if t_ns < now_ns]
                if not over:
                    break
                del self._alarm_ns[min(over, key=self._alarm_ns.__getitem__)]
            self._alarm_ns[fan] = now_ns
