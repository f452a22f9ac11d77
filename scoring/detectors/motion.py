"""How fast a fan is changing its speed: distance of the speed from its low-pass over one second.

A twin that is accurate at constant speed is less accurate while the speed changes, so healthy residuals vary more
there. Limits widen with this measure (an adaptive threshold by the size of the input: Emami-Naeini, Akhter and Rock,
IEEE Transactions on Automatic Control 33 (1988) 1106). A fan that a fault slows down must not widen its own limits, so
they widen with the motion of the readings only as far as a healthy fan may move: as its command and its twin have.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.messages import Array
from scoring.column_state import ColumnState
from scoring.detectors.low_pass import LowPass

TIME_CONSTANT_S = 1.0
RECENT_S = 5.0
"""so long after its command a healthy fan may still move"""


class Motion(ColumnState):
    """The measure of a tray's fans."""

    def __init__(self, fans: int, time_constant_s: float = TIME_CONSTANT_S) -> None:
        self.past = LowPass(fans, time_constant_s, np.nan)
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


class HealthyMotion:
    """How far healthy fans may move: as far as their commands or their twins have within about `RECENT_S`.

    The command leads a fan that is faster than its twin, the twin one that still turns without a command. Where
    the command has changed by a share of itself, the speed may have changed by the same share: that of the twin, or the
    reading of a fan that starts faster than its twin.
    """

    def __init__(self, fans: int) -> None:
        self._command, self._predicted = Motion(fans, RECENT_S), Motion(fans, RECENT_S)

    def update(self, command: Array, predicted_rad_s: Array, speed_rad_s: Array, period_s: float) -> Array:
        """(n, fans) rad/s, infinite where nothing is predicted. All (n, fans)."""
        of_command, largest_command = _moved(self._command, command, period_s)
        of_twin, fastest_rad_s = _moved(self._predicted, predicted_rad_s, period_s)
        share = np.divide(of_command, largest_command, out=np.zeros_like(of_command), where=largest_command > 0.0)
        moved = np.maximum(of_twin, share * np.fmax(fastest_rad_s, np.abs(speed_rad_s)))
        return np.where(np.isfinite(predicted_rad_s), moved, np.inf)

    @property
    def states(self) -> tuple[ColumnState, ...]:
        """All that is kept."""
        return self._command, self._predicted

    @property
    def memory_s(self) -> float:
        """How long commands and speeds affect the measure."""
        return self._predicted.memory_s

    def reset(self, fans: Array) -> None:
        """Start again for some fans, (fans,) of bool."""
        self._command.reset(fans)
        self._predicted.reset(fans)

    def snapshot(self) -> dict[str, Any]:
        """The state as JSON can hold it."""
        return {"command": self._command.snapshot(), "predicted": self._predicted.snapshot()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a snapshot. Raises as ColumnState.restore does."""
        self._command.restore(state["command"])
        self._predicted.restore(state["predicted"])


def _moved(motion: Motion, values: Array, period_s: float) -> tuple[Array, Array]:
    """How far values, (n, fans), are from their past, and the larger size of both."""
    moved = motion.update(values, period_s)
    return np.abs(moved), np.maximum(np.abs(values), np.abs(values - moved))
