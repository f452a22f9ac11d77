"""The one loop that every stage runs in: receive, check the sequence, step, stamp, publish, count.

Everything a stage reacts to comes through one bounded inbox: messages from the bus, items from the stage's sources, and
the arrival and departure of other stages. While the inbox is full, publishers wait. Only a stage that may drop
(learner, viewer, gateway, opcua, mqtt) discards its oldest items instead, and counts them.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Set

from fantwin.pipeline.bus.identity import new_session_id
from fantwin.pipeline.bus.kept_messages import KeptQuery
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import Shard, chosen_shard
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.runtime.building import abort, build_and_join
from fantwin.pipeline.runtime.ending import Ending, Step
from fantwin.pipeline.runtime.health import HealthBuilder
from fantwin.pipeline.runtime.inbox import INBOX_SIZE, DueMessages, FromBus, FromSource, Inbox, Item, Liveness
from fantwin.pipeline.runtime.kept_snapshots import KeptForOthers
from fantwin.pipeline.runtime.publishing import Outputs
from fantwin.pipeline.runtime.receiving import Receiver
from fantwin.pipeline.runtime.reports import Reports
from fantwin.pipeline.runtime.service_manager import SignsOfLife
from fantwin.pipeline.runtime.sessions import Session, Sessions, trays_in_words
from fantwin.pipeline.runtime.stage import BuiltStage, Stage, StageError
from fantwin.pipeline.runtime.started_sources import Sources
from fantwin.pipeline.runtime.steps import Steps
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.pipeline.timebase.stage_clock import StageClock
from fantwin.schemas.codec import type_name
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Health
from fantwin.schemas.topics import BY_NAME, alive_key, health_key, tray_key

TICK_S, EARLY_S = 0.06, 0.02
"""longest time between ticks; a tick due within EARLY_S comes at once if nothing waits: one waking does for both"""
WATCH_S = 0.25
"""how often it is seen whether `stop` has been set while the loop hangs; the loop itself sees it at its next tick"""
HEALTH_PERIOD_S = 1.0
LOSS_REPORT_S = (
    0.2  # losses, and that a command has arrived, are reported this soon: a killed stage leaves few unreported
)
MOST_DUE_BYTES = 8 << 20
"""of messages that are taken from the inbox to be joined: more than ever come together"""
PRODUCERS_END_LIMIT_S = 10.0  # how long a stage whose launcher has gone waits for its producers to end
# When each part of the end must be over, as shares of launcher.watchdog_s: the rest is for the process itself.
CAUGHT_UP, ANSWERED, DRAINED, WORK_ENDED = 0.4, 0.55, 0.7, 0.75
SOURCES_STOPPED, CORES_CLOSED, HEALTH_SENT, BUS_LEFT = 0.78, 0.88, 0.9, 0.95


class Runner:
    """Runs one stage in this process until `stop` is set, then processes what is in flight and ends."""

    def __init__(
        self,
        stage: Stage,
        config: Config,
        shard: Shard | None,
        stop: threading.Event,
        on_health: Callable[[Health], None] | None = None,
    ) -> None:
        """Build the stage and join the bus. `shard` says which trays it has, None: all; `stop` ends `run`; `on_health`
        is called with each health message while it runs.

        Raises:
            StageError, ConfigError, BusError: it cannot be built; nothing has been published.
        """
        shard = shard or chosen_shard(stage.name, config)
        self.stage = stage
        self.stop = stop
        self.launcher_gone = threading.Event()
        """Set when the process that started this stage has gone: it ends as soon as its producers have ended."""
        self._site = config.site
        self._shard = shard
        session_id = new_session_id()
        self.producer = f"{stage.name}-{self._shard.name}-{session_id}"
        self._inbox = Inbox(drops_oldest=stage.may_drop)
        started_t_ns = HOST_CLOCK.now_ns()
        self._sources = Sources(self._inbox)
        self._clock = StageClock()
        self._sessions = Sessions()
        self._session = Session.of_this_process(stage.name, shard, started_t_ns, self.producer)
        self._bus, self._parts = build_and_join(
            stage, config, shard, self._session, session_id, stop, lambda: self._clock.is_replay_alive
        )
        before = {key: payload for parts in self._parts.values() for key, payload in parts.kept.items()}
        self._kept = KeptForOthers(
            self._bus, config.site, STAGES[stage.name].keeps, shard.trays, before, self._inbox.put
        )
        self._has_source = any(parts.source for parts in self._parts.values())
        takes_messages = not (stage.wants_envelopes or stage.undecoded)
        joins = stage.core_per_tray and takes_messages and not self._has_source
        self._due = DueMessages(self._parts, joins=joins)
        """to be processed before anything else"""
        self._outputs = Outputs(self._bus, config.site, stage, list(shard.trays), self.producer)
        main = stage.reads[:1] if not self._has_source else ()  # the core of a source reports its silence
        self._health = HealthBuilder(
            stage.name,
            self._shard.name,
            started_t_ns,
            may_drop=stage.may_drop,
            main_keys={
                tray_key(config.site, tray, topic)
                for topic in main
                # what is published seldom is not waited for
                if topic in stage.reads_as_configured(config) and not BY_NAME[topic].is_rare
                for tray in shard.trays
            },
            trays=() if shard.is_whole else shard.trays,
        )
        self._receiver = Receiver(
            stage=stage,
            config=config,
            shard=shard,
            bus=self._bus,
            inbox=self._inbox,
            producer=self.producer,
            sessions=self._sessions,
            clock=self._clock,
            health=self._health,
            due=self._due,
            wants=lambda tray: self._parts[tray if tray in self._parts else ""].core.wants(tray),
        )
        self._tracker = self._receiver.tracker
        self._signs_of_life = SignsOfLife.from_environment()
        self._ending = Ending(stage.name, config.launcher.watchdog_s)
        self._require_rights()
        self._steps = Steps(
            stage=stage,
            parts=self._parts,
            receiver=self._receiver,
            kept=self._kept,
            outputs=self._outputs,
            health=self._health,
            clock=self._clock,
        )
        key = health_key(config.site, stage.name, self._shard.name)
        self._reports = Reports(
            stage=stage,
            parts=self._parts,
            producer=self.producer,
            publisher=self._bus.publisher(key, BY_NAME["health"], type_name(Health), self.producer),
            bus=self._bus,
            inbox=self._inbox,
            due=self._due,
            sources=self._sources,
            receiver=self._receiver,
            steps=self._steps,
            outputs=self._outputs,
            health=self._health,
            ending=self._ending,
            on_health=on_health,
        )

    def run(self) -> Health:
        """Run to the end and return the last health, which is published whatever happens.

        At the end cores are closed. A core that raised is aborted instead: its state may be half updated. The end takes
        no longer than `launcher.watchdog_s`: a step that hangs, for example because a consumer takes no more
        messages, is left behind. `is_hung` then says that the process cannot end in order.

        Raises:
            UserError: a part of the end did not end in time.
            Exception: the first that the stage raised.
        """
        work, ending = Step(self._work), self._ending
        alone_until_s = 0.0
        while not work.wait(WATCH_S):
            if self.launcher_gone.is_set():
                alone_until_s = alone_until_s or time.monotonic() + PRODUCERS_END_LIMIT_S
                if time.monotonic() > alone_until_s:
                    self.stop.set()
            if self.stop.is_set():
                ending.begin()
                ending.finish("processing what had arrived", work, WORK_ENDED)
                break
        else:
            ending.begin()
            if work.error is not None:
                is_ours = isinstance(work.error, UserError)
                ending.fail(work.error, f"{'' if is_ours else f'crashed: {type(work.error).__name__}: '}{work.error}")
        self._inbox.close()
        ending.finish("stopping the source", self._sources.stop(), SOURCES_STOPPED)
        failed = self._steps.active
        for name, parts in self._parts.items():
            self._close_core(name, parts, failed)
        ending.run("reporting what was consumed", self._outputs.report_last, CORES_CLOSED)
        last = self._reports.publish_last(HEALTH_SENT)
        ending.run("leaving the bus", self._bus.close, BUS_LEFT)
        if ending.error is not None:
            raise ending.error
        return last

    @property
    def is_hung(self) -> bool:
        """Whether something was left behind in its thread: the interpreter must not wait for it."""
        return self._ending.is_hung

    def _require_rights(self) -> None:
        """Refuse to start where nobody would hear what is published."""
        try:
            self._bus.require_rights(self.stop, of_role=True)
        except UserError:
            abort(self._parts)
            self._bus.close()
            raise

    def _work(self) -> None:
        self._start()
        self._signs_of_life.ready()
        self._loop(self._should_end, StageStatus.OK)
        self._ending.begin()
        self._signs_of_life.stopping()
        self._drain()

    def _start(self) -> None:
        # sources use the host's time, also during a replay, and so do stages that have all trays in one core
        self._receiver.start(follows_clock=self.stage.core_per_tray and not self._has_source)
        self._bus.declare_alive(self._session.key(self._site))  # before the first message
        self._sessions.update(self._session.key(self._site), alive=True)
        self._reports.publish(StageStatus.STARTING)
        if not self.stage.may_drop:
            self._receiver.catch_up()
            self._loop(self._has_caught_up, StageStatus.STARTING)
            self._health.has_caught_up()
        self._bus.declare_alive(alive_key(self._site, self.stage.name, self._shard.name))
        for name, parts in self._parts.items():
            self._sources.start(name, parts)

    def _loop(self, until: Callable[[], bool], status: StageStatus) -> None:
        next_tick = next_health = next_loss = time.monotonic()
        reported_lost = 0
        while not until():
            if self._due.is_pressing:
                self._step_once()
            elif (item := self._inbox.get(0.0 if self._due else max(0.0, next_tick - time.monotonic()))) is not None:
                self._handle(item)
                if self._due.joins:
                    self._handle_what_waits()
            elif self._due:
                self._step_once()
            now = time.monotonic()
            if now >= next_tick or (now >= next_tick - EARLY_S and not self._due and not self._inbox.waiting()):
                next_tick = now + TICK_S
                for name, parts in self._parts.items():
                    now_ns = self._clock.tick_ns(name)
                    parts.core.confirm_input(is_complete=self._receiver.is_complete(name))
                    self._steps.call(name, lambda core=parts.core, now_ns=now_ns: core.tick(now_ns), from_timer=True)
                self._receiver.ask_again()
                news = False
                if now >= next_loss:
                    next_loss = now + LOSS_REPORT_S
                    news = self._steps.owes_answer or self._reports.lost() > reported_lost
                if news or now >= next_health:
                    self._steps.owes_answer = False
                    next_health = now + HEALTH_PERIOD_S
                    reported_lost = self._reports.publish(status).lost
                self._signs_of_life.at_work(self._health.summary)

    def _should_end(self) -> bool:
        return self.stop.is_set() or (self.launcher_gone.is_set() and not self._sessions.has_producer())

    def _drain(self) -> None:
        """Process what was sent to this stage before it was asked to stop, however much more is being sent.

        Whatever there is no time for is counted as lost.
        """
        sources = self._sources.stop()
        left: int | None = None  # items still to be processed, known once everything expected has arrived
        while left != 0 or self._due:
            if self._ending.left_s(DRAINED) < 0:
                self._discard_waiting()
                return
            if self._tracker.is_waiting and self._ending.left_s(ANSWERED) < 0:
                self._due.add(self._tracker.give_up())
            if self._due:
                self._step_once()
                continue
            if left is None and sources.wait(0) and not self._receiver.awaits_more:
                left = self._inbox.waiting()
                continue
            self._receiver.ask_again()
            item = self._inbox.get(TICK_S)
            if item is not None:
                self._handle(item)
                taken = 1 + (self._handle_what_waits() if self._due.joins else 0)
                left = None if left is None else max(0, left - taken)

    def _discard_waiting(self) -> None:
        self._inbox.close()  # from now on it takes nothing, and the sources count what they deliver
        if not self.stage.may_drop:
            self._reports.lost_at_stop += len(self._due) + self._tracker.held
        while (item := self._inbox.get(0)) is not None:
            if isinstance(item, FromSource):
                self._sources.discard(item)
            elif isinstance(item, FromBus) and item.key in self._receiver.keys and not self.stage.may_drop:
                self._reports.lost_at_stop += 1

    def _close_core(self, name: str, parts: BuiltStage, failed: Set[str]) -> None:
        what = name or "the core"
        if name in failed:
            self._ending.run(f"aborting {what}", parts.core.abort, CORES_CLOSED)
        else:
            close = functools.partial(self._steps.call, name, parts.core.close, from_timer=True)
            self._ending.run(f"closing {what}", close, CORES_CLOSED)

    def _handle_what_waits(self) -> int:
        """Take what else is in the inbox now, so that messages of a tray are joined; returns the number of items. It is
        bounded, so that what the inbox holds back does not pile up here."""
        most = min(self._inbox.waiting(), INBOX_SIZE - len(self._due))
        for taken in range(most):
            if self._due.bytes >= MOST_DUE_BYTES or (item := self._inbox.get(0)) is None:
                return taken
            self._handle(item)
        return max(0, most)

    def _handle(self, item: Item) -> None:
        if isinstance(item, FromSource):
            now_ns = HOST_CLOCK.now_ns()
            self._health.add_input("", now_ns, now_ns)
            core = self._parts[item.core].core
            self._steps.call(item.core, lambda: core.step(item.item))
        elif isinstance(item, KeptQuery):
            self._kept.answer(item)
        else:
            self._receiver.take(item)
            if isinstance(item, Liveness):
                self._end_if_replaced()

    def _end_if_replaced(self) -> None:
        other = self._sessions.successor_of(self._session)
        if other is not None and other.may_live(self._session.host):
            shared = [tray for tray in self._session.trays or other.trays if other.has(tray)]
            raise StageError(
                f"{self._session.name} ends: {other.name}, {other.process}, has {trays_in_words(shared)} and started "
                "later; stop one of them, or give it other trays"
            )

    def _step_once(self) -> None:
        """Process the next message, or as many as can be at once."""
        if self._due.is_pressing:
            self._steps.step(self._due.pop_of_each() if self.stage.joint and self._due.joins else [self._due.pop()])
        if request := self._due.pop_request():
            self._steps.step([request])

    def _has_caught_up(self) -> bool:
        return not (self._receiver.is_catching_up or self._due) or self._ending.left_s(CAUGHT_UP) < 0
