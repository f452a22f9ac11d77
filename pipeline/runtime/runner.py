"""The one loop every stage runs in: receive, check the sequence, step, stamp, publish, count.

Everything a stage reacts to comes through one inbox: messages from the bus, items from the stage's source, and
the coming and going of other stages. It is bounded, and while it is full publishers wait; only a stage that may
drop (the viewer) throws its oldest packets away instead, and counts them.
"""

from __future__ import annotations

import queue
import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pipeline.bus.session import Bus, Publisher
from pipeline.config.models import Config
from pipeline.config.registry import STAGES
from pipeline.errors import UserError
from pipeline.runtime.clock import REPLAY, StageClock, is_of_replay
from pipeline.runtime.health import HealthBook
from pipeline.runtime.sequence_tracker import SequenceTracker
from pipeline.runtime.stage import Context, Parts, Stage
from schemas.codec import CodecError, decode, encode, type_name
from schemas.envelope import Envelope
from schemas.messages import Clock, Header, Health, InputPosition, Message, Output, StageStatus
from schemas.streams import stage_losses
from schemas.topics import BY_NAME, TOPICS, alive_key, health_key, topic_of, tray_key

INBOX_SIZE = 4096
TICK_S = 0.05
HEALTH_PERIOD_S = 1.0
LOSS_TOLD_S = 0.2  # a loss is told after this at the latest, so that a stage that is killed takes few to its grave
FAREWELL_S = 1.0  # how long a stopping stage waits for the last health of a producer that has just left
ORPHAN_LIMIT_S = 10.0  # how long an orphaned stage waits for those it reads from to end


@dataclass(frozen=True, slots=True)
class _FromBus:
    key: str
    payload: bytes
    received_t_ns: int


@dataclass(frozen=True, slots=True)
class _FromSource:
    item: Any


@dataclass(frozen=True, slots=True)
class _Alive:
    key: str
    alive: bool


class _Inbox:
    """The bounded queue before a stage."""

    def __init__(self, drops_oldest: bool) -> None:
        self._queue: queue.Queue[Any] = queue.Queue(INBOX_SIZE)
        self._drops_oldest = drops_oldest
        self._aside: deque[Any] = deque()
        self._closed = False
        self.dropped = 0

    def put(self, item: Any) -> None:
        """Add an item; while the inbox is full it blocks, or drops the oldest. Nothing more once it is closed."""
        while not self._closed:
            try:
                self._queue.put(item, block=not self._drops_oldest, timeout=TICK_S)
                return
            except queue.Full:
                if self._drops_oldest:
                    self._drop_one()

    def close(self) -> None:
        """Let go of whoever is blocked in `put`: it is a thread of the bus, which cannot close while it is."""
        self._closed = True

    def waiting(self) -> int:
        """How many items are there now."""
        return self._queue.qsize() + len(self._aside)

    def _drop_one(self) -> None:
        try:
            self._queue.get_nowait()
        except queue.Empty:
            return
        self.dropped += 1

    def get(self, timeout_s: float) -> Any | None:
        """The next item, or None when there is none in time."""
        if self._aside:
            return self._aside.popleft()
        try:
            return self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def set_aside(self) -> None:
        """Take an item out of the queue and keep it for later, in order: makes room while the stage waits."""
        try:
            self._aside.append(self._queue.get(timeout=0.005))
        except queue.Empty:
            return


