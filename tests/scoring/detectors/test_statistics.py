"""scoring.detectors: each statistic against its definition and its false alarms on noise; cuts change nothing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.tacho import Tacho as TachoKind
from scoring.detectors.cusum import ONE, Cusum
from scoring.detectors.detector import Detector, DetectorContext, DetectorInput
from scoring.detectors.drift import Drift, DriftSettings
from scoring.detectors.missing_readings import MissingReadings, MissingReadingsSettings
from scoring.detectors.smoothed import Smoothed, SmoothedSettings
from scoring.detectors.tacho import Tacho, TachoSettings
from scoring.detectors.variance_growth import VarianceGrowth, VarianceGrowthSettings

STEP_S, STEP_NS = 0.01, 10_000_000
FANS = 3
Update = Callable[[np.ndarray, np.ndarray], np.ndarray]


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
    [of_smoothed, of_drift, of_both_drifts, of_variance_growth, of_sensor, of_missing_readings],
)
@settings(max_examples=10, deadline=None)
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


def test_a_filter_is_loaded_when_it_is_built_and_not_with_the_first_long_block() -> None:
    """The import takes a second or two, and the first scores would be late; what only shows wear does without it."""
    program = (
        "import sys; import scoring.wear.trend; before = 'scipy.signal' in sys.modules;"
        "from scoring.detectors.low_pass import LowPass; LowPass(1, 1.0); print(before, 'scipy.signal' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False True\n"


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


@pytest.mark.parametrize(("share", "alarms"), [(0.1, False), (0.6, True)])
def test_missing_readings_are_judged_by_their_share(share: float, alarms: bool) -> None:
    rng = np.random.default_rng(7)
    missing = rng.random((2000, 1)) < share
    speed = np.where(missing, np.nan, 100.0 + rng.normal(size=missing.shape))
    sensor = sensor_of(1, 5.0)
    made = readings(sensor, speed, missing)
    assert bool(made.max() > 1.0) is alarms
    assert sensor.observed()["missing_share"] == pytest.approx(0.25 * made.max(), rel=0.05)


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
