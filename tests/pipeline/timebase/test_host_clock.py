"""pipeline.timebase.host_clock: a time that passes evenly, whatever happens to the wall clock."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from fantwin.pipeline.timebase.host_clock import VARIABLE, ClockStep, HostClock, handed_on
from fantwin.schemas.units import NS_PER_S

EPOCH_NS = 1_700_000_000_000_000_000
HOUR_NS = 3600 * NS_PER_S


class Host:
    def __init__(self) -> None:
        self.wall_ns, self.monotonic_ns = EPOCH_NS, 5 * NS_PER_S
        self.clock = HostClock(lambda: self.wall_ns, lambda: self.monotonic_ns)

    def passes(self, seconds: float, *, set_by_ns: int = 0) -> int:
        self.monotonic_ns += round(seconds * NS_PER_S)
        self.wall_ns += round(seconds * NS_PER_S) + set_by_ns
        return self.clock.now_ns()


def test_row_13_a_wall_clock_set_back_by_less_than_a_second_makes_the_time_slower_until_it_has_caught_up() -> None:
    host = Host()
    host.passes(1.0)
    host.passes(0.0, set_by_ns=-500_000_000)
    times = [host.passes(0.05) for _ in range(1100)]
    assert 49_000_000 <= min(np.diff(times)) < max(np.diff(times)) == 50_000_000
    assert times[-1] == host.wall_ns
    assert host.clock.steps == 0


def test_a_process_that_is_held_up_between_two_readings_takes_it_for_no_step() -> None:
    host = Host()
    host.passes(1.0)
    delays_s = iter([2.0, 0.0])

    def read_wall_ns() -> int:
        wall_ns = host.wall_ns
        delay_ns = round(next(delays_s) * NS_PER_S)
        host.wall_ns += delay_ns
        host.monotonic_ns += delay_ns
        return wall_ns

    clock = HostClock(read_wall_ns, lambda: host.monotonic_ns, host.clock.offset_ns)
    assert clock.now_ns() == host.wall_ns
    assert clock.steps == 0


def test_row_13_a_wall_clock_set_back_does_not_take_the_time_back() -> None:
    host = Host()
    before = host.passes(1.0)
    assert host.passes(0.05, set_by_ns=-HOUR_NS) == before + 50_000_000
    assert host.clock.last_step == ClockStep(-HOUR_NS, before + 50_000_000, HOUR_NS)
    assert host.passes(600.0) == before + 50_000_000 + 600 * NS_PER_S
    assert host.clock.steps == 1, "it is one step, however long ago"


@pytest.mark.parametrize("more_ns", [0, HOUR_NS])
def test_a_wall_clock_that_is_put_right_is_followed_again(more_ns: int) -> None:
    host = Host()
    host.passes(1.0, set_by_ns=-HOUR_NS)
    assert host.passes(1.0, set_by_ns=HOUR_NS + more_ns) == host.wall_ns
    assert (host.clock.steps, host.clock.last_step.ahead_ns) == (2, 0) if host.clock.last_step else False


def test_row_13_the_time_never_goes_back() -> None:
    host = Host()
    times = [host.passes(0.05, set_by_ns=by_s * NS_PER_S) for by_s in (0, -5, 3, -7200, 100, 7300, -1, -2, 50)]
    assert all(later > earlier for earlier, later in pairwise(times))


@pytest.mark.parametrize("set_by_s", [-3600, -20, -10, -3, -2, 3])
def test_row_13_a_stage_goes_on_with_the_time_of_its_launcher_and_notices_a_step_while_it_starts(set_by_s: int) -> None:
    host = Host()
    before, handed = host.passes(1.0), handed_on({VARIABLE: str(host.clock.offset_ns)})
    host.monotonic_ns += NS_PER_S
    host.wall_ns += NS_PER_S + set_by_s * NS_PER_S
    of_stage = HostClock(lambda: host.wall_ns, lambda: host.monotonic_ns, handed)
    assert of_stage.now_ns() == host.clock.now_ns() == before + NS_PER_S + max(set_by_s, 0) * NS_PER_S
    assert of_stage.last_step == host.clock.last_step, "it reports the step, too"


@pytest.mark.parametrize("environment", [{}, {VARIABLE: "soon"}])
def test_a_process_that_nobody_hands_a_time_begins_with_the_wall_clock(environment: dict[str, str]) -> None:
    assert handed_on(environment) is None
