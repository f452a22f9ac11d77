"""The static model of healthy runs (twin.models.static), and when it takes the place of one with motion.

Speeds at the knots are found by least squares for each time constant and each share of changes at an unknown time.
These two have the smallest mean absolute error: samples right after a change err by much, and must not decide.

Samples are too far apart for a model with motion where the time constant found is at most `SLOW` sample periods, and
the physical model explains the speeds no better: it takes a command to act from its sample on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear, minimize

from fantwin.schemas.tacho import INSTANTANEOUS
from fantwin.schemas.twin_card import BalanceCard
from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.damped_least_squares import Flags
from fantwin.twin.fitting.identification import Identification, in_a_loop
from fantwin.twin.fitting.reference_choice import LEAST_GAIN, AtReference
from fantwin.twin.models.static import STATIC_PARAMETERS, StaticModel, follow
from fantwin.twin.reference import at_reference, reference_of
from fantwin.twin.runs import Array, Run, common_fans

KNOTS = 12
SLOW = 1.1
"""time constant in sample periods up to which samples may be too far apart"""
FAST = 0.1
"""sample periods in a time constant of the physical model below which the static one is not tried"""
SHORTEST = 0.02
"""shortest time constant, in sample periods: a shorter one looks the same"""
STARTS = ((SHORTEST, 1.0), (SHORTEST, 0.0), (0.2, 1.0), (0.5, 1.0), (1.0, 1.0), (1.0, 0.0), (2.0, 0.5))
PART_SAMPLES, MOST_PARTS = 500, 12
"""samples of a part of the runs, and parts from which the time constant is found; speeds are from all"""
FORGETS, FEWEST = 3, 10
"""first samples of a part, which are not compared, and fewest of a fan that are"""
ROBUST_PASSES, HUBER = 3, 3.0
MAD = 1.4826
"""standard deviation of a normal distribution in its median absolute deviation"""
LEAST_R2 = 0.5
LARGEST_BALANCE_SPEED = 100.0
"""multiple of the top speed below which a static twin has no torque balance: that is for motion"""


@dataclass(frozen=True, eq=False)
class StaticFit:
    """The model, its parameters (fans, 2 + K), and of its errors on the runs the standard deviation without those right
    after changes, and the root mean square: (fans,) each."""

    model: StaticModel
    parameters: Array
    sigma_rad_s: Array
    rmse_rad_s: Array
    r2: Array
    top_speed_rad_s: Array
    closed_loop: Flags
    period_s: float

    @property
    def time_constant_s(self) -> Array:
        """(fans,); a shorter one than SHORTEST periods counts as that."""
        return self.parameters[:, 0]

    @property
    def error_rad_s(self) -> float:
        """Rms error of all fans, without the samples right after changes."""
        return float(np.sqrt(np.mean(self.sigma_rad_s**2)))

    @property
    def identification(self) -> Identification:
        """What the card says of the parameters: they have no interval."""
        fans, count = self.parameters.shape
        return Identification(
            parameters=self.parameters,
            covariance=np.zeros((fans, count, count)),
            degrees_of_freedom=np.ones((fans, count)),
            lambda_per_s=np.zeros(fans),
            rmse_rad_s=self.rmse_rad_s,
            time_constant_s=self.time_constant_s,
            top_speed_rad_s=self.top_speed_rad_s,
            iterations=0,
            warnings=(),
            misfits=(),
            closed_loop=self.closed_loop,
        )

    @property
    def balance(self) -> BalanceCard:
        """The torque that holds a steady speed, by the speeds at the knots; it is not judged, for it is for motion."""
        speeds, fans = self.parameters[:, len(STATIC_PARAMETERS) :], len(self.parameters)
        steady = np.array([_torque(of_fan, self.model.knots) for of_fan in speeds])
        slope = np.maximum(steady[:, 0] + 2.0 * steady[:, 1] * self.top_speed_rad_s, 1e-9)
        lowest = LARGEST_BALANCE_SPEED * self.top_speed_rad_s
        nothing = ((0.0,) * 4,) * 4
        return BalanceCard(
            inertia=tuple((slope * self.time_constant_s).tolist()),
            viscous=tuple(steady[:, 0].tolist()),
            drag=tuple(steady[:, 1].tolist()),
            friction=tuple(steady[:, 2].tolist()),
            covariance=(nothing,) * fans,  # type: ignore[arg-type]
            lag_s=(0.0,) * fans,
            source=("least-squares",) * fans,
            sigma_command=tuple((slope * self.sigma_rad_s).tolist()),
            autocorrelation_time_s=(self.period_s,) * fans,
            lowest_speed_rad_s=tuple(lowest.tolist()),
            filter_rate_per_s=1.0 / self.period_s,
        )


def fit_static(runs: Sequence[Run]) -> StaticFit:
    """The static model of every fan.

    Raises:
        TwinError: a command or a speed never changes, or only as a controller answers noise.
    """
    pieces = [piece for run in runs for piece in run.split_at_gaps()]
    closed_loop = np.array([in_a_loop(pieces, fan) for fan in range(common_fans(runs))])
    period_s = float(np.median(np.concatenate([np.diff(piece.t_s) for piece in pieces])))
    model = StaticModel(_knots(np.concatenate([piece.command.ravel() for piece in pieces])))
    fits = [_FanFit(model, pieces, fan, period_s) for fan in range(pieces[0].fans)]
    for fan, each in enumerate(fits):
        if len(each.measured()) < FEWEST:
            raise TwinError(f"fan {fan}: fewer than {FEWEST} measured speeds after steps without a gap")
    found = [each.best() for each in fits]
    residuals = [each.residual(parameters) for each, parameters in zip(fits, found, strict=True)]
    tops = [float(np.abs(each.measured()).max()) for each in fits]
    spread = np.array([np.var(each.measured()) for each in fits])
    squares = np.array([np.mean(residual**2) for residual in residuals])
    return StaticFit(
        model=model,
        parameters=np.array(found),
        sigma_rad_s=np.concatenate([typical_error_rad_s([each[:, np.newaxis]]) for each in residuals]),
        rmse_rad_s=np.sqrt(squares),
        r2=1.0 - squares / spread,
        top_speed_rad_s=np.array(tops),
        closed_loop=closed_loop,
        period_s=period_s,
    )


def as_read(runs: Sequence[Run]) -> list[Run]:
    """The runs for a model whose output is compared with the readings as they are, whatever tachos make of speeds."""
    return [replace(run, tacho=INSTANTANEOUS) for run in runs]


def static_at_reference(runs: Sequence[Run], validation_runs: Sequence[Run]) -> tuple[AtReference, StaticFit]:
    """The static model, at the reference conditions if it fits better at these. Raises as `fit_static`."""
    plain = as_read(runs)
    found = fit_static(at_reference(plain, None))
    conditions = reference_of([*runs, *validation_runs])
    if conditions is not None:
        with_conditions = fit_static(at_reference(plain, conditions))
        if with_conditions.error_rad_s < (1.0 - LEAST_GAIN) * found.error_rad_s:
            return AtReference(conditions, with_conditions.identification, ()), with_conditions
    return AtReference(None, found.identification, ()), found


def static_instead(
    runs: Sequence[Run], validation_runs: Sequence[Run], physical: AtReference | None
) -> tuple[AtReference, StaticFit] | None:
    """The static model if samples are too far apart for motion; None if they are not, or it does not fit, either.

    physical: of the same runs; None: the physical model does not follow them.
    """
    period_s = float(np.median([run.median_period_s for run in runs]))
    if physical is not None and period_s < FAST * float(np.median(physical.identification.time_constant_s)):
        return None
    try:
        found, static = static_at_reference(runs, validation_runs)
    except TwinError:
        return None
    if static.r2.min() < LEAST_R2 or np.median(static.time_constant_s) > SLOW * period_s:
        return None
    if physical is not None and np.any(static.rmse_rad_s > physical.identification.rmse_rad_s):
        return None
    return found, static


def typical_error_rad_s(residuals: Sequence[Array]) -> Array:
    """(fans,) standard deviation of residuals (samples, fans) as their median has it; 0 where there are none."""
    sizes = np.abs(np.concatenate(residuals))
    known = np.isfinite(sizes)
    return MAD * np.array(
        [float(np.median(of_fan[its])) if its.any() else 0.0 for of_fan, its in zip(sizes.T, known.T, strict=True)]
    )


def _knots(commands: Array) -> Array:
    """The commands themselves where they are few, else some of them, and the lowest and the highest."""
    levels = np.unique(commands)
    return levels if len(levels) <= KNOTS else np.quantile(levels, np.linspace(0.0, 1.0, KNOTS))


def _bends(knots: Array) -> Array:
    """(K - 2, K) rows that give the bend of a curve at each inner knot."""
    widths, rows = np.diff(knots), np.arange(len(knots) - 2)
    found = np.zeros((len(rows), len(knots)))
    found[rows, rows], found[rows, rows + 2] = widths[1:], widths[:-1]
    found[rows, rows + 1] = -(widths[1:] + widths[:-1])
    return found / (widths[1:] + widths[:-1])[:, np.newaxis]


class _FanFit:
    """The data of one fan, and its error for a time constant and a share of changes at an unknown time."""

    def __init__(self, model: StaticModel, pieces: Sequence[Run], fan: int, period_s: float) -> None:
        self._period_s = period_s
        parts = [piece.rows(*rows).fan(fan) for piece in pieces for rows in piece.equal_parts(PART_SAMPLES)]
        self._parts = [(model.hats(part.command[:, 0]), part.step_s, part.speed_rad_s[:, 0]) for part in parts]
        bends = _bends(model.knots)
        self._smooth = bends.T @ bends + 1e-9 * np.eye(len(model.knots))
        """weight of one sample at each inner knot, with the mean of its neighbours, for knots without samples"""
        self._some = self._parts[:: -(-len(parts) // MOST_PARTS)]

    def best(self) -> Array:
        """(2 + K,) the parameters."""
        near = sorted(STARTS, key=self._loss)[:2]
        options = {"maxiter": 40, "xatol": 0.02, "fatol": 1e-4}
        found = [minimize(self._loss, start, method="Nelder-Mead", options=options) for start in near]
        periods, unknown = _possible(min(found, key=lambda each: float(each.fun)).x)
        return np.array([periods * self._period_s, unknown, *self._speeds(periods, unknown, self._parts)[0]])

    def measured(self) -> Array:
        """All its readings that are compared."""
        return np.concatenate([speed[_is_known(speed)] for _, _, speed in self._parts])

    def residual(self, parameters: Array) -> Array:
        """These less what the model expects."""
        regressors = self._regressors(parameters[0] / self._period_s, parameters[1], self._parts)[0]
        return self.measured() - regressors @ parameters[len(STATIC_PARAMETERS) :]

    def _loss(self, unknowns: Array | tuple[float, float]) -> float:
        return self._speeds(*_possible(unknowns), self._some)[1]

    def _speeds(
        self, periods: float, unknown: float, parts: Sequence[tuple[Array, Array, Array]]
    ) -> tuple[Array, float]:
        """The speeds at the knots and the mean absolute error."""
        regressors, measured = self._regressors(periods, unknown, parts)
        weight = np.ones(len(measured))
        speeds: Array = np.zeros(regressors.shape[1])
        error = measured
        for _ in range(ROBUST_PASSES):
            weighted = regressors.T * weight
            speeds = np.asarray(np.linalg.solve(weighted @ regressors + self._smooth, weighted @ measured), np.float64)
            error = np.abs(measured - regressors @ speeds)
            weight = 1.0 / np.maximum(1.0, error / (HUBER * MAD * np.median(error) + 1e-9))
        return speeds, float(error.mean())

    def _regressors(
        self, periods: float, unknown: float, parts: Sequence[tuple[Array, Array, Array]]
    ) -> tuple[Array, Array]:
        """(samples, K) shares of the speeds at the knots in the expected readings, and the readings. A part starts at
        the steady speed of its command."""
        expected, measured = [], []
        for hats, step_s, speed in parts:
            unit = np.ones(hats.shape[1])
            steady = np.vstack((hats[:1], hats))
            of_part, _ = follow(steady, hats[0], step_s, periods * self._period_s * unit, unknown * unit)
            known = _is_known(speed)
            expected.append(of_part[known])
            measured.append(speed[known])
        return np.concatenate(expected), np.concatenate(measured)


def _is_known(speed_rad_s: Array) -> NDArray[np.bool_]:
    """Whether there is a reading, and the start of the part, which may not have been steady, is forgotten."""
    return np.isfinite(speed_rad_s) & (np.arange(len(speed_rad_s)) >= FORGETS)


def _possible(unknowns: Array | tuple[float, float]) -> tuple[float, float]:
    """The nearest time constant, in periods, and share that there can be."""
    return max(float(unknowns[0]), SHORTEST), min(max(float(unknowns[1]), 0.0), 1.0)


def _torque(speeds_rad_s: Array, commands: Array) -> Array:
    """(3,) viscous, drag and friction of the command that holds a speed, the first two not below zero."""
    terms = np.column_stack((speeds_rad_s, speeds_rad_s * np.abs(speeds_rad_s), np.ones(len(commands))))
    size = np.abs(terms).max(axis=0) + np.finfo(float).tiny
    return lsq_linear(terms / size, commands, ([0.0, 0.0, -np.inf], np.inf), method="bvls").x / size
