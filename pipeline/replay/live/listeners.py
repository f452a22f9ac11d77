"""The stages on the bus of a replay: which read it, which conflict with it, and what they lost."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.replay.stage_chain import replay_starts
from fantwin.pipeline.runtime.sessions import Sessions
from fantwin.pipeline.runtime.stage import Stage, load_stage
from fantwin.pipeline.site.loss_accounting import label
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.site.stage_states import StageView
from fantwin.pipeline.timebase.stage_clock import REPLAY
from fantwin.schemas.health import Health
from fantwin.schemas.streams import StreamId, input_streams, output_streams
from fantwin.schemas.topics import ALL_TRAYS, BY_NAME, sessions_key, stage_label

_POLL_S = 0.02
_ANY_STAGE_S = 2.0  # to find any stage: one whose first peer has died tries its endpoint every second
_ALL_STAGES_S = 30.0  # to receive the health of all stages that were found: one that is not linked yet misses messages
_SAID_AFTER_S = 4.0
_UNCHANGED_S = 1.0  # after so long without a new stage, all are found
_STALLED_S = 10.0  # at the end: after so long without progress, waiting for stages that are behind ends


@dataclass(frozen=True)
class Present:
    """A stage that is running on the bus."""

    stage: Stage
    instance: str
    trays: tuple[str, ...] = ()
    """none: all of the site"""

    @property
    def label(self) -> str:
        """Its name for people."""
        return stage_label(self.stage.name, self.instance)


def conflict(present: Collection[Present], topics: Collection[str], trays: Collection[str], site: str) -> str:
    """Why these topics must not be replayed beside the running stages: one line; empty if they may."""
    if "command" in topics:
        driving = [
            each for each in present if STAGES[each.stage.name].scope == "tray" and "command" in each.stage.reads
        ]
        if driving:
            return (
                f"{driving[0].label} of site {site!r} is running, and recorded commands are not for the fans of today: "
                "stop it, or replay on a site or bus.endpoint of its own"
            )
    for each in present:
        if each.trays and set(each.trays).isdisjoint(trays):
            continue
        for topic in each.stage.writes:
            if topic in topics:
                other = _another_start(present)
                way_out = f"replay with --from-topic {other}, or stop it" if other else "stop it"
                return f"{each.label} of site {site!r} is running and writes {topic} itself: {way_out}"
    answering = [each for each in present if "request" in each.stage.reads and "alarm" in each.stage.writes]
    if "request" in topics and answering:
        return (
            f"{answering[0].label} of site {site!r} is running, and recorded requests are not for the alarms of today: "
            "leave request out of --topics, or replay on a site or bus.endpoint of its own"
        )
    return ""


def made_by_stages(present: Collection[Present], topics: Collection[str]) -> dict[str, str]:
    """The topics that are not recorded, which the replay leaves to a running stage that writes them: by topic, its
    label."""
    of_replay = [topic for topic in topics if not BY_NAME[topic].recorded]
    return {topic: each.label for topic in of_replay for each in present if topic in each.stage.writes}


def _another_start(present: Collection[Present]) -> str:
    """The topic to start from so that running stages have input, and none of them writes what is replayed; or empty."""
    for start, topics in replay_starts().items():
        written = any(topic in each.stage.writes for each in present for topic in topics if BY_NAME[topic].recorded)
        if not written and any(start in each.stage.reads for each in present if each.stage.writes):
            return start
    return ""


class Listeners:
    """Watches the stages on the bus."""

    def __init__(self, bus: Bus, site: str) -> None:
        """Start watching, before the replay itself is on the bus."""
        self._site = site
        self._watcher = SiteWatcher(bus, site)
        self._sessions = Sessions()
        bus.watch_alive(sessions_key(site), self._sessions.update)
        self._before: dict[str, int] = {}
        self._present_at_start: set[str] = set()

    def wait_for_discovery(self, stop: threading.Event, report: Callable[[str], None]) -> None:
        """Wait until the running stages are connected and the health of each has arrived; `report` prints a line if
        that takes long."""
        began_s = steady_s = time.monotonic()
        known: set[str] = set()
        waited_for: list[str] = []
        while not stop.wait(_POLL_S):
            now_s = time.monotonic()
            views = {view.health.header.producer for view in self._views()}
            if views != known:
                known, steady_s = views, now_s
            if now_s - began_s > _SAID_AFTER_S and not waited_for:
                heard = {label(view.health) for view in self._views()}
                waited_for = [each.label for each in self.present() if each.label not in heard]
                if waited_for:
                    report(f"waiting for {', '.join(waited_for)} of site {self._site!r}, up to {_ALL_STAGES_S:.0f} s")
            complete = len(views) >= len(self.present()) and now_s - steady_s > _UNCHANGED_S
            if now_s - began_s > (_ALL_STAGES_S if self._watcher.alive() else _ANY_STAGE_S) or (views and complete):
                break
        self._before = self._watcher.losses()
        self._present_at_start = known

    def present(self) -> list[Present]:
        """The running stages."""
        sessions = {name: self._sessions.named(*name) for name in sorted(self._watcher.alive())}
        return [
            Present(load_stage(stage), instance, session.trays if session else ())
            for (stage, instance), session in sessions.items()
            if stage in STAGES
        ]

    def is_replaying(self) -> bool:
        """Whether a replay, this one or another, is on the bus."""
        return (REPLAY, ALL_TRAYS) in self._watcher.alive()

    def readers(self, topics: Collection[str]) -> list[str]:
        """The running stages that read any of these topics."""
        return [each.label for each in self.present() if any(topic in topics for topic in each.stage.reads)]

    def wait_until_drained(
        self, producer: str, published: Mapping[str, int], stop: threading.Event, heartbeat: Callable[[], None]
    ) -> list[str]:
        """Wait until the stages have consumed what was sent and what other stages made of it.

        `heartbeat` is called while waiting, to keep the replay alive on the bus. Returns the stages that are behind
        and no longer make progress.
        """
        old = {view.health.header.producer: view.health.header.sequence for view in self._views()}
        seen: object = None
        changed_s = time.monotonic()
        while behind := self._behind(producer, published, old):
            healths = tuple(line for view in self._views() for line in view.health.inputs)
            if healths != seen:
                seen, changed_s = healths, time.monotonic()
            if stop.is_set():
                return []
            if time.monotonic() - changed_s > _STALLED_S:
                return behind
            heartbeat()
            stop.wait(_POLL_S)
        return []

    def lost(self, producer: str, published: Mapping[str, int]) -> dict[str, int]:
        """Messages that each stage has lost since the replay began.

        For a stage that was running at the start, messages sent before its first received one count as lost too.
        """
        now = self._watcher.losses()
        lost = Counter({name: count - self._before.get(name, 0) for name, count in now.items()})
        for view in self._views():
            row = STAGES.get(view.health.stage)
            if view.health.header.producer in self._present_at_start and not (row and row.may_drop):
                for (key, of), state in input_streams(view.health).items():
                    if of == producer and key in published:
                        lost[label(view.health)] += state.first_sequence
        return {name: count for name, count in lost.items() if count > 0}

    def _behind(self, producer: str, published: Mapping[str, int], old: Mapping[str, int]) -> list[str]:
        """The stages without a health message newer than the `old` one that shows that they received all that was
        sent."""
        healths = [view.health for view in self._views()]
        sent = {(key, producer): count for key, count in published.items()}
        for each in healths:
            sent |= output_streams(each)
        return [
            label(each)
            for each in healths
            if each.header.sequence <= old.get(each.header.producer, -1) or _lacks(each, sent)
        ]

    def _views(self) -> list[StageView]:
        return [view for view in self._watcher.stages() if view.alive and view.health.stage in STAGES]


def _lacks(health: Health, sent: Mapping[StreamId, int]) -> bool:
    return any((state.next_sequence or 0) < sent.get(stream, 0) for stream, state in input_streams(health).items())
