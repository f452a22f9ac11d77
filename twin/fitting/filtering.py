"""The filtering operator: both sides of a differential equation through 1 / (s + lambda).

If w' = sum_j theta_j phi_j, then, with f_x the filtered x and no derivative taken anywhere,

    w - lambda f_w = w(0) exp(-lambda t) + sum_j theta_j f_phi_j          (equations (13) to (18) of Peng and Chen,
                                                                          with y_1 = -w(0) exp(-lambda t) - lambda f_w)

which is linear in theta. Between samples speeds are linear and commands are held, and under that the filter is
discretised exactly, for steps of any length. w(0) is measured with noise, so it is not subtracted but estimated: its
column is projected out of both sides.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fantwin.twin.models.lag import effective_command
from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.runs import Array, Run
from fantwin.twin.tacho_readings import with_measured_command

Basis = Callable[[Array, Array], Array]
"""Speed (n,) and command (n,) to the regressors phi (n, P)."""


def filter_between_samples(start: Array, end: Array, step_s: Array, lambda_per_s: float) -> Array:
    """Filter a signal that goes linearly from start to end within each step.

    start, end: (n - 1, P). step_s: (n - 1,). Returns (n, P), zero at first. A held signal has start equal to end.
    """
    x = lambda_per_s * step_s
    decay = np.exp(-x)
    whole_s = -np.expm1(-x) / lambda_per_s
    # Below 1e-3 the closed form loses digits to cancellation; three terms of its series are then exact to 1e-10.
    small = x < 1e-3
    safe = np.where(small, 1.0, x)
    late_s = step_s * np.where(small, 0.5 - x / 6.0 + x * x / 24.0, (1.0 + np.expm1(-safe) / safe) / safe)
    forced = (whole_s - late_s)[:, np.newaxis] * start + late_s[:, np.newaxis] * end
    forcing = np.concatenate((np.zeros((1, start.shape[1])), forced))
    return linear_recursion(decay[:, np.newaxis], forcing[:, np.newaxis])[:, 0]


def filtered_regression(
    t_s: Array, speed_rad_s: Array, command: Array, basis: Basis, lambda_per_s: float
) -> tuple[Array, Array]:
    """Target (m,) and regressors (m, P) of one fan's run, at its m measured samples, free of the initial speed.

    t_s, speed_rad_s, command: (n,). Missing speeds are bridged linearly within the filter and give no row.
    """
    measured = np.isfinite(speed_rad_s)
    speed = np.interp(t_s, t_s[measured], speed_rad_s[measured])
    step_s = np.diff(t_s)
    held = command[:-1]
    start = np.column_stack((speed[:-1], basis(speed[:-1], held)))
    end = np.column_stack((speed[1:], basis(speed[1:], held)))
    filtered = filter_between_samples(start, end, step_s, lambda_per_s)
    rows = np.column_stack((speed - lambda_per_s * filtered[:, 0], filtered[:, 1:]))[measured]
    initial = np.exp(-lambda_per_s * (t_s - t_s[0]))[measured]
    if square := float(initial @ initial):  # 0 where the first reading comes so late that no start is left in it
        rows -= np.outer(initial, initial @ rows / square)
    return rows[:, 0], rows[:, 1:]


def with_lagged_command(pieces: Sequence[Run], lag_s: Array) -> list[Run]:
    """The pieces with the commands after the lag, lag_s (fans,), as the tachos would show them."""
    return [
        replace(
            piece, command=effective_command(piece.command, piece.step_s[:, np.newaxis], lag_s, piece.command[0])[0]
        )
        for piece in map(with_measured_command, pieces)
    ]
