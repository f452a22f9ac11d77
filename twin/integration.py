"""Runge-Kutta integration of w' = f(w, command), and its exact derivatives.

The command is held over each step (zero-order). One classical fourth-order step per sample, whatever the step: local
error of order 5, global error of order 4 (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I,
section II.1). The exported graph takes the same step, so that both give the same numbers.

A fan's state is one speed, so the free run's derivative by all parameters is a scalar recursion per fan:
S[k+1] = A[k] S[k] + B[k]. A and B need the speeds only and are computed for all samples at once.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from twin.runs import Array

Acceleration = Callable[[Array, Array], Array]


class RightHandSide(Protocol):
    """w' as a function of speed and command, with its derivatives. Arrays of any equal shape (..., batch)."""

    def acceleration(self, speed_rad_s: Array, command: Array) -> Array:
        """(..., batch) in rad/s^2."""
        ...

    def linearise(self, speed_rad_s: Array, command: Array) -> tuple[Array, Array, Array]:
        """The acceleration (..., batch), its derivative by speed (..., batch) and by theta (..., batch, P)."""
        ...


def rk4_step(acceleration: Acceleration, speed_rad_s: Array, command: Array, step_s: Array | float) -> Array:
    """The speed one step later. All arrays (batch,), or step_s a number common to all."""
    half_s = 0.5 * step_s
    k1 = acceleration(speed_rad_s, command)
    k2 = acceleration(speed_rad_s + half_s * k1, command)
    k3 = acceleration(speed_rad_s + half_s * k2, command)
    k4 = acceleration(speed_rad_s + step_s * k3, command)
    return speed_rad_s + step_s / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)


def free_run(
    acceleration: Acceleration, initial_speed_rad_s: Array, command: Array, step_s: Array
) -> tuple[Array, Array]:
    """Integrate from one initial speed under the commands alone.

    initial_speed_rad_s: (batch,). command: (n, batch). step_s: (n,) or (n, batch), from sample k to k + 1.
    Returns the speed at each sample (n, batch), before that sample's command acts, and the speed (batch,) after the
    last step. An unstable model gives non-finite speeds, not an exception.
    """
    speed_rad_s = np.empty_like(command)
    current = np.array(initial_speed_rad_s, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(len(command)):
            speed_rad_s[k] = current
            current = rk4_step(acceleration, current, command[k], step_s[k])
    return speed_rad_s, current


def rk4_step_derivatives(rhs: RightHandSide, speed_rad_s: Array, command: Array, step_s: Array) -> tuple[Array, Array]:
    """Derivatives of one step's result by the speed it started from (..., batch) and by theta (..., batch, P).

    All inputs (..., batch): the steps of a whole free run are differentiated at once.
    """
    total_by_speed = np.zeros_like(speed_rad_s)
    total_by_theta: Array | float = 0.0
    k = k_by_speed = np.zeros_like(speed_rad_s)
    k_by_theta: Array | float = 0.0
    for reach, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
        reach_s = reach * step_s
        stage_by_theta = reach_s[..., np.newaxis] * k_by_theta
        stage_by_speed = 1.0 + reach_s * k_by_speed
        k, slope, direct = rhs.linearise(speed_rad_s + reach_s * k, command)
        k_by_speed = slope * stage_by_speed
        k_by_theta = slope[..., np.newaxis] * stage_by_theta + direct
        total_by_speed = total_by_speed + weight * k_by_speed
        total_by_theta = total_by_theta + weight * k_by_theta
    sixth_s = step_s / 6.0
    return 1.0 + sixth_s * total_by_speed, sixth_s[..., np.newaxis] * np.asarray(total_by_theta)


def free_run_sensitivities(rhs: RightHandSide, speed_rad_s: Array, command: Array, step_s: Array) -> Array:
    """(n, batch, P + 1) derivatives of a free run by theta and, last, by its own initial speed.

    speed_rad_s: (n, batch), the free run itself. command, step_s: (n, batch).
    """
    by_speed, by_theta = rk4_step_derivatives(rhs, speed_rad_s[:-1], command[:-1], step_s[:-1])
    steps, batch, parameters = by_theta.shape
    sensitivity = np.zeros((steps + 1, batch, parameters + 1))
    sensitivity[0, :, -1] = 1.0
    sensitivity[1:, :, :-1] = by_theta
    for k in range(steps):
        sensitivity[k + 1] += by_speed[k, :, np.newaxis] * sensitivity[k]
    return sensitivity
