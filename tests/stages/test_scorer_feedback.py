"""Scorer: what operators say of an alarm, whether it was true, while it stands and after it."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.schemas.enums import Action, Feedback, Transition
from fantwin.schemas.messages import Alarm, Prediction
from fantwin.schemas.units import NS_PER_S
from tests.support.scored_blocks import core_of, feed, prediction_of, request_of, snapshot_of

PERIOD_NS = NS_PER_S
EXCURSION = [0.0] * 5 + [-90.0] * 6 + [0.0] * 19
"""deviation of 30 s: raises one alarm, and clears it"""
SEQUENCES = count()


def residuals(residual: list[float], first: int) -> Prediction:
    return prediction_of(np.array(residual), first=first, period_ns=PERIOD_NS)


def scorer() -> ScorerCore:
    core = core_of()
    feed(core, [residuals([0.0] * 30, first=-30)])
    return core


def excursions(core: ScorerCore, count: int, first: int = 0) -> list[int]:
    """Onsets of so many alarms."""
    alarms: list[Alarm] = []
    for number in range(first, first + count):
        alarms += feed(core, [residuals(EXCURSION, first=number * len(EXCURSION))])[1]
    return [alarm.onset_t_ns for alarm in alarms if alarm.transition == Transition.RAISED]


def asked(core: ScorerCore, action: Action, comment: str = "", **more: Any) -> Alarm:
    _, (answer,) = feed(core, [request_of(action, 0, sequence=next(SEQUENCES), comment=comment, **more)])
    return answer


def of(alarm: Alarm) -> tuple[Feedback, str, str]:
    return alarm.feedback, alarm.feedback_by, alarm.feedback_reason


def test_feedback_on_an_alarm_that_stands_is_in_every_message_about_it_and_not_in_those_about_the_next() -> None:
    core = scorer()
    _, (raised, *_) = feed(core, [residuals([-90.0] * 6, first=0)])
    answer = asked(core, Action.FALSE_ALARM, "a door was open")
    assert (answer.transition, answer.marked_onset_t_ns) == (Transition.MARKED_FALSE, raised.onset_t_ns)
    assert (answer.message, answer.comment) == ("fan 0: marked as a false alarm", "a door was open")
    assert (answer.active, answer.acknowledged, answer.severity) == (True, False, raised.severity), (
        "nothing else changes"
    )
    _, (*_, cleared) = feed(core, [residuals([0.0] * 20, first=6)])
    assert cleared.transition == Transition.CLEARED
    assert of(cleared) == of(answer) == (Feedback.FALSE_ALARM, answer.operator_name, "a door was open")
    assert cleared.marked_onset_t_ns == 0
    _, (raised_again, *_) = feed(core, [residuals([-90.0] * 6, first=26)])
    assert of(raised_again) == (Feedback.NONE, "", "")


def test_an_earlier_alarm_is_named_by_its_onset_to_within_a_second_and_what_cannot_be_granted_changes_nothing() -> None:
    core = scorer()
    none = asked(core, Action.TRUE_ALARM)
    assert none.message == "fan 0: refused: no alarm has been raised"
    onsets = excursions(core, 3)
    for onset, off_ns in zip(onsets, (999_999_999, -500_000_000, 0), strict=True):
        answer = asked(core, Action.TRUE_ALARM, onset_t_ns=onset - off_ns)
        nearest = min(onsets, key=lambda each: abs(each - onset + off_ns))
        assert (answer.transition, answer.marked_onset_t_ns) == (Transition.MARKED_TRUE, nearest)
    earlier = asked(core, Action.FALSE_ALARM, "test", onset_t_ns=onsets[0])
    assert (earlier.onset_t_ns, earlier.feedback) == (onsets[2], Feedback.TRUE_ALARM), "that of the last alarm stays"
    assert earlier.message == "fan 0: an earlier alarm is marked as a false alarm"
    assert asked(core, Action.FALSE_ALARM, "dust").marked_onset_t_ns == onsets[2], "without an onset it is the last one"
    for comment, onset_t_ns, why in (
        (" \t", 0, "fan 0: refused: a false alarm needs a reason: add a comment"),
        ("why", 5, "fan 0: refused: no alarm began then, or too many have been raised since"),
    ):
        refused = asked(core, Action.FALSE_ALARM, comment, onset_t_ns=onset_t_ns)
        assert (refused.message, refused.marked_onset_t_ns, refused.feedback_reason) == (why, 0, "dust")
    last = asked(core, Action.TRUE_ALARM)
    assert of(last) == (Feedback.TRUE_ALARM, last.operator_name, ""), "the last word counts, and needs no reason"


@pytest.mark.parametrize("is_of_another_twin", [False, True])
def test_after_a_restart_alarms_of_before_can_still_be_marked(is_of_another_twin: bool) -> None:
    core = scorer()
    onsets = excursions(core, 2)
    marked = asked(core, Action.FALSE_ALARM, "test run")
    successor = scorer()
    if is_of_another_twin:
        successor.tray.alarms.state = core.tray.alarms.state
        successor.tray.alarms.discard_all(onsets[1] + NS_PER_S, keep_silenced=True)
        answer = asked(successor, Action.TRUE_ALARM)
        assert (answer.marked_onset_t_ns, answer.feedback) == (onsets[1], Feedback.NONE)
    else:
        _, republished = successor.restore(snapshot_of(core))
        assert isinstance(republished, Alarm)
        assert (republished.transition, of(republished)) == (Transition.REPUBLISHED, of(marked))
        assert asked(successor, Action.TRUE_ALARM, onset_t_ns=onsets[0]).marked_onset_t_ns == onsets[0]
