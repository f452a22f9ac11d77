"""Watches a running site from outside: the last health of each session, and a model of its fans."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.roles import Role, roles_of_stages
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.config.shards import StageProcess
from fantwin.pipeline.runtime.believed_health import believed_health
from fantwin.pipeline.runtime.sessions import Session
from fantwin.pipeline.site.known_sessions import KnownSessions
from fantwin.pipeline.site.loss_accounting import Launched, label, losses, refused, unusable_lines
from fantwin.pipeline.site.one_line import readable_alarm, readable_health
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.pipeline.site.stage_states import HeardHealth, StageState, StageView, stage_states
from fantwin.schemas.codec import CodecError, decode
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.topics import alive_key, health_key, sessions_key, tray_key
from fantwin.scoring.alarms.current_alarms import CurrentAlarm

MOST_WATCHED_SESSIONS = 1000
"""number of last health messages that are kept; of more, those heard longest ago are forgotten: those of producers that
have shown no token first, those of launched sessions last"""
SAMPLED_S = 0.1
"""time between two scores of a tray that a command looks at: a fast line sends hundreds a second"""


class SiteWatcher:
    """Keeps the last health of each session, and in `model` what is known of the fans. Thread-safe.

    Whoever is no session of the site is not shown and not counted: `pipeline.site.known_sessions`.
    """

    def __init__(
        self,
        bus: Bus,
        site: str,
        roles: Mapping[str, Role] | None = None,
        trays: Sequence[TrayConfig] = (),
        *,
        has_scores: bool = False,
        hear_alarm: Callable[[Alarm], None] = lambda _alarm: None,
    ) -> None:
        """Subscribe.

        Args:
            bus: of the site.
            site: its name.
            roles: those of the site, each with the trays to which it is limited. None: the roles of all stages, not
                limited to trays.
            trays: whose alarms are followed; none: no alarms.
            has_scores: their scores are followed, too.
            hear_alarm: is called with each alarm message of the site.
        """
        self._roles = roles_of_stages() if roles is None else roles
        self._bus = bus
        self._site = site
        self._hear_alarm = hear_alarm
        self._lock = threading.Lock()
        self._sessions = KnownSessions()
        self._healths: dict[str, HeardHealth] = {}
        """by producer, in the order heard, also of those whose token may still be on its way"""
        self.model = SiteModel(site, trays)
        bus.watch_alive(alive_key(site, "*", "*"), self._on_liveness)
        bus.watch_alive(sessions_key(site), self._on_session)
        bus.subscribe(health_key(site, "*", "*"), self._on_health)
        self._alarm_keys = tray_key(site, "*", "alarm")
        if trays:
            bus.subscribe(self._alarm_keys, self._on_alarm)
        for tray in trays if has_scores else ():
            bus.subscribe(tray_key(site, tray.name, "score"), self._on_score)

    def ask_for_past_alarms(self) -> None:
        """Fetch the alarms that were raised before this watcher started: those of several scorers by their time."""
        found = [(key, payload, _decoded(Alarm, payload)) for key, payload in self._bus.recover(self._alarm_keys)]
        known = [(alarm.t_ns, key, payload) for key, payload, alarm in found if isinstance(alarm, Alarm)]
        for _, key, payload in sorted(known):
            self._on_alarm(key, payload)

    def ask_for_health(self, stage: str, instance: str) -> None:
        """Fetch the last health of a stage, instead of waiting for its next one."""
        for key, payload in self._bus.recover(health_key(self._site, stage, instance)):
            self._on_health(key, payload)

    def stages(self) -> list[StageView]:
        """The latest session of every stage instance, by name; one whose token is there, if there is one. A session
        whose link was cut is looked for."""
        with self._lock:
            are_apart = self._sessions.has_cut_off()
        if are_apart:
            self._bus.meet_again()
        with self._lock:
            latest: dict[tuple[str, str], StageView] = {}
            at_work = self._sessions.alive()
            heard = self._believed()  # as heard: a host's clock may be set back
            for each in sorted(heard, key=lambda each: self._sessions.is_alive(each.health.header.producer)):
                if self._sessions.is_replaced(each.health.header.producer):
                    continue
                name = (each.health.stage, each.health.instance)
                latest[name] = each.view(time.monotonic(), alive=name in at_work)
            return [latest[name] for name in sorted(latest)]

    def states(self, expected: Iterable[StageProcess]) -> list[StageState]:
        """The state of each stage that is expected, and of each other that was heard."""
        return stage_states(self.stages(), self.alive(), expected)

    def alive(self) -> set[tuple[str, str]]:
        """Stage and instance of each session that is on the bus now."""
        with self._lock:
            return self._sessions.alive()

    def is_ready(self, process_id: int) -> bool:
        """Whether the session of this process is alive and at work."""
        return any(view.alive and view.health.process_id == process_id for view in self.stages())

    def counts(self, key: str, producer: str) -> bool:
        """Whether a message of this producer on this key is one of the site."""
        with self._lock:
            return not self._sessions.is_stranger(key, producer)

    def owner(self, stage: str, tray: str) -> Session | None:
        """The session of a stage that owns a tray now; None: there is none."""
        with self._lock:
            return self._sessions.owner(stage, tray)

    def current_alarms(self) -> list[CurrentAlarm]:
        """The current alarm of each fan that had one, by tray and fan."""
        with self._lock:
            self.model.drop_alarms(self._is_of_stranger)  # the session that publishes there may have come after it
        return self.model.current_alarms()

    def add_launched(self, session: Launched) -> None:
        """Register a session that this process has started: a flood of others does not displace what it lost."""
        with self._lock:
            self._sessions.add_launched(session)

    def last_health(self, session: Launched) -> Health | None:
        """The last health of a session; None if none has been heard."""
        with self._lock:
            healths = [each.health for each in self._believed()]
        return next((health for health in healths if (label(health), health.process_id) == session), None)

    def losses(
        self, launched: Collection[Launched] | None = None, reads: Mapping[str, Collection[str]] | None = None
    ) -> dict[str, int]:
        """What every stage has lost, over all its sessions; see `pipeline.site.loss_accounting`."""
        with self._lock:
            return losses((each.health for each in self._believed()), launched, reads)

    def refused(self) -> dict[str, dict[str, int]]:
        """What every stage has refused, over all its sessions; see `pipeline.site.loss_accounting`."""
        with self._lock:
            return refused(each.health for each in self._believed())

    def unusable(self, launched: Collection[Launched]) -> list[str]:
        """A line for each device of which no sample could be used by the sessions given."""
        with self._lock:
            return unusable_lines((each.health for each in self._believed()), launched)

    def _believed(self) -> list[HeardHealth]:
        return [each for each in self._healths.values() if self._sessions.is_health_of_stage(each.health)]

    def _is_of_stranger(self, alarm: Alarm) -> bool:
        return self._sessions.is_stranger(tray_key(self._site, alarm.header.tray, "alarm"), alarm.header.producer)

    def _on_liveness(self, key: str, alive: bool) -> None:
        with self._lock:
            self._sessions.update_stage(key, alive)

    def _on_session(self, key: str, alive: bool) -> None:
        with self._lock:
            self._sessions.update(key, alive)

    def _on_health(self, key: str, payload: bytes) -> None:
        health = _decoded(Health, payload)
        if isinstance(health, Health) and key == health_key(self._site, health.stage, health.instance):
            health = believed_health(readable_health(health), self._roles)
            with self._lock:
                self._sessions.add_health(health)
                self._keep(health)

    def _keep(self, health: Health) -> None:
        producer = health.header.producer
        if self._sessions.is_known(producer) and not self._sessions.is_health_of_stage(health):
            return
        before = self._healths.pop(producer, None)
        self._healths[producer] = HeardHealth(health, before.health if before else None, time.monotonic())
        if len(self._healths) > MOST_WATCHED_SESSIONS:
            worth = {of: self._sessions.worth(each.health) for of, each in self._healths.items()}
            del self._healths[min(worth, key=worth.__getitem__)]

    def _on_alarm(self, key: str, payload: bytes) -> None:
        """A message without a producer (empty bytes decode as one), or of another tray than its key, is ignored."""
        alarm = _decoded(Alarm, payload)
        if not isinstance(alarm, Alarm) or not self._is_of_site(key, alarm):
            return
        if self.counts(key, alarm.header.producer):
            alarm = readable_alarm(alarm)
            self.model.add_alarm(alarm)
            self._hear_alarm(alarm)

    def _on_score(self, key: str, payload: bytes) -> None:
        tray = key.split("/")[2]
        if self.model.wants_score(tray, SAMPLED_S):
            score = _decoded(Score, payload)
            if isinstance(score, Score) and self.counts(key, score.header.producer):
                self.model.add_decoded_score(tray, score)

    def _is_of_site(self, key: str, alarm: Alarm) -> bool:
        tray = self.model.tray(alarm.header.tray)
        is_there = tray is not None and 0 <= alarm.fan < tray.fans and bool(alarm.header.producer)
        return is_there and key == tray_key(self._site, alarm.header.tray, "alarm")


def _decoded(kind: type[Health] | type[Alarm] | type[Score], payload: bytes) -> object | None:
    """None for undecodable bytes: the stages count those."""
    try:
        return decode(kind, payload)
    except CodecError:
        return None
