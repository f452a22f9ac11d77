"""scoring.torque_balance: the balance of a stream is that of the whole, however the stream is cut."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scoring.torque_balance import SETTLED, BalanceModel, TorqueBalance
from twin.fitting.balance import FILTER_RATE_PER_S, torque_balance

STEP_S = 0.01
COEFFICIENTS = np.array([[0.15, 0.012, 0.0025, 4.0], [0.3, 0.2, 0.001, 0.0], [0.05, 0.1, 0.002, 1.0]])
LAG_S = np.array([0.05, 0.0, 0.3])
FANS = len(LAG_S)
SETTLED_ROWS = int(np.ceil(-np.log(1.0 - SETTLED) / (FILTER_RATE_PER_S * STEP_S)))
"""steps until the filter is settled"""


def balance_model(lag_s: np.ndarray = LAG_S, lowest: float = 0.0, highest: float = 1e9) -> BalanceModel:
    inertia, viscous, drag, friction = COEFFICIENTS.T
    return BalanceModel(
        inertia, viscous, drag, friction, lag_s, FILTER_RATE_PER_S, np.full(FANS, lowest), highest_speed_rad_s=highest
    )


def wandering(samples: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (samples, FANS)
    return rng.uniform(10.0, 100.0, shape), 150.0 + 20.0 * rng.normal(size=shape), np.ones(shape, np.bool_)


def streamed(
    command: np.ndarray, speed: np.ndarray, known: np.ndarray, cuts: Sequence[int] = (), lag_s: np.ndarray = LAG_S
) -> np.ndarray:
    balance = TorqueBalance(balance_model(lag_s))
    edges = [0, *sorted(set(cuts)), len(command)]
    made = [
        balance.update(STEP_S, command[first:last], speed[first:last], known[first:last])
        for first, last in pairwise(edges)
        if last > first
    ]
    return np.concatenate(made)


def test_it_is_the_balance_of_the_twin_once_it_is_settled() -> None:
    command, speed, known = wandering(400)
    whole = torque_balance(command, speed, STEP_S, COEFFICIENTS, LAG_S)
    balance = streamed(command, speed, known)
    assert np.isnan(balance[:SETTLED_ROWS]).all()
    np.testing.assert_allclose(balance[SETTLED_ROWS:], whole[SETTLED_ROWS:], rtol=1e-9, atol=1e-9)


def test_after_an_unknown_sample_a_fan_starts_again_like_the_twin_and_other_fans_continue() -> None:
    command, speed, known = wandering(400)
    known[150:153, 1] = False
    unknown = np.where(known, speed, np.nan)
    whole = torque_balance(command, unknown, STEP_S, COEFFICIENTS, LAG_S)
    balance = streamed(command, speed, known)
    assert np.isnan(balance[150 : 153 + SETTLED_ROWS, 1]).all()
    rows = np.r_[SETTLED_ROWS:150, 153 + SETTLED_ROWS : 400]
    np.testing.assert_allclose(balance[rows, 1], whole[rows, 1], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(balance[:, [0, 2]], streamed(command, speed, np.ones_like(known))[:, [0, 2]])


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 1000),
    cuts=st.lists(st.integers(1, 199), max_size=12),
    holes=st.lists(st.tuples(st.integers(0, 199), st.integers(0, 30), st.integers(0, FANS - 1)), max_size=4),
    numbers=st.lists(st.tuples(st.integers(0, 199), st.integers(0, FANS - 1)), max_size=3),
    off=st.tuples(st.integers(0, 199), st.integers(0, 60)),
)
def test_cuts_change_no_bit(
    seed: int,
    cuts: list[int],
    holes: list[tuple[int, int, int]],
    numbers: list[tuple[int, int]],
    off: tuple[int, int],
) -> None:
    command, speed, known = wandering(200, seed)
    for row, length, fan in holes:
        known[row : row + length, fan] = False
        speed[row : row + length, fan] = np.nan
    for row, fan in numbers:
        known[row, fan] = False
        command[row, fan] = np.nan
    command[off[0] : sum(off)] = 0.0  # all drives off
    whole = streamed(command, speed, known)
    np.testing.assert_array_equal(streamed(command, speed, known, cuts), whole)
    np.testing.assert_array_equal(streamed(command, speed, known, range(200)), whole)


def test_the_balance_is_unknown_while_a_drive_is_off_and_starts_again_with_it() -> None:
    command, speed, known = wandering(300)
    command[100:150, 0] = 2.0  # less than friction takes
    balance = streamed(command, speed, known)
    assert np.isnan(balance[100 : 150 + SETTLED_ROWS, 0]).all()
    assert np.isfinite(balance[150 + SETTLED_ROWS :, 0]).all()
    assert np.isfinite(balance[SETTLED_ROWS:, 1:]).all()


def test_the_balance_is_unknown_below_the_lowest_and_above_the_highest_speed() -> None:
    command, speed, known = wandering(200)
    speed[100:110], speed[160:165] = 5.0, 5000.0
    balance = TorqueBalance(balance_model(lowest=20.0, highest=1000.0)).update(STEP_S, command, speed, known)
    assert np.isnan(balance[100 : 110 + SETTLED_ROWS]).all()  # starts again: the filter must forget what held the rotor
    assert np.isfinite(balance[110 + SETTLED_ROWS : 160]).all()
    assert np.isnan(balance[160:165]).all()
    assert np.isfinite(balance[165:]).all()


@pytest.mark.parametrize("more", [3.0, -3.0])
def test_a_torque_that_sets_in_shows_with_its_sign_and_in_its_size(more: float) -> None:
    speed = np.full((600, FANS), 100.0)
    _, viscous, drag, friction = COEFFICIENTS.T
    command = np.broadcast_to(viscous * 100.0 + drag * 100.0**2 + friction, speed.shape).copy()
    command[200:] += more
    balance = streamed(command, speed, np.ones(speed.shape, np.bool_), lag_s=np.zeros(FANS))
    np.testing.assert_allclose(balance[SETTLED_ROWS:200], 0.0, atol=1e-9)
    np.testing.assert_allclose(balance[-1], more, rtol=1e-4)
    after = 201 + round(1.0 / (FILTER_RATE_PER_S * STEP_S))
    np.testing.assert_allclose(balance[after], more * (1.0 - np.exp(-1.0)), rtol=0.03)
