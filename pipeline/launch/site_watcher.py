"""Watches a running site from outside: the last health of each session, and the alarms."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass

from pipeline.bus.session import Bus
from pipeline.config.models import NAME_PATTERN
from pipeline.launch.loss_accounting import Launched, label, losses
from pipeline.launch.refused_messages import refused
from pipeline.runtime.sessions import Sessions
from schemas.codec import CodecError, decode
from schemas.messages import Alarm, Health
from schemas.topics import alive_key, health_key, sessions_key, tray_key
from schemas.units import NS_PER_S
from scoring.alarms.current_alarms import CurrentAlarm, current_alarms, in_sequence

MOST_WATCHED_SESSIONS = 1000
"""so many last healths are kept; of more, those heard longest ago are forgotten, those of launched sessions last"""


@dataclass(frozen=True)
class StageView:
    """A stage session as seen from outside."""

    health: Health
    previous: Health | None
    alive: bool
    age_s: float = 0.0
    """since the health was heard here: clocks of other hosts may differ"""

    @property
    def rate_in_hz(self) -> float:
        """Messages received a second between the last two healths."""
        return self._rate(sum(i.received for i in self.health.inputs), lambda h: sum(i.received for i in h.inputs))

    @property
    def rate_out_hz(self) -> float:
        """Messages published a second between the last two healths."""
        return self._rate(sum(o.published for o in self.health.outputs), lambda h: sum(o.published for o in h.outputs))

    def _rate(self, now: int, count: Callable[[Health], int]) -> float:
        if self.previous is None or self.health.t_ns <= self.previous.t_ns:
            return 0.0
        return (now - count(self.previous)) / ((self.health.t_ns - self.previous.t_ns) / NS_PER_S)


class SiteWatcher:
    """Keeps the last health of each session, and the messages about the last alarm of each fan. Thread-safe."""

    def __init__(self, bus: Bus, site: str) -> None:
        self._bus = bus
        self._site = site
        self._lock = threading.Lock()
        self._healths: dict[str, tuple[Health, Health | None, float]] = {}
        """by producer: the last health and the one before, and when the last was heard, of a monotonic clock in s"""
        self._launched: set[Launched] = set()
        self._alive: set[str] = set()
        self._sessions = Sessions()
        self._alarms: dict[tuple[str, int], dict[tuple[str, int], Alarm]] = {}
        """by fan: the messages about its last occurrence, by producer and sequence number"""
        bus.watch_alive(alive_key(site, "*", "*"), self._on_liveness)
        bus.watch_alive(sessions_key(site), self._on_session)
        bus.subscribe(health_key(site, "*", "*"), self._on_health)
        bus.subscribe(tray_key(site, "*", "alarm"), self._on_alarm)

    def ask_for_past_alarms(self) -> None:
        """Fetch the alarms that were raised before this watcher started."""
        key = tray_key(self._site, "*", "alarm")
        for its_key, payload in self._bus.recover(key):
            self._on_alarm(its_key, payload)

    def stages(self) -> list[StageView]:
        """The latest session of every stage instance, by name."""
        with self._lock:
            latest: dict[tuple[str, str], StageView] = {}
            for health, previous, heard_s in self._healths.values():  # as heard: a host's clock may be set back
                if self._sessions.is_ignored(health.header.producer):
                    continue
                alive = alive_key(self._site, health.stage, health.instance) in self._alive
                age_s = time.monotonic() - heard_s
                latest[health.stage, health.instance] = StageView(health, previous, alive, age_s)
            return [latest[name] for name in sorted(latest)]

    def alive(self) -> set[tuple[str, str]]:
        """Stage and instance of each session that is on the bus now."""
        with self._lock:
            return {(stage, instance) for *_, stage, instance in (key.split("/") for key in self._alive)}

    def is_ready(self, process_id: int) -> bool:
        """Whether the session of this process is alive and at work."""
        return any(view.alive and view.health.process_id == process_id for view in self.stages())

    def alarms(self) -> list[Alarm]:
        """The last alarm message of every fan that had one, oldest first."""
        return sorted((current.newest for current in self.current_alarms()), key=lambda alarm: alarm.t_ns)

    def current_alarms(self) -> list[CurrentAlarm]:
        """The current alarm of each fan that had one, by tray and fan."""
        with self._lock:
            return current_alarms(alarm for messages in self._alarms.values() for alarm in messages.values())

    def add_launched(self, session: Launched) -> None:
        """Register a session that this process has started: a flood of others does not displace what it lost."""
        with self._lock:
            self._launched.add(session)

    def last_health(self, session: Launched) -> Health | None:
        """The last health of a session; None if none has been heard."""
        with self._lock:
            found = (health for health, _, _ in self._healths.values() if _session(health) == session)
            return next(found, None)

    def losses(self, launched: Collection[Launched] | None = None) -> dict[str, int]:
        """What every stage has lost, over all its sessions; see `pipeline.launch.loss_accounting`."""
        with self._lock:
            return losses((health for health, _, _ in self._healths.values()), launched)

    def refused(self) -> dict[str, dict[str, int]]:
        """What every stage has refused, over all its sessions; see `pipeline.launch.refused_messages`."""
        with self._lock:
            return refused(health for health, _, _ in self._healths.values())

    def _on_liveness(self, key: str, alive: bool) -> None:
        with self._lock:
            (self._alive.add if alive else self._alive.discard)(key)

    def _on_session(self, key: str, alive: bool) -> None:
        with self._lock:
            self._sessions.update(key, alive)

    def _on_health(self, key: str, payload: bytes) -> None:
        health = _decoded(Health, payload)
        if isinstance(health, Health) and key == health_key(self._site, health.stage, health.instance):
            with self._lock:
                before = self._healths.pop(health.header.producer, None)
                self._healths[health.header.producer] = (health, before[0] if before else None, time.monotonic())
                if len(self._healths) > MOST_WATCHED_SESSIONS:
                    others = (name for name, each in self._healths.items() if _session(each[0]) not in self._launched)
                    del self._healths[next(others, next(iter(self._healths)))]

    def _on_alarm(self, key: str, payload: bytes) -> None:
        """A message without a producer (empty bytes decode as one), or of another tray than its key, is ignored."""
        alarm = _decoded(Alarm, payload)
        if isinstance(alarm, Alarm) and alarm.header.producer and key == _alarm_key(self._site, alarm.header.tray):
            with self._lock:
                if self._sessions.is_ignored(alarm.header.producer):
                    return
                messages = self._alarms.setdefault((alarm.header.tray, alarm.fan), {})
                messages[alarm.header.producer, alarm.header.sequence] = alarm
                newest = in_sequence(messages.values())[-1]
                for name in [name for name, each in messages.items() if each.onset_t_ns != newest.onset_t_ns]:
                    del messages[name]


def _session(health: Health) -> Launched:
    return label(health), health.process_id


def _alarm_key(site: str, tray: str) -> str:
    return tray_key(site, tray, "alarm") if re.fullmatch(NAME_PATTERN, tray) else ""


def _decoded(kind: type[Health] | type[Alarm], payload: bytes) -> object | None:
    """None for undecodable bytes: the stages count those."""
    try:
        return decode(kind, payload)
    except CodecError:
        return None
