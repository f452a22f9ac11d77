"""Whether the free run of a NARX network is stable: it must forget where it started, and stay near the recorded speeds.

A recursion that fits its data can have a second, false steady state where there were no data, and a start or a jump of
the command that was not in the training data can take it there permanently. Probing detects this without measured
speeds: the network runs under long held commands over the range of training, from below the lowest and from above the
highest speed of training.
"""

import numpy as np

from fantwin.twin.models.narx import Narx
from fantwin.twin.models.physics import PARAMETER_NAMES

LEVELS = 16
# A fan without drive coasts far longer than its time constant at speed.
PROBE_TIME_CONSTANTS, SHORTEST_PROBE_SAMPLES = 30.0, 1000
# Beyond the range of training's speeds by a tenth of it on each side: a fan at rest may lie outside.
REACH = 1.2
# In shares of the range of speeds in training.
FORGOTTEN, MARGIN = 0.1, 0.5


def forgets_its_start(model: Narx, time_constant_samples: float) -> bool:
    """Whether both runs of each level end at the same speed, at most half the training range of speeds outside it.

    time_constant_samples: of the fan at speed, in samples.
    """
    scaling = model.scaling
    samples = max(round(PROBE_TIME_CONSTANTS * time_constant_samples), SHORTEST_PROBE_SAMPLES)
    level = scaling.command_offset + scaling.command_scale * np.tile(np.linspace(-1.0, 1.0, LEVELS), 2)
    start = scaling.speed_offset_rad_s + scaling.speed_scale_rad_s * np.repeat((-REACH, REACH), LEVELS)
    state = model.state_layout.initial_state(start, level)
    unused = np.ones((2 * LEVELS, len(PARAMETER_NAMES)))
    speed_rad_s, _ = model.advance(state, np.tile(level, (samples, 1)), np.ones(samples), unused)
    relative = (speed_rad_s - scaling.speed_offset_rad_s) / (2.0 * scaling.speed_scale_rad_s)
    from_low, from_high = relative[-1, :LEVELS], relative[-1, LEVELS:]
    return bool(np.all(np.abs(from_low - from_high) < FORGOTTEN) and np.all(np.abs(relative) < 0.5 + MARGIN))
