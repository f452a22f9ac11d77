"""Missing readings: a loose wire against a healthy line, whose losses may come in bursts."""

from __future__ import annotations

import math

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.scoring.saved import Saved

SHARES = np.array([0.03, 0.07, 0.15, 0.35, 0.7, 0.95])
"""shares of missing readings of a loose wire, equally probable"""
PRIOR = np.array([300.0, 0.5, 4.0, 1.0])
"""readings after a reading, missing ones of them, readings after a missing one, and missing ones of them"""
NOTHING, LARGEST = -30.0, 60.0
"""limits of the log of the statistic"""
LEAST_RATIO, LARGEST_SHARE = 2.0, 0.9
"""least ratio of the losses of a loose wire to those of a healthy line, and the largest share that it loses"""
LONGEST_BURST = 5
"""number of missing readings in a row from which nothing is learned of a healthy line: the tacho may be dead"""
OVER_S = 10.0
"""time for which a healthy line must be more probable before an alarm clears"""


class MissingReadings(Saved):
    """Shiryaev-Roberts statistic of a loose wire against a healthy line, which loses one share of readings, and another
    share after a missing one.

    In an alarm the shares of a loose wire are weighed by all that it has lost since, so that a burst with which it
    began is not taken for its share.
    """

    KEPT = ("_counts", "_log_terms", "_returned", "_returns_s", "_run", "is_active")

    def __init__(self, fans: int, bin_s: float, log_limit: float) -> None:
        """Begin without a reading. log_limit: of the statistic."""
        self._bin_s, self._log_limit = bin_s, log_limit
        self._counts = PRIOR.copy()
        self._log_terms = np.full((fans, len(SHARES)), NOTHING)
        self._returned = np.zeros(fans)
        """(fans,) log odds of a healthy line, by the newest readings"""
        self._returns_s = np.zeros(fans)
        """(fans,) time for which it has been more probable"""
        self._run = np.zeros(fans)
        """(fans,) number of missing readings in a row"""
        self.is_active = np.zeros(fans, np.bool_)
        self.score = np.zeros(fans)
        """(fans,) log of the statistic over that of the limit; in an alarm until it clears"""

    def take(self, missing: Array) -> None:
        """Process the counts of a bin, (fans, 4), as in `Bin.missing`."""
        gain = missing @ self._log_ratios()
        readings, lost = missing[:, ::2].sum(axis=1), missing[:, 1::2].sum(axis=1)
        self._run = np.where(lost < readings, 0.0, self._run + lost)
        cleared = self._is_over(gain, readings > 0) if self.is_active.any() else np.zeros(len(missing), np.bool_)
        has_onset = (readings > 0) & ~self.is_active  # the statistic counts bins with readings, until an alarm
        begins = np.where(has_onset, 0.0, -np.inf)[:, np.newaxis]
        self._log_terms = np.minimum(np.logaddexp(self._log_terms, begins) + gain, LARGEST)
        log_statistic = _log_sum(self._log_terms) - math.log(len(SHARES))
        self.is_active = (self.is_active | (log_statistic > self._log_limit)) & ~cleared
        if cleared.any():
            self._log_terms[cleared], self._returned[cleared], self._returns_s[cleared] = NOTHING, 0.0, 0.0
        self._log_terms -= np.where(self.is_active, self._log_terms.max(axis=1), 0.0)[:, np.newaxis]
        back = (1.0 - self._returned / self._log_limit).clip(0.0)
        self.score = np.where(self.is_active, back, np.maximum(log_statistic / self._log_limit, 0.0))
        self._counts = self._counts + missing[~self.is_active & (self._run < LONGEST_BURST)].sum(axis=0)

    def forget(self, fans: Array) -> None:
        """Begin again for some fans, (fans,) of bool."""
        self._log_terms[fans], self.is_active[fans] = NOTHING, False
        self._returned[fans] = self._returns_s[fans] = self._run[fans] = 0.0

    @property
    def share(self) -> Array:
        """Most probable share of missing readings, (fans,)."""
        found: Array = self._shares()[self._log_terms.argmax(axis=1)]
        return found

    @property
    def explains_silence(self) -> Array:
        """Return where a loose wire causes such a silence more often than false alarms are declared, (fans,)."""
        share = self.share
        found: Array = self.is_active & (share < LARGEST_SHARE) & (-np.log(share) * self._run < self._log_limit)
        return found

    def _is_over(self, gain: Array, known: Array) -> Array:
        """Return where a line is healthy again, (fans,). known: (fans,) true where there should have been a reading."""
        back = self._returned - (_log_sum(self._log_terms + gain) - _log_sum(self._log_terms))
        self._returned = np.where(self.is_active, np.maximum(back, 0.0), 0.0)
        self._returns_s = np.where(self._returned > 0.0, self._returns_s + known * self._bin_s, 0.0)
        found: Array = self.is_active & (self._returned > self._log_limit) & (self._returns_s >= OVER_S)
        return found

    def _shares(self) -> Array:
        """Shares that a loose wire loses, (SHARES,), each well above that of a healthy line."""
        readings, lost, *_ = self._counts.tolist()
        return np.maximum(SHARES, min(LEAST_RATIO * lost / readings, LARGEST_SHARE))

    def _log_ratios(self) -> Array:
        """Log likelihood ratios of a loose wire against a healthy line, (4, SHARES), for each count of
        `Bin.missing`."""
        readings, lost, missing, lost_again = self._counts.tolist()
        healthy = np.array([[lost / readings], [lost_again / missing]])
        shares = self._shares()
        loses, arrives = np.log(shares / healthy), np.log((1.0 - shares) / (1.0 - healthy))
        return np.stack((arrives[0], loses[0] - arrives[0], arrives[1], loses[1] - arrives[1]))


def _log_sum(logs: Array) -> Array:
    """Logarithm of the sum of exp(logs) over the shares, (fans,). logs: (fans, SHARES)."""
    largest = logs.max(axis=1)
    found: Array = largest + np.log(np.exp(logs - largest[:, np.newaxis]).sum(axis=1))
    return found
