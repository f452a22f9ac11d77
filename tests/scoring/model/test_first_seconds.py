"""First seconds of a fault: what is large is found at once, from the first second of a run on, and anywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.messages import Array
from fantwin.scoring.model.bins import Bin
from fantwin.scoring.model.faults import DRAG, SCALE
from tests.support.made_bins import MadeFans, plays, with_balance, with_reading
from tests.support.scored_blocks import TWIN_SPEED, twin_of

FANS, MANY = 6, 16
OF_TEN_PER_CENT, OF_TWENTY_PER_CENT = 0.105, 0.21
"""sizes of a drag that takes this much of TWIN_SPEED"""


def steady(_time_s: float) -> float:
    return TWIN_SPEED


@pytest.mark.parametrize("at_s", [0.3, 0.9, 3.0, 30.0])
@pytest.mark.parametrize(("column", "size"), [(SCALE, -0.1), (DRAG, -OF_TEN_PER_CENT)], ids=["reading", "rotor"])
def test_a_step_of_ten_per_cent_is_an_alarm_within_a_second_from_the_first_moments_of_a_run_on(
    at_s: float, column: int, size: float
) -> None:
    made = MadeFans(twin_of(FANS).fans, 0.1, steady, seed=round(10 * at_s))
    decision = made.decision()
    assert plays(made, decision, at_s) == []
    made.fault_from_s, made.sizes[:, column] = at_s, size
    raised = plays(made, decision, 1.0 if at_s > 0.5 else 1.5)  # a rotor hardly moves while its free run begins
    assert sorted(fan for _, fan, is_raised in raised if is_raised) == list(range(FANS))
    onset_s = (decision.onset - 1) * made.bin_s
    np.testing.assert_allclose(onset_s, at_s, atol=0.35, err_msg="it says when it began, too")


@pytest.mark.parametrize("is_of_balance", [False, True], ids=["speed", "torque balance"])
def test_a_fall_of_twenty_per_cent_in_a_moment_is_an_alarm_where_a_twin_was_not_trained_and_is_wrong_too(
    is_of_balance: bool,
) -> None:
    made = MadeFans(twin_of(FANS).fans, 0.1, lambda time_s: 200.0 + min(10.0 * time_s, 100.0), seed=3)
    decision, off, rng = made.decision(), np.linspace(-1.0, 1.0, FANS), np.random.default_rng(3)

    def untrained(one: Bin) -> Bin:
        share = ((one.predicted_rad_s - 220.0) / 80.0).clip(0.0, 1.0)
        error_rad_s = (45.0 + 3.0 * np.sin(made.time_s)) * share * off
        if not is_of_balance:
            return replace(with_reading(one, one.deviation_rad_s + error_rad_s), unseen_rad_s=45.0 * share)
        assert made.rotor_rad_s is not None
        slope = made.fans.slope(one.predicted_rad_s)
        wrong = replace(one, unseen_balance_command=45.0 * share * slope)
        return with_balance(wrong, -slope * (made.rotor_rad_s + error_rad_s) + rng.normal(0.0, 0.15, FANS))

    assert plays(made, decision, 20.0, untrained) == [], "an error of 15 % is no fault there, nor that it wanders"
    made.fault_from_s, made.sizes[:, DRAG] = 20.0, -OF_TWENTY_PER_CENT
    assert sorted(fan for *_, fan, _ in plays(made, decision, 1.0, untrained)) == list(range(FANS))


def raised_after_s(has_speed: bool, has_balance: bool) -> Array:
    """Times, of 15 s at most, after which a drag that takes 3 % of the speed is an alarm.

    Speed and balance are known by turns.
    """
    made = MadeFans(twin_of(MANY).fans, 0.1, steady, seed=1)
    made.fault_from_s, made.sizes[:, DRAG] = 10.0, -0.3 * OF_TEN_PER_CENT
    rng, times = np.random.default_rng(1), np.full(MANY, 15.0)
    decision = made.decision()

    def by_turns(one: Bin) -> Bin:
        is_of_balance = made.number % 2 == 1
        assert made.rotor_rad_s is not None
        needs = -made.fans.slope(one.predicted_rad_s) * made.rotor_rad_s + rng.normal(0.0, 0.15, MANY)
        if is_of_balance and has_balance:
            return with_balance(one, needs)
        if has_speed and not is_of_balance:
            return one
        return replace(one, readings=np.zeros(MANY), deviations_rad_s=np.full((1, MANY), np.nan))

    while made.time_s < 25.0 and times.max() == 15.0:
        for time_s, fan, is_raised in plays(made, decision, 1.0, by_turns):
            times[fan] = min(times[fan], time_s - 10.0) if is_raised else times[fan]
    return times


def test_speed_and_torque_balance_add_up() -> None:
    speed, balance = raised_after_s(True, False), raised_after_s(False, True)
    both = raised_after_s(True, True)
    assert (min(map(np.min, (speed, balance, both)))) > 0.0, "nothing before the fault"
    assert np.median(both) < 0.9 * min(np.median(speed), np.median(balance))


@pytest.mark.parametrize("gap_s", [3.0, 7200.0])
def test_after_a_gap_a_healthy_fan_raises_nothing_and_a_fault_of_the_gap_is_found_at_once(gap_s: float) -> None:
    made = MadeFans(twin_of(FANS).fans, 0.1, steady, seed=8)
    decision = made.decision()
    assert plays(made, decision, 10.0) == []
    bins = round(gap_s / made.bin_s)
    made.number += bins
    assert plays(made, decision, 10.0) == []
    made.number += bins
    made.fault_from_s, made.sizes[:, DRAG] = made.time_s - 1.0, -OF_TWENTY_PER_CENT
    made.rotor_rad_s = None  # it has long slowed down
    raised = plays(made, decision, 2.0)
    assert sorted(fan for *_, fan, _ in raised) == list(range(FANS))


@pytest.mark.parametrize("gap_s", [3.0, 7200.0])
def test_a_gap_ends_no_alarm_and_what_is_healthy_after_it_ends_it_once(gap_s: float) -> None:
    made = MadeFans(twin_of(FANS).fans, 0.1, steady, seed=8)
    decision = made.decision()
    made.fault_from_s, made.sizes[:, DRAG] = 10.0, -OF_TEN_PER_CENT
    assert len(plays(made, decision, 12.0)) == FANS
    made.number += round(gap_s / made.bin_s)
    assert plays(made, decision, 14.0) == []
    made.number += round(gap_s / made.bin_s)
    made.sizes[:] = 0.0
    cleared = plays(made, decision, 20.0)
    assert sorted((fan, is_raised) for _, fan, is_raised in cleared) == [(fan, False) for fan in range(FANS)]
