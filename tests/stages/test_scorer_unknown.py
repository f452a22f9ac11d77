"""What is wrong, missing or not known for a while, as a scorer takes it, of one fan."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.schemas.enums import Action, FanState, InvalidReason, Transition
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.scoring.model.healthy import RISE
from tests.support.scored_blocks import NEEDED, TWIN_SPEED, core_of, prediction_of, request_of

STANDS = Standstill(
    turning_command=20.0, standing_below_rad_s=50.0, off_command=5.0, start_s=2.0, coast_s=3.0, slowing_s=1.0
)
Floats = NDArray[np.float64]


class Fan:
    """A fan that is fed to a scorer, and what this has emitted."""

    def __init__(self, core: ScorerCore, rate_hz: int = 10) -> None:
        self.core, self.rate_hz, self.samples, self.alarms = core, rate_hz, 0, list[Alarm]()
        self._rng = np.random.default_rng(1)

    def runs(
        self,
        seconds: float,
        speed: Floats | float = TWIN_SPEED,
        reason: InvalidReason = InvalidReason.NONE,
        *,
        predicted: Floats | float = TWIN_SPEED,
        balance: float = np.nan,
        noise_rad_s: float = 2.0,
    ) -> Score:
        """Feed readings of a speed; NaN: there is none."""
        count = round(seconds * self.rate_hz)
        measured = np.broadcast_to(speed, count) + self._rng.normal(0.0, noise_rad_s, count)
        valid = np.full((count, 1), reason == InvalidReason.NONE)
        lost = np.isnan(measured)[:, np.newaxis] & (reason in (InvalidReason.NONE, InvalidReason.NO_SPEED))
        why = np.where(lost, InvalidReason.NO_SPEED, reason).astype(np.uint8)
        of_twin = np.broadcast_to(predicted, count)[:, np.newaxis]
        item = replace(
            prediction_of(np.zeros((count, 1)), first=self.samples, period_ns=1_000_000_000 // self.rate_hz),
            command=of_twin * NEEDED / TWIN_SPEED,
            measured_speed_rad_s=measured[:, np.newaxis],
            predicted_speed_rad_s=of_twin,
            valid=valid & ~lost,
            invalid_reason=why,
            reading_missing=lost,
            torque_balance_command=np.full((count, 1), balance),
        )
        self.samples += count
        (score,) = self._take(item)
        return score

    def take(self, message: Any) -> None:
        self._take(message)

    def _take(self, message: Any) -> list[Score]:
        emitted = self.core.step(message)
        self.alarms += [each for each in emitted if isinstance(each, Alarm)]
        return [each for each in emitted if isinstance(each, Score)]

    @property
    def transitions(self) -> list[Transition]:
        return [each.transition for each in self.alarms]


def test_where_a_counting_tacho_cannot_be_compared_with_the_twin_its_fan_is_not_said_to_be_normal() -> None:
    fan = Fan(core_of(tachos=(Tacho(kind="count", window_s=1.0),)))
    fan.runs(3.0)
    score = fan.runs(20.0, 150.0, InvalidReason.OUT_OF_RANGE, balance=25.0)
    assert (score.state == FanState.UNKNOWN).all() and not score.valid.any()
    assert "outside the twin's range" in fan.core.problem()
    judged = Fan(core_of())
    judged.runs(3.0)
    judged.runs(3.0, 150.0, InvalidReason.OUT_OF_RANGE, balance=25.0)
    assert judged.transitions[0] == Transition.RAISED, "an instantaneous tacho shows it in the torque balance"


def test_one_wrong_reading_of_0_in_an_alarm_does_not_make_it_a_fan_that_stands() -> None:
    fan = Fan(core_of())
    fan.runs(8.0)
    fan.runs(6.0, 260.0)
    named = fan.alarms[-1]
    fan.runs(0.1, 0.0)
    fan.runs(1.2, 260.0)
    assert named.active and all("does not turn" not in each.message for each in fan.alarms)
    assert [each.cause for each in fan.core.tray.causes(0)] == [each.cause for each in named.causes]


def test_the_alarm_of_a_stuck_tacho_clears_also_after_a_gap_in_which_the_fan_came_back_to_the_stuck_speed() -> None:
    fan = Fan(core_of())
    fan.runs(6.0)
    fan.runs(6.0, 299.0, predicted=200.0 + 100.0 * np.exp(-np.arange(1, 61) / 6.0), noise_rad_s=0.0)
    assert fan.alarms[-1].active
    fan.samples += 700
    fan.runs(18.0)
    assert fan.alarms[-1].transition == Transition.CLEARED


@pytest.mark.parametrize("between", [[], [np.nan], [np.nan, np.nan], [np.nan] * 8])
def test_two_wrong_readings_do_not_agree_because_of_those_that_are_missing_between_them(between: list[float]) -> None:
    fan = Fan(core_of())
    fan.runs(15.0)
    readings = np.array([150.0, *between, 150.0])
    scores = [fan.runs(len(readings) / 10, readings), fan.runs(3.0)]
    assert fan.alarms == []
    assert max(np.nanmax(each.score) for each in scores) < 0.5


def test_a_silent_line_is_no_movement_of_the_fan() -> None:
    fan = Fan(core_of())
    slower, quicker = 300.0, 300.0
    ends = np.repeat([160.0, 300.0] * 7, 30)
    path = []
    for end in ends:
        slower += (end - slower) * (1.0 - np.exp(-0.1 / 0.75))
        quicker += (end - quicker) * (1.0 - np.exp(-0.1 / 0.6))
        path.append((slower, quicker))
    measured, predicted = np.array(path).T
    fan.runs(len(ends) / 10, measured, predicted=predicted)
    fan.runs(3.0)
    model = fan.core.tray._decision.model
    before = model.mean[0].copy()
    fan.runs(3.0, np.nan, InvalidReason.STALE, predicted=np.nan)
    score = fan.runs(3.0)
    assert before[RISE] > 0.05, "it is slower to rise than its twin"
    assert np.abs(score.expected_residual_rad_s).max() < 10.0
    assert abs(model.mean[0, RISE] - before[RISE]) < 0.02


def test_a_fan_that_stands_is_not_judged_while_its_line_is_silent() -> None:
    fan = Fan(core_of(standstill=STANDS))
    fan.runs(6.0)
    fan.runs(2.0, 0.0)
    assert fan.alarms[-1].active
    score = fan.runs(4.0, np.nan, InvalidReason.STALE)
    assert not score.valid[10:].any() and (score.invalid_reason[10:] == InvalidReason.STALE).all()
    assert Transition.DATA_LOST in fan.transitions


def test_a_fan_that_starts_after_a_long_stop_is_not_suspect_for_the_time_in_which_it_stood() -> None:
    fan = Fan(core_of(config={"false_alarms_per_day": 1.0}), rate_hz=1)
    fan.runs(30.0)
    fan.runs(600.0, 0.0, InvalidReason.STOPPED, predicted=np.nan)
    score = fan.runs(5.0)
    assert (score.state == FanState.NORMAL).all() and score.score.max() < 0.3


def test_commissioning_ends_the_alarm_of_a_fan_whose_line_is_silent() -> None:
    fan = Fan(core_of())
    fan.runs(8.0)
    fan.runs(6.0, 250.0)
    fan.runs(4.0, np.nan, InvalidReason.STALE)
    assert fan.alarms[-1].active
    fan.take(request_of(Action.COMMISSION))
    fan.runs(1.0, np.nan, InvalidReason.STALE)
    assert not fan.alarms[-1].active


def test_a_fan_that_stands_beyond_the_range_of_its_twin_has_an_alarm_whatever_its_last_judged_reading_was() -> None:
    fan = Fan(core_of(standstill=STANDS), 1)
    fan.runs(60.0)
    fan.runs(1.0, TWIN_SPEED * 1.2)  # far, and the last that is compared with the twin: it may be wrong
    fan.runs(30.0, reason=InvalidReason.OUT_OF_RANGE)
    fan.runs(10.0, 0.0, InvalidReason.OUT_OF_RANGE, noise_rad_s=0.0)
    assert [alarm.transition for alarm in fan.alarms][:1] == [Transition.RAISED]
    assert "does not turn although commanded" in fan.alarms[0].message
