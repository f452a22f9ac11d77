"""Wrong readings of a tacho: far from what is expected, and gone with the next.

Boards show twice, half or an impossible speed, or none, for a reading or two. A fan with a fault stays far, so a far
reading counts once others have agreed with it: as many as a healthy tacho does not show wrong, one after the other, in
the declared time. Two are surely two readings where they differ, or where the second is shown for longer than one would
be.
"""

from __future__ import annotations

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.scoring.model.operation import Fans
from fantwin.scoring.model.saved import Saved

FAR_SIGMAS = 4.5
"""a reading that is farther from what is expected is far"""
PRIOR = (0.5, 1000.0)
"""wrong readings, and readings, of a tacho of which nothing is known"""
FEWEST, ONE_MORE = 2, 2
"""readings that must agree at least; and samples more than they take where they are alike: a reading may be seen in one
sample more than its time, and the last one has to be seen"""


class WrongReadings(Saved):
    """Follows the far readings of the fans of one tray."""

    KEPT = ("_wrong", "_readings", "_side", "_long", "_different", "agree")

    def __init__(self, fans: Fans, bin_s: float, period_s: float, log_limit: float) -> None:
        """Begin without a reading. bin_s: within which samples of a reading that is not held count as one; period_s: of
        the samples; log_limit: of the declared time."""
        count = len(fans.top_rad_s)
        self._held = np.maximum(np.round(np.where(fans.held_s > 0.0, fans.held_s, bin_s) / period_s), 1.0)
        """(fans,) a reading is shown in so many samples"""
        self._holds = fans.held_s > 0.0
        """(fans,) whether a tacho holds its readings, so that they tell one from another"""
        self._log_limit = log_limit
        self._wrong, self._readings = np.zeros((2, count))
        self.begin_again(np.ones(count, np.bool_))
        self._side = np.zeros(count)
        """(fans,) on which side the newest reading is far; 0: it is not"""
        self._long = np.zeros(count)
        """(fans,) how many samples ago the first far one on this side was, itself included"""
        self._different = np.zeros(count)
        """(fans,) number of different readings since then, the first one included"""
        self.agree = np.zeros(count, np.bool_)
        """(fans,) whether the newest reading is far, and enough before it were"""

    @property
    def waits(self) -> Array:
        """(fans,) whether the newest reading was far."""
        return self._side != 0.0

    def counts(self, distance_rad_s: Array, std_rad_s: Array, another: Array, *, learns: Array) -> Array:
        """(n, fans) whether each sample of a bin counts.

        distance_rad_s: (n, fans) from what is expected, NaN without a reading; std_rad_s: (fans,) of that;
        another: (n, fans) whether a reading is another than the one before; learns: (fans,) whether what is far is the
        tacho's, if it is gone soon.
        """
        known = np.isfinite(distance_rad_s)
        with np.errstate(invalid="ignore"):
            far = np.abs(distance_rad_s) > FAR_SIGMAS * std_rad_s
        self._readings += learns * known.sum(axis=0) / self._held
        if not far.any() and not self._side.any():
            self.agree = np.zeros_like(self.agree)
            return known
        side, agree_at = np.where(far, np.sign(distance_rad_s), 0.0), self._agree_at()
        began, waits = np.zeros(known.shape[1], np.int64), np.zeros(known.shape, np.bool_)
        for row in range(len(known)):
            ends = known[row] & (side[row] != self._side)
            was_wrong = ends & learns & (self._side != 0.0) & ~self._are_enough(agree_at)
            self._wrong += was_wrong * np.ceil(self._long / self._held)
            self._side, began[ends] = np.where(ends, side[row], self._side), row
            self._long = np.where(ends, 1.0, self._long + 1.0)
            self._different = np.where(ends, 1.0, self._different + (known[row] & self._holds & another[row]))
            waits[row] = far[row]
            agree = far[row] & self._are_enough(agree_at)
            if agree.any():
                waits &= ~agree | (np.arange(len(known))[:, np.newaxis] < began)
        self.agree = (self._side != 0.0) & self._are_enough(agree_at)
        return known & ~waits

    def begin_again(self, fans: Array) -> None:
        """Forget what the tachos of some fans have shown wrong, (fans,) of bool."""
        self._wrong[fans], self._readings[fans] = PRIOR

    def forget(self) -> None:
        """Nothing agrees with what was read before a gap."""
        self._side[:] = 0.0

    def _are_enough(self, agree_at: Array) -> Array:
        """(fans,) whether at least agree_at readings in a row are far."""
        samples = (agree_at - 1.0) * self._held + ONE_MORE
        found: Array = (self._long >= samples) | (self._different >= agree_at)
        return found

    def _agree_at(self) -> Array:
        """(fans,) number of readings in a row that must be far before they count."""
        share = self._wrong / self._readings
        agree = np.ceil((self._log_limit + np.log(2.0)) / (np.log(2.0) - np.log(share)))
        found: Array = np.maximum(agree, FEWEST)
        return found
