"""The one loop of all stages, driven with a toy stage over a real bus."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.bus.session import Bus
from pipeline.config.models import BusConfig, Config, LauncherConfig, TrayConfig
from pipeline.launch.loss_accounting import losses
from pipeline.runtime.runner import INBOX_SIZE, Runner
from pipeline.runtime.stage import Context, Core, Parts, Stage, StageConfig
from schemas.codec import decode, encode, type_name
from schemas.messages import Command, Grid, Header, Health, InputPosition, Message, Output, Raw, StageStatus
from schemas.topics import BY_NAME, alive_key, health_key, tray_key
from tests.support.running_chain import eventually

TRAY_A, TRAY_B = "a", "b"


class ToyConfig(StageConfig):
    """Nothing to configure."""


class Passer(Core):
    """Makes a Grid of every Raw; at the end one more, so that a test sees `close` was called."""

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


class Deaf(Passer):
    """Makes nothing of anything."""

    def step(self, item: Any) -> Sequence[Message]:
        return []


class Burst:
    """A source that delivers its items when it is told to stop: the hardest moment."""

    def __init__(self, items: Sequence[Any]) -> None:
        self.items = items

    def start(self, deliver: Callable[[Any], None]) -> None:
        self.deliver = deliver

    def stop(self) -> None:
        for item in self.items:
            self.deliver(item)


def toy(build: Callable[[Context], Parts] = lambda _context: Parts(Passer()), **declared: Any) -> Stage:
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


def test_an_output_says_what_had_been_taken_when_it_was_made(config):
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


def test_what_is_made_because_time_has_passed_says_so(config):
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

    bench = Bench(toy(lambda _context: Parts(Waits())), config)
    bench.feed(TRAY_A, 10)
    position = bench.next(Grid).header.input_position
    bench.end()
    assert position == InputPosition("raw", "feeder", 0, 1, 0, from_timer=True)


class Answers(Passer):
    """Reads commands beside its raw samples, and makes a grid of each of them, too."""

    def step(self, item: Any) -> Sequence[Message]:
        self.fans = item.fans
        return [self.grid([item.t_ns])] if isinstance(item, Command) else super().step(item)


def send_once(bus: Bus, producer: str, t_ns: int) -> None:
    publisher = bus.publisher(tray_key("s", TRAY_A, "command"), BY_NAME["command"], type_name(Command), producer)
    publisher.put(encode(Command(header=Header(producer, 0, TRAY_A), fans=1, t_ns=t_ns)))


def test_a_side_input_becomes_no_cause_and_does_not_count_as_taken(config):
    bench = Bench(toy(lambda _context: Parts(Answers()), reads=("raw", "command")), config)
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


def test_a_producer_that_says_one_thing_and_leaves_is_heard_and_no_loss(config):
    class Careful(Answers):
        def counters(self):
            return {}

    bench = Bench(toy(lambda _context: Parts(Careful()), reads=("raw", "command")), config)
    for number in range(3):  # sessions that nobody has a word of health from
        with Bus(config.bus) as visitor:
            met = threading.Event()
            visitor.subscribe(health_key("s", "*", "*"), lambda _key, _payload, met=met: met.set())
            assert met.wait(20)
            send_once(visitor, f"visitor-{number}", number)
            assert bench.next(Grid).t_ns.tolist() == [number]
    health = bench.health_with(lambda health: len(health.inputs) == 3)
    last = bench.end()
    for said, status in ((health, StageStatus.OK), (last, StageStatus.STOPPED)):
        assert (said.status, said.problem, said.lost) == (status, "", 0)
        assert [(line.received, line.missing, line.duplicated) for line in said.inputs] == [(1, 0, 0)] * 3
    assert losses([health, last]) == {"resampler": 0}


def test_each_tray_has_a_core_and_a_sequence_of_its_own(config):
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


def test_bytes_that_are_no_message_are_counted_and_harm_nothing(config):
    bench = Bench(toy(), config)
    bench.publisher[TRAY_A]._publisher.put(b"\xff\xff\xff")
    bench.feed(TRAY_A, 1)
    assert bench.next(Grid).t_ns.tolist() == [1]
    assert {c.name: c.value for c in bench.end().counters}["lost_undecodable"] == 1


def test_what_a_source_still_delivers_when_told_to_stop_is_handled_before_the_end(config):
    items = [raw(t_ns) for t_ns in range(50)]
    stage = toy(lambda _context: Parts(Passer(), Burst(items)), name="acquisition")
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


def test_a_stage_that_may_drop_asks_again_for_what_is_said_once(config):
    stage = toy(lambda _context: Parts(Deaf()), reads=("command", "raw"), may_drop=True)
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


def test_a_stage_that_may_drop_throws_its_oldest_away_and_counts(config):
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

    bench = Bench(toy(lambda _context: Parts(Slow()), may_drop=True), config)
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


def test_a_stage_stops_while_its_producer_goes_on(config):
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


def test_a_stage_that_crashes_says_so_and_not_that_it_stopped_in_order(config):
    class Broken(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            raise ZeroDivisionError("on purpose")

    bench = Bench(toy(lambda _context: Parts(Broken())), config)
    bench.feed(TRAY_A, 1)
    last = bench.health_with(lambda health: "crashed" in health.problem)
    bench.thread.join(20)
    bench.bus.close()
    assert bench.crashes
    assert last.status == StageStatus.DEGRADED
    assert "ZeroDivisionError: on purpose" in last.problem


def test_a_stage_that_crashes_with_a_full_inbox_leaves_the_bus_at_once(config):
    fed = threading.Event()

    class BrokenLater(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            fed.wait(20)
            raise ZeroDivisionError("on purpose")

    bench = Bench(toy(lambda _context: Parts(BrokenLater())), config)
    for t_ns in range(INBOX_SIZE + 500):
        bench.feed(TRAY_A, t_ns)
    fed.set()
    bench.thread.join(20)
    bench.bus.close()
    assert not bench.thread.is_alive()
    assert str(bench.crashes[0]) == "on purpose"  # and not that the bus could not be closed


def test_an_orphaned_stage_goes_on_until_those_it_reads_from_have_ended(config):
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
        while not any(map(bench.runner._is_fed_by, set(bench.runner._alive))):  # until they have met
            publisher.put(encode(health))
            bench.next(Health)
        bench.runner.orphaned.set()
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
