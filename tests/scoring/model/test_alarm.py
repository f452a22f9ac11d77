"""Alarm of a fault: it keeps its size, nothing is learned in it, it clears once, and it goes on after a restart."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.messages import Array
from fantwin.schemas.tacho import Tacho
from fantwin.scoring.model.decision import OVER_S, Decision
from fantwin.scoring.model.faults import DRAG, DRAG_GROWS, DRIVE, FRICTION, GROWS_S
from fantwin.scoring.model.healthy import SLOW
from tests.support.made_bins import Changes, MadeFans, plays, with_reading
from tests.support.scored_blocks import TWIN_SPEED, twin_of

FANS = 4


def steady(_time_s: float) -> float:
    return TWIN_SPEED


def moving(time_s: float) -> float:
    return 280.0 + 100.0 * math.sin(2.0 * math.pi * time_s / 40.0)


def taken_rad_s(made: MadeFans, drag: float) -> float:
    """What a drag takes of TWIN_SPEED."""
    top = made.fans.top_rad_s[:1]
    return float(drag * made.fans.slope(top)[0] / made.fans.slope(np.array([TWIN_SPEED]))[0] * TWIN_SPEED**2 / top[0])


def test_of_a_slow_fault_what_was_taken_up_before_its_alarm_is_given_back_and_it_does_not_shrink_in_its_alarm() -> None:
    made = MadeFans(twin_of(FANS).fans, 0.4, steady, seed=2)
    decision = made.decision()
    plays(made, decision, 30.0)
    healthy = decision.model.expected_rad_s.copy()
    made.fault_from_s, made.sizes[:, DRAG_GROWS] = 30.0, -0.03
    raised = plays(made, decision, 150.0)
    assert len(raised) == FANS and min(raised)[0] > 60.0, "the filter has had time to take it for its own"
    made.sizes[:, DRAG], made.sizes[:, DRAG_GROWS] = -0.03 * 150.0 / GROWS_S, 0.0
    takes = taken_rad_s(made, 0.03 * 150.0 / GROWS_S)
    for _ in range(3):
        assert plays(made, decision, 15.0) == []
        share, std = decision.fault
        assert np.abs(share * TWIN_SPEED + takes).max() < 0.25 * takes
        assert (std * TWIN_SPEED < 0.2 * takes).all()
        assert np.abs(decision.model.expected_rad_s - healthy).mean() < 0.07 * takes


def test_an_alarm_stays_while_the_command_moves_and_clears_once_ten_seconds_after_its_fault() -> None:
    """Two fans each with more drag, less drive, and more friction, which take 8 to 12 %."""
    columns = np.repeat([DRAG, DRIVE, FRICTION], 2)
    fans = list(range(len(columns)))
    made = MadeFans(twin_of(len(columns)).fans, 0.2, moving, seed=2)
    decision = made.decision()
    made.fault_from_s = 20.0
    made.sizes[fans, columns] = -0.12
    raised = plays(made, decision, 30.0)
    assert sorted((fan, is_raised) for _, fan, is_raised in raised) == [(fan, True) for fan in fans]
    assert plays(made, decision, 60.0) == []
    ends_s, made.sizes[:] = made.time_s, 0.0
    cleared = plays(made, decision, OVER_S + 5.0)
    assert sorted(fan for _, fan, _ in cleared) == fans
    assert all(OVER_S <= time_s - ends_s < OVER_S + 4.0 and not is_raised for time_s, _, is_raised in cleared)


def test_a_small_fault_of_which_each_reading_of_a_coarse_tacho_says_little_does_not_outlive_its_end() -> None:
    """A count says 3 rad/s, the fault takes 4."""
    tacho = Tacho(kind="count", pulses=2, window_s=1.0)
    made = MadeFans(twin_of(FANS, tachos=(tacho,)).fans, 1.0, lambda _time_s: 100.0, seed=0, own=0.3)
    decision = made.decision(declared_s=86400.0)
    assert plays(made, decision, 60.0) == []
    made.fault_from_s, made.sizes[:, DRIVE] = 60.0, -0.016
    raised = {fan for _, fan, is_raised in plays(made, decision, 300.0) if is_raised}
    ends_s, made.sizes[:] = made.time_s, 0.0
    cleared = {fan: time_s - ends_s for time_s, fan, is_raised in plays(made, decision, 250.0) if not is_raised}
    assert raised and raised <= cleared.keys() and max(cleared.values()) < 250.0


COUNTING = Tacho(kind="count", pulses=2, window_s=1.0)


def with_drop(made: MadeFans, decision: Decision, share: Array | float, seconds: float) -> Changes:
    """What a decision says while the readings are lower by a share of the speed, or one of each fan."""
    return plays(made, decision, seconds, lambda one: with_reading(one, one.deviation_rad_s - share * TWIN_SPEED))


def test_the_alarm_of_a_small_fault_follows_it_for_long_also_when_it_grows_and_clears_after_it() -> None:
    fans = replace(twin_of(2, tachos=(COUNTING,)).fans, noise_rad_s=np.full(2, 0.8))
    made, later = MadeFans(fans, 1.0, steady, seed=2, own=0.0), np.array([0.02, 0.3])
    decision = made.decision()
    plays(made, decision, 150.0)
    assert sorted(each[1:] for each in with_drop(made, decision, 0.02, 600.0)) == [(0, True), (1, True)]
    assert with_drop(made, decision, later, 60.0) == []
    np.testing.assert_allclose(decision.fault[0], -later, rtol=0.3)
    assert sorted(each[1:] for each in plays(made, decision, 60.0)) == [(0, False), (1, False)]


def test_an_alarm_stays_while_anything_is_left_of_its_fault_or_it_becomes_its_opposite_and_ends_at_one_pace() -> None:
    """A fault that becomes its opposite, a fan that loses nearly all of its speed, one of which a third of the fault
    remains, and one with a drive of its own and a tacho that counts."""
    fans = twin_of(4, tachos=(Tacho(), Tacho(), Tacho(), COUNTING)).fans
    made = MadeFans(replace(fans, has_own_drive=np.arange(4) == 3), 0.2, steady, seed=2, own=0.0)
    decision, first, then = made.decision(), np.array([0.3, 0.9, 0.3, 0.2]), np.array([-0.2, 0.9, 0.1, 0.2])
    plays(made, decision, 20.0)
    raised = [each for shares in (first, then) for each in with_drop(made, decision, shares, 30.0)]
    assert sorted(each[1:] for each in raised) == [(fan, True) for fan in range(4)]
    share = decision.fault[0]
    assert share[0] == pytest.approx(0.2, rel=0.1) and not decision.is_returning[0]
    assert (share[1:] >= -1.0).all() and (share[1:] < -0.7 * then[1:]).all()
    assert all(decision.alarms.causes(fan)[0].probability > 0.0 for fan in range(4))
    ends_s = made.time_s
    cleared = plays(made, decision, 30.0)
    assert sorted(each[1:] for each in cleared) == [(fan, False) for fan in range(4)]
    assert all(time_s - ends_s < 2.0 * OVER_S for time_s, _, _ in cleared)


def test_the_causes_of_a_fan_do_not_depend_on_which_others_have_an_alarm() -> None:
    found = []
    for faults in ({1: 20.0}, {0: 15.0, 1: 20.0, 2: 20.0, 3: 26.0}):
        made = MadeFans(twin_of(4).fans, 0.2, moving, seed=3, own=0.3)
        decision = made.decision()
        made.fault_from_s = 15.0
        plays(made, decision, 15.0)
        for _ in range(30):
            made.sizes[:, DRIVE] = [-0.12 * (made.time_s >= faults.get(fan, np.inf)) for fan in range(4)]
            made.sizes[0, DRIVE] *= made.time_s < 22.0  # it ends while the others last
            plays(made, decision, 1.0)
        assert set(decision.alarms.fans) == set(faults) - {0}
        found.append([(each.cause, each.probability, each.change) for each in decision.alarms.causes(1)[:2]])
    alone, among_others = found
    assert [cause for cause, *_ in alone] == [cause for cause, *_ in among_others]
    np.testing.assert_allclose([each[1:] for each in alone], [each[1:] for each in among_others], atol=2e-3)


def test_a_fan_whose_speed_varies_is_unsteady_and_its_alarm_stays_until_it_is_steady_again() -> None:
    made = MadeFans(twin_of(2).fans, 0.1, moving, seed=6)
    decision = made.decision()
    made.fault_from_s = 20.0
    assert plays(made, decision, 20.0) == []
    changes, is_returning = [], []
    for number in range(500):
        made.sizes[0, DRAG] = 0.06 * math.sin(2.0 * math.pi * number * made.bin_s / 3.0)
        changes += plays(made, decision, made.bin_s)
        is_returning.append(bool(decision.is_returning[0]))
    assert [each[1:] for each in changes] == [(0, True)]
    assert not any(is_returning[250:])
    first = decision.alarms.causes(0)[0]
    assert (first.cause, first.probability > 0.95) == ("unsteady", True)
    assert 1.5 < first.change < 3.0, "times as much as a healthy fan"
    ends_s, made.sizes[:] = made.time_s, 0.0
    (over,) = plays(made, decision, OVER_S + 16.0)
    assert over[1:] == (0, False) and OVER_S <= over[0] - ends_s < OVER_S + 15.0


def test_what_the_filter_took_of_a_large_fault_before_its_alarm_is_given_back() -> None:
    """The speed falls when the fault begins: what it takes looks like a lag at first."""
    made = MadeFans(twin_of(4).fans, 0.1, lambda time_s: 320.0 - 60.0 * min(max(time_s - 20.0, 0.0), 2.0), seed=6)
    decision = made.decision()
    assert plays(made, decision, 20.0) == []
    before, std = decision.model.mean[:, SLOW].copy(), np.sqrt(np.einsum("nii->ni", decision.model.covariance)[:, SLOW])
    made.fault_from_s, made.sizes[:, DRAG] = 20.0, -0.6
    assert len(plays(made, decision, 1.0)) == 4
    assert np.all(np.abs(decision.model.mean[:, SLOW] - before) < 0.5 * std)
