"""The commands of a campaign: every column turns its own knob, holds it for a while, and turns again.

A held level, a hand at the knob, random stairs and a random binary sequence are the same process: they differ
in the times of holding and turning, and in the number of levels. Values are drawn as time advances, so that a run may
have any length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fantwin.schemas.messages import Array


@dataclass(frozen=True)
class Knob:
    """How a column is commanded. low, high: duty, or rad/s for the set-point of a speed loop, where `is_looped`.

    levels: 0 for any between low and high.
    """

    low: float
    high: float
    hold_s: tuple[float, float]
    turn_s: tuple[float, float] = (0.5, 3.0)
    levels: int = 0
    is_looped: bool = False


HELD = Knob(0.1, 0.95, (60.0, 600.0))
BY_HAND = Knob(0.1, 0.95, (1.0, 6.0))
STAIRS = Knob(0.1, 0.95, (2.0, 6.0), (0.0, 0.0), levels=9)
BINARY = Knob(0.3, 0.7, (0.5, 2.0), (0.0, 0.0), levels=2)
LOOPED = Knob(200.0, 700.0, (10.0, 120.0), is_looped=True)
EVERYDAY = (HELD, BY_HAND, LOOPED, HELD, STAIRS, LOOPED, BY_HAND, HELD, BINARY, LOOPED)
"""of ten fans in use"""


class Knobs:
    """The knobs of all columns, each turned by its own chance."""

    def __init__(self, knobs: list[Knob], seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self.is_looped = np.array([knob.is_looped for knob in knobs])
        self._low = np.array([knob.low for knob in knobs])
        self._width = np.array([knob.high - knob.low for knob in knobs])
        self._steps = np.array([max(knob.levels - 1, 0) for knob in knobs])
        self._hold_s = np.array([knob.hold_s for knob in knobs]).T
        self._turn_s = np.array([knob.turn_s for knob in knobs]).T
        everybody = np.ones(len(knobs), np.bool_)
        self._to = self._drawn_level(everybody)
        self._reached_s = np.zeros(len(knobs))
        self._until_s = np.zeros(len(knobs))
        self._slope = np.zeros(len(knobs))
        self._turn(everybody, 0.0)

    @property
    def centre(self) -> Array:
        """(c,) the middle of each column's levels; the level itself where it never changes."""
        return self._low + self._width / 2.0

    def at(self, t_s: float) -> Array:
        """(c,) commands at a time; times must rise."""
        over = self._until_s <= t_s
        if over.any():
            self._turn(over, t_s)
        return self._to + self._slope * np.minimum(t_s - self._reached_s, 0.0)

    def _turn(self, which: Array, t_s: float) -> None:
        """Some knobs begin to turn now, to another level that is then held."""
        at, count = self._to[which], int(which.sum())
        turn_s = self._rng.uniform(*self._turn_s[:, which], size=count)
        self._to = self._to.copy()
        self._to[which] = self._drawn_level(which)
        self._reached_s[which] = t_s + turn_s
        self._slope[which] = np.divide(self._to[which] - at, turn_s, out=np.zeros(count), where=turn_s > 0.0)
        self._until_s[which] = t_s + turn_s + self._rng.uniform(*self._hold_s[:, which], size=count)

    def _drawn_level(self, which: Array) -> Array:
        share = self._rng.random(int(which.sum()))
        steps = self._steps[which]
        stepped = np.floor(share * (steps + 1)) / np.maximum(steps, 1)
        return self._low[which] + self._width[which] * np.where(steps > 0, stepped, share)
