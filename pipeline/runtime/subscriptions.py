"""Which keys a stage reads message by message: all that it reads, unless its core follows some trays only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Set

from fantwin.pipeline.bus.session import Bus
from fantwin.schemas.topics import tray_key


class Subscriptions:
    """The keys of a stage, health apart, and its subscriptions to them."""

    def __init__(
        self,
        bus: Bus,
        site: str,
        reads: Iterable[str],
        undecoded: Iterable[str],
        trays: Iterable[str],
        on_message: Callable[[str, bytes], None],
        on_end: Callable[[str], None],
    ) -> None:
        """reads: the topics of the stage. undecoded: of these, those that may be read of some trays only. on_message is
        called with key and payload, from a thread of the bus; on_end with each key that is not read message by message
        any more."""
        self._bus = bus
        self._on_message = on_message
        self._on_end = on_end
        of_topic = {
            topic: {tray: tray_key(site, tray, topic) for tray in trays} for topic in reads if topic != "health"
        }
        self.keys = {key for keys in of_topic.values() for key in keys.values()}
        """all that the stage reads"""
        self._undecoded = [of_topic[topic] for topic in undecoded]
        self._ends: dict[str, Callable[[], None]] = {}
        self._followed: Set[str] | None = None
        self._others: set[str] = set()

    @property
    def current(self) -> Set[str]:
        """The keys that are read message by message now."""
        return self._ends.keys()

    def follow(self, trays: Set[str] | None) -> Set[str]:
        """Read the stage's `undecoded` topics of these trays message by message, None: of all, and return the keys of
        the others. All other topics are read so in any case."""
        if self._ends and trays == self._followed:
            return self._others
        self._followed, self._others = None if trays is None else frozenset(trays), set()
        if trays is not None:
            self._others = {key for keys in self._undecoded for tray, key in keys.items() if tray not in trays}
        for key in sorted(self._others & self._ends.keys()):
            self._ends.pop(key)()
            self._on_end(key)
        for key in sorted(self.keys - self._others - self._ends.keys()):
            self._ends[key] = self._bus.subscribe(key, self._on_message)
        return self._others
