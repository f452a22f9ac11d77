"""The clock that a stage uses."""

from __future__ import annotations

import math

from fantwin.pipeline.timebase.stage_clock import StageClock, is_of_replay
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Clock

HOST_NS = 1_800_000_000_000_000_000


class Host:
    def __init__(self) -> None:
        self.ns = HOST_NS

    def __call__(self) -> int:
        return self.ns

    def monotonic_s(self) -> float:
        return self.ns / 1e9


def clock_of(host: Host, *, owner: str = "replay-all-1") -> StageClock:
    """The clock of a stage while a replay owns the site."""
    clock = StageClock(host, host.monotonic_s)
    clock.set_replay_alive(True)
    clock.add_replay_health(owner, has_ended=False)
    return clock


def clock_message(t_ns: int, rate: float, tray: str = "a", producer: str = "replay-all-1") -> Clock:
    return Clock(header=Header(producer, 0, tray), t_ns=t_ns, rate=rate)


def test_a_tick_stays_at_the_last_time_of_the_replay_and_ages_advance_at_its_rate():
    host = Host()
    alone = StageClock(host)
    assert alone.tick_ns("a") == alone.now_ns("a", HOST_NS) == HOST_NS, "without a replay"
    clock = clock_of(host)
    assert clock.update(clock_message(1000, 2.0))
    host.ns += 50
    assert clock.tick_ns("a") == 1000
    assert clock.now_ns("a", HOST_NS) == 1100
    assert clock.tick_ns("b") == clock.now_ns("b", HOST_NS) == host.ns


def test_there_is_no_age_while_a_replay_is_paused_or_runs_as_fast_as_it_can():
    clock = clock_of(Host())
    for rate in (0.0, math.inf):
        clock.update(clock_message(1000, rate))
        assert clock.now_ns("a", HOST_NS) is None
        assert clock.tick_ns("a") == 1000


def test_the_hosts_time_applies_again_once_the_replay_has_left():
    for leave in (
        lambda clock: clock.set_replay_alive(False),
        lambda clock: clock.add_replay_health("replay-all-1", has_ended=True),
    ):
        clock = clock_of(Host())
        clock.update(clock_message(1000, 1.0))
        leave(clock)
        assert clock.tick_ns("a") == HOST_NS
        assert not clock.update(clock_message(2000, 1.0)), "what is still on the way no longer applies"
        assert clock.now_ns("a", 1500) is None, "its last samples have no age by the host's time"
        assert clock.now_ns("a", HOST_NS + 1) == clock.now_ns("b", 1500) == HOST_NS


def test_row_12_a_clock_is_taken_from_the_replay_that_owns_the_site_only():
    host = Host()
    nobody = StageClock(host, host.monotonic_s)
    assert not nobody.update(clock_message(1000, 0.0))
    announced = StageClock(host, host.monotonic_s)
    announced.add_replay_health("replay-all-1", has_ended=False)
    assert not announced.update(clock_message(1000, 0.0)), "without the liveliness token"
    for clock in (nobody, announced):
        host.ns += 10**9
        assert clock.tick_ns("a") == host.ns, "a silent line is still reported"
    owned = clock_of(host)
    owned.update(clock_message(1000, 1.0))
    owned.add_replay_health("replay-forged", has_ended=False)
    assert not owned.update(clock_message(5000, 0.0, producer="replay-forged"))
    assert owned.tick_ns("a") == 1000


def test_row_12_a_clock_that_is_not_renewed_expires_and_another_replay_may_follow():
    host = Host()
    clock = clock_of(host)
    clock.update(clock_message(1000, 0.0))
    host.ns += round(4.9e9)
    assert clock.tick_ns("a") == 1000, "a paused replay renews it 20 times a second"
    host.ns += round(0.2e9)
    assert clock.tick_ns("a") == clock.now_ns("a", host.ns) == host.ns
    clock.add_replay_health("replay-all-2", has_ended=False)
    assert clock.update(clock_message(3000, 1.0, producer="replay-all-2"))
    assert clock.tick_ns("a") == 3000


def test_only_the_sessions_of_a_replay_are_of_one_whatever_a_tray_is_called():
    """Samples and commands of a replay drive no live fan."""
    assert is_of_replay("replay-all-12ab")
    assert not any(map(is_of_replay, ("acquisition-replay-12ab", "replayer-all-12ab")))
