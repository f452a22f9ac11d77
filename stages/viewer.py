"""Viewer: shows twin, measurement, states and alarms live in Rerun.

Reads `score`, `alarm`, `twin` and `health`; writes nothing. One core serves all trays. Speeds are shown in the unit of
the tray. Samples are collected and drawn twice a second, because a call into Rerun is expensive and a row in it is
cheap.

With few fans, every sample is drawn. With more than `fleet_above`, an overview has a cell for every fan, and only some
fans are drawn sample by sample: those in alarm, as far as there is room, and those in `show`. Of the other trays the
newest score is asked for once a second, and the rest never arrives.

Only samples and alarms are on the time line, at the time of the sample. Reports in host time go to a page
without time; otherwise, in a replay of an old recording, these reports would be the newest data, which viewers follow.
It may drop messages: the runner keeps a bounded queue in front of it and counts what it drops.
"""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydantic import Field

from pipeline.config.models import TrayConfig, nearest
from pipeline.optional_dependencies import how_to_install
from pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageConfig, StageError
from pipeline.viewing.alarm_log import LogLine, log_line
from pipeline.viewing.fleet import SILENT, Fan
from pipeline.viewing.fleet_view import COLUMNS, FleetView
from pipeline.viewing.loopback import check_free
from pipeline.viewing.plot_places import FleetPlots, PlotPlaces
from pipeline.viewing.stages_page import StagesPage
from pipeline.viewing.trace import MEASURED_COLUMNS, Trace, state_changes, state_name, trace_of
from pipeline.viewing.view_sink import ViewSink
from schemas.codec import CodecError, decode_columns
from schemas.envelope import Envelope
from schemas.health import Health
from schemas.messages import Alarm, Message, ModelCard, Score
from schemas.units import NS_PER_S

NO_RERUN = f"the viewer needs the extra `view`: take viewer out of launcher.stages, or {how_to_install('view')}"
FLUSH_PERIOD_NS = 500_000_000
REPEAT_STATES_NS = 5_000_000_000  # a viewer that joins late finds a state at most this old
PAGE_PERIOD_NS = 5_000_000_000  # minimum between two pages: Rerun never drops data without a time, however old
SAMPLES_HELD = 4096  # samples kept per tray, when a replay is faster than the ticks


class ViewerConfig(StageConfig):
    """Section `[viewer]`."""

    file: str = Field(
        default="view.rrd",
        description='file in run_folder for the view; an older file is kept, and view-2.rrd is written; "": no file',
    )
    serve: bool = Field(default=True, description="serve live viewers on this host (127.0.0.1)")
    grpc_port: int = Field(
        default=9876,
        ge=1,
        le=65535,
        description="port of the data, for native and browser viewer; of shard K the K-th from here on",
    )
    web_port: int = Field(
        default=9090, ge=0, le=65535, description="port of the browser viewer's page, counted alike; 0: no page"
    )
    window_s: float = Field(default=30.0, gt=0, description="length of the rolling window, s")
    memory_limit: str = Field(
        default="256MB", pattern=r"^\d+(MB|GB|MiB|GiB)$", description="history kept for viewers that join late"
    )
    fleet_above: int = Field(
        default=64, ge=0, description="with more fans than this on the site, an overview and few plots are shown"
    )
    show: tuple[str, ...] = Field(
        default=(), max_length=64, description='fans of a fleet that always have a plot: ["tray1/3", "tray2/0"]'
    )
    alarm_plots: int = Field(
        default=8, ge=0, le=64, description="how many fans in alarm have a plot at a time, in the view of a fleet"
    )
    alarm_plot_hold_s: float = Field(
        default=60.0, ge=0, description="how long such a plot stays after the alarm is over, s"
    )


