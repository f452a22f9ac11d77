"""How far each parameter of a fan has moved from health over a window, one at a time, with standard errors.

The same filtered regression as in a diagnosis (scoring.diagnosis.regression_window), by plain least squares, for a
change that is
there all the time: drag and gain relative, friction in units of the command. Each is the whole drift of the fan told
as that parameter's; which of them it is, is for a diagnosis. A series of them is what wear is seen in
(scoring.wear.trend):
give windows with the offset of commissioning, not with one that follows the fan.
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
FEWEST_ROWS = 20


@dataclass(frozen=True)
class Drift:
    """Change of one parameter since health, and its standard error (of noise alone: the twin's errors do not move)."""

    parameter: str
    change: float
    std_error: float


def parameter_drifts(window: Window, healthy: HealthyBalance) -> tuple[Drift, ...]:
    """Drag, friction and gain over a window; none when too little of it counts. Its onset is not looked at."""
    regression = RegressionWindow(window, healthy)
    if regression.rows < FEWEST_ROWS:
        return ()
    always = np.full(1, -np.inf)
    columns = regression.columns(always, always)[0]
    variance, inflation = mean_of_correlated(healthy.autocorrelation_time_s / window.step_s, regression.per_row)
    residual = columns[RESIDUAL]
    drifts = []
    for parameter, (column, sign) in COLUMNS.items():
        direction = sign * columns[column]
        size = float(direction @ direction)
        if not size > 0.0:
            continue  # a fan without drag, as far as could be told
        change = float(direction @ residual) / size
        left = float(np.square(residual - change * direction).sum()) / (regression.rows - 1)
        noise = max(left, healthy.sigma_command**2 * variance)
        drifts.append(Drift(parameter, change, float(np.sqrt(noise * inflation / size))))
    return tuple(drifts)
