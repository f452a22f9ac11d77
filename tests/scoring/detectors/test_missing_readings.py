"""scoring.detectors.missing_readings: a loose wire is found in seconds; a healthy line, however bad, has no alarm."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.messages import Array
from scoring.detectors.detector import DetectorContext, DetectorInput
from scoring.detectors.missing_readings import MissingReadings, MissingReadingsSettings

HZ, PERIOD_NS = 10, 100_000_000
HOUR = 3600 * HZ


def detector_of(settings: MissingReadingsSettings, fans: int, *, capped: bool = True) -> MissingReadings:
    return MissingReadings(settings, DetectorContext(fans=fans, smoothing_s=0.2, capped=capped))


def ratios(detector: MissingReadings, missing: Array, valid: Array | None = None, idle: Array | None = None) -> Array:
    """Of readings of which some are missing, (n, fans)."""
    nothing = np.zeros(missing.shape)
    return detector.update(
        DetectorInput(
            period_ns=PERIOD_NS,
            period_s=1.0 / HZ,
            valid=np.ones(missing.shape, np.bool_) if valid is None else valid,
            standardised=nothing,
            persistent=nothing,
            speed_rad_s=nothing,
            missing=np.zeros(missing.shape, np.bool_),
            reading_missing=missing,
            idle=np.zeros(missing.shape, np.bool_) if idle is None else idle,
            command=nothing,
            predicted_rad_s=nothing,
        )
    )


def by_chance(share: float, samples: int, fans: int, seed: int) -> Array:
    return np.random.default_rng(seed).random((samples, fans)) < share


def calibrated(share: float, seed: int, seconds: int = 600) -> MissingReadingsSettings:
    """By one run of four fans whose lines miss such a share."""
    healthy = detector_of(MissingReadingsSettings.unreached(), 4, capped=False)
    assert ratios(healthy, by_chance(share, seconds * HZ, 4, seed)).max() == 0.0
    return MissingReadingsSettings.fixed(healthy.observed())


@pytest.mark.parametrize(
    ("healthy", "share", "median_s", "most_s"),
    [(0.002, 0.35, 3.0, 8.0), (0.002, 0.1, 12.0, 60.0), (0.02, 0.35, 6.0, 15.0)],
)
def test_a_loose_wire_is_found_in_seconds_and_stays_found(
    healthy: float, share: float, median_s: float, most_s: float
) -> None:
    found = ratios(detector_of(calibrated(healthy, 1), 100), by_chance(share, 300 * HZ, 100, 2)) > 1.0
    assert found.any(axis=0).all()
    after_s = (found.argmax(axis=0) + 1) / HZ
    assert np.median(after_s) < median_s
    assert after_s.max() < most_s
    off_delay = round(detector_of(MissingReadingsSettings(), 1).off_delay_s) * HZ
    below = np.array([longest_run(~found[first:, fan]) for fan, first in enumerate(found.argmax(axis=0).tolist())])
    assert below.max() < off_delay, "the alarm would return"


def longest_run(flags: Array) -> int:
    edges = np.flatnonzero(np.concatenate(([True], np.diff(flags), [True])))
    return int((np.diff(edges) * flags[edges[:-1]]).max(initial=0))


@pytest.mark.parametrize("share", [0.0, 0.02])
def test_a_line_that_misses_as_many_as_at_calibration_has_no_alarm(share: float) -> None:
    assert ratios(detector_of(calibrated(share, 3), 200), by_chance(share, HOUR, 200, 4)).max() < 1.0


def test_a_twin_without_calibration_bears_a_line_that_misses_two_percent() -> None:
    assert ratios(detector_of(MissingReadingsSettings(), 200), by_chance(0.02, HOUR, 200, 6)).max() < 1.0


def test_an_interruption_counts_as_one_reading_however_long_it_is() -> None:
    missing = np.zeros((40 * HZ, 3), np.bool_)
    missing[100, 0] = missing[100 : 100 + HZ, 1] = missing[100 : 100 + 30 * HZ, 2] = True
    made = ratios(detector_of(MissingReadingsSettings(healthy_share=0.005), 3), missing)
    assert made.max() < 0.3
    np.testing.assert_array_equal(made.max(axis=0), made.max())


def test_a_silent_line_and_a_fan_at_rest_miss_nothing() -> None:
    missing = by_chance(0.5, 200, 2, 7)
    valid, idle = (np.ones(missing.shape, np.bool_) for _ in range(2))
    valid[:, 0] = idle[:, 0] = False
    healthy = detector_of(MissingReadingsSettings(healthy_share=0.005), 2)
    assert ratios(healthy, missing, valid, idle).max() == 0.0
    assert healthy.observed() == {"missing_share": 0.0}


def test_after_any_time_the_sum_comes_down_in_bounded_time() -> None:
    detector = detector_of(calibrated(0.002, 1), 50)
    assert ratios(detector, by_chance(0.9, HOUR // 4, 50, 8)).max() == pytest.approx(2.0, rel=1e-3)
    below = ratios(detector, np.zeros((HOUR // 60, 50), np.bool_)) < 0.75
    assert (below.argmax(axis=0) < 20 * HZ).all()
    assert below[-1].all()
