"""The drive of fans that control their own speed (twin.models.drive), from runs in which they stop and start.

A fan's settings are fitted along with its physics on the free run, by Levenberg-Marquardt with exact sensitivities, for
one kick and rest after the other of two short ladders. Both enter through the command, so that the rest of the model
maker needs to know nothing of a drive: it is given the runs with the commands that act.

Most fans have no such drive. It is looked for where readings are of pulses, as those of 4-pin fans are, and each fan
starts, all together `FEWEST_STARTS` times. It is kept only if it lowers the free-run error of the physics by
`LEAST_GAIN` or more, compared with friction alone, which is no drive: a hybrid learns that by itself. Errors are of all
runs together: held-out ones may hold no start and no command of the plateau, and five settings of 10,000 readings fit
no chance. Readings count as they do in the fit (twin.fitting.reading_errors): while the speed changes, those of a slow
line err by more than a drive explains.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.standstill import Standstill
from fantwin.schemas.twin_card import DriveCard
from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.free_run_fit import ERROR_ROUNDS
from fantwin.twin.fitting.free_run_problem import HEAVIER, HUBER_DELTA
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.fitting.reading_errors import ReadingErrors, reading_errors, robust_scale
from fantwin.twin.fitting.trajectories import MAX_SAMPLES, Trajectories, cut_into_trajectories, practical_samples
from fantwin.twin.models.drive import DRIVE_PARAMETERS, Drive
from fantwin.twin.models.integration import free_run, rk4_step_derivatives
from fantwin.twin.models.physical import fitted_unknowns, parameters_by_unknowns, physical_parameters
from fantwin.twin.models.physics import LAG, PARAMETER_NAMES
from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.models.right_hand_side import FanEquation
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.runs import Array, Run

FEWEST_STARTS = 3
LEAST_GAIN = 0.07
"""a share of the free-run error"""
KICKS_S, RESTS_S = (0.3, 0.6, 1.2), (1.0, 2.0, 4.0)
FIRST_ITERATIONS, MORE_ITERATIONS = 12, 5
MOST_ITERATIONS = 2 * FIRST_ITERATIONS + (len(KICKS_S) + len(RESTS_S) + 2 * ERROR_ROUNDS) * MORE_ITERATIONS
FIRST_DAMPING, DAMPING_DOWN, DAMPING_UP = 1e-3, 3.0, 4.0
FIRST_PLATEAU, FIRST_KICK = 0.05, 0.5
"""shares of the range of commands above the lowest that turns the fans"""
LOWEST, FRICTION, KICK = (LAG + index for index in range(len(DRIVE_PARAMETERS)))
UNKNOWNS = LAG + len(DRIVE_PARAMETERS)
INERTIA = PARAMETER_NAMES.index("J")


@dataclass(frozen=True, eq=False)
class FoundDrive:
    """The drive of all fans and the settings (fans, 3) of each."""

    drive: Drive
    settings: Array

    def driven(self, runs: Sequence[Run]) -> list[Run]:
        """The stretches of runs with the commands that act."""
        pieces = [piece for run in runs for piece in run.split_at_gaps()]
        return [
            replace(piece, command=self.drive.run_effective(piece.command, piece.step_s, self.settings))
            for piece in pieces
        ]

    def raised(self, runs: Sequence[Run]) -> list[Run]:
        """The runs with commands on the plateau raised to its end, for the torque balance."""
        return [replace(run, command=self.card.raised(run.command)) for run in runs]

    @property
    def card(self) -> DriveCard:
        """What readers of a twin have to know of it."""
        drive = self.drive
        return DriveCard(drive.turning_command, drive.kick_s, drive.rest_s, tuple(self.settings[:, 0].tolist()))


def find_drive(
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    plain: Identification,
    standstill: Standstill | None,
    progress: Progress = unreported,
) -> FoundDrive | None:
    """The drive of the fans, or None where they have none, or it does not pay.

    validation_runs: held out of the fit; it has to pay over them and the runs together. plain: without a drive.
    """
    of_pulses = all(tacho.kind != "instantaneous" for run in runs for tacho in run.tacho)
    if not of_pulses or standstill is None or standstill.off_command is None:
        return None
    turning = (standstill.off_command + standstill.turning_command) / 2.0
    starts = np.sum([_starts(run, turning) for run in runs], axis=0)
    if starts.min() == 0 or starts.sum() < FEWEST_STARTS:
        return None
    try:
        learned, judged = _Runs(runs), _Runs([*runs, *validation_runs])
    except TwinError:
        return None
    highest = max(float(run.command.max()) for run in runs)
    count = itertools.count(1)

    def iteration_done() -> None:
        progress("drive of the fans", next(count), MOST_ITERATIONS, np.nan)

    start = np.zeros((len(plain.parameters), UNKNOWNS))
    start[:, :LAG] = fitted_unknowns(plain.parameters, plain.top_speed_rad_s)[:, :LAG]
    without = np.arange(UNKNOWNS) < LAG
    without[FRICTION] = True
    drive = Drive(turning, KICKS_S[1], RESTS_S[1])
    never = replace(drive, rest_s=np.inf)
    of_friction = _Problem(learned, never, plain.top_speed_rad_s, highest).fit(
        start, without, FIRST_ITERATIONS, iteration_done
    )
    start = of_friction.copy()
    # A plateau below all commands would have no effect, and so no derivative.
    start[:, LOWEST] = standstill.turning_command + FIRST_PLATEAU * (highest - standstill.turning_command)
    start[:, KICK] = turning + FIRST_KICK * (highest - turning)
    everything = np.ones(UNKNOWNS, np.bool_)
    best = _Problem(learned, drive, plain.top_speed_rad_s, highest).fit(
        start, everything, FIRST_ITERATIONS, iteration_done
    )
    loss = _Problem(learned, drive, plain.top_speed_rad_s, highest).mean_square(best)
    for name, ladder in (("kick_s", KICKS_S), ("rest_s", RESTS_S)):
        for value in ladder:
            if value == getattr(drive, name):
                continue
            other = replace(drive, **{name: value})
            problem = _Problem(learned, other, plain.top_speed_rad_s, highest)
            unknowns = problem.fit(best, everything, MORE_ITERATIONS, iteration_done)
            if (of_other := problem.mean_square(unknowns)) < loss:
                best, loss, drive = unknowns, of_other, other
    # Inertia and kick show while the speed changes, when readings say little of the rest.
    steady = everything.copy()
    steady[[INERTIA, KICK]] = False

    def steadied(of: Drive, unknowns: Array, free: NDArray[np.bool_]) -> Array:
        problem = _Problem(learned, of, plain.top_speed_rad_s, highest)
        for _ in range(ERROR_ROUNDS):
            problem.learn_errors(unknowns)
            unknowns = problem.fit(unknowns, free & steady, MORE_ITERATIONS, iteration_done)
        return unknowns

    final, of_friction = steadied(drive, best, everything), steadied(never, of_friction, without)
    with_drive = _Problem(judged, drive, plain.top_speed_rad_s, highest)
    with_drive.learn_errors(final)
    friction_alone = _Problem(judged, never, plain.top_speed_rad_s, highest, with_drive.errors)
    if not with_drive.mean_square(final) < (1.0 - LEAST_GAIN) ** 2 * friction_alone.mean_square(of_friction):
        return None
    return FoundDrive(drive, final[:, LAG:])


def _starts(run: Run, turning_command: float) -> NDArray[np.intp]:
    """(fans,) how often the command goes from one that stops the fan to one that turns it."""
    is_on = run.command >= turning_command
    return np.count_nonzero(~is_on[:-1] & is_on[1:], axis=0)


class _Runs:
    """Runs as stretches. Raises TwinError where they hold nothing to compare."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self.pieces = [piece for run in runs for piece in run.split_at_gaps()]
        self.samples = practical_samples(self.pieces, MAX_SAMPLES)
        self.data: Trajectories = cut_into_trajectories(self.pieces, self.samples)

    def kick(self, drive: Drive) -> Array:
        """(n, batch) share of each step for which a kick lasts, of the stretches."""
        shares = []
        for piece in self.pieces:
            share, _ = drive.kick(piece.command, piece.step_s[:, np.newaxis], piece.command[0])
            shares.append(replace(piece, command=share))
        return cut_into_trajectories(shares, self.samples).command


