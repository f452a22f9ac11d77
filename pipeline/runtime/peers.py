"""The other stages on the bus, as one stage sees them: who is alive, who has left, and what each reported last."""

from __future__ import annotations

import time
from collections.abc import Set
from dataclasses import dataclass
from typing import TypeVar

from fantwin.pipeline.runtime.inbox import Liveness
from fantwin.schemas.health import Health

MOST_PEERS = 4096
"""so many sessions are remembered: those heard most recently"""
LAST_HEALTH_TIMEOUT_S = 1.0
"""how long a stopping stage waits for the last health of a producer that has just left"""

Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class _Reported:
    """What matters here of the last health of a session."""

    is_producer: bool
    has_ended: bool


class Peers:
    """Liveness and last health of each session, by its liveliness key."""

    def __init__(self, read_keys: Set[str]) -> None:
        """read_keys: the keys that this stage reads."""
        self._read_keys = read_keys
        self._alive: dict[str, None] = {}
        self._left_s: dict[str, float] = {}
        self._reported: dict[str, _Reported] = {}

    def update(self, change: Liveness) -> None:
        """A session has appeared or left."""
        if change.alive:
            self._left_s.pop(change.key, None)
            _remember(self._alive, change.key, None)
        else:
            self._alive.pop(change.key, None)
            _remember(self._left_s, change.key, time.monotonic())

    def add_health(self, key: str, health: Health) -> None:
        """The session with the liveliness key `key` has published a health message."""
        is_producer = any(output.key in self._read_keys for output in health.outputs)
        _remember(self._reported, key, _Reported(is_producer, health.is_last))

    def has_producer(self) -> bool:
        """Whether a stage that writes what this one reads is alive."""
        return any(key in self._alive for key, reported in self._reported.items() if reported.is_producer)

    def awaits_last_health(self) -> bool:
        """Whether a session has just left whose last health, and so its last messages, may still be on the way."""
        now = time.monotonic()
        return any(
            now - left_s < LAST_HEALTH_TIMEOUT_S and not self._reported[key].has_ended
            for key, left_s in self._left_s.items()
            if key in self._reported
        )


def _remember(by_key: dict[str, Value], key: str, value: Value) -> None:
    """Put a value last, and forget the first beyond MOST_PEERS."""
    by_key.pop(key, None)
    by_key[key] = value
    if len(by_key) > MOST_PEERS:
        del by_key[next(iter(by_key))]
