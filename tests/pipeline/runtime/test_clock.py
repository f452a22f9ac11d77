"""The clock that a stage uses."""

from __future__ import annotations

import math

from pipeline.runtime.clock import StageClock, is_of_replay
from schemas.messages import Clock, Header

HOST_NS = 1_800_000_000_000_000_000


class Host:
    def __init__(self) -> None:
        self.ns = HOST_NS

    def __call__(self) -> int:
        return self.ns


def clock_message(t_ns: int, rate: float, tray: str = "a") -> Clock:
    return Clock(header=Header("replay-all-1", 0, tray), t_ns=t_ns, rate=rate)


def test_without_a_replay_the_time_is_the_hosts():
    clock = StageClock(Host())
    assert clock.tick_ns("a") == clock.now_ns("a") == HOST_NS


def test_a_tick_stays_at_the_last_time_of_the_replay_and_ages_advance_at_its_rate():
    host = Host()
    clock = StageClock(host)
    clock.update(clock_message(1000, 2.0), HOST_NS)
    host.ns += 50
    assert clock.tick_ns("a") == 1000
    assert clock.now_ns("a") == 1100
    assert clock.tick_ns("b") == clock.now_ns("b") == host.ns


def test_there_is_no_age_while_a_replay_is_paused_or_runs_as_fast_as_it_can():
    clock = StageClock(Host())
    for rate in (0.0, math.inf):
        clock.update(clock_message(1000, rate), HOST_NS)
        assert clock.now_ns("a") is None
        assert clock.tick_ns("a") == 1000


def test_the_hosts_time_applies_again_once_the_replay_has_left():
    clock = StageClock(Host())
    clock.update(clock_message(1000, 1.0), HOST_NS)
    clock.clear()
    assert clock.tick_ns("a") == HOST_NS


def test_only_the_replayers_sessions_count_as_a_replay():
    assert is_of_replay("replay-all-12ab")
    assert not is_of_replay("acquisition-replay-12ab")
    assert not is_of_replay("replayer")
