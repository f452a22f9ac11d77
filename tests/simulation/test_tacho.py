"""Counting, period and delayed tachos: what their readings show of known courses of speed."""

from itertools import pairwise

import numpy as np
import pytest

from fantwin.schemas.tacho import Tacho
from fantwin.simulation.tacho import (
    AveragingTacho,
    CountingTacho,
    DelayedTacho,
    PeriodTacho,
    TachoSettings,
    simulated_tacho,
)

STEP_S = 0.01


def counts_of(tacho: Tacho, fans: int = 1, **errors: float) -> CountingTacho:
    return CountingTacho(
        [tacho] * fans, errors.get("missing", 0.0), errors.get("double", 0.0), np.random.default_rng(3)
    )


def readings(tacho: AveragingTacho | CountingTacho | PeriodTacho | DelayedTacho, speed_rad_s: np.ndarray) -> np.ndarray:
    """(n, fans) readings after each step of a course (n + 1, fans)."""
    rows = []
    for step, (before, after) in enumerate(pairwise(speed_rad_s)):
        tacho.turn(step * STEP_S, before, (step + 1) * STEP_S, after)
        rows.append(tacho.read())
    return np.array(rows)


def wandering(seconds: float, fans: int) -> np.ndarray:
    t_s = np.arange(round(seconds / STEP_S) + 1) * STEP_S
    return np.stack([120.0 + 60.0 * np.sin(0.7 * t_s + fan) + 20.0 * np.sin(9.1 * t_s) for fan in range(fans)], axis=1)


@pytest.mark.parametrize("tacho", [Tacho(kind="count", window_s=0.5), Tacho(kind="count", window_s=1.0, update_s=0.25)])
def test_a_count_is_the_mean_speed_of_its_own_window_to_within_one_step_of_its_resolution(tacho: Tacho) -> None:
    fans = 3
    speed = wandering(40.0, fans)
    angle = np.concatenate((np.zeros((1, fans)), np.cumsum(0.5 * (speed[1:] + speed[:-1]) * STEP_S, axis=0)))
    counting = counts_of(tacho, fans)
    found, windows = [], []
    for step in range(len(speed) - 1):
        counting.turn(step * STEP_S, speed[step], (step + 1) * STEP_S, speed[step + 1])
        found.append(counting.read())
        windows.append(counting.shown_from_s.copy())
    reading, shown_from_s = np.array(found), np.array(windows)
    times_s = np.arange(len(speed)) * STEP_S
    for fan in range(fans):
        ends_s = np.unique(shown_from_s[200:, fan])
        assert np.diff(ends_s) == pytest.approx(tacho.held_s)
        shown = np.array([reading[shown_from_s[:, fan] == end_s, fan] for end_s in ends_s[:-1]], dtype=object)
        assert all(len(set(one)) == 1 for one in shown)  # held until the next
        values = np.array([one[0] for one in shown])
        mean = (
            np.interp(ends_s[:-1], times_s, angle[:, fan])
            - np.interp(ends_s[:-1] - tacho.window_s, times_s, angle[:, fan])
        ) / tacho.window_s
        assert np.abs(values - mean).max() < 1.01 * tacho.resolution_rad_s
        assert np.abs(values - mean).max() > 0.3 * tacho.resolution_rad_s  # it is quantised
        assert np.allclose(values / tacho.resolution_rad_s, np.round(values / tacho.resolution_rad_s))
        assert values.mean() == pytest.approx(mean.mean(), abs=0.1 * tacho.resolution_rad_s)
    phases_s = shown_from_s[-1] % tacho.held_s
    assert len(np.unique(np.round(phases_s, 3))) == fans


def test_edges_that_are_missed_or_seen_twice_shift_the_mean_by_their_share() -> None:
    speed = np.full((6001, 8), 200.0)
    window = Tacho(kind="count", window_s=0.5)
    exact, missing, double = (
        readings(counts_of(window, 8, **errors), speed)[100:].mean()
        for errors in ({}, {"missing": 0.1}, {"double": 0.2})
    )
    assert exact == pytest.approx(200.0, rel=0.002)
    assert missing == pytest.approx(180.0, rel=0.01)
    assert double == pytest.approx(240.0, rel=0.01)


def test_a_period_shows_the_last_revolution_and_0_once_the_rotor_has_stood_for_long() -> None:
    speed = np.concatenate((np.full(300, 10.0), np.full(300, 100.0), np.zeros(400)))[:, np.newaxis]
    found = readings(PeriodTacho(2, 1, 0.0, 0.0, np.random.default_rng(1)), speed)[:, 0]
    assert found[:60].max() == 0.0  # not one revolution yet
    assert found[150:299] == pytest.approx(10.0)
    assert found[320:598] == pytest.approx(100.0)
    assert found[605:780] == pytest.approx(found[605])  # held, while no edge comes
    assert found[605] > 50.0
    assert np.all(found[805:] == 0.0)


def test_a_delay_shows_what_was_measured_before() -> None:
    speed = wandering(5.0, 2)
    now = readings(PeriodTacho(2, 2, 0.0, 0.0, np.random.default_rng(5)), speed)
    late = simulated_tacho(TachoSettings((Tacho(kind="period", delay_s=0.295),)), 2, np.random.default_rng(5))
    assert isinstance(late, DelayedTacho)
    assert np.array_equal(readings(late, speed)[30:], now[:-30])


def test_an_average_is_the_mean_speed_of_its_window_in_whole_steps_and_is_held() -> None:
    tacho = Tacho(kind="average", window_s=0.25, update_s=1.0, step_rad_s=5.0)
    speed = wandering(20.0, 1)
    shown = readings(AveragingTacho([tacho], np.random.default_rng(3)), speed)[:, 0]
    assert np.allclose(shown % 5.0, 0.0)
    changes = np.flatnonzero(np.diff(shown)) + 1
    assert np.all(np.diff(changes) % 100 == 0)
    angle = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:, 0] + speed[:-1, 0]) * STEP_S)))
    ends = changes[1:] + 1  # the window ends within the piece whose reading is new
    mean = (angle[ends] - angle[ends - 25]) / 0.25
    assert np.abs(shown[changes[1:]] - mean).max() < 2.5 + 1.5
