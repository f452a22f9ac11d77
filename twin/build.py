"""From measured runs to a twin with its card: identify, train, validate, export."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from twin.errors import TwinError
from twin.evaluation.accuracy import (
    Evaluation,
    Figures,
    evaluate_model,
    evaluation_pieces,
    free_run_residuals,
)
from twin.evaluation.residual_analysis import QUANTILES, HealthyResidual, healthy_residual
from twin.export.card import BalanceCard, Card, DataCard, HealthyCard, NetworkCard, TrainingCard, ValidationCard
from twin.export.onnx_export import export_onnx
from twin.export.onnx_twin import OnnxTwin
from twin.fitting.balance import FILTER_RATE_PER_S
from twin.fitting.balance_fit import BalanceFit, fit_balance
from twin.fitting.cross_validation import chosen_spread
from twin.fitting.identification import Identification, identify
from twin.fitting.initial_weights import initial_weights
from twin.fitting.narx_training import train_narx
from twin.fitting.training import GRID_SPREAD, Physics, Progress, data_scaling, train_network
from twin.models.hybrid import UNITS as HYBRID_UNITS
from twin.models.hybrid import Hybrid
from twin.models.model import KINDS, Kind, Model, NetworkOde
from twin.models.narx import PARAMETER_COUNT, Narx
from twin.models.narx import UNITS as NARX_UNITS
from twin.models.network import TanhNetwork
from twin.models.neural_ode import UNITS as NEURAL_ODE_UNITS
from twin.models.neural_ode import NeuralOde
from twin.models.physical import PhysicalModel
from twin.models.physics import PARAMETER_NAMES
from twin.runs import Array, Run, common_fans

Trainer = Literal["levenberg-marquardt", "adam"]
NETWORK_UNITS: dict[Kind, int] = {"neural-ode": NEURAL_ODE_UNITS, "hybrid": HYBRID_UNITS}
DEFAULT_ITERATIONS: dict[Trainer, int] = {"levenberg-marquardt": 120, "adam": 400}
NARX_ITERATIONS = 100


@dataclass(frozen=True, eq=False)
class TrainedTwin:
    """A model with everything that is known about it. parameters: (fans, 4)."""

    model: Model
    parameters: Array
    card: Card
    identification: Identification
    validation: Evaluation

    def save(self, path: str | Path) -> Path:
        """Write the ONNX file; returns its path. Raises TwinError when it cannot be written."""
        target = Path(path)
        try:
            target.write_bytes(export_onnx(self.model, self.card))
        except OSError as error:
            raise TwinError(f"{target}: cannot be written ({error.strerror}); choose another place") from error
        return target


def train_twin(
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    kind: Kind,
    *,
    name: str,
    seed: int = 0,
    trainer: Trainer = "levenberg-marquardt",
    max_iterations: int | None = None,
    network_inputs: tuple[str, ...] = ("speed", "command"),
    physics: Physics = "refined",
    command_unit: str = "",
    fan_numbers: Sequence[int] | None = None,
    data: Sequence[DataCard] = (),
    validation_data: Sequence[DataCard] = (),
    created: datetime | None = None,
    progress: Progress | None = None,
) -> TrainedTwin:
    """Build a twin of healthy runs.

    validation_runs: held out of the fit; they choose the best weights and give the healthy sigmas and the card's
    figures. Empty: the training runs do, and the card says so. network_inputs: of the hybrid's and neural ODE's
    network. physics: whether a hybrid's physics are refined along with its network, or stay as they were identified.
    trainer "adam" leaves them as they were, and its weights are those that did best in training.
    fan_numbers (what the recordings call the runs' fans; default: counted from 0), command_unit, data and
    validation_data (the files that the runs are from) and created (default: now) go into the card. The same seed and
    runs give the same model.
    Raises TwinError when the runs do not tell the parameters, or the result cannot serve as a twin.
    """
    _require_known(kind, trainer)
    fans = common_fans([*runs, *validation_runs])
    numbers = tuple(range(fans) if fan_numbers is None else fan_numbers)
    started_s = time.monotonic()
    identification = identify(runs)
    limit = max_iterations or (NARX_ITERATIONS if kind == "narx" else DEFAULT_ITERATIONS[trainer])
    model, parameters, iterations = _train(
        kind, runs, validation_runs, identification, seed, trainer, limit, network_inputs, physics, progress
    )
    duration_s = time.monotonic() - started_s
    if kind == "physical":
        identification = replace(identification, warnings=(*identification.warnings, *identification.misfits))
    if isinstance(model, Hybrid) and not np.any(model.network.theta):
        silent = "the network stays silent: free runs with it were no better than those of the physics alone"
        identification = replace(identification, warnings=(*identification.warnings, silent))
    judged = validation_runs or runs
    pieces = evaluation_pieces(judged)
    healthy = healthy_residual(free_run_residuals(model, parameters, pieces), pieces)
    sigma_rad_s = np.array(healthy.sigma_rad_s)
    unmeasured = np.flatnonzero(sigma_rad_s == 0.0)
    if unmeasured.size:
        where = "held-out" if validation_runs else "training"
        raise TwinError(
            f"fan {unmeasured[0]}: no measured speed in the {where} runs, so no band; give runs in which it was "
            "measured, or leave it out"
        )
    if not np.all(np.isfinite(sigma_rad_s)):
        raise TwinError(
            f"the {kind} model of {name!r} diverges when run freely; record more levels, or try another kind"
        )
    validation = evaluate_model(model, parameters, sigma_rad_s, judged)
    balance = fit_balance(runs, validation_runs, identification)
    speeds = np.concatenate([run.speed_rad_s.ravel() for run in runs])
    commands = np.concatenate([run.command.ravel() for run in runs])
    moved: Physics = physics if kind == "hybrid" and trainer == "levenberg-marquardt" else "fixed"
    card = Card(
        kind=kind,
        name=name,
        created=(created or datetime.now(UTC)).isoformat(timespec="seconds"),
        fans=fans,
        n_state=model.state_layout.size,
        state_layout=model.state_layout,
        parameter_names=PARAMETER_NAMES,
        parameters=_rows(parameters),
        identified_parameters=_rows(identification.parameters),
        parameter_std_errors=_rows(identification.standard_errors),
        parameter_interval_95=tuple(
            tuple((float(low), float(high)) for low, high in fan) for fan in identification.interval_95
        ),
        sigma_rad_s=healthy.sigma_rad_s,
        healthy=_healthy_card(healthy),
        balance=_balance_card(balance),
        speed_range_rad_s=(float(np.nanmin(speeds)), float(np.nanmax(speeds))),
        command_range=(float(commands.min()), float(commands.max())),
        rate_hz=1.0 / float(np.median(np.concatenate([np.diff(run.t_s) for run in runs]))),
        network=_network_card(model),
        training=TrainingCard(trainer, moved, seed, iterations, round(duration_s, 3), tuple(data), numbers),
        validation=_validation_card(
            validation.pooled, "held-out" if validation_runs else "training", tuple(validation_data)
        ),
        versions=_versions(),
        command_unit=command_unit,
    )
    return TrainedTwin(model, parameters, card, identification, validation)


def evaluate(
    twin: str | Path | OnnxTwin | TrainedTwin, runs: Sequence[Run], fan_numbers: Sequence[int] | None = None
) -> Evaluation:
    """Figures of a twin, or of its file, on runs.

    fan_numbers: what the recordings call the runs' fans, as card.Card.rows wants them. A twin of one fan serves any.
    Raises TwinError when the fans do not fit.
    """
    loaded = OnnxTwin(twin) if isinstance(twin, str | Path) else twin
    model = loaded if isinstance(loaded, OnnxTwin) else loaded.model
    rows = loaded.card.rows(common_fans(runs), fan_numbers)
    return evaluate_model(model, loaded.parameters[rows], np.array(loaded.card.sigma_rad_s)[rows], runs)


def _require_known(kind: str, trainer: str) -> None:
    if kind not in KINDS:
        raise TwinError(f"kind {kind!r} is unknown; use one of {', '.join(KINDS)}")
    if trainer not in get_args(Trainer):
        raise TwinError(f"trainer {trainer!r} is unknown; use one of {', '.join(get_args(Trainer))}")
    if trainer == "adam" and kind not in NETWORK_UNITS:
        raise TwinError(f"trainer 'adam' cannot train the {kind} model; use levenberg-marquardt")


def _train(
    kind: Kind,
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    identification: Identification,
    seed: int,
    trainer: Trainer,
    max_iterations: int,
    network_inputs: tuple[str, ...],
    physics: Physics,
    progress: Progress | None,
) -> tuple[Model, Array, int]:
    if kind == "physical":
        return PhysicalModel(), identification.parameters, identification.iterations
    scaling = data_scaling(runs, identification)
    if kind == "narx":
        narx, iterations = train_narx(
            runs, validation_runs, scaling, seed=seed, max_iterations=max_iterations, progress=progress
        )
        return narx, identification.parameters, iterations
    units = NETWORK_UNITS[kind]
    network = TanhNetwork.zero(units, network_inputs, scaling)
    untrained: NetworkOde = Hybrid(network) if kind == "hybrid" else NeuralOde(network)
    if trainer == "adam":
        # torch is needed by this trainer alone, and takes seconds to import.
        from twin.fitting.torch_reference import train_adam  # noqa: PLC0415

        pieces = evaluation_pieces(runs)
        (theta,) = initial_weights(untrained, pieces, identification, np.random.default_rng(seed), 1)
        start = untrained.with_theta(theta)
        model, iterations = train_adam(start, runs, identification, max_iterations=max_iterations, progress=progress)
        return model, identification.parameters, iterations
    spread = GRID_SPREAD
    if not validation_runs:
        spread = chosen_spread(untrained, runs, seed=seed, physics=physics, progress=progress)
    return train_network(
        untrained,
        runs,
        validation_runs,
        identification,
        max_iterations=max_iterations,
        seed=seed,
        physics=physics,
        spread=spread,
        progress=progress,
    )


def _network_card(model: Model) -> NetworkCard:
    if isinstance(model, PhysicalModel):
        return NetworkCard(units=0, inputs=(), parameter_count=0)
    if isinstance(model, Narx):
        return NetworkCard(units=NARX_UNITS, inputs=("speed", "command"), parameter_count=PARAMETER_COUNT)
    return NetworkCard(model.network.units, model.network.inputs, model.network.parameter_count)


def _healthy_card(healthy: HealthyResidual) -> HealthyCard:
    return HealthyCard(
        autocorrelation_time_s=tuple(map(_finite, healthy.autocorrelation_time_s)),
        independent_samples=tuple(map(_finite, healthy.independent_samples)),
        probabilities=QUANTILES,
        quantiles_sigma=tuple(tuple(map(_finite, fan)) for fan in healthy.quantiles_sigma),
        max_sigma=tuple(map(_finite, healthy.max_sigma)),
    )


def _balance_card(balance: BalanceFit) -> BalanceCard:
    inertia, viscous, drag, friction = (tuple(column) for column in balance.coefficients.T.tolist())
    return BalanceCard(
        inertia=inertia,
        viscous=viscous,
        drag=drag,
        friction=friction,
        std_errors=_fours(balance.std_errors),
        covariance=tuple(_fours(of_fan) for of_fan in balance.covariance),
        lag_s=tuple(balance.lag_s.tolist()),
        source=balance.sources,
        sigma_command=tuple(balance.sigma_command.tolist()),
        autocorrelation_time_s=tuple(balance.autocorrelation_time_s.tolist()),
        lowest_speed_rad_s=tuple(balance.lowest_speed_rad_s.tolist()),
        filter_rate_per_s=FILTER_RATE_PER_S,
    )


def _fours(rows: Array) -> tuple[tuple[float, float, float, float], ...]:
    return tuple((row[0], row[1], row[2], row[3]) for row in rows.tolist())


def _validation_card(
    figures: Figures, source: Literal["held-out", "training"], data: tuple[DataCard, ...]
) -> ValidationCard:
    return ValidationCard(
        source=source,
        data=data,
        samples=figures.samples,
        rmse=_finite(figures.rmse_rad_s),
        max_error=_finite(figures.max_error_rad_s),
        r2=_finite(figures.r2),
        one_step_rmse=_finite(figures.one_step_rmse_rad_s),
        coverage_2_sigma=_finite(figures.coverage_2_sigma),
    )


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _versions() -> dict[str, str]:
    return {package: _version(package) for package in ("fantwin", "numpy", "onnx")}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        # Run from a checkout that was never installed.
        return "unknown"


def _rows(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in values.tolist())
