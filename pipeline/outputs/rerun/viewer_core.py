"""The viewer's core: collects what the stages say about the fans and passes it to a sink in few, long pieces."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.rerun import fleet_view
from fantwin.pipeline.outputs.rerun.alarm_log import LogLine, alarm_table, log_line
from fantwin.pipeline.outputs.rerun.fleet_view import ADDED_EVERY_NS, FLEET_ABOVE, FleetView, is_fleet
from fantwin.pipeline.outputs.rerun.rerun_sink import RerunSink, ViewOptions
from fantwin.pipeline.outputs.rerun.rerun_wear import WearPoints, wear_points
from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.site.fleet import SILENT, Fan
from fantwin.pipeline.site.site_core import SiteCore
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.pipeline.site.trace import MEASURED_COLUMNS, Trace, state_changes, state_name, trace_of, with_holes
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm, Message, Score, ScorerSnapshot
from fantwin.schemas.units import NS_PER_S

FLUSH_PERIOD_NS = 500_000_000
REPEAT_STATES_NS = 5_000_000_000  # a viewer that joins late finds a state at most this old
BEHIND_NS = 10 * NS_PER_S
"""trays may be so far behind the others; if all that comes is older still, it is a replay, at times of its own"""
SAMPLES_HELD = 4096  # samples kept per tray, when a replay is faster than the ticks


@dataclass(slots=True)
class _TrayView:
    """State of one tray between two flushes.

    Attributes:
        fans: which are drawn; None: all.
        newest: of a fleet, the newest score since the last flush.
        drawn_t_ns: by fan, the time of the last sample drawn.
        before_t_ns: the last sample of the last flush; None: its samples have not been followed since.
        wear: the points of a snapshot that came since the last flush.
    """

    config: TrayConfig
    fans: Sequence[int] | None
    scores: list[Score] = field(default_factory=list)
    samples: int = 0
    states: dict[int, str] = field(default_factory=dict)
    repeated_t_ns: int = 0
    newest: Score | None = None
    drawn_t_ns: dict[int, int] = field(default_factory=dict)
    before_t_ns: int | None = None
    wear: Sequence[WearPoints] = ()


class ViewerCore(SiteCore):
    """Collects scores and passes them to a sink in few, long pieces."""

    def __init__(self, site: str, trays: Sequence[TrayConfig], sink: RerunSink, fleet: FleetView | None = None) -> None:
        """fleet: which fans are drawn; None: all."""
        self._now_ns: int | None = None
        """host time of the last tick"""
        super().__init__(SiteModel(site, trays, now_s=self._now_s))
        self._views = {tray.name: _TrayView(tray, () if fleet else None) for tray in trays}
        self._sink = sink
        self._fleet = fleet
        self._drawn: Sequence[Fan] = ()
        """of a fleet"""
        self._lines: list[LogLine] = []
        self._shown_alarms = ""
        self._alarms_t_ns = 0
        self._flushed_t_ns = 0
        self._samples_drawn = 0
        self._newest_t_ns = 0
        self._show_fans()

    def _now_s(self) -> float:
        """The model's clock: what has been heard before the first tick is not silent then."""
        return math.inf if self._now_ns is None else self._now_ns / NS_PER_S

    def step(self, item: Message | Envelope) -> Sequence[Message]:
        """Keep what is to be drawn, and what is known of the site."""
        if isinstance(item, ScorerSnapshot) and item.header.tray in self._views:
            if not self._fleet:
                self._views[item.header.tray].wear = wear_points(item)
            return ()
        return super().step(item)

    def add_alarm(self, alarm: Alarm) -> None:
        """Keep it for the next flush."""
        self._lines.append(log_line(alarm))
        self._model.add_alarm(alarm)

    def wants(self, tray: str) -> bool:
        """Whether the next score of a tray is to be decoded: all, where fans of the tray are drawn."""
        is_drawn = not self._fleet or bool(self._views[tray].fans)
        return is_drawn or self._model.wants_score(tray, ADDED_EVERY_NS / NS_PER_S)

    def add_score(self, envelope: Envelope) -> None:
        """Keep it for the next flush."""
        score = self._model.add_score(envelope, MEASURED_COLUMNS)
        if score is None:
            return
        view = self._views[envelope.header.tray]
        if self._fleet:
            view.newest = score
        if view.fans != ():
            view.scores.append(score)
            view.samples += len(score.t_ns)
            if view.samples >= SAMPLES_HELD:
                self._flush(view)

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Draw the samples since the last flush, twice a second."""
        self._now_ns = now_ns
        if now_ns - self._flushed_t_ns >= FLUSH_PERIOD_NS:
            self._flushed_t_ns = now_ns
            self._model.notice_silence()
            self._flush_all()
        return ()

    def close(self) -> Sequence[Message]:
        """Draw the remaining samples and close the file."""
        self._flush_all()
        self._sink.close()
        return ()

    def abort(self) -> None:
        """Finish the file after a crash."""
        self._sink.close()

    def counters(self) -> Mapping[str, int]:
        """Samples drawn, scores that do not fit, and messages of trays and fans that are not configured."""
        return {"samples_drawn": self._samples_drawn, **super().counters()}

    def problem(self) -> str:
        """Scores with another number of fans than configured, or what the sink reports; empty if there is nothing."""
        for name, fans in self._model.wrong_fans.items():
            return (
                f"scores have {fans} fans, [[tray]] {name} has fans = {self._views[name].config.fans}: correct `fans`"
            )
        return self._sink.problem()

    def _flush_all(self) -> None:
        for view in self._views.values():
            self._flush(view)
        if self._fleet:
            self._flush_fleet(self._fleet)
        if self._lines:
            self._sink.log(self._lines)
            self._lines = []
        for view in self._views.values():
            if view.wear:
                self._sink.draw_wear(view.config.name, view.wear)
                view.wear = ()
        self._show_alarms()
        self._sink.flush()

    def _flush(self, view: _TrayView) -> None:
        if view.samples:
            trace = trace_of(view.config.name, view.scores, view.config.speed_unit, view.fans)
            self._draw(view, with_holes(trace, view.scores[-1].period_ns, view.before_t_ns), view.samples)
            view.before_t_ns = int(trace.t_ns[-1])
            self._note_time(view.before_t_ns)
        view.scores, view.samples = [], 0

    def _show_alarms(self) -> None:
        """Show the table of alarms when it has changed, and now and then for viewers that join late."""
        current = self._model.current_alarms()
        t_ns = self._newest_t_ns or max((each.newest.t_ns for each in current), default=0)
        table = alarm_table(current, t_ns)
        if t_ns and (table != self._shown_alarms or t_ns - self._alarms_t_ns >= REPEAT_STATES_NS):
            self._shown_alarms, self._alarms_t_ns = table, t_ns
            self._sink.show_alarms(table, t_ns)

    def _draw(self, view: _TrayView, trace: Trace, samples: int) -> None:
        self._samples_drawn += samples
        self._sink.draw(trace)
        newest_t_ns = int(trace.t_ns[-1])
        repeat = newest_t_ns - view.repeated_t_ns >= REPEAT_STATES_NS
        if repeat:
            view.repeated_t_ns = newest_t_ns
        for column, fan in enumerate(trace.fan_numbers):
            view.drawn_t_ns[fan] = newest_t_ns
            t_ns, names = state_changes(trace, column, view.states.get(fan))
            if not names and repeat:
                t_ns = trace.t_ns[-1:]
                names = [state_name(trace.state[-1, column], trace.invalid_reason[-1, column])]
            if names:
                view.states[fan] = names[-1]
                self._sink.change_states(trace.tray, fan, np.asarray(t_ns), names)

    def _note_time(self, t_ns: int) -> None:
        if not self._newest_t_ns - BEHIND_NS <= t_ns <= self._newest_t_ns:
            self._newest_t_ns = t_ns

    def _flush_fleet(self, fleet: FleetView) -> None:
        """Keep the newest sample of every tray, and draw the fans in alarm."""
        for view in self._views.values():
            if view.newest is not None:
                fleet.add_newest(view.newest)
                self._note_time(int(view.newest.t_ns[-1]))
                view.newest = None
        heard = {name for name in self._views if not self._model.is_silent(name)}
        fleet.update([fan for fan in self._model.in_alarm() if fan.tray in heard], self._now_ns or 0)
        self._show_fans()

    def _show_fans(self) -> None:
        """Begin and end the plots of a fleet."""
        drawn = self._fleet.drawn if self._fleet else ()
        left, come = (set(one) - set(other) for one, other in ((self._drawn, drawn), (drawn, self._drawn)))
        self._drawn = drawn
        for name in {fan.tray for fan in left | come}:
            view = self._views[name]
            view.fans = tuple(sorted(fan.number for fan in drawn if fan.tray == name))
            if not view.fans:
                view.before_t_ns = None
        if left or come:
            self._sink.show_fans(drawn)
        for fan in sorted(come):
            self._draw_before(self._views[fan.tray], fan)
        for fan in drawn:
            view = self._views[fan.tray]
            if view.drawn_t_ns and self._model.is_silent(fan.tray) and view.states.get(fan.number, SILENT) != SILENT:
                view.states[fan.number] = SILENT
                self._sink.change_states(*fan, np.array([view.drawn_t_ns[fan.number] + 1]), [SILENT])

    def _draw_before(self, view: _TrayView, fan: Fan) -> None:
        """Draw what was before a plot began, a sample or two a second."""
        assert self._fleet is not None
        drawn_t_ns = view.drawn_t_ns.get(fan.number)
        before = [s for s in self._fleet.history(fan.tray) if drawn_t_ns is None or int(s.t_ns[0]) > drawn_t_ns]
        if before:
            trace = trace_of(fan.tray, before, view.config.speed_unit, (fan.number,))
            self._draw(view, with_holes(trace, NS_PER_S, drawn_t_ns), len(trace.t_ns))


def view_of_site(
    site: str, trays: Sequence[TrayConfig], started_t_ns: int, file: Path | None, options: ViewOptions
) -> ViewerCore:
    """Open the file and serve the viewers; None leaves the file out.

    Raises:
        StageError: a port is taken, the file cannot be written, or the layout is not one of a fleet.
    """
    fleet = None
    if is_fleet(trays):
        if options.layout == "wear":
            raise StageError(
                f"--layout wear: not with more than {FLEET_ABOVE} fans; fantwin status --wear lists the changes"
            )
        hold_ns, window_ns = round(fleet_view.HOLD_S * NS_PER_S), round(options.window_s * NS_PER_S)
        fleet = FleetView(trays, options.show, fleet_view.ALARM_PLOTS, hold_ns, window_ns)
    return ViewerCore(site, trays, RerunSink(site, trays, started_t_ns, file, options), fleet)
