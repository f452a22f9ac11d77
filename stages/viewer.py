"""Viewer: shows twin, measurement, states and alarms live in Rerun.

Reads `score`, `alarm`, `twin` and `health`; writes nothing. One core serves all trays. Speeds are shown in the unit of
the tray. Samples are collected and drawn twice a second, because a call into Rerun is expensive and a row in it is
cheap. Only samples and alarms are on the time line, at the time of the sample. Reports in host time go to a page
without time; otherwise, in a replay of an old recording, these reports would be the newest data, which viewers follow.
It may drop messages: the runner keeps a bounded queue in front of it and counts what it drops.
"""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from pydantic import Field

from pipeline.config.models import TrayConfig
from pipeline.optional_dependencies import how_to_install
from pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageConfig, StageError
from pipeline.viewing.loopback import check_free
from pipeline.viewing.stages_page import StagesPage
from pipeline.viewing.trace import Trace, state_changes, state_name, trace_of
from schemas.messages import Alarm, Array, Health, Message, ModelCard, Score, Severity, Transition
from scoring.alarms.current_alarms import words_of

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


class ViewSink(Protocol):
    """Destination of a view. Times are ns since the epoch."""

    def draw(self, trace: Trace) -> None:
        """Show the next stretch of a tray."""
        ...

    def change_states(self, tray: str, fan: int, t_ns: Array, names: Sequence[str]) -> None:
        """Set the state of a fan's lane from each time on."""
        ...

    def log(self, tray: str, t_ns: int, level: str, text: str) -> None:
        """Add a line to a tray's log; `level` is INFO, WARN or ERROR."""
        ...

    def show_stages(self, page: str) -> None:
        """Replace the page about the stages with this Markdown text."""
        ...

    def flush(self) -> None:
        """Write what has been sent, so that it survives a crash of this process. Returns within seconds."""
        ...

    def problem(self) -> str:
        """Why the view is not complete; empty if all is well."""
        ...

    def close(self) -> None:
        """Write everything and close, within seconds."""
        ...


def alarm_line(alarm: Alarm) -> tuple[str, str]:
    """Level and text of an alarm's transition, for the log."""
    happened = alarm.transition.words
    is_bad = alarm.active or alarm.transition != Transition.REPUBLISHED
    if not is_bad or alarm.transition not in (Transition.RAISED, Transition.SEVERITY, Transition.REPUBLISHED):
        return "INFO", f"{happened}: {words_of(alarm)}"
    level = "ERROR" if alarm.severity == Severity.ALARM else "WARN"
    return level, f"{alarm.severity.words} {happened}: {words_of(alarm)}"


@dataclass(slots=True)
class _TrayView:
    """State of one tray between two flushes."""

    config: TrayConfig
    scores: list[Score] = field(default_factory=list)
    samples: int = 0
    states: dict[int, str] = field(default_factory=dict)
    wrong_fans: int = 0  # fans of the last score, if not the configured number
    repeated_t_ns: int = 0


class ViewerCore(Core):
    """Collects scores and passes them to a sink in few, long pieces."""

    def __init__(self, trays: Sequence[TrayConfig], sink: ViewSink) -> None:
        self._views = {tray.name: _TrayView(tray) for tray in trays}
        self._sink = sink
        self._now_ns = 0
        self._flushed_t_ns = 0
        self._page = StagesPage()
        self._shown_page = ""
        self._page_t_ns = 0
        self._samples_drawn = 0
        self._counts: Counter[str] = Counter()

    def step(self, item: Message) -> Sequence[Message]:
        """Keep a score for the next flush, log an alarm, add a twin or the health of a stage to the page."""
        if isinstance(item, Health):
            self._page.add_health(item)
            return ()
        view = self._views.get(item.header.tray)
        if view is None:
            self._counts["unknown_tray"] += 1
            return ()
        if isinstance(item, Score):
            self._add_score(view, item)
        elif isinstance(item, Alarm):
            self._sink.log(view.config.name, item.t_ns, *alarm_line(item))
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

    def problem(self) -> str:
        """Scores with another number of fans than configured, or what the sink reports; empty if there is nothing."""
        for name, view in self._views.items():
            if view.wrong_fans:
                return (
                    f"scores have {view.wrong_fans} fans, [[tray]] {name} has fans = {view.config.fans}: correct `fans`"
                )
        return self._sink.problem()

    def _add_score(self, view: _TrayView, score: Score) -> None:
        if score.fans != view.config.fans:
            self._counts["wrong_fan_count"] += 1
            view.wrong_fans = score.fans
            return
        view.wrong_fans = 0
        view.scores.append(score)
        view.samples += len(score.t_ns)
        if view.samples >= SAMPLES_HELD:
            self._flush(view)

    def _show_stages(self) -> None:
        page = self._page.text(self._now_ns)
        if page != self._shown_page:
            self._shown_page = page
            self._page_t_ns = self._now_ns
            self._sink.show_stages(page)

    def _flush_all(self) -> None:
        for view in self._views.values():
            self._flush(view)
        self._sink.flush()

    def _flush(self, view: _TrayView) -> None:
        if not view.samples:
            return
        trace = trace_of(view.config.name, view.scores, view.config.speed_unit)
        view.scores, view.samples = [], 0
        self._samples_drawn += len(trace.t_ns)
        self._sink.draw(trace)
        newest_t_ns = int(trace.t_ns[-1])
        repeat = newest_t_ns - view.repeated_t_ns >= REPEAT_STATES_NS
        if repeat:
            view.repeated_t_ns = newest_t_ns
        for fan in range(trace.fans):
            t_ns, names = state_changes(trace, fan, view.states.get(fan))
            if not names and repeat:
                t_ns, names = trace.t_ns[-1:], [state_name(trace.state[-1, fan], trace.invalid_reason[-1, fan])]
            if names:
                view.states[fan] = names[-1]
                self._sink.change_states(trace.tray, fan, np.asarray(t_ns), names)


def build(context: Context) -> BuiltStage:
    """Open the file and serve the viewers.

    Raises:
        StageError: Rerun is not installed, a port is taken, or the file cannot be written.
    """
    try:
        from pipeline.viewing.rerun_sink import RerunSink  # noqa: PLC0415  the extra `view` may not be installed
    except ModuleNotFoundError as error:
        if error.name != "rerun":
            raise
        raise StageError(NO_RERUN) from error
    config: ViewerConfig = context.config
    ports = _ports(context)
    sink = RerunSink(
        name=context.site,
        trays=context.trays,
        started_t_ns=context.started_t_ns,
        window_s=config.window_s,
        file=context.own_file(Path(config.file)) if config.file else None,
        grpc_port=ports.get("grpc_port"),
        web_port=ports.get("web_port"),
        memory_limit=config.memory_limit,
    )
    return BuiltStage(ViewerCore(context.trays, sink))


def _ports(context: Context) -> dict[str, int]:
    """The ports that are served, by key: as configured, and one more for each further shard, which may be on this
    host."""
    config: ViewerConfig = context.config
    configured = {"grpc_port": config.grpc_port, "web_port": config.web_port} if config.serve else {}
    return {key: port + context.shard_number - 1 for key, port in configured.items() if port}


def check(context: Context) -> list[str]:
    """Report a missing extra, and ports that another program has taken."""
    problems = [] if importlib.util.find_spec("rerun") else [NO_RERUN]
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
    may_drop=True,
    check=check,
)
