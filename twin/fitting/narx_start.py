"""Where the training of NARX starts: tanh units that together act as the best first-order low-pass filter of the data.

Small random weights keep each unit on the nearly straight part of its tanh, so the layer starts close to a linear model
whose free run is stable and near the data; training adds the curvature. The filter is fitted by output error on a grid
of time constants: with the time constant given, gain and offset are linear in the data, so noise on the speeds biases
nothing, and missing ones are left out.
"""

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from fantwin.twin.models.narx import INPUTS, ORDER, UNITS, regressor_rows
from fantwin.twin.runs import Array

TIME_CONSTANTS_SAMPLES = np.geomspace(0.5, 2000.0, 40)
# Older samples say less about the next one; a factor of 0.7 per lag leaves about 0.03 for the oldest of ten.
LAG_DECAY = 0.7
# Standard deviation of a unit's input when all its regressors have standard deviation one.
UNIT_SLOPE = 0.2
# Regressors of a linear filter lie in a plane. Scatter around it makes the layer linear off the plane as well.
SCATTER = 0.1
MAX_ROWS = 4000


def lag_scale() -> Array:
    """(1151,) relative size that is expected of each weight: it decays with the lag of its input."""
    lags = np.concatenate((np.arange(ORDER), np.arange(ORDER + 1)))
    return np.concatenate((np.repeat(LAG_DECAY**lags, UNITS), np.ones(2 * UNITS + 1)), dtype=np.float64)


def starting_weights(
    commands: Sequence[Array], speeds: Sequence[Array], rng: np.random.Generator
) -> tuple[Array, float]:
    """theta (1151,) of a layer that acts as a first-order filter, and the filter's time constant in samples.

    commands, speeds: one (n,) each a stretch, scaled; a speed of NaN is missing.
    """
    linear, smooth = first_order_filter(commands, speeds)
    regressors = np.concatenate([regressor_rows(*pair) for pair in zip(smooth, commands, strict=True)])
    regressors = rng.choice(regressors, min(len(regressors), MAX_ROWS), replace=False)
    regressors = regressors + rng.normal(scale=SCATTER, size=regressors.shape)
    input_weights = rng.normal(size=(INPUTS, UNITS)) * lag_scale()[: INPUTS * UNITS].reshape(INPUTS, UNITS)
    input_weights *= UNIT_SLOPE / np.linalg.norm(input_weights, axis=0).mean()
    bias = rng.uniform(-1.0, 1.0, UNITS)
    layer = np.column_stack((np.tanh(regressors @ input_weights + bias), np.ones(len(regressors))))
    squares = layer.T @ layer
    ridge = 1e-6 * np.trace(squares) / len(squares) * np.eye(len(squares))
    output = np.linalg.solve(squares + ridge, layer.T @ (regressors @ linear[:-1] + linear[-1]))
    return np.concatenate((input_weights.ravel(), bias, output)), float(-1.0 / np.log(linear[0]))


def first_order_filter(commands: Sequence[Array], speeds: Sequence[Array]) -> tuple[Array, list[Array]]:
    """The best low-pass filter from command to speed: coefficients (22,) of the 21 regressors and 1, and its speeds."""
    measured = np.concatenate(speeds)
    known = np.isfinite(measured)
    candidates = []
    for time_constant in TIME_CONSTANTS_SAMPLES:
        kept = float(np.exp(-1.0 / time_constant))
        smooth = np.concatenate([_low_pass(command, kept) for command in commands])
        columns = np.column_stack((smooth, np.ones(len(smooth))))
        gain_and_offset = np.linalg.lstsq(columns[known], measured[known])[0]
        error = float(np.sum((measured - columns @ gain_and_offset)[known] ** 2))
        candidates.append((error, kept, gain_and_offset))
    _, kept, (gain, offset) = min(candidates, key=lambda candidate: candidate[0])
    linear = np.zeros(INPUTS + 1)
    linear[0], linear[ORDER], linear[-1] = kept, (1.0 - kept) * gain, (1.0 - kept) * offset
    return linear, [gain * _low_pass(command, kept) + offset for command in commands]


def _low_pass(command: Array, kept: float) -> Array:
    """x[k+1] = kept x[k] + (1 - kept) command[k], at rest at the first command."""
    return command[0] + np.asarray(lfilter([0.0, 1.0 - kept], [1.0, -kept], command - command[0]))
