"""Fewer readings of many fans, for what does not need all of them.

A network of a few dozen weights is as well determined by the readings of a few fans as by those of many. So the runs of
many fans are cut into windows, and of each window only the readings of every so-many-th fan are kept, of the next one
in the next window. Whatever happens in a run is still seen at some fans, and every fan is seen in some windows. (Fans
of a tray are often commanded alike: with whole runs of some fans, or the same moments of all, a start or a level might
be missing.)

What is known of a single fan cannot come from its few windows. Where a share of a time constant is enough between two
samples, all of its readings are averaged over such shares instead (`coarser`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fantwin.twin.fitting.trajectories import stretch_samples
from fantwin.twin.runs import Array, Run

ENOUGH_READINGS = 64_000
"""of all fans together: eight fans at 100 Hz for 80 s"""
LEAST_FANS = 5
"""that a window shows; so the runs of fewer than ten fans are used as they are"""
TIME_CONSTANTS = 15.0
"""of a window"""
COARSE_TIME_CONSTANTS = 0.25
"""between two samples of `coarser`, at most"""


def thinning_factor(pieces: Sequence[Run], time_constant_s: float) -> int:
    """A window shows one fan of so many; 1 where the fans are few, or their readings.

    pieces: of runs, without gaps. time_constant_s: of the slowest fan.
    """
    readings = sum(int(np.count_nonzero(np.isfinite(piece.speed_rad_s))) for piece in pieces)
    windows = sum(piece.samples for piece in pieces) // _window_samples(pieces, time_constant_s)
    return max(1, min(readings // ENOUGH_READINGS, pieces[0].fans // LEAST_FANS, windows))


def windows_of(pieces: Sequence[Run], time_constant_s: float) -> list[Run]:
    """Windows of pieces of runs, or the pieces themselves where the factor is 1. Arguments as of thinning_factor.

    The readings that a window does not show are NaN.
    """
    every = thinning_factor(pieces, time_constant_s)
    if every == 1:
        return list(pieces)
    length = _window_samples(pieces, time_constant_s)
    cut = [piece.rows(first, last) for piece in pieces for first, last in piece.equal_parts(length)]
    fans = np.arange(pieces[0].fans)
    return [
        replace(window, speed_rad_s=np.where(fans % every == number % every, window.speed_rad_s, np.nan))
        for number, window in enumerate(cut)
    ]


def _window_samples(pieces: Sequence[Run], time_constant_s: float) -> int:
    return stretch_samples(time_constant_s, min(piece.median_period_s for piece in pieces), TIME_CONSTANTS)


def coarser(piece: Run, time_constant_s: float) -> Run:
    """The piece with a sample for each share of a time constant, or as it is where its samples are that far apart.

    A sample is the mean of the readings of its share, at the time of the middle one, and the mean of the commands from
    there to the next.
    """
    every = int(COARSE_TIME_CONSTANTS * time_constant_s / piece.median_period_s)
    every -= 1 - every % 2
    count = piece.samples // every - 1 if every > 1 else 0
    if count < 2:
        return piece
    middle = every // 2
    speed = piece.speed_rad_s[: count * every].reshape(count, every, -1)
    measured = np.isfinite(speed)
    readings = measured.sum(axis=1)
    total: Array = np.sum(speed, axis=1, where=measured)
    mean = np.divide(total, readings, out=np.full_like(total, np.nan), where=readings > 0)
    command = piece.command[middle : middle + count * every].reshape(count, every, -1).mean(axis=1)
    return replace(piece, t_s=piece.t_s[middle : count * every : every], command=command, speed_rad_s=mean)
