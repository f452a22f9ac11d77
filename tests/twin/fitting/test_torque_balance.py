"""twin.fitting.balance: the balance equals its recursion, and differentiates no noise."""

import numpy as np
import pytest

from fantwin.twin.fitting.balance import FILTER_RATE_PER_S
from tests.support.fan_data import torque_balance

COEFFICIENTS = np.array([[0.15, 0.012, 0.0025, 4.0], [0.3, 0.2, 0.001, -2.0]])
LAG_S = np.array([0.05, 0.0])
STEP_S = 0.01


def wandering(samples: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Commands and speeds of two fans that are independent of each other."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.0, 100.0, (samples, 2)), 50.0 + 80.0 * rng.normal(size=(samples, 2))


def test_it_is_the_recursion_sample_by_sample() -> None:
    command, speed = wandering(300)
    balance = torque_balance(command, speed, STEP_S, COEFFICIENTS, LAG_S)
    a = np.exp(-FILTER_RATE_PER_S * STEP_S)
    for fan, (lag_s, (inertia, viscous, drag, friction)) in enumerate(zip(LAG_S, COEFFICIENTS, strict=True)):
        f, lagged = 0.0, command[0, fan]
        for k in range(299):
            left = np.exp(-STEP_S / lag_s) if lag_s else 0.0
            mean_left = (1.0 - left) * lag_s / STEP_S
            acting = command[k, fan] + (lagged - command[k, fan]) * mean_left
            lagged = command[k, fan] + (lagged - command[k, fan]) * left
            middle, rise = speed[k : k + 2, fan].mean(), (speed[k + 1, fan] - speed[k, fan]) / STEP_S
            x = acting - inertia * rise - viscous * middle - drag * middle * abs(middle) - friction
            f = a * f + (1.0 - a) * x
            assert balance[k + 1, fan] == pytest.approx(f / (1.0 - a ** (k + 1)), rel=1e-9)
    assert np.isnan(balance[0]).all()


def test_after_an_unknown_speed_the_filter_starts_again_and_the_other_fan_continues() -> None:
    command, speed = wandering(200)
    whole = torque_balance(command, speed, STEP_S, COEFFICIENTS, LAG_S)
    broken = speed.copy()
    broken[80:90, 1] = np.nan
    balance = torque_balance(command, broken, STEP_S, COEFFICIENTS, LAG_S)
    np.testing.assert_array_equal(balance[:, 0], whole[:, 0])
    assert np.isnan(balance[80:91, 1]).all()
    assert np.isfinite(np.delete(balance[1:, 1], slice(79, 90))).all()
    from_there = torque_balance(command[90:], speed[90:], STEP_S, COEFFICIENTS, LAG_S)
    np.testing.assert_allclose(balance[91:, 1], from_there[1:, 1], rtol=1e-9)
