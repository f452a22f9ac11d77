"""What a replay that verifies a recording compares: decisions exactly, numbers within a tolerance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.pipeline.replay.offline.comparison import Comparison
from fantwin.pipeline.replay.offline.verify import AT_A_LIMIT, RecordedSamples, compare_alarms, compare_samples
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


OTHER = Diagnosis(cause="cannot_tell", probability=0.3)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"score": 1.5 * (1 + 1e-11), "causes": (drag_up(0.2 * (1 + 1e-11)), OTHER)}, ""),
        ({"score": 1.5 * (1 + 1e-5)}, "score"),
        ({"causes": (drag_up(0.2 * (1 + 1e-5)), OTHER)}, "causes.0.change"),
        ({"causes": (OTHER, drag_up(0.2))}, "causes.0.cause"),
        ({"severity": Severity.WARNING}, "severity"),
        ({"onset_t_ns": 6}, "onset_t_ns"),
        ({"acknowledged": True}, "acknowledged"),
        ({"message": "fan 0: less drag"}, "message"),
    ],
    ids=str,
)
def test_numbers_of_alarms_may_differ_in_their_last_digits_and_decisions_not_at_all(change, where: str) -> None:
    made = replace(alarm(Transition.DIAGNOSED, "fan 0: more drag"), causes=(drag_up(0.2), OTHER), score=1.5)
    found = Comparison("tray1")
    compare_alarms([made], [replace(made, **change)], 100, found)
    assert (found.counts["alarms_equal"], found.counts["alarms_different"]) == (not where, bool(where))
    assert not where or f" {where} differs" in found.named[0]


def three_samples() -> Score:
    (score,), _ = made_up_tray(fans=2, seconds=0.03, block=3, faulty_fan=None, gap_fan=None)
    return score


def compared(made: Score, recorded: Score) -> Comparison:
    found = Comparison("tray1")
    message = replace(recorded, header=Header("scorer-1", 0, "tray1"))
    envelope = Envelope.of("fantwin/site/tray1/score", message, 0)
    compare_samples(made, RecordedSamples([envelope], "scorer-1", Score), found)
    return found


def test_numbers_of_samples_may_differ_within_the_tolerance_and_the_largest_difference_is_known() -> None:
    made = three_samples()
    found = compared(made, made)
    assert (found.counts["samples_equal"], found.counts["samples_different"], found.largest.share) == (3, 0, 0.0)
    speed = made.predicted_speed_rad_s.copy()
    speed[1, 0] = np.nextafter(speed[1, 0], np.float32(np.inf))
    found = compared(made, replace(made, predicted_speed_rad_s=speed))
    assert (found.counts["samples_equal"], found.counts["samples_different"]) == (3, 0)
    assert found.largest.name == "predicted_speed_rad_s" and 0.0 < found.largest.share < 0.2
    speed[1, 0] *= 1 + 1e-5
    found = compared(made, replace(made, predicted_speed_rad_s=speed))
    assert (found.counts["samples_equal"], found.counts["samples_different"], found.numbers_different) == (2, 1, 1)
    (line,) = found.named
    assert "fan 0: predicted_speed_rad_s" in line and AT_A_LIMIT not in line
    speed[1, 0] = np.nan
    assert compared(made, replace(made, predicted_speed_rad_s=speed)).counts["samples_different"] == 1


def test_a_decision_that_a_number_at_its_limit_turns_is_a_difference_with_its_reason() -> None:
    made = three_samples()
    score, state = np.full_like(made.score, 0.5), made.state.copy()
    score[2, 1] = 1.0 - 1e-7
    made = replace(made, score=score)
    score, state = score.copy(), state.copy()
    score[2, 1], state[2, 1] = 1.0 + 1e-7, FanState.ALARM
    found = compared(made, replace(made, score=score, state=state))
    assert (found.counts["samples_equal"], found.counts["samples_different"], found.numbers_different) == (2, 1, 0)
    (line,) = found.named
    assert "fan 1: state" in line and line.endswith(AT_A_LIMIT)
    compare_alarms([], [alarm(Transition.RAISED, "fan 1: raised")], 100, found)
    assert found.counts["alarms_different"] == 1 and "none replayed (although all numbers agree" in found.named[1]
