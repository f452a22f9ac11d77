"""The one loop of all stages, driven with a toy stage over a real bus."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.runtime.runner import TICK_S
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Core
from fantwin.pipeline.site.loss_accounting import losses
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.health import Health, Note, Output
from fantwin.schemas.messages import Command, Grid, Message, Raw
from fantwin.schemas.topics import BY_NAME, tray_key
from tests.support import made_messages
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, TRAY_B, Bench, Passer, Silent, raw, toy


def test_outputs_are_stamped_with_producer_sequence_tray_and_the_position_of_their_main_input(config):
    bench = Bench(toy(), config)
    for tray, t_ns in ((TRAY_A, 10), (TRAY_A, 11), (TRAY_B, 12)):
        bench.feed(tray, t_ns)
    grids = [bench.next(Grid) for _ in range(3)]
    last = bench.end()
    first, second = InputPosition("raw", "feeder", 0, 1, 0), InputPosition("raw", "feeder", 1, 2, 0)
    found = {(g.header.tray, g.header.sequence): (g.t_ns.tolist(), g.header.input_position) for g in grids}
    assert found == {(TRAY_A, 0): ([10], first), (TRAY_A, 1): ([11], second), (TRAY_B, 0): ([12], first)}
    assert {grid.header.producer for grid in grids} == {last.header.producer}


def test_what_waits_for_a_busy_core_comes_to_it_as_one_message(config):
    is_busy, may_go_on = threading.Event(), threading.Event()

    class Busy(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            is_busy.set()
            assert may_go_on.wait(20)
            return super().step(item)

    bench = Bench(toy(lambda _context: BuiltStage(Busy())), config)
    bench.feed(TRAY_A, 9)
    assert is_busy.wait(20)
    publisher = bench.publisher[TRAY_A]
    for t_ns in (10, 11, 12):
        publisher.put(encode(replace(raw(t_ns), header=Header("feeder", publisher.published, TRAY_A))))
    eventually(lambda: bench.runner._inbox.waiting() >= 3, "they wait")
    may_go_on.set()
    grids = [bench.next(Grid) for _ in range(2)]
    last = bench.end()
    assert [grid.t_ns.tolist() for grid in grids] == [[9], [10, 11, 12]]
    assert grids[1].header.input_position == InputPosition("raw", "feeder", 3, 4, 0)
    assert [(line.received, line.missing) for line in last.inputs] == [(4, 0)]


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
    found = [bench.next(Grid)]
    for send in (lambda: bench.feed(TRAY_A, 10), lambda: send_once(bench.bus, "another", 6)):
        send()
        found.append(bench.next(Grid))
    bench.end()
    first = InputPosition("raw", "feeder", 0, 1, 0)
    assert [(grid.t_ns.tolist(), grid.header.input_position) for grid in found] == [
        ([5], None),
        ([10], first),
        ([6], first),
    ]


def waits(health: Health, tray: str) -> bool:
    """Whether input waits of which more grids of a tray may be made."""
    return next(output.has_more for output in health.outputs if output.key == tray_key("s", tray, "grid"))


def test_row_16_a_stage_that_was_held_up_says_that_its_input_is_not_all_processed(config, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.runtime.runner.HEALTH_PERIOD_S", 0.0)
    may_step, is_held = threading.Semaphore(0), threading.Event()

    class HeldUp(Answers):
        def step(self, item):
            is_held.set()
            assert may_step.acquire(timeout=20)
            return super().step(item)

    bench = Bench(toy(lambda _context: BuiltStage(HeldUp())), config)
    try:
        assert not waits(bench.next(Health), TRAY_A)
        for number in range(3):
            bench.feed(TRAY_A, number)
        assert is_held.wait(20)
        eventually(lambda: bench.runner._reports._has_more(TRAY_A), "another one has arrived")
        threading.Event().wait(2 * TICK_S)
        may_step.release()
        healths = [bench.next(Health)]
        while not any(line.received for line in healths[-1].inputs):
            healths.append(bench.next(Health))
    finally:
        may_step.release(2)
    last = bench.end()
    assert waits(healths[-1], TRAY_A)
    assert not waits(healths[-1], TRAY_B)
    assert not waits(last, TRAY_A)


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
    outputs = (Output(key=tray_key("s", TRAY_A, "raw"), published=5),)
    sent = made_messages.health("acquisition", TRAY_A, "feeder", outputs=outputs, process_id=1)
    follower = replace(last, header=Header("follower", 0, ""), inputs=(), counters=(), lost=0, process_id=2)
    killed = replace(killed, counters=(), lost=0)
    launched = {(f"acquisition/{TRAY_A}", 1), ("resampler", 2), ("resampler", killed.process_id)}
    assert losses([sent, killed, follower], launched)["resampler"] == 5


def test_a_topic_declared_undecoded_reaches_the_core_with_its_header_only_and_in_sequence(config):
    holder = Holder()
    bench = Bench(toy(lambda _context: BuiltStage(holder), undecoded=("raw",)), config)
    bench.feed(TRAY_A, 0)
    broken = encode(replace(raw(1), header=Header("feeder", 1, TRAY_A))) + b"\xff"
    bench.publisher[TRAY_A].put(broken)
    eventually(lambda: len(holder.held) == 2, "both reach the core")
    first, second = holder.held
    assert (first.header.sequence, first.message.header.sequence) == (0, 0)
    assert second.header.sequence == 1 and second.payload == broken
    assert all(counter.name != "undecodable" for counter in bench.end().counters)


def test_what_a_core_does_not_want_of_an_undecoded_topic_is_not_read_and_is_no_loss(config, monkeypatch):
    holder, answers = Holder(), iter((True, False, True))
    monkeypatch.setattr(holder, "wants", lambda _tray: next(answers))
    bench = Bench(toy(lambda _context: BuiltStage(holder), undecoded=("raw",)), config)
    for number in range(3):
        bench.feed(TRAY_A, number)
    eventually(lambda: len(holder.held) == 2, "two of three reach the core")
    assert [envelope.header.sequence for envelope in holder.held] == [0, 2]
    (line,) = (each for each in bench.end().inputs if each.key == tray_key("s", TRAY_A, "raw"))
    assert (line.received, line.missing) == (2, 0)


def test_row_18_undecodable_bytes_of_a_stranger_are_counted_and_are_no_loss_of_the_stage(config):
    bench = Bench(toy(), config)
    bench.publisher[TRAY_A]._publisher.put(b"\xff\xff\xff")
    bench.feed(TRAY_A, 1)
    assert bench.next(Grid).t_ns.tolist() == [1]
    last = bench.end()
    assert {c.name: c.value for c in last.counters}["undecodable"] == 1
    assert Note(tray="", text=f"messages that cannot be read: 1 on raw of {TRAY_A}") in last.notes
    assert last.lost == 4  # the counters of the two cores


def test_only_topics_that_are_read_as_configured_of_configured_trays_are_heard(config):
    contexts: list[Context] = []

    def build(context: Context) -> BuiltStage:
        contexts.append(context)
        return BuiltStage(Passer())

    def choose(section: object, trays: Sequence[TrayConfig]) -> Sequence[str]:
        assert section == config.sections["resampler"] and trays == config.trays
        return ("raw",)

    bench = Bench(toy(build, reads=("raw", "command"), chooses=choose), config)
    send_once(bench.bus, "operator", 1)
    stranger = bench.bus.publisher(tray_key("s", "stranger", "raw"), BY_NAME["raw"], type_name(Raw), "x")
    stranger.put(encode(replace(raw(1), header=Header("x", 0, "stranger"))))
    bench.feed(TRAY_A, 1)
    bench.next(Grid)
    last = bench.end()
    assert [line.key for line in last.inputs] == [tray_key("s", TRAY_A, "raw")]
    assert contexts[0].reads == ("raw",)


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


def test_a_stage_that_may_drop_discards_its_oldest_items_and_counts_them(config, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.runtime.inbox.INBOX_SIZE", 100)
    release, newest = threading.Event(), threading.Event()
    taken: list[int] = []
    count = 300

    class Slow(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            release.wait(600)
            taken.extend(item.host_receive_t_ns.tolist())  # what is left beside a gap may come joined
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


@pytest.mark.parametrize("declared", [{"reads": ("rwa",)}, {"writes": ("gird",)}])
def test_a_stage_with_an_unknown_topic_is_refused_when_it_is_declared(declared):
    with pytest.raises(ValueError, match="stage 'resampler': no such topic: (rwa|gird); known: raw, "):
        toy(**declared)
