"""What a scorer remembers over a gap: its baselines and its alarms, and nothing that is of the moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from schemas.enums import FanState, InvalidReason, Transition
from schemas.messages import Alarm, Prediction
from stages.scorer import ScorerCore
from tests.support.scored_blocks import LIVELY, commissioned, core_of, feed, prediction_of, snapshot_of

FAULT, HEALTHY = 60.0, 0.0
HZ = 100


def stretch(level: float, seconds: float, first: int, *, balance: float = 0.0, speed_from_s: float = 0.0) -> Prediction:
    """Samples from number `first` on. speed_from_s: before it the free run warms up."""
    samples = round(seconds * HZ)
    noise = np.random.default_rng(first).normal(0.0, 1.0, samples)
    speed_known = np.arange(samples) >= speed_from_s * HZ
    prediction = prediction_of(level + noise, balance=balance + 0.05 * noise, first=first)
    reason = np.where(speed_known, InvalidReason.NONE, InvalidReason.WARMING_UP)[:, np.newaxis].astype(np.uint8)
    return prediction_with(prediction, reason)


def prediction_with(prediction: Prediction, invalid_reason: np.ndarray) -> Prediction:
    return replace(prediction, valid=invalid_reason == InvalidReason.NONE, invalid_reason=invalid_reason)


def calibrated() -> ScorerCore:
    return commissioned(core_of(calibration=LIVELY, off_delay_s=0.5))


def transitions(alarms: list[Alarm]) -> list[Transition]:
    return [alarm.transition for alarm in alarms if alarm.transition != Transition.DIAGNOSED]


@pytest.mark.parametrize("gap_s", [6.0, 86_400.0])
def test_row_06_a_fault_repaired_during_a_gap_raises_no_alarm_again(gap_s: float) -> None:
    core = calibrated()
    _, before = feed(core, [stretch(FAULT, 5.0, 0, balance=10.0)])
    assert transitions(before)[0] == Transition.RAISED
    # the torque balance is known at once and shows a healthy fan; the free run warms up for three seconds
    _, after = feed(core, [stretch(HEALTHY, 60.0, 500 + round(gap_s * HZ), speed_from_s=3.0)])
    assert Transition.RAISED not in transitions(after), [alarm.message for alarm in after]
    assert transitions(after) == [Transition.DATA_LOST, Transition.DATA_RESTORED, Transition.CLEARED]
    assert [alarm.stale for alarm in after] == [True, False, False]
    assert not after[-1].causes or after[-1].causes == before[-1].causes
    assert core.counters()["alarms_raised"] == 1


def test_row_06_an_alarm_persists_over_a_gap_and_says_that_data_do_not_confirm_it() -> None:
    core = calibrated()
    feed(core, [stretch(FAULT, 5.0, 0)])
    silent = prediction_of(np.full(500, np.nan), np.zeros(500, np.bool_), first=500)
    scores, lost = feed(core, [silent])
    assert transitions(lost) == [Transition.DATA_LOST]
    assert (lost[0].active, lost[0].stale) == (True, True)
    assert lost[0].message == "fan 0: not confirmed by data: there are no samples to judge"
    assert (lost[0].t_ns - silent.t_ns[0]) / 1e9 == pytest.approx(2.0), "while the line is silent, not after it"
    assert (scores[0].state == FanState.UNKNOWN).all()
    _, again = feed(core, [stretch(FAULT, 5.0, 1000)])
    assert transitions(again) == [Transition.DATA_RESTORED], "the same occurrence, neither cleared nor raised"
    assert (again[0].active, again[0].stale) == (True, False)
    assert again[0].onset_t_ns == lost[0].onset_t_ns


def test_row_06_a_small_fault_that_only_adds_up_slowly_keeps_its_alarm_over_a_gap() -> None:
    slow = LIVELY | {"detectors": {"speed_drift": {"limit": 30.0, "period_s": 0.01, "reference_sigmas": 0.5}}}
    core = commissioned(core_of(calibration=slow, off_delay_s=0.5))
    _, before = feed(core, [stretch(4.0, 60.0, 0)])
    assert transitions(before) == [Transition.RAISED]
    _, after = feed(core, [stretch(4.0, 60.0, 60 * HZ + 6000)])
    assert transitions(after) == [Transition.DATA_LOST, Transition.DATA_RESTORED]


def test_row_06_a_short_gap_changes_nothing() -> None:
    core = calibrated()
    feed(core, [stretch(FAULT, 5.0, 0)])
    state = core.restore(snapshot_of(core))
    assert state
    _, after = feed(core, [stretch(FAULT, 1.0, 500 + 40)])
    assert transitions(after) == []


def test_row_06_an_excursion_does_not_continue_after_a_gap() -> None:
    core = commissioned(core_of(calibration=LIVELY, on_delay_s=0.5))
    feed(core, [stretch(FAULT, 0.3, 0)])
    scores, alarms = feed(core, [stretch(FAULT, 1.0, 3000)])
    assert transitions(alarms) == [Transition.RAISED]
    assert alarms[0].onset_t_ns >= scores[0].t_ns[0]


def test_row_06_a_restart_of_the_scorer_is_a_gap_like_any_other() -> None:
    core = calibrated()
    feed(core, [stretch(FAULT, 5.0, 0)])
    successor = core_of(calibration=LIVELY, off_delay_s=0.5)
    successor.restore(snapshot_of(core))
    _, after = feed(successor, [stretch(HEALTHY, 60.0, 360_000, speed_from_s=3.0)])
    assert transitions(after) == [Transition.DATA_LOST, Transition.DATA_RESTORED, Transition.CLEARED]
