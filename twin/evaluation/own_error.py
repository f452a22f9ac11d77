"""How far the twin itself may be wrong along a run, by the table of its card."""

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from schemas.model_uncertainty import ModelUncertainty
from twin.runs import Array


def own_error_rad_s(table: ModelUncertainty, speed_rad_s: Array, command: Array) -> Array:
    """Standard deviation at speeds and commands of one shape; NaN where either is. Linear between the points of the
    table, constant beyond its edges.
    """
    axes = (table.speeds_rad_s, table.commands)
    at = [np.clip(values, axis[0], axis[-1]) for values, axis in zip((speed_rad_s, command), axes, strict=True)]
    interpolated = RegularGridInterpolator(axes, np.array(table.std_rad_s), bounds_error=False)
    return interpolated(np.stack(at, axis=-1))
