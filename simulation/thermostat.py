"""Commands of a thermostat, as cooling controllers give them: temperature wanders, jumps, and fans stop and start.

Two neighbouring fans share a zone, whose load jumps between cold, where the fans stop, and hot. The temperature of each
fan follows its zone with a lag; below `STOP_C` the fan is switched off, above `START_C` on again, and between them it
keeps its state. The duty rises with the temperature from low to high, in steps of 1/255 as the registers of PWM
controllers have it, ten times a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

UPDATES_HZ = 10.0
STEPS = 255
ZONE_C = (26.5, 33.0, 38.0, 42.0, 47.0, 52.0, 58.0, 66.0)
"""settled temperatures of a zone; the first stops the fans"""
NEIGHBOUR_C = 1.5
"""the second fan of a zone is so much warmer"""
JUMP_AFTER_S = (15.0, 600.0)
"""a zone keeps its load so long, equally often at each order of magnitude"""
LAG_S = 5.0
NOISE_C = 0.2
"""standard deviation of the wandering of a temperature"""
STOP_C, START_C, FULL_C = 29.0, 31.0, 65.0


class Thermostat:
    """Commands of fans for a time, then again from the beginning."""

    def __init__(self, fans: int, seed: int, low: float, high: float, period_s: float = 3600.0) -> None:
        """Draw the commands. low, high: duty of a running fan, 0 to 1; a stopped one has 0."""
        samples = round(period_s * UPDATES_HZ)
        zones = np.random.default_rng(seed).spawn((fans + 1) // 2)
        self._steps = np.empty((samples, fans), np.uint8)  # a day of hundreds of fans
        for first, zone in zip(range(0, fans, 2), zones, strict=True):
            zone_c = _zone_c(zone, samples)
            for fan in range(first, min(first + 2, fans)):
                temperature_c = _lagged(zone, zone_c + NEIGHBOUR_C * (fan - first))
                share = np.clip((temperature_c - START_C) / (FULL_C - START_C), 0.0, 1.0)
                duty = np.where(_is_on(temperature_c), low + (high - low) * share, 0.0)
                self._steps[:, fan] = np.round(duty * STEPS)

    def command(self, t_s: float) -> Array:
        """(fans,) duty in force at t_s."""
        return self._steps[int(t_s * UPDATES_HZ + 1e-6) % len(self._steps)] / STEPS

    def side_by_side(self, starts_s: Sequence[float], seconds: float) -> Thermostat:
        """A thermostat of as many times the fans, which have the commands from each of these times on, for a time."""
        found = copy(self)
        numbers = np.arange(round(seconds * UPDATES_HZ))
        parts = [self._steps[(round(start_s * UPDATES_HZ) + numbers) % len(self._steps)] for start_s in starts_s]
        found._steps = np.concatenate(parts, axis=1)
        return found

    def is_on(self, times_s: Array, fan: int) -> NDArray[np.bool_]:
        """Whether a fan has a duty at times; same shape."""
        return self._steps[(times_s * UPDATES_HZ + 1e-6).astype(np.int64) % len(self._steps), fan] > 0


def _zone_c(rng: np.random.Generator, samples: int) -> Array:
    """(samples,) settled temperature of a zone: levels, each held for a while; warm at first."""
    shortest, longest = (hold_s * UPDATES_HZ for hold_s in JUMP_AFTER_S)
    holds = np.exp(rng.uniform(np.log(shortest), np.log(longest), size=int(samples / shortest) + 1))
    levels = rng.integers(len(ZONE_C) - 1, size=len(holds)).cumsum() + np.arange(
        1, len(holds) + 1
    )  # never the same twice
    return np.repeat(np.array(ZONE_C)[levels % len(ZONE_C)], np.round(holds).astype(np.int64))[:samples]


def _lagged(rng: np.random.Generator, settled_c: Array) -> Array:
    """(samples,) temperature that follows the settled one, and wanders."""
    from scipy.signal import lfilter  # noqa: PLC0415  slow to import, and the other profiles do without

    kept = np.exp(-1.0 / (UPDATES_HZ * LAG_S))
    noise_c = NOISE_C * np.sqrt(1.0 - kept * kept) * rng.normal(size=len(settled_c))
    filtered, _ = lfilter([1.0], [1.0, -kept], (1.0 - kept) * settled_c + noise_c, zi=[kept * settled_c[0]])
    return filtered


def _is_on(temperature_c: Array) -> NDArray[np.bool_]:
    """(samples,) whether the fan is switched on: at first it is, between the two limits it stays as it was."""
    decided = (temperature_c < STOP_C) | (temperature_c > START_C)
    latest = np.maximum.accumulate(np.where(decided, np.arange(len(decided)), -1))
    return np.where(latest >= 0, temperature_c[np.maximum(latest, 0)] > START_C, True)
