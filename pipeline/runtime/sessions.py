"""Sessions of stages on the bus: which process owns each tray in each stage, and which sessions were killed or cut off.

Each session of a stage shows a liveliness token, which says its trays, from before its first message until it ends,
however it ends. A stage is refused at its start if the token of another process already shows one of its trays. Where
two were started at once, or a network has healed, all see both tokens, and the one that started earlier ends. Until
then the later one is the owner.
"""

from __future__ import annotations

import os
import re
import socket
import time
from collections.abc import Callable, Collection, Iterable, Set
from dataclasses import dataclass, field

from fantwin.pipeline.config.shards import Shard
from fantwin.schemas.health import Health
from fantwin.schemas.topics import (
    SESSION_CHUNK,
    health_key,
    session_key,
    stage_label,
    topic_of,
)

APART_S, APART_LIMIT_S = 2.0, 60.0
"""time after a token has disappeared in which a session whose process still runs counts as cut off: earlier, it may be
about to end; later, its process id may be reused"""


@dataclass
class LostSessions:
    """Finds sessions whose token has disappeared, and whether their process still runs. host: the name of this host, as
    sessions show it.

    The token of a session disappears when its process dies, and also when a link is cut. The two can be distinguished
    only for processes on this host: by whether the process still runs.
    """

    host: str
    now_s: Callable[[], float] = time.monotonic
    _seen: dict[str, Session] = field(default_factory=dict)
    """by token: sessions whose process was once found to run here. The number of a process in another container may not
    exist here, or may be that of another process"""
    _gone: dict[str, tuple[Session, float]] = field(default_factory=dict)
    """by token: those of them whose token has disappeared, and when; the last ones"""

    def update(self, key: str, alive: bool) -> None:
        """A token has appeared or disappeared."""
        if not alive:
            if (session := self._seen.pop(key, None)) is not None:
                self._gone[key] = session, self.now_s()
                if len(self._gone) > MOST_SESSIONS:
                    del self._gone[next(iter(self._gone))]
            return
        self._gone.pop(key, None)
        session = Session.of_key(key)
        if session is None or session.host != self.host or session.process_id == os.getpid():
            return
        if session.may_live(self.host) and len(self._seen) < MOST_SESSIONS:
            self._seen[key] = session

    def take_killed(self) -> list[str]:
        """The producers of the sessions that were killed; each is returned once."""
        killed = {key: each for key, (each, _) in self._gone.items() if not each.may_live(self.host)}
        for key in killed:
            del self._gone[key]
        return [each.producer for each in killed.values()]

    def cut_off(self) -> list[str]:
        """The producers of the sessions that still run, and whose token disappeared a while ago."""
        now_s = self.now_s()
        return [
            each.producer
            for each, since_s in self._gone.values()
            if APART_S <= now_s - since_s < APART_LIMIT_S and each.may_live(self.host)
        ]


MOST_SESSIONS = 4096
_BETWEEN_TRAYS = "+"
"""in a token: no tray has it in its name"""
_TRAYS_SHOWN = 3
"""by name, of those that two sessions have"""


@dataclass(frozen=True)
class Session:
    """A process that runs a stage.

    Attributes:
        started_t_ns: when it began, host time.
        producer: how it signs messages: its stage, its instance, and what is its own, as `scorer-all-0a1b2c3d`.
        trays: those that it has; none: all of the site.
    """

    stage: str
    instance: str
    started_t_ns: int
    producer: str
    host: str
    process_id: int
    trays: tuple[str, ...] = ()

    @classmethod
    def of_this_process(cls, stage: str, shard: Shard, started_t_ns: int, producer: str) -> Session:
        """The session of a stage that runs in this process."""
        trays = () if shard.is_whole else shard.trays
        return cls(stage, shard.name, started_t_ns, producer, this_host(), os.getpid(), trays)

    @classmethod
    def of_key(cls, key: str) -> Session | None:
        """The session that shows the token `key`; None if it is no such token, or names a producer of others.

        Rights depend only on stage and instance. A token without trays stands for all trays of the site.
        """
        parts = key.split("/")
        if len(parts) not in (9, 10) or parts[2] != SESSION_CHUNK:
            return None
        stage, instance, started, producer, host, process_id = parts[3:9]
        if not (_is_number(started) and _is_number(process_id)):
            return None
        if producer.rpartition("-")[0] != f"{stage}-{instance}":
            return None
        named = parts[9].split(_BETWEEN_TRAYS) if len(parts) > 9 else ()
        return cls(stage, instance, int(started), producer, host, int(process_id), tuple(named))

    def key(self, site: str) -> str:
        """The key of its token."""
        parts = (self.started_t_ns, self.producer, self.host, self.process_id)
        own = session_key(site, self.stage, self.instance, *parts)
        return f"{own}/{_BETWEEN_TRAYS.join(self.trays)}" if self.trays else own

    def has(self, tray: str) -> bool:
        """Whether this tray is one of its trays."""
        return not self.trays or tray in self.trays

    def shares_a_tray_with(self, other: Session) -> bool:
        """Whether both have a tray."""
        return not (self.trays and other.trays and set(self.trays).isdisjoint(other.trays))

    @property
    def name(self) -> str:
        """The process, for people: the stage, and its trays where it does not have all."""
        return stage_label(self.stage, self.instance)

    @property
    def process(self) -> str:
        """The process, for people."""
        return f"process {self.process_id} on {self.host}"

    def may_live(self, here: str) -> bool:
        """Whether its process may still run. A token outlives a process whose host was cut off; `here`: this host."""
        if self.host != here:
            return True
        if self.process_id == os.getpid():  # in a container each process has the number of the one before
            return False
        try:
            os.kill(self.process_id, 0)
        except ProcessLookupError:
            return False
        except OSError:
            pass
        return True


