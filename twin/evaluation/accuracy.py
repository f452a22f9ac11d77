"""How well a model follows measured runs.

The main figures are those of the free run: it starts from the first five measured speeds, as a deployed twin does, and
is driven by the commands alone. Runs are split at long gaps and restarted after them. The one-step error, from measured
speeds to the next one, is given for comparison and is a weak measure. Missing samples are ignored. What the tachos are
expected to show of the free run is compared with what they showed (twin.tacho_readings), from when on a reading shows
nothing of the time before the start. Of a static model, what a change of the command since the sample before may
explain is no error. RMSE, maximum error and R2 are equations (32) to (34) of Peng and Chen, the band of two sigma (35)
and (36).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.units import NS_PER_S
from fantwin.twin.errors import TwinError
from fantwin.twin.models.model import MayBeStatic, TwinModel
from fantwin.twin.runs import Array, Run, common_fans, starting_samples, starting_speed_rad_s
from fantwin.twin.tacho_readings import Measurement, measurement_of

Flags = NDArray[np.bool_]
UnseenStd = Callable[[Array, Array], Array]
"""of speeds in rad/s and commands, (n, fans) each: the standard deviation of the unseen error, rad/s"""

START_ITERATIONS = 3
START_NUDGE = 1e-4
FORGOTTEN = 0.01
"""squared sensitivity below which the first measured speeds do not determine the speed at the start"""


@dataclass(frozen=True)
class Figures:
    """Free-run figures in rad/s (r2 and coverage without unit), and the one-step error beside them.

    Infinite where the free run diverged; NaN where nothing was measured, and r2 where the speed never changed.
    coverage_2_sigma: the share of samples in the band, within two standard deviations of the free run. floor_rad_s: the
    rmse that the tachos would leave a perfect model; 0 where they are instantaneous, for their noise is not known.
    """

    rmse_rad_s: float
    max_error_rad_s: float
    r2: float
    one_step_rmse_rad_s: float
    coverage_2_sigma: float
    samples: int
    floor_rad_s: float = 0.0


@dataclass(frozen=True)
class Evaluation:
    """Figures of each fan, and of all fans' samples together."""

    per_fan: tuple[Figures, ...]
    pooled: Figures


@dataclass(frozen=True, eq=False)
class FigureSums:
    """What figures are made of: sums over samples, (fans,) each. They can be added.

    measured: the number of measured speeds. speed, spread: their sum, and that of their squared deviations from the
    mean. squares, largest, within: of the free-run error where measured: its squares, its largest magnitude, and how
    often it is in the band. steps, step_squares: the number of one-step errors, and their squares. noise: the squares
    of the noise of the tachos.
    """

    measured: Array
    speed: Array
    spread: Array
    squares: Array
    largest: Array
    within: Array
    steps: Array
    step_squares: Array
    noise: Array

    def __add__(self, other: "FigureSums") -> "FigureSums":
        sums = {name: value + getattr(other, name) for name, value in vars(self).items()}
        sums["largest"] = np.maximum(self.largest, other.largest)
        apart = self.speed / np.maximum(self.measured, 1.0) - other.speed / np.maximum(other.measured, 1.0)
        sums["spread"] += apart**2 * self.measured * other.measured / np.maximum(sums["measured"], 1.0)
        return FigureSums(**sums)

    def of(self, fans: slice) -> "FigureSums":
        """The sums of all samples of some fans together, (1,) each."""
        sums = {name: np.sum(value[fans], keepdims=True) for name, value in vars(self).items()}
        return FigureSums(**sums | {"largest": np.max(self.largest[fans], keepdims=True)})

    def evaluation(self) -> Evaluation:
        """The figures of each fan, and of all together."""
        fans = range(len(self.measured))
        return Evaluation(tuple(self.of(slice(fan, fan + 1)).figures() for fan in fans), self.of(slice(None)).figures())

    def figures(self) -> Figures:
        """The figures of sums (1,)."""
        measured, spread, squares, largest, within, steps, step_squares, noise = (
            float(value[0]) for name, value in vars(self).items() if name != "speed"
        )
        if measured == 0.0:
            return Figures(np.nan, np.nan, np.nan, np.nan, np.nan, 0)
        return Figures(
            rmse_rad_s=math.sqrt(squares / measured),
            max_error_rad_s=largest,
            r2=1.0 - squares / spread if spread > 0.0 else np.nan,
            one_step_rmse_rad_s=math.sqrt(step_squares / steps) if steps else np.nan,
            coverage_2_sigma=within / measured,
            samples=int(measured),
            floor_rad_s=math.sqrt(noise / measured),
        )


