"""What a replay that verifies a recording compares: decisions exactly, numbers within a tolerance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.pipeline.replay.offline.comparison import Comparison
from fantwin.pipeline.replay.offline.verify import AT_A_LIMIT, RecordedSession, compare_alarms, compare_scores
from fantwin.schemas.enums import FanState, Severity, Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Diagnosis, Score
from tests.support import made_messages
from tests.support.score_data import made_up_tray


def alarm(transition: Transition, message: str) -> Alarm:
    return made_messages.alarm(active=False, onset_t_ns=5, residual_rad_s=3.0, message=message, transition=transition)


def drag_up(change: float) -> Diagnosis:
    return Diagnosis(cause="drag_up", probability=0.7, parameter="drag", change=change)


@pytest.mark.parametrize(("factor", "equal"), [(1.0, 1), (1.0 + 1e-11, 1), (1.0 + 1e-5, 0)])
def test_numbers_of_alarms_may_differ_in_their_last_digits_only(factor: float, equal: int) -> None:
    made = replace(alarm(Transition.DIAGNOSED, "fan 0: more drag"), causes=(drag_up(0.2),), score=1.5)
    for recorded in (replace(made, causes=(drag_up(0.2 * factor),)), replace(made, score=1.5 * factor)):
        found = Comparison("tray1")
        compare_alarms([made], [recorded], 100, found)
        assert (found.alarms_equal, found.alarms_different) == (equal, 1 - equal)


@pytest.mark.parametrize(
    "change",
    [
        {"severity": Severity.WARNING},
        {"onset_t_ns": 6},
        {"acknowledged": True},
        {"causes": (Diagnosis(cause="cannot_tell", probability=0.3), drag_up(0.2))},
        {"message": "fan 0: less drag"},
    ],
    ids=lambda change: next(iter(change)),
)
def test_decisions_on_alarms_are_compared_exactly(change) -> None:
    made = replace(
        alarm(Transition.DIAGNOSED, "fan 0: more drag"),
        causes=(drag_up(0.2), Diagnosis(cause="cannot_tell", probability=0.3)),
    )
    found = Comparison("tray1")
    compare_alarms([made], [replace(made, **change)], 100, found)
    assert (found.alarms_equal, found.alarms_different) == (0, 1)
    assert f"{next(iter(change))} differs" in found.named[0] or ".cause differs" in found.named[0]


def three_samples() -> Score:
    (score,), _ = made_up_tray(fans=2, seconds=0.03, block=3, faulty_fan=None, gap_fan=None)
    return score


def compared(made: Score, recorded: Score) -> Comparison:
    found = Comparison("tray1")
    message = replace(recorded, header=Header("scorer-1", 0, "tray1"))
    envelope = Envelope.of("fantwin/site/tray1/score", message, 0)
    compare_scores(made, RecordedSession([envelope], "scorer-1", Score), found)
    return found


def test_numbers_of_samples_may_differ_within_the_tolerance_and_the_largest_difference_is_known() -> None:
    made = three_samples()
    found = compared(made, made)
    assert (found.equal, found.different, found.largest.share) == (3, 0, 0.0)
    speed = made.predicted_speed_rad_s.copy()
    speed[1, 0] = np.nextafter(speed[1, 0], np.float32(np.inf))
    found = compared(made, replace(made, predicted_speed_rad_s=speed))
    assert (found.equal, found.different) == (3, 0)
    assert found.largest.name == "predicted_speed_rad_s" and 0.0 < found.largest.share < 0.2
    speed[1, 0] *= 1 + 1e-5
    found = compared(made, replace(made, predicted_speed_rad_s=speed))
    assert (found.equal, found.different, found.numbers_different) == (2, 1, 1)
    (line,) = found.named
    assert "fan 0: predicted_speed_rad_s" in line and AT_A_LIMIT not in line
    speed[1, 0] = np.nan
    assert compared(made, replace(made, predicted_speed_rad_s=speed)).different == 1


def test_a_decision_that_a_number_at_its_limit_turns_is_a_difference_with_its_reason() -> None:
    made = three_samples()
    score, state = np.full_like(made.score, 0.5), made.state.copy()
    score[2, 1] = 1.0 - 1e-7
    made = replace(made, score=score)
    score, state = score.copy(), state.copy()
    score[2, 1], state[2, 1] = 1.0 + 1e-7, FanState.ALARM
    found = compared(made, replace(made, score=score, state=state))
    assert (found.equal, found.different, found.numbers_different) == (2, 1, 0)
    (line,) = found.named
    assert "fan 1: state" in line and line.endswith(AT_A_LIMIT)
    compare_alarms([], [alarm(Transition.RAISED, "fan 1: raised")], 100, found)
    assert found.alarms_different == 1 and "none replayed (although all numbers agree" in found.named[1]
