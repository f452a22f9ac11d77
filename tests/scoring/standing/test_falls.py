"""Falls of the speed: how long a fan ran on, which distinguishes a held rotor from one without power."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from fantwin.scoring.model.operation import Operation
from fantwin.scoring.standing.stands_still import Falls
from tests.support.made_bins import bin_of, with_reading
from tests.support.scored_blocks import TWIN_SPEED, twin_of

BIN_S = 0.1
COASTS_S = 2.0


@pytest.mark.parametrize(
    ("course", "least_s", "most_s"),
    [
        (lambda _since_s: 0.0, 0.0, 0.1),
        (lambda since_s: 0.8 * (since_s < 6.0), 0.0, 0.1),
        (lambda since_s: 0.5 * (since_s < 6.0), 0.0, 0.1),
        (lambda since_s: 0.2 * (since_s % 3.0 > 2.7), 0.0, 0.1),
        (lambda since_s: math.exp(-since_s / COASTS_S), 1.4, 2.1),
    ],
    ids=["held", "slow, then held", "at half speed, then held", "held, and jerking", "without power"],
)
def test_a_fan_that_comes_to_rest_stands_and_has_run_on_for_as_long_as_its_readings_say(
    course: Callable[[float], float], least_s: float, most_s: float
) -> None:
    fans = twin_of(1).fans
    operation = Operation(fans, round(BIN_S * 1e9))
    falls = Falls(fans, BIN_S)
    for number in range(140):
        since_s = number * BIN_S - 5.0
        speed = TWIN_SPEED * (course(since_s) if since_s >= 0.0 else 1.0)
        one = bin_of(number, round(BIN_S * 1e9), 1, TWIN_SPEED)
        one = with_reading(one, speed - one.predicted_rad_s)
        now = operation.inputs(one)
        falls.take(now)
        assert falls.stands[0] == (speed < 0.08 * TWIN_SPEED)
        assert falls.is_falling[0] == (speed < 0.6 * TWIN_SPEED)
    falls.rest(30.0)
    fall = falls.of(0)
    assert fall is not None, "also after a gap, since it has stood before"
    assert least_s <= fall.lasted_s <= most_s
    assert fall.rest_s == pytest.approx(max(fall.lasted_s - 0.85 * BIN_S, 0.0), abs=0.1 * BIN_S), "but for one reading"
    assert fall.coasts_s == pytest.approx(COASTS_S)


@pytest.mark.parametrize(("turned_s", "gap_s"), [(0.0, 0.0), (3.0, 30.0)], ids=["from the start", "after a gap"])
def test_how_long_a_fan_ran_on_is_not_known_where_nobody_saw_it(turned_s: float, gap_s: float) -> None:
    fans = twin_of(1).fans
    operation, falls = Operation(fans, round(BIN_S * 1e9)), Falls(fans, BIN_S)
    for number in range(round((turned_s + 1.0) / BIN_S)):
        is_turning = number * BIN_S < turned_s
        one = bin_of(number if is_turning else number + round(gap_s / BIN_S), round(BIN_S * 1e9), 1, TWIN_SPEED)
        one = with_reading(one, 0.0 * one.predicted_rad_s if is_turning else -one.predicted_rad_s)
        if number == round(turned_s / BIN_S):
            falls.rest(gap_s)
        falls.take(operation.inputs(one))
    assert falls.stands[0] and falls.of(0) is None