class _Problem:
    """The free run of fans behind one drive. Unknowns (fans, 6): ln J, two ln dampings, DRIVE_PARAMETERS."""

    def __init__(
        self,
        runs: _Runs,
        drive: Drive,
        top_speed_rad_s: Array,
        highest_command: float,
        errors: ReadingErrors | None = None,
    ) -> None:
        """errors: of the readings; None: not known."""
        self._data, self._drive = runs.data, drive
        self.errors = errors or ReadingErrors.unknown(self._data.command.shape)
        self._share = runs.kick(drive)
        self._top_speed_rad_s = top_speed_rad_s
        self._fans = len(top_speed_rad_s)
        self._highest_command = highest_command
        self._initial = self._data.starting_speed_rad_s()
        self._guess = self._data.interpolated_speed_rad_s()

    def fit(
        self, unknowns: Array, free: NDArray[np.bool_], iterations: int, iteration_done: Callable[[], None]
    ) -> Array:
        """The unknowns after so many steps, each fan for itself, that lower the pseudo-Huber loss of its residual."""
        residual, speed = self._residual(unknowns)
        scale = robust_scale(residual, self._data)
        cost = self._cost(residual, scale)
        damping = np.full(self._fans, FIRST_DAMPING)
        held = np.flatnonzero(~free)
        for _ in range(iterations):
            squares, gradient = self._normal_equations(unknowns, speed, residual, scale)
            squares[:, held, :] = squares[:, :, held] = gradient[:, held] = 0.0
            diagonal = np.diagonal(squares, axis1=1, axis2=2)
            ridge = damping[:, np.newaxis] * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True)
            squares[:, np.arange(UNKNOWNS), np.arange(UNKNOWNS)] += np.where(diagonal > 0.0, ridge, 1.0)
            trial = self._within_bounds(unknowns + np.linalg.solve(squares, gradient[..., np.newaxis])[..., 0])
            of_trial, trial_speed = self._residual(trial)
            trial_cost = self._cost(of_trial, scale)
            better = trial_cost < cost
            damping = np.where(better, damping / DAMPING_DOWN, damping * DAMPING_UP)
            column = better[self._data.fan]
            unknowns = np.where(better[:, np.newaxis], trial, unknowns)
            residual, speed = np.where(column, of_trial, residual), np.where(column, trial_speed, speed)
            cost = np.where(better, trial_cost, cost)
            iteration_done()
        return unknowns

    def learn_errors(self, unknowns: Array) -> None:
        """Let readings have the errors that they have in the free run of these unknowns."""
        heavier = unknowns.copy()
        heavier[:, INERTIA] += HEAVIER
        data, speed = self._data, self._speed(unknowns)
        readings, of_heavier = data.measurement.of_speed(speed), data.measurement.of_speed(self._speed(heavier))
        with np.errstate(over="ignore", invalid="ignore"):
            errors, by_inertia = data.speed_rad_s - readings, of_heavier - readings
        self.errors = reading_errors(errors, speed, by_inertia, data, self.errors)

    def mean_square(self, unknowns: Array) -> float:
        """Mean square of the residual of all fans, (rad/s)^2."""
        residual, _ = self._residual(unknowns)
        return float(np.sum(residual**2) / np.count_nonzero(self._data.compared))

    def _residual(self, unknowns: Array) -> tuple[Array, Array]:
        """(n, batch) weighted readings less those expected, 0 where nothing is compared; and the free run's speeds."""
        data, speed = self._data, self._speed(unknowns)
        with np.errstate(over="ignore", invalid="ignore"):
            error = data.speed_rad_s - data.measurement.of_speed(speed) - self.errors.expected_rad_s
            return np.where(data.compared, self.errors.weight * error, 0.0), speed

    def _speed(self, unknowns: Array) -> Array:
        """(n, batch) rad/s of the free run."""
        equation, command = self._equation(unknowns)
        speed, _ = free_run(equation, self._initial, command, self._data.step_s, self._guess)
        return speed

    def _equation(self, unknowns: Array) -> tuple[FanEquation, Array]:
        fan = self._data.fan
        parameters = self._parameters(unknowns)[fan]
        return FanEquation(parameters, None), self._drive.effective(
            self._data.command, self._share, unknowns[fan][:, LAG:]
        )

    def _parameters(self, unknowns: Array) -> Array:
        return physical_parameters(_without_lag(unknowns), self._top_speed_rad_s)

    def _cost(self, residual: Array, scale: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore"):
            loss = np.hypot(1.0, residual / (HUBER_DELTA * scale[self._data.fan])) - 1.0
            cost = np.bincount(self._data.fan, loss.sum(axis=0), self._fans)
        return np.where(np.isfinite(cost), cost, np.inf)

    def _normal_equations(self, unknowns: Array, speed: Array, residual: Array, scale: Array) -> tuple[Array, Array]:
        """For each fan the weighted S^T S (fans, 6, 6) and S^T residual (fans, 6)."""
        data, fan = self._data, self._data.fan
        equation, command = self._equation(unknowns)
        by_speed, by_command, by_physics = rk4_step_derivatives(equation, speed[:-1], command[:-1], data.step_s[:-1])
        chain = parameters_by_unknowns(_without_lag(unknowns), self._top_speed_rad_s)[fan][:, :LAG, :LAG]
        by_settings = self._drive.by_settings(data.command, self._share, unknowns[fan][:, LAG:])
        forcing = np.zeros((*command.shape, UNKNOWNS))
        forcing[1:, :, :LAG] = np.einsum("nbp,bpq->nbq", by_physics, chain)
        forcing[1:, :, LAG:] = by_command[..., np.newaxis] * by_settings[:-1]
        readings = data.measurement.of_speed(linear_recursion(by_speed, forcing))
        sensitivity = (readings * self.errors.weight[..., np.newaxis]).transpose(1, 0, 2)
        weight = np.where(data.compared, 1.0 / np.hypot(1.0, residual / (HUBER_DELTA * scale[fan])), 0.0)
        weighted = sensitivity * weight.T[..., np.newaxis]
        squares, gradient = np.zeros((self._fans, UNKNOWNS, UNKNOWNS)), np.zeros((self._fans, UNKNOWNS))
        np.add.at(squares, fan, weighted.transpose(0, 2, 1) @ sensitivity)
        np.add.at(gradient, fan, np.einsum("bnp,nb->bp", weighted, residual))
        return squares, gradient

    def _within_bounds(self, unknowns: Array) -> Array:
        unknowns = unknowns.copy()
        turning, highest = self._drive.turning_command, self._highest_command
        unknowns[:, KICK] = unknowns[:, KICK].clip(0.0, 2.0 * highest)
        unknowns[:, FRICTION] = unknowns[:, FRICTION].clip(0.0, highest)
        unknowns[:, LOWEST] = unknowns[:, LOWEST].clip(turning, highest)
        return unknowns


def _without_lag(unknowns: Array) -> Array:
    return np.column_stack((unknowns[:, :LAG], np.zeros(len(unknowns))))
