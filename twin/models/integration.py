"""Runge-Kutta integration of w' = f(w, command), all samples at once, and its exact derivatives.

The command is held over each step (zero-order). One classical fourth-order step per sample, whatever the step: local
error of order 5, global error of order 4 (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I,
section II.1). The exported graph takes the same step, so that both give the same numbers.

A free run is the solution of x[k + 1] = F_k(x[k]). Newton's method takes all these equations together: linearised about
a guess of the whole run they are one bidiagonal system (twin.models.recursion), and for a fan, which forgets its
initial speed, four or five iterations reach rounding error. Stepping from sample to sample would cost a Python call per
sample. (The idea: Lim et al., Parallelizing non-linear sequential models over the sequence length, ICLR 2024.) If
Newton's method does not converge, the run is cut into shorter windows; if that fails, as for an unstable model, the
samples are computed one by one.
"""

from collections.abc import Callable

import numpy as np

from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.models.right_hand_side import FanEquation
from fantwin.twin.runs import Array

Acceleration = Callable[[Array, Array], Array]

NEWTON_ITERATIONS = 25
NEWTON_TOLERANCE = 1e-7
SHORTEST_WINDOW = 16
"""samples up to which stepping is as cheap as one solution for all"""
WIDE_BATCH = 64
"""number of fans from which arithmetic dominates NumPy's call overhead, so that stepping is cheaper"""
MAX_WINDOW = 250_000
"""samples times batch that are solved for at once: it bounds the memory"""


def rk4_step(acceleration: Acceleration, speed_rad_s: Array, command: Array, step_s: Array | float) -> Array:
    """The speed one step later. All arrays (batch,), or step_s a number common to all."""
    half_s = 0.5 * step_s
    k1 = acceleration(speed_rad_s, command)
    k2 = acceleration(speed_rad_s + half_s * k1, command)
    k3 = acceleration(speed_rad_s + half_s * k2, command)
    k4 = acceleration(speed_rad_s + step_s * k3, command)
    return speed_rad_s + step_s / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)


