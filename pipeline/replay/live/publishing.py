"""A replay on the bus from its beginning to its end: who is there, the playing, and what became of it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from pipeline.bus.session import Bus
from pipeline.config.models import Config
from pipeline.errors import UserError
from pipeline.replay.live.keyboard import Key
from pipeline.replay.live.listeners import Listeners, conflict
from pipeline.replay.live.pace import Pace
from pipeline.replay.live.player import Player, Progress, RealTime, Stopped
from pipeline.replay.live.recording_playback import RecordingPlayback
from pipeline.replay.live.sender import Sender
from pipeline.replay.resolve_config import trays_of
from schemas.messages import StageStatus


@dataclass
class Outcome:
    """What became of a replay."""

    site: str
    listeners: list[str] = field(default_factory=list)
    """who was there to read it when it began"""
    messages: dict[str, int] = field(default_factory=dict)
    """by topic"""
    recorded_s: float = 0.0
    elapsed_s: float = 0.0
    rate: float | None = None
    """seconds of the recording a second, pauses left out; None where it was too short to say"""
    stopped: bool = False
    """it was ended before its end"""
    lost: dict[str, int] = field(default_factory=dict)
    """by stage"""
    behind: list[str] = field(default_factory=list)
    """stages that never said they had taken all"""
    damage: list[str] = field(default_factory=list)
    """what could not be read, a line for each file"""

    @property
    def exit_code(self) -> int:
        """0: all in order; 3: something was lost, or could not be read."""
        return 3 if self.lost or self.behind or self.damage else 0


def publish(
    reel: RecordingPlayback,
    topics: Collection[str],
    pace: Pace,
    place: Config,
    stop: threading.Event,
    *,
    loop: bool,
    keys: Callable[[], Sequence[Key]],
    show: Callable[[Progress], None],
    say: Callable[[str], None],
) -> Outcome:
    """Replay on the bus of `place` until the end, or until `stop` is set; `say` is given a line for people.

    Raises:
        UserError: a tray is unknown, or a stage is there, or comes, that writes the same.
    """
    recorded = trays_of(reel.files)
    for tray in sorted(recorded):
        place.tray(tray)
    trays = recorded or {tray.name for tray in place.trays}
    outcome = Outcome(place.site)
    with Bus(place.bus, stop) as bus:
        listeners = Listeners(bus, place.site)

        def refuse_conflicts() -> None:
            if invalid_reason := conflict(listeners.present(), topics, trays, place.site):
                raise UserError(invalid_reason)

        def look(progress: Progress) -> None:
            refuse_conflicts()
            show(progress)

        listeners.meet(stop)
        if listeners.is_replaying():
            raise UserError(f"a replay is running on site {place.site!r} at {place.bus.endpoint}: stop that first")
        refuse_conflicts()
        outcome.listeners = listeners.readers(topics)
        if not outcome.listeners:
            where = f"site {place.site!r} at {place.bus.endpoint}"
            say(f"nobody on {where} reads {', '.join(topics)}; publishing all the same")
        sender = Sender(bus, place.site, trays)
        player = Player(sender, pace, RealTime(stop), keys=keys, look=look)
        outcome.stopped = True
        try:
            with suppress(Stopped):
                player.play(reel.rounds() if loop else ((0, entry) for entry in reel))
                if not sender.sent:
                    raise UserError(f"{reel.files[0]}: there is no {' or '.join(topics)} in it, or not in that stretch")
                outcome.behind = listeners.settle(sender.producer, sender.published(), stop, player.linger)
                outcome.stopped = False
        finally:
            sender.tell_health(StageStatus.STOPPED, "; ".join(reel.damage))
        outcome.lost = listeners.lost(sender.producer, sender.published())
    outcome.messages = dict(sender.sent)
    outcome.recorded_s = (player.last_ns - player.first_ns) / 1e9
    outcome.elapsed_s = player.ended_s - player.began_s
    running_s = outcome.elapsed_s - pace.paused_s
    outcome.rate = outcome.recorded_s / running_s if running_s > 0.0 else None
    outcome.damage = list(reel.damage)
    return outcome
