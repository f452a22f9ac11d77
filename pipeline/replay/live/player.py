"""Plays a recording: sends each message when it is due, handles keys, and publishes the time 20 times a second.

The replay is a producer of its own on the bus, with its own sequence numbers, health and liveliness token.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.replay.live.keyboard import Key
from fantwin.pipeline.runtime.health import HealthBuilder
from fantwin.pipeline.timebase.stage_clock import REPLAY
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.health import Output
from fantwin.schemas.messages import Array, Clock, Grid, Message, NewTwin, Prediction, Raw, Score
from fantwin.schemas.topics import ALL_TRAYS, BY_NAME, TOPICS, alive_key, health_key, tray_key, tray_of
from fantwin.schemas.units import NS_PER_S


def sample_times(message: Message) -> Array:
    """(samples,) ns since the epoch; empty for a message without samples."""
    if isinstance(message, Raw):
        return message.host_receive_t_ns
    return message.t_ns if isinstance(message, Grid | Prediction | Score) else np.zeros(0, np.int64)


SLOWEST, FASTEST = 1 / 64, 1024.0
"""limits of doubling and halving the rate; faster than FASTEST is only infinite: as fast as possible"""


class Pace:
    """Maps a monotonic clock, which the caller reads as `now_s`, to recorded time.

    Deadlines count from the last change of the rate, so that delays between messages do not add up.
    """

    def __init__(self, rate: float, *, paused: bool = False) -> None:
        """`rate`: seconds of the recording per second; infinite: as fast as possible."""
        self.rate = rate
        self.paused = paused
        self.paused_s = 0.0
        """time spent paused, up to the last change"""
        self._at_ns = 0
        self._since_s = 0.0

    @property
    def rate_now(self) -> float:
        """The rate to publish: 0 while paused."""
        return 0.0 if self.paused else self.rate

    def start(self, at_ns: int, now_s: float) -> None:
        """Set recorded time to `at_ns` now."""
        self._at_ns, self._since_s = at_ns, now_s

    def change(self, at_ns: int, now_s: float, *, rate: float | None = None, paused: bool | None = None) -> None:
        """Continue from `at_ns` with another rate, or pause there."""
        if self.paused:
            self.paused_s += now_s - self._since_s
        self.rate = self.rate if rate is None else rate
        self.paused = self.paused if paused is None else paused
        self.start(at_ns, now_s)

    def position_ns(self, now_s: float, next_ns: int) -> int:
        """Recorded time now, at most `next_ns`, the time of the next message."""
        if self.paused:
            return min(self._at_ns, next_ns)
        if math.isinf(self.rate):
            return next_ns
        return min(self._at_ns + round((now_s - self._since_s) * self.rate * NS_PER_S), next_ns)

    def due_in_s(self, t_ns: int, now_s: float) -> float:
        """Seconds until recorded time is `t_ns`; zero or less: it is due. Infinite while paused."""
        if self.paused:
            return math.inf
        return (t_ns - self._at_ns) / NS_PER_S / self.rate - (now_s - self._since_s)


def faster(rate: float) -> float:
    """Twice the rate."""
    return math.inf if rate >= FASTEST else rate * 2


def slower(rate: float) -> float:
    """Half the rate."""
    return FASTEST if math.isinf(rate) else max(rate / 2, SLOWEST)


class Sender:
    """Publishes recorded messages under the site's keys with new headers, the clock of each tray, and health."""

    def __init__(self, bus: Bus, site: str, trays: Collection[str]) -> None:
        """Join the bus; `trays` are the trays of the site."""
        self.producer = f"{REPLAY}-all-{bus.id}"
        self.sent: Counter[str] = Counter()
        """messages sent, by topic"""
        self._bus = bus
        self._site = site
        self._publishers: dict[str, Publisher] = {}
        self._clocks = {tray: self._publisher(tray_key(site, tray, "clock"), "clock") for tray in trays}
        self._health = self._publisher(health_key(site, REPLAY, ALL_TRAYS), "health")
        self._builder = HealthBuilder(REPLAY, ALL_TRAYS, time.time_ns(), may_drop=False)
        self.publish_health(StageStatus.STARTING)
        bus.declare_alive(alive_key(site, REPLAY, ALL_TRAYS))
        bus.require_rights()

    def send(self, entry: Envelope) -> None:
        """Publish a message; blocks while a reader is behind.

        Raises:
            UserError: the site has no such tray.
        """
        tray = tray_of(entry.key)
        if tray not in self._clocks:
            raise UserError(f"the recording has a tray {tray!r}, the configuration has none of that name: see -c")
        key = tray_key(self._site, tray, entry.topic)
        if key not in self._publishers:
            self._publishers[key] = self._publisher(key, entry.topic)
        self._put(self._publishers[key], entry.message, tray)
        self.sent[entry.topic] += 1

    def publish_clock(self, t_ns: int, rate: float) -> None:
        """Publish recorded time and the rate at which it passes."""
        for tray, publisher in self._clocks.items():
            self._put(publisher, Clock(t_ns=t_ns, rate=rate), tray)

    def publish_health(self, status: StageStatus = StageStatus.OK, problem: str = "") -> None:
        """Publish health with the number of sent messages, so that a reader that missed the last ones asks for them."""
        health = self._builder.build(
            status=status,
            problems=[problem],
            inputs=(),
            outputs=[Output(key=key, published=count) for key, count in self.published().items()],
            counters={},
            now_ns=time.time_ns(),
        )
        self._put(self._health, replace(health, is_last=status == StageStatus.STOPPED), "")

    def published(self) -> Mapping[str, int]:
        """Messages sent, by key."""
        return {key: publisher.published for key, publisher in self._publishers.items()}

    def _publisher(self, key: str, topic: str) -> Publisher:
        return self._bus.publisher(key, BY_NAME[topic], type_name(BY_NAME[topic].message), self.producer)

    def _put(self, publisher: Publisher, message: Message, tray: str) -> None:
        publisher.put(encode(replace(message, header=Header(self.producer, publisher.published, tray))))


