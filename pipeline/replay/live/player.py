"""Plays a recording: sends each message when it is due, handles keys, and publishes the time 20 times a second."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from fantwin.pipeline.replay.live.keyboard import Key
from fantwin.pipeline.replay.live.pace import Pace, faster, slower
from fantwin.pipeline.replay.live.sender import Sender
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import NewTwin, Raw
from fantwin.schemas.topics import BY_NAME, TOPICS

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
