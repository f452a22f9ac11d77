"""Comparing two snapshots of a scorer: what counts as a difference, and which one is named."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pipeline.replay.offline.compare_snapshots import Difference, first_difference
from schemas.messages import ScorerSnapshot

STATE: dict[str, Any] = {
    "scorer": {"speed": {"drift": [0.1, 0.2]}},
    "alarms": {"last_emitted": {"3": {"active": True, "causes": [{"probability": 0.75}]}}},
    "wear": {"fans": [{"change": 0.1}]},
}


def snapshot(state: dict[str, Any], twin: str = "t") -> ScorerSnapshot:
    return ScorerSnapshot(t_ns=1, twin_sha256=twin, state_json=json.dumps(state))


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
        ("scorer.speed.drift.1", 0.2, None),
        ("scorer.speed.drift.1", 0.2 * (1 + 1e-15), Difference("scorer.speed.drift.1")),
        ("scorer.speed.drift", [0.1], Difference("scorer.speed.drift")),
        ("wear.fans.0.change", 0.1 * (1 + 1e-9), None),
        ("wear.fans.0.change", 0.1 * (1 + 1e-3), Difference("wear.fans.0.change")),
        ("alarms.last_emitted.3.causes.0.probability", 0.75 * (1 + 1e-9), None),
        ("alarms.last_emitted.3", None, Difference("alarms.last_emitted.3")),
        ("scorer.speed", None, Difference("scorer.speed", is_of_form=True)),
        ("scorer.new", 1.0, Difference("scorer.new", is_of_form=True)),
    ],
)
def test_values_differ_in_any_bit_but_for_regressions_and_a_lacking_entry_is_another_form(where, value, found):
    assert first_difference(snapshot(changed(where, value)), snapshot(STATE)) == found
    assert first_difference(snapshot(STATE), snapshot(changed(where, value))) == found


def test_a_difference_of_values_is_named_before_one_of_form():
    other = changed("scorer.speed", None) | {"wear": {"fans": []}}
    assert first_difference(snapshot(other), snapshot(STATE)) == Difference("wear.fans")
    assert first_difference(snapshot(other, "u"), snapshot(STATE)) == Difference("twin_sha256")