BEAT_S = 0.05
HEALTH_PERIOD_S = 1.0
_RANK = {topic.name: rank for rank, topic in enumerate(TOPICS)}


class Stopped(Exception):  # noqa: N818  not an error
    """The user asked to stop."""


@dataclass(frozen=True)
class Progress:
    """How far a replay is."""

    t_ns: int
    rate: float
    paused: bool
    round: int
    messages: int


class Player:
    """One replay."""

    def __init__(
        self,
        output: Sender,
        pace: Pace,
        wait: Callable[[float], bool],
        *,
        now_s: Callable[[], float] = time.monotonic,
        keys: Callable[[], Sequence[Key]] = tuple,
        look: Callable[[Progress], None] = lambda _progress: None,
    ) -> None:
        """wait: waits for some seconds; returns True, at once, when the replay has to stop. now_s: monotonic seconds.
        keys: returns the keys pressed since the last call. look: is called about every 50 ms, and may raise."""
        self._output = output
        self._pace = pace
        self._wait, self._now_s = wait, now_s
        self._keys = keys
        self._look = look
        self._next_beat_s = self._next_health_s = 0.0
        self._steps = 0
        self._leading = len(_RANK)
        self._round = 0
        self._messages = 0
        self._clock_ns = 0
        self.first_ns = self.last_ns = 0
        """recorded time of the first and the newest message sent"""
        self.began_s = self.ended_s = now_s()
        """the same on this process's clock"""

    def play(self, rounds: Iterable[tuple[int, Envelope]]) -> None:
        """Play to the end. Each message comes with the number of its round.

        Raises:
            Stopped: the user asked to stop.
        """
        try:
            for self._round, entry in rounds:
                if not self._messages:
                    self._begin(entry)
                self._wait_for(entry)
                self._output.send(entry)
                self._messages += 1
                self.last_ns = max(self.last_ns, entry.received_t_ns)
                self._count_step(entry)
        finally:
            self.ended_s = self._now_s()
            self._pace.change(self.last_ns, self.ended_s)  # counts a pause that is not over
        self._output.publish_health()  # at once, so that stages know how many messages there are

    def heartbeat_after_end(self) -> None:
        """Keep publishing clock and health after the last message."""
        if self._now_s() >= self._next_beat_s:
            self._beat(self._now_s(), self.last_ns, self.last_ns)

    def _begin(self, entry: Envelope) -> None:
        self.began_s = self._now_s()
        self.first_ns = self.last_ns = entry.received_t_ns
        self._pace.start(entry.received_t_ns, self.began_s)

    def _wait_for(self, entry: Envelope) -> None:
        """Return when the message is due."""
        while True:
            now_s = self._now_s()
            if now_s >= self._next_beat_s:
                self._press(entry, now_s)
                self._beat(now_s, self._pace.position_ns(now_s, entry.received_t_ns), _latest_clock_ns(entry))
            wait_s = 0.0 if self._steps else self._pace.due_in_s(entry.received_t_ns, now_s)
            if self._wait(min(max(wait_s, 0.0), BEAT_S)):
                raise Stopped
            if wait_s <= 0.0:
                return

    def _beat(self, now_s: float, position_ns: int, no_later_ns: int) -> None:
        self._next_beat_s = now_s + BEAT_S
        # The clock stops before the next samples, so that a stage does not take them for late.
        self._clock_ns = max(self._clock_ns, min(position_ns, no_later_ns))
        self._output.publish_clock(self._clock_ns, self._pace.rate_now)
        if now_s >= self._next_health_s:
            self._next_health_s = now_s + HEALTH_PERIOD_S
            self._output.publish_health()
        self._look(Progress(position_ns, self._pace.rate, self._pace.paused, self._round, self._messages))

    def _press(self, entry: Envelope, now_s: float) -> None:
        """Handle the pressed keys."""
        for key in self._keys():
            at_ns = self._pace.position_ns(now_s, entry.received_t_ns)
            match key:
                case Key.PAUSE:
                    self._pace.change(at_ns, now_s, paused=not self._pace.paused)
                case Key.STEP:
                    self._pace.change(at_ns, now_s, paused=True)
                    self._steps += 1
                case Key.FASTER:
                    self._pace.change(at_ns, now_s, rate=faster(self._pace.rate))
                case Key.SLOWER:
                    self._pace.change(at_ns, now_s, rate=slower(self._pace.rate))
                case Key.QUIT:
                    raise Stopped

    def _count_step(self, entry: Envelope) -> None:
        """Count a step down when it ends: with a message of the earliest topic, which is the next sample."""
        if BY_NAME[entry.topic].is_needed_first:  # it only comes with that
            return
        self._leading = min(self._leading, _RANK[entry.topic])
        if self._steps and _RANK[entry.topic] == self._leading:
            self._steps -= 1
            self._pace.change(entry.received_t_ns, self._now_s(), paused=True)
            self._next_beat_s = self._now_s()  # publishes the clock at once


def _latest_clock_ns(entry: Envelope) -> int:
    """The time of a message's oldest raw sample, or of its receipt: the clock must not pass it before it is sent."""
    message = entry.message
    if isinstance(message, Raw) and len(message.host_receive_t_ns):
        return int(message.host_receive_t_ns[0])
    if isinstance(message, NewTwin):
        return message.t_ns  # it comes just before a message whose oldest sample this is
    return entry.received_t_ns
