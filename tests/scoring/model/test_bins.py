"""Bins of predictions: fixed stretches of time, however samples are cut, without a reading that is wrong."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fantwin.schemas.blocks import cut
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.bins import Bin, Bins, bin_ns_of
from tests.support.scored_blocks import STEP_NS, TOP_SPEED, noise_of, prediction_of

SAMPLES, BIN_NS = 60, 100_000_000


def new() -> Bins:
    return Bins(BIN_NS, np.full(2, TOP_SPEED), np.ones(2, np.bool_), None)


def told(one: Bin) -> dict[str, list[float]]:
    return {name: np.asarray(value).tolist() for name, value in vars(one).items() if name != "row"}


@settings(max_examples=20, deadline=None)
@given(st.sets(st.integers(1, SAMPLES - 1)), st.integers(0, 1000))
def test_neither_cuts_nor_a_restart_change_a_bin(cuts: set[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = prediction_of(noise_of(SAMPLES, 2, seed), rng.random((SAMPLES, 2)) > 0.1, first=int(rng.integers(9)))
    expected = [repr(told(one)) for one in new().take(whole)]
    bins, found = new(), []
    for first, last in pairwise(sorted({0, SAMPLES, *cuts})):
        found += [repr(told(one)) for one in bins.take(cut(whole, first, last))]
        successor = new()
        successor.restore(*bins.snapshot())
        bins = successor
    assert found == expected != []


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
