"""scoring.detectors.running_on: what a healthy stop looks like, with tachos, gaps and snapshots."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.messages import Array
from schemas.standstill import Standstill
from schemas.tacho import INSTANTANEOUS, Tacho
from scoring.detectors.detector import DetectorContext, DetectorInput
from scoring.detectors.running_on import RunningOn, RunningOnSettings

PERIOD_NS = 100_000_000
COUNT = Tacho(kind="count", window_s=1.0)
HEALTHY = Standstill(
    turning_command=20.0, standing_below_rad_s=10.0, off_command=0.0, start_s=1.0, coast_s=4.0, slowing_s=0.4
)


def context(tacho: Tacho = INSTANTANEOUS[0]) -> DetectorContext:
    return DetectorContext(fans=1, smoothing_s=0.2, tachos=(tacho,))


def detector(tacho: Tacho = INSTANTANEOUS[0]) -> RunningOn:
    return RunningOn(RunningOnSettings(healthy=HEALTHY), context(tacho))


def stopped(of: RunningOn, speed_rad_s: Array) -> Array:
    """(n,) for readings (n,) since a stop."""
    return ratios(of, np.concatenate((speed_rad_s[:1], speed_rad_s)), np.r_[50.0, np.zeros(len(speed_rad_s))])[1:]


def ratios(of: RunningOn, speed_rad_s: Array, command: Array | float = 0.0) -> Array:
    """(n,) for readings (n,) at 10 Hz; the fan is stopped, and nobody has seen when."""
    speed = speed_rad_s[:, np.newaxis]
    nothing = np.zeros(speed.shape, bool)
    block = DetectorInput(
        period_ns=PERIOD_NS,
        period_s=PERIOD_NS / 1e9,
        valid=~nothing,
        standardised=0.0 * speed,
        persistent=0.0 * speed,
        speed_rad_s=speed,
        missing=nothing,
        reading_missing=nothing,
        idle=nothing,
        command=np.broadcast_to(np.asarray(command, np.float64).reshape(-1, 1), speed.shape),
        predicted_rad_s=speed,
    )
    return of.ratio(block)[:, 0]


def exceeded_s(ratio: Array) -> float:
    return float(np.flatnonzero(ratio > 1.0)[0]) * PERIOD_NS / 1e9


@pytest.mark.parametrize(("tacho", "after_s"), [(INSTANTANEOUS[0], 1.2), (COUNT, 1.2 + COUNT.reach_s)])
def test_a_fan_that_keeps_its_speed_has_three_times_what_healthy_ones_need_and_the_lag_at_least(
    tacho: Tacho, after_s: float
) -> None:
    assert exceeded_s(stopped(detector(tacho), np.full(100, 200.0))) == pytest.approx(after_s, abs=0.11)


def test_one_that_has_slowed_down_has_three_coasts() -> None:
    speed = np.concatenate((np.full(8, 200.0), np.full(200, 130.0)))
    assert exceeded_s(stopped(detector(), speed)) == pytest.approx(12.0, abs=0.11)


def test_a_second_stop_is_measured_by_its_own_speed() -> None:
    of = detector()
    first = stopped(of, np.concatenate((200.0 * np.exp(-np.arange(40) / 10.0), np.zeros(40))))
    turning = ratios(of, np.full(50, 100.0), command=50.0)
    assert max(first.max(), turning.max()) < 1.0
    assert exceeded_s(stopped(of, np.full(40, 100.0))) < 2.0, "100 rad/s are all of its speed"


def test_readings_that_are_missing_are_no_rest() -> None:
    coast = 200.0 * np.exp(-np.arange(60) / 15.0)
    coast[10:25] = np.nan
    assert stopped(detector(), coast).max() < 1.0


def test_the_speed_that_a_stop_began_with_is_not_known_after_a_gap() -> None:
    of = detector()
    assert stopped(of, 200.0 * np.exp(-np.arange(20) / 15.0)).max() < 1.0
    of.reset(np.array([True]))
    assert of.memory_s == 0.0
    slow = 50.0 * np.exp(-np.arange(30) / 60.0)
    assert ratios(of, slow).max() < 1.0, "a slow fan takes longer to lose 30 %"


def test_after_a_rest_it_may_not_turn_for_longer_than_the_lag() -> None:
    speed = np.concatenate((np.zeros(30), np.full(30, 50.0)))
    assert exceeded_s(ratios(detector(), speed)) == pytest.approx(4.0, abs=0.11)
