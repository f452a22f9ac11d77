"""A replay on the bus: find the running stages, play, wait until they have consumed all, and report losses."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.config.roles import REPLAY
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.replay.live.keyboard import Key
from fantwin.pipeline.replay.live.listeners import Listeners, conflict, made_by_stages
from fantwin.pipeline.replay.live.player import Pace, Player, Progress, Sender, Stopped
from fantwin.pipeline.replay.live.recording_playback import RecordingPlayback
from fantwin.pipeline.replay.resolve_config import trays_of
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.topics import BY_NAME
from fantwin.schemas.units import NS_PER_S


@dataclass
class Outcome:
    """The result of a replay."""

    site: str
    listeners: list[str] = field(default_factory=list)
    """stages that could read it when it began"""
    messages: dict[str, int] = field(default_factory=dict)
    """by topic"""
    recorded_s: float = 0.0
    elapsed_s: float = 0.0
    rate: float | None = None
    """seconds of the recording per second, without pauses; None where it was too short"""
    stopped: bool = False
    """the user stopped it"""
    lost: dict[str, int] = field(default_factory=dict)
    """by stage"""
    behind: list[str] = field(default_factory=list)
    """stages that did not report that they received everything"""
    damage: list[str] = field(default_factory=list)
    """what could not be read, a line a file"""

    @property
    def exit_code(self) -> int:
        """0: success; 3: data were lost, or could not be read."""
        return 3 if self.lost or self.behind or self.damage else 0


def publish(
    playback: RecordingPlayback,
    pace: Pace,
    config: Config,
    stop: threading.Event,
    *,
    loop: bool,
    keys: Callable[[], Sequence[Key]],
    show: Callable[[Progress], None],
    report: Callable[[str], None],
) -> Outcome:
    """Replay on the bus of `config` until the end, or until `stop` is set; `report` prints a line for the user.

    Raises:
        UserError: a tray is unknown, or a running stage writes the same topics.
    """
    recorded = trays_of(playback.files)
    for tray in sorted(recorded):
        config.tray(tray)
    trays = recorded or {tray.name for tray in config.trays}
    topics = playback.topics
    recorded_topics = [topic for topic in topics if BY_NAME[topic].recorded]
    outcome = Outcome(config.site)
    with join_bus(config, stop, roles=(REPLAY,)) as bus:
        listeners = Listeners(bus, config.site)

        def refuse_conflicts() -> None:
            if problem := conflict(listeners.present(), topics, trays, config.site):
                raise UserError(problem)

        def look(progress: Progress) -> None:
            refuse_conflicts()
            show(progress)

        listeners.wait_for_discovery(stop, report)
        if listeners.is_replaying():
            raise UserError(f"a replay is running on site {config.site!r} at {config.bus.endpoint}: stop that first")
        for topic, label in made_by_stages(listeners.present(), topics).items():
            report(
                f"{label} of site {config.site!r} is running and writes {topic} itself: recorded versions are left out"
            )
            topics = tuple(each for each in topics if each != topic)
        refuse_conflicts()
        outcome.listeners = listeners.readers(recorded_topics)
        if not outcome.listeners:
            where = f"site {config.site!r} at {config.bus.endpoint}"
            report(f"no stage on {where} reads {', '.join(recorded_topics)}; publishing anyway")
        sender = Sender(bus, config.site, trays)
        player = Player(sender, pace, stop.wait, keys=keys, look=look)
        outcome.stopped = True
        try:
            with suppress(Stopped):
                rounds = playback.rounds() if loop else ((0, entry) for entry in playback)
                player.play((number, entry) for number, entry in rounds if entry.topic in topics)
                if not sender.sent:
                    none = f"it holds no {' or '.join(recorded_topics)}, or none between --from and --to"
                    raise UserError(f"{playback.files[0]}: {none}")
                outcome.behind = listeners.wait_until_drained(
                    sender.producer, sender.published(), stop, player.heartbeat_after_end
                )
                outcome.stopped = False
        finally:
            sender.publish_health(StageStatus.STOPPED, "; ".join(playback.damage))
        outcome.lost = listeners.lost(sender.producer, sender.published())
    outcome.messages = dict(sender.sent)
    outcome.recorded_s = (player.last_ns - player.first_ns) / NS_PER_S
    outcome.elapsed_s = player.ended_s - player.began_s
    running_s = outcome.elapsed_s - pace.paused_s
    outcome.rate = outcome.recorded_s / running_s if running_s > 0.0 else None
    outcome.damage = list(playback.damage)
    return outcome
