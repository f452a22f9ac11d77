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
    cleaned, share = without_outliers(with_speed(run, speed))
    found = np.isnan(cleaned.speed_rad_s)
    assert (found & bad).sum() > 0.97 * bad.sum()
    assert (found & ~bad).sum() <= 2
    assert share[0] == pytest.approx(bad[:, 0].mean(), rel=0.05)
    assert share[1] == 0.0


@pytest.mark.parametrize("rate", [1.0, 0.1], ids=["slow fan", "fan of 23 ms"])
def test_a_healthy_fan_keeps_all_its_samples(rate: float) -> None:
    run = fan_data.rough_run(3, 60.0)
    speed = run.speed_rad_s[:: round(1.0 / rate)]
    coarse = Run("coarse", run.t_s[: len(speed)], run.command[:: round(1.0 / rate)], speed)
    assert np.all(without_outliers(coarse)[1] < 2e-4)


def test_the_steps_of_a_quantised_tacho_are_no_outliers() -> None:
    run = fan_data.published_run(3, 60.0)
    quantised = np.round(run.speed_rad_s / 20.0) * 20.0
    assert np.all(without_outliers(with_speed(run, quantised))[1] < 2e-3)


def test_missing_speeds_stay_missing_and_are_not_counted() -> None:
    run = fan_data.published_run(3, 10.0)
    speed = run.speed_rad_s.copy()
    speed[::3] = np.nan
    cleaned, share = without_outliers(with_speed(run, speed))
    np.testing.assert_array_equal(cleaned.speed_rad_s, speed)
    assert share[0] == 0.0
