"""What a verification compares: decisions exactly, numbers of samples, alarms and snapshots within a tolerance."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.replay.offline.comparison import Apart, Comparison
from fantwin.pipeline.replay.offline.verify import (
    AT_A_LIMIT,
    RecordedSamples,
    compare_alarms,
    compare_samples,
    first_difference,
)
from fantwin.schemas.enums import FanState, Severity, Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Diagnosis, Score, ScorerSnapshot
from fantwin.scoring.saved import as_json
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


STATE: dict[str, Any] = {
    "arrays": {"speed_rad_s": [0.1, 0.2], "number": [107], "log_statistic": [-np.inf, 1.0], "reading": [np.nan]},
    "input_producer": "twin_integrator-1-00aa",
    "alarms": {
        "last_emitted": {"3": {"active": True, "message": "takes 0.046 more", "causes": [{"probability": 0.75}]}}
    },
    "wear": {"fans": [{"change": 0.1}]},
}


def snapshot(state: dict[str, Any], twin: str = "t") -> ScorerSnapshot:
    arrays = {name: np.array(values) for name, values in state["arrays"].items()}
    return ScorerSnapshot(t_ns=1, twin_sha256=twin, state_json=json.dumps(state | {"arrays": as_json(arrays)}))


def changed(where: str, value: object) -> dict[str, Any]:
    """A copy of the state with another value at some keys; with `None` without the entry."""
    state = json.loads(json.dumps(STATE))
    *path, last = [int(key) if key.isdigit() and key != "3" else key for key in where.split(".")]
    inner = state
    for key in path:
        inner = inner[key]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    return state


@pytest.mark.parametrize(
    ("where", "value", "found"),
    [
        ("arrays.speed_rad_s.1", 0.2, ""),
        ("arrays.speed_rad_s.1", 0.2 * (1 + 1e-9), ""),
        ("arrays.speed_rad_s.1", 0.2 * (1 + 1e-4), "arrays.speed_rad_s"),
        ("arrays.log_statistic.0", 0.5, "arrays.log_statistic"),
        ("arrays.reading.0", 1.0, "arrays.reading"),
        ("input_producer", "twin_integrator-2-99aa", "input_producer"),
        ("alarms.last_emitted.3.active", False, "alarms.last_emitted.3.active"),
        ("alarms.last_emitted.3.message", "takes 0.047 more", ""),
        ("alarms.last_emitted.3.message", "takes 0.046 less", "alarms.last_emitted.3.message"),
        ("alarms.last_emitted.3.causes.0.probability", 0.75 * (1 + 1e-9), ""),
        ("wear.fans.0.change", 0.1 * (1 + 1e-3), "wear.fans.0.change"),
        ("wear.new", 1.0, "wear.new"),
    ],
)
def test_numbers_may_differ_in_their_last_digits_and_nothing_else_may(where, value, found):
    assert first_difference(snapshot(changed(where, value)), snapshot(STATE)) == found
    assert first_difference(snapshot(STATE), snapshot(changed(where, value))) == found


def test_the_largest_difference_is_known_and_another_twin_is_one():
    seen: list[Apart] = []
    assert not first_difference(snapshot(changed("wear.fans.0.change", 0.1 + 2e-9)), snapshot(STATE), seen.append)
    (apart,) = seen
    assert apart.name == "change" and apart.difference == pytest.approx(2e-9) and 0.01 < apart.share < 0.03
    assert first_difference(snapshot(STATE, "u"), snapshot(STATE)) == "twin_sha256"
