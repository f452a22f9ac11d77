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

from fantwin.schemas.standstill import Standstill
from fantwin.schemas.twin_card import DriveCard
from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.damped_least_squares import Flags, minimise
from fantwin.twin.fitting.free_run_fit import ERROR_ROUNDS
from fantwin.twin.fitting.free_run_problem import INERTIA, FreeRunProblem, Point, Unknowns
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.fitting.trajectories import MAX_SAMPLES, Trajectories, cut_into_trajectories, practical_samples
from fantwin.twin.models.drive import DRIVE_PARAMETERS, Drive
from fantwin.twin.models.physical import (
    PhysicalModel,
    fitted_unknowns,
    parameters_by_unknowns,
    physical_parameters,
)
from fantwin.twin.models.physics import LAG
from fantwin.twin.models.right_hand_side import FanEquation
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.runs import Array, Run

FEWEST_STARTS = 3
LEAST_GAIN = 0.07
"""a share of the free-run error"""
KICKS_S, RESTS_S = (0.3, 0.6, 1.2), (1.0, 2.0, 4.0)
FIRST_ITERATIONS, MORE_ITERATIONS = 12, 5
MOST_ITERATIONS = 2 * FIRST_ITERATIONS + (len(KICKS_S) + len(RESTS_S) + 2 * ERROR_ROUNDS) * MORE_ITERATIONS
FIRST_PLATEAU, FIRST_KICK = 0.05, 0.5
"""shares of the range of commands above the lowest that turns the fans"""
LOWEST, FRICTION, KICK = (LAG + index for index in range(len(DRIVE_PARAMETERS)))
UNKNOWNS = LAG + len(DRIVE_PARAMETERS)
NO_WEIGHTS = np.zeros(0)


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
    def friction(self) -> Array:
        """The part of each fan's command (fans,) that the drive takes off before it acts."""
        return self.settings[:, DRIVE_PARAMETERS.index("friction")]

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
    turns = [run.command >= turning for run in runs]
    starts = np.sum([np.count_nonzero(~is_on[:-1] & is_on[1:], axis=0) for is_on in turns], axis=0)
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

    def behind(drive: Drive, runs: _Runs = learned) -> _Problem:
        return _Problem(runs, drive, plain.top_speed_rad_s, highest)

    start = np.zeros((len(plain.parameters), UNKNOWNS))
    start[:, :LAG] = fitted_unknowns(plain.parameters, plain.top_speed_rad_s)[:, :LAG]
    without = np.arange(UNKNOWNS) < LAG
    without[FRICTION] = True
    drive = Drive(turning, KICKS_S[1], RESTS_S[1])
    never = replace(drive, rest_s=np.inf)
    of_friction, _ = behind(never).fit(start, without, FIRST_ITERATIONS, iteration_done)
    start = of_friction.copy()
    # A plateau below all commands would have no effect, and so no derivative.
    start[:, LOWEST] = standstill.turning_command + FIRST_PLATEAU * (highest - standstill.turning_command)
    start[:, KICK] = turning + FIRST_KICK * (highest - turning)
    everything = np.ones(UNKNOWNS, np.bool_)
    best, loss = behind(drive).fit(start, everything, FIRST_ITERATIONS, iteration_done)
    for name, ladder in (("kick_s", KICKS_S), ("rest_s", RESTS_S)):
        for value in ladder:
            if value == getattr(drive, name):
                continue
            other = replace(drive, **{name: value})
            unknowns, of_other = behind(other).fit(best, everything, MORE_ITERATIONS, iteration_done)
            if of_other < loss:
                best, loss, drive = unknowns, of_other, other
    # Inertia and kick show while the speed changes, when readings say little of the rest.
    steady = everything.copy()
    steady[[INERTIA, KICK]] = False

    def steadied(drive: Drive, unknowns: Array, free: Flags) -> Array:
        problem = behind(drive)
        for _ in range(ERROR_ROUNDS):
            problem.learn_errors(problem.point(NO_WEIGHTS, unknowns))
            unknowns, _ = problem.fit(unknowns, free & steady, MORE_ITERATIONS, iteration_done)
        return unknowns

    final, of_friction = steadied(drive, best, everything), steadied(never, of_friction, without)
    with_drive, friction_alone = behind(drive, judged), behind(never, judged)
    with_drive.learn_errors(with_drive.point(NO_WEIGHTS, final))
    friction_alone.errors = with_drive.errors
    if not with_drive.mean_square(final) < (1.0 - LEAST_GAIN) ** 2 * friction_alone.mean_square(of_friction):
        return None
    return FoundDrive(drive, final[:, LAG:])


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


