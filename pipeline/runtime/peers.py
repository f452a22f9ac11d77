"""The other stages on the bus, as one stage sees them: who is alive, who has left, and what each reported last."""

from __future__ import annotations

import time
from collections.abc import Set

from pipeline.runtime.inbox import Liveness
from schemas.messages import Health, StageStatus

LAST_HEALTH_TIMEOUT_S = 1.0
"""how long a stopping stage waits for the last health of a producer that has just left"""


class Peers:
    """Liveness and last health of each session, by its liveliness key."""

    def __init__(self, read_keys: Set[str]) -> None:
        """read_keys: the keys that this stage reads."""
        self._read_keys = read_keys
        self._alive: set[str] = set()
        self._left_s: dict[str, float] = {}
        self._last_health: dict[str, Health] = {}

    def update(self, change: Liveness) -> None:
        """A session has appeared or left."""
        if change.alive:
            self._alive.add(change.key)
            self._left_s.pop(change.key, None)
        else:
            self._alive.discard(change.key)
            self._left_s[change.key] = time.monotonic()

    def add_health(self, key: str, health: Health) -> None:
        """The session with the liveliness key `key` has published a health."""
        self._last_health[key] = health

    def has_producer(self) -> bool:
        """Whether a stage that writes what this one reads is alive."""
        return any(self._is_producer(key) for key in self._alive)

    def awaits_last_health(self) -> bool:
        """Whether a session has just left whose last health, and so its last messages, may still be on the way."""
        now = time.monotonic()
        return any(
            now - left_s < LAST_HEALTH_TIMEOUT_S and self._last_health[key].status != StageStatus.STOPPED
            for key, left_s in self._left_s.items()
            if key in self._last_health
        )

    def _is_producer(self, key: str) -> bool:
        health = self._last_health.get(key)
        return health is not None and any(output.key in self._read_keys for output in health.outputs)
