"""The viewer's core: collects what the stages say about the fans and passes it to a sink in few, long pieces."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.outputs.rerun.alarm_log import LogLine, log_line
from fantwin.pipeline.outputs.rerun.alarm_table import AlarmTable
from fantwin.pipeline.outputs.rerun.fleet_view import COLUMNS, FleetView
from fantwin.pipeline.outputs.rerun.stages_page import StagesPage
from fantwin.pipeline.outputs.rerun.view_sink import ViewSink
from fantwin.pipeline.outputs.rerun.wear_points import WearPoints, wear_points
from fantwin.pipeline.runtime.stage import Core
from fantwin.pipeline.site.fleet import SILENT, Fan
from fantwin.pipeline.site.trace import MEASURED_COLUMNS, Trace, state_changes, state_name, trace_of, with_holes
from fantwin.schemas.codec import CodecError, decode_columns
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm, Message, ModelCard, Score, ScorerSnapshot

FLUSH_PERIOD_NS = 500_000_000
REPEAT_STATES_NS = 5_000_000_000  # a viewer that joins late finds a state at most this old
PAGE_PERIOD_NS = 5_000_000_000  # minimum between two pages: Rerun never drops data without a time, however old
SAMPLES_HELD = 4096  # samples kept per tray, when a replay is faster than the ticks


@dataclass(slots=True)
class _TrayView:
    """State of one tray between two flushes.

    Attributes:
        fans: which are drawn; None: all.
        newest: the newest score that the overview has not seen.
        drawn_t_ns: by fan, the time of the last sample drawn.
        before_t_ns: the last sample of the last flush; None: its samples have not been followed since.
        wear: the points of a snapshot that came since the last flush.
    """

    config: TrayConfig
    fans: Sequence[int] | None
    scores: list[Score] = field(default_factory=list)
    samples: int = 0
    states: dict[int, str] = field(default_factory=dict)
    wrong_fans: int = 0  # fans of the last score, if not the configured number
    repeated_t_ns: int = 0
    newest: Envelope | None = None
    drawn_t_ns: dict[int, int] = field(default_factory=dict)
    before_t_ns: int | None = None
    wear: Sequence[WearPoints] = ()


class ViewerCore(Core):
    """Collects scores and passes them to a sink in few, long pieces."""

    def __init__(self, trays: Sequence[TrayConfig], sink: ViewSink, fleet: FleetView | None = None) -> None:
        """fleet: the overview; None: every fan is drawn, and there is no overview."""
        self._views = {tray.name: _TrayView(tray, () if fleet else None) for tray in trays}
        self._sink = sink
        self._fleet = fleet
        self._places: dict[Fan, int] = {}
        self._lines: list[LogLine] = []
        self._alarms = AlarmTable()
        self._shown_alarms = ""
        self._alarms_t_ns = 0
        self._now_ns = 0
        self._flushed_t_ns = 0
        self._page = StagesPage()
        self._shown_page = ""
        self._page_t_ns = 0
        self._samples_drawn = 0
        self._newest_t_ns = 0
        self._counts: Counter[str] = Counter()
        self._show_places()

    def step(self, item: Message | Envelope) -> Sequence[Message]:
        """Keep a score, an alarm or a snapshot for the next flush; add a twin or the health of a stage to the page."""
        if isinstance(item, Health):
            self._page.add_health(item)
            return ()
        view = self._views.get(item.header.tray)
        if view is None:
            self._counts["unknown_tray"] += 1
        elif isinstance(item, Envelope):
            self._add_score(view, item)
        elif isinstance(item, Alarm):
            self._lines.append(log_line(item))
            self._alarms.add(item)
            if self._fleet:
                self._fleet.add_alarm(item)
        elif isinstance(item, ScorerSnapshot) and not self._fleet:
            view.wear = wear_points(item)
        elif isinstance(item, ModelCard):
            self._page.add_twin(view.config.name, item)
        return ()

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Draw the samples since the last flush, twice a second."""
        self._now_ns = now_ns
        if now_ns - self._flushed_t_ns >= FLUSH_PERIOD_NS:
            self._flushed_t_ns = now_ns
            if now_ns - self._page_t_ns >= PAGE_PERIOD_NS:
                self._show_stages()
            self._flush_all()
        return ()

    def close(self) -> Sequence[Message]:
        """Draw the remaining samples and close the file."""
        self._show_stages()
        self._flush_all()
        self._sink.close()
        return ()

    def abort(self) -> None:
        """Finish the file after a crash."""
        self._sink.close()

    def counters(self) -> Mapping[str, int]:
        """Samples drawn, scores with another number of fans, and messages of trays that are not configured."""
        return {"samples_drawn": self._samples_drawn, "wrong_fan_count": 0, **self._counts}

    def followed(self) -> Set[str] | None:
        """The trays with a fan that is drawn; None if all are."""
        return {fan.tray for fan in self._places} if self._fleet else None

    def problem(self) -> str:
        """Scores with another number of fans than configured, or what the sink reports; empty if there is nothing."""
        for name, view in self._views.items():
            if view.wrong_fans:
                return (
                    f"scores have {view.wrong_fans} fans, [[tray]] {name} has fans = {view.config.fans}: correct `fans`"
                )
        return self._sink.problem()

    def _add_score(self, view: _TrayView, envelope: Envelope) -> None:
        if self._fleet:
            view.newest = envelope
        if view.fans == ():
            return
        score = self._decode(view, envelope, MEASURED_COLUMNS)
        if score is None:
            return
        view.scores.append(score)
        view.samples += len(score.t_ns)
        if view.samples >= SAMPLES_HELD:
            self._flush(view)

    def _decode(self, view: _TrayView, envelope: Envelope, columns: Sequence[str]) -> Score | None:
        """Some columns of a score; None if it cannot be shown, which is counted."""
        try:
            score = decode_columns(Score, envelope.payload, columns)
        except CodecError:
            self._counts["undecodable"] += 1
            return None
        if score.fans != view.config.fans:
            self._counts["wrong_fan_count"] += 1
            view.wrong_fans = score.fans
            return None
        view.wrong_fans = 0
        return score if len(score.t_ns) else None

    def _show_stages(self) -> None:
        page = self._page.text(self._now_ns)
        if page != self._shown_page:
            self._shown_page = page
            self._page_t_ns = self._now_ns
            self._sink.show_stages(page)

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
            view.before_t_ns = self._newest_t_ns = int(trace.t_ns[-1])
        view.scores, view.samples = [], 0

    def _show_alarms(self) -> None:
        """Show the table of alarms when it has changed, and now and then for viewers that join late."""
        table, t_ns = self._alarms.text(), self._newest_t_ns or self._alarms.t_ns
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

    def _flush_fleet(self, fleet: FleetView) -> None:
        """Show the newest sample of every fan, and give plots to the fans in alarm."""
        newest: list[Score] = []
        for view in self._views.values():
            if view.newest is not None:
                score = self._decode(view, view.newest, COLUMNS)
                newest += [score] if score else []
                view.newest = None
        fleet.add_newest(newest, self._now_ns)
        self._show_places()
        overview = fleet.overview(self._now_ns)
        if overview is not None:
            self._newest_t_ns = overview.t_ns
            self._sink.draw_overview(overview)

    def _show_places(self) -> None:
        """Begin and end the plots of a fleet."""
        places = dict(self._fleet.places) if self._fleet else {}
        left = [fan for fan, place in self._places.items() if places.get(fan) != place]
        come = [fan for fan, place in places.items() if self._places.get(fan) != place]
        for fan in left:
            view = self._views[fan.tray]
            view.states.pop(fan.number, None)
            self._sink.hide_fan(fan, view.drawn_t_ns.get(fan.number, 0) + 1)
        self._places = places
        for name in {fan.tray for fan in (*left, *come)}:
            fans = tuple(sorted(fan.number for fan in places if fan.tray == name))
            self._views[name].fans = fans
            if not fans:
                self._views[name].before_t_ns = None
        for fan in come:
            view = self._views[fan.tray]
            self._sink.show_fan(fan, places[fan], view.config.speed_unit)
            self._draw_before(view, fan)
        for fan in places:
            view = self._views[fan.tray]
            if self._fleet and fan.tray in self._fleet.silent and view.states.get(fan.number, SILENT) != SILENT:
                view.states[fan.number] = SILENT
                self._sink.change_states(*fan, np.array([view.drawn_t_ns[fan.number] + 1]), [SILENT])

    def _draw_before(self, view: _TrayView, fan: Fan) -> None:
        """Draw what was before a plot began, a sample or two a second."""
        assert self._fleet is not None
        drawn_t_ns = view.drawn_t_ns.get(fan.number)
        before = [s for s in self._fleet.history(fan.tray) if drawn_t_ns is None or int(s.t_ns[0]) > drawn_t_ns]
        if before:
            trace = trace_of(fan.tray, before, view.config.speed_unit, (fan.number,))
            self._draw(view, trace, len(trace.t_ns))
