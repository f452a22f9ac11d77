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
from fantwin.scoring.as_commanded.time_limits import Durations, lapse_limit_s, start_limit_s
from fantwin.scoring.diagnosis.standstill_causes import Fall, Standing
from fantwin.scoring.model.operation import Fans, Inputs
from fantwin.scoring.saved import Saved

STANDS, FALLS = 0.08, 0.85
"""shares of the expected speed: below, a fan stands; above, it has not begun to fall"""
CONSTANT = 0.02
"""relative difference below which two readings above FALLING show a fan that turns slowly, not one that falls"""
FALLING = 0.6
"""share of the expected speed: a fan below it may come to rest"""
LEAST_EXPECTED_RAD_S = 1.0
"""lowest expected speed of a fan that turns"""
STEADY = 0.1
"""share of a reading within which a fan stays that falls no more, for longer than a whole coast"""


class Falls(Saved):
    """Falls of speed: what distinguishes a rotor that is held from one that has no power.

    It follows the fans of one tray from bin to bin.
    """

    KEPT = (
        *("_share", "_lasted_s", "_rest_s", "_is_first", "_passed_s", "_has_stood", "stands", "is_falling"),
        *("_steady_share", "_steady_s", "_has_turned"),
    )

    def __init__(self, fans: Fans, bin_s: float) -> None:
        """Begin with fans that turn."""
        self._fans, self._bin_s = fans, bin_s
        count = len(fans.top_rad_s)
        self._share = np.zeros(count)
        """(fans,) newest reading, share of the expected speed"""
        self._passed_s = np.zeros(count)
        """(fans,) time since the newest reading"""
        self._steady_share, self._steady_s = np.zeros((2, count))
        """(fans,) share about which a fan stays, and for how long it has"""
        self._lasted_s = np.zeros(count)
        """(fans,) integral of the speed as a share of the expected one, since it fell"""
        self._rest_s = np.zeros(count)
        """(fans,) the same integral without the first reading of the fall"""
        self._is_first = np.zeros(count, np.bool_)
        """(fans,) true while the tacho still shows the first reading of the fall"""
        self._has_stood = np.zeros(count, np.bool_)
        """(fans,) true after a fan has stood since it fell: what it turns at rest is no part of the fall"""
        self._has_turned = np.zeros(count, np.bool_)
        """(fans,) true once a fan has been seen to turn: else it was not seen how it fell"""
        self.stands = np.zeros(count, np.bool_)
        self.is_falling = np.zeros(count, np.bool_)

    def take(self, now: Inputs) -> None:
        """Follow the readings of a bin."""
        known = now.is_new & np.isfinite(now.newest_rad_s)
        self._passed_s = self._passed_s + self._bin_s
        expected = now.speed_rad_s - np.where(now.is_balance, now.deviation_rad_s, 0.0)
        share = np.abs(now.newest_rad_s) / np.maximum(expected, LEAST_EXPECTED_RAD_S)
        turned_s = np.where(known & ~self._has_stood, share * self._passed_s, 0.0)
        self._is_first = (self._is_first & ~now.changes) | (known & (self._lasted_s == 0.0))
        is_constant = (share > FALLING) & (np.abs(share - self._share) < CONSTANT * share)
        moves = known & (np.abs(share - self._steady_share) > STEADY * self._steady_share)
        self._steady_share = np.where(moves, share, self._steady_share)
        self._steady_s = np.where(moves, 0.0, self._steady_s + np.where(known, self._passed_s, 0.0))
        coast_s = self._fans.coasts_s + self._fans.held_s
        is_constant |= (share >= STANDS) & (self._steady_s > coast_s)  # it turns slowly for longer than any fall lasts
        falls = ~known | ((share <= FALLS) & ~is_constant)
        self._share = np.where(known, share, self._share)
        self._rest_s = np.where(falls, self._rest_s + np.where(self._is_first, 0.0, turned_s), 0.0)
        self._lasted_s = np.where(falls, self._lasted_s + turned_s, 0.0)
        self._passed_s = np.where(known, 0.0, self._passed_s)
        is_off = expected < LEAST_EXPECTED_RAD_S
        turns = known & ~is_off & (share > FALLS)
        self._has_turned = (self._has_turned | turns) & ~(is_off & ~self._has_stood)  # its command ended that
        self._has_stood = falls & (self._has_stood | (known & (share < STANDS)))
        self.stands = np.where(known, share < STANDS, self.stands)
        self.is_falling = np.where(known, share < FALLING, self.is_falling)

    def rest(self, gap_s: float) -> None:
        """Let a gap of gap_s pass. A fall that may have begun within a long gap counts as not seen."""
        self._has_turned &= self._has_stood | (gap_s <= np.maximum(self._fans.held_s, 0.5 * self._fans.coasts_s))

    def of(self, fan: int) -> Fall | None:
        """The fall of a fan that falls or stands; None if it was not seen, or lies between two samples."""
        if not self._has_turned[fan] or self._bin_s > self._fans.coasts_s[fan] + self._fans.held_s[fan]:
            return None
        held_s = max(float(self._fans.held_s[fan]), self._bin_s)
        return Fall(float(self._lasted_s[fan]), float(self._rest_s[fan]), float(self._fans.coasts_s[fan]), held_s)


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
