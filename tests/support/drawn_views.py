"""A viewer in this process: its context, its messages, a sink that remembers, and its files read back."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.rerun.alarm_log import LogLine
from fantwin.pipeline.outputs.rerun.rerun_sink import RerunSink
from fantwin.pipeline.outputs.rerun.rerun_wear import WearPoints
from fantwin.pipeline.runtime.stage import Context, Core
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.trace import Trace
from fantwin.schemas.codec import encode
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Message, Score
from fantwin.schemas.topics import tray_key
from fantwin.stages.viewer import ViewerConfig
from tests.support.score_data import START_NS

LATER_NS = START_NS + 400 * 86_400 * 1_000_000_000  # the host's time while what was recorded at START_NS is replayed


@dataclass
class FakeSink(RerunSink):
    """Remembers the items it received."""

    traces: list[Trace] = field(default_factory=list)
    states: list[tuple[str, int, list[int], list[str]]] = field(default_factory=list)
    lines: list[LogLine] = field(default_factory=list)
    shown: list[tuple[Fan, ...]] = field(default_factory=list)
    wear: list[tuple[str, WearPoints]] = field(default_factory=list)
    tables: list[tuple[int, str]] = field(default_factory=list)
    flushed: int = 0
    closed: bool = False
    trouble: str = ""

    def draw(self, trace: Trace) -> None:
        self.traces.append(trace)

    def change_states(self, tray: str, fan: int, t_ns: Any, names: Sequence[str]) -> None:
        self.states.append((tray, fan, t_ns.tolist(), list(names)))

    def show_fans(self, fans: Sequence[Fan]) -> None:
        self.shown.append(tuple(fans))

    def draw_wear(self, tray: str, points: Sequence[WearPoints]) -> None:
        self.wear += [(tray, each) for each in points]

    def show_alarms(self, table: str, t_ns: int) -> None:
        self.tables.append((t_ns, table))

    def log(self, lines: Sequence[LogLine]) -> None:
        self.lines += lines

    def flush(self) -> None:
        self.flushed = len(self.traces)

    def problem(self) -> str:
        return self.trouble

    def close(self) -> None:
        self.closed = True

    def lane(self, fan: int) -> list[tuple[float, str]]:
        """A fan's lane: (s since the start, state)."""
        return [
            ((t - START_NS) / 1e9, name)
            for _, of, times, names in self.states
            if of == fan
            for t, name in zip(times, names, strict=True)
        ]


def sent(message: Message) -> Message | Envelope:
    """A message as the runner hands it over: a score has not been decoded."""
    if not isinstance(message, Score):
        return message
    key = tray_key("site", message.header.tray, "score")
    return Envelope(key, "score", encode(message), 0)


def play(core: Core, scores: Sequence[Score]) -> None:
    """Hand over scores with a tick after each, as the runner does."""
    for score in scores:
        core.step(sent(score))
        core.tick(int(score.t_ns[-1]))


def context(
    folder: Path, *, fans: int = 3, speed_unit: Any = "rad/s", trays: Sequence[str] = ("tray1",), **config: Any
) -> Context:
    configs = tuple(TrayConfig(name=name, fans=fans, speed_unit=speed_unit) for name in trays)
    viewer = ViewerConfig(**{"file": "view.rrd", "grpc_port": 0, **config})
    return Context("site", configs, viewer, folder, folder, started_t_ns=START_NS)


def chunks_of(path: Path) -> list[Any]:
    reader: Callable[[Path], Any] = pytest.importorskip("rerun.chunk").RrdReader
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*no footer")
        return list(reader(path).stream())


def rows_of(path: Path) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """Entity -> (time in ns, component -> values) in order of time, of what is on the time line."""
    rows: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for chunk in chunks_of(path):
        table = chunk.to_record_batch()
        if "time" not in table.schema.names:  # static, or wear
            continue
        times = np.asarray(table.column("time")).astype(np.int64)
        names = [name for name in table.schema.names if ":" in name]
        for index, t_ns in enumerate(times.tolist()):
            row = {name: table.column(name)[index].as_py() for name in names}
            rows.setdefault(chunk.entity_path, []).append((t_ns, row))
    return {path: sorted(of, key=lambda row: row[0]) for path, of in rows.items()}


def styles_of(path: Path, entity: str, component: str) -> list[str]:
    (chunk,) = (chunk for chunk in chunks_of(path) if chunk.is_static and chunk.entity_path == entity)
    return chunk.to_record_batch().column(component)[0].as_py()
