"""The runner while a recording is replayed: which time applies, and what a device must not receive."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.runtime.stage import BuiltStage, Context
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Clock, Command, Grid, Message
from fantwin.schemas.topics import BY_NAME, alive_key, health_key, tray_key
from tests.support import made_messages
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, TRAY_B, Bench, Burst, Passer, toy


class Ticker(Passer):
    """Records the times of its ticks."""

    def __init__(self) -> None:
        super().__init__()
        self.ticks: list[int] = []

    def tick(self, now_ns: int) -> Sequence[Message]:
        self.ticks.append(now_ns)
        return []


class Replay:
    """The part of a replay on the bus of a bench that a stage sees."""

    def __init__(self, config: Config) -> None:
        self.bus = Bus(config.bus)
        self.bus.declare_alive(alive_key("s", "replay", "all"))
        self.clock = self.bus.publisher(tray_key("s", TRAY_A, "clock"), BY_NAME["clock"], type_name(Clock), "replay-1")
        self.health = self.bus.publisher(
            health_key("s", "replay", "all"), BY_NAME["health"], type_name(Health), "replay-1"
        )

    def publish_time(self, t_ns: int, rate: float = 1.0) -> None:
        self._publish_health(StageStatus.OK)
        header = Header("replay-1", self.clock.published, TRAY_A)
        self.clock.put(encode(Clock(header=header, t_ns=t_ns, rate=rate)))

    def stop(self) -> None:
        self._publish_health(StageStatus.STOPPED, is_last=True)

    def _publish_health(self, status: StageStatus, *, is_last: bool = False) -> None:
        about = {"sequence": self.health.published, "status": status, "is_last": is_last}
        self.health.put(encode(made_messages.health("replay", producer="replay-1", **about)))


@pytest.fixture
def tickers(config):
    """A bench whose cores record their ticks, and the two cores."""
    cores: dict[str, Ticker] = {}

    def build(context: Context) -> BuiltStage:
        cores[context.tray.name] = Ticker()
        return BuiltStage(cores[context.tray.name])

    bench = Bench(toy(build), config)
    yield bench, cores[TRAY_A], cores[TRAY_B]
    bench.end()


@pytest.mark.parametrize("leave", [lambda replay: replay.stop(), lambda replay: replay.bus.close()])
def test_ticks_carry_the_time_of_a_replay_until_it_leaves_in_any_way(config, tickers, leave):
    _, core, other = tickers
    replay = Replay(config)
    try:
        for t_ns in (1000, 2000):
            eventually(
                lambda t_ns=t_ns: replay.publish_time(t_ns) or core.ticks[-1] == t_ns, "it ticks in recorded time"
            )
        assert other.ticks[-1] > 1e18, "the other tray is not replayed"
        count = len(core.ticks)
        eventually(lambda: len(core.ticks) > count + 3, "it keeps ticking")
        assert set(core.ticks[count:]) == {2000}, "the time stands still until the replay publishes another"
        leave(replay)
        eventually(lambda: core.ticks[-1] > 1e18, "the host's time applies again")
    finally:
        replay.bus.close()


def test_row_12_a_clock_from_anybody_but_the_replay_is_refused_and_time_goes_on(config, tickers):
    bench, core, _ = tickers
    key = tray_key("s", TRAY_A, "clock")
    stranger = bench.bus.publisher(key, BY_NAME["clock"], type_name(Clock), "replay-forged")
    stranger.put(encode(Clock(header=Header("replay-forged", 0, TRAY_A), t_ns=1000, rate=0.0)))
    health = bench.health_with(lambda h: any(c.name == "refused_clocks" for c in h.counters))
    assert {c.name: c.value for c in health.counters}["refused_clocks"] == 1
    assert min(core.ticks) > 1e18, "the host's time never stopped"


def test_latency_is_measured_in_the_time_of_the_replay_and_not_while_it_is_paused(config, tickers):
    bench, core, _ = tickers
    replay = Replay(config)
    try:
        eventually(lambda: replay.publish_time(10**9, rate=0.0) or core.ticks[-1] == 10**9, "the replay is paused")
        bench.feed(TRAY_A, 1)
        bench.next(Grid)
        eventually(
            lambda: replay.publish_time(2 * 10**9, rate=0.001) or core.ticks[-1] == 2 * 10**9, "it continues slowly"
        )
        bench.feed(TRAY_A, 2 * 10**9 - 5_000_000)
        bench.next(Grid)
        health = bench.health_with(lambda h: h.latency_p99_ms > 0.0)
    finally:
        replay.bus.close()
    assert 5.0 <= health.latency_p50_ms < 100.0, "a thousandth of what passed here, and 5 ms in the recording"


def test_a_stage_with_a_device_refuses_replayed_commands_and_keeps_the_hosts_time(config):
    core = Ticker()
    declared = {"name": "acquisition", "reads": ("command",)}
    bench = Bench(toy(lambda _context: BuiltStage(core, Burst([])), **declared), config, TRAY_A)
    publishers = {
        who: bench.bus.publisher(tray_key("s", TRAY_A, "command"), BY_NAME["command"], type_name(Command), who)
        for who in ("replay-all-1", "command-1")
    }
    replay = Replay(config)
    replay.publish_time(1000)
    for who, publisher in publishers.items():
        publisher.put(encode(Command(header=Header(who, 0, TRAY_A), fans=3 if who == "replay-all-1" else 1, t_ns=0)))
    health = bench.health_with(lambda h: len(h.inputs) == 2)
    replay.bus.close()
    bench.end()
    assert {c.name: c.value for c in health.counters}["refused_of_replay"] == 1
    assert core.fans == 1
    assert min(core.ticks) > 1e18
