"""One pass over healthy runs, scored as live fans are: the statistics from which calibration sets limits."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from schemas.messages import Array
from schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from schemas.units import NS_PER_S
from scoring.baseline.fan_offsets import Cells
from scoring.calibration.residual_moments import MOTION_BINS, SPEED_BINS, ResidualMoments, octaves
from scoring.calibration.windows import WindowMaxima, Windows, peaks
from scoring.detectors.detector import DetectorRow, Signal
from scoring.detectors.smoothed import Smoothed
from scoring.detectors.table import calibrated_rows, rows
from scoring.fan_scorer import RESIDUALS, FanScorer
from scoring.limits import Limits
from scoring.samples import Samples
from scoring.scored_block import Observation, ScoredBlock

COUNTS_OF_A_MEAN = 10  # so many of a tacho say as much about a shift as a second of a tacho that does not count
LARGEST_SIGMAS = 100.0  # larger residuals are clipped to this


class HealthyRun(NamedTuple):
    """A healthy run of one tray."""

    name: str
    """of the recording, for people"""
    fans: int
    blocks: Iterable[Samples]
    known_as: range | None = None
    """the numbers of these fans in the twin; None where it does not know its fans one by one"""
    tachos: tuple[Tacho, ...] = INSTANTANEOUS
    """how their speeds are measured: one for all fans, or one for each"""
    tray: str = ""
    """its name: runs of one tray are of the same fans"""


class MixedRatesError(Exception):
    """Healthy runs have grids of different rates; limits are valid for one rate."""

    def __init__(self, first: tuple[str, int], other: tuple[str, int]) -> None:
        super().__init__(first, other)
        self.first = first
        """name of a run and its period in ns"""
        self.other = other


@dataclass
class HealthyStatistics:
    """Statistics of one pass over a healthy run, or over several together."""

    top_speed_rad_s: float
    name: str = ""
    """of the first run that has samples"""
    period_ns: int = 0
    maxima: list[WindowMaxima] = field(default_factory=list)
    """of each run"""
    moments: dict[Signal, ResidualMoments] = field(
        default_factory=lambda: {source: ResidualMoments() for source in RESIDUALS}
    )
    ratio_sums: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """of each detector of a residual, the sum of its statistic in its limit"""
    fan_s: float = 0.0
    """time that was scored, summed over fans"""
    speed_sum_rad_s: float = 0.0
    """over the samples that were scored"""
    command_sum: float = 0.0
    """the same of the commands, without their signs"""
    count_sigmas: float = 0.0
    """largest standard deviation of a reading of a tacho that counts, from the phases of its pulses, sigma"""
    observed: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(dict))
    """of each detector, see Detector.observed"""

    def add(self, other: HealthyStatistics) -> None:
        """Add what was found in other runs.

        Raises:
            MixedRatesError: they are not of the same sampling period.
        """
        if not self.period_ns:
            self.name, self.period_ns = other.name, other.period_ns
        elif other.period_ns not in (0, self.period_ns):
            raise MixedRatesError((self.name, self.period_ns), (other.name, other.period_ns))
        self.maxima += other.maxima
        for source, moments in self.moments.items():
            moments.add(other.moments[source])
        for name, ratio_sum in other.ratio_sums.items():
            self.ratio_sums[name] += ratio_sum
        self.fan_s += other.fan_s
        self.speed_sum_rad_s += other.speed_sum_rad_s
        self.command_sum += other.command_sum
        self.count_sigmas = max(self.count_sigmas, other.count_sigmas)
        for name, observed in other.observed.items():
            largest = self.observed[name]
            for key, value in observed.items():
                largest[key] = max(largest.get(key, 0.0), value)

    @property
    def period_s(self) -> float:
        """Sampling period of the runs."""
        return self.period_ns / NS_PER_S

    @property
    def centres_rad_s(self) -> Array:
        """(SPEED_BINS,) centres of the bins of speed."""
        return (np.arange(SPEED_BINS) + 0.5) / SPEED_BINS * self.top_speed_rad_s

    @property
    def mean_speed_rad_s(self) -> float:
        """Mean speed of the samples that were scored."""
        return self.speed_sum_rad_s * self.period_s / max(self.fan_s, 1e-9)

    @property
    def visited_s(self) -> list[Array]:
        """Of each fan, (SPEED_BINS,) how long it was scored at a speed."""
        speed, balance = (self.moments[source].of_fans for source in RESIDUALS)
        return [np.maximum(speed[fan][0], balance[fan][0]) * self.period_s for fan in speed]

    @property
    def windows(self) -> int:
        """Number of windows of fans in which the fan was scored."""
        return sum(int(np.isfinite(run.score).sum()) for run in self.maxima)

    def peaks(self, row: int) -> Array:
        """(windows of fans,) of the statistic in a row of the table, see windows.peaks."""
        every = np.concatenate([peaks(run.statistics[:, row]).ravel() for run in self.maxima])
        return every[np.isfinite(every)]

    def mean_ratio(self, row: DetectorRow) -> float:
        """Mean of the statistic of a detector of a residual, in multiples of its limit."""
        if row.source == "tacho":
            return 0.0
        return float(self.ratio_sums[row.name] / max(self.moments[row.source].count.sum(), 1.0))


RunWork = Callable[[HealthyRun], HealthyStatistics]
Runs = Callable[[RunWork], Iterable[HealthyStatistics]]
"""Does the work on each healthy run, from its beginning, in this process or another; results in the order of the runs.
The work can be pickled."""


def one_after_another(runs: Callable[[], Iterable[HealthyRun]]) -> Runs:
    """Runs that are gone through in this process. runs: returns them from the beginning at each call."""
    return lambda work: map(work, runs())


def healthy_statistics(runs: Runs, limits: Limits, top_speed_rad_s: float) -> HealthyStatistics:
    """Score healthy runs with some limits.

    Raises:
        MixedRatesError: the runs are not all of one sampling period.
    """
    found = HealthyStatistics(top_speed_rad_s)
    for one in runs(partial(statistics_of_run, limits=limits, top_speed_rad_s=top_speed_rad_s)):
        found.add(one)
    return found


def statistics_of_run(run: HealthyRun, limits: Limits, top_speed_rad_s: float) -> HealthyStatistics:
    """Score one run. One block of it is in memory at a time.

    Raises:
        MixedRatesError: its sampling period changes.
    """
    found = HealthyStatistics(top_speed_rad_s, run.name)
    scoring = _RunScoring(found, run, limits.of(run.known_as))
    for block in run.blocks:
        if block.period_ns != (found.period_ns or block.period_ns):
            raise MixedRatesError((run.name, found.period_ns), (run.name, block.period_ns))
        found.period_ns = block.period_ns
        scoring.add(block)
    scoring.end()
    return found


class _RunScoring:
    """Scores one run, and adds up its statistics."""

    def __init__(self, found: HealthyStatistics, run: HealthyRun, limits: Limits) -> None:
        self._found = found
        self._run = run
        self._scorer = FanScorer(run.fans, limits, for_calibration=True, tachos=run.tachos)
        self._rows = [rows().index(row) for row in calibrated_rows()]
        self._windows = Windows(run.fans, len(calibrated_rows()), limits.timing.on_delay_s)
        tachos = tacho_of_each_fan(run.tachos, run.fans)
        graded = [tacho.resolution_rad_s / math.sqrt(tacho.resolution_steps) for tacho in tachos]
        self._count_std_rad_s = np.array(graded)
        self._seconds = {source: _Means(1.0) for source in RESIDUALS}
        counts_s = COUNTS_OF_A_MEAN * max(tacho.held_s for tacho in tachos)
        self._standardised_means = {
            source: _Means(counts_s, 0.5) if counts_s > 1.0 else _Means(1.0) for source in RESIDUALS
        }
        self._cells = {source: np.zeros((2, run.fans, SPEED_BINS)) for source in RESIDUALS}

    def add(self, block: Samples) -> None:
        """Score a block."""
        found, scored = self._found, self._scorer.update(block)
        seen = self._scorer.observed()
        ratios = np.concatenate([one.ratios[self._rows] for one in seen], axis=1)
        has_score = np.isfinite(scored.score)
        count_sigmas = np.where(block.speed_valid, self._count_std_rad_s / block.speed_sigma_rad_s, 0.0)
        found.count_sigmas = max(found.count_sigmas, float(count_sigmas.max()))
        found.command_sum += float(np.nansum(np.abs(block.command), where=has_score & np.isfinite(block.speed_rad_s)))
        self._windows.add(block.t_ns, block.period_ns, ratios, has_score)
        found.fan_s += float(has_score.sum()) * found.period_s
        found.speed_sum_rad_s += float(np.nansum(np.abs(block.speed_rad_s), where=has_score))
        self._add_residual("speed", block, scored, seen, ratios)
        self._add_residual("balance", block, scored, seen, ratios)

    def _add_residual(
        self, source: Signal, block: Samples, scored: ScoredBlock, seen: list[Observation], ratios: Array
    ) -> None:
        is_speed = source == "speed"
        residual, valid = (
            (block.speed_residual, block.speed_valid) if is_speed else (block.balance, block.balance_valid)
        )
        smoothed, baseline = (
            (scored.speed_smoothed, scored.speed_baseline)
            if is_speed
            else (scored.balance_smoothed, scored.balance_baseline)
        )
        use = valid & np.isfinite(smoothed)
        if not use.any():
            return
        found, moments = self._found, self._found.moments[source]
        operating_rad_s = block.operating_speed_rad_s(is_predicted=self._scorer.limits.over_predicted_speed)
        speed = np.abs(operating_rad_s) / found.top_speed_rad_s * SPEED_BINS
        bins = np.clip(speed, 0, SPEED_BINS - 1)
        transient_rad_s = np.concatenate([one.transient_rad_s for one in seen])
        octave = np.log2(np.maximum(transient_rad_s / found.top_speed_rad_s, 1e-9))
        moving = np.clip(np.ceil(octave) + MOTION_BINS - 1, 0, MOTION_BINS - 1).astype(int)
        for number, row in enumerate(calibrated_rows()):
            if row.source == source:
                found.ratio_sums[row.name] += float(ratios[number][use].sum())
                if row.detector is Smoothed:
                    squares = np.square(ratios[number][use])
                    moments.smoothed_by_speed += _sums(bins[use].astype(int), SPEED_BINS, squares)
        expected = np.concatenate([one.expected[source] for one in seen])
        shift = np.clip(np.where(use, residual - expected - baseline, np.nan), -LARGEST_SIGMAS, LARGEST_SIGMAS)
        _add_shift(moments, self._cells[source], shift, bins, self._seconds[source].of(shift, found.period_s))
        persistent = np.concatenate([one.persistent[source] for one in seen])
        means = self._standardised_means[source].of(np.where(use, persistent, np.nan), found.period_s)
        moments.standardised_octaves += octaves(np.square(means))
        motions = np.square(transient_rad_s[use])
        moments.by_motion += _sums(moving[use], MOTION_BINS, motions, np.square(smoothed[use]))

    def end(self) -> None:
        """Add what is known at the end of the run."""
        found = self._found
        found.maxima.append(self._windows.end())
        for name, detector in self._scorer.detectors.items():
            found.observed[name] = {key: max(value, 0.0) for key, value in detector.observed().items()}
        for source, moments in found.moments.items():
            baseline = self._scorer.residuals[source].baseline
            settled = baseline.is_set & ~baseline.is_commissioning
            count, total = self._cells[source]
            moments.count += count.sum(axis=0)
            moments.total += total.sum(axis=0)
            tray, numbers = ("", self._run.known_as) if self._run.known_as else (self._run.tray, range(self._run.fans))
            for column, number in enumerate(numbers):
                fan = (tray, number)
                moments.of_fans[fan] = moments.of_fans.get(fan, 0.0) + self._cells[source][:, column]
            if self._run.known_as is not None:
                moments.cells.append(Cells(self._run.known_as, count, total))
            moments.baselines.append(baseline.commissioned[settled if settled.any() else baseline.is_set])


def _sums(places: Array, bins: int, *columns: Array) -> Array:
    """(1 + columns, bins) counts and sums."""
    return np.stack([np.bincount(places, column, minlength=bins) for column in (np.ones(len(places)), *columns)])


def _add_shift(moments: ResidualMoments, cells: Array, shift: Array, bins: Array, means: Array) -> None:
    use = np.isfinite(shift)
    where = bins[use].astype(int)
    of_fans = where + SPEED_BINS * np.nonzero(use)[1]
    for column, values in enumerate((None, shift[use])):
        cells[column] += np.bincount(of_fans, values, minlength=cells[column].size).reshape(-1, SPEED_BINS)
    moments.square += np.bincount(where, shift[use] ** 2, minlength=SPEED_BINS)
    squares = np.square(means)
    moments.seconds += squares.size
    moments.second_mean_square += float(squares.sum())
    moments.second_octaves += octaves(squares)


class _Means:
    """Means of one residual of one run over a time, however its samples are cut into blocks."""

    def __init__(self, over_s: float, least_share: float = 1.0) -> None:
        """least_share: so many of its samples must be finite."""
        self._over_s, self._least_share = over_s, least_share
        self._rest: Array | None = None

    def of(self, shift: Array, period_s: float) -> Array:
        """(m,) means that are complete now, and of enough samples; shift: (n, fans)."""
        rows = max(1, round(self._over_s / period_s))
        samples = shift if self._rest is None else np.concatenate((self._rest, shift))
        whole = len(samples) // rows * rows
        self._rest = samples[whole:].copy()
        each = samples[:whole].reshape(-1, rows, samples.shape[1])
        known = np.isfinite(each)
        counts = known.sum(axis=1)
        enough = counts >= self._least_share * rows
        return np.where(known, each, 0.0).sum(axis=1)[enough] / counts[enough]


def truncate_runs(runs: Runs, count: int, fan_s: float) -> Runs:
    """The first part of each of `count` runs, together not longer than fan_s, summed over fans."""
    return lambda work: runs(partial(_on_first_part, fan_s=fan_s / count, work=work))


def _on_first_part(run: HealthyRun, fan_s: float, work: RunWork) -> HealthyStatistics:
    return work(run._replace(blocks=_until(run.blocks, fan_s / run.fans)))


def _until(blocks: Iterable[Samples], seconds: float) -> Iterator[Samples]:
    """Blocks up to a time; the first one at least."""
    end_t_ns = None
    for block in blocks:
        if end_t_ns is not None and block.t_ns[-1] > end_t_ns:
            return
        end_t_ns = end_t_ns or int(block.t_ns[0]) + round(seconds * NS_PER_S)
        yield block
