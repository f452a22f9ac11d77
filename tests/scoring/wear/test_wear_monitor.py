"""scoring.wear.wear_monitor: weeks of a tray, of which a filter says how much slower than its twin each fan turns."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from fantwin.schemas.messages import Array
from fantwin.scoring.wear.slow_change import (
    LIMIT_SHARE,
    MOST_FANS,
    WEAR_HINT,
    is_of_slow_change,
    limit_ahead,
    own_change,
    shared_change,
)
from fantwin.scoring.wear.trend import NS_PER_DAY
from fantwin.scoring.wear.wear_monitor import WearMonitor
from tests.support.wear_data import (
    DAYS_OF_WEAR,
    EVERY_S,
    LOSS,
    PER_DAY,
    START_NS,
    feed,
    loss_of,
    slow_states,
    times_ns,
)

FANS, WORN = 4, 2


def change_of(monitor: WearMonitor, fan: int) -> tuple[float, float]:
    found = monitor.of(fan)
    assert found is not None
    return found.change, found.std_error


def after(change: Array, monitor: WearMonitor | None = None, from_day: float = 0.0, seed: int = 1) -> WearMonitor:
    """A monitor of a tray with this change, (n, fans), from a day on."""
    monitor = monitor or WearMonitor(change.shape[1], EVERY_S)
    start_ns = START_NS + round(from_day * NS_PER_DAY)
    feed(monitor, times_ns(len(change) / PER_DAY, start_ns), *slow_states(change, seed))
    return monitor


def restored(monitor: WearMonitor, *, same_twin: bool = True) -> WearMonitor:
    successor = WearMonitor(len(monitor.t_ns), EVERY_S)
    successor.continue_from(copy.deepcopy(monitor.state), monitor.arrays(), same_twin=same_twin)
    return successor


def test_the_limit_is_forecast_within_its_interval() -> None:
    """Each of the fans loses 5 % in 30 days, so it will have lost 10 % on day 60."""
    fans, days = 20, DAYS_OF_WEAR
    monitor = after(np.repeat(loss_of(0, 1, days), fans, axis=1))
    likely, held, near = [], [], []
    for fan in range(fans):
        found = monitor.of(fan)
        assert found is not None and found.forecast.likely_ns, fan
        times_ns = (found.forecast.earliest_ns, found.forecast.likely_ns, found.forecast.latest_ns)
        earliest, middle, latest = (((t_ns or 0) - START_NS) / NS_PER_DAY for t_ns in times_ns)
        likely.append(middle)
        held.append(earliest <= 60.0 <= latest)
        near.append(abs(found.change + LOSS) <= 2.0 * found.std_error)
        assert latest - earliest < 45.0
    assert np.median(likely) == pytest.approx(60.0, rel=0.05)
    assert np.mean(held) >= 0.95 and np.mean(near) >= 0.95


def test_a_fan_that_wears_is_noticed_then_forecast_and_then_over() -> None:
    t_ns, monitor, fed = times_ns(80), WearMonitor(FANS, EVERY_S), 0
    shares, std_error = slow_states(loss_of(WORN, FANS, 80))

    def problem_on(day: int, asked_on: int = 0) -> str:
        """The problem after this day, asked for on it or later."""
        nonlocal fed
        feed(monitor, t_ns[fed : day * PER_DAY], shares[fed : day * PER_DAY], std_error[fed : day * PER_DAY])
        fed = day * PER_DAY
        return monitor.problem(START_NS + (asked_on or day) * NS_PER_DAY)

    problem_on(5)
    assert monitor.notices() == []
    assert problem_on(30) == ""
    (line,) = monitor.notices()
    assert line.startswith(f"fan {WORN}: speed -") and " % in 30 days, the fans beside it " in line
    assert line.endswith(WEAR_HINT)
    problem = problem_on(58)
    assert problem.startswith(f"fan {WORN} is wearing: it will have lost 10 % of its speed in about ")
    assert problem.endswith("); inspect it")
    assert not monitor.is_over.any() and problem_on(58, asked_on=90) == "", "the forecast has passed"
    assert problem_on(65) == f"fan {WORN} is wearing: it has lost about 10 % of its speed; inspect it"
    assert not monitor.is_over.any(), "that is not sure"
    assert problem_on(80) == "", "there is an alarm"
    assert monitor.is_over.tolist() == [fan == WORN for fan in range(FANS)]


def test_what_all_fans_share_is_no_wear_of_one() -> None:
    days = np.arange(40 * PER_DAY)[:, np.newaxis] / PER_DAY
    weather = -0.08 * days / 40.0 + 0.01 * np.sin(2.0 * np.pi * days)
    monitor = after(np.repeat(weather, FANS, axis=1))
    (line,) = monitor.notices()
    assert line.startswith(f"{MOST_FANS} ") and " % slower than when they were commissioned: the air" in line
    assert monitor.problem(START_NS + 40 * NS_PER_DAY) == ""
    for fan in range(FANS):
        found = monitor.of(fan)
        assert found is not None and found.beside == pytest.approx(found.change, abs=0.02)
    assert after(weather).notices()[0].startswith("fan 0: speed -"), "a fan without others is judged by itself"
    faster = after(np.repeat(-weather, 3, axis=1)).notices()
    assert len(faster) == 1 and "% faster than" in faster[0]


def test_two_fans_of_four_are_not_most_of_them() -> None:
    change = loss_of(WORN, FANS, DAYS_OF_WEAR) + loss_of(0, FANS, DAYS_OF_WEAR)
    assert [line for line in after(change).notices() if line.startswith(MOST_FANS)] == []


def test_a_replaced_fan_starts_again_and_is_compared_with_the_others_from_then_on() -> None:
    """All fans lose 6 % in 30 days, and again 6 % in the 20 days since one was replaced."""
    share = np.concatenate((np.linspace(0.0, 0.06, 30 * PER_DAY), np.linspace(0.06, 0.12, 20 * PER_DAY)))
    shares, std_error = slow_states(np.repeat(-share[:, np.newaxis], FANS, axis=1))
    t_ns, cut, monitor = times_ns(50), 30 * PER_DAY, WearMonitor(FANS, EVERY_S)
    feed(monitor, t_ns[:cut], shares[:cut], std_error[:cut])
    monitor.forget(np.arange(FANS) == WORN, START_NS + 30 * NS_PER_DAY)
    assert monitor.of(WORN) is None and monitor.of(0) is not None
    monitor = restored(monitor)
    feed(monitor, t_ns[cut:], shares[cut:], std_error[cut:])
    assert change_of(monitor, 0)[0] == pytest.approx(-0.12, abs=0.02)
    found = monitor.of(WORN)
    assert found is not None and found.change == pytest.approx(-0.06, abs=0.02)
    assert found.beside == pytest.approx(-0.06, abs=0.02)
    assert [line for line in monitor.notices() if line.startswith("fan ")] == []


def test_a_limit_is_reached_only_surely_and_until_the_change_is_below_it_again() -> None:
    t_ns, error = times_ns(8), 0.01
    beyond = np.array([0.0, 0.0, 0.005, 0.05, 0.005, -0.01])
    steps = np.repeat(np.where(beyond == 0.0, 0.0, LIMIT_SHARE + beyond), PER_DAY)
    monitor, seen = WearMonitor(2, EVERY_S), []
    for day in range(6):
        rows = slice(day * PER_DAY, (day + 1) * PER_DAY)
        feed(monitor, t_ns[rows], steps[rows, np.newaxis] * [-1.0, 1.0], np.full(PER_DAY, error))
        monitor = restored(monitor)
        seen.append(monitor.is_over.tolist())
    assert seen == [[False] * 2] * 3 + [[True] * 2] * 2 + [[False] * 2]


def test_the_change_goes_on_with_another_twin() -> None:
    """It has taken the fan as it was on day 15 for healthy."""
    change = loss_of(WORN, FANS, 30)
    first, second = change[: 15 * PER_DAY], change[15 * PER_DAY :] - change[15 * PER_DAY] + 0.03
    before = after(first)
    monitor = restored(before, same_twin=False)
    assert [change_of(monitor, fan) for fan in range(FANS)] == [change_of(before, fan) for fan in range(FANS)]
    after(second, monitor, from_day=15.0, seed=2)
    found, std_error = change_of(monitor, WORN)
    assert found == pytest.approx(-LOSS, abs=2.0 * std_error)
    assert change_of(before, WORN)[1] < std_error < 0.02, "a takeover is no surer than the last point and the first"
    assert abs(change_of(monitor, 0)[0]) < 0.02
    assert np.abs(np.diff(monitor.state.series[WORN].value)).max() < 0.015, "there is no step"
    other = after(second, restored(before), from_day=15.0, seed=2)
    assert abs(change_of(other, WORN)[0] + LOSS) > 0.01, "without it there is one"


def test_what_is_no_number_is_no_point() -> None:
    monitor = WearMonitor(2, EVERY_S)
    feed(monitor, times_ns(1), np.full((PER_DAY, 2), [0.0, np.nan]), np.full(PER_DAY, 0.01))
    assert monitor.of(0) is not None and monitor.of(1) is None
    feed(monitor, times_ns(1, START_NS + NS_PER_DAY), np.zeros((PER_DAY, 2)), np.full(PER_DAY, 0.01))
    assert change_of(monitor, 1)[0] == 0.0


def test_the_notices_are_told_from_other_notes() -> None:
    alone = own_change("fan 2", -0.0512, 30 * 3600 * 10**9, None)
    assert alone == "fan 2: speed -5.1 % in 30 h: see fantwin status --wear"
    beside = own_change("fan 0", 0.04, 12 * 24 * 3600 * 10**9, -0.002)
    assert beside == "fan 0: speed +4.0 % in 12 days, the fans beside it -0.2 %: see fantwin status --wear"
    shared = shared_change(-0.042)
    assert shared == (
        "most fans turn 4 % slower than when they were commissioned: the air, the supply, or a filter in front of them "
        "all"
    )
    assert all(is_of_slow_change(note) for note in (alone, beside, shared))
    assert not is_of_slow_change("98.0 % of the fans' samples judged")


def test_a_limit_ahead_names_the_first_fan_its_days_and_the_others() -> None:
    line = limit_ahead("fan 3", "", -0.001, [4.2, 2.6, 6.1])
    assert line == "fan 3 is wearing: it will have lost 10 % of its speed in about 4 days (3 to 6); inspect it"
    line = limit_ahead("CPU (fan 3)", "fans 1, 5", 0.001, [1.2, 0.0, 2.0])
    assert line == "CPU (fan 3) is wearing: it will turn 10 % faster in about 1 day (0 to 2); inspect it, and fans 1, 5"
    assert "it turns faster by about 10 % of its speed; i" in limit_ahead("fan 0", "", 0.1, [0.0, 0.0, 0.0])
    assert "speed within a day; inspect it" in limit_ahead("fan 0", "", -0.001, [0.3, 0.0, 2.0])
