"""scoring.baseline.baseline: when the offset of a fan is learned, and how far."""

from __future__ import annotations

import numpy as np
import pytest

from scoring.baseline.baseline import COMMISSIONING_INTERVALS, MAX_UNSTEADY_INTERVALS, Baseline
from scoring.baseline.settings import BaselineSettings
from tests.support.one_interval import one_interval

SAMPLES = 100
GOOD = np.array([True, True])
STILL = MANY_READINGS = np.array([False, False])
SETTINGS = BaselineSettings(commissioning_limit_sigmas=3.0, adaptation_limit_sigmas=0.5)
ADAPTATION_INTERVALS = 60.0


def baseline_of(settings: BaselineSettings = SETTINGS, **changes: float) -> Baseline:
    """A baseline of two fans."""
    return Baseline(2, settings.model_copy(update=changes), ADAPTATION_INTERVALS)


def add(baseline: Baseline, residual: np.ndarray, valid: np.ndarray, scaling: np.ndarray | None = None) -> None:
    """Samples of the present interval."""
    scaling = np.ones(residual.shape) if scaling is None else scaling
    baseline.take(baseline.state, baseline.sums(residual, valid, scaling, one_interval(len(residual))))


def feed(baseline: Baseline, level: float, intervals: int, good: np.ndarray = GOOD) -> None:
    """good: whether each fan is within its limits, and also below half of them."""
    for _ in range(intervals):
        add(baseline, np.full((SAMPLES, 2), level), np.ones((SAMPLES, 2), np.bool_))
        baseline.end_interval(SAMPLES, good, good, STILL, MANY_READINGS)


def test_the_first_good_interval_gives_the_baseline() -> None:
    baseline = baseline_of()
    assert not baseline.is_set.any()
    add(baseline, np.full((SAMPLES, 2), 1.5), np.ones((SAMPLES, 2), np.bool_) & np.array([True, False]))
    baseline.end_interval(SAMPLES, GOOD, GOOD, STILL, MANY_READINGS)
    np.testing.assert_array_equal(baseline.is_set, [True, False])
    np.testing.assert_allclose(baseline.value, [1.5, 0.0])


@pytest.mark.parametrize("per_interval", [1, 2])
def test_on_a_slow_line_a_fan_that_still_moves_has_no_baseline(per_interval: int) -> None:
    def baseline_after(levels: list[float], moving: list[bool], few_readings: bool = True) -> float:
        baseline = baseline_of(commissioning_limit_sigmas=30.0)
        for level, moves in zip(levels, moving, strict=True):
            add(baseline, np.full((per_interval, 2), level), np.ones((per_interval, 2), np.bool_))
            baseline.end_interval(per_interval, GOOD, GOOD, np.array([moves, moves]), np.full(2, few_readings))
        return float(baseline.value[0])

    assert baseline_after([-18.0, -9.0, 2.0], [False, True, False]) == 2.0
    assert baseline_after([-18.0, -9.0, 2.0], [False, True, False], few_readings=False) == pytest.approx(-8.0)
    many = [5.0] * MAX_UNSTEADY_INTERVALS
    assert baseline_after(many, [True] * len(many)) == 0.0
    assert baseline_after([*many, 7.0], [True] * (len(many) + 1)) == 7.0, "one that never settles is accepted"


def test_while_commissioning_it_is_the_median_of_the_intervals() -> None:
    baseline = baseline_of()
    levels = np.random.default_rng(1).normal(0.0, 0.1, COMMISSIONING_INTERVALS)
    for level in levels:
        feed(baseline, float(level), 1)
    np.testing.assert_allclose(baseline.value, np.median(levels), atol=1e-6)
    np.testing.assert_array_equal(baseline.commissioned, baseline.value)
    assert not baseline.is_commissioning.any()


@pytest.mark.parametrize("level", [9.0, -9.0])
def test_while_commissioning_it_stays_within_the_commissioning_limit(level: float) -> None:
    baseline = baseline_of()
    feed(baseline, np.sign(level) * 2.9, 1)
    for _ in range(COMMISSIONING_INTERVALS + 1):
        feed(baseline, level, 1)
        assert np.abs(baseline.commissioned).max() <= SETTINGS.commissioning_limit_sigmas
    np.testing.assert_allclose(np.abs(baseline.commissioned), SETTINGS.commissioning_limit_sigmas)
    feed(baseline, level, 300)
    np.testing.assert_allclose(
        np.abs(baseline.value), SETTINGS.commissioning_limit_sigmas + SETTINGS.adaptation_limit_sigmas
    )


@pytest.mark.parametrize("commissioned", [0.0, 1.0 / 3.0])
def test_it_stops_at_the_adaptation_limit_and_reports_it(commissioned: float) -> None:
    baseline = baseline_of()
    feed(baseline, commissioned, COMMISSIONING_INTERVALS)
    assert not baseline.is_at_limit.any()
    feed(baseline, commissioned + 5.0, 300)
    np.testing.assert_allclose(baseline.value, commissioned + 0.5, atol=1e-6)
    assert baseline.is_at_limit.all()
    feed(baseline, commissioned, 20)
    assert not baseline.is_at_limit.any()


def test_unsteady_intervals_are_skipped_but_not_for_ever() -> None:
    swing = np.linspace(-6.0, 6.0, SAMPLES)[:, np.newaxis] * np.ones(2)
    baseline = baseline_of()
    for number in range(MAX_UNSTEADY_INTERVALS + 1):
        assert not baseline.is_set.any(), number
        add(baseline, swing, np.ones((SAMPLES, 2), np.bool_))
        baseline.end_interval(SAMPLES, GOOD, GOOD, STILL, MANY_READINGS)
    assert baseline.is_set.all()


def test_once_commissioned_it_learns_only_below_half_of_the_limits() -> None:
    baseline = baseline_of()
    feed(baseline, 0.0, COMMISSIONING_INTERVALS)
    add(baseline, np.full((SAMPLES, 2), 1.0), np.ones((SAMPLES, 2), np.bool_))
    baseline.end_interval(SAMPLES, GOOD, np.array([False, True]), STILL, MANY_READINGS)
    assert baseline.value[0] == 0.0
    assert baseline.value[1] > 0.0


# An offset that changes with the speed

SCALED = BaselineSettings(commissioning_limit_sigmas=5.0, adaptation_limit_sigmas=0.5, ridge=0.25, rms_sigmas=0.5)
EVERY = np.ones((SAMPLES, 2), np.bool_)


def scaled(levels: np.ndarray, seed: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Residuals with an offset of two at scaling one, and the scalings; (samples, 2) each, from (samples,)."""
    scaling = levels[:, np.newaxis] * np.ones(2)
    return 2.0 * scaling + np.random.default_rng(seed).normal(0.0, noise, scaling.shape), scaling


def test_an_offset_that_changes_with_the_speed_is_found_while_the_speed_changes() -> None:
    baseline = baseline_of(SCALED, ridge=0.0, rms_sigmas=0.0)
    for seed in range(COMMISSIONING_INTERVALS):
        add(baseline, *_with(EVERY, scaled(np.linspace(0.3, 1.5, SAMPLES), seed, 0.2)))
        baseline.end_interval(SAMPLES, GOOD, GOOD, STILL, MANY_READINGS)
    np.testing.assert_allclose(baseline.value, 2.0, atol=0.05)


def _with(valid: np.ndarray, made: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return made[0], valid, made[1]
