"""Alarms of fans that stand: over a restart of the scorer, and on a slow line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.enums import InvalidReason, Transition
from fantwin.schemas.messages import Prediction
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.units import NS_PER_S
from tests.support.scored_blocks import core_of, feed, learned, noise_of, prediction_of, snapshot_of

ON = 50.0
HEALTHY = Standstill(
    turning_command=20.0, standing_below_rad_s=50.0, off_command=0.0, start_s=1.0, coast_s=4.0, slowing_s=1.0
)


def standing(first_s: int, seconds: int, command: float) -> Prediction:
    """A fan that stands: STARTING where its command turns it, else STOPPED."""
    block = prediction_of(np.zeros(100 * seconds), first=100 * first_s)
    reason = InvalidReason.STARTING if command else InvalidReason.STOPPED
    return unscored(replace(block, command=0.0 * block.command + command), np.full(100 * seconds, int(reason)))


def unscored(block: Prediction, reasons: np.ndarray, speed_rad_s: float | np.ndarray = 0.0) -> Prediction:
    """A block without predictions where there is a reason. reasons, speed_rad_s: of each sample."""
    column = reasons.astype(np.uint8)[:, np.newaxis]
    speed = np.broadcast_to(speed_rad_s, len(column)).astype(float)[:, np.newaxis]
    return replace(block, measured_speed_rad_s=speed, invalid_reason=column, valid=column == 0)


@pytest.mark.parametrize("restarts", [False, True])
def test_the_alarm_of_a_fan_that_did_not_start_stays_while_its_command_stops_it_also_over_a_restart(
    restarts: bool,
) -> None:
    core = learned(standstill=HEALTHY)
    _, alarms = feed(core, [standing(30, 12, 0.0), standing(42, 12, ON), standing(54, 5, 0.0)])
    assert [each.transition for each in alarms] == [Transition.RAISED]
    if restarts:
        snapshot, core = snapshot_of(core), core_of(standstill=HEALTHY)
        core.restore(snapshot)
    _, alarms = feed(core, [standing(59, 20, 0.0)])
    assert Transition.CLEARED not in [each.transition for each in alarms]


@pytest.mark.parametrize("rate_hz", [1, 2])
def test_one_wrong_reading_of_0_while_a_fan_starts_is_no_alarm_on_a_slow_line(rate_hz: int) -> None:
    samples = 60 * rate_hz
    t_s = np.arange(samples) / rate_hz
    block = prediction_of(noise_of(samples), period_ns=NS_PER_S // rate_hz)
    speed = np.where((t_s < 11.0) | (t_s == 15.0), 0.0, block.measured_speed_rad_s[:, 0])
    reasons = np.select([t_s < 10.0, t_s < 20.0], [int(InvalidReason.STOPPED), int(InvalidReason.STARTING)], 0)
    command = np.where(t_s < 10.0, 0.0, ON)[:, np.newaxis]
    _, alarms = feed(core_of(standstill=HEALTHY), [replace(unscored(block, reasons, speed), command=command)])
    assert alarms == []
