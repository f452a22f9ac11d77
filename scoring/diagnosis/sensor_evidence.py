"""What the readings alone say of the sensor, as log likelihood ratios against a sensor that works.

Stuck: from some sample on, each reading repeats the last exactly, up to now. A working sensor does so with the
probability seen before that (integrated out: seen for a little while is not known). Readings of zero count only if the
sensor fell to zero in one sample: a rotor that stands reads zero, too. That it may have stuck at any sample is paid
for, as each choice is.

Dropout: more readings are missing than before. Against the share missing before, all larger shares are equally
probable beforehand (a binomial with its share integrated out).
"""

from __future__ import annotations

import numpy as np
from scipy.special import betaincc, betaln, xlog1py, xlogy

from scoring.diagnosis.regression_window import Array

FEWEST_REPEATS = 10
FEWEST_EARLIER = 20
MOST_MISSING = 0.05
"""share of readings that a sensor in order may miss, if it missed as many before"""
FAR = 10.0
"""in steps from reading to reading"""


def stuck_log_ratio(speed_rad_s: Array, onset: int) -> tuple[float, int]:
    """For a stuck sensor, and how many readings repeat the one before; zeros where nothing repeats. speed: (n,)."""
    repeats = np.diff(speed_rad_s) == 0.0
    changed = np.flatnonzero(~repeats)
    last_change = int(changed[-1]) + 1 if changed.size else 0
    run = len(speed_rad_s) - 1 - last_change
    if run < FEWEST_REPEATS:
        return 0.0, 0
    if speed_rad_s[last_change] == 0.0 and not _fell(speed_rad_s[:last_change]):
        return 0.0, 0
    # Repeats of the run itself say nothing of a working sensor, unless there is nothing else to go by.
    end = min(onset, last_change) - 1
    earlier = repeats[: end if end >= FEWEST_EARLIER else max(onset - 1, 0)]
    seen = int(np.count_nonzero(earlier)) + 1.0
    unseen = len(earlier) - seen + 2.0
    log_by_chance = betaln(seen + run, unseen) - betaln(seen, unseen)
    return float(-log_by_chance - np.log(len(repeats))), run


def _fell(before_rad_s: Array) -> bool:
    """Whether readings were far from zero the moment before they were zero. (n,)"""
    last = before_rad_s[-5:]
    return last.size > 1 and bool(last.min() > FAR * np.abs(np.diff(last)).max())


def dropout_log_ratio(speed_rad_s: Array, onset: int) -> tuple[float, float]:
    """For a sensor that drops out, and the share of readings missing since the onset. speed: (n,)."""
    missing = ~np.isfinite(speed_rad_s)
    before, after = missing[:onset], missing[onset:]
    n, m = len(after), int(np.count_nonzero(after))
    if m == 0:
        return 0.0, 0.0
    usual = min((np.count_nonzero(before) + 0.5) / (len(before) + 1.0), MOST_MISSING)
    # The integral of p^m (1-p)^(n-m) over the shares above the usual one.
    log_more = betaln(m + 1.0, n - m + 1.0) + np.log(max(betaincc(m + 1.0, n - m + 1.0, usual), 1e-300))
    log_usual = xlogy(m, usual) + xlog1py(n - m, -usual)
    return float(log_more - np.log1p(-usual) - log_usual), m / n
