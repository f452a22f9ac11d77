"""One pass over healthy runs, judged as live fans are: what calibration needs to know of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from schemas.messages import Array, Statistic
from scoring.baseline.fan_offsets import Cells
from scoring.calibration.windows import Windows, peaks
from scoring.fan_scorer import FanScorer, Samples
from scoring.limits import Limits

SPEED_BINS = 24
MOTION_BINS = 12  # each twice the one before; the last begins at the top speed
LARGEST_SQUARE, PARTS_OF_OCTAVE, OCTAVE_PARTS = 1e4, 8, 320
MEDIAN_OF_SQUARE = 0.4549  # of a normal variable of variance one
WILD = 100.0  # sigma; a larger residual counts as this
RESIDUALS = ("speed", "balance")
FIRST = (Statistic.SPEED_SMOOTHED - 1, Statistic.BALANCE_SMOOTHED - 1)
"""the first of the three statistics of each residual"""


class Running(NamedTuple):
    """A healthy run. known_as: which fans of the twin these are; None where it does not know one from another."""

    fans: int
    blocks: Iterable[Samples]
    known_as: range | None = None


Runs = Callable[[], Iterable[Running]]
"""At each call the healthy runs from the beginning."""


@dataclass
class Moments:
    """Of one residual over bins of speed: counts, sums, sums of squares; and of means over a second."""

    count: Array = field(default_factory=lambda: np.zeros(SPEED_BINS))
    total: Array = field(default_factory=lambda: np.zeros(SPEED_BINS))
    cells: list[Cells] = field(default_factory=list)
    """of each run of fans that the twin knows"""
    square: Array = field(default_factory=lambda: np.zeros(SPEED_BINS))
    means: int = 0
    mean_square: float = 0.0
    baselines: list[Array] = field(default_factory=list)
    growth: float = 0.0
    """sum of the spread, in its limit"""
    moved: Array = field(default_factory=lambda: np.zeros((3, MOTION_BINS)))
    """over bins of motion: counts, sums of the squares of motion, and of the low-passed residual"""
    lasting: Array = field(default_factory=lambda: np.zeros((2, SPEED_BINS)))
    """over bins of speed: counts, and sums of the square of the step, in its limit"""

    raw: Array = field(default_factory=lambda: np.zeros(OCTAVE_PARTS))
    """of squares of means over a second, by how many parts of an octave they are below the largest"""
    standard: Array = field(default_factory=lambda: np.zeros(OCTAVE_PARTS))
    """the same of the standardised residual"""

    def left(self) -> float:
        """Mean square of what the baseline leaves, over seconds."""
        return self.mean_square / self.means if self.means else math.inf

    def usually_left(self) -> float:
        """The same by the median, as of normal ones: what is only there on the way from one speed to another is not."""
        return _quantile(self.raw, 0.5) / MEDIAN_OF_SQUARE

    def lasts(self, share: float) -> float:
        """What the mean of the standardised residual over a second is not above in such a share of them."""
        return math.sqrt(_quantile(self.standard, share))


def _quantile(below: Array, share: float) -> float:
    if not below.sum():
        return math.inf
    parts = np.interp(1.0 - share, np.cumsum(below) / below.sum(), np.arange(OCTAVE_PARTS) + 1.0)
    return float(LARGEST_SQUARE * 0.5 ** (parts / PARTS_OF_OCTAVE))


@dataclass
class Healthy:
    """What one pass over the healthy runs has found. maxima: by run, (windows, 8, fans), see
    scoring.calibration.windows."""

    top_speed_rad_s: float
    step_s: float = 0.0
    maxima: list[Array] = field(default_factory=list)
    moments: dict[str, Moments] = field(default_factory=lambda: {name: Moments() for name in RESIDUALS})
    fan_s: float = 0.0
    speeds: float = 0.0
    """sum over the samples that were judged, rad/s"""
    stuck_s: float = 0.0
    missing: float = 0.0

    def peaks(self, row: int) -> Array:
        """(windows of fans,) of one statistic, or the score as the last."""
        every = np.concatenate([peaks(run[:, row]).ravel() for run in self.maxima])
        return every[np.isfinite(every)]

    @property
    def centres_rad_s(self) -> Array:
        """(SPEED_BINS,)"""
        return (np.arange(SPEED_BINS) + 0.5) / SPEED_BINS * self.top_speed_rad_s

    @property
    def mean_speed_rad_s(self) -> float:
        """Of the samples that were judged."""
        return self.speeds * self.step_s / max(self.fan_s, 1e-9)

    @property
    def windows(self) -> int:
        """So many in which a fan was judged."""
        return sum(int(np.isfinite(run[:, -1]).sum()) for run in self.maxima)


def survey(runs: Runs, limits: Limits, top_speed_rad_s: float) -> Healthy:
    """Judge healthy runs by some limits and keep what calibration needs."""
    healthy = Healthy(top_speed_rad_s)
    for fans, blocks, known_as in runs():
        judge = FanScorer(fans, limits.of(known_as))
        judge.watch()
        windows = Windows(fans, limits.timing.on_delay_s)
        seconds = {row + more: _Seconds() for row in FIRST for more in (0, 1)}
        cells = {name: np.zeros((2, fans, SPEED_BINS)) for name in RESIDUALS}
        for block in blocks:
            _take(healthy, judge, windows, seconds, cells, block)
        healthy.maxima.append(windows.end())
        for name in RESIDUALS:
            baseline = getattr(judge, name).baseline
            settled = baseline.is_set & ~baseline.is_commissioning
            count, total = cells[name]
            healthy.moments[name].count += count.sum(axis=0)
            healthy.moments[name].total += total.sum(axis=0)
            if known_as is not None:
                healthy.moments[name].cells.append(Cells(known_as, count, total))
            healthy.moments[name].baselines.append(baseline.commissioned[settled if settled.any() else baseline.is_set])
    return healthy


def _take(
    healthy: Healthy,
    judge: FanScorer,
    windows: Windows,
    seconds: dict[int, _Seconds],
    cells: dict[str, Array],
    block: Samples,
) -> None:
    verdict = judge.update(block)
    judged = np.isfinite(verdict.score)
    ratios, standard, usual, motion_rad_s = judge.watched()
    windows.add(block.t_ns, block.period_ns, ratios, judged)
    healthy.step_s = block.period_ns / 1e9
    healthy.fan_s += float(judged.sum()) * healthy.step_s
    healthy.speeds += float(np.nansum(np.abs(block.speed_rad_s), where=judged))
    healthy.stuck_s = max(healthy.stuck_s, judge.sensor.longest_s)
    healthy.missing = max(healthy.missing, judge.sensor.most_missing)
    bins = np.clip(np.abs(block.speed_rad_s) / healthy.top_speed_rad_s * SPEED_BINS, 0, SPEED_BINS - 1)
    octaves = np.log2(np.maximum(motion_rad_s / healthy.top_speed_rad_s, 1e-9))
    moving = np.clip(np.ceil(octaves) + MOTION_BINS - 1, 0, MOTION_BINS - 1).astype(int)
    for name, first, residual, valid, smoothed, baseline in (
        ("speed", FIRST[0], block.speed_residual, block.speed_valid, verdict.speed_smoothed, verdict.speed_baseline),
        ("balance", FIRST[1], block.balance, block.balance_valid, verdict.balance_smoothed, verdict.balance_baseline),
    ):
        use = valid & np.isfinite(smoothed)
        if use.any():
            moments = healthy.moments[name]
            moments.growth += float(ratios[first + 2][use].sum())
            moments.lasting += _sums(bins[use].astype(int), SPEED_BINS, np.square(ratios[first][use]))
            shift = np.clip(np.where(use, residual - usual[first // 3] - baseline, np.nan), -WILD, WILD)
            _note(moments, cells[name], shift, bins, seconds[first].of(shift, healthy.step_s))
            lasts = seconds[first + 1].of(np.where(use, standard[first // 3], np.nan), healthy.step_s)
            moments.standard += _below(np.square(lasts))
            motions = np.square(motion_rad_s[use])
            moments.moved += _sums(moving[use], MOTION_BINS, motions, np.square(smoothed[use]))


def _sums(places: Array, bins: int, *columns: Array) -> Array:
    """(1 + columns, bins) counts and sums."""
    return np.stack([np.bincount(places, column, minlength=bins) for column in (np.ones(len(places)), *columns)])


def _note(moments: Moments, cells: Array, shift: Array, bins: Array, means: Array) -> None:
    use = np.isfinite(shift)
    where = bins[use].astype(int)
    of_fans = where + SPEED_BINS * np.nonzero(use)[1]
    for column, values in enumerate((None, shift[use])):
        cells[column] += np.bincount(of_fans, values, minlength=cells[column].size).reshape(-1, SPEED_BINS)
    moments.square += np.bincount(where, shift[use] ** 2, minlength=SPEED_BINS)
    squares = np.square(means)
    moments.means += squares.size
    moments.mean_square += float(squares.sum())
    moments.raw += _below(squares)


class _Seconds:
    """Means over whole seconds of one residual of one run, however its samples are cut into blocks."""

    def __init__(self) -> None:
        self._rest: Array | None = None

    def of(self, shift: Array, step_s: float) -> Array:
        """(m,) finite means that are now whole; shift: (n, fans)."""
        second = max(1, round(1.0 / step_s))
        rows = shift if self._rest is None else np.concatenate((self._rest, shift))
        whole = len(rows) // second * second
        self._rest = rows[whole:].copy()
        means = rows[:whole].reshape(-1, second, rows.shape[1]).mean(axis=1)
        return means[np.isfinite(means)]


def _below(squares: Array) -> Array:
    """(OCTAVE_PARTS,) how many are how far below the largest."""
    parts = PARTS_OF_OCTAVE * np.log2(LARGEST_SQUARE / np.clip(squares, 1e-12, LARGEST_SQUARE))
    return np.bincount(np.minimum(parts, OCTAVE_PARTS - 1).astype(int), minlength=OCTAVE_PARTS)


def truncate_runs(runs: Runs, count: int, fan_s: float) -> Runs:
    """The truncate_runs of so many runs, together not more than so much running of fans."""

    def each() -> Iterator[Running]:
        for fans, blocks, known_as in runs():
            yield Running(fans, _until(blocks, fan_s / count / fans), known_as)

    return each


def _until(blocks: Iterable[Samples], seconds: float) -> Iterator[Samples]:
    """The first block at least."""
    end_t_ns = None
    for block in blocks:
        if end_t_ns is not None and block.t_ns[-1] > end_t_ns:
            return
        end_t_ns = end_t_ns or int(block.t_ns[0]) + round(seconds * 1e9)
        yield block
