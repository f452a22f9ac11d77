"""Speed readings that cannot be true: tacho dropouts, double counts, glitches on the line.

The Hampel identifier (Pearson, Mining Imperfect Data, SIAM 2005, section 3.2): a sample is an outlier where it lies
further from the median of its neighbours than several of their median absolute deviations. A well-sampled transient has
wide deviations around it and passes; an outlier that is not detected counts only linearly in a fit
(twin.fitting.free_run_fit). Bursts of up to five samples are found.
"""

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from fantwin.twin.runs import Array, Run

NEIGHBOURS = 11
LOCAL_DEVIATIONS, TYPICAL_DEVIATIONS = 5.0, 6.0
MIN_SHARE_OF_RANGE = 0.02
QUANTISATION_STEPS = 2.5
NORMAL_DEVIATION = 1.4826
"""a standard deviation in median absolute deviations of a normal distribution"""


def without_outliers(run: Run) -> tuple[Run, Array]:
    """The run with its outliers missing (NaN), and their share of the measured speeds of each fan (fans,).

    Outliers are speed readings that cannot be true: tacho dropouts, double counts, glitches on the line. The Hampel
    identifier (Pearson, Mining Imperfect Data, SIAM 2005, section 3.2) finds bursts of up to five samples: a sample is
    an outlier where it lies further from the median of its neighbours than several of their median absolute deviations.
    A well-sampled transient has wide deviations around it and passes; an outlier that is not detected counts only
    linearly in a fit (twin.fitting.free_run_fit).
    """
    speed_rad_s, share = run.speed_rad_s.copy(), np.zeros(run.fans)
    for fan, column in enumerate(run.speed_rad_s.T):
        measured = np.flatnonzero(np.isfinite(column))
        if len(measured) < NEIGHBOURS:
            continue
        outliers = measured[_are_outliers(column[measured])]
        speed_rad_s[outliers, fan] = np.nan
        share[fan] = len(outliers) / len(measured)
    return (replace(run, speed_rad_s=speed_rad_s), share) if share.any() else (run, share)


def _are_outliers(speed_rad_s: Array) -> NDArray[np.bool_]:
    """(n,) which of successive measured speeds are outliers."""
    reach = NEIGHBOURS // 2
    windows = sliding_window_view(np.pad(speed_rad_s, reach, mode="reflect"), NEIGHBOURS)
    median = np.median(windows, axis=1)
    deviation = NORMAL_DEVIATION * np.median(np.abs(windows - median[:, np.newaxis]), axis=1)
    low, high = np.quantile(speed_rad_s, (0.05, 0.95))
    # A quantised speed often does not deviate at all: one quantisation step, or a small part of the range, is no
    # outlier.
    values = np.unique(speed_rad_s)
    step = float(np.median(np.diff(values))) if len(values) > 1 else 0.0
    least = max(
        TYPICAL_DEVIATIONS * float(np.median(deviation)),
        MIN_SHARE_OF_RANGE * float(high - low),
        QUANTISATION_STEPS * step,
    )
    return np.abs(speed_rad_s - median) > LOCAL_DEVIATIONS * deviation + least
