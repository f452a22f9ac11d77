"""Comparing two snapshots of a scorer: what counts as a difference, and which one is named."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pipeline.replay.offline.compare_snapshots import first_difference
from pipeline.replay.offline.tolerance import Apart
from schemas.messages import ScorerSnapshot

STATE: dict[str, Any] = {
    "scorer": {
        "speed": {"drift": [0.1, 0.2], "sums": [107439, 0], "counts": [107, 0], "shared": {"products": [10**6]}},
        "input_producer": "twin_integrator-1-00aa",
    },
    "alarms": {
        "last_emitted": {"3": {"active": True, "message": "takes 0.046 more", "causes": [{"probability": 0.75}]}}
    },
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
        ("scorer.speed.drift.1", 0.2, ""),
        ("scorer.speed.drift.1", 0.2 * (1 + 1e-9), ""),
        ("scorer.speed.drift.1", 0.2 * (1 + 1e-5), "scorer.speed.drift.1"),
        ("scorer.speed.drift.1", None, "scorer.speed.drift"),
        ("scorer.speed.drift", [0.1], "scorer.speed.drift"),
        ("scorer.speed.sums.0", 107440, ""),
        ("scorer.speed.sums.0", 107449, "scorer.speed.sums.0"),
        ("scorer.speed.shared.products.0", 10**6 + 1, ""),
        ("scorer.speed.shared.products.0", 10**6 + 9, "scorer.speed.shared.products.0"),
        ("scorer.input_producer", "twin_integrator-2-99aa", "scorer.input_producer"),
        ("scorer.speed.counts.0", 108, "scorer.speed.counts.0"),
        ("alarms.last_emitted.3.active", False, "alarms.last_emitted.3.active"),
        ("alarms.last_emitted.3.message", "takes 0.047 more", ""),
        ("alarms.last_emitted.3.message", "takes 0.046 less", "alarms.last_emitted.3.message"),
        ("alarms.last_emitted.3.causes.0.probability", 0.75 * (1 + 1e-9), ""),
        ("alarms.last_emitted.3", None, "alarms.last_emitted.3"),
        ("wear.fans.0.change", 0.1 * (1 + 1e-9), ""),
        ("wear.fans.0.change", 0.1 * (1 + 1e-3), "wear.fans.0.change"),
        ("scorer.new", 1.0, "scorer.new"),
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
