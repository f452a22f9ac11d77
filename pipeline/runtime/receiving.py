"""What comes from the bus to a stage: decoded, with nothing missing, and in the order in which it is processed.

Missing messages are asked of their producers; what nobody has any more is counted as lost. Health of other stages says
how much of each sequence there should be, and which producers there are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.roles import roles_of
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import Shard
from fantwin.pipeline.runtime.believed_health import believed_health
from fantwin.pipeline.runtime.health import HealthBuilder
from fantwin.pipeline.runtime.inbox import DueMessages, FromBus, Inbox, Liveness, Recovered
from fantwin.pipeline.runtime.missed_messages import Recovery
from fantwin.pipeline.runtime.sequence_tracker import Found, SequenceTracker
from fantwin.pipeline.runtime.sessions import Sessions
from fantwin.pipeline.runtime.silences import Silences
from fantwin.pipeline.runtime.stage import Stage
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.pipeline.timebase.stage_clock import REPLAY, StageClock
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Clock
from fantwin.schemas.streams import MOST_PUBLISHED
from fantwin.schemas.topics import (
    ALL_TRAYS,
    alive_key,
    health_key,
    key_in_words,
    sessions_key,
    topic_of,
    tray_key,
    tray_of,
)

MANY_TRAYS = 16
"""in a process that processes several trays in one pass: then it takes messages at its ticks, together"""

MOST_UNREADABLE_KEYS = 16
"""the most keys that are named in the note on messages that cannot be read"""


@dataclass(kw_only=True, eq=False)
class Receiver:
    """Takes items of the inbox that came from the bus, and puts the messages that are due into `due`.

    Attributes:
        shard: the trays of the process.
        producer: its name; its own messages are not taken.
        sessions, clock, health: what is received changes them.
        wants: whether a core needs the next message of a tray on an undecoded topic.
    """

    stage: Stage
    config: Config
    shard: Shard
    bus: Bus
    inbox: Inbox
    producer: str
    sessions: Sessions
    clock: StageClock
    health: HealthBuilder
    due: DueMessages
    wants: Callable[[str], bool]
    counts: Counter[str] = field(default_factory=Counter)
    """of messages that could not be taken, by reason"""

    def __post_init__(self) -> None:
        stage, config, shard = self.stage, self.config, self.shard
        self._site = config.site
        self._roles = roles_of(config)
        self._trays = frozenset(shard.trays)
        self._is_patient = stage.is_patient or (stage.joint is not None and len(shard.trays) >= MANY_TRAYS)
        self._unreadable: Counter[str] = Counter()
        """by key, the number of messages that cannot be read; at most MOST_UNREADABLE_KEYS keys"""
        self._recovery = Recovery(self.bus, self.inbox, self.bus.answer_timeout_s, only_rare=stage.may_drop)
        reads = stage.reads_as_configured(config)
        self.keys = {tray_key(config.site, tray, topic) for topic in reads if topic != "health" for tray in shard.trays}
        """all that the stage reads, health apart"""
        self._undecoded = {key for key in self.keys if topic_of(key).name in stage.undecoded}
        self.tracker = SequenceTracker(self._recovery.ask, sessions=self.sessions, sampled=self._undecoded)
        main = {tray_key(config.site, tray, topic): tray for topic in stage.reads[:1] for tray in shard.trays}
        self._silences = Silences(main, self.sessions)

    def start(self, *, follows_clock: bool) -> None:
        """Subscribe to what the stage reads, to health, to who is there and, if it follows them, to the clocks of the
        trays."""
        for key in sorted(self.keys - self._undecoded):
            self.bus.subscribe(key, self.on_message)
        for key in sorted(self._undecoded):
            self.bus.subscribe(key, self.on_message, partial(self.wants, tray_of(key)))
        if follows_clock:
            for tray in self.shard.trays:
                self.bus.subscribe(tray_key(self._site, tray, "clock"), self.on_message)
        self.bus.subscribe(health_key(self._site, "*", "*"), self._on_health)
        self.bus.watch_alive(alive_key(self._site, REPLAY, ALL_TRAYS), self._on_liveness)
        self.bus.watch_alive(sessions_key(self._site), self._on_liveness)

    def on_message(self, key: str, payload: bytes) -> None:
        """A message has come, in a thread of the bus: put it into the inbox."""
        is_urgent = not (self._is_patient or key in self._undecoded)
        self.inbox.put(FromBus(key, payload, HOST_CLOCK.now_ns()), is_urgent=is_urgent)

    def _on_health(self, key: str, payload: bytes) -> None:
        self.inbox.put(FromBus(key, payload, HOST_CLOCK.now_ns()), is_urgent=False)

    def _on_liveness(self, key: str, alive: bool) -> None:
        self.inbox.put(Liveness(key, alive))

    def catch_up(self) -> None:
        """Request what producers still keep from before this stage started: only then is it ready."""
        keys = sorted(self.keys, key=lambda key: (not topic_of(key).is_needed_first, key))
        if "health" in self.stage.reads:
            keys.append(health_key(self._site, "*", "*"))
        self._recovery.catch_up(keys)

    @property
    def is_catching_up(self) -> bool:
        """Whether an answer to `catch_up` is still to come."""
        return self._recovery.is_catching_up

    @property
    def awaits_more(self) -> bool:
        """Whether something that other stages have sent, or say at their end, is still to come."""
        return self.sessions.awaits_last_health() or self.tracker.is_waiting

    def ask_again(self) -> None:
        """Repeat unanswered requests when they are due; find sessions that were killed, and those that were cut off."""
        self._recovery.send_due()
        for producer in self.sessions.take_killed():
            self._silences.end(producer)
        if self.sessions.has_cut_off():
            self.bus.meet_again()

    def is_complete(self, tray: str) -> bool:
        """Whether the producer of a tray's main input has shown, since this was last asked, that all that it has sent
        has been processed; a replay shows it by its clock."""
        is_shown = self._silences.take(tray)
        return not self.due.has(tray) and (is_shown or self.clock.is_of_replay(tray))

    def take(self, item: FromBus | Recovered | Liveness) -> None:
        """Take an item of the inbox."""
        match item:
            case FromBus():
                self._take_message(item)
            case Recovered():
                self._take_recovered(item)
            case Liveness():
                self.sessions.update(item.key, item.alive)
                if item.key == alive_key(self._site, REPLAY, ALL_TRAYS):
                    self.clock.set_replay_alive(item.alive)

    def _take_message(self, item: FromBus) -> None:
        envelope = self._decode(item.key, item.payload, item.received_t_ns)
        if envelope is None:
            return
        message = None if self.is_undecoded(envelope) else envelope.message
        if isinstance(message, Health):
            self._take_health(envelope, message)
        elif isinstance(message, Clock):
            if not self.clock.update(message):
                self.counts["refused_clocks"] += 1
        else:
            self.health.add_input(envelope.key, envelope.received_t_ns, HOST_CLOCK.now_ns())
            self.due.add(self.tracker.accept(envelope))

    def _take_recovered(self, item: Recovered) -> None:
        now_ns = HOST_CLOCK.now_ns()
        envelopes = [
            each
            for each in self._decoded(item.answer.messages, now_ns)
            if each.header.producer != self.producer and self._concerns(each)
        ]
        if self._recovery.is_catch_up(item.request):
            due = self.tracker.accept_kept(envelopes)
        else:
            due = self.tracker.answer(item.request, Found(envelopes, item.answer.published))
        for key in dict.fromkeys(envelope.key for envelope in due if envelope.topic != "health"):
            self.health.add_input(key, now_ns, now_ns)
        self.due.add(due)
        self._recovery.finish(item)

    def _take_health(self, envelope: Envelope, health: Health) -> None:
        said, health = health, believed_health(health, self._roles)
        if health is not said:
            self.counts["refused_outputs"] += 1
        if health.stage == REPLAY:
            self.clock.add_replay_health(health.header.producer, has_ended=health.is_last)
        self.sessions.add_health(health, self.keys)
        self.due.add(self.tracker.reconcile(health, self.keys))
        self._silences.add_health(health, self.tracker.has_all_of)
        if "health" in self.stage.reads and self._concerns(envelope):
            self.due.add(self.tracker.accept(envelope))

    def _concerns(self, envelope: Envelope) -> bool:
        """Whether a message is of a tray of this process. Health is of all trays of its process: so each recorder has
        the health of all processes that work on its trays, whatever becomes of the others."""
        if envelope.topic != "health" or self.shard.is_whole:
            return True
        message = envelope.message
        if not isinstance(message, Health) or not message.trays:
            return True
        return not self._trays.isdisjoint(message.trays.split(","))

    def _decoded(self, messages: Sequence[tuple[str, bytes]], received_t_ns: int) -> list[Envelope]:
        decoded = (self._decode(key, payload, received_t_ns) for key, payload in messages)
        return [envelope for envelope in decoded if envelope]

    def note(self) -> str:
        """How many messages could not be read, by key; empty if there were none."""
        where = ", ".join(f"{count} on {key_in_words(key)}" for key, count in self._unreadable.most_common())
        return f"messages that cannot be read: {where}" if where else ""

    def _decode(self, key: str, payload: bytes, received_t_ns: int) -> Envelope | None:
        try:
            envelope = Envelope(key, topic_of(key).name, payload, received_t_ns)
            header = envelope.header if self.is_undecoded(envelope) else envelope.message.header
            if header.sequence >= MOST_PUBLISHED:
                raise CodecError(f"no producer has ever published {header.sequence} messages")
        except (KeyError, CodecError):
            self.counts["undecodable"] += 1
            if key in self._unreadable or len(self._unreadable) < MOST_UNREADABLE_KEYS:
                self._unreadable[key] += 1
            return None
        if not self._is_of_its_key(envelope):
            self.counts["refused_of_other_key"] += 1
            return None
        return envelope

    def _is_of_its_key(self, envelope: Envelope) -> bool:
        """Whether a message is of the tray, or of the process, of its key: rights are about keys, and cores go by what
        is in the message."""
        if envelope.topic != "health":
            return envelope.header.tray == tray_of(envelope.key)
        health = envelope.message
        return isinstance(health, Health) and envelope.key == health_key(self._site, health.stage, health.instance)

    def is_undecoded(self, envelope: Envelope) -> bool:
        """Whether the core takes a message as it came."""
        return envelope.topic in self.stage.undecoded
