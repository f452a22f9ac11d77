"""Whose messages count, as a program sees it that watches a site from outside: those of the stages' sessions.

A session shows its token before its first message, and stays known after it has ended: its last messages may come after
its token has gone. Not thread-safe.
"""

from __future__ import annotations

from fantwin.pipeline.runtime.sessions import MOST_SESSIONS, Session, Sessions
from fantwin.pipeline.site.loss_accounting import Launched
from fantwin.schemas.health import Health
from fantwin.schemas.topics import topic_of

_WATCHED_TOPICS = {"alarm", "score", "snapshot"}


class KnownSessions:
    """The sessions that have shown a token, and which producers are strangers to them."""

    def __init__(self) -> None:
        self._sessions = Sessions()
        self._known: dict[str, Session] = {}
        """by producer, in the order in which they were seen"""
        self._stages: set[tuple[str, str]] = set()
        """stage and instance of all known sessions"""
        self._alive: set[tuple[str, str]] = set()
        self._seen: dict[tuple[str, str], None] = {}
        """stage and instance of what is or was on the bus, also of a program whose sessions show no token of their own,
        such as a replay"""
        self._launched: set[Launched] = set()

    def update(self, key: str, alive: bool) -> None:
        """The token of a session has appeared, or gone."""
        session = Session.of_key(key)
        if session is None:
            return
        self._sessions.update(key, alive)
        self._known.setdefault(session.producer, session)
        self._stages.add((session.stage, session.instance))
        if len(self._known) > MOST_SESSIONS:
            del self._known[next(filter(self._may_be_forgotten, self._known), next(iter(self._known)))]
            self._stages = {(each.stage, each.instance) for each in self._known.values()}

    def update_stage(self, key: str, alive: bool) -> None:
        """The token that says that a stage is at work has appeared, or gone."""
        *_, stage, instance = key.split("/")
        if not alive:
            self._alive.discard((stage, instance))
        elif len(self._alive) < MOST_SESSIONS:
            self._alive.add((stage, instance))
            self._seen[stage, instance] = None
            if len(self._seen) > MOST_SESSIONS:
                del self._seen[next(name for name in self._seen if name not in self._alive)]

    def add_launched(self, session: Launched) -> None:
        """A session that this process has started: of the known ones it is forgotten last."""
        self._launched.add(session)

    def add_health(self, health: Health) -> None:
        """A session has said what it publishes."""
        self._sessions.add_health(health, {output.key for output in health.outputs if _is_watched(output.key)})

    def alive(self) -> set[tuple[str, str]]:
        """Stage and instance of all stages that are at work."""
        return set(self._alive)

    def is_alive(self, producer: str) -> bool:
        """Whether the token of this session is there now."""
        return self._sessions.is_alive(producer)

    def may_return(self, producer: str) -> bool:
        """Whether the token of this session has gone, but nothing says that it has ended."""
        return self._sessions.may_return(producer)

    def has_cut_off(self) -> bool:
        """Whether a session still runs on this host whose token disappeared a while ago."""
        return self._sessions.has_cut_off()

    def is_known(self, producer: str) -> bool:
        """Whether this session has shown its token."""
        return producer in self._known

    def worth(self, health: Health) -> int:
        """How long the health of a session is to be remembered: 0 without a token, 2 if this process started it."""
        session = self._known.get(health.header.producer)
        return 0 if session is None else 1 + ((session.name, session.process_id) in self._launched)

    def is_replaced(self, producer: str) -> bool:
        """Whether another session of the same stage and instance started later."""
        return self._sessions.is_replaced(producer)

    def owner(self, stage: str, tray: str) -> Session | None:
        """The session of a stage that owns a tray now; None: there is none."""
        return self._sessions.owner(stage, tray)

    def is_stranger(self, key: str, producer: str) -> bool:
        """Whether a session publishes on this key, and this producer is none and never was."""
        return self._sessions.is_stranger(key, producer)

    def is_health_of_stage(self, health: Health) -> bool:
        """Whether a health message is that of a session of its stage. Where no session has shown a token, it may come
        from whatever is on the bus under the name of the stage."""
        name = (health.stage, health.instance)
        session = self._known.get(health.header.producer)
        if session is not None:
            return name == (session.stage, session.instance)
        return name in self._seen and name not in self._stages

    def _may_be_forgotten(self, producer: str) -> bool:
        session = self._known[producer]
        return not self.is_alive(producer) and (session.name, session.process_id) not in self._launched


def _is_watched(key: str) -> bool:
    try:
        return topic_of(key).name in _WATCHED_TOPICS
    except KeyError:
        return False
