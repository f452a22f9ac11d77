"""scoring.detectors.motion: how far a healthy fan may move."""

from __future__ import annotations

import json

import numpy as np
import pytest

from schemas.messages import Array
from scoring.detectors.motion import HealthyMotion

PERIOD_S, BEFORE = 0.1, 100
STEADY_RAD_S = 100.0


def allowed(command: Array, predicted_rad_s: Array, speed_rad_s: Array) -> Array:
    columns = [np.asarray(values)[:, np.newaxis] for values in (command, predicted_rad_s, speed_rad_s)]
    return HealthyMotion(1).update(columns[0], columns[1], columns[2], PERIOD_S)[:, 0]


def stepped(first: float, last: float, samples: int = 200) -> Array:
    return np.repeat([first, last], [BEFORE, samples - BEFORE])


def test_a_fan_whose_command_and_twin_are_steady_may_not_move() -> None:
    steady = np.full(200, STEADY_RAD_S)
    assert allowed(np.full(200, 0.5), steady, stepped(STEADY_RAD_S, 0.0)).max() == pytest.approx(0.0, abs=1e-9)


def test_it_may_move_by_the_share_by_which_its_command_has_changed_within_five_seconds() -> None:
    steady = np.full(300, STEADY_RAD_S)
    may = allowed(stepped(0.5, 0.25, 300), steady, steady)
    assert may[BEFORE] == pytest.approx(50.0, abs=1.0), "0.25 of 0.5"
    after_s = 5.0
    kept = np.exp(-after_s / 5.0) * 0.25
    assert may[BEFORE + round(after_s / PERIOD_S)] == pytest.approx(STEADY_RAD_S * kept / (0.25 + kept), abs=1.0)
    assert may[-1] < 0.1 * may[BEFORE]


def test_it_may_move_as_far_as_its_twin_whatever_the_command() -> None:
    may = allowed(np.zeros(200), stepped(STEADY_RAD_S, 0.0), np.zeros(200))
    assert may[BEFORE] == pytest.approx(STEADY_RAD_S, rel=0.03)


def test_a_fan_that_starts_before_its_twin_may_move_as_far_as_it_does() -> None:
    speed_rad_s = np.concatenate((np.zeros(BEFORE), np.linspace(10.0, 200.0, 20)))
    may = allowed(stepped(0.0, 1.0, 120), np.zeros(120), speed_rad_s)
    assert np.all(may[BEFORE:] >= 0.9 * speed_rad_s[BEFORE:] * np.exp(-np.arange(20) * PERIOD_S / 5.0))


def test_nothing_is_limited_where_nothing_is_predicted() -> None:
    predicted_rad_s = np.full(200, STEADY_RAD_S)
    predicted_rad_s[50:60] = np.nan
    may = allowed(np.full(200, 0.5), predicted_rad_s, predicted_rad_s)
    assert np.array_equal(np.isinf(may), np.isnan(predicted_rad_s))


def test_neither_blocks_nor_a_restart_nor_another_fan_change_anything() -> None:
    rng = np.random.default_rng(3)
    command, predicted, speed = (rng.uniform(0.1, 1.0, (400, 2)) * size for size in (1.0, 200.0, 200.0))
    predicted[rng.random((400, 2)) < 0.05] = np.nan
    whole = HealthyMotion(2).update(command, predicted, speed, PERIOD_S)
    alone = HealthyMotion(1).update(command[:, :1], predicted[:, :1], speed[:, :1], PERIOD_S)
    np.testing.assert_array_equal(alone, whole[:, :1])
    before, parts = HealthyMotion(2), []
    for start in range(0, 400, 7):
        cut = slice(start, start + 7)
        restarted = HealthyMotion(2)
        restarted.restore(json.loads(json.dumps(before.snapshot())))
        before = restarted
        parts.append(before.update(command[cut], predicted[cut], speed[cut], PERIOD_S))
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_after_a_reset_the_motion_of_before_is_forgotten() -> None:
    motion = HealthyMotion(2)
    moving = np.linspace(0.0, 100.0, 100)[:, np.newaxis] * np.ones(2)
    motion.update(moving / 100.0, moving, moving, PERIOD_S)
    motion.reset(np.array([True, False]))
    steady = np.full((1, 2), 100.0)
    after = motion.update(steady / 100.0, steady, steady, PERIOD_S)[0]
    assert after[0] == 0.0
    assert after[1] > 10.0
