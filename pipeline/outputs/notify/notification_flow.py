"""Decides what is to be sent: transitions of alarms and the time of the host come in, texts for targets come out.

Pure: its user saves what has changed, together with the texts, and gives it back after a restart.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from fantwin.pipeline.outputs.notify.config import NotifierConfig, TargetConfig
from fantwin.pipeline.outputs.notify.deciding import (
    DIGEST_ABOVE,
    Announced,
    Gathered,
    Happened,
    decide,
    hears_of,
    is_due,
    is_quiet,
    next_after,
)
from fantwin.pipeline.outputs.notify.wording import Place, Text, about_fan, about_many
from fantwin.pipeline.site.alarm_book import AlarmBook
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.enums import Severity
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import is_silenced
from fantwin.scoring.alarms.current_alarms import CurrentAlarm

FIRST_LOOK_NS = 10 * NS_PER_S
"""a notifier that has never run hears what happened before: in this time it only learns what the alarms are now"""
TIMES_PERIOD_NS = 5 * NS_PER_S
"""so often it is looked whether time alone brings a message: for 5,000 active alarms that takes 50 ms"""


class Basket(StrEnum):
    """Where events wait for their message."""

    OPEN = "open"
    HELD = "held"
    """for the end of quiet hours"""


@dataclass
class Saved:
    """All that survives a restart, also of fans that are gone. `is_first`: nothing had been saved."""

    is_first: bool = True
    announced: dict[tuple[str, Fan], Announced] = field(default_factory=dict)
    """by target and fan"""
    gathered: dict[tuple[str, Basket], Gathered] = field(default_factory=dict)
    """by target"""


@dataclass(frozen=True)
class Outgoing:
    """A text for a target, and when it was made, by the clock of the host."""

    target: str
    text: Text
    made_ns: int


@dataclass
class Changes:
    """Changes to save: the keys of what has changed in `Saved`, and the texts that were decided on."""

    announced: set[tuple[str, Fan]] = field(default_factory=set)
    gathered: set[tuple[str, Basket]] = field(default_factory=set)
    outgoing: list[Outgoing] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.announced or self.gathered or self.outgoing)


class Notifications:
    """Decides, transition by transition, what targets hear. Not thread-safe."""

    def __init__(self, config: NotifierConfig, place: Place, saved: Saved, past: Iterable[Alarm] = ()) -> None:
        """past: transitions already decided on, from which the present alarms follow."""
        self._config = config
        self._place = place
        self._targets = [target for target in config.target if target.kind == "apprise"]
        self.saved = saved
        self.changes = Changes()
        """since they were saved last; whoever saves them replaces this"""
        self._first_look_ends_ns: int | None = None
        self._is_looking = saved.is_first
        self._times_ns: int | None = None
        self._book = AlarmBook()
        self._open: set[Fan] = set()
        """fans whose alarm is active: time alone may bring a message about them"""
        for alarm in past:
            self._keep(alarm)

    @property
    def is_looking(self) -> bool:
        """Whether it still learns what the alarms are: nothing of that is to be saved yet."""
        return self._is_looking

    def add(self, message: Alarm, now_ns: int) -> None:
        """Take a transition. now_ns: time of the host."""
        newest = self._keep(message)
        if not self._is_looking:
            self._decide(newest, now_ns)

    def tick(self, now_ns: int) -> None:
        """Time has passed."""
        if self._is_looking:
            self._look(now_ns)
            return
        if self._times_ns is None or abs(now_ns - self._times_ns) >= TIMES_PERIOD_NS:
            self._times_ns = now_ns
            self._decide_open(now_ns)
        for target in self._targets:
            self._send_due(target, now_ns)

    def firing(self, target: TargetConfig) -> list[CurrentAlarm]:
        """The alarms that Alertmanager is to have now: active, and not silenced by an operator."""
        alarms = map(self._current, sorted(self._open))
        return [each for each in alarms if not is_silenced(each.newest) and hears_of(target, each.newest)]

    def waiting(self) -> Mapping[tuple[str, Basket], int]:
        """How many fans each target will hear of, by where they wait."""
        return {key: len(each.fans) for key, each in self.saved.gathered.items() if each.fans}

    def _look(self, now_ns: int) -> None:
        """Until the first look ends; then what is presented now is what is to be said first."""
        ends_ns = self._first_look_ends_ns
        if ends_ns is None or ends_ns - now_ns > FIRST_LOOK_NS:  # the clock was set back
            self._first_look_ends_ns = ends_ns = now_ns + FIRST_LOOK_NS
        if now_ns < ends_ns:
            return
        self._is_looking = False
        self._decide_open(now_ns)

    def _keep(self, message: Alarm) -> Alarm:
        """Take a message; returns the newest one about its fan."""
        newest = self._book.add(message).newest
        fan = Fan(newest.header.tray, newest.fan)
        if newest.active:
            self._open.add(fan)
        else:
            self._open.discard(fan)
        return newest

    def _current(self, fan: Fan) -> CurrentAlarm:
        current = self._book.of(fan)
        assert current is not None
        return current

    def _decide_open(self, now_ns: int) -> None:
        for fan in sorted(self._open):
            self._decide(self._current(fan).newest, now_ns)

    def _decide(self, alarm: Alarm, now_ns: int) -> None:
        fan = Fan(alarm.header.tray, alarm.fan)
        for target in self._targets:
            key = (target.name, fan)
            before = self.saved.announced.get(key)
            happened, now = decide(target, alarm, before, now_ns)
            if now is not None and now != before:
                self.saved.announced[key] = now
                self.changes.announced.add(key)
            if happened is not None:
                self._gather(target, fan, happened, int(alarm.severity), now_ns)

    def _gather(self, target: TargetConfig, fan: Fan, happened: Happened, severity: int, now_ns: int) -> None:
        basket = Basket.OPEN
        if severity < Severity.ALARM and is_quiet(target, now_ns):
            basket = Basket.HELD
        elif (before := self._gathered(target, Basket.HELD).fans.pop(fan, None)) is not None:
            # worse than what is held: all of it goes at once
            happened = before.then(happened)
            self.changes.gathered.add((target.name, Basket.HELD))
        self._gathered(target, basket).add(fan, happened, now_ns)
        self.changes.gathered.add((target.name, basket))

    def _send_due(self, target: TargetConfig, now_ns: int) -> None:
        gathered = self._gathered(target, Basket.OPEN)
        if is_due(gathered, now_ns):
            self._set(target, Basket.OPEN, next_after(gathered, now_ns))
            for text in self._texts(gathered, now_ns):
                self.changes.outgoing.append(Outgoing(target.name, text, now_ns))
        held = self._gathered(target, Basket.HELD)
        if held.fans and not is_quiet(target, now_ns):
            self._set(target, Basket.HELD, Gathered())
            self._count_from(target, held, now_ns)
            if fans := self._presented(held):
                text = about_many(self._place, fans, now_ns, were_held=True)
                self.changes.outgoing.append(Outgoing(target.name, text, now_ns))

    def _count_from(self, target: TargetConfig, held: Gathered, now_ns: int) -> None:
        """The target hears of these fans only now: from now on counts when it hears of them again."""
        for fan in held.fans:
            key = (target.name, fan)
            self.saved.announced[key] = replace(self.saved.announced[key], last_ns=now_ns)
            self.changes.announced.add(key)

    def _texts(self, gathered: Gathered, now_ns: int) -> Iterator[Text]:
        fans = self._presented(gathered)
        if len(fans) > DIGEST_ABOVE:
            yield about_many(self._place, fans, now_ns)
            return
        for alarm, happened in fans:
            yield about_fan(self._place, alarm, happened, now_ns)

    def _presented(self, gathered: Gathered) -> list[tuple[CurrentAlarm, Happened]]:
        """Without the fans that operators have silenced while their message waited."""
        known = ((self._book.of(fan), happened) for fan, happened in gathered.fans.items())
        return [(each, happened) for each, happened in known if each is not None and not is_silenced(each.newest)]

    def _gathered(self, target: TargetConfig, basket: Basket) -> Gathered:
        return self.saved.gathered.setdefault((target.name, basket), Gathered())

    def _set(self, target: TargetConfig, basket: Basket, gathered: Gathered) -> None:
        self.saved.gathered[target.name, basket] = gathered
        self.changes.gathered.add((target.name, basket))
