"""scoring.detectors.slow: what grows within minutes, while the baseline follows and the other statistics are blind."""

from __future__ import annotations

import numpy as np

from schemas.messages import Statistic
from scoring.limits import Limits
from tests.support.healthy_residuals import alarms_of, autoregressive, in_blocks, samples_of

PERIOD_S, FANS = 0.5, 8
PER_S = round(1.0 / PERIOD_S)
SLOW = {"speed_slow": {"limit": 0.5}}
CARD = {
    "format_version": 2,
    "speed": {},
    "balance": {},
    "detectors": {
        "speed_smoothed": {"limit": 5.0},
        "speed_drift": {"limit": 8.0, "reference_sigmas": 1.5, "period_s": PERIOD_S},
    },
    "timing": {"smoothing_s": 0.2, "baseline_s": 1.0, "adaptation_s": 60.0, "on_delay_s": 0.1},
}


def raised(residual: np.ndarray, detectors: dict[str, dict[str, float]]) -> list[tuple[float, Statistic]]:
    limits = Limits.model_validate(CARD | {"detectors": CARD["detectors"] | detectors})
    samples = samples_of(residual, np.full(residual.shape, np.nan), period_ns=round(PERIOD_S * 1e9))
    return [(alarm.t_s, alarm.statistic) for alarm in alarms_of(limits, in_blocks(samples), FANS)]


def test_a_clogging_of_three_minutes_is_found_within_them() -> None:
    seconds = np.arange(400 * PER_S)[:, np.newaxis] * PERIOD_S
    growing = 2.0 * np.clip((seconds - 200.0) / 180.0, 0.0, 1.0)
    residual = autoregressive(len(seconds), FANS, 0.0, 1) - growing
    found = raised(residual, SLOW)
    assert [statistic for _, statistic in found] == [Statistic.SPEED_SLOW] * FANS
    assert all(200.0 < t_s < 380.0 for t_s, _ in found)
    assert raised(residual, {}) == [], "the baseline followed it"


def test_what_changes_over_an_hour_is_followed() -> None:
    seconds = np.arange(3600 * PER_S)[:, np.newaxis] * PERIOD_S
    weather = 0.6 * np.sin(2.0 * np.pi * seconds / 3600.0)
    assert raised(autoregressive(len(seconds), FANS, 0.0, 2) + weather, SLOW) == []