class _Problem(FreeRunProblem):
    """The free run of fans behind one drive. Physics unknowns (fans, 6): ln J, two ln dampings, DRIVE_PARAMETERS."""

    def __init__(self, runs: _Runs, drive: Drive, top_speed_rad_s: Array, highest_command: float) -> None:
        everything = np.ones(UNKNOWNS, np.bool_)
        super().__init__(PhysicalModel(), runs.data, top_speed_rad_s, everything, estimate_initial_speed=False)
        self._drive, self._share = drive, runs.kick(drive)
        self._highest_command = highest_command

    def fit(
        self, physics: Array, free: Flags, iterations: int, iteration_done: Callable[[], None]
    ) -> tuple[Array, float]:
        """The unknowns after at most so many steps of the free ones, and the mean square of their residual."""
        self.free = free

        def accepted(_iteration: int, _point: Point) -> bool:
            iteration_done()
            return False

        start = self.rescaled(self.point(NO_WEIGHTS, physics))
        point, _, _ = minimise(self, start, iterations, 0.0, accepted)
        return point.unknowns.physics, self._mean_square(point)

    def mean_square(self, physics: Array) -> float:
        """Mean square of the residual of all fans, (rad/s)^2."""
        return self._mean_square(self.point(NO_WEIGHTS, physics))

    def _mean_square(self, point: Point) -> float:
        return float(np.sum(point.residual**2) / np.count_nonzero(self.trajectories.compared))

    def equation(self, unknowns: Unknowns, part: slice) -> tuple[FanEquation, Array]:
        data = self.trajectories
        fan = data.fan[part]
        parameters = physical_parameters(_without_lag(unknowns.physics), self.top_speed_rad_s)[fan]
        settings = unknowns.physics[fan, LAG:]
        return FanEquation(parameters, None), self._drive.effective(
            data.command[:, part], self._share[:, part], settings
        )

    def command_by_unknowns(self, unknowns: Unknowns, part: slice) -> Array:
        data = self.trajectories
        settings = unknowns.physics[data.fan[part], LAG:]
        return self._drive.by_settings(data.command[:, part], self._share[:, part], settings)

    def parameters_by_unknowns(self, unknowns: Unknowns) -> Array:
        chain = np.tile(np.eye(UNKNOWNS), (self.fans, 1, 1))
        of_physics = parameters_by_unknowns(_without_lag(unknowns.physics), self.top_speed_rad_s)
        chain[:, :LAG, :LAG] = of_physics[:, :LAG, :LAG]
        return chain

    def within_bounds(self, physics: Array) -> Array:
        turning, highest = self._drive.turning_command, self._highest_command
        lowest = {KICK: 0.0, FRICTION: 0.0, LOWEST: turning}
        for column, least in lowest.items():
            most = 2.0 * highest if column == KICK else highest
            physics[:, column] = physics[:, column].clip(least, most)
        return physics

    def at_bounds(self, physics: Array, downhill: Array) -> Flags:
        return np.zeros(physics.shape, np.bool_)


def _without_lag(physics: Array) -> Array:
    return np.column_stack((physics[:, :LAG], np.zeros(len(physics))))
