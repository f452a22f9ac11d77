"""Falls of speed: what distinguishes a rotor that is held from one that has no power."""

from __future__ import annotations

import numpy as np

from fantwin.scoring.diagnosis.standstill_causes import Fall
from fantwin.scoring.model.operation import Fans, Inputs
from fantwin.scoring.model.saved import Saved

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
    """Follows the fans of one tray from bin to bin."""

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
        """The fall of a fan that falls or stands; None if it was not seen."""
        if not self._has_turned[fan]:
            return None
        held_s = max(float(self._fans.held_s[fan]), self._bin_s)
        return Fall(float(self._lasted_s[fan]), float(self._rest_s[fan]), float(self._fans.coasts_s[fan]), held_s)
