"""pipeline.learning.fan_alarms: what the states of scores say about alarms, and what they do not."""

from __future__ import annotations

import numpy as np

from fantwin.pipeline.learning.fan_alarms import LONGEST_UNKNOWN_NS, FanAlarms
from fantwin.schemas.enums import FanState
from fantwin.schemas.messages import Score
from fantwin.schemas.units import NS_PER_S

N, S, A, R = FanState.NORMAL, FanState.SUSPECT, FanState.ALARM, FanState.RETURNING


def score(*rows: list[FanState], first_s: int = 0) -> Score:
    """One row a second; a row has the state of each fan."""
    state = np.array([[int(each) for each in row] for row in rows], np.uint8)
    zeros = np.zeros(state.shape)
    arrays = ("command", "measured_speed_rad_s", "predicted_speed_rad_s", "band_variance")
    return Score(
        fans=state.shape[1],
        period_ns=NS_PER_S,
        t_ns=(first_s + np.arange(len(state), dtype=np.int64)) * NS_PER_S,
        state=state,
        valid=zeros.astype(bool),
        invalid_reason=zeros.astype(np.uint8),
        **dict.fromkeys(arrays, zeros),
    )


def test_the_last_row_that_says_something_decides_and_alarms_that_end_in_the_same_score_are_seen() -> None:
    alarms = FanAlarms(3)
    seen = alarms.update(
        score([A, N, N], [N, A, FanState.UNKNOWN], [FanState.STOPPED, FanState.UNKNOWN, FanState.UNKNOWN])
    )
    assert alarms.fans == [1]
    assert seen.began_t_ns == [NS_PER_S], "that of fan 0 may have begun before the first score"
    alarms = FanAlarms(1)
    seen = alarms.update(score([N], [A], [N], [A], [R], [N]))
    assert alarms.fans == []
    assert seen.had_alarm
    assert seen.began_t_ns == [NS_PER_S, 3 * NS_PER_S]


def test_alarms_are_known_when_each_fan_was_judged_or_some_for_long() -> None:
    alarms = FanAlarms(2)
    assert not alarms.are_known
    alarms.update(score([FanState.STOPPED, FanState.STOPPED]))
    assert not alarms.are_known
    alarms.update(score([N, FanState.STOPPED]))
    assert not alarms.are_known
    by_time = FanAlarms(2)
    by_time.update(score([N, FanState.STOPPED]))
    by_time.update(score([N, FanState.STOPPED], first_s=LONGEST_UNKNOWN_NS // NS_PER_S))
    assert by_time.are_known
    alarms.update(score([FanState.UNKNOWN, A]))
    assert alarms.are_known
