"""Bins of predictions: fixed stretches of time, without a reading that is wrong."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.bins import Bins, bin_ns_of
from tests.support.scored_blocks import STEP_NS, TOP_SPEED, noise_of, prediction_of

BIN_NS = 100_000_000


def new() -> Bins:
    return Bins(BIN_NS, np.full(2, TOP_SPEED), np.ones(2, np.bool_), None)


def test_of_several_readings_one_that_is_far_from_the_others_does_not_count() -> None:
    residual = noise_of(40, 2)
    residual[25, 0] = -300.0
    for number, one in enumerate(new().take(prediction_of(residual))):
        assert one.readings.tolist() == ([9, 10] if number == 2 else [10, 10])
        assert (np.abs(one.deviation_rad_s) < 10.0).all()


def test_a_bin_is_a_tenth_of_a_second_or_as_long_as_a_reading_is_held_in_whole_samples() -> None:
    assert bin_ns_of(STEP_NS, 0.0) == NS_PER_S // 10
    assert bin_ns_of(NS_PER_S, 0.0) == NS_PER_S
    assert bin_ns_of(NS_PER_S // 10, 0.5) == NS_PER_S // 2
