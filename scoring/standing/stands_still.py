"""A fan that stands although its command turns it.

It needs no prediction: what commands do to healthy fans, and how long starts and coasts take, is in the twin's card
(schemas.standstill). While a fan starts it may read as standing for three times the longest healthy start. Once it has
turned, only lapses of its tacho explain a reading of a fan that stands. A tacho may give no reading for its reach plus
`MISSING_S`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.diagnosis.standstill_causes import Standing
from fantwin.scoring.model.saved import Saved
from fantwin.scoring.standing.durations import Durations
from fantwin.scoring.standing.time_limits import lapse_limit_s, start_limit_s

MISSING_S = 2.0  # beyond the reach of the tacho
UNKNOWN_STARTED_S = 5.0  # beyond the reach: the length of a start, if none was seen
KINDS = (Standing.NO_READING, Standing.CAME_TO_REST, Standing.NOT_STARTED)


class StandsStill(Saved):
    """Time for which each fan has stood or given no reading against its command."""

    KEPT = ("_lasted_ns",)

    def __init__(self, healthy: Standstill, tachos: Sequence[Tacho]) -> None:
        """Begin without knowledge of the fans. tachos: of each fan."""
        self._healthy = healthy
        reach_s = np.array([tacho.reach_s for tacho in tachos])
        started_s = UNKNOWN_STARTED_S + reach_s if healthy.start_s is None else healthy.start_s + 0.0 * reach_s
        self._started_ns = started_s * NS_PER_S
        self._lapse_limit_s = lapse_limit_s(healthy)
        self._held_s = np.array([tacho.held_s for tacho in tachos])
        self._start_limit_s = start_limit_s(healthy, reach_s)
        self.memory_s = float(np.max(self._start_limit_s))
        """longest gap after which it is known how the fan was started"""
        self._missing_limit_s: Array = reach_s + MISSING_S
        self._lasted_ns = np.zeros((4, len(tachos)), np.int64)
        """(4, fans) time for which each has been driven, turned, stood, and given no reading"""

    def update(self, command: Array, speed_rad_s: Array, counts: Durations) -> tuple[Array, Array, Array]:
        """Return the time in multiples of a healthy one; where a fan turns as it should; and the number of the kind in
        KINDS. All (n, fans), also command and speed_rad_s."""
        healthy = self._healthy
        drives, known, turns = healthy.drives(command), np.isfinite(speed_rad_s), healthy.turns(speed_rad_s)
        driven = counts.of(drives, ~drives, self._lasted_ns[0])
        turned, stood, silent = counts.of(
            np.array((drives & turns & (driven >= self._started_ns), drives & known & ~turns, drives & ~known)),
            np.array((~drives, ~drives | turns, ~drives | known)),
            self._lasted_ns[1:],
        )
        has_turned = turned > 0
        two_readings_s = np.maximum(self._lapse_limit_s, self._held_s + counts.period_ns / NS_PER_S)  # one may be wrong
        of_stood = stood / np.where(has_turned, two_readings_s, self._start_limit_s) / NS_PER_S
        of_silent = silent / self._missing_limit_s / NS_PER_S
        kind = np.where(of_silent > of_stood, 0, np.where(has_turned, 1, 2))
        return np.maximum(of_stood, of_silent), drives & turns, kind

    def forget(self, fans: Array) -> None:
        """Begin again for some fans, (fans,) of bool."""
        self._lasted_ns[:, fans] = 0
