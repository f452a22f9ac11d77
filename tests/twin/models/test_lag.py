"""The lagged command: exact, with its whole impulse, and equal to the command without a lag."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fantwin.twin.models.lag import effective_command, effective_command_by_lag

STEP_S = np.random.default_rng(1).uniform(0.003, 0.03, (40, 2))
COMMAND = np.random.default_rng(2).uniform(0.0, 90.0, (40, 2))
BEFORE = np.array([10.0, 70.0])
LAG_S = np.array([0.012, 0.08])


def test_each_step_acts_with_the_mean_of_the_lagged_command() -> None:
    acting, after = effective_command(COMMAND, STEP_S, LAG_S, BEFORE)
    for fan in range(2):
        lagged = BEFORE[fan]
        for k in range(len(COMMAND)):
            solved = solve_ivp(
                lambda _t, y, u=COMMAND[k, fan], lag=LAG_S[fan]: [(u - y[0]) / lag, y[0]],
                (0.0, STEP_S[k, fan]),
                [lagged, 0.0],
                rtol=1e-10,
                atol=1e-12,
            )
            lagged, impulse = solved.y[:, -1]
            assert acting[k, fan] == pytest.approx(impulse / STEP_S[k, fan], rel=1e-7)
        assert after[fan] == pytest.approx(lagged, rel=1e-7)


def test_a_step_of_zero_changes_nothing() -> None:
    acting, after = effective_command(COMMAND[:3], np.zeros((3, 2)), np.array([0.0, 0.08]), BEFORE)
    assert np.all(np.isfinite(acting))
    assert after[1] == BEFORE[1]
    assert np.all(np.isfinite(effective_command_by_lag(COMMAND[:3], np.zeros((3, 2)), np.array([0.0, 0.08]), BEFORE)))


@pytest.mark.parametrize("lag_s", [0.0, 0.004, 0.08])
def test_the_derivative_by_the_lag_is_exact(lag_s: float) -> None:
    lag, move = np.full(2, lag_s), 1e-7
    low = max(lag_s - move, 0.0)
    up, _ = effective_command(COMMAND, STEP_S, lag + move, BEFORE)
    down, _ = effective_command(COMMAND, STEP_S, np.full(2, low), BEFORE)
    numeric = (up - down) / (lag_s + move - low)
    exact = effective_command_by_lag(COMMAND, STEP_S, lag, BEFORE)
    np.testing.assert_allclose(exact, numeric, rtol=1e-4, atol=1e-4 * np.abs(numeric).max())
