"""The one loop of all stages, driven with a toy stage over a real bus."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest

from pipeline.bus.session import Bus
from pipeline.config.models import BusConfig, Config, LauncherConfig, TrayConfig
from pipeline.launch.loss_accounting import losses
from pipeline.runtime.inbox import INBOX_SIZE
from pipeline.runtime.runner import Runner
from pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageConfig, StageError
from schemas.codec import decode, encode, type_name
from schemas.envelope import Envelope
from schemas.messages import Command, Grid, Header, Health, InputPosition, Message, Output, Raw, StageStatus
from schemas.topics import BY_NAME, alive_key, health_key, tray_key
from tests.support.running_chain import eventually

TRAY_A, TRAY_B = "a", "b"


class ToyConfig(StageConfig):
    """Nothing to configure."""


class Passer(Core):
    """Returns a Grid for each Raw, and one more at the end, so that a test sees that `close` was called."""

    def __init__(self) -> None:
        self.fans = 0

    def step(self, item: Any) -> Sequence[Message]:
        self.fans = item.fans
        return [self.grid(item.host_receive_t_ns)] if isinstance(item, Raw) else []

    def close(self) -> Sequence[Message]:
        return [self.grid(np.array([-1]))] if self.fans else []

    def counters(self):
        return {"lost_on_purpose": 2, "seen": 5}

    def problem(self) -> str:
        return ""

    def grid(self, t_ns: Any) -> Grid:
        t_ns = np.asarray(t_ns)
        column = np.zeros((len(t_ns), self.fans))
        states = {"valid": column == 0, "invalid_reason": column.astype(np.uint8)}
        return Grid(fans=self.fans, period_ns=1, t_ns=t_ns, command=column, speed_rad_s=column, **states)


class Silent(Passer):
    """Returns nothing."""

    def step(self, item: Any) -> Sequence[Message]:
        return []


class Burst:
    """A source that delivers its items while it is being stopped: the hardest moment."""

    def __init__(self, items: Sequence[Any]) -> None:
        self.items = items

    def start(self, deliver: Callable[[Any], None]) -> None:
        self.deliver = deliver

    def stop(self) -> None:
        for item in self.items:
            self.deliver(item)


def toy(build: Callable[[Context], BuiltStage] = lambda _context: BuiltStage(Passer()), **declared: Any) -> Stage:
    defaults = {"name": "resampler", "about": "", "reads": ("raw",), "writes": ("grid",), "config": ToyConfig}
    return Stage(**{**defaults, **declared}, build=build)


@pytest.fixture
def config(endpoint, tmp_path) -> Config:
    return Config(
        path=tmp_path / "fan.toml",
        text="",
        overrides=(),
        site="s",
        run_folder=tmp_path,
        bus=BusConfig(endpoint=endpoint),
        launcher=LauncherConfig(),
        stages=("acquisition", "resampler"),
        trays=tuple(TrayConfig(name=name, fans=1) for name in (TRAY_A, TRAY_B)),
        sections={"resampler": ToyConfig(), "acquisition": ToyConfig()},
    )


def raw(t_ns: int) -> Raw:
    return Raw(fans=1, host_receive_t_ns=np.array([t_ns]), command=np.zeros((1, 1)), speed_rad_s=np.zeros((1, 1)))


class Bench:
    """A stage running in a thread, and a second session on the bus that feeds it and listens."""

    def __init__(self, stage: Stage, config, tray: str | None = None) -> None:
        self.stop = threading.Event()
        self.heard: queue.Queue[tuple[str, Message]] = queue.Queue()
        self.bus = Bus(config.bus)
        self.bus.subscribe(tray_key("s", "*", "grid"), self._hear(Grid))
        self.bus.subscribe(health_key("s", "*", "*"), self._hear(Health))
        self.publisher = {
            name: self.bus.publisher(tray_key("s", name, "raw"), BY_NAME["raw"], type_name(Raw), "feeder")
            for name in (TRAY_A, TRAY_B)
        }
        self.runner = Runner(stage, config, tray, self.stop)
        self.last: list[Health] = []
        self.crashes: list[ZeroDivisionError] = []
        self.thread = threading.Thread(target=self._run)
        self.thread.start()
        self.health_with(lambda health: health.status == StageStatus.OK)

    def _run(self) -> None:
        try:
            self.last.append(self.runner.run())
        except ZeroDivisionError as crash:
            self.crashes.append(crash)

    def _hear(self, kind: type[Message]) -> Callable[[str, bytes], None]:
        return lambda key, payload: self.heard.put((key, decode(kind, payload)))

    def feed(self, tray: str, t_ns: int) -> None:
        publisher = self.publisher[tray]
        publisher.put(encode(replace(raw(t_ns), header=Header("feeder", publisher.published, tray))))

    def next(self, kind: type[Message]) -> Any:
        while True:
            _, message = self.heard.get(timeout=20)
            if isinstance(message, kind):
                return message

    def health_with(self, fits: Callable[[Health], bool]) -> Health:
        while True:
            health = self.next(Health)
            if fits(health):
                return health

    def end(self) -> Health:
        self.stop.set()
        self.thread.join(20)
        self.bus.close()
        return self.last[0]


def test_outputs_are_stamped_with_producer_sequence_and_tray(config):
    bench = Bench(toy(), config)
    for t_ns in (10, 11):
        bench.feed(TRAY_A, t_ns)
    first, second = bench.next(Grid), bench.next(Grid)
    last = bench.end()
    assert [first.header.sequence, second.header.sequence] == [0, 1]
    assert first.header.tray == TRAY_A
    assert first.header.producer == last.header.producer
    assert first.t_ns.tolist() == [10]


def test_an_output_carries_the_position_of_its_main_input(config):
    bench = Bench(toy(), config)
    for t_ns in (10, 11):
        bench.feed(TRAY_A, t_ns)
    bench.feed(TRAY_B, 12)
    positions = [bench.next(Grid).header.input_position for _ in range(3)]
    bench.end()
    assert positions == [
        InputPosition("raw", "feeder", 0, 1, 0),
        InputPosition("raw", "feeder", 1, 2, 0),
        InputPosition("raw", "feeder", 0, 1, 0),
    ]


def test_an_output_made_because_time_passed_says_so(config):
    class Waits(Core):
        def __init__(self) -> None:
            self.held: list[Grid] = []

        def step(self, item: Raw) -> list[Grid]:
            passer = Passer()
            passer.fans = item.fans
            self.held.append(passer.grid(item.host_receive_t_ns))
            return []

        def tick(self, now_ns: int) -> list[Grid]:
            held, self.held = self.held, []
            return held

    bench = Bench(toy(lambda _context: BuiltStage(Waits())), config)
    bench.feed(TRAY_A, 10)
    position = bench.next(Grid).header.input_position
    bench.end()
    assert position == InputPosition("raw", "feeder", 0, 1, 0, from_timer=True)


class Answers(Passer):
    """Reads commands besides raw samples, and makes a grid of each of them too."""

    def step(self, item: Any) -> Sequence[Message]:
        self.fans = item.fans
        return [self.grid([item.t_ns])] if isinstance(item, Command) else super().step(item)


def send_once(bus: Bus, producer: str, t_ns: int) -> None:
    publisher = bus.publisher(tray_key("s", TRAY_A, "command"), BY_NAME["command"], type_name(Command), producer)
    publisher.put(encode(Command(header=Header(producer, 0, TRAY_A), fans=1, t_ns=t_ns)))


def test_a_side_input_does_not_advance_the_input_position(config):
    bench = Bench(toy(lambda _context: BuiltStage(Answers()), reads=("raw", "command")), config)
    send_once(bench.bus, "operator", 5)
    bench.feed(TRAY_A, 10)
    send_once(bench.bus, "another", 6)
    bench.feed(TRAY_A, 11)
    grids = [bench.next(Grid) for _ in range(4)]
    bench.end()
    first = InputPosition("raw", "feeder", 0, 1, 0)
    assert [grid.t_ns.tolist() for grid in grids] == [[5], [10], [6], [11]]
    assert [grid.header.input_position for grid in grids] == [
        None,
        first,
        first,
        InputPosition("raw", "feeder", 1, 2, 0),
    ]


def test_a_producer_that_publishes_one_message_and_leaves_causes_no_loss(config):
    class Careful(Answers):
        def counters(self):
            return {}

    bench = Bench(toy(lambda _context: BuiltStage(Careful()), reads=("raw", "command")), config)
    for number in range(3):  # sessions that nobody has a word of health from
        with Bus(config.bus) as visitor:
            met = threading.Event()
            visitor.subscribe(health_key("s", "*", "*"), lambda _key, _payload, met=met: met.set())
            assert met.wait(20)
            send_once(visitor, f"visitor-{number}", number)
            assert bench.next(Grid).t_ns.tolist() == [number]
    health = bench.health_with(lambda health: len(health.inputs) == 3)
    last = bench.end()
    for reported, status in ((health, StageStatus.OK), (last, StageStatus.STOPPED)):
        assert (reported.status, reported.problem, reported.lost) == (status, "", 0)
        assert [(line.received, line.missing, line.duplicated) for line in reported.inputs] == [(1, 0, 0)] * 3
    assert losses([health, last]) == {"resampler": 0}


def test_each_tray_has_its_own_core_and_sequence(config):
    bench = Bench(toy(), config)
    bench.feed(TRAY_A, 1)
    bench.feed(TRAY_B, 2)
    got = {(g.header.tray, g.header.sequence) for g in (bench.next(Grid), bench.next(Grid))}
    bench.end()
    assert got == {(TRAY_A, 0), (TRAY_B, 0)}


def test_health_accounts_for_inputs_outputs_counters_and_losses(config):
    bench = Bench(toy(), config)
    for t_ns in range(5):
        bench.feed(TRAY_A, t_ns)
    bench.publisher[TRAY_A].published += 3  # three that were never sent, nor kept
    bench.feed(TRAY_A, 9)
    health = bench.health_with(lambda h: any(line.received == 6 for line in h.inputs))
    bench.end()
    (line,) = health.inputs
    assert (line.missing, line.duplicated, line.next_sequence) == (3, 0, 9)
    assert {counter.name: counter.value for counter in health.counters} == {"lost_on_purpose": 4, "seen": 10}
    assert health.lost == 3 + 4  # missing messages, and the counters of two cores
    assert {output.key: output.published for output in health.outputs}[tray_key("s", TRAY_A, "grid")] == 6


class Holder(Silent):
    """Like a recorder: it keeps messages in memory until its end."""

    def __init__(self) -> None:
        super().__init__()
        self.held: list[Envelope] = []

    def step(self, item: Any) -> Sequence[Message]:
        self.held.append(item)
        return []

    def close(self) -> Sequence[Message]:
        self.held.clear()
        return []

    def unsaved(self) -> Sequence[Envelope]:
        return self.held


def test_row_18_what_a_killed_stage_had_received_and_not_saved_is_lost_if_nobody_can_send_it_again(config):
    bench = Bench(toy(lambda _context: BuiltStage(Holder()), wants_envelopes=True), config)
    for t_ns in range(5):
        bench.feed(TRAY_A, t_ns)
    killed = bench.health_with(lambda health: any(line.received == 5 for line in health.inputs))
    last = bench.end()
    assert [line.unsaved for line in (*killed.inputs, *last.inputs)] == [5, 0]
    sent = Health(
        header=Header("feeder", 0, ""),
        stage="acquisition",
        instance=TRAY_A,
        status=StageStatus.OK,
        t_ns=1,
        uptime_s=0,
        outputs=(Output(key=tray_key("s", TRAY_A, "raw"), published=5),),
        process_id=1,
    )
    follower = replace(last, header=Header("follower", 0, ""), inputs=(), counters=(), lost=0, process_id=2)
    killed = replace(killed, counters=(), lost=0)
    launched = {(f"acquisition/{TRAY_A}", 1), ("resampler", 2), ("resampler", killed.process_id)}
    assert losses([sent, killed, follower], launched)["resampler"] == 5


def test_row_18_undecodable_bytes_of_a_stranger_are_counted_and_are_no_loss_of_the_stage(config):
    bench = Bench(toy(), config)
    bench.publisher[TRAY_A]._publisher.put(b"\xff\xff\xff")
    bench.feed(TRAY_A, 1)
    assert bench.next(Grid).t_ns.tolist() == [1]
    last = bench.end()
    assert {c.name: c.value for c in last.counters}["undecodable"] == 1
    assert last.lost == 4  # the counters of the two cores


def test_items_a_source_delivers_while_stopping_are_processed_before_the_end(config):
    items = [raw(t_ns) for t_ns in range(50)]
    stage = toy(lambda _context: BuiltStage(Passer(), Burst(items)), name="acquisition")
    bench = Bench(stage, config, TRAY_A)
    last = bench.end()
    grids = []
    while not bench.heard.empty():
        grids += [m.t_ns.tolist() for _, m in [bench.heard.get()] if isinstance(m, Grid)]
    assert grids == [[t] for t in range(50)] + [[-1]]
    assert last.status == StageStatus.STOPPED
    assert last.outputs[0].published == 51


def test_messages_of_trays_that_are_not_configured_are_not_read(config):
    bench = Bench(toy(reads=("command",)), config)
    publisher = bench.bus.publisher(tray_key("s", "stranger", "command"), BY_NAME["command"], type_name(Command), "x")
    publisher.put(encode(Command(header=Header("x", 0, "stranger"), fans=1, t_ns=0)))
    last = bench.end()
    assert last.inputs == ()


def test_a_stage_that_may_drop_recovers_messages_published_on_change(config):
    stage = toy(lambda _context: BuiltStage(Silent()), reads=("command", "raw"), may_drop=True)
    bench = Bench(stage, config)
    for topic, kind in (("command", Command), ("raw", Raw)):
        publisher = bench.bus.publisher(tray_key("s", TRAY_A, topic), BY_NAME[topic], type_name(kind), "x")
        for sequence in (0, 1):
            header = Header("x", sequence, TRAY_A)
            message = Command(header=header, fans=1, t_ns=0) if kind is Command else replace(raw(1), header=header)
            if sequence == 0:  # sent before this stage was there
                publisher._kept.append((0, encode(message)))
                publisher.published = 1
            else:
                publisher.put(encode(message))
    inputs = bench.health_with(lambda health: len(health.inputs) == 2).inputs
    bench.end()
    assert {line.key.split("/")[-1]: line.received for line in inputs} == {"command": 2, "raw": 1}


def test_a_stage_that_may_drop_discards_its_oldest_items_and_counts_them(config):
    release, newest = threading.Event(), threading.Event()
    taken: list[int] = []
    count = 6000

    class Slow(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            release.wait(20)
            taken.append(int(item.host_receive_t_ns[0]))
            if taken[-1] == count - 1:
                newest.set()
            return []

    bench = Bench(toy(lambda _context: BuiltStage(Slow()), may_drop=True), config)
    for t_ns in range(count):
        bench.feed(TRAY_A, t_ns)
    eventually(lambda: bench.runner._inbox.dropped, "the inbox has overflowed")
    release.set()
    assert newest.wait(20)
    last = bench.end()
    counters = {c.name: c.value for c in last.counters}
    assert taken == sorted(taken)
    assert counters["dropped"] > 0
    assert last.inputs[0].missing == count - len(taken)
    assert last.lost == 4  # the counters of the two cores: what it may drop is no loss


def test_a_stage_stops_while_its_producer_continues(config):
    bench = Bench(toy(), config)
    enough = threading.Event()

    def feed_on() -> None:
        t_ns = 0
        while not enough.wait(0.002):
            bench.feed(TRAY_A, t_ns)
            t_ns += 1

    feeder = threading.Thread(target=feed_on)
    feeder.start()
    bench.next(Grid)
    bench.stop.set()
    bench.thread.join(20)
    stopped = not bench.thread.is_alive()
    enough.set()
    feeder.join()
    bench.end()
    assert stopped


def test_the_last_health_of_a_stage_that_crashed_says_why(config):
    class Broken(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            raise ZeroDivisionError("on purpose")

    bench = Bench(toy(lambda _context: BuiltStage(Broken())), config)
    bench.feed(TRAY_A, 1)
    last = bench.health_with(lambda health: "crashed" in health.problem)
    bench.thread.join(20)
    bench.bus.close()
    assert bench.crashes
    assert last.status == StageStatus.DEGRADED
    assert "ZeroDivisionError: on purpose" in last.problem


class CrashesOnce(Passer):
    """Like a scorer: it keeps a snapshot (in `saved`) that `close` updates. Crashes on the sample `crash_t_ns`."""

    saved: ClassVar[dict[str, int]] = {}

    def __init__(self, tray: str, crash_t_ns: int) -> None:
        super().__init__()
        self.tray, self.crash_t_ns = tray, crash_t_ns
        self.last_t_ns = self.saved.get(tray, 0)
        self.aborted = False

    def step(self, item: Any) -> Sequence[Message]:
        t_ns = int(item.host_receive_t_ns[0])
        if t_ns <= self.last_t_ns:
            return []
        self.last_t_ns = t_ns  # the state advances before all of it is processed
        if t_ns == self.crash_t_ns:
            raise ZeroDivisionError("on purpose")
        return super().step(item)

    def close(self) -> Sequence[Message]:
        self.saved[self.tray] = self.last_t_ns
        return super().close()

    def abort(self) -> None:
        self.aborted = True


def test_a_crashed_core_saves_and_publishes_nothing_and_its_successor_gets_the_message_again(config):
    CrashesOnce.saved.clear()
    cores: dict[str, CrashesOnce] = {}

    def build(context: Context, crash_t_ns: int = 2) -> BuiltStage:
        cores[context.tray.name] = CrashesOnce(context.tray.name, crash_t_ns)
        return BuiltStage(cores[context.tray.name])

    bench = Bench(toy(build), config)
    bench.feed(TRAY_B, 1)
    bench.feed(TRAY_A, 1)
    bench.feed(TRAY_A, 2)
    crash = bench.health_with(lambda health: "crashed" in health.problem)
    bench.thread.join(20)
    crashed, saved = cores[TRAY_A], dict(CrashesOnce.saved)
    stop = threading.Event()
    successor = Runner(toy(lambda context: build(context, crash_t_ns=-1)), config, None, stop)
    stop.set()
    last = successor.run()  # it catches up before it looks at `stop`
    bench.bus.close()
    assert crashed.aborted
    assert saved == {TRAY_B: 1}, "only the core of the other tray was closed"
    assert {output.key.split("/")[2]: output.published for output in crash.outputs} == {TRAY_A: 1, TRAY_B: 2}
    assert CrashesOnce.saved == {TRAY_A: 2, TRAY_B: 1}
    assert {output.key.split("/")[2]: output.published for output in last.outputs} == {TRAY_A: 3, TRAY_B: 0}


class OfAllTrays(Core):
    """One core for all trays that publishes from `step`, `tick` and `close`."""

    def __init__(self, tray: str = TRAY_B) -> None:
        self.header = Header("", 0, tray)
        self.seen = 0
        self.due: list[Grid] = []

    def grid(self, t_ns: int) -> Grid:
        passer = Passer()
        passer.fans = 1
        return replace(passer.grid([t_ns]), header=self.header)

    def step(self, item: Any) -> Sequence[Message]:
        self.due.append(self.grid(200))
        return [replace(self.grid(100), header=Header("", 0, ""))]

    def tick(self, now_ns: int) -> Sequence[Message]:
        due, self.due = self.due, []
        return due

    def close(self) -> Sequence[Message]:
        return [self.grid(300)]


def test_a_core_of_all_trays_publishes_from_tick_and_close_for_the_tray_in_the_header(config):
    bench = Bench(toy(lambda _context: BuiltStage(OfAllTrays()), core_per_tray=False), config)
    bench.feed(TRAY_A, 1)
    grids = [bench.next(Grid), bench.next(Grid)]
    bench.stop.set()
    grids.append(bench.next(Grid))
    bench.end()
    assert [(grid.header.tray, grid.t_ns.tolist()) for grid in grids] == [
        (TRAY_A, [100]),
        (TRAY_B, [200]),
        (TRAY_B, [300]),
    ]


def test_an_output_without_a_tray_is_refused_in_one_line(config):
    stop = threading.Event()
    stop.set()
    runner = Runner(toy(lambda _context: BuiltStage(OfAllTrays("")), core_per_tray=False), config, None, stop)
    with pytest.raises(StageError, match="'resampler' serves all trays and returned a grid without one: set header"):
        runner.run()


def test_an_output_that_is_not_declared_is_refused_in_one_line(config):
    stop = threading.Event()
    stop.set()
    runner = Runner(toy(lambda _context: BuiltStage(OfAllTrays()), core_per_tray=False, writes=()), config, None, stop)
    with pytest.raises(StageError, match="message of topic 'grid': add it to `writes` of its declaration"):
        runner.run()


@pytest.mark.parametrize("declared", [{"reads": ("rwa",)}, {"writes": ("gird",)}])
def test_a_stage_with_an_unknown_topic_is_refused_when_it_is_declared(declared):
    with pytest.raises(ValueError, match="stage 'resampler': no such topic: (rwa|gird); known: raw, grid"):
        toy(**declared)


def test_sources_in_one_process_for_all_trays_feed_each_the_core_of_its_tray(config):
    def build(context: Context) -> BuiltStage:
        return BuiltStage(Passer(), Burst([raw(1 if context.tray.name == TRAY_A else 2)]))

    bench = Bench(toy(build, reads=()), config)
    bench.end()
    grids = []
    while not bench.heard.empty():
        grids += [(m.header.tray, m.t_ns.tolist()) for _, m in [bench.heard.get()] if isinstance(m, Grid)]
    assert sorted(grids) == [(TRAY_A, [-1]), (TRAY_A, [1]), (TRAY_B, [-1]), (TRAY_B, [2])]


def test_a_stage_that_crashes_with_a_full_inbox_leaves_the_bus_at_once(config):
    fed = threading.Event()

    class BrokenLater(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            fed.wait(20)
            raise ZeroDivisionError("on purpose")

    bench = Bench(toy(lambda _context: BuiltStage(BrokenLater())), config)
    for t_ns in range(INBOX_SIZE + 500):
        bench.feed(TRAY_A, t_ns)
    fed.set()
    bench.thread.join(20)
    bench.bus.close()
    assert not bench.thread.is_alive()
    assert str(bench.crashes[0]) == "on purpose"  # and not that the bus could not be closed


def test_a_stage_whose_launcher_has_gone_runs_until_its_producers_have_ended(config):
    bench = Bench(toy(), config)
    with Bus(config.bus) as feeder:
        key, stage = health_key("s", "acquisition", TRAY_A), ("acquisition", TRAY_A)
        health = Health(
            header=Header("feeder", 0, ""),
            stage=stage[0],
            instance=stage[1],
            status=StageStatus.OK,
            t_ns=0,
            uptime_s=0.0,
            outputs=(Output(key=tray_key("s", TRAY_A, "raw"), published=0),),
        )
        feeder.declare_alive(alive_key("s", *stage))
        publisher = feeder.publisher(key, BY_NAME["health"], type_name(Health), "feeder")
        while not bench.runner._peers.has_producer():  # until they have discovered each other
            publisher.put(encode(health))
            bench.next(Health)
        bench.runner.launcher_gone.set()
        last = None
        for _ in range(3):  # seconds in which it could have ended
            last = bench.health_with(lambda h: h.stage == "resampler")
            if last.status == StageStatus.STOPPED:
                break
    bench.thread.join(20)
    ended_by_itself = not bench.thread.is_alive()
    bench.end()
    assert last and last.status == StageStatus.OK, "it ended while there was still somebody to read from"
    assert ended_by_itself
