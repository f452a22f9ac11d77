"""Bins of predictions: fixed stretches of time, without a wrong reading; and what drives the model in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.model.bins import Bins, bin_ns_of
from fantwin.scoring.model.operation import Inputs, Operation
from tests.support.made_bins import bin_of
from tests.support.scored_blocks import STEP_NS, TOP_SPEED, noise_of, prediction_of, twin_of

BIN_NS = 100_000_000
LOWEST = 20.0


def inputs_of(*commands: float) -> list[Inputs]:
    """Those of bins with these commands, of a fan whose lowest command that acts is LOWEST."""
    fans = replace(twin_of(1).fans, lowest_command=np.array([LOWEST]))
    operation = Operation(fans, BIN_NS)
    return [
        operation.inputs(bin_of(number, BIN_NS, 1, 60.0, command=command)) for number, command in enumerate(commands)
    ]


def test_on_a_plateau_a_twin_may_be_wrong_as_at_its_end_and_no_move_there_tells_anything_new() -> None:
    end, below, far_below, beyond = inputs_of(LOWEST, 0.9 * LOWEST, 0.3 * LOWEST, 2.0 * LOWEST)
    assert end.of_lowest_rad_s > 0.0
    assert below.of_lowest_rad_s == far_below.of_lowest_rad_s == end.of_lowest_rad_s
    assert below.command_path == far_below.command_path == far_below.command_moved == 0.0
    assert beyond.of_lowest_rad_s < 0.01 * end.of_lowest_rad_s
    assert beyond.command_path == pytest.approx(0.5)


def test_a_command_that_goes_to_and_fro_has_a_path_and_has_not_moved() -> None:
    first, _, *later = inputs_of(50.0, *(50.0 + 0.3 * (-1.0) ** number for number in range(20)))
    assert first.command_moved > 0.0
    assert sum(float(each.command_path[0]) for each in later) > 0.1
    assert sum(float(each.command_moved[0]) for each in later) == 0.0


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
