"""What is shown of a fleet: an overview of all fans, and which of them are drawn with their bands.

It is fed with the newest sample of each tray, once or twice a second. Those of the last window are kept, so that a plot
that begins with an alarm shows what was before it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.outputs.rerun.plot_places import PlotPlaces
from fantwin.pipeline.outputs.rerun.worst_page import worst_page
from fantwin.pipeline.site.fleet import FLEET_COLUMNS, Fan, Fleet, last_sample
from fantwin.pipeline.site.trace import MEASURED_COLUMNS
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.units import NS_PER_S

SILENT_AFTER_NS = 5 * NS_PER_S
"""a tray without a score for so long is silent"""
ADDED_EVERY_NS = NS_PER_S // 2
"""the newest samples come no faster"""
BEHIND_NS = 10 * NS_PER_S
"""trays may be so far behind the others; if all that comes is older still, it is a replay, at times of its own"""
PAGE_PERIOD_NS = NS_PER_S
"""between two pages about the worst fans: faster than this nobody reads"""
REPEAT_NS = 5 * NS_PER_S
"""what does not change is sent again for viewers that join late"""
COLUMNS = tuple(dict.fromkeys((*FLEET_COLUMNS, *MEASURED_COLUMNS)))


@dataclass(frozen=True, eq=False)
class Overview:
    """The overview at one time.

    Attributes:
        t_ns: time of the newest sample, ns since the epoch.
        counts: fans in alarm, suspect, not judged.
        page: about the worst fans, in Markdown; None: it has not changed.
    """

    t_ns: int
    counts: Mapping[str, int]
    page: str | None


class FleetView:
    """Collects what the overview shows, and chooses the fans that have a plot."""

    def __init__(self, site: str, trays: Sequence[TrayConfig], places: PlotPlaces, window_ns: int) -> None:
        """window_ns: how far back a plot begins."""
        self._site = site
        self._fleet = Fleet(trays)
        self._places = places
        self._window_ns = window_ns
        self._history = {tray.name: deque[Score](maxlen=math.ceil(window_ns / ADDED_EVERY_NS)) for tray in trays}
        self._heard_ns: dict[str, int] = {}
        """by tray, host time"""
        self.silent: set[str] = set()
        """the trays that have sent samples and do so no more"""
        self._t_ns = 0
        self._repeated_ns = self._page_ns = -REPEAT_NS
        self._page = ""

    @property
    def places(self) -> Mapping[Fan, int]:
        """The fans that have a plot, with the number of its place."""
        return self._places.taken()

    def history(self, tray: str) -> Sequence[Score]:
        """The samples of a tray that were added within the last window, one score each, with `MEASURED_COLUMNS`."""
        kept = self._history[tray]
        return [score for score in kept if 0 <= int(kept[-1].t_ns[0] - score.t_ns[0]) < self._window_ns]

    def add_newest(self, scores: Sequence[Score], now_ns: int) -> None:
        """Take the last sample of the newest score, with `COLUMNS`, of each tray that has sent one since the last call.

        `now_ns` is host time. Trays that have sent none for long become silent.
        """
        for score in scores:
            tray = score.header.tray
            self._heard_ns[tray] = now_ns
            newest = last_sample(score, COLUMNS)
            self._history[tray].append(newest)
            self._fleet.update(newest)
        newest_t_ns = max((int(score.t_ns[-1]) for score in scores), default=self._t_ns)
        if newest_t_ns > self._t_ns or newest_t_ns < self._t_ns - BEHIND_NS:
            self._t_ns = newest_t_ns
        self.silent = {tray for tray, heard_ns in self._heard_ns.items() if now_ns - heard_ns > SILENT_AFTER_NS}
        for tray in self.silent:
            self._fleet.silence(tray, int(self._history[tray][-1].t_ns[-1]))
        heard = self._heard_ns.keys() - self.silent
        self._places.update([fan for fan in self._fleet.alarms() if fan.tray in heard], now_ns)

    def add_alarm(self, alarm: Alarm) -> None:
        """Take the state of an alarm of a known tray."""
        self._fleet.add_alarm(alarm)

    def overview(self, now_ns: int) -> Overview | None:
        """What has changed in the overview; None before the first sample. `now_ns` is host time."""
        if not self._heard_ns:
            return None
        repeat = now_ns - self._repeated_ns >= REPEAT_NS
        if repeat:
            self._repeated_ns = now_ns
        page = None
        if now_ns - self._page_ns >= PAGE_PERIOD_NS:
            page = worst_page(self._site, self._fleet, self._places.place, self._t_ns)
            page = page if repeat or page != self._page else None
        if page is not None:
            self._page_ns, self._page = now_ns, page
        return Overview(t_ns=self._t_ns, counts=self._fleet.counts(), page=page)
