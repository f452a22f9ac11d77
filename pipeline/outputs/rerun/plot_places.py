"""Which fans of a fleet have a plot: those asked for always, and those in alarm for as long as there is room."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from fantwin.pipeline.site.fleet import Fan


@dataclass(frozen=True)
class FleetPlots:
    """The plots in the view of a fleet, numbered from 1: first those of the fans asked for, then those for fans in
    alarm."""

    asked: Sequence[Fan] = ()
    for_alarms: int = 0

    @property
    def count(self) -> int:
        """How many plots there are."""
        return len(self.asked) + self.for_alarms

    def title(self, place: int) -> str:
        """The title of a plot."""
        return f"plot {place}: {self.asked[place - 1] if place <= len(self.asked) else 'a fan in alarm'}"


@dataclass(slots=True)
class _Held:
    place: int
    alarm_ns: int
    """when it was in alarm last, host time"""


class PlotPlaces:
    """The plots of a fleet, and the fans in them.

    A fan in alarm keeps its place until its alarm has been over for `hold_ns`; if all are taken, a new one gets the
    place of the fan whose alarm has been over for longest. A fan in alarm never loses its place to another.
    """

    def __init__(self, plots: FleetPlots, hold_ns: int) -> None:
        self._asked = {fan: place for place, fan in enumerate(plots.asked, 1)}
        self._held: dict[Fan, _Held] = {}
        self._free = deque(range(len(plots.asked) + 1, plots.count + 1))
        self._hold_ns = hold_ns

    def place(self, fan: Fan) -> int | None:
        """The place of a fan; None if it has none."""
        held = self._held.get(fan)
        return held.place if held else self._asked.get(fan)

    def taken(self) -> dict[Fan, int]:
        """The place of each fan that has one."""
        return self._asked | {fan: held.place for fan, held in self._held.items()}

    def update(self, in_alarm: Sequence[Fan], now_ns: int) -> None:
        """Give places to the fans in alarm, the first first. `now_ns` is host time."""
        for fan in in_alarm:
            if fan in self._held:
                self._held[fan].alarm_ns = now_ns
        for fan in [fan for fan, held in self._held.items() if now_ns - held.alarm_ns > self._hold_ns]:
            self._free.append(self._held.pop(fan).place)
        for fan in in_alarm:
            if fan in self._held or fan in self._asked:
                continue
            if not self._free and not self._release_one(now_ns):
                break
            # the place that has been free for longest: what it showed before may have left the window
            self._held[fan] = _Held(self._free.popleft(), now_ns)

    def _release_one(self, now_ns: int) -> bool:
        over = [fan for fan, held in self._held.items() if held.alarm_ns < now_ns]
        if not over:
            return False
        longest = min(over, key=lambda fan: self._held[fan].alarm_ns)
        self._free.append(self._held.pop(longest).place)
        return True
