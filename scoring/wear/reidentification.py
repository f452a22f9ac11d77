"""How far each parameter of a fan has drifted from health over a window, one at a time, with standard errors.

The same filtered regression as in a diagnosis (scoring.diagnosis.regression_window), by plain least squares, for a
change that is present throughout the window: drag and gain relative, friction in units of the command. Each parameter
is given the whole drift of the fan; which of them has really changed is a question for a diagnosis. scoring.wear.trend
evaluates series of these drifts: use windows with the fan offset of commissioning, not with one that follows the fan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scoring.diagnosis.regression_window import (
    COMMAND,
    CONSTANT,
    DRAG,
    RESIDUAL,
    HealthyBalance,
    RegressionWindow,
    Window,
    mean_of_correlated,
)

COLUMNS = {"drag": (DRAG, 1.0), "friction": (CONSTANT, 1.0), "gain": (COMMAND, -1.0)}
MIN_ROWS = 20


@dataclass(frozen=True)
class ParameterShift:
    """Change of one parameter from its healthy value. std_error: from noise alone, as the twin's errors are
    constant."""

    parameter: str
    change: float
    std_error: float


def parameter_shifts(window: Window, healthy: HealthyBalance) -> tuple[ParameterShift, ...]:
    """Drag, friction and gain over a window; empty when too few rows count. The window's onset is ignored."""
    regression = RegressionWindow(window, healthy)
    if regression.rows < MIN_ROWS:
        return ()
    whole_window = np.full(1, -np.inf)
    columns = regression.columns(whole_window, whole_window)[0]
    variance, inflation = mean_of_correlated(healthy.autocorrelation_time_s / window.period_s, regression.per_row)
    residual = columns[RESIDUAL]
    drifts = []
    for parameter, (column, sign) in COLUMNS.items():
        direction = sign * columns[column]
        size = float(direction @ direction)
        if not size > 0.0:
            continue  # a fan whose drag was identified as zero
        change = float(direction @ residual) / size
        residual_variance = float(np.square(residual - change * direction).sum()) / (regression.rows - 1)
        noise = max(residual_variance, healthy.sigma_command**2 * variance)
        drifts.append(ParameterShift(parameter, change, float(np.sqrt(noise * inflation / size))))
    return tuple(drifts)
