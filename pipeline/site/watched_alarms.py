"""The current alarm of each fan of a site, in bounded memory: of what was published about a fan, only what is shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.current_alarms import CurrentAlarm, current_alarms, in_sequence, needed

MOST_WATCHED_FANS = 4096
"""whose last alarm is kept. Of more, and beyond WATCHED_BYTES, those of producers that are no stage are forgotten
first, then those heard longest ago"""
WATCHED_BYTES = 16 << 20
"""of the messages kept, encoded"""

_Name = tuple[str, int]


@dataclass
class _Fan:
    """The messages about the last alarm of a fan, in sequence, and what follows from them."""

    messages: list[Alarm]
    current: CurrentAlarm
    sizes: dict[_Name, int] = field(default_factory=dict)

    @property
    def size(self) -> int:
        return sum(self.sizes.values())


class WatchedAlarms:
    """Not thread-safe."""

    def __init__(self, is_known: Callable[[str], bool], most_fans: int = MOST_WATCHED_FANS) -> None:
        """is_known: whether a producer is a stage."""
        self._is_known = is_known
        self._most_fans = most_fans
        self._fans: dict[tuple[str, int], _Fan] = {}
        """by tray and fan; those heard last come last"""
        self._bytes = 0

    def add(self, alarm: Alarm, size: int) -> None:
        """A message has arrived. size: of the encoded message, bytes."""
        fan = (alarm.header.tray, alarm.fan)
        before = self._fans.get(fan)
        messages = [each for each in before.messages if _name(each) != _name(alarm)] if before else []
        sizes = (before.sizes if before else {}) | {_name(alarm): size}
        self._put(fan, needed(in_sequence([*messages, alarm])), sizes)
        while len(self._fans) > self._most_fans or self._bytes > WATCHED_BYTES:
            strangers = (of for of, each in self._fans.items() if not self._is_known(_producer(each)))
            self._put(next(strangers, next(iter(self._fans))), [], {})

    def drop(self, is_dropped: Callable[[Alarm], bool]) -> None:
        """Forget the messages to which this applies."""
        for fan, each in list(self._fans.items()):
            left = [message for message in each.messages if not is_dropped(message)]
            if len(left) < len(each.messages):
                self._put(fan, left, each.sizes)

    def current(self) -> list[CurrentAlarm]:
        """The current alarm of each fan that had one, by tray and fan."""
        return [self._fans[fan].current for fan in sorted(self._fans)]

    def of(self, tray: str, fan: int) -> CurrentAlarm | None:
        """The current alarm of a fan; None: it had none."""
        found = self._fans.get((tray, fan))
        return found.current if found else None

    def _put(self, fan: tuple[str, int], messages: list[Alarm], sizes: dict[_Name, int]) -> None:
        before = self._fans.pop(fan, None)
        self._bytes -= before.size if before else 0
        if messages:
            (current,) = current_alarms(messages)
            self._fans[fan] = _Fan(messages, current, {_name(each): sizes[_name(each)] for each in messages})
            self._bytes += self._fans[fan].size


def _name(alarm: Alarm) -> _Name:
    return alarm.header.producer, alarm.header.sequence


def _producer(fan: _Fan) -> str:
    return fan.current.newest.header.producer
