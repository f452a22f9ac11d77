"""The time axis of a report: recordings one after another, gaps open, long ones thinned without losing a peak."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fantwin.twin.runs import Array, Run

Indices = NDArray[np.int64]

WIDEST_GAP = 0.04
"""A gap is drawn no wider than this share of the measured time, so that a night without samples does not hide the
day."""
BETWEEN_RECORDINGS = 0.01


@dataclass(frozen=True)
class Gap:
    """Time without samples inside a recording: where it is drawn, and how long it truly was."""

    start_s: float
    stop_s: float
    lasted_s: float

    @property
    def shortened(self) -> bool:
        """Whether it is drawn narrower than it was."""
        return self.stop_s - self.start_s < 0.999 * self.lasted_s


@dataclass(frozen=True, eq=False)
class Timeline:
    """Drawn time of all samples of the pieces of some runs, one piece after the other.

    t_s: (n,) increasing. A single recording keeps its own seconds as far as no gap was shortened; several are drawn
    one after another from zero. starts: (pieces,) index of each piece's first sample. recordings: where each begins.
    """

    t_s: Array
    starts: Indices
    gaps: tuple[Gap, ...]
    recordings: tuple[tuple[float, str], ...]

    @property
    def keeps_the_clock(self) -> bool:
        """Whether drawn time is the recording's own."""
        return len(self.recordings) == 1 and not any(gap.shortened for gap in self.gaps)


def timeline(pieces: Sequence[Run]) -> Timeline:
    """Lay out pieces, as evaluation.evaluation_pieces gives them."""
    measured_s = sum(piece.duration_s for piece in pieces)
    first = pieces[0]
    several = any(_is_other_recording(before, after) for before, after in pairwise(pieces))
    now_s = 0.0 if several else float(first.t_s[0])
    times, gaps, recordings = [first.t_s - first.t_s[0] + now_s], [], [(now_s, first.name)]
    for before, after in pairwise(pieces):
        end_s = float(times[-1][-1])
        if _is_other_recording(before, after):
            now_s = end_s + BETWEEN_RECORDINGS * measured_s
            recordings.append((now_s, after.name))
        else:
            lasted_s = float(after.t_s[0] - before.t_s[-1])
            now_s = end_s + min(lasted_s, WIDEST_GAP * measured_s)
            gaps.append(Gap(end_s, now_s, lasted_s))
        times.append(after.t_s - after.t_s[0] + now_s)
    starts = np.cumsum([0, *(piece.samples for piece in pieces[:-1])])
    return Timeline(np.concatenate(times), starts, tuple(gaps), tuple(recordings))


def kept_samples(t_s: Array, series: Sequence[Array], columns: int) -> Indices:
    """Indices of the samples that a plot of so many columns needs: each series' smallest and largest in every column.

    t_s: (n,) increasing. series: each (n,), NaN where missing; a column in which a series is missing throughout keeps
    a missing sample, so that its line breaks there. Few samples are all kept.
    """
    if len(t_s) <= 4 * columns:
        return np.arange(len(t_s))
    edges = np.searchsorted(t_s, np.linspace(t_s[0], t_s[-1], columns + 1))
    edges[-1] = len(t_s)
    kept = {0, len(t_s) - 1}
    for low, high in pairwise(edges.tolist()):
        if low == high:
            continue
        for values in series:
            part = values[low:high]
            if np.isnan(part).all():
                kept.add(low)
            else:
                kept |= {low + int(np.nanargmin(part)), low + int(np.nanargmax(part))}
    return np.array(sorted(kept))


def broken_at(starts: Indices, kept: Indices, *series: Array) -> list[Array]:
    """The kept samples of each series, with a NaN before each piece: nothing is drawn across a gap."""
    breaks = np.searchsorted(kept, starts[1:])
    return [np.insert(values[kept], breaks, np.nan) for values in series]


def _is_other_recording(before: Run, after: Run) -> bool:
    return before.name != after.name or after.t_s[0] <= before.t_s[-1]
