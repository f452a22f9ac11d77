"""The simulated fans whose truth is known: their equation, their noise, and what the docstring claims of them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.training.published_fan import (
    DRAG,
    INERTIA,
    RATE_HZ,
    VISCOUS,
    published_fan,
    published_training,
    rough_run,
)

STEP = np.repeat([0.0, 150.0, 40.0], 100)[:, np.newaxis]


def test_the_published_fan_follows_its_equation():
    speed = published_fan(STEP, 0, "steps").true_speed_rad_s[:, 0]
    exact, w = [], np.zeros(1)
    for (held,) in STEP:
        exact.append(w[0])

        def slope(_t, w, held=held):
            return (held - (VISCOUS + DRAG * np.abs(w)) * w) / INERTIA

        w = solve_ivp(slope, (0.0, 1.0 / RATE_HZ), w, rtol=1e-11, atol=1e-11).y[:, -1]
    np.testing.assert_allclose(speed, exact, rtol=0, atol=1e-8)


def test_the_electrical_lag_follows_its_equation():
    lag_s = 0.03
    lagged = rough_run(3, 4.0, lag_s=lag_s)
    exact, state = [], np.array([0.0, lagged.run.command[0, 0]])
    for (held,) in lagged.run.command:
        exact.append(state[0])

        def slope(_t, state, held=held):
            w, acting = state
            friction = (4.0 + 8.0 * np.exp(-((w / 25.0) ** 2))) * np.tanh(w / 3.0)
            torque = max(acting - 8.0, 0.0) - friction
            return ((torque - (VISCOUS + DRAG * abs(w)) * w) / INERTIA, (held - acting) / lag_s)

        state = solve_ivp(slope, (0.0, 1.0 / RATE_HZ), state, rtol=1e-9, atol=1e-9, max_step=1e-3).y[:, -1]
    np.testing.assert_allclose(lagged.true_speed_rad_s[:, 0], exact, rtol=0, atol=1e-4)


def test_the_noise_is_white_and_has_variance_ten():
    simulated = published_training(5, 400.0)
    noise = (simulated.run.speed_rad_s - simulated.true_speed_rad_s)[:, 0]
    samples = len(noise)
    assert simulated.noise_rms_rad_s == pytest.approx(np.sqrt(10.0), rel=4 / np.sqrt(2 * samples))
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 4 / np.sqrt(samples)
    assert abs(noise.mean()) < 4 * np.sqrt(10.0) / np.sqrt(samples)
