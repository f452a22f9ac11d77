"""What is known of a twin on some recordings, as sums: recordings are summed one by one, wherever they are.

All sums have the extent of the runs in common, which must be known before. `SpeedSums` gives the mean error of the twin
over its range of speeds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

import numpy as np

from fantwin.twin.build import RunsOfTwin
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import (
    FigureSums,
    FreeRun,
    evaluation_pieces,
    figure_sums,
    free_run_of_piece,
)
from fantwin.twin.evaluation.residual_analysis import ResidualGrid, ResidualSums, residual_grid, residual_sums
from fantwin.twin.runs import Array, Run

BINS = 20
FEWEST = 20
SMALLEST_SHARE = 0.005


@dataclass(frozen=True)
class SpeedBin:
    """The errors (measured minus free run, rad/s) at free-run speeds around middle_rad_s."""

    middle_rad_s: float
    mean_rad_s: float
    std_rad_s: float


@dataclass(frozen=True, eq=False)
class SpeedSums:
    """Sums of the errors of each fan in bins of equal width over a range of speeds, (fans, BINS). They can be added."""

    count: Array
    error: Array
    square: Array

    def __add__(self, other: "SpeedSums") -> "SpeedSums":
        return SpeedSums(self.count + other.count, self.error + other.error, self.square + other.square)

    def error_std_rad_s(self) -> Array:
        """(fans,) standard deviation of all errors; NaN without any."""
        count, error, square = (sums.sum(axis=1) for sums in (self.count, self.error, self.square))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(np.maximum(square / count - (error / count) ** 2, 0.0))

    def bins(self, fan: int, range_rad_s: Array) -> tuple[SpeedBin, ...]:
        """The bins of one fan, without those that have too few samples. range_rad_s: (2,) of its speeds."""
        low, high = range_rad_s
        if not high > low:
            return ()
        edges = np.linspace(low, high, BINS + 1)
        enough = max(FEWEST, SMALLEST_SHARE * self.count[fan].sum())
        found = []
        for k in np.flatnonzero(self.count[fan] >= enough):
            mean = float(self.error[fan, k] / self.count[fan, k])
            variance = float(self.square[fan, k] / self.count[fan, k]) - mean**2
            found.append(SpeedBin(float(edges[k : k + 2].mean()), mean, max(variance, 0.0) ** 0.5))
        return tuple(found)


def speed_sums(predicted_rad_s: Array, error_rad_s: Array, range_rad_s: Array) -> SpeedSums:
    """The sums over samples. predicted_rad_s, error_rad_s: (n, fans), values that are not finite are ignored.
    range_rad_s: (2, fans) of speeds that the bins divide; the outermost ones go on beyond it.
    """
    fans = predicted_rad_s.shape[1]
    seen = np.isfinite(predicted_rad_s) & np.isfinite(error_rad_s)
    low, high = range_rad_s
    with np.errstate(invalid="ignore", divide="ignore"):
        place = np.nan_to_num(BINS * (predicted_rad_s - low) / (high - low))
    column = np.clip(place, 0, BINS - 1).astype(int) + BINS * np.arange(fans)
    error = error_rad_s[seen]
    sums = (np.bincount(column[seen], weights, fans * BINS) for weights in (np.ones(len(error)), error, error**2))
    count, total, square = (of.reshape(fans, BINS).astype(np.float64) for of in sums)
    return SpeedSums(count, total, square)


RANGE_TOLERANCE = 0.05
"""of the width of the trained command range; as in production (docs/explanation/deciding.md)"""


@dataclass(frozen=True, eq=False)
class Extent:
    """How fast and how long runs are. range_rad_s: (2, fans) lowest and highest measured speed; longest_s: of runs
    without a gap. steps: how many steps the median is of."""

    median_step_s: float
    steps: int
    longest_s: float
    range_rad_s: Array

    @property
    def grid(self) -> ResidualGrid:
        """For the sums over the residual."""
        return residual_grid(self.median_step_s, self.longest_s)


def extent_of(runs: Sequence[Run]) -> Extent:
    """The extent of some runs. Raises TwinError when there is nothing to evaluate."""
    pieces = evaluation_pieces(runs)
    steps_s = np.concatenate([np.diff(piece.t_s) for piece in pieces])
    speed_rad_s = np.concatenate([piece.speed_rad_s for piece in pieces])
    low, high = np.fmin.reduce(speed_rad_s), np.fmax.reduce(speed_rad_s)
    longest_s = max(piece.duration_s for piece in pieces)
    return Extent(float(np.median(steps_s)), len(steps_s), longest_s, np.stack((low, high)))


def common_extent(extents: Sequence[Extent]) -> Extent:
    """That of all of some recordings; the median step is the median over recordings, each weighted by its steps.

    Raises TwinError when they are of different numbers of fans.
    """
    fans = {extent.range_rad_s.shape[1] for extent in extents}
    if len(fans) > 1:
        raise TwinError(f"runs of {sorted(fans)} fans are mixed; give runs of one fan count")
    ranges_rad_s = np.array([extent.range_rad_s for extent in extents])
    ordered = sorted(extents, key=lambda extent: extent.median_step_s)
    up_to = np.cumsum([extent.steps for extent in ordered])
    return Extent(
        median_step_s=ordered[int(np.searchsorted(up_to, up_to[-1] / 2))].median_step_s,
        steps=int(up_to[-1]),
        longest_s=max(extent.longest_s for extent in extents),
        range_rad_s=np.stack((np.fmin.reduce(ranges_rad_s[:, 0]), np.fmax.reduce(ranges_rad_s[:, 1]))),
    )


@dataclass(frozen=True, eq=False)
class RecordingSums:
    """Sums over runs. They can be added. fastest_rad_s, missing, outside: (fans,) the largest measured speed, and how
    many of the samples have no speed and a command far outside the trained range."""

    figures: FigureSums
    residual: ResidualSums
    by_speed: SpeedSums
    samples: int
    fastest_rad_s: Array
    missing: Array
    outside: Array

    def __add__(self, other: "RecordingSums") -> "RecordingSums":
        sums: dict[str, Any] = {name: value + getattr(other, name) for name, value in vars(self).items()}
        sums["fastest_rad_s"] = np.fmax(self.fastest_rad_s, other.fastest_rad_s)
        return RecordingSums(**sums)


def sums_of_free_run(of: RunsOfTwin, free_run: FreeRun, extent: Extent) -> RecordingSums:
    """The sums over one piece."""
    piece, error = free_run.piece, free_run.residual_rad_s
    low, high = of.card.command_range
    reach = RANGE_TOLERANCE * (high - low)
    return RecordingSums(
        figures=figure_sums(of.model, of.parameters, of.sigma_rad_s, free_run, of.unseen_std),
        residual=residual_sums(error, [piece], extent.grid),
        by_speed=speed_sums(free_run.expected_rad_s, error, extent.range_rad_s),
        samples=piece.samples,
        fastest_rad_s=np.fmax.reduce(np.abs(piece.speed_rad_s)),
        missing=np.isnan(piece.speed_rad_s).sum(axis=0, dtype=np.float64),
        outside=((piece.command < low - reach) | (piece.command > high + reach)).sum(axis=0, dtype=np.float64),
    )


def recording_sums(of: RunsOfTwin, extent: Extent) -> RecordingSums:
    """The sums over all runs, one piece in memory at a time. Raises TwinError when there is nothing to evaluate."""
    free_runs = (free_run_of_piece(of.model, of.parameters, piece) for piece in evaluation_pieces(of.runs))
    return reduce(add, (sums_of_free_run(of, each, extent) for each in free_runs))
