"""The electrical lag between command and torque: lag i' + i = tau (equation (1) of Peng and Chen, scaled).

i is the current, in units of the command. Neither it nor the command depends on the speed, so the command is lagged
before the motion is integrated: exactly, for a command held over each step, and then averaged over the step, so that
its whole impulse reaches the rotor. With lag_s = 0 the effective command is the command.
"""

import numpy as np

from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.runs import Array


def effective_command(command: Array, step_s: Array, lag_s: Array, lagged_before: Array) -> tuple[Array, Array]:
    """The command that acts (n, batch), and the lagged command after the last step (batch,).

    command: (n, batch). step_s: (n, batch) or (n, 1). lag_s, lagged_before: (batch,).
    """
    if not np.any(lag_s):
        return command, command[-1]
    decay, mean_share = _decay_and_mean_share(step_s, lag_s)
    lagged = _lagged(command, decay, lagged_before)
    return command + (lagged[:-1] - command) * mean_share, lagged[-1]


def effective_command_by_lag(command: Array, step_s: Array, lag_s: Array, lagged_before: Array) -> Array:
    """(n, batch) derivative of the effective command by lag_s, in command units per second. Inputs as above."""
    decay, mean_share = _decay_and_mean_share(step_s, lag_s)
    lagged = _lagged(command, decay, lagged_before)
    with np.errstate(divide="ignore", invalid="ignore"):
        decay_by_lag = np.where((lag_s > 0.0) & (step_s > 0.0), decay * step_s / lag_s**2, 0.0)
        share_by_lag = np.where(step_s > 0.0, (1.0 - decay - decay_by_lag * lag_s) / step_s, 0.0)
    distance = lagged[:-1] - command
    forcing = np.concatenate((np.zeros((1, command.shape[1])), distance * decay_by_lag))
    lagged_by_lag = linear_recursion(decay, forcing)[:-1]
    return mean_share * lagged_by_lag + distance * share_by_lag


def _decay_and_mean_share(step_s: Array, lag_s: Array) -> tuple[Array, Array]:
    """(n, batch) share of a deviation that remains after each step, and its mean over the step."""
    step_s = np.broadcast_to(step_s, (len(step_s), len(lag_s)))
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.where(step_s > 0.0, step_s / lag_s, 0.0)
        mean_share = np.where(steps > 0.0, -np.expm1(-steps) / steps, 1.0)
    return np.exp(-steps), mean_share


def _lagged(command: Array, decay: Array, lagged_before: Array) -> Array:
    """(n + 1, batch) the lagged command at each sample and after the last step."""
    forcing = np.concatenate((lagged_before[np.newaxis], (1.0 - decay) * command))
    return linear_recursion(decay, forcing)
