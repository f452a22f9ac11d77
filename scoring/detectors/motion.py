"""How fast a fan is changing its speed: distance of the speed from its low-pass over one second or more.

A twin that is accurate at constant speed is less accurate while the speed changes, so healthy residuals vary more
there. Limits widen with this measure (an adaptive threshold by the size of the input: Emami-Naeini, Akhter and Rock,
IEEE Transactions on Automatic Control 33 (1988) 1106). The speed is that of the healthy fan, which the twin predicts: a
fan that a fault slows down must not widen its own limits.
"""

from __future__ import annotations

import numpy as np

from schemas.messages import Array
from scoring.detectors.low_pass import LowPass
from scoring.detectors.state import ColumnState

TIME_CONSTANT_S = 1.0
"""and the time for which a reading is held, because readings follow the speed so much later"""


class Motion(ColumnState):
    """The measure of a tray's fans."""

    def __init__(self, fans: int, held_s: float = 0.0) -> None:
        """held_s: the longest time for which a tacho of the tray holds a reading."""
        self.past = LowPass(fans, TIME_CONSTANT_S + held_s, np.nan)
        """rad/s; NaN before the first speed"""

    def update(self, speed_rad_s: Array, period_s: float) -> Array:
        """Take speeds, (n, fans) rad/s. Returns the distance from the low-pass with its sign, (n, fans) rad/s, 0 where
        there is no speed. The measure is its size.
        """
        valid = np.isfinite(speed_rad_s)
        new = np.isnan(self.past.value) & valid.any(axis=0)
        if new.any():
            first = valid[:, new].argmax(axis=0)
            self.past.value[new] = speed_rad_s[first, np.flatnonzero(new)]
        speed = np.where(valid, speed_rad_s, 0.0)
        return np.where(valid, speed - self.past.update(speed, valid, period_s), 0.0)

    @property
    def memory_s(self) -> float:
        """How long speeds affect the measure."""
        return self.past.memory_s

    def reset(self, fans: Array) -> None:
        """Start again for some fans, (fans,) of bool."""
        self.past.reset(fans, np.nan)

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"past": self.past.value}
