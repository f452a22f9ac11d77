"""A bus of one process, the sessions that are seen on it, and their health."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from fantwin.pipeline.runtime.sessions import Session
from fantwin.schemas.codec import encode
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm
from fantwin.schemas.topics import alive_key, health_key, sessions_key, tray_key
from tests.support import made_messages

KEY = tray_key("s", "tray", "alarm")
STRANGER = "nobody"


class StubBus:
    """A bus of one process: the test publishes on it."""

    def __init__(self) -> None:
        self.subscribers: dict[str, Callable[[str, bytes], None]] = {}
        self.watched: dict[str, Callable[[str, bool], None]] = {}
        self.kept: list[tuple[str, bytes]] = []

    def subscribe(self, key: str, on_message: Callable[[str, bytes], None], _is_wanted: object = None) -> None:
        self.subscribers[key] = on_message

    def watch_alive(self, key: str, on_change: Callable[[str, bool], None]) -> None:
        self.watched[key] = on_change

    def recover(self, *_args: Any) -> Iterator[tuple[str, bytes]]:
        yield from self.kept

    def say(self, message: Health) -> None:
        key = health_key("s", message.stage, message.instance)
        self.subscribers[health_key("s", "*", "*")](key, encode(message))

    def raise_alarm(self, message: Alarm) -> None:
        self.subscribers[tray_key("s", "*", "alarm")](KEY, encode(message))

    def show(self, session: Session, *, alive: bool = True) -> None:
        """Show the tokens of a session, or let them go."""
        self.watched[sessions_key("s")](session.key("s"), alive)
        self.watched[alive_key("s", "*", "*")](alive_key("s", session.stage, session.instance), alive)


def session(stage: str, number: int) -> Session:
    return Session(stage, "all", number, f"{stage}-all-{number}", "host", number)


def health(of: Session, t_ns: int = 1, **more: Any) -> Health:
    return made_messages.health(of.stage, of.instance, of.producer, t_ns=t_ns, process_id=of.process_id, **more)


def of(producer: str, sequence: int = 0, **more: Any) -> Alarm:
    return replace(made_messages.alarm(0, tray="tray"), header=Header(producer, sequence, "tray"), **more)


SCORER = session("scorer", 1)