def this_host() -> str:
    """The name of this host in tokens of sessions."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", socket.gethostname()) or "unknown"


class Sessions:
    """The sessions on the bus, and which of them owns which trays."""

    def __init__(self) -> None:
        self._alive: dict[str, Session] = {}
        self._by_producer: dict[str, Session] = {}
        """those that are alive"""
        self._owners: dict[str, _Owners] = {}
        """by stage"""
        self._written: dict[str, set[str]] = {}
        """by producer of a session: the keys on which it publishes"""
        self._ended: dict[str, Session] = {}
        """by producer: the last sessions whose token has disappeared; their messages may still be on the way"""
        self._said_last: dict[str, None] = {}
        """producers of sessions that have sent their last health, the last ones"""

    def update(self, key: str, alive: bool) -> None:
        """A token has appeared, or gone."""
        session = Session.of_key(key)
        if session is None or (alive and len(self._alive) >= MOST_SESSIONS):
            return
        if self._by_producer.get(session.producer, session) != session:
            return  # whoever signs as a session that is there does not take its place
        if alive:
            self._alive[key] = self._by_producer[session.producer] = session
            self._written.setdefault(session.producer, {health_key(key.split("/")[1], session.stage, session.instance)})
        else:
            self._alive.pop(key, None)
            self._by_producer.pop(session.producer, None)
            if self._written.pop(session.producer, None) is not None:
                self._ended[session.producer] = session
                if len(self._ended) > MOST_SESSIONS:
                    del self._ended[next(iter(self._ended))]
        self._owners[session.stage] = _Owners(each for each in self._alive.values() if each.stage == session.stage)

    def add_health(self, health: Health, read_keys: Set[str]) -> None:
        """A stage has said what it publishes; `read_keys`: the keys that matter here."""
        producer = health.header.producer
        written = self._written.get(producer)
        if health.is_last and (written is not None or producer in self._ended):
            self._said_last[producer] = None
            if len(self._said_last) > MOST_SESSIONS:
                del self._said_last[next(iter(self._said_last))]
        if written is not None:
            outputs = (output.key for output in health.outputs if output.key in read_keys)
            written.update(key for key in outputs if not topic_of(key).is_of_people)

    def is_alive(self, producer: str) -> bool:
        """Whether this producer is a session that is alive."""
        return producer in self._written

    def may_return(self, producer: str) -> bool:
        """Whether the token of this producer's session has disappeared, but it has not sent its last health, and no
        other session has taken its place: the link may only be cut."""
        session = self._ended.get(producer)
        if session is None or producer in self._said_last:
            return False
        return self.named(session.stage, session.instance) is None

    def has_ended(self, producer: str) -> bool:
        """Whether this producer is a session that has left: ended, or cut off."""
        return producer in self._ended and producer not in self._written

    def is_stranger(self, key: str, producer: str) -> bool:
        """Whether a session publishes on this key, and this producer neither is nor was one."""
        if producer in self._written or producer in self._ended:
            return False
        return any(key in keys for keys in self._written.values())

    def successor_of(self, session: Session) -> Session | None:
        """The first session that started later than this one, and has one of its trays in the same stage."""
        later = self._owners[session.stage].after(session) if session.stage in self._owners else ()
        return next((each for each in later if each.shares_a_tray_with(session)), None)

    def named(self, stage: str, instance: str) -> Session | None:
        """The session of this stage and instance, the one that started last; None: there is none."""
        return self._owners[stage].named(instance) if stage in self._owners else None

    def is_replaced(self, producer: str) -> bool:
        """Whether another session of the same stage and instance has started later than this producer's."""
        session = self._by_producer.get(producer)
        return session is not None and self.named(session.stage, session.instance) is not session

    def owner(self, stage: str, tray: str) -> Session | None:
        """The session of a stage that owns a tray; None: there is none."""
        return self._owners[stage].of(tray) if stage in self._owners else None


class _Owners:
    """Which of the sessions of one stage is the owner of each tray: the one that started last of those that have it."""

    def __init__(self, sessions: Iterable[Session]) -> None:
        self._sessions = sorted(sessions, key=_start)
        self._by_name = {each.instance: each for each in self._sessions}
        self._of_tray: dict[str, Session] = {}
        self._of_others: Session | None = None
        """of all trays that are not named"""
        for each in self._sessions:
            if not each.trays:
                self._of_tray, self._of_others = {}, each
            for tray in each.trays:
                self._of_tray[tray] = each

    def of(self, tray: str) -> Session | None:
        """The owner of a tray."""
        return self._of_tray.get(tray, self._of_others)

    def named(self, instance: str) -> Session | None:
        """The session of this name that started last."""
        return self._by_name.get(instance)

    def after(self, session: Session) -> list[Session]:
        """The sessions that started later."""
        return [each for each in self._sessions if _start(each) > _start(session)]


def _start(session: Session) -> tuple[int, str]:
    return session.started_t_ns, session.producer


def trays_in_words(trays: Collection[str]) -> str:
    """Some trays for people, the first ones by name; none are all."""
    first = list(trays)[:_TRAYS_SHOWN]
    more = f" and {len(trays) - len(first)} more" if len(trays) > len(first) else ""
    return f"tray{'s' * (len(trays) > 1)} {', '.join(first)}{more}" if first else "all trays"


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 20
