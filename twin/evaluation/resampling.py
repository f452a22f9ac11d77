"""A run on another grid than it was recorded on, to see whether a twin depends on the grid it was trained on.

The command of each new step is the mean of the held command over it (the exact integral of the zero-order hold), so
that no impulse is lost. Measured speeds are used where the times of both grids coincide: interpolation would lower
their noise (midway between two samples by half its variance), and figures of different grids could not be compared.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import evaluation_pieces
from fantwin.twin.runs import Array, Run

Grid = float | Literal["irregular"]

LONGEST_STEP = 3
SAME_TIME_IN_STEPS = 0.01
MIN_SHARE_MEASURED = 0.1
MAX_SHARE_UNEVEN = 0.1
BRIDGE_IN_STEPS = 2.5
MOST_TIMES_FASTER = 100


def resampled(run: Run, rate_hz: float) -> Run:
    """The run at a constant rate from its first sample on.

    New times within a hundredth of a median step of a sample take its speed; the others have none. Where the run's own
    steps are uneven (more than a tenth are not a multiple of the median), or fewer than a tenth of the new times meet a
    sample, the samples met would be few or a choice of their own: then speeds are interpolated between measured
    neighbours, at most two and a half median steps apart, and their noise is lower than recorded.
    Raises TwinError when the rate is not positive or beyond 100 times that of the run, or the run is shorter than one
    step of it.
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise TwinError(f"a rate of {rate_hz} Hz; give a positive number")
    if rate_hz * run.median_period_s > MOST_TIMES_FASTER:
        raise TwinError(f"a rate of {rate_hz:g} Hz; give at most {MOST_TIMES_FASTER} times that of the run")
    steps = int(run.duration_s * rate_hz * (1.0 + 1e-12) + 1e-6)
    if steps < 1:
        raise TwinError(f"run {run.name!r}: {run.duration_s:.3g} s are shorter than one step at {rate_hz:g} Hz")
    t_s = run.t_s[0] + np.arange(steps + 1) / rate_hz
    held = np.clip(np.searchsorted(run.t_s, t_s, "right") - 1, 0, None)
    return _at_times(run, t_s, _speed_rad_s(run, t_s), held)


def irregular(run: Run, seed: int = 0) -> Run:
    """The run thinned at random: each step becomes one to three of its own, all equally likely.

    Every speed is a measured one, so that the noise is the recording's. Raises TwinError when fewer than two samples
    remain.
    """
    steps = np.random.default_rng(seed).integers(1, LONGEST_STEP + 1, size=run.samples)
    kept = np.concatenate(([0], np.cumsum(steps)))
    kept = kept[kept < run.samples]
    if len(kept) < 2:
        raise TwinError(f"run {run.name!r}: {run.samples} samples are too few to thin; give a longer run")
    return _at_times(run, run.t_s[kept], run.speed_rad_s[kept], kept)


def thinned(run: Run, every: int) -> Run:
    """Every so many samples of the run, from the first on; the run itself where fewer than two would remain.

    Also for tachos that count: their readings are compared with the mean of a free run over the window, at any times.
    """
    kept = np.arange(0, run.samples, every)
    return run if every == 1 or len(kept) < 2 else _at_times(run, run.t_s[kept], run.speed_rad_s[kept], kept)


def _at_times(run: Run, t_s: Array, speed_rad_s: Array, rows: NDArray[np.intp]) -> Run:
    """The run at other times. rows: of the run, whose auxiliary columns it has."""
    command = _mean_command(run, t_s)
    return replace(run, t_s=t_s, command=command, speed_rad_s=speed_rad_s, auxiliary=run.auxiliary_in(rows))


def on_grid(runs: Sequence[Run], grid: Grid, seed: int = 0) -> list[Run]:
    """The stretches of runs between their long gaps, each on another grid; those too short for it are left out.

    Raises TwinError when none is long enough.
    """
    shortest = LONGEST_STEP + 1 if grid == "irregular" else 2
    pieces = [piece for piece in evaluation_pieces(runs) if piece.samples >= shortest]
    if grid == "irregular":
        made = [irregular(piece, seed + k) for k, piece in enumerate(pieces)]
    else:
        made = [resampled(piece, grid) for piece in pieces if piece.duration_s * grid >= 1.0]
    if not made:
        rate = "at irregular steps" if grid == "irregular" else f"at {grid:g} Hz"
        raise TwinError(f"no run is long enough to be evaluated {rate}; give longer ones")
    return made


def _mean_command(run: Run, t_s: Array) -> Array:
    """(new samples, fans) mean of the held command from each new time to the next; the last step repeats."""
    edges = np.append(t_s, 2.0 * t_s[-1] - t_s[-2])
    knots = np.append(run.t_s, max(run.t_s[-1] + run.step_s[-1], edges[-1]))
    held = np.cumsum(run.command * np.diff(knots)[:, np.newaxis], axis=0)
    integral = np.vstack((np.zeros(run.fans), held))
    at_edges = np.column_stack([np.interp(edges, knots, of_fan) for of_fan in integral.T])
    return np.diff(at_edges, axis=0) / np.diff(edges)[:, np.newaxis]


def _speed_rad_s(run: Run, t_s: Array) -> Array:
    after = np.clip(np.searchsorted(run.t_s, t_s), 1, run.samples - 1)
    nearest = np.where(t_s - run.t_s[after - 1] < run.t_s[after] - t_s, after - 1, after)
    same = np.abs(t_s - run.t_s[nearest]) <= SAME_TIME_IN_STEPS * run.median_period_s
    if _steps_are_even(run) and same.mean() >= MIN_SHARE_MEASURED:
        return np.where(same[:, np.newaxis], run.speed_rad_s[nearest], np.nan)
    return np.column_stack([_interpolated(run, speed, t_s) for speed in run.speed_rad_s.T])


def _steps_are_even(run: Run) -> bool:
    """Whether all but a few steps are multiples of the median one: samples may be lost, but time does not jitter."""
    in_medians = np.diff(run.t_s) / run.median_period_s
    return bool(np.mean(np.abs(in_medians - np.rint(in_medians)) > SAME_TIME_IN_STEPS) <= MAX_SHARE_UNEVEN)


def _interpolated(run: Run, speed_rad_s: Array, t_s: Array) -> Array:
    """(new samples,) one fan's speeds, linear between measured neighbours that are close enough, else NaN."""
    measured = np.isfinite(speed_rad_s)
    known_s, known = run.t_s[measured], speed_rad_s[measured]
    if len(known) < 2:
        return np.full_like(t_s, np.nan)
    after = np.clip(np.searchsorted(known_s, t_s), 1, len(known) - 1)
    bridged = known_s[after] - known_s[after - 1] <= BRIDGE_IN_STEPS * run.median_period_s
    slack_s = SAME_TIME_IN_STEPS * run.median_period_s
    inside = (t_s >= known_s[0] - slack_s) & (t_s <= known_s[-1] + slack_s)
    return np.where(bridged & inside, np.interp(t_s, known_s, known), np.nan)