class Runner:
    """Runs one stage in this process until `stop` is set, then brings what is in flight to its end."""

    def __init__(self, stage: Stage, config: Config, tray: str | None, stop: threading.Event) -> None:
        """Build the stage. `tray` names the tray of a stage that has one process for each; `stop` ends `run`.

        Raises:
            StageError, ConfigError, BusError: it cannot be built; nothing has been published.
        """
        trays = (config.tray(tray),) if tray else config.trays
        is_per_tray = STAGES[stage.name].scope == "tray"
        if is_per_tray and len(trays) != 1:
            names = ", ".join(t.name for t in trays)
            raise UserError(f"{stage.name} runs one process for each tray: say which with --tray (one of {names})")
        self.stage = stage
        self.stop = stop
        self.orphaned = threading.Event()
        """Set when whoever started this stage has gone: it ends as soon as those it reads from have ended."""
        self._site = config.site
        self._instance = trays[0].name if is_per_tray else "all"
        self.producer = f"{stage.name}-{self._instance}-{secrets.token_hex(4)}"
        self._inbox = _Inbox(drops_oldest=stage.may_drop)
        self._counts: Counter[str] = Counter()
        started_t_ns = time.time_ns()
        self._health = HealthBook(stage.name, self._instance, started_t_ns, may_drop=stage.may_drop)
        context = Context(
            site=config.site,
            trays=trays,
            config=config.sections[stage.name],
            folder=config.folder,
            run_folder=config.run_folder,
            started_t_ns=started_t_ns,
            snapshot_folder=config.run_folder,
            configuration_text=config.text,
            overrides=config.overrides,
        )
        self._parts: dict[str, Parts] = (
            {t.name: stage.build(replace(context, trays=(t,))) for t in trays}
            if stage.core_per_tray
            else {"": stage.build(context)}
        )
        self._has_source = any(parts.source for parts in self._parts.values())
        self._clock = StageClock()
        self._bus = Bus(config.bus, stop)
        self._tracker = SequenceTracker(self._recover_rare if stage.may_drop else self._recover)
        self._publishers: dict[tuple[str, str], Publisher] = {
            (t.name, name): self._publisher(tray_key(config.site, t.name, name), name)
            for t in trays
            for name in stage.writes
        }
        self._health_publisher = self._publisher(health_key(config.site, stage.name, self._instance), "health")
        self._read_keys = {
            tray_key(config.site, t.name, name) for t in trays for name in stage.reads if name != "health"
        }
        self._taken: dict[str, InputPosition] = {}
        """of each core: what it has taken of its main input, the first it reads; the others move no output's place"""
        self._crash = ""
        self._orphan_until_s = 0.0
        self._alive: set[str] = set()
        self._left: dict[str, float] = {}
        self._last_health: dict[str, Health] = {}

    def run(self) -> Health:
        """Run to the end and give the last health. Whatever happens, the cores are closed and it is published."""
        for key in sorted(self._read_keys):
            self._bus.subscribe(key, self._on_bus)
        if self.stage.core_per_tray and not self._has_source:  # a core of all trays has no one tray's time
            for tray in self._parts:
                self._bus.subscribe(tray_key(self._site, tray, "clock"), self._on_bus)
        self._bus.subscribe(health_key(self._site, "*", "*"), self._on_bus)
        self._bus.watch_alive(alive_key(self._site, "*", "*"), lambda key, alive: self._inbox.put(_Alive(key, alive)))
        try:
            self._publish_health(StageStatus.STARTING)
            if not self.stage.may_drop:
                self._catch_up()
            self._bus.declare_alive(alive_key(self._site, self.stage.name, self._instance))
            for parts in self._parts.values():
                if parts.source:
                    parts.source.start(lambda item: self._inbox.put(_FromSource(item)))
            self._loop(until=self._should_end)
            self._drain()
        except BaseException as error:
            self._crash = f"crashed: {type(error).__name__}: {error}"
            raise
        finally:
            self._inbox.close()
            for tray, parts in self._parts.items():
                self._publish(tray, parts.core.close(), from_timer=True)
            last = self._publish_health(StageStatus.DEGRADED if self._crash else StageStatus.STOPPED)
            self._bus.close()
        return last

    def _on_bus(self, key: str, payload: bytes) -> None:
        self._inbox.put(_FromBus(key, payload, time.time_ns()))

    def _loop(self, until: Callable[[], bool]) -> None:
        next_tick = next_health = next_loss = time.monotonic()
        told = 0
        while not until():
            item = self._inbox.get(max(0.0, next_tick - time.monotonic()))
            if item is not None:
                self._handle(item)
            now = time.monotonic()
            if now >= next_tick:
                next_tick = now + TICK_S
                for tray, parts in self._parts.items():
                    self._publish(tray, parts.core.tick(self._clock.tick_ns(tray)), from_timer=True)
                if now >= next_health or (now >= next_loss and self._lost() > told):
                    next_health, next_loss = now + HEALTH_PERIOD_S, now + LOSS_TOLD_S
                    told = self._publish_health(StageStatus.OK).lost

    def _should_end(self) -> bool:
        if self.stop.is_set() or not self.orphaned.is_set():
            return self.stop.is_set()
        now = time.monotonic()
        self._orphan_until_s = self._orphan_until_s or now + ORPHAN_LIMIT_S
        return now > self._orphan_until_s or not any(map(self._is_fed_by, self._alive))

    def _is_fed_by(self, key: str) -> bool:
        health = self._last_health.get(key)
        return health is not None and any(output.key in self._read_keys for output in health.outputs)

    def _drain(self) -> None:
        """Handle what has been sent to this stage before it was told to stop, however much more is being sent."""
        stopped = threading.Event()

        def stop_sources() -> None:
            for parts in self._parts.values():
                if parts.source:
                    parts.source.stop()
            stopped.set()

        threading.Thread(target=stop_sources, daemon=True).start()
        left: int | None = None  # items still to be handled, known once all that must come has come
        while left != 0:
            if left is None and stopped.is_set() and not self._awaits_farewell():
                left = self._inbox.waiting()
                continue
            item = self._inbox.get(TICK_S)
            if item is not None:
                self._handle(item)
                left = None if left is None else left - 1

    def _awaits_farewell(self) -> bool:
        """Whether a producer has just left whose last health, and so its last messages, may still be on the way."""
        now = time.monotonic()
        return any(
            now - left < FAREWELL_S and self._last_health[key].status != StageStatus.STOPPED
            for key, left in self._left.items()
            if key in self._last_health
        )

    def _handle(self, item: _FromBus | _FromSource | _Alive) -> None:
        if isinstance(item, _FromSource):
            (parts,) = self._parts.values()
            self._publish(self._instance, parts.core.step(item.item))
        elif isinstance(item, _Alive):
            self._note_alive(item)
        else:
            packet = self._decode(item.key, item.payload, item.received_t_ns)
            if packet is None:
                return
            if isinstance(packet.message, Health):
                self._note_health(packet)
            elif isinstance(packet.message, Clock):
                self._clock.note(packet.message, packet.received_t_ns)
            else:
                for due in self._tracker.accept(packet):
                    self._step(due)

    def _decode(self, key: str, payload: bytes, received_t_ns: int) -> Envelope | None:
        try:
            topic = topic_of(key)
            return Envelope(key, topic.name, payload, received_t_ns, decode(topic.message, payload))
        except (KeyError, CodecError):
            self._counts["lost_undecodable"] += 1
            return None

    def _step(self, packet: Envelope) -> None:
        tray = packet.message.header.tray
        parts = self._parts.get(tray) or self._parts.get("")
        if parts is None:
            self._counts["unknown_tray"] += 1
            return
        header = packet.message.header
        if self._has_source and is_of_replay(header.producer):  # a recorded command must not drive a fan of today
            self._counts["refused_of_replay"] += 1
            return
        if packet.topic == self.stage.reads[0]:
            self._taken[tray] = InputPosition.after(self._taken.get(tray), packet.topic, header)
        self._publish(tray, parts.core.step(packet if self.stage.wants_envelopes else packet.message))

    def _note_alive(self, change: _Alive) -> None:
        if change.alive:
            self._alive.add(change.key)
            self._left.pop(change.key, None)
        else:
            self._alive.discard(change.key)
            if change.key == alive_key(self._site, REPLAY, "all"):
                self._clock.forget()
            self._left[change.key] = time.monotonic()

    def _note_health(self, packet: Envelope) -> None:
        health = packet.message
        assert isinstance(health, Health)
        self._last_health[alive_key(self._site, health.stage, health.instance)] = health
        if health.stage == REPLAY and health.status == StageStatus.STOPPED:
            self._clock.forget()
        for due in self._tracker.reconcile(health, self._read_keys):
            self._step(due)
        if "health" in self.stage.reads:
            for due in self._tracker.accept(packet):
                self._step(due)

    def _recover(self, key: str, producer: str, first: int, last: int) -> Iterator[Envelope]:
        found = self._bus.recover(key, producer, first, last, self._inbox.set_aside)
        packets = (self._decode(its_key, payload, time.time_ns()) for its_key, payload in found)
        return (packet for packet in packets if packet is not None)

    def _recover_rare(self, key: str, producer: str, first: int, last: int) -> Iterator[Envelope]:
        """What a stage that may drop asks for again: no data, but what is said once, such as the twin in force."""
        return self._recover(key, producer, first, last) if topic_of(key).is_rare else iter(())

    def _catch_up(self) -> None:
        """Take what producers still keep from before this stage came: only then is it ready."""
        keys = sorted(self._read_keys)
        if "health" in self.stage.reads:
            keys.append(health_key(self._site, "*", "*"))
        for key in keys:
            kept = (p for p in self._recover(key, "*", 0, 2**63) if p.message.header.producer != self.producer)
            for packet in sorted(kept, key=lambda p: (p.message.header.producer, p.message.header.sequence)):
                for due in self._tracker.accept(packet):
                    self._step(due)

    def _publisher(self, key: str, topic: str) -> Publisher:
        return self._bus.publisher(key, BY_NAME[topic], type_name(BY_NAME[topic].message), self.producer)

    def _publish(self, tray: str, messages: Sequence[Message], *, from_timer: bool = False) -> None:
        # what comes of a device is made of nothing that came over the bus
        position = self._taken.get(tray) if messages and not self._has_source else None
        if position and from_timer:
            position = replace(position, from_timer=True)
        for message in messages:
            publisher = self._publishers[tray, _TOPIC_NAMES[type(message)]]
            stamped = replace(message, header=Header(self.producer, publisher.published, tray, position))
            publisher.put(encode(stamped))
            if (now_ns := self._clock.now_ns(tray)) is not None:
                self._health.note_output(stamped, now_ns)

    def _counters(self) -> Counter[str]:
        counters: Counter[str] = Counter(self._counts)
        for parts in self._parts.values():
            counters.update(parts.core.counters())
        if self._inbox.dropped:
            counters["dropped"] = self._inbox.dropped
        return counters

    def _lost(self) -> int:
        return stage_losses(self._tracker.inputs(), self._counters(), may_drop=self.stage.may_drop)

    def _publish_health(self, status: StageStatus) -> Health:
        health = self._health.make(
            status=status,
            problems=[self._crash, *(parts.core.problem() for parts in self._parts.values())],
            inputs=self._tracker.inputs(),
            outputs=[
                Output(key=publisher.key, published=publisher.published) for publisher in self._publishers.values()
            ],
            counters=self._counters(),
            now_ns=time.time_ns(),
        )
        header = Header(self.producer, self._health_publisher.published, "")
        health = replace(health, header=header)
        payload = encode(health)
        self._health_publisher.put(payload)
        if "health" in self.stage.reads and status != StageStatus.STOPPED:  # the bus brings what others publish
            self._step(Envelope(self._health_publisher.key, "health", payload, time.time_ns(), health))
        return health


_TOPIC_NAMES = {topic.message: topic.name for topic in TOPICS}