def free_run(
    rhs: FanEquation, initial_speed_rad_s: Array, command: Array, step_s: Array, guess_rad_s: Array | None = None
) -> tuple[Array, Array]:
    """Integrate from one initial speed under the commands alone.

    initial_speed_rad_s: (batch,). command: (n, batch). step_s: (n,) or (n, batch), from sample k to k + 1.
    guess_rad_s: (n, batch) speeds near the solution, if known; it only saves iterations.
    Returns the speed at each sample (n, batch), before that sample's command acts, and the speed (batch,) after the
    last step. An unstable model gives non-finite speeds, not an exception.
    """
    samples, batch = command.shape
    step_s = np.broadcast_to(step_s.reshape(samples, -1), command.shape)
    if batch >= WIDE_BATCH:
        with np.errstate(over="ignore", invalid="ignore"):
            return step_through(rhs.acceleration, initial_speed_rad_s, command, step_s)
    speed_rad_s = np.empty_like(command)
    current = np.array(initial_speed_rad_s, dtype=np.float64)
    window = largest = max(SHORTEST_WINDOW, MAX_WINDOW // batch)
    first = 0
    with np.errstate(over="ignore", invalid="ignore"):
        while first < samples:
            part = slice(first, first + window)
            guess = None if guess_rad_s is None else guess_rad_s[part]
            solved = _solve(rhs, current, command[part], step_s[part], guess)
            if solved is None and window > SHORTEST_WINDOW:
                # Over a shorter time the guess is nearer to the truth.
                window = max(SHORTEST_WINDOW, min(window, samples - first) // 4)
                continue
            if solved is None:
                solved = step_through(rhs.acceleration, current, command[part], step_s[part])
            speed_rad_s[part], current = solved
            first += window
            window = min(2 * window, largest)
    return speed_rad_s, current


def _solve(
    rhs: FanEquation, initial_speed_rad_s: Array, command: Array, step_s: Array, guess_rad_s: Array | None
) -> tuple[Array, Array] | None:
    """The free run by Newton's method, or None where that does not converge."""
    if len(command) <= SHORTEST_WINDOW:
        return None
    speed = np.empty((len(command) + 1, command.shape[1]))
    speed[:-1] = initial_speed_rad_s if guess_rad_s is None else guess_rad_s
    speed[-1], speed[0] = speed[-2], initial_speed_rad_s
    for _ in range(NEWTON_ITERATIONS):
        following, by_speed = _rk4_step_slope(rhs, speed[:-1], command, step_s)
        correction = np.zeros_like(speed)
        correction[1:] = following - speed[1:]
        correction = linear_recursion(by_speed, correction)
        speed += correction
        largest = np.abs(correction).max(axis=0)
        if not np.all(np.isfinite(largest)):
            return None
        if np.all(largest <= NEWTON_TOLERANCE * (1.0 + np.abs(speed).max(axis=0))):
            # Convergence is quadratic: the remaining error is about the square of this.
            return speed[:-1], speed[-1].copy()
    return None


def step_through(
    acceleration: Acceleration, initial_speed_rad_s: Array, command: Array, step_s: Array
) -> tuple[Array, Array]:
    """free_run sample by sample, for any acceleration. step_s: (n, batch) or (n,)."""
    speed_rad_s, current = np.empty_like(command), np.array(initial_speed_rad_s, dtype=np.float64)
    for k in range(len(command)):
        speed_rad_s[k] = current
        current = rk4_step(acceleration, current, command[k], step_s[k])
    return speed_rad_s, current


def _rk4_step_slope(rhs: FanEquation, speed_rad_s: Array, command: Array, step_s: Array) -> tuple[Array, Array]:
    """The result of each step and its derivative by the speed it started from; all arrays (..., batch)."""
    half_s = 0.5 * step_s
    k1, d1 = rhs.slope(speed_rad_s, command)
    k2, d2 = rhs.slope(speed_rad_s + half_s * k1, command)
    d2 = d2 * (1.0 + half_s * d1)
    k3, d3 = rhs.slope(speed_rad_s + half_s * k2, command)
    d3 = d3 * (1.0 + half_s * d2)
    k4, d4 = rhs.slope(speed_rad_s + step_s * k3, command)
    d4 = d4 * (1.0 + step_s * d3)
    sixth_s = step_s / 6.0
    return (
        speed_rad_s + sixth_s * (k1 + 2.0 * (k2 + k3) + k4),
        1.0 + sixth_s * (d1 + 2.0 * (d2 + d3) + d4),
    )


def rk4_step_derivatives(
    rhs: FanEquation, speed_rad_s: Array, command: Array, step_s: Array
) -> tuple[Array, Array, Array]:
    """Derivatives of one step's result by the speed it started from and by the command held (..., batch), and by theta
    (..., batch, P).

    All inputs (..., batch): the steps of a whole free run are differentiated at once.
    """
    total_by_speed = np.zeros_like(speed_rad_s)
    total_by_command = np.zeros_like(speed_rad_s)
    k = k_by_speed = k_by_command = np.zeros_like(speed_rad_s)
    direct = k_by_theta = total_by_theta = np.zeros(0)
    for reach, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
        reach_s = reach * step_s
        is_first = reach == 0.0
        k, slope, by_command, direct = rhs.linearise(speed_rad_s + reach_s * k, command, None if is_first else direct)
        k_by_speed = slope * (1.0 + reach_s * k_by_speed)
        k_by_command = slope * reach_s * k_by_command + by_command
        total_by_speed += weight * k_by_speed
        total_by_command += weight * k_by_command
        # The largest arrays are written in place.
        if is_first:
            k_by_theta, total_by_theta, direct = direct, direct.copy(), np.empty_like(direct)
            continue
        k_by_theta *= (slope * reach_s)[..., np.newaxis]
        k_by_theta += direct
        total_by_theta += k_by_theta if weight == 1.0 else np.multiply(k_by_theta, weight, out=direct)
    sixth_s = step_s / 6.0
    total_by_theta *= sixth_s[..., np.newaxis]
    return 1.0 + sixth_s * total_by_speed, sixth_s * total_by_command, total_by_theta


def free_run_sensitivities(
    rhs: FanEquation, speed_rad_s: Array, command: Array, step_s: Array, command_by: Array
) -> Array:
    """(n, batch, P + K + 1) derivatives of a free run by theta, by K unknowns of its command and, last, by its own
    initial speed.

    speed_rad_s: (n, batch), the free run itself. command, step_s: (n, batch). command_by: (n, batch, K), derivatives of
    the command by its unknowns.
    """
    by_speed, by_command, by_theta = rk4_step_derivatives(rhs, speed_rad_s[:-1], command[:-1], step_s[:-1])
    steps, batch, parameters = by_theta.shape
    forcing = np.empty((steps + 1, batch, parameters + command_by.shape[-1] + 1))
    forcing[0], forcing[1:, :, -1] = 0.0, 0.0
    forcing[0, :, -1] = 1.0
    forcing[1:, :, :parameters] = by_theta
    forcing[1:, :, parameters:-1] = by_command[..., np.newaxis] * command_by[:-1]
    return linear_recursion(by_speed, forcing)