@dataclass(slots=True)
class _TrayView:
    """State of one tray between two flushes.

    Attributes:
        fans: which are drawn; None: all.
        newest: the newest score that the overview has not seen.
        drawn_t_ns: by fan, the time of the last sample drawn.
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


class ViewerCore(Core):
    """Collects scores and passes them to a sink in few, long pieces."""

    def __init__(self, trays: Sequence[TrayConfig], sink: ViewSink, fleet: FleetView | None = None) -> None:
        """fleet: the overview; None: every fan is drawn, and there is no overview."""
        self._views = {tray.name: _TrayView(tray, () if fleet else None) for tray in trays}
        self._sink = sink
        self._fleet = fleet
        self._places: dict[Fan, int] = {}
        self._lines: list[LogLine] = []
        self._now_ns = 0
        self._flushed_t_ns = 0
        self._page = StagesPage()
        self._shown_page = ""
        self._page_t_ns = 0
        self._samples_drawn = 0
        self._counts: Counter[str] = Counter()
        self._show_places()

    def step(self, item: Message | Envelope) -> Sequence[Message]:
        """Keep a score for the next flush, as an alarm for the log; add a twin or the health of a stage to the page."""
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
            if self._fleet:
                self._fleet.add_alarm(item)
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
        self._sink.flush()

    def _flush(self, view: _TrayView) -> None:
        if view.samples:
            self._draw(view, trace_of(view.config.name, view.scores, view.config.speed_unit, view.fans))
        view.scores, view.samples = [], 0

    def _draw(self, view: _TrayView, trace: Trace) -> None:
        self._samples_drawn += len(trace.t_ns)
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
            self._views[name].fans = tuple(sorted(fan.number for fan in places if fan.tray == name))
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
            self._draw(view, trace_of(fan.tray, before, view.config.speed_unit, (fan.number,)))


def shown_fans(names: Iterable[str], trays: Sequence[TrayConfig]) -> list[Fan]:
    """The fans named in `viewer.show`.

    Raises:
        StageError: a name is not `tray/fan`, or there is no such fan.
    """
    fans = {tray.name: tray.fans for tray in trays}
    found: list[Fan] = []
    for name in names:
        tray, _, number = name.rpartition("/")
        if not (tray and number.isascii() and number.isdigit()):
            raise StageError(f'viewer.show: {name!r} is no fan; write "tray/number", for example "{trays[0].name}/0"')
        if tray not in fans:
            raise StageError(f"viewer.show: {name!r}: no tray called {tray!r}{nearest(tray, fans)}")
        if int(number) >= fans[tray]:
            raise StageError(f"viewer.show: {name!r}: {tray} has fans 0 to {fans[tray] - 1}")
        found.append(Fan(tray, int(number)))
    return list(dict.fromkeys(found))


def build(context: Context) -> BuiltStage:
    """Open the file and serve the viewers.

    Raises:
        StageError: Rerun is not installed, a port is taken, the file cannot be written, or `show` names no fan.
    """
    try:
        from pipeline.viewing.rerun_sink import RerunSink  # noqa: PLC0415  the extra `view` may not be installed
    except ModuleNotFoundError as error:
        if error.name != "rerun":
            raise
        raise StageError(NO_RERUN) from error
    config: ViewerConfig = context.config
    plots = FleetPlots(shown_fans(config.show, context.trays), config.alarm_plots)
    is_fleet = sum(tray.fans for tray in context.trays) > config.fleet_above
    ports = _ports(context)
    sink = RerunSink(
        name=context.site,
        trays=context.trays,
        fleet=plots if is_fleet else None,
        started_t_ns=context.started_t_ns,
        window_s=config.window_s,
        file=context.own_file(Path(config.file)) if config.file else None,
        grpc_port=ports.get("grpc_port"),
        web_port=ports.get("web_port"),
        memory_limit=config.memory_limit,
    )
    fleet = None
    if is_fleet:
        places = PlotPlaces(plots, round(config.alarm_plot_hold_s * NS_PER_S))
        fleet = FleetView(context.site, context.trays, places, round(config.window_s * NS_PER_S))
    return BuiltStage(ViewerCore(context.trays, sink, fleet))


def _ports(context: Context) -> dict[str, int]:
    """The ports that are served, by key: as configured, and one more for each further shard, which may be on this
    host."""
    config: ViewerConfig = context.config
    configured = {"grpc_port": config.grpc_port, "web_port": config.web_port} if config.serve else {}
    return {key: port + context.shard_number - 1 for key, port in configured.items() if port}


def check(context: Context) -> list[str]:
    """Report a missing extra, fans to show that do not exist, and ports that another program has taken."""
    config: ViewerConfig = context.config
    problems = [] if importlib.util.find_spec("rerun") else [NO_RERUN]
    try:
        shown_fans(config.show, context.trays)
    except StageError as error:
        problems.append(str(error))
    for key, port in ({} if context.is_running else _ports(context)).items():
        try:
            check_free(port, f"viewer.{key}", "viewer.serve = false")
        except StageError as error:
            problems.append(str(error))
    return problems


STAGE = Stage(
    name="viewer",
    about="shows measured speed, twin, band, alarms and states live in Rerun, and keeps them in a file",
    reads=("score", "alarm", "twin", "health"),
    writes=(),
    config=ViewerConfig,
    build=build,
    core_per_tray=False,
    undecoded=("score",),
    may_drop=True,
    check=check,
)
