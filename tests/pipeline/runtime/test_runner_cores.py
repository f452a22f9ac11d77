"""The cores and sources of a stage: one for each tray or for all, and those that crash."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import pytest

from fantwin.pipeline.runtime.inbox import INBOX_SIZE
from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.stage import Admitted, BuiltStage, Context, Core, StageError
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Grid, Message, Raw
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, TRAY_B, Bench, Burst, Passer, raw, toy


class Joined(Passer):
    """A core whose blocks are processed in one pass with those of other trays; the first one waits."""

    busy, may_go_on = threading.Event(), threading.Event()
    aborted: ClassVar[list[str]] = []

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name

    def step(self, item: Any) -> Sequence[Message]:
        self.busy.set()
        assert self.may_go_on.wait(20)
        return super().step(item)

    def admit(self, item: Any) -> Admitted:
        return Admitted((), item, "all")

    def abort(self) -> None:
        self.aborted.append(self.name)


class InOnePass:
    """Processes blocks of Joined."""

    passes: ClassVar[list[int]] = []

    def process(self, cores: Sequence[Joined], blocks: Sequence[Raw]) -> Sequence[Message]:
        self.passes.append(len(cores))
        if any(int(block.host_receive_t_ns[0]) < 0 for block in blocks):
            raise ZeroDivisionError("on purpose")
        return [message for core, block in zip(cores, blocks, strict=True) for message in core.step(block)]


@pytest.mark.parametrize("raises", [False, True])
def test_what_waits_of_several_trays_is_processed_in_one_pass(config, raises):
    for event in (Joined.busy, Joined.may_go_on):
        event.clear()
    Joined.aborted.clear()
    InOnePass.passes.clear()
    stage = toy(lambda context: BuiltStage(Joined(context.tray.name)), joint=InOnePass)
    bench = Bench(stage, config)
    bench.feed(TRAY_A, 1)
    assert Joined.busy.wait(20)
    for tray, t_ns in ((TRAY_B, -2 if raises else 2), (TRAY_A, 3), (TRAY_B, 4)):
        bench.feed(tray, t_ns)
    eventually(lambda: bench.runner._inbox.waiting() >= 3, "they wait")
    Joined.may_go_on.set()
    if raises:
        bench.thread.join(20)
        bench.bus.close()
        assert bench.crashes
        assert sorted(Joined.aborted) == [TRAY_A, TRAY_B], "each may be half updated"
        return
    grids = [bench.next(Grid) for _ in range(4)]
    bench.end()
    assert InOnePass.passes == [2]
    found = [(grid.header.tray, int(grid.t_ns[0]), grid.header.input_position) for grid in grids]
    assert found == [
        (TRAY_A, 1, InputPosition("raw", "feeder", 0, 1, 0)),
        (TRAY_B, 2, InputPosition("raw", "feeder", 0, 1, 0)),
        (TRAY_A, 3, InputPosition("raw", "feeder", 1, 2, 0)),
        (TRAY_B, 4, InputPosition("raw", "feeder", 1, 2, 0)),
    ]


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
    assert _published(crash, "grid") == {TRAY_A: 1, TRAY_B: 2}
    assert _published(crash, "consumed") == {TRAY_A: 1, TRAY_B: 2}, "the first grid of each, and the last, by a timer"
    assert CrashesOnce.saved == {TRAY_A: 2, TRAY_B: 1}
    assert _published(last, "grid") == {TRAY_A: 3, TRAY_B: 0}


def _published(health: Health, topic: str) -> dict[str, int]:
    keys = ((output.key.split("/"), output.published) for output in health.outputs)
    return {tray: published for (*_, tray, name), published in keys if name == topic}


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


@pytest.mark.parametrize(
    ("tray", "declared", "why"),
    [
        ("", {}, "'resampler' serves all trays and returned a grid without one: set header"),
        (TRAY_B, {"writes": ()}, "message of topic 'grid': add it to `writes` of its declaration"),
    ],
)
def test_an_output_without_a_tray_or_a_declaration_is_refused_in_one_line(config, tray, declared, why):
    stop = threading.Event()
    stop.set()
    stage = toy(lambda _context: BuiltStage(OfAllTrays(tray)), core_per_tray=False, **declared)
    with pytest.raises(StageError, match=why):
        Runner(stage, config, None, stop).run()


def test_items_that_sources_deliver_while_stopping_come_to_the_core_of_their_tray_before_the_end(config):
    def build(context: Context) -> BuiltStage:
        first = 0 if context.tray.name == TRAY_A else 100
        return BuiltStage(Passer(), Burst([raw(first + number) for number in range(50)]))

    bench = Bench(toy(build, reads=()), config)
    last = bench.end()
    grids: dict[str, list[int]] = {TRAY_A: [], TRAY_B: []}
    while not bench.heard.empty():
        _, message = bench.heard.get()
        if isinstance(message, Grid):
            grids[message.header.tray] += message.t_ns.tolist()
    assert grids == {TRAY_A: [*range(50), -1], TRAY_B: [*range(100, 150), -1]}
    assert last.status == StageStatus.STOPPED
    assert _published(last, "grid") == {TRAY_A: 51, TRAY_B: 51}


def test_a_stage_that_crashes_with_a_full_inbox_says_why_and_leaves_the_bus_at_once(config):
    fed = threading.Event()

    class BrokenLater(Passer):
        def step(self, item: Any) -> Sequence[Message]:
            fed.wait(20)
            raise ZeroDivisionError("on purpose")

    bench = Bench(toy(lambda _context: BuiltStage(BrokenLater())), config)
    for t_ns in range(INBOX_SIZE + 100):
        bench.feed(TRAY_A, t_ns)
    fed.set()
    last = bench.health_with(lambda health: "crashed" in health.problem)
    bench.thread.join(20)
    bench.bus.close()
    assert not bench.thread.is_alive()
    assert str(bench.crashes[0]) == "on purpose"  # and not that the bus could not be closed
    assert last.status == StageStatus.DEGRADED
    assert "ZeroDivisionError: on purpose" in last.problem
