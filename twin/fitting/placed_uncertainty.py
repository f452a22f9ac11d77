"""How far the twin of placed fans may be wrong at each speed and command.

Where the fans of its type were trained, the error is theirs: the largest of them, for a fan that was never seen. To it
comes what is not known of the fan's own physics, as an error of the speed at which it settles.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.twin.fitting.model_uncertainty import SETTLING_SPEEDS, Settling, significant
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.physical import fitted_unknowns, physical_parameters
from fantwin.twin.runs import Array

REACH = 1.5
"""how far fans may settle, in top speeds of the type"""


def placed_uncertainty(
    of_type: ModelUncertainty,
    model: FanOde,
    parameters: Array,
    covariance: Array,
    top_speed_rad_s: float,
    friction: Array,
) -> ModelUncertainty:
    """The tables of placed fans. parameters: (fans, 4). covariance: (fans, 4, 4) of their unknowns. friction: (fans,)
    what a drive takes of the command before it acts.
    """
    speeds_rad_s = REACH * top_speed_rad_s * np.linspace(-1.0, 1.0, SETTLING_SPEEDS)
    commands, largest = np.array(of_type.commands), np.max(np.array(of_type.std_rad_s), axis=0)
    settled, tables = [], []

    @lru_cache(maxsize=1)
    def settling(lost: float) -> Settling:
        return Settling(model, commands - lost, speeds_rad_s)

    for own, spread, lost in zip(parameters, covariance, friction.tolist(), strict=True):
        own_rad_s, *moved_rad_s = (settling(lost).of_fan(each) for each in (own, *_moved(own, spread, top_speed_rad_s)))
        unknown_rad_s = np.sqrt(np.sum(np.square(np.array(moved_rad_s) - own_rad_s), axis=0))
        settled.append(own_rad_s)
        tables.append(np.hypot(largest, unknown_rad_s[:, np.newaxis]))
    seen = max(of_type.seen_std_rad_s, default=0.0)
    return replace(
        of_type,
        std_rad_s=tuple(tuple(tuple(significant(row, 4)) for row in table) for table in tables),
        settled_speed_rad_s=tuple(tuple(significant(each)) for each in settled),
        seen_std_rad_s=(seen,) * len(parameters),
    )


def _moved(own: Array, covariance: Array, top_speed_rad_s: float) -> Array:
    """(4, 4) the physics with the unknowns moved by one standard deviation, along each axis of their covariance."""
    top = np.full(len(own), top_speed_rad_s)
    variances, axes = np.linalg.eigh(covariance)
    moves = np.sqrt(np.maximum(variances, 0.0))[:, np.newaxis] * axes.T
    return physical_parameters(fitted_unknowns(np.tile(own, (len(own), 1)), top) + moves, top)
