"""Dropouts and glitches are found; transients, noise and steps of a quantised tacho are not."""

import numpy as np
import pytest

from fantwin.twin.fitting.outliers import without_outliers
from fantwin.twin.runs import Run
from tests.support import fan_data


def with_speed(run: Run, speed_rad_s: np.ndarray) -> Run:
    return Run(run.name, run.t_s, run.command, speed_rad_s)


def test_dropouts_and_double_counts_are_left_out_and_counted() -> None:
    run = fan_data.rough_run(1, 40.0, fans=2)
    rng = np.random.default_rng(2)
    speed = run.speed_rad_s.copy()
    bad = (rng.random(speed.shape) < 0.02) & (speed > 60.0)
    bad[:, 1] = False
    speed[bad] *= rng.choice([0.0, 2.0], bad.sum())
    speed[::7, 1] = np.nan
    cleaned, share = without_outliers(with_speed(run, speed))
    found = np.isnan(cleaned.speed_rad_s)
    assert (found & bad).sum() > 0.97 * bad.sum()
    assert (found & ~bad)[:, 0].sum() <= 2, "missing speeds are not counted"
    assert share[0] == pytest.approx(bad[:, 0].mean(), rel=0.05)
    assert share[1] == 0.0


@pytest.mark.parametrize(
    ("every", "step_rad_s", "most"),
    [(1, 0.0, 2e-4), (10, 0.0, 2e-4), (1, 20.0, 2e-3)],
    ids=["slow fan", "fan of 23 ms", "coarse tacho"],
)
def test_a_healthy_fan_keeps_all_its_samples(every: int, step_rad_s: float, most: float) -> None:
    run = fan_data.published_run(3, 60.0) if step_rad_s else fan_data.rough_run(3, 60.0)
    speed = np.round(run.speed_rad_s / step_rad_s) * step_rad_s if step_rad_s else run.speed_rad_s[::every]
    coarse = Run("coarse", run.t_s[: len(speed)], run.command[::every], speed)
    assert np.all(without_outliers(coarse)[1] < most)
