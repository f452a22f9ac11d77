"""Fans of a known type: each fan's own physics from a few minutes of its running; the network is that of the type.

A twin that was trained on some fans of a type says what they have in common, its network, and how far their physics are
apart: mean and standard deviation of the unknowns of twin.models.physical. Those of another fan of the type are a draw
from there. They are estimated from its own free run and that distribution together, as the random effects of a
nonlinear mixed-effects model (Lindstrom and Bates, Biometrics 46, 1990), at its mode: where a fan has shown little, it
is taken as typical. The standard errors are those of the quadratic at the mode.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fantwin.schemas.twin_card import TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.free_run_fit import FreeRunFit, fit_physics
from fantwin.twin.fitting.free_run_problem import (
    ALL_FREE,
    FreeRunProblem,
    Prior,
    sums_by_fan,
    without_initial_speeds,
)
from fantwin.twin.fitting.identifiability import feedback_share
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.fitting.reading_errors import robust_scale
from fantwin.twin.fitting.trajectories import Trajectories, cut_into_trajectories, stretch_samples
from fantwin.twin.models import physics
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.models.physical import PhysicalModel, fitted_unknowns, parameters_by_unknowns, physical_parameters
from fantwin.twin.models.physics import LAG, PARAMETER_NAMES
from fantwin.twin.models.right_hand_side import FanEquation
from fantwin.twin.progress import Progress
from fantwin.twin.runs import Array, Run, common_fans

STRETCH_TIME_CONSTANTS = 10.0
ASSUMED_SPREAD, ASSUMED_FANS = 0.1, 2.0
"""how far fans of a type are taken to be apart before any is known, relative, and the number of fans that this counts
as: two or three fans of a type may be alike by chance"""
NOT_OF_TYPE = 5.0
"""standard deviations of a type: a fan whose physics are further from the mean is probably another one, or faulty"""
ENOUGH_READINGS = 100


@dataclass(frozen=True)
class _FixedNetwork(PhysicalModel):
    """Physics beside a network whose weights are not fitted."""

    fixed_network: TanhNetwork | None = None

    def equation(self, parameters: Array) -> FanEquation:
        """w' of a batch of fans with the physical parameters (batch, 4)."""
        return FanEquation(parameters, self.fixed_network, has_free_weights=False)


@dataclass(frozen=True, eq=False)
class TypeOfFans:
    """The unknowns of the physics among fans of a type: mean, std (4,). top_speed_rad_s: of them all."""

    mean: Array
    std: Array
    top_speed_rad_s: float

    @classmethod
    def of_card(cls, card: TwinCard) -> "TypeOfFans":
        """By the fans that a twin was trained on. A lag that none of them has is none of the type."""
        parameters = np.array(card.parameters)[:, : len(PARAMETER_NAMES)]
        top_speed_rad_s = card.top_speed_rad_s
        unknowns = fitted_unknowns(parameters, np.full(len(parameters), top_speed_rad_s))
        mean = unknowns.mean(axis=0)
        assumed_std = np.full(len(PARAMETER_NAMES), ASSUMED_SPREAD)
        assumed_std[LAG] *= mean[LAG]
        squares = np.sum((unknowns - mean) ** 2, axis=0) + ASSUMED_FANS * assumed_std**2
        return cls(mean, np.sqrt(squares / (len(unknowns) - 1 + ASSUMED_FANS)), top_speed_rad_s)


