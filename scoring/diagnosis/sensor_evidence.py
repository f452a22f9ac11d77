"""Evidence of a broken sensor from the readings alone, as log likelihood ratios against a working sensor.

Stuck: from some sample on, each reading repeats the last exactly, up to now. A working sensor does so with the
probability seen before (integrated out, as it is uncertain after a short time). Readings of zero count only if the
sensor fell to zero within one sample: a rotor at standstill reads zero, too. The likelihood accounts for the free
choice of the sample at which it stuck. A tacho that shows a reading for a while repeats it, and so does one that
counts pulses of a fan that runs evenly: of such a tacho whole readings count, and only those for which a healthy fan
would read something else.

Dropout: more readings are missing than before. All shares larger than the one before have the same prior probability
(a binomial with its share integrated out).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincc, betaln, xlog1py, xlogy

from schemas.tacho import Tacho
from scoring.detectors.tacho import moved
from scoring.diagnosis.regression_window import Array

MIN_REPEATS = 10
MIN_EARLIER = 20
MAX_HEALTHY_MISSING = 0.05
"""share of readings that a working sensor may miss, if it missed as many before"""
MIN_FALL = 10.0
"""smallest speed from which a sensor falls to zero at once, in changes from reading to reading"""


def stuck_log_ratio(speed_rad_s: Array, onset: int) -> tuple[float, int]:
    """Log ratio for a stuck sensor, and the number of repeated readings; zeros where nothing repeats. speed: (n,)."""
    repeats = np.diff(speed_rad_s) == 0.0
    changed = np.flatnonzero(~repeats)
    last_change = int(changed[-1]) + 1 if changed.size else 0
    run = len(speed_rad_s) - 1 - last_change
    if run < MIN_REPEATS:
        return 0.0, 0
    if speed_rad_s[last_change] == 0.0 and not _fell(speed_rad_s[:last_change]):
        return 0.0, 0
    # Repeats within the run itself are used only if there are too few readings before it.
    end = min(onset, last_change) - 1
    earlier = repeats[: end if end >= MIN_EARLIER else max(onset - 1, 0)]
    seen = int(np.count_nonzero(earlier)) + 1.0
    unseen = len(earlier) - seen + 2.0
    log_by_chance = betaln(seen + run, unseen) - betaln(seen, unseen)
    return float(-log_by_chance - np.log(len(repeats))), run


def stuck_log_ratio_of_readings(
    speed_rad_s: Array, expected_rad_s: Array, onset: int, tacho: Tacho, period_s: float
) -> tuple[float, int]:
    """As `stuck_log_ratio` for a tacho that shows each reading for a while. expected_rad_s: (n,) what it would read."""
    changed = np.flatnonzero(np.diff(speed_rad_s) != 0.0)
    last_change = int(changed[-1]) + 1 if changed.size else 0
    run = len(speed_rad_s) - 1 - last_change
    samples = max(1, round(tacho.held_s / period_s))
    telling = np.count_nonzero(moved(expected_rad_s[last_change:], expected_rad_s[last_change], tacho.resolution_rad_s))
    readings = telling // samples
    if run < MIN_REPEATS or not readings or speed_rad_s[last_change] == 0.0:
        return 0.0, 0
    end = min(onset, last_change)
    earlier = np.diff(speed_rad_s[: end if end >= MIN_EARLIER * samples else onset : samples]) == 0.0
    seen = int(np.count_nonzero(earlier)) + 1.0
    unseen = len(earlier) - seen + 2.0
    log_by_chance = betaln(seen + readings, unseen) - betaln(seen, unseen)
    return float(-log_by_chance - np.log(max(len(speed_rad_s) / samples, 1.0))), run


def _fell(before_rad_s: Array) -> bool:
    """Whether readings were far from zero the moment before they were zero. (n,)"""
    last = before_rad_s[-5:]
    return last.size > 1 and bool(last.min() > MIN_FALL * np.abs(np.diff(last)).max())


def dropout_log_ratio(missing: NDArray[np.bool_], onset: int) -> tuple[float, float]:
    """Log ratio for a sensor that drops out, and the share of readings missing since the onset. missing: (n,)."""
    before, after = missing[:onset], missing[onset:]
    n, m = len(after), int(np.count_nonzero(after))
    if m == 0:
        return 0.0, 0.0
    expected = min((np.count_nonzero(before) + 0.5) / (len(before) + 1.0), MAX_HEALTHY_MISSING)
    # The integral of p^m (1-p)^(n-m) over the shares above the expected one.
    log_more = betaln(m + 1.0, n - m + 1.0) + np.log(max(betaincc(m + 1.0, n - m + 1.0, expected), 1e-300))
    log_expected = xlogy(m, expected) + xlog1py(n - m, -expected)
    return float(log_more - np.log1p(-expected) - log_expected), m / n
