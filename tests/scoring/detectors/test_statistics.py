"""scoring.detectors: each statistic against its definition and its false alarms on noise; cuts change nothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.tacho import Tacho as TachoKind
from scoring.detectors.cusum import LARGEST_SIGMAS, ONE, Cusum
from scoring.detectors.detector import Detector, DetectorContext, DetectorInput
from scoring.detectors.drift import Drift, DriftSettings
from scoring.detectors.low_pass import LowPass
from scoring.detectors.missing_readings import MissingReadings, MissingReadingsSettings
from scoring.detectors.smoothed import Smoothed, SmoothedSettings
from scoring.detectors.tacho import Tacho, TachoSettings
from scoring.detectors.variance_growth import VarianceGrowth, VarianceGrowthSettings
from tests.support.healthy_residuals import autoregressive

STEP_S, STEP_NS = 0.01, 10_000_000
FANS = 3
Update = Callable[[np.ndarray, np.ndarray], np.ndarray]


def of_low_pass() -> Update:
    low_pass = LowPass(FANS, 0.2)
    return lambda x, valid: low_pass.update(x, valid, STEP_S)


def of_cusum() -> Update:
    cusum = Cusum(FANS, [0.25], [0.3])
    return lambda x, valid: cusum.update(x, valid, STEP_S)[:, 0]


def context(fans: int = FANS, smoothing_s: float = 0.2) -> DetectorContext:
    return DetectorContext(fans=fans, smoothing_s=smoothing_s)


def block_of(
    residual: np.ndarray, valid: np.ndarray, speed: np.ndarray | None = None, missing: np.ndarray | None = None
) -> DetectorInput:
    """A block in which every field has the same residual."""
    return DetectorInput(
        period_ns=STEP_NS,
        period_s=STEP_S,
        valid=valid,
        standardised=residual,
        persistent=residual,
        speed_rad_s=residual if speed is None else speed,
        missing=np.zeros(valid.shape, np.bool_) if missing is None else missing,
        reading_missing=np.zeros(valid.shape, np.bool_) if missing is None else missing,
        idle=np.zeros(valid.shape, np.bool_),
        command=np.ones(valid.shape),
        predicted_rad_s=residual,
    )


def readings(
    sensor: Tacho, speed: np.ndarray, missing: np.ndarray | None = None, alive: np.ndarray | None = None
) -> np.ndarray:
    return sensor.update(block_of(speed, np.ones(speed.shape, np.bool_) if alive is None else alive, missing=missing))


def sensor_of(fans: int, stuck_s: float, missing_share: float = 0.25) -> Tacho:
    return Tacho(TachoSettings(stuck_s=stuck_s, missing_share=missing_share), context(fans))


def growth_of(fans: int, smoothing_s: float) -> VarianceGrowth:
    """Its ratio is the standard deviation itself."""
    return VarianceGrowth(VarianceGrowthSettings(limit=1.0), context(fans, smoothing_s))


def of(detector: Detector) -> Update:
    return lambda x, valid: detector.update(block_of(x, valid))


def of_smoothed() -> Update:
    return of(Smoothed(SmoothedSettings(limit=3.0), context()))


def of_drift() -> Update:
    return of(Drift(DriftSettings(limit=2.0, reference_sigmas=0.25, period_s=STEP_S), context()))


def of_both_drifts() -> Update:
    both = DriftSettings(limit=2.0, reference_sigmas=0.25, large_limit=0.5, period_s=STEP_S)
    return of(Drift(both, context()))


def of_variance_growth() -> Update:
    return of(growth_of(FANS, 0.2))


def of_sensor() -> Update:
    sensor = sensor_of(FANS, 1.0)
    return lambda x, valid: readings(sensor, np.round(np.where(valid, x, np.nan)), ~valid, np.isfinite(x))


def of_missing_readings() -> Update:
    detector = MissingReadings(MissingReadingsSettings(healthy_share=0.01), context())
    return lambda x, valid: detector.update(block_of(x, valid, missing=~(x > 0.0)))


@pytest.mark.parametrize(
    "make",
    [of_low_pass, of_cusum, of_smoothed, of_drift, of_both_drifts, of_variance_growth, of_sensor, of_missing_readings],
)
@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000), cuts=st.lists(st.integers(1, 119), max_size=8), share=st.sampled_from([0.0, 0.1, 0.9])
)
def test_cuts_and_invalid_samples_change_no_bit(
    make: Callable[[], Update], seed: int, cuts: list[int], share: float
) -> None:
    rng = np.random.default_rng(seed)
    x = rng.normal(0.4, 1.0, (120, FANS))
    valid = rng.random(x.shape) >= share
    valid[:, 1] = True
    x = np.where(valid | (rng.random(x.shape) < 0.5), x, np.nan)
    whole = make()(x, valid)
    for edges in ([0, *sorted(set(cuts)), 120], range(121)):
        update = make()
        made = np.concatenate([update(x[a:b], valid[a:b]) for a, b in pairwise(edges)])
        np.testing.assert_array_equal(made, whole)


def test_the_low_pass_is_its_recursion_and_holds_over_invalid_samples() -> None:
    x = np.random.default_rng(1).normal(size=(50, 1))
    valid = np.ones((50, 1), np.bool_)
    valid[10:20] = False
    made = LowPass(1, 0.2).update(x, valid, STEP_S)
    keep, y = math.exp(-STEP_S / 0.2), 0.0
    for row in range(50):
        y = keep * y + (1.0 - keep) * x[row, 0] if valid[row, 0] else y
        assert made[row, 0] == pytest.approx(y, rel=1e-12)


def test_a_low_pass_without_a_time_constant_passes_everything() -> None:
    x = np.random.default_rng(1).normal(size=(50, 2))
    np.testing.assert_array_equal(LowPass(2, 0.0).update(x, np.ones(x.shape, np.bool_), STEP_S), x)


def test_the_cusum_is_its_recursion_up_to_its_cap_and_finds_both_signs() -> None:
    x = np.random.default_rng(2).normal(0.0, 1.0, (500, 2)) + np.array([0.5, -0.5])
    (made,) = Cusum(2, [0.25], [0.5]).update(x, np.ones(x.shape, np.bool_), STEP_S).swapaxes(0, 1)
    for fan in range(2):
        up = down = 0.0
        for row in range(500):
            up = min(max(up + (x[row, fan] - 0.25) * STEP_S, 0.0), 0.5)
            down = min(max(down + (-x[row, fan] - 0.25) * STEP_S, 0.0), 0.5)
            assert made[row, fan] == pytest.approx(max(up, down), abs=500 / ONE)
    assert made.max() == pytest.approx(0.5)


def test_an_extreme_number_counts_as_the_largest() -> None:
    made = Cusum(1, [0.0], [math.inf]).update(np.array([[1e300]]), np.array([[True]]), STEP_S)
    assert made[0, 0, 0] == pytest.approx(LARGEST_SIGMAS * STEP_S)


def average_run_length(z: np.ndarray, reference: float, limit: float) -> float:
    """Mean run length over streams z (n, streams), each of which must end in an alarm."""
    cusum = Cusum(z.shape[1], [reference], [math.inf])
    running, lengths = np.arange(z.shape[1]), np.zeros(z.shape[1])
    for first in range(0, len(z), 500):
        block = z[first : first + 500, running]
        beyond = cusum.update(block, np.ones(block.shape, np.bool_), 1.0)[:, 0] > limit
        ended = beyond.any(axis=0)
        lengths[running[ended]] = first + beyond.argmax(axis=0)[ended] + 1
        running, cusum.sums = running[~ended], cusum.sums[..., ~ended]
    assert not len(running)
    return float(lengths.mean())


def test_on_white_noise_the_cusum_runs_as_long_as_the_textbook_says() -> None:
    """Two-sided, k 0.5, h 5: 465 (Montgomery, Statistical Quality Control, table 9.3)."""
    assert average_run_length(autoregressive(8000, 1500, 0.0, 3), 0.5, 5.0) == pytest.approx(465, rel=0.08)


def test_an_autocorrelated_residual_invalidates_textbook_limits() -> None:
    memory = -1.0 / math.log(0.7)  # in samples: AR(1) of 0.7
    assert average_run_length(autoregressive(3000, 1500, memory, 4, period_s=1.0), 0.5, 5.0) == pytest.approx(
        35, rel=0.1
    )


@pytest.mark.parametrize(("shift", "expected"), [(1.0, 10.4), (2.0, 4.01)])
def test_a_shift_is_found_as_fast_as_the_textbook_says(shift: float, expected: float) -> None:
    z = autoregressive(400, 3000, 0.0, 5) + shift
    assert average_run_length(z, 0.5, 5.0) == pytest.approx(expected, rel=0.05)


def test_a_shift_below_the_reference_value_is_never_found() -> None:
    z = np.full((100_000, 1), 0.49)
    assert Cusum(1, [0.5], [math.inf]).update(z, np.ones(z.shape, np.bool_), STEP_S).max() == 0.0


def test_a_second_sum_finds_large_shifts_sooner_and_small_ones_no_sooner() -> None:
    one = DriftSettings(limit=50.0, reference_sigmas=1.0, period_s=STEP_S)
    both = one.model_copy(update={"large_limit": 5.0})

    def found_after(settings: DriftSettings, shift: float) -> int:
        drift = Drift(settings, replace(context(1), capped=True))
        ratio = drift.update(block_of(np.full((3000, 1), shift), np.ones((3000, 1), np.bool_)))
        state = drift.snapshot()
        drift.reset(np.array([True]))
        again = drift.update(block_of(np.zeros((1, 1)), np.ones((1, 1), np.bool_)))
        assert again[0, 0] == 0.0, "both sums start again"
        drift.restore(state)
        assert drift.snapshot() == state
        return int((ratio > 1.0).argmax())

    for shift in (1.2, 1.5):
        assert found_after(both, shift) == found_after(one, shift) > 0
    assert found_after(both, 4.0) == pytest.approx(found_after(one, 4.0) * 0.1 * 3.0 / 2.5, abs=2.0)
    assert found_after(both.scaled(2.0), 4.0) == pytest.approx(2 * found_after(both, 4.0), abs=2.0)


def test_the_deviation_of_noise_is_found_and_doubles_with_it() -> None:
    noise = np.random.default_rng(6).normal(size=(6000, 50))
    valid = np.ones(noise.shape, np.bool_)
    for scale in (1.0, 2.0):
        made = growth_of(50, 100.0).update(block_of(scale * noise, valid))
        assert np.sqrt((made[1000:] ** 2).mean()) == pytest.approx(scale, rel=0.02)


def test_a_shift_that_the_low_pass_has_followed_is_no_variance() -> None:
    z = np.full((3000, 1), 7.0)
    deviation = growth_of(1, 0.2).update(block_of(z, np.ones(z.shape, np.bool_)))
    assert deviation.max() > 1.0  # it cannot know at once
    assert deviation[-1] < 1e-5


def test_a_reading_is_stuck_for_as_long_as_it_repeats() -> None:
    speed = np.arange(1.0, 301.0)[:, np.newaxis]
    speed[100:200] = speed[99]
    sensor = sensor_of(1, 0.5)
    stuck_s = readings(sensor, speed) * 0.5
    assert stuck_s[:100].max() == 0.0
    np.testing.assert_allclose(stuck_s[100:200, 0], STEP_S * np.arange(1, 101))
    assert stuck_s[200:].max() == 0.0
    assert sensor.observed()["stuck_s"] == pytest.approx(1.0)  # within the block, not at its end only


def test_a_fan_at_rest_and_a_silent_line_are_not_stuck() -> None:
    alive = np.ones((300, 2), np.bool_)
    speed = np.zeros((300, 2))
    speed[:, 1] = 50.0
    alive[50:250, 1] = False
    made = readings(sensor_of(2, 0.6), speed, alive=alive)
    assert made.max() < 1.0


def test_a_coarse_tacho_of_a_fan_that_moves_is_not_stuck_for_longer_than_its_steps() -> None:
    speed = 100.0 + 20.0 * np.sin(0.5 * STEP_S * np.arange(6000))[:, np.newaxis]
    coarse = np.round(speed / 0.5) * 0.5
    sensor = sensor_of(1, 2.0)
    readings(sensor, coarse)
    assert 0.2 < sensor.observed()["stuck_s"] < 1.0


@pytest.mark.parametrize(("share", "alarms"), [(0.1, False), (0.6, True), (1.0, True)])
def test_missing_readings_are_judged_by_their_share(share: float, alarms: bool) -> None:
    rng = np.random.default_rng(7)
    missing = rng.random((2000, 1)) < share
    speed = np.where(missing, np.nan, 100.0 + rng.normal(size=missing.shape))
    sensor = sensor_of(1, 5.0)
    made = readings(sensor, speed, missing)
    assert bool(made.max() > 1.0) is alarms
    assert sensor.observed()["missing_share"] == pytest.approx(0.25 * made.max(), rel=0.05)


def test_speeds_that_are_not_finite_do_not_count_as_repeated_readings() -> None:
    speed = np.full((500, 2), np.inf)
    speed[:, 1] = np.nan
    sensor = sensor_of(2, 0.1)
    assert readings(sensor, speed).max() == 0.0
    assert np.isnan(sensor.columns()["last"]).all()


def test_some_fans_start_again_and_the_others_continue() -> None:
    x = np.random.default_rng(8).normal(0.5, 1.0, (200, 2))
    valid = np.ones(x.shape, np.bool_)
    first = np.array([True, False])
    low_pass, cusum, growth = LowPass(2, 0.2), Cusum(2, [0.25], [math.inf]), growth_of(2, 0.2)
    growth.update(block_of(x, valid))
    growth.reset(first)
    for each in (low_pass, cusum):
        each.update(x, valid, STEP_S)
        each.reset(first)
    assert low_pass.value[0] == cusum.sums[..., 0].max() == growth.columns()["square"][0] == 0.0
    assert low_pass.value[1] != 0.0
    assert cusum.sums[0, 0, 1] > 0
    assert growth.columns()["square"][1] > 0.0


@pytest.mark.parametrize("cuts", [(), (130, 131, 260)])
def test_a_tacho_that_counts_is_stuck_only_where_a_healthy_one_would_read_something_else(cuts: tuple[int, ...]) -> None:
    tacho = TachoKind(kind="count", window_s=1.0)
    of = DetectorContext(fans=2, smoothing_s=0.2, tachos=(tacho, TachoKind()))
    sensor = Tacho(TachoSettings(stuck_s=0.5), of)
    speed = np.full((400, 2), 100.0)
    predicted = np.full((400, 2), 100.0)
    predicted[200:] = 100.0 + 3.5 * tacho.resolution_rad_s
    predicted[300:] = 100.0
    whole = block_of(speed, np.ones(speed.shape, np.bool_))
    edges = (0, *cuts, 400)
    parts = []
    for first, last in pairwise(edges):
        rows = {name: value[first:last] for name, value in vars(whole).items() if isinstance(value, np.ndarray)}
        parts.append(sensor.update(replace(whole, **rows | {"predicted_rad_s": predicted[first:last]})))
    stuck_s = np.concatenate(parts) * 0.5
    assert stuck_s[:200, 0].max() == 0.0, "the fan runs evenly"
    np.testing.assert_allclose(stuck_s[200:300, 0], STEP_S * np.arange(1, 101))
    np.testing.assert_allclose(stuck_s[300:, 0], 1.0)
    np.testing.assert_allclose(stuck_s[:, 1], STEP_S * np.arange(400), err_msg="each reading is one of its own")


def test_a_reading_that_a_healthy_fan_would_give_is_not_stuck_though_the_twin_came_from_elsewhere() -> None:
    tacho = TachoKind(kind="count", window_s=1.0)
    settled = np.full((300, 1), 100.0 + tacho.resolution_rad_s)
    settled[:100] = 100.0 - 4.0 * tacho.resolution_rad_s  # the free run still settles
    speed = np.full((300, 1), 100.0)
    block = replace(block_of(speed, np.ones(speed.shape, np.bool_)), predicted_rad_s=settled)
    of = DetectorContext(fans=1, smoothing_s=0.2, tachos=(tacho,))
    assert Tacho(TachoSettings(stuck_s=0.5), of).update(block).max() == 0.0
