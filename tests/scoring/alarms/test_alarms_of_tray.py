"""States of alarms: what raises and clears them, what operators may ask, and that nothing is forgotten."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy

import numpy as np
import pytest

from fantwin.schemas.enums import Action, Severity, Transition
from fantwin.scoring.alarms.alarm_state import DATA_LOST_AFTER_NS, UNTIL_IT_CLEARS_T_NS, is_retained, is_silenced
from fantwin.scoring.alarms.alarms_of_tray import AlarmsOfTray, Decided

STEP_NS = DATA_LOST_AFTER_NS * 2 // 7
RAISED, CLEARED, UNSHELVED = Transition.RAISED, Transition.CLEARED, Transition.UNSHELVED
UP, LOW, HIGH = 1, 0, 2
"""an active alarm, none, and an active one of severity ALARM"""
ONSET_NS = 7


def decided(number: int, active: Sequence[int], judged: Sequence[bool]) -> Decided:
    """What is decided at the end of a bin, of each fan."""
    t_ns = number * STEP_NS
    return Decided(
        t_ns, np.array(judged), np.array(active) > 0, np.array(active), np.full(len(active), t_ns - ONSET_NS), STEP_NS
    )


def take(
    conditions: AlarmsOfTray, active: Sequence[int], judged: Sequence[bool] | None = None, first: int = 0
) -> list[tuple[int, Transition]]:
    """The transitions of one fan, each with the number of its decision."""
    judged = [True] * len(active) if judged is None else judged
    found = []
    for number, (each, is_judged) in enumerate(zip(active, judged, strict=True), first):
        found += [(number, e.transition) for e in conditions.update(decided(number, [each], [is_judged]))]
    return found


def asked(
    conditions: AlarmsOfTray, action: Action, now_t_ns: int = 0, duration_ns: float = 0
) -> tuple[Transition, str]:
    ((_, transition, why),) = conditions.request(action, [0], now_t_ns, duration_ns, "Ann", "looked at it")
    return transition, why


def test_an_alarm_is_raised_with_its_onset_and_cleared_at_what_was_decided() -> None:
    conditions = AlarmsOfTray.begin(1)
    assert take(conditions, [LOW, UP, UP, LOW, LOW]) == [(1, RAISED), (3, CLEARED)]
    assert conditions.alarm_state(0).onset_t_ns == STEP_NS - ONSET_NS
    assert not conditions.active[0]


def test_what_was_not_judged_raises_and_clears_nothing_and_makes_an_alarm_stale_after_a_time() -> None:
    conditions = AlarmsOfTray.begin(1)
    assert take(conditions, [UP], [False]) == []
    judged = [True, *[False] * 6, True]
    assert take(conditions, [UP, *[LOW] * 6, UP], judged) == [
        (0, RAISED),
        (4, Transition.DATA_LOST),
        (7, Transition.DATA_RESTORED),
    ]
    assert conditions.active[0] and not conditions.alarm_state(0).stale


def test_severity_rises_and_does_not_fall_before_the_next_alarm() -> None:
    conditions = AlarmsOfTray.begin(1)
    found = []
    for number, each in enumerate([UP, HIGH, UP, LOW, UP]):
        events = conditions.update(decided(number, [each], [True]))
        found += [(number, event.transition, event.alarm_state.severity) for event in events]
    assert found == [
        (0, RAISED, Severity.WARNING),
        (1, Transition.SEVERITY, Severity.ALARM),
        (3, CLEARED, Severity.ALARM),
        (4, RAISED, Severity.WARNING),
    ]


def test_an_acknowledged_alarm_is_done_once_it_has_cleared():
    conditions = AlarmsOfTray.begin(1)
    take(conditions, [UP, LOW])
    assert is_retained(conditions.alarm_state(0))
    assert asked(conditions, Action.ACKNOWLEDGE) == (Transition.ACKNOWLEDGED, "")
    now = conditions.alarm_state(0)
    assert (is_retained(now), now.acknowledged_by, now.comment) == (False, "Ann", "looked at it")
    take(conditions, [UP])
    now = conditions.alarm_state(0)
    assert (now.acknowledged, now.acknowledged_by) == (False, "")


@pytest.mark.parametrize(
    ("before", "action", "why"),
    [
        ((), Action.ACKNOWLEDGE, "no alarm has been raised"),
        ((UP, Action.ACKNOWLEDGE), Action.ACKNOWLEDGE, "it is acknowledged already"),
        ((Action.SHELVE,), Action.SHELVE, "it is shelved until it clears already"),
        ((), Action.UNSHELVE, "it is not shelved"),
        ((Action.OUT_OF_SERVICE,), Action.OUT_OF_SERVICE, "it is out of service already"),
        ((), Action.IN_SERVICE, "it is in service already"),
        ((), Action.NONE, "no action is named"),
    ],
)
def test_an_invalid_request_is_refused_in_plain_words_and_changes_nothing(before, action, why):
    conditions = AlarmsOfTray.begin(1)
    for event in before:
        if isinstance(event, Action):
            assert asked(conditions, event)[0] != Transition.REFUSED
        else:
            take(conditions, [event])
    kept = deepcopy(conditions.conditions)
    assert asked(conditions, action) == (Transition.REFUSED, why)
    assert conditions.conditions == kept


@pytest.mark.parametrize("duration_ns", [-1, math.nan, 2**63 - 1])
def test_a_time_that_no_shelving_can_have_is_refused(duration_ns):
    refused = (Transition.REFUSED, "it cannot be shelved for such a time")
    assert asked(AlarmsOfTray.begin(1), Action.SHELVE, now_t_ns=5, duration_ns=duration_ns) == refused


def test_every_fan_asked_about_gets_exactly_one_answer():
    conditions = AlarmsOfTray.begin(2)
    answers = conditions.request(Action.OUT_OF_SERVICE, [1, 0, 2, -3], 0)
    assert [fan for fan, *_ in answers] == [1, 0, 2, -3]
    assert [transition for _, transition, _ in answers] == [Transition.OUT_OF_SERVICE] * 2 + [Transition.REFUSED] * 2


def test_a_timed_shelving_ends_with_the_first_decision_at_its_time_even_if_nothing_was_judged() -> None:
    conditions = AlarmsOfTray.begin(1)
    asked(conditions, Action.SHELVE, now_t_ns=0, duration_ns=3 * STEP_NS)
    assert take(conditions, [LOW] * 6, [True, True, True, False, False, True]) == [(3, UNSHELVED)]
    assert conditions.alarm_state(0).shelved_until_t_ns == 0


def test_a_shelved_alarm_is_evaluated_and_emitted_but_not_presented() -> None:
    conditions = AlarmsOfTray.begin(1)
    asked(conditions, Action.SHELVE, now_t_ns=0, duration_ns=4 * STEP_NS)
    assert take(conditions, [LOW, LOW, UP]) == [(2, RAISED)]
    assert is_silenced(conditions.alarm_state(0))
    assert take(conditions, [UP, UP], first=3) == [(4, UNSHELVED)]
    assert not is_silenced(conditions.alarm_state(0))


def test_a_shelving_without_a_time_ends_when_the_alarm_clears() -> None:
    conditions = AlarmsOfTray.begin(1)
    asked(conditions, Action.SHELVE)
    assert conditions.alarm_state(0).shelved_until_t_ns == UNTIL_IT_CLEARS_T_NS
    assert take(conditions, [LOW, UP, LOW, UP]) == [(1, RAISED), (2, CLEARED), (2, UNSHELVED), (3, RAISED)]


def test_out_of_service_hides_no_transition_and_presents_nothing():
    conditions = AlarmsOfTray.begin(1)
    asked(conditions, Action.OUT_OF_SERVICE)
    assert take(conditions, [UP]) == [(0, RAISED)]
    assert is_retained(conditions.alarm_state(0)) and is_silenced(conditions.alarm_state(0))
    asked(conditions, Action.IN_SERVICE)
    assert is_retained(conditions.alarm_state(0)) and not is_silenced(conditions.alarm_state(0))


def test_commissioning_is_granted_and_does_not_change_the_alarm():
    conditions = AlarmsOfTray.begin(1)
    take(conditions, [UP])
    before = conditions.alarm_state(0)
    assert conditions.request(Action.COMMISSION, [0], 0) == [(0, Transition.COMMISSIONING, "")]
    assert conditions.alarm_state(0) == before


def test_whatever_is_asked_raised_and_cleared_alternate_and_say_what_was_decided_last() -> None:
    for seed in range(20):
        rng, conditions, turns = np.random.default_rng(seed), AlarmsOfTray.begin(2), ([], [])
        active, judged = rng.choice([LOW, UP, HIGH], (60, 2)), rng.random((60, 2)) > 0.3
        for number, (now, is_judged) in enumerate(zip(active.tolist(), judged.tolist(), strict=True)):
            duration_ns = rng.choice([0, 3 * STEP_NS, 17 * STEP_NS])
            asked(conditions, rng.choice(list(Action)), STEP_NS * (number - 1), duration_ns)
            for each in conditions.update(decided(number, now, is_judged)):
                if each.transition in (RAISED, CLEARED):
                    turns[each.fan].append(each.transition)
        for fan, of_fan in enumerate(turns):
            assert of_fan == [CLEARED if i % 2 else RAISED for i in range(len(of_fan))] != []
            assert conditions.active[fan] == (active[judged[:, fan], fan][-1] > LOW)