@dataclass(frozen=True, eq=False)
class FreeRun:
    """A piece of a run beside the free run of a model, (n, fans) in rad/s. expected: the readings that its tachos would
    show, not finite where it diverged. residual: measured minus that, NaN where nothing is compared
    (compared_readings), infinite where the free run diverged."""

    piece: Run
    expected_rad_s: Array
    residual_rad_s: Array


def sums_of_model(
    model: TwinModel, parameters: Array, sigma_rad_s: Array, runs: Sequence[Run], unseen_std: UnseenStd | None = None
) -> FigureSums:
    """What the figures on runs are made of. parameters: (fans, 4). sigma_rad_s: (fans,) healthy standard deviation of
    the free run: the band has this and the unseen error, as that of a running site."""
    free_runs = (free_run_of_piece(model, parameters, piece) for piece in evaluation_pieces(runs))
    return reduce(add, (figure_sums(model, parameters, sigma_rad_s, each, unseen_std) for each in free_runs))


def figure_sums(
    model: TwinModel, parameters: Array, sigma_rad_s: Array, free_run: FreeRun, unseen_std: UnseenStd | None = None
) -> FigureSums:
    """The sums over one piece. The others as of sums_of_model."""
    piece, expected = free_run.piece, free_run.expected_rad_s
    speed = compared_readings(piece)
    measured = np.isfinite(speed)
    count = measured.sum(axis=0, dtype=np.float64)
    errors = np.where(measured, free_run.residual_rad_s, 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        noise = measurement_of(piece).noise_rad_s(expected)
        std = np.hypot(sigma_rad_s, np.nan_to_num(unseen_std(expected, piece.command))) if unseen_std else sigma_rad_s
        squares = sums_by_fan(errors**2)
    steps = one_step_residual(model, parameters, piece)
    is_step = np.isfinite(steps)
    total = sums_by_fan(np.where(measured, speed, 0.0))
    deviation = np.where(measured, speed - total / np.maximum(count, 1.0), 0.0)
    return FigureSums(
        measured=count,
        speed=total,
        spread=sums_by_fan(deviation**2),
        squares=squares,
        largest=np.abs(errors).max(axis=0),
        within=(measured & (np.abs(errors) <= 2.0 * std)).sum(axis=0, dtype=np.float64),
        steps=is_step.sum(axis=0, dtype=np.float64),
        step_squares=sums_by_fan(np.where(is_step, steps, 0.0) ** 2),
        noise=sums_by_fan(np.where(measured, np.broadcast_to(noise, speed.shape), 0.0) ** 2),
    )


def sums_by_fan(values: Array) -> Array:
    """(fans,) the sums over the samples of (n, fans), to the bit as for each fan by itself: numpy adds rows that lie
    side by side in another order."""
    return np.ascontiguousarray(values.T).sum(axis=1)


def evaluation_pieces(runs: Sequence[Run]) -> list[Run]:
    """The runs split at their long gaps. Raises TwinError when there is nothing to evaluate."""
    common_fans(runs)
    pieces = [piece for run in runs for piece in run.split_at_gaps()]
    if not pieces:
        raise TwinError("the runs contain only gaps; give runs with at least two successive samples")
    return pieces


def compared_readings(piece: Run) -> Array:
    """(n, fans) readings in rad/s; NaN where missing, and where they show time before the start of the piece."""
    return np.where(measurement_of(piece).comparable, piece.speed_rad_s, np.nan)


def free_run_speeds(model: TwinModel, parameters: Array, piece: Run) -> Array:
    """(n, fans) speeds in rad/s of a free run from the measured start, driven by the commands; not finite where it
    diverged."""
    state = _starting_state(model, parameters, piece)
    return model.advance(state, piece.command, piece.step_s, parameters)[0]


def free_run_readings(model: TwinModel, parameters: Array, piece: Run) -> Array:
    """(n, fans) readings in rad/s that the tachos are expected to show of free_run_speeds."""
    return measurement_of(piece).of_speed(free_run_speeds(model, parameters, piece))


def free_run_of_piece(model: TwinModel, parameters: Array, piece: Run) -> FreeRun:
    """Run a model freely over a piece."""
    expected, measured = free_run_readings(model, parameters, piece), compared_readings(piece)
    diverged = np.isfinite(measured) & ~np.isfinite(expected)
    residual = measured - expected
    if isinstance(model, MayBeStatic) and (curve := model.steady_curve(parameters)) is not None:
        commands = np.vstack((piece.command[:1], piece.command))
        may_be = curve.half_range_rad_s(commands, np.append(0.0, np.diff(piece.t_s)), np.zeros(piece.fans))
        residual -= residual.clip(-may_be, may_be)
    return FreeRun(piece, expected, np.where(diverged, np.inf, residual))


def free_run_residuals(model: TwinModel, parameters: Array, pieces: Sequence[Run]) -> Array:
    """(samples, fans) residual of the free runs over pieces one after the other, as of FreeRun."""
    return np.concatenate([free_run_of_piece(model, parameters, piece).residual_rad_s for piece in pieces])


def pooled_rmse_rad_s(residual: Array) -> float:
    """Root mean square over all measured samples of a residual (samples, fans)."""
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.nanmean(residual**2)))


