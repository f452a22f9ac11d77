"""scoring.alarms.tray_conditions: the states of alarms, what operators may ask, and that nothing is forgotten."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.enums import Action, FanState, Severity, Transition
from scoring.alarms.alarm_flags import is_retained, is_silenced
from scoring.alarms.fan_condition import UNTIL_IT_CLEARS_T_NS, ConditionSettings
from scoring.alarms.tray_conditions import BlockResult, TrayConditions
from tests.support.score_alone import by_score, scores_alone

STEP_NS = 10
NORMAL, SUSPECT, ALARM, RETURNING = FanState.NORMAL, FanState.SUSPECT, FanState.ALARM, FanState.RETURNING
RAISED, CLEARED, UNSHELVED = Transition.RAISED, Transition.CLEARED, Transition.UNSHELVED
UP, MID, LOW, HIGH = 1.2, 0.8, 0.1, 1.6  # beyond the limit, between it and the return, returned, of severity ALARM


def conditions_of(fans: int = 1, on_delay_ns: int = 50, off_delay_ns: int = 100, **more: Any) -> TrayConditions:
    return TrayConditions(fans, ConditionSettings(on_delay_ns, by_score(off_delay_ns), **more))


def at_once(**more: Any) -> TrayConditions:
    return conditions_of(on_delay_ns=0, off_delay_ns=0, **more)


def take(
    conditions: TrayConditions, ratios: Sequence[float], valid: Sequence[bool] | None = None, first_t_ns: int = 0
) -> BlockResult:
    ratio = np.array(ratios, float)[:, None]
    mask = np.ones(ratio.shape, np.bool_) if valid is None else np.array(valid)[:, None]
    t_ns = first_t_ns + STEP_NS * np.arange(len(ratio))
    return conditions.update(*scores_alone(t_ns, STEP_NS, np.where(mask, ratio, np.nan)))


def happened(result: BlockResult) -> list[tuple[int, Transition]]:
    return [(change.row, change.transition) for change in result.events]


def states(conditions: TrayConditions, ratios: Sequence[float], valid: Sequence[bool] | None = None) -> list[int]:
    return take(conditions, ratios, valid).state[:, 0].tolist()


def asked(
    conditions: TrayConditions, action: Action, now_t_ns: int = 0, duration_ns: float = 0
) -> tuple[Transition, str]:
    ((_, transition, why),) = conditions.request(action, [0], now_t_ns, duration_ns, "Ann", "looked at it")
    return transition, why


def test_an_alarm_is_raised_exactly_when_the_on_delay_has_run_out():
    result = take(conditions_of(), [LOW, LOW] + [UP] * 7)
    assert result.state[:, 0].tolist() == [NORMAL] * 2 + [SUSPECT] * 5 + [ALARM] * 2
    (change,) = result.events
    assert (change.row, change.fan, change.transition, change.alarm_state.onset_t_ns) == (7, 0, RAISED, 2 * STEP_NS)


def test_an_excursion_one_sample_too_short_raises_nothing_and_is_counted():
    result = take(conditions_of(), [LOW] + [UP] * 5 + [LOW] + [UP] * 5 + [LOW])
    assert (result.events, result.too_short) == ([], 2)


def test_the_limit_itself_is_not_exceeded_and_the_limit_of_return_itself_is_no_return():
    assert states(at_once(), [1.0]) == [NORMAL]
    assert states(at_once(), [UP, 0.75]) == [ALARM] * 2


def test_an_alarm_is_cleared_exactly_when_the_off_delay_has_run_out():
    result = take(conditions_of(), [UP] * 6 + [MID] * 20 + [LOW] * 12)
    assert result.state[5:, 0].tolist() == [ALARM] * 21 + [RETURNING] * 10 + [NORMAL] * 2
    assert happened(result) == [(5, RAISED), (36, CLEARED)]
    assert [change.alarm_state.onset_t_ns for change in result.events] == [0, 0]


def test_a_return_that_is_interrupted_begins_again():
    ratios = [UP] * 6 + [LOW] * 10 + [MID] + [LOW] * 11
    assert states(conditions_of(), ratios)[6:] == [RETURNING] * 10 + [ALARM] + [RETURNING] * 10 + [NORMAL]


def test_samples_that_are_not_valid_stop_the_timers_and_end_nothing():
    valid = [True] * 3 + [False] * 50 + [True] * 3
    result = take(conditions_of(), [UP] * 56, valid)
    assert result.state[:, 0].tolist() == [SUSPECT] * 3 + [FanState.UNKNOWN] * 50 + [SUSPECT] * 2 + [ALARM]
    conditions = at_once()
    take(conditions, [UP])
    assert states(conditions, [LOW] * 9, [False] * 9) == [FanState.UNKNOWN] * 9
    assert conditions.alarm_state(0).active


def test_severity_rises_at_its_ratio_and_does_not_fall_before_the_next_alarm():
    result = take(at_once(), [UP, 1.5, UP, LOW, UP])
    reported = [(change.row, change.transition, change.alarm_state.severity) for change in result.events]
    assert reported == [
        (0, RAISED, Severity.WARNING),
        (1, Transition.SEVERITY, Severity.ALARM),
        (3, CLEARED, Severity.ALARM),
        (4, RAISED, Severity.WARNING),
    ]


B1 = [  # table B.1 of Part 9: what happens, then Active, Acked, Confirmed, Retain
    (UP, True, False, True, True),
    (Action.ACKNOWLEDGE, True, True, False, True),
    (LOW, False, True, False, True),
    (Action.CONFIRM, False, True, True, False),
    (UP, True, False, True, True),
    (LOW, False, False, True, True),
    (Action.ACKNOWLEDGE, False, True, False, True),
    (Action.CONFIRM, False, True, True, False),
]


def test_acknowledging_and_confirming_follow_table_b1_of_part_9():
    conditions = at_once(confirming=True)
    now = conditions.alarm_state(0)
    assert (now.active, now.acknowledged, now.confirmed, is_retained(now)) == (False, True, True, False)
    for event, *expected in B1:
        if isinstance(event, Action):
            assert asked(conditions, event)[0] != Transition.REFUSED
        else:
            take(conditions, [event])
        now = conditions.alarm_state(0)
        assert [now.active, now.acknowledged, now.confirmed, is_retained(now)] == expected, event


def test_without_confirming_an_acknowledged_alarm_is_done_once_it_has_cleared():
    conditions = at_once()
    take(conditions, [UP, LOW])
    assert is_retained(conditions.alarm_state(0))
    assert asked(conditions, Action.ACKNOWLEDGE) == (Transition.ACKNOWLEDGED, "")
    now = conditions.alarm_state(0)
    assert (is_retained(now), now.acknowledged_by, now.comment) == (False, "Ann", "looked at it")
    take(conditions, [UP])
    now = conditions.alarm_state(0)
    assert (now.acknowledged, now.acknowledged_by) == (False, "")


def test_a_latched_alarm_stays_until_it_is_reset_in_its_turn():
    conditions = at_once(latching=True, confirming=True)
    assert asked(conditions, Action.RESET)[1] == "it is not latched"
    take(conditions, [UP])
    assert asked(conditions, Action.RESET)[1] == "it is still active"
    take(conditions, [LOW])
    assert asked(conditions, Action.RESET)[1] == "it must be acknowledged first"
    asked(conditions, Action.ACKNOWLEDGE)
    assert asked(conditions, Action.RESET)[1] == "it must be confirmed first"
    asked(conditions, Action.CONFIRM)
    assert (conditions.alarm_state(0).latched, is_retained(conditions.alarm_state(0))) == (True, True)
    assert asked(conditions, Action.RESET) == (Transition.RESET, "")
    assert not is_retained(conditions.alarm_state(0))


@pytest.mark.parametrize(
    ("before", "action", "why"),
    [
        ((), Action.ACKNOWLEDGE, "no alarm has been raised"),
        ((UP, Action.ACKNOWLEDGE), Action.ACKNOWLEDGE, "it is acknowledged already"),
        ((UP,), Action.CONFIRM, "it must be acknowledged first"),
        ((UP, Action.ACKNOWLEDGE), Action.CONFIRM, "there is nothing to confirm"),
        ((Action.SHELVE,), Action.SHELVE, "it is shelved until it clears already"),
        ((), Action.UNSHELVE, "it is not shelved"),
        ((Action.SUPPRESS,), Action.SUPPRESS, "it is suppressed already"),
        ((), Action.UNSUPPRESS, "it is not suppressed"),
        ((Action.OUT_OF_SERVICE,), Action.OUT_OF_SERVICE, "it is out of service already"),
        ((), Action.IN_SERVICE, "it is in service already"),
        ((), Action.NONE, "no action is named"),
    ],
)
def test_an_invalid_request_is_refused_in_plain_words_and_changes_nothing(before, action, why):
    conditions = at_once()
    for event in before:
        if isinstance(event, Action):
            assert asked(conditions, event)[0] != Transition.REFUSED
        else:
            take(conditions, [event])
    kept = conditions.snapshot()
    assert asked(conditions, action) == (Transition.REFUSED, why)
    assert conditions.snapshot() == kept


@pytest.mark.parametrize("duration_ns", [-1, math.nan, 2**63 - 1])
def test_a_time_that_no_shelving_can_have_is_refused(duration_ns):
    refused = (Transition.REFUSED, "it cannot be shelved for such a time")
    assert asked(at_once(), Action.SHELVE, now_t_ns=5, duration_ns=duration_ns) == refused


def test_every_fan_asked_about_gets_exactly_one_answer():
    conditions = conditions_of(fans=2)
    answers = conditions.request(Action.SUPPRESS, [1, 0, 2, -3], 0)
    assert [fan for fan, *_ in answers] == [1, 0, 2, -3]
    assert [transition for _, transition, _ in answers] == [Transition.SUPPRESSED] * 2 + [Transition.REFUSED] * 2


def test_a_timed_shelving_ends_with_the_first_sample_at_its_time_even_if_that_is_not_valid():
    conditions = at_once()
    asked(conditions, Action.SHELVE, now_t_ns=0, duration_ns=3 * STEP_NS)
    result = take(conditions, [LOW] * 6, [True, True, True, False, False, True])
    assert happened(result) == [(3, UNSHELVED)]
    assert conditions.alarm_state(0).shelved_until_t_ns == 0


def test_a_shelved_alarm_is_evaluated_and_emitted_but_not_presented():
    conditions = at_once()
    asked(conditions, Action.SHELVE, now_t_ns=0, duration_ns=4 * STEP_NS)
    result = take(conditions, [LOW, LOW, UP, UP, UP])
    assert happened(result) == [(2, RAISED), (4, UNSHELVED)]
    assert [is_silenced(change.alarm_state) for change in result.events] == [True, False]


def test_a_shelving_without_a_time_ends_when_the_alarm_clears():
    conditions = at_once()
    asked(conditions, Action.SHELVE)
    assert conditions.alarm_state(0).shelved_until_t_ns == UNTIL_IT_CLEARS_T_NS
    assert happened(take(conditions, [LOW, UP, LOW, UP])) == [(1, RAISED), (2, CLEARED), (2, UNSHELVED), (3, RAISED)]


@pytest.mark.parametrize("action", [Action.SUPPRESS, Action.OUT_OF_SERVICE])
def test_suppressed_or_out_of_service_hides_no_transition_and_presents_nothing(action):
    conditions = at_once()
    asked(conditions, action)
    assert happened(take(conditions, [UP])) == [(0, RAISED)]
    assert is_retained(conditions.alarm_state(0)) and is_silenced(conditions.alarm_state(0))
    back = Action.UNSUPPRESS if action == Action.SUPPRESS else Action.IN_SERVICE
    asked(conditions, back)
    assert is_retained(conditions.alarm_state(0)) and not is_silenced(conditions.alarm_state(0))


def test_commissioning_is_granted_and_does_not_change_the_alarm():
    conditions = at_once()
    take(conditions, [UP])
    before = conditions.alarm_state(0)
    assert conditions.request(Action.COMMISSION, [0], 0) == [(0, Transition.COMMISSIONING, "")]
    assert conditions.alarm_state(0) == before


# any history: samples of two fans with requests between them, by the row before which each is asked

SAMPLES = 60
RATIOS = st.sampled_from([LOW, MID, UP, HIGH, math.nan, math.inf])
HISTORIES = st.fixed_dictionaries(
    {
        "ratio": st.lists(st.tuples(RATIOS, RATIOS), min_size=SAMPLES, max_size=SAMPLES),
        "valid": st.lists(
            st.tuples(st.sampled_from([True, True, False]), st.booleans()), min_size=SAMPLES, max_size=SAMPLES
        ),
        "requests": st.dictionaries(
            st.integers(1, SAMPLES - 1),
            st.tuples(st.sampled_from(Action), st.integers(0, 1), st.sampled_from([0, 35, 170])),
            max_size=12,
        ),
    }
)
SETTINGS = st.builds(
    ConditionSettings,
    on_delay_ns=st.sampled_from([0, 20]),
    detectors=st.sampled_from([by_score(0), by_score(20)]),
    latching=st.booleans(),
    confirming=st.booleans(),
)
CUTS = st.sets(st.integers(1, SAMPLES - 1))


def played(
    conditions: TrayConditions, history: dict[str, Any], cuts: set[int], restart: ConditionSettings | None = None
):
    """The complete output for a history cut at `cuts`; with `restart`, from a new object after every block."""
    ratio, valid = np.array(history["ratio"]), np.array(history["valid"])
    states, changes, answers, too_short = [], [], [], 0
    for first, last in pairwise(sorted({0, SAMPLES, *cuts, *history["requests"]})):
        if first in history["requests"]:
            action, fan, duration_ns = history["requests"][first]
            answers += conditions.request(action, [fan], STEP_NS * (first - 1), duration_ns, "Ann")
        rows = slice(first, last)
        t_ns, period_ns, score, _, ratios, speed_rad_s = scores_alone(
            STEP_NS * np.arange(first, last), STEP_NS, ratio[rows]
        )
        result = conditions.update(t_ns, period_ns, score, valid[rows], ratios, speed_rad_s)
        states.append(result.state)
        changes += [(first + c.row, c.fan, c.transition, c.alarm_state) for c in result.events]
        too_short += result.too_short
        if restart:
            kept = json.loads(json.dumps(conditions.snapshot()))
            conditions = TrayConditions(2, restart)
            conditions.restore(kept)
    return np.concatenate(states).tolist(), changes, answers, too_short, conditions.snapshot()


@given(HISTORIES, SETTINGS, CUTS)
@settings(max_examples=30, deadline=None)
def test_the_blocks_make_no_difference(history, chosen, cuts):
    whole = played(TrayConditions(2, chosen), history, set())
    assert played(TrayConditions(2, chosen), history, cuts) == whole
    assert played(TrayConditions(2, chosen), history, set(range(1, SAMPLES))) == whole


@given(HISTORIES, SETTINGS, CUTS)
@settings(max_examples=30, deadline=None)
def test_continuing_from_a_snapshot_changes_nothing(history, chosen, cuts):
    whole = played(TrayConditions(2, chosen), history, cuts)
    assert played(TrayConditions(2, chosen), history, cuts, restart=chosen) == whole


@given(HISTORIES, SETTINGS)
@settings(max_examples=30, deadline=None)
def test_raised_and_cleared_alternate_and_agree_with_the_states(history, chosen):
    state, changes, *_ = played(TrayConditions(2, chosen), history, set())
    for fan in (0, 1):
        turns = [t for _, its_fan, t, _ in changes if its_fan == fan and t in (RAISED, CLEARED)]
        assert turns == [RAISED if i % 2 == 0 else CLEARED for i in range(len(turns))]
        active = np.cumsum(
            [
                sum((t == RAISED) - (t == CLEARED) for row, its_fan, t, _ in changes if (row, its_fan) == (i, fan))
                for i in range(SAMPLES)
            ]
        )
        known = [(s[fan] in (ALARM, RETURNING), bool(a)) for s, a in zip(state, active, strict=True) if s[fan]]
        assert all(reported == counted for reported, counted in known)
