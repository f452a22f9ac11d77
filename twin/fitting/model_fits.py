"""The fit of each kind of model: one call for all of them, from runs and the identified physics to a trained model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import evaluation_pieces
from fantwin.twin.fitting import narx_training
from fantwin.twin.fitting.cross_validation import choose_prior_std
from fantwin.twin.fitting.drive_fit import FoundDrive
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.fitting.initial_weights import initial_weights
from fantwin.twin.fitting.static_fit import StaticFit
from fantwin.twin.fitting.training import GRID_PRIOR_STD, MAX_ITERATIONS, data_scaling, train_network
from fantwin.twin.models.fan_ode import FanOde, NetworkOde
from fantwin.twin.models.model import Model
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.network_training import ForEachNetwork, one_after_another
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.runs import Array, Run

Trainer = Literal["levenberg-marquardt", "adam"]

SILENT_NETWORK = "the network is not used: free runs with it were no better than those of the physics alone"


@dataclass(frozen=True, eq=False)
class FitRequest:
    """Data and settings of a fit. See build.train_twin; max_iterations None: the default of the fit.

    drive: what the commands of the runs have passed already; the model is put behind it. networks,
    each_network: see training.train_network. static: of a static model, which is fitted before all else.
    """

    runs: Sequence[Run]
    validation_runs: Sequence[Run]
    identification: Identification
    seed: int = 0
    trainer: Trainer = "levenberg-marquardt"
    max_iterations: int | None = None
    progress: Progress = unreported
    drive: FoundDrive | None = None
    networks: int = 1
    each_network: ForEachNetwork = one_after_another
    static: StaticFit | None = None


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted model. parameters: each fan's own, (fans, 4), behind a drive (fans, 7).

    is_refined: its physics were fitted along with the network.
    """

    model: Model
    parameters: Array
    iterations: int
    is_refined: bool = False
    warnings: tuple[str, ...] = ()


def fit_physical(request: FitRequest) -> FittedModel:
    """The identified physics as they are, with what they fail to describe as warnings."""
    found = request.identification
    model, parameters = _behind(request.drive, PhysicalModel(), found.parameters)
    return FittedModel(model, parameters, found.iterations, warnings=found.misfits)


def fit_static_model(request: FitRequest) -> FittedModel:
    """The static model, which was found in place of the physics."""
    assert request.static is not None
    return FittedModel(request.static.model, request.static.parameters, iterations=0)


def fit_narx(request: FitRequest) -> FittedModel:
    """Levenberg-Marquardt on the free run (twin.fitting.narx_training)."""
    narx, iterations = narx_training.train_narx(
        request.runs,
        request.validation_runs,
        data_scaling(request.runs, request.identification),
        seed=request.seed,
        max_iterations=request.max_iterations or narx_training.MAX_ITERATIONS,
        progress=request.progress,
    )
    return FittedModel(narx, request.identification.parameters, iterations)


def fit_network_ode(
    request: FitRequest,
    make: Callable[[TanhNetwork], NetworkOde],
    units: int,
    inputs: tuple[str, ...] = ("speed", "command"),
) -> FittedModel:
    """Fit a model whose network has these units and inputs, by the trainer of the request."""
    scaling = data_scaling(request.runs, request.identification)
    untrained = make(TanhNetwork.zero(units, inputs, scaling))
    train = _by_adam if request.trainer == "adam" else _by_levenberg_marquardt
    model, parameters, iterations = train(untrained, request)
    silent = model.has_physics and not np.any(model.theta)
    driven, parameters = _behind(request.drive, model, parameters)
    return FittedModel(
        driven,
        parameters,
        iterations,
        is_refined=model.has_physics and request.trainer == "levenberg-marquardt",
        warnings=(SILENT_NETWORK,) if silent else (),
    )


def _behind(drive: FoundDrive | None, model: FanOde, parameters: Array) -> tuple[FanOde, Array]:
    if drive is None:
        return model, parameters
    return model.with_drive(drive.drive), np.hstack((parameters, drive.settings))


def _by_adam(untrained: NetworkOde, request: FitRequest) -> tuple[NetworkOde, Array, int]:
    """The published recipe. The physics stay as identified. Raises TwinError for tachos that average."""
    if any(tacho.reach_s > 0.0 for run in request.runs for tacho in run.tacho):
        raise TwinError(
            "trainer 'adam' takes readings for speeds, which a counting tacho's are not; use levenberg-marquardt"
        )
    # torch is needed by this trainer alone, and takes seconds to import.
    from fantwin.twin.fitting import torch_reference  # noqa: PLC0415

    found = request.identification
    (theta,) = initial_weights(
        untrained, evaluation_pieces(request.runs), found, np.random.default_rng(request.seed), 1
    )
    start = untrained.with_theta(theta)
    limit = request.max_iterations or torch_reference.MAX_ITERATIONS
    model, iterations = torch_reference.train_adam(
        start, request.runs, found, max_iterations=limit, progress=request.progress
    )
    return model, found.parameters, iterations


def _by_levenberg_marquardt(untrained: NetworkOde, request: FitRequest) -> tuple[NetworkOde, Array, int]:
    prior_std = GRID_PRIOR_STD
    if not request.validation_runs:
        prior_std = choose_prior_std(untrained, request.runs, seed=request.seed, progress=request.progress)
    return train_network(
        untrained,
        request.runs,
        request.validation_runs,
        request.identification,
        max_iterations=request.max_iterations or MAX_ITERATIONS,
        seed=request.seed,
        prior_std=prior_std,
        networks=request.networks,
        each=request.each_network,
        progress=request.progress,
    )
