"""Fans that are not scored are reported with the reason."""

import numpy as np

from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.unscored_monitor import REASONS, UnscoredMonitor


def test_a_reason_of_a_newer_twin_integrator_is_reported_with_its_number():
    monitor = UnscoredMonitor(2, NS_PER_S)
    monitor.update(NS_PER_S, np.zeros((3, 2), np.bool_), np.full((3, 2), 99, np.uint8))
    assert "unknown (99)" in monitor.problem()


def test_a_fan_that_is_scored_now_and_then_is_reported_until_it_is_scored_again():
    monitor = UnscoredMonitor(4, 10 * NS_PER_S)

    def seconds(count: int, *every: int) -> str:
        """The problem after so long in which each fan is scored once in so many seconds."""
        for second in range(count):
            valid = np.array([[second % each == 0 for each in every]])
            reason = np.where(valid, InvalidReason.NONE, InvalidReason.OUT_OF_RANGE).astype(np.uint8)
            monitor.update(NS_PER_S, valid, reason)
        return monitor.problem()

    why = REASONS[InvalidReason.OUT_OF_RANGE]
    assert seconds(19, 1, 2, 4, 9) == ""
    assert seconds(1, 1, 2, 4, 9) == f"fans 2, 3 are not scored most of the time: {why}"
    assert seconds(1, 1, 1, 1, 1) != "", "one score changes nothing"
    assert seconds(19, 1, 1, 1, 9) == f"fan 3 is not scored most of the time: {why}"
    assert seconds(20, 1, 1, 1, 1) == ""


def test_a_fan_that_is_scored_again_after_a_long_time_is_reported_no_more():
    monitor = UnscoredMonitor(1, 10 * NS_PER_S)
    for rows, is_scored in ((37, False), (40, True)):
        for _ in range(rows):
            reason = np.full((1, 1), InvalidReason.NONE if is_scored else InvalidReason.WARMING_UP, np.uint8)
            monitor.update(NS_PER_S, np.full((1, 1), is_scored), reason)
            assert not is_scored or monitor.problem() == ""
