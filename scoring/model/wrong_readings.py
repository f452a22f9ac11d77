"""Wrong readings of a tacho: far from what is expected, and gone with the next.

Boards show twice or half the speed, an impossible speed or 0 rpm, for one reading or a few. A fan with a fault stays
far. So a far reading counts only once more readings in a row agree with it than a healthy tacho shows wrong within the
declared time between false alarms. A run of wrong readings is a *spell*. Its length depends on the board, so it is
learned from all fans of a tray. Two samples are two readings if they differ, or if they last longer than one reading
would.
"""

from __future__ import annotations

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.scoring.model.operation import Fans
from fantwin.scoring.saved import Saved

FAR_SIGMAS = 4.5
"""distance from the expected reading, in standard deviations, beyond which a reading is far"""
PRIOR = (0.5, 1000.0)
"""spells and readings, as if counted before the first reading of a tacho"""
PRIOR_LONGER = 10.0
"""spells, as if counted for the tray, that went on as often as by chance"""
LONGEST = 4
"""wrong readings, one after the other; more are no tacho's"""
MANY, LATELY, SAID_FROM = 0.02, 2000.0, 500.0
"""share of wrong readings with which a tacho is not sound; number of newest readings that count; and at least"""
FEWEST, ONE_MORE = 2, 2
"""least number of readings that must agree; and samples that equal readings must last beyond their time, because one
may show in one sample more, and the last must be seen"""


class WrongReadings(Saved):
    """Follows the far readings of the fans of one tray."""

    KEPT = ("_times", "_readings", "_lasted", "_side", "_long", "_different", "_std", "agree", "_lately")

    def __init__(self, fans: Fans, bin_s: float, period_s: float, log_limit: float) -> None:
        """Begin without a reading. bin_s: within which samples of a reading that is not held count as one; period_s: of
        the samples; log_limit: of the declared time."""
        count = len(fans.top_rad_s)
        self._held = np.maximum(np.round(np.where(fans.held_s > 0.0, fans.held_s, bin_s) / period_s), 1.0)
        """(fans,) number of samples that show one reading"""
        self._holds = fans.held_s > 0.0
        """(fans,) true where a tacho holds its readings, so that a different sample is another reading"""
        self._log_limit = log_limit
        self._times, self._readings, self._std = np.zeros((3, count))
        """(fans,) number of spells; number of readings; standard deviation of the reading expected of a healthy fan,
        rad/s, during an alarm that of before it, since the fault is not known yet"""
        self._lately = np.zeros((2, count))
        """(2, fans) number of wrong readings, and of readings, lately"""
        self.begin_again(np.ones(count, np.bool_))
        self._lasted = np.zeros(LONGEST)
        """number of spells of the tray that lasted at least 1, 2, ... readings"""
        self._side, self._long, self._different = np.zeros((3, 2, count))
        """(2, fans), from the expected reading and from that of a healthy fan: side on which the newest reading is
        far, 0 if it is not; samples with a reading since the first far one on that side, itself included; different
        readings since then, the first one included"""
        self.agree = np.zeros(count, np.bool_)
        """(fans,) true where the newest reading is far, and enough before it were"""

    @property
    def many(self) -> Array:
        """Return the share of wrong readings of a tacho that is not sound, (fans,); of others 0."""
        wrong, readings = self._lately
        is_many = (readings > SAID_FROM) & (wrong > MANY * readings)
        return np.divide(wrong, readings, out=np.zeros(len(wrong)), where=is_many)

    @property
    def waits(self) -> Array:
        """Return where the newest reading was far, (fans,)."""
        return self._side[0] != 0.0

    @property
    def may_be(self) -> Array:
        """Return where the newest reading is far, and too few before it were, (fans,)."""
        return self.waits & ~self.agree

    def counts(self, distances_rad_s: Array, std_rad_s: Array, another: Array, raised: Array) -> Array:
        """Find the samples of a bin that count, (n, fans).

        distances_rad_s: (2, n, fans) from the expected reading, and from that of a healthy fan, NaN without a reading;
        std_rad_s: (fans,) of the expected reading; another: (n, fans) true where a reading is another than the one
        before; raised: (fans,) samples since an alarm was raised, -1 without an alarm.
        """
        known = np.isfinite(distances_rad_s[0])
        self._std = np.where(raised < 0, std_rad_s, self._std)
        with np.errstate(invalid="ignore"):
            far = np.abs(distances_rad_s) > FAR_SIGMAS * np.stack((std_rad_s, self._std))[:, np.newaxis]
        readings = known.sum(axis=0) / self._held
        self._readings += readings
        self._lately *= np.exp(-readings / LATELY)
        self._lately[1] += readings
        if not far.any() and not self._side.any():
            self.agree = np.zeros_like(self.agree)
            return known
        sides, agree_at = np.where(far, np.sign(distances_rad_s), 0.0), self._agree_at()
        began, waits = np.zeros(known.shape[1], np.int64), np.zeros(known.shape, np.bool_)
        for row in range(len(known)):
            ends = known[row] & (sides[:, row] != self._side)
            is_first = np.where(raised < 0, ~self._are_enough(agree_at), self._long[1] > raised + row)
            self._learn(ends[1] & (self._side[1] != 0.0) & is_first)
            self._side, began[ends[0]] = np.where(ends, sides[:, row], self._side), row
            self._long = np.where(ends, 1.0, self._long + known[row])
            self._different = np.where(ends, 1.0, self._different + (known[row] & self._holds & another[row]))
            waits[row] = far[0, row]
            agree = far[0, row] & self._are_enough(agree_at)
            if agree.any():
                waits &= ~agree | (np.arange(len(known))[:, np.newaxis] < began)
        self.agree = self.waits & self._are_enough(agree_at)
        return known & ~waits

    def begin_again(self, fans: Array) -> None:
        """Forget the wrong readings of some fans, (fans,) of bool."""
        self._times[fans], self._readings[fans] = PRIOR
        self._lately[:, fans] = 0.0

    def forget(self) -> None:
        """Forget far readings from before a gap."""
        self._side[:] = 0.0

    def _are_enough(self, agree_at: Array) -> Array:
        """Return where at least agree_at readings in a row are far, (fans,)."""
        samples = (agree_at - 1.0) * self._held + ONE_MORE
        return (self._long[0] >= samples) | (self._different[0] >= agree_at)

    def _learn(self, ends: Array) -> None:
        """Count far readings that end as a spell: too few agreed, or an alarm began with them. ends: (fans,)."""
        readings = np.ceil(self._long[1] / self._held)
        was_wrong = ends & (readings <= LONGEST)
        self._times += was_wrong
        self._lately[0] += np.where(was_wrong, readings, 0.0)
        self._lasted += (readings[was_wrong] > np.arange(LONGEST)[:, np.newaxis]).sum(axis=1)

    def _agree_at(self) -> Array:
        """Number of readings in a row that must be far before they count, (fans,)."""
        share = self._times / self._readings
        times = self._lasted[:, np.newaxis] + PRIOR_LONGER * 0.5 * share  # on the same side
        goes_on = times[1:] / (self._lasted[:-1, np.newaxis] + PRIOR_LONGER)
        log_in_a_row = np.log(np.vstack((share, goes_on))).cumsum(axis=0)
        return np.maximum((log_in_a_row > -self._log_limit).sum(axis=0) + 1.0, FEWEST)
