"""One owner of each stage: which process runs it, and whose messages count where two do.

Each stage session shows a liveliness token from before its first message until it ends, however it ends. A stage whose
token another process already shows is refused at its start. Where two were started at once, or a network has healed,
all see both tokens: the session that started later owns the stage, and what the other publishes is ignored until one of
them ends. Ownership depends only on the tokens that exist now, so a clock that was once wrong has no effect later.
"""

from __future__ import annotations

import os
import re
import socket
import threading
import time
from collections.abc import Set
from dataclasses import dataclass

from pipeline.bus.session import Bus
from pipeline.config.registry import STAGES
from pipeline.runtime.clock import REPLAY
from pipeline.runtime.stage import StageError
from schemas.messages import Health
from schemas.topics import SESSION_CHUNK, alive_key, health_key, sessions_key

GOSSIP_S = 0.2
"""how long a starting stage waits for further processes after it has met the first: they took 6 ms"""
LEAVING_LIMIT_S = 2.0
"""how long it waits for a predecessor that is about to leave"""
MOST_SESSIONS = 4096
_POLL_S = 0.02


@dataclass(frozen=True)
class Session:
    """A process that runs a stage. `started_t_ns`: when it began, host time; `producer`: how it signs messages."""

    stage: str
    instance: str
    started_t_ns: int
    producer: str
    host: str
    process_id: int

    @classmethod
    def of_this_process(cls, stage: str, instance: str, started_t_ns: int, producer: str) -> Session:
        """The session of a stage that runs in this process."""
        host = re.sub(r"[^A-Za-z0-9_.-]", "_", socket.gethostname()) or "unknown"
        return cls(stage, instance, started_t_ns, producer, host, os.getpid())

    @classmethod
    def of_key(cls, key: str) -> Session | None:
        """The session that shows the token `key`; None if it is no such token."""
        parts = key.split("/")
        if len(parts) != 9 or parts[2] != SESSION_CHUNK:
            return None
        stage, instance, started, producer, host, process_id = parts[3:]
        if not (_is_number(started) and _is_number(process_id)):
            return None
        return cls(stage, instance, int(started), producer, host, int(process_id))

    def key(self, site: str) -> str:
        """The key of its token."""
        prefix = sessions_key(site, self.stage, self.instance).removesuffix("/**")
        return f"{prefix}/{self.started_t_ns}/{self.producer}/{self.host}/{self.process_id}"

    @property
    def name(self) -> str:
        """The stage and its tray, for people."""
        return self.stage if self.instance == "all" else f"{self.stage}/{self.instance}"

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


class Sessions:
    """The sessions on the bus, and which of them are ignored."""

    def __init__(self) -> None:
        self._alive: dict[str, Session] = {}
        self._ignored: dict[str, tuple[Session, Session]] = {}
        """by producer: the session that is ignored, and the one that owns its stage"""
        self._written: dict[str, set[str]] = {}
        """by producer of a session: the keys on which it publishes"""
        self._ended: dict[str, None] = {}
        """producers of sessions that have ended, the last ones: their messages may still be on the way"""

    def update(self, key: str, alive: bool) -> None:
        """A token has appeared, or gone."""
        session = Session.of_key(key)
        if session is None or (alive and len(self._alive) >= MOST_SESSIONS):
            return
        if alive:
            self._alive[key] = session
            self._written.setdefault(session.producer, {health_key(key.split("/")[1], session.stage, session.instance)})
        else:
            self._alive.pop(key, None)
            if self._written.pop(session.producer, None) is not None:
                self._ended[session.producer] = None
                if len(self._ended) > MOST_SESSIONS:
                    del self._ended[next(iter(self._ended))]
        owners: dict[tuple[str, str], Session] = {}
        for each in sorted(self._alive.values(), key=lambda each: (each.started_t_ns, each.producer)):
            owners[each.stage, each.instance] = each
        found = ((each, owners[each.stage, each.instance]) for each in self._alive.values())
        self._ignored = {each.producer: (each, owner) for each, owner in found if each is not owner}

    def add_health(self, health: Health, read_keys: Set[str]) -> None:
        """A stage has said what it publishes; `read_keys`: the keys that matter here."""
        written = self._written.get(health.header.producer)
        if written is not None:
            written.update(output.key for output in health.outputs if output.key in read_keys)

    def is_alive(self, producer: str) -> bool:
        """Whether this producer is a session that is alive."""
        return producer in self._written

    def is_stranger(self, key: str, producer: str) -> bool:
        """Whether a session publishes on this key, and this producer neither is nor was one."""
        if producer in self._written or producer in self._ended:
            return False
        return any(key in keys for keys in self._written.values())

    def is_ignored(self, producer: str) -> bool:
        """Whether another process owns the stage of this producer."""
        return producer in self._ignored

    def problem(self) -> str:
        """The stages that run twice; empty if none does."""
        return "; ".join(
            f"{ignored.name} runs twice: {ignored.process} is ignored, because {owner.process} started later; "
            "stop one of them"
            for ignored, owner in self._ignored.values()
        )


def refuse_second(bus: Bus, site: str, session: Session, stop: threading.Event) -> None:
    """Return if no other process runs this stage, and no replay presents the site to a stage with a device; wait a
    moment for one that is about to leave.

    Raises:
        StageError: one does.
        BusError: a program that is not fantwin listens at the endpoint.
    """
    replay = alive_key(site, REPLAY, "all") if STAGES[session.stage].scope == "tray" else ""
    bus.wait_for_others(stop)
    met_s = time.monotonic()
    while True:
        others, is_replayed = _others(bus, site, session), bool(replay and bus.alive(replay))
        limit_s = LEAVING_LIMIT_S if others or is_replayed else GOSSIP_S
        if time.monotonic() - met_s >= limit_s or not bus.came_second or stop.wait(_POLL_S):
            break
    if is_replayed:
        raise StageError(
            f"a replay presents site {site!r}: stop it, or give {session.name} another site or bus.endpoint"
        )
    if others:
        raise StageError(
            f"{session.name} of site {site!r} already runs: {others[0].process}; stop that, or give this one another "
            "site, tray or bus.endpoint"
        )


def _others(bus: Bus, site: str, session: Session) -> list[Session]:
    found = (Session.of_key(key) for key in bus.alive(sessions_key(site, session.stage, session.instance)))
    return [each for each in found if each is not None and each != session and each.may_live(session.host)]


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 20
