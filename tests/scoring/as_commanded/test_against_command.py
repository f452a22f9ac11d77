"""Fans against their command: what a clock that was set back does to what was seen before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fantwin.schemas.messages import Prediction
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.scoring.as_commanded.against_command import AgainstCommand
from tests.support.scored_blocks import prediction_of

HOUR_NS = 3_600_000_000_000
HEALTHY = Standstill(turning_command=20.0, standing_below_rad_s=50.0, off_command=0.0, start_s=1.0, coast_s=4.0)


def standing(seconds: float, first: int = 0) -> Prediction:
    """A fan that stands although its command turns it."""
    block = prediction_of(np.zeros(round(100 * seconds)), first=first)
    return replace(block, measured_speed_rad_s=np.zeros(block.measured_speed_rad_s.shape))


def test_what_was_seen_before_the_clock_was_set_back_does_not_count_and_what_comes_after_does() -> None:
    fans = AgainstCommand(HEALTHY, [Tacho()])
    fans.take(standing(2.5))
    assert not fans.active.any()
    later = standing(2.5)
    fans.take(replace(later, t_ns=later.t_ns - HOUR_NS))
    assert not fans.active.any(), "how long it stood in between is not known"
    more = standing(2.5, first=250)
    fans.take(replace(more, t_ns=more.t_ns - HOUR_NS))
    assert fans.active.any()
