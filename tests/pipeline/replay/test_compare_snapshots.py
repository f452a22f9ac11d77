"""Comparing two snapshots of a scorer: what counts as a difference, and which one is named."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.replay.offline.comparison import Apart
from fantwin.pipeline.replay.offline.verify import first_difference
from fantwin.schemas.messages import ScorerSnapshot
from fantwin.scoring.saved import as_json

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
