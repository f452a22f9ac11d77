"""Watches a running site from outside: the last health of every session, and the alarms."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from pipeline.bus.session import Bus
from pipeline.launch.loss_accounting import losses
from schemas.codec import CodecError, decode
from schemas.messages import Alarm, Health
from schemas.topics import alive_key, health_key, tray_key
from scoring.alarms.current_alarms import CurrentAlarm, current_alarms, in_sequence


@dataclass(frozen=True)
class StageView:
    """A stage session as seen from outside."""

    health: Health
    previous: Health | None
    alive: bool

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
        return (now - count(self.previous)) / ((self.health.t_ns - self.previous.t_ns) / 1e9)


class Watcher:
    """Keeps the last health of every session, and what was said of the last alarm of every fan. Safe to read from any
    thread.
    """

    def __init__(self, bus: Bus, site: str) -> None:
        self._bus = bus
        self._site = site
        self._lock = threading.Lock()
        self._healths: dict[str, tuple[Health, Health | None]] = {}
        self._alive: set[str] = set()
        self._alarms: dict[tuple[str, int], dict[tuple[str, int], Alarm]] = {}
        """of each fan the messages about its last occurrence, by who sent them"""
        bus.watch_alive(alive_key(site, "*", "*"), self._note_alive)
        bus.subscribe(health_key(site, "*", "*"), self._note_health)
        bus.subscribe(tray_key(site, "*", "alarm"), self._note_alarm)

    def ask_for_past_alarms(self) -> None:
        """Fetch the alarms that were raised before this watcher came."""
        key = tray_key(self._site, "*", "alarm")
        for _, payload in self._bus.recover(key, "*", 0, 2**63, lambda: time.sleep(0.005)):
            self._note_alarm("", payload)

    def stages(self) -> list[StageView]:
        """The latest session of every stage instance, by name."""
        with self._lock:
            latest: dict[tuple[str, str], StageView] = {}
            for health, previous in sorted(self._healths.values(), key=lambda pair: pair[0].t_ns):
                alive = alive_key(self._site, health.stage, health.instance) in self._alive
                latest[health.stage, health.instance] = StageView(health, previous, alive)
            return [latest[name] for name in sorted(latest)]

    def is_ready(self, process_id: int) -> bool:
        """Whether the session of this process is there and has begun its work."""
        return any(view.alive and view.health.process_id == process_id for view in self.stages())

    def alarms(self) -> list[Alarm]:
        """The last alarm message of every fan that had one, oldest first."""
        return sorted((standing.newest for standing in self.standing()), key=lambda alarm: alarm.t_ns)

    def standing(self) -> list[CurrentAlarm]:
        """How the alarm of every fan that had one stands, by tray and fan."""
        with self._lock:
            return current_alarms(alarm for told in self._alarms.values() for alarm in told.values())

    def losses(self) -> dict[str, int]:
        """What every stage has lost, over all its sessions; see `pipeline.launch.loss_accounting`."""
        with self._lock:
            return losses(health for health, _ in self._healths.values())

    def _note_alive(self, key: str, alive: bool) -> None:
        with self._lock:
            (self._alive.add if alive else self._alive.discard)(key)

    def _note_health(self, _key: str, payload: bytes) -> None:
        health = _decoded(Health, payload)
        if isinstance(health, Health):
            with self._lock:
                before = self._healths.get(health.header.producer)
                self._healths[health.header.producer] = (health, before[0] if before else None)

    def _note_alarm(self, _key: str, payload: bytes) -> None:
        alarm = _decoded(Alarm, payload)
        if isinstance(alarm, Alarm):
            with self._lock:
                told = self._alarms.setdefault((alarm.header.tray, alarm.fan), {})
                told[alarm.header.producer, alarm.header.sequence] = alarm
                newest = in_sequence(told.values())[-1]
                for name in [name for name, each in told.items() if each.onset_t_ns != newest.onset_t_ns]:
                    del told[name]


def _decoded(kind: type[Health] | type[Alarm], payload: bytes) -> object | None:
    """A watcher judges nobody: what it cannot read, the stages count."""
    try:
        return decode(kind, payload)
    except CodecError:
        return None