def place_fans(
    network: TanhNetwork, card: TwinCard, runs: Sequence[Run], correlated_samples: float, progress: Progress
) -> tuple[Identification, Array]:
    """The physics of the fans of some runs, and (fans, 4, 4) the covariance of their unknowns.

    network, card: of the twin of the type. runs: with the commands that act on the fans. correlated_samples: of the
    residual of a healthy fan, so many samples count as one.

    Raises:
        TwinError: a fan has hardly any readings.
    """
    fans = common_fans(runs)
    pieces = [piece for run in runs for piece in run.split_at_gaps()]
    for fan in range(fans):
        if sum(int(np.isfinite(piece.speed_rad_s[:, fan]).sum()) for piece in pieces) < ENOUGH_READINGS:
            raise TwinError(f"fan {fan}: fewer than {ENOUGH_READINGS} measured speeds; check the speed column")
    of_type = TypeOfFans.of_card(card)
    top_speed_rad_s = np.full(fans, of_type.top_speed_rad_s)
    typical = np.tile(of_type.mean, (fans, 1))
    typical_speed = np.full(fans, of_type.top_speed_rad_s / 2.0)
    tau_s = physics.time_constant_s(typical_speed, physical_parameters(typical, top_speed_rad_s))
    step_s = min(piece.median_period_s for piece in pieces)
    stretches = cut_into_trajectories(pieces, stretch_samples(float(tau_s.max()), step_s, STRETCH_TIME_CONSTANTS))
    free = ALL_FREE.copy()
    free[LAG] = of_type.std[LAG] > 0.0
    precision = np.where(free, correlated_samples / np.where(free, of_type.std, 1.0) ** 2, 0.0)
    problem = FreeRunProblem(
        _FixedNetwork(fixed_network=network), stretches, top_speed_rad_s, free, Prior(0.0, precision, typical)
    )
    found = fit_physics(problem, typical, "placing", progress)
    of_unknowns = _covariance(replace(problem, free=free), found, correlated_samples)
    unknowns = found.point.unknowns.physics
    chain = parameters_by_unknowns(unknowns, top_speed_rad_s)
    parameters = physical_parameters(unknowns, top_speed_rad_s)
    identification = Identification(
        parameters=parameters,
        covariance=chain @ of_unknowns @ chain.transpose(0, 2, 1),
        degrees_of_freedom=np.full(parameters.shape, np.inf),
        lambda_per_s=np.full(fans, np.nan),
        rmse_rad_s=stretches.rms_of_fans(found.error_rad_s),
        time_constant_s=physics.time_constant_s(typical_speed, parameters),
        top_speed_rad_s=top_speed_rad_s,
        iterations=found.iterations,
        warnings=_strangers(unknowns, of_type),
        misfits=(),
        closed_loop=np.array([feedback_share(pieces, fan) > 0.0 for fan in range(fans)]),
    )
    return identification, of_unknowns


def _covariance(problem: FreeRunProblem, fit: FreeRunFit, correlated_samples: float) -> Array:
    """(fans, 4, 4) of the unknowns, by the curvature at the mode; zero for one that is held."""
    data: Trajectories = problem.trajectories
    problem.scale_rad_s = robust_scale(fit.error_rad_s, data)
    squares, _ = problem.normal_equations(fit.point)
    own, _ = without_initial_speeds(squares, squares[:, -1, -1])
    curvature = sums_by_fan(own, data.fan, problem.fans)
    curvature = (curvature + np.diag(problem.prior.physics)) / correlated_samples
    free = np.flatnonzero(problem.free)
    covariance = np.zeros_like(curvature)
    covariance[:, free[:, np.newaxis], free] = np.linalg.inv(curvature[:, free[:, np.newaxis], free])
    return covariance


def _strangers(unknowns: Array, of_type: TypeOfFans) -> tuple[str, ...]:
    """Fans whose physics are far from those of the type."""
    std = np.where(of_type.std > 0.0, of_type.std, np.inf)
    distance = np.abs(unknowns - of_type.mean) / std
    names = ("inertia", "damping at rest", "damping at top speed", "lag")
    return tuple(
        f"fan {fan}: its {names[worst]} is {distance[fan, worst]:.0f} standard deviations from that of its type: it is "
        "another type of fan, or faulty"
        for fan, worst in enumerate(np.argmax(distance, axis=1).tolist())
        if distance[fan, worst] > NOT_OF_TYPE
    )
