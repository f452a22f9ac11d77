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
from collections.abc import Callable, Collection, Iterable, Iterator, Set
from dataclasses import dataclass

from fantwin.pipeline.config.shards import Shard
from fantwin.schemas.health import Health
from fantwin.schemas.topics import (
    SESSION_CHUNK,
    health_key,
    session_key,
    stage_label,
    topic_of,
)

LAST_HEALTH_S = 1.0
"""time after a token has disappeared in which the last health of its session may still come"""
APART_S, APART_LIMIT_S = 2.0, 60.0
"""time after a token has disappeared in which a session whose process still runs counts as cut off: earlier, it may be
about to end; later, its process id may be reused"""


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


@dataclass(slots=True)
class _Known:
    """What is known of a session.

    Attributes:
        writes: the keys on which it publishes.
        runs_here: its process was found to run here, and not yet that it was killed. The number of a process in another
            container may not exist here, or may be that of another process.
        left_s: when its token disappeared, monotonic; its messages may still be on the way. None: it is there.
        has_said_last: it has sent its last health.
    """

    session: Session
    writes: set[str]
    runs_here: bool
    left_s: float | None = None
    has_said_last: bool = False


class Sessions:
    """The sessions on the bus, those that have left it last, and which of them owns which trays.

    The token of a session disappears when its process dies, and also when a link is cut. The two can be distinguished
    only for processes on this host: by whether the process still runs.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._host = this_host()
        self._known: dict[str, _Known] = {}
        """by producer"""
        self._owners: dict[str, _Owners] = {}
        """by stage"""

    def update(self, key: str, alive: bool) -> None:
        """A token has appeared, or gone."""
        session = Session.of_key(key)
        if session is None:
            return
        known = self._known.get(session.producer)
        if known and known.session != session:
            if known.left_s is None:
                return  # whoever signs as a session that is there does not take its place
            known = None
        if alive:
            if known is None:
                if len(self._known) >= MOST_SESSIONS and not self._forget_one():
                    return
                own_health = health_key(key.split("/")[1], session.stage, session.instance)
                known = self._known[session.producer] = _Known(session, {own_health}, runs_here=False)
            known.left_s = None
            is_near = session.host == self._host and session.process_id != os.getpid()
            known.runs_here = is_near and session.may_live(self._host)
        elif known:
            known.left_s = self._now_s()
        there = (each.session for each in self._there())
        self._owners[session.stage] = _Owners(each for each in there if each.stage == session.stage)

    def add_health(self, health: Health, read_keys: Set[str]) -> None:
        """A stage has said what it publishes; `read_keys`: the keys that matter here."""
        if known := self._known.get(health.header.producer):
            known.has_said_last |= health.is_last
            outputs = (output.key for output in health.outputs if output.key in read_keys)
            known.writes.update(key for key in outputs if not topic_of(key).is_of_people)

    def is_alive(self, producer: str) -> bool:
        """Whether this producer is a session that is alive."""
        known = self._known.get(producer)
        return known is not None and known.left_s is None

    def has_ended(self, producer: str) -> bool:
        """Whether this producer is a session that has left: ended, or cut off."""
        return producer in self._known and not self.is_alive(producer)

    def may_return(self, producer: str) -> bool:
        """Whether the token of this producer's session has disappeared, but it has not sent its last health, and no
        other session has taken its place: the link may only be cut."""
        known = self._known.get(producer)
        if known is None or known.left_s is None or known.has_said_last:
            return False
        return self.named(known.session.stage, known.session.instance) is None

    def is_stranger(self, key: str, producer: str) -> bool:
        """Whether a session publishes on this key, and this producer neither is nor was one."""
        return producer not in self._known and any(key in each.writes for each in self._there())

    def has_producer(self) -> bool:
        """Whether a session is alive that publishes what is read here."""
        return any(len(each.writes) > 1 for each in self._there())

    def awaits_last_health(self) -> bool:
        """Whether a session has just left whose last health, and so its last messages, may still be on the way."""
        since_s = self._now_s() - LAST_HEALTH_S
        return any(
            each.left_s is not None and each.left_s > since_s and not each.has_said_last
            for each in self._known.values()
        )

    def take_killed(self) -> list[str]:
        """The producers of the sessions that were killed here; each is returned once."""
        gone = [each for each in self._known.values() if each.runs_here and each.left_s is not None]
        killed = [each for each in gone if not each.session.may_live(self._host)]
        for each in killed:
            each.runs_here = False
        return [each.session.producer for each in killed]

    def has_cut_off(self) -> bool:
        """Whether a session still runs here whose token disappeared a while ago."""
        now_s = self._now_s()
        return any(
            each.runs_here
            and APART_S <= now_s - each.left_s < APART_LIMIT_S
            and self.may_return(producer)
            and each.session.may_live(self._host)
            for producer, each in self._known.items()
            if each.left_s is not None
        )

    def successor_of(self, session: Session) -> Session | None:
        """The first session that started later than this one, and has one of its trays in the same stage."""
        later = self._owners[session.stage].after(session) if session.stage in self._owners else ()
        return next((each for each in later if each.shares_a_tray_with(session)), None)

    def named(self, stage: str, instance: str) -> Session | None:
        """The session of this stage and instance, the one that started last; None: there is none."""
        return self._owners[stage].named(instance) if stage in self._owners else None

    def is_replaced(self, producer: str) -> bool:
        """Whether another session of the same stage and instance has started later than this producer's."""
        if not self.is_alive(producer):
            return False
        session = self._known[producer].session
        return self.named(session.stage, session.instance) is not session

    def owner(self, stage: str, tray: str) -> Session | None:
        """The session of a stage that owns a tray; None: there is none."""
        return self._owners[stage].of(tray) if stage in self._owners else None

    def _there(self) -> Iterator[_Known]:
        return (each for each in self._known.values() if each.left_s is None)

    def _forget_one(self) -> bool:
        """Forget the first session that has left; False: all are there."""
        gone = next((producer for producer, each in self._known.items() if each.left_s is not None), None)
        return gone is not None and bool(self._known.pop(gone))


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