def _starting_state(model: TwinModel, parameters: Array, piece: Run) -> Array:
    """The state whose free run is nearest, in least squares, to the first five readings of each fan.

    With a tacho that averages, to the first five that show mostly the time after the start. Their mean is the speed at
    their middle: an accelerating fan would start too fast, the more so the longer its sample period.
    """
    times = np.broadcast_to(piece.t_s[:, np.newaxis], piece.speed_rad_s.shape)
    early = starting_samples(times, piece.speed_rad_s, piece.tacho)
    rows = slice(0, int(np.flatnonzero(early.any(axis=1)).max(initial=0)) + 1)
    measurement = Measurement(times[rows], piece.tacho)

    def beginning(speed_rad_s: Array) -> Array:
        state = model.state_layout.initial_state(speed_rad_s, piece.command[0])
        predicted, _ = model.advance(state, piece.command[rows], piece.step_s[rows], parameters)
        return np.where(early[rows], measurement.of_speed(predicted), 0.0)

    known = np.where(early, piece.speed_rad_s, 0.0)[rows]
    start = np.nan_to_num(starting_speed_rad_s(piece.speed_rad_s, early))
    nudge = START_NUDGE * (1.0 + np.abs(start))
    for _ in range(START_ITERATIONS):
        predicted = beginning(start)
        with np.errstate(invalid="ignore", over="ignore"):
            by_start = (beginning(start + nudge) - predicted) / nudge
            slope, square = np.sum(by_start * (known - predicted), axis=0), np.sum(by_start**2, axis=0)
            correction = slope / (square + FORGOTTEN)
        start = np.where(np.isfinite(correction), start + correction, start)
    return model.state_layout.initial_state(start, piece.command[0])


def one_step_residual(model: TwinModel, parameters: Array, piece: Run) -> Array:
    """(samples, fans) of one piece: measured minus the prediction from the measured speeds up to the sample before.

    The commands before count as they do in a free run. NaN where the speeds that a prediction needs are not measured.
    What the state holds of the commands does not depend on the speeds: it is carried along, and at each sample the
    measured speeds take the place of the predicted ones. The piece is cut into as many stretches as each has samples;
    their starting states come from running it once, and then all stretches advance side by side, as if they were fans.
    """
    layout, samples = model.state_layout, piece.samples
    measured = np.isfinite(piece.speed_rad_s)
    # A state cannot contain a missing speed; predictions from the zero in its place are removed again.
    speed = np.where(measured, piece.speed_rad_s, 0.0)
    length = math.isqrt(samples)
    starts = np.arange(0, samples, length)
    state = layout.initial_state(speed[0], piece.command[0])
    starting_states = []
    for first in starts:
        starting_states.append(state)
        block = slice(first, first + length)
        _, state = model.advance(state, piece.command[block], piece.step_s[block], parameters)
        # A diverging free run must not pass its speeds on.
        state = np.where(np.isfinite(state), state, 0.0)
    states = np.stack(starting_states)
    predicted = np.full_like(speed, np.nan)
    for offset in range(length):
        k = starts[starts + offset < samples - 1] + offset
        states = states[: len(k)]
        for back in range(layout.speed):
            states[:, :, back] = speed[np.maximum(k - back, 0)]
        states = _advance_side_by_side(model, states, piece.command[k], piece.step_s[k], parameters)
        predicted[k + 1] = states[:, :, 0]
    predicted[: layout.speed] = np.nan
    for back in range(1, layout.speed + 1):
        predicted[back:][~measured[:-back]] = np.nan
    return piece.speed_rad_s - predicted


def _advance_side_by_side(model: TwinModel, states: Array, command: Array, step_s: Array, parameters: Array) -> Array:
    """(stretches, fans, n_state) states one step later. command: (stretches, fans). step_s: (stretches,).

    A block has one step for all its fans, so that stretches advance together whose steps are equal, to the nanosecond
    in which times are recorded.
    """
    following = np.empty_like(states)
    period_ns = np.rint(NS_PER_S * step_s)
    for step in np.unique(period_ns):
        same = period_ns == step
        count = int(np.count_nonzero(same))
        together = states[same].reshape(-1, states.shape[-1])
        everyone = np.tile(parameters, (count, 1))
        _, ends = model.advance(together, command[same].reshape(1, -1), step_s[same][:1], everyone)
        following[same] = ends.reshape(count, *states.shape[1:])
    return following
