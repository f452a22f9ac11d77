"""The current alarm of each fan, from the few messages that it follows from.

A message that comes late is put before what its scorer sent after it. If its number has been heard already, with other
content, one of the two was forged: such a message counts as received, so that a forgery hides no alarm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum

from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.codec import encode
from fantwin.schemas.messages import Alarm
from fantwin.scoring.alarms.current_alarms import CurrentAlarm, current_alarm, needed

MOST_FORMER = 8
"""producers of the messages about a fan that are remembered"""
MOST_STREAMS, MOST_NUMBERS = 4096, 4096
"""producers and trays that are remembered, and how many of the numbers that were heard of each"""


class _Numbers:
    """The numbers of a producer for a tray that were heard last, each with what it stood for."""

    def __init__(self) -> None:
        self._heard: dict[int, int] = {}
        self._newest = -1

    def place(self, alarm: Alarm) -> _Place:
        """Where a message belongs, which is heard then."""
        number, content = alarm.header.sequence, hash(encode(alarm))
        known, self._heard[number] = self._heard.get(number), content
        if len(self._heard) > MOST_NUMBERS:
            del self._heard[next(iter(self._heard))]
        if known == content:
            return _Place.HEARD
        is_late = known is None and number < self._newest
        self._newest = max(self._newest, number)
        return _Place.LATE if is_late else _Place.LAST


class _Place(Enum):
    HEARD = "it has been heard"
    LATE = "before what its scorer sent after it"
    LAST = "after all others"


class AlarmBook:
    """Current alarms by fan. Its memory is bounded by the fans that its owner accepts. Not thread-safe."""

    def __init__(self) -> None:
        self._messages: dict[Fan, Sequence[Alarm]] = {}
        """in the order sent"""
        self._current: dict[Fan, CurrentAlarm] = {}
        self._former: dict[Fan, Sequence[str]] = {}
        """by fan, the last producers before the present one"""
        self._numbers: dict[tuple[str, str], _Numbers] = {}
        """by producer and tray"""

    def add(self, alarm: Alarm) -> CurrentAlarm:
        """Take a message, which may be late; returns the alarm of its fan after it.

        What a former scorer said of a time before its successor's last message comes too late to matter.
        """
        header, fan = alarm.header, Fan(alarm.header.tray, alarm.fan)
        stream = (header.producer, header.tray)
        place = self._numbers.setdefault(stream, _Numbers()).place(alarm)
        if len(self._numbers) > MOST_STREAMS:
            del self._numbers[next(iter(self._numbers))]
        messages = [*self._messages.get(fan, ())]
        if place == _Place.HEARD and messages:
            return self._current[fan]
        if messages and (present := messages[-1].header.producer) != header.producer:
            former = self._former.get(fan, ())
            if header.producer in former and alarm.t_ns <= messages[-1].t_ns:
                return self._current[fan]
            self._former[fan] = (*former, present)[-MOST_FORMER:]
        later = [n for n, each in enumerate(messages) if place == _Place.LATE and _is_after(each, alarm)]
        messages.insert(later[0] if later else len(messages), alarm)
        return self._set(fan, needed(messages))

    def drop(self, is_dropped: Callable[[Alarm], bool]) -> None:
        """Forget the messages to which this applies."""
        for fan, messages in list(self._messages.items()):
            left = [each for each in messages if not is_dropped(each)]
            if not left:
                del self._messages[fan], self._current[fan]
            elif len(left) < len(messages):
                self._set(fan, left)

    def of(self, fan: Fan) -> CurrentAlarm | None:
        """The alarm of a fan; None: it had none."""
        return self._current.get(fan)

    def all(self) -> list[CurrentAlarm]:
        """The alarm of each fan that had one, by tray and fan."""
        return [self._current[fan] for fan in sorted(self._current)]

    def _set(self, fan: Fan, messages: Sequence[Alarm]) -> CurrentAlarm:
        self._messages[fan] = messages
        self._current[fan] = current_alarm(messages)
        return self._current[fan]


def _is_after(known: Alarm, alarm: Alarm) -> bool:
    return known.header.producer == alarm.header.producer and known.header.sequence > alarm.header.sequence
