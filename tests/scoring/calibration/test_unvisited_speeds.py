"""With few data limits are wider at speeds that calibration has not seen, if a tacho counts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from schemas.tacho import INSTANTANEOUS, Tacho
from scoring.calibration.healthy_statistics import HealthyRun
from scoring.limits import Limits, default_timing
from tests.support.calibrated_runs import calibrate
from tests.support.healthy_residuals import in_blocks, samples_of

FANS, TOP_RAD_S, HELD_RAD_S = 4, 200.0, 100.0
COUNTS = (Tacho(kind="count", pulses=2, window_s=0.1),)


def limits_of(tachos: tuple[Tacho, ...], runs: int, per_day: float) -> Limits:
    """Of fans that held one speed."""

    def each() -> Iterator[HealthyRun]:
        for run in range(runs):
            speed, balance = np.random.default_rng(run).normal(size=(2, 1200, FANS))
            made = samples_of(speed, balance, period_ns=100_000_000)
            held = replace(made, speed_sigma_rad_s=np.full(speed.shape, 2.0))
            yield HealthyRun(f"run {run}", FANS, in_blocks(held), tachos=tachos)

    return calibrate(each, TOP_RAD_S, default_timing(FANS), per_day, extrapolate=True, has_drive=True)


def std_at(limits: Limits, speed_rad_s: float) -> float:
    """The low-frequency standard deviation at a speed, which limits are relative to."""
    speeds_rad_s = limits.speed.speeds_rad_s
    return float(np.interp(speed_rad_s, speeds_rad_s, np.resize(limits.speed.persistent_std, len(speeds_rad_s))))


@pytest.mark.parametrize(
    ("tachos", "per_day", "is_wider"), [(COUNTS, 1.0, True), (INSTANTANEOUS, 1.0, False), (COUNTS, 20_000.0, False)]
)
def test_they_are_wider_with_few_data_of_tachos_that_count(tachos, per_day: float, is_wider: bool) -> None:
    limits = limits_of(tachos, 2, per_day)
    for other_rad_s in (HELD_RAD_S - 25.0, HELD_RAD_S + 25.0):
        assert std_at(limits, other_rad_s) == pytest.approx(
            (2.5 if is_wider else 1.0) * min(limits.speed.persistent_std)
        )
