"""When recorded messages are due."""

from __future__ import annotations

import math

import pytest

from pipeline.replay.live.pace import FASTEST, SLOWEST, Pace, faster, slower

S = 1_000_000_000


def paced(rate: float = 1.0, *, paused: bool = False) -> Pace:
    pace = Pace(rate, paused=paused)
    pace.start(100 * S, 7.0)
    return pace


@pytest.mark.parametrize(("rate", "due_s"), [(1.0, 3.0), (0.1, 30.0), (4.0, 0.75), (math.inf, 0.0)])
def test_a_message_is_due_after_its_recorded_time_over_the_rate(rate, due_s):
    assert paced(rate).due_in_s(103 * S, 7.0) == pytest.approx(due_s)


def test_waiting_too_long_for_one_message_does_not_delay_those_after_it():
    pace = paced()
    assert pace.due_in_s(101 * S, 8.5) == pytest.approx(-0.5)
    assert pace.due_in_s(102 * S, 8.5) == pytest.approx(0.5)


def test_while_paused_nothing_is_due_and_recorded_time_stands_still():
    pace = paced()
    pace.change(pace.position_ns(8.0, 200 * S), 8.0, paused=True)
    assert pace.due_in_s(101 * S, 1000.0) == math.inf
    assert pace.position_ns(1000.0, 200 * S) == 101 * S
    assert pace.rate_now == 0.0
    pace.change(101 * S, 1000.0, paused=False)
    assert pace.due_in_s(102 * S, 1000.0) == pytest.approx(1.0)
    assert pace.paused_s == pytest.approx(992.0)


def test_another_rate_applies_from_the_position_of_the_request():
    pace = paced()
    pace.change(pace.position_ns(9.0, 200 * S), 9.0, rate=10.0)
    assert pace.position_ns(9.5, 200 * S) == 107 * S
    assert pace.due_in_s(112 * S, 9.5) == pytest.approx(0.5)


@pytest.mark.parametrize("rate", [1.0, math.inf])
def test_recorded_time_never_overtakes_the_message_that_is_next(rate):
    assert paced(rate).position_ns(60.0, 105 * S) == 105 * S


def test_rates_double_and_halve_between_their_ends():
    assert faster(1.0) == 2.0
    assert slower(1.0) == 0.5
    assert slower(SLOWEST) == SLOWEST
    assert faster(FASTEST) == math.inf
    assert slower(math.inf) == FASTEST
