"""Decides what is to be sent: transitions of alarms and the time of the host come in, texts for targets come out.

Pure: its user saves what has changed, together with the texts, and gives it back after a restart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from fantwin.pipeline.outputs.notify.config import NotifierConfig, TargetConfig
from fantwin.pipeline.outputs.notify.deciding import Announced, Event, decide, hears_of
from fantwin.pipeline.outputs.notify.fan_alarm import FanAlarm, FanName, fan_alarm
from fantwin.pipeline.outputs.notify.gathering import (
    DIGEST_ABOVE,
    Gathered,
    Happened,
    is_due,
    is_held,
    is_within,
    next_after,
)
from fantwin.pipeline.outputs.notify.wording import Place, Text, about_fan, about_many
from fantwin.pipeline.site.alarm_book import AlarmBook
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S

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
    """All that survives a restart. `is_first`: there was nothing."""

    is_first: bool = True
    heard: dict[FanName, tuple[int, int]] = field(default_factory=dict)
    """by fan: an onset, and when that alarm was first presented, by the clock of the host"""
    announced: dict[tuple[str, FanName], Announced] = field(default_factory=dict)
    """by target and fan"""
    gathered: dict[tuple[str, Basket], Gathered] = field(default_factory=dict)
    """by target"""

    def of_fans(self, fans: Mapping[str, int]) -> Saved:
        """Without what is about fans that are not there any more. fans: how many each tray has."""

        def is_there(fan: FanName) -> bool:
            return fan[1] < fans.get(fan[0], 0)

        return Saved(
            self.is_first,
            {name: heard for name, heard in self.heard.items() if is_there(name)},
            {key: announced for key, announced in self.announced.items() if is_there(key[1])},
            {
                key: replace(each, fans={name: happened for name, happened in each.fans.items() if is_there(name)})
                for key, each in self.gathered.items()
            },
        )


@dataclass(frozen=True)
class Outgoing:
    """A text for a target, and when it was made, by the clock of the host."""

    target: str
    text: Text
    made_ns: int


@dataclass
class Changes:
    """What is to be saved: names of what has changed in `Saved`, the events that were decided, and their texts."""

    heard: set[FanName] = field(default_factory=set)
    announced: set[tuple[str, FanName]] = field(default_factory=set)
    gathered: set[tuple[str, Basket]] = field(default_factory=set)
    events: set[tuple[str, Event]] = field(default_factory=set)
    outgoing: list[Outgoing] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.heard or self.announced or self.gathered or self.events or self.outgoing)


class Notifications:
    """Not thread-safe."""

    def __init__(
        self,
        config: NotifierConfig,
        place: Place,
        saved: Saved,
        was_sent: Callable[[str, Event], bool],
        past: Iterable[Alarm] = (),
    ) -> None:
        """was_sent: whether an event was decided before for a target, as saved. past: the transitions that were
        decided on, as far as the alarms of now follow from them."""
        self._config = config
        self._place = place
        self._was_sent = was_sent
        self._targets = [target for target in config.target if target.kind == "apprise"]
        self.saved = saved
        self.changes = Changes()
        """since they were saved last; whoever saves them replaces this"""
        self._first_look_ends_ns: int | None = None
        self._is_looking = saved.is_first
        self._times_ns: int | None = None
        self._book = AlarmBook()
        self._open: set[FanName] = set()
        """fans whose alarm is active: time alone may bring a message about them"""
        for alarm in past:
            self._keep(alarm)

    @property
    def is_looking(self) -> bool:
        """Whether it still learns what the alarms are: nothing of that is to be saved yet."""
        return self._is_looking

    def add(self, message: Alarm, now_ns: int) -> None:
        """A transition. now_ns: time of the host."""
        name = self._keep(message)
        if not self._is_looking:
            self._hear(name, now_ns)
            self._decide(self._alarm(name), now_ns)

    def tick(self, now_ns: int) -> None:
        """Time has passed."""
        if self._is_looking:
            self._look(now_ns)
            return
        if self._times_ns is None or abs(now_ns - self._times_ns) >= TIMES_PERIOD_NS:
            self._times_ns = now_ns
            for name in sorted(self._open):
                self._decide(self._alarm(name), now_ns)
        for target in self._targets:
            self._send_due(target, now_ns)

    def firing(self, target: TargetConfig) -> list[FanAlarm]:
        """The alarms that an Alertmanager has to have now: active, and not silenced by an operator."""
        alarms = map(self._alarm, sorted(self._open))
        return [alarm for alarm in alarms if alarm.presented and hears_of(target, alarm)]

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
        for name in sorted(self._open):
            self._hear(name, now_ns)
            self._decide(self._alarm(name), now_ns)

    def _keep(self, message: Alarm) -> FanName:
        newest = self._book.add(message).newest
        name = (newest.header.tray, newest.fan)
        if newest.active:
            self._open.add(name)
        else:
            self._open.discard(name)
        return name

    def _hear(self, name: FanName, now_ns: int) -> None:
        """Remember when an alarm is presented for the first time."""
        alarm = self._alarm(name)
        if alarm.active and alarm.presented and not alarm.first_heard_ns:
            self.saved.heard[name] = (alarm.onset_t_ns, now_ns)
            self.changes.heard.add(name)

    def _alarm(self, name: FanName) -> FanAlarm:
        current = self._book.of(Fan(*name))
        assert current is not None
        onset_t_ns, heard_ns = self.saved.heard.get(name, (0, 0))
        return fan_alarm(current, heard_ns if onset_t_ns == current.newest.onset_t_ns else 0)

    def _decide(self, alarm: FanAlarm, now_ns: int) -> None:
        for target in self._targets:
            key = (target.name, alarm.name)
            before = self.saved.announced.get(key)
            events, now = decide(target, alarm, before, now_ns)
            if now is not None and now != before:
                self.saved.announced[key] = now
                self.changes.announced.add(key)
            for event in events:
                self._gather(target, alarm, event, now_ns)

    def _gather(self, target: TargetConfig, alarm: FanAlarm, event: Event, now_ns: int) -> None:
        sent = (target.name, event)
        if sent in self.changes.events or self._was_sent(target.name, event):
            return
        self.changes.events.add(sent)
        happened = Happened((event.kind,), event.number if event.kind == event.kind.AGAIN else 0)
        basket = Basket.OPEN
        if is_held(target.quiet_hours, alarm.severity, now_ns, self._place.zone):
            basket = Basket.HELD
        elif (before := self._gathered(target, Basket.HELD).fans.pop(alarm.name, None)) is not None:
            # worse than what is held: all of it goes at once
            happened = before.then(happened)
            self.changes.gathered.add((target.name, Basket.HELD))
        self._gathered(target, basket).add(alarm.name, happened, now_ns)
        self.changes.gathered.add((target.name, basket))

    def _send_due(self, target: TargetConfig, now_ns: int) -> None:
        gathered = self._gathered(target, Basket.OPEN)
        if is_due(gathered, now_ns):
            self._set(target, Basket.OPEN, next_after(gathered, now_ns))
            for text in self._texts(gathered, now_ns):
                self.changes.outgoing.append(Outgoing(target.name, text, now_ns))
        held = self._gathered(target, Basket.HELD)
        if held.fans and not (target.quiet_hours and is_within(target.quiet_hours, now_ns, self._place.zone)):
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

    def _presented(self, gathered: Gathered) -> list[tuple[FanAlarm, Happened]]:
        """Without the fans that operators have silenced while their message waited."""
        known = [(name, happened) for name, happened in gathered.fans.items() if self._book.of(Fan(*name))]
        fans = ((self._alarm(name), happened) for name, happened in known)
        return [(alarm, happened) for alarm, happened in fans if not alarm.silenced]

    def _gathered(self, target: TargetConfig, basket: Basket) -> Gathered:
        return self.saved.gathered.setdefault((target.name, basket), Gathered())

    def _set(self, target: TargetConfig, basket: Basket, gathered: Gathered) -> None:
        self.saved.gathered[target.name, basket] = gathered
        self.changes.gathered.add((target.name, basket))
