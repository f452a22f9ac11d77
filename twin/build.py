"""From measured runs to a twin with its card: identify, train, validate, export."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from twin.card import Card, DataCard, NetworkCard, TrainingCard, ValidationCard
from twin.errors import TwinError
from twin.evaluation import (
    Evaluation,
    Figures,
    evaluate_model,
    evaluation_pieces,
    free_run_residuals,
    healthy_sigma_rad_s,
)
from twin.export import export_onnx
from twin.hybrid import UNITS as HYBRID_UNITS
from twin.hybrid import Hybrid
from twin.identification import Identification, identify
from twin.models import KINDS, Kind, Model, NetworkOde
from twin.narx import PARAMETER_COUNT, Narx
from twin.narx import UNITS as NARX_UNITS
from twin.narx_training import train_narx
from twin.network import TanhNetwork
from twin.neural_ode import UNITS as NEURAL_ODE_UNITS
from twin.neural_ode import NeuralOde
from twin.onnx_twin import OnnxTwin
from twin.physical import PhysicalModel
from twin.physics import PARAMETER_NAMES
from twin.runs import Array, Run, common_fans
from twin.training import Progress, data_scaling, initial_weights, train_network

Trainer = Literal["levenberg-marquardt", "adam"]
NETWORK_UNITS: dict[Kind, int] = {"neural-ode": NEURAL_ODE_UNITS, "hybrid": HYBRID_UNITS}
DEFAULT_ITERATIONS: dict[Trainer, int] = {"levenberg-marquardt": 60, "adam": 400}
NARX_ITERATIONS = 25


@dataclass(frozen=True, eq=False)
class TrainedTwin:
    """A model with everything that is known about it. parameters: (fans, 3)."""

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
    command_unit: str = "",
    data: Sequence[DataCard] = (),
    created: datetime | None = None,
    progress: Progress | None = None,
) -> TrainedTwin:
    """Build a twin of healthy runs.

    validation_runs: held out of the fit; they choose the best weights and give the healthy sigma and the card's
    figures. Empty: the training runs do, and the card says so. network_inputs: of the hybrid's and neural ODE's
    network. command_unit, data, created (default: now) go into the card. The same seed and runs give the same model.
    Raises TwinError when the runs do not tell the parameters, or the result cannot serve as a twin.
    """
    _require_known(kind, trainer)
    fans = common_fans([*runs, *validation_runs])
    started_s = time.monotonic()
    identification = identify(runs)
    limit = max_iterations or (NARX_ITERATIONS if kind == "narx" else DEFAULT_ITERATIONS[trainer])
    model, iterations = _train(
        kind, runs, validation_runs, identification, seed, trainer, limit, network_inputs, progress
    )
    duration_s = time.monotonic() - started_s
    judged = validation_runs or runs
    residual = free_run_residuals(model, identification.parameters, evaluation_pieces(judged))
    sigma_rad_s = healthy_sigma_rad_s(residual)
    if not np.all(np.isfinite(sigma_rad_s)):
        raise TwinError(
            f"the {kind} model of {name!r} diverges when run freely; record more levels, or try another kind"
        )
    validation = evaluate_model(model, identification.parameters, sigma_rad_s, judged)
    speeds = np.concatenate([run.speed_rad_s.ravel() for run in runs])
    commands = np.concatenate([run.command.ravel() for run in runs])
    card = Card(
        kind=kind,
        name=name,
        created=(created or datetime.now(UTC)).isoformat(timespec="seconds"),
        fans=fans,
        n_state=model.state_layout.size,
        state_layout=model.state_layout,
        parameter_names=PARAMETER_NAMES,
        parameters=_rows(identification.parameters),
        parameter_std_errors=_rows(identification.standard_errors),
        sigma_rad_s=tuple(sigma_rad_s.tolist()),
        speed_range_rad_s=(float(np.nanmin(speeds)), float(np.nanmax(speeds))),
        command_range=(float(commands.min()), float(commands.max())),
        rate_hz=1.0 / float(np.median(np.concatenate([np.diff(run.t_s) for run in runs]))),
        network=_network_card(model),
        training=TrainingCard(trainer, seed, iterations, round(duration_s, 3), tuple(data)),
        validation=_validation_card(validation.pooled, "held-out" if validation_runs else "training"),
        versions=_versions(),
        command_unit=command_unit,
    )
    return TrainedTwin(model, identification.parameters, card, identification, validation)


def evaluate(twin: str | Path | OnnxTwin | TrainedTwin, runs: Sequence[Run]) -> Evaluation:
    """Figures of a twin, or of its file, on runs.

    A twin of one fan serves any number of fans. Raises TwinError when the fan counts differ otherwise.
    """
    loaded = OnnxTwin(twin) if isinstance(twin, str | Path) else twin
    model = loaded if isinstance(loaded, OnnxTwin) else loaded.model
    fans, known = common_fans(runs), loaded.card.fans
    if known not in (1, fans):
        raise TwinError(
            f"twin {loaded.card.name!r} is of {known} fans, the runs of {fans}; select the fans, or retrain"
        )
    parameters = np.broadcast_to(loaded.parameters, (fans, len(PARAMETER_NAMES)))
    sigma_rad_s = np.broadcast_to(np.array(loaded.card.sigma_rad_s), (fans,))
    return evaluate_model(model, parameters, sigma_rad_s, runs)


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
    progress: Progress | None,
) -> tuple[Model, int]:
    if kind == "physical":
        return PhysicalModel(), identification.iterations
    scaling = data_scaling(runs, identification)
    if kind == "narx":
        return train_narx(runs, validation_runs, scaling, seed=seed, max_iterations=max_iterations, progress=progress)
    units = NETWORK_UNITS[kind]
    network = TanhNetwork.zero(units, network_inputs, scaling)
    untrained: NetworkOde = Hybrid(network) if kind == "hybrid" else NeuralOde(network)
    start = initial_weights(untrained, runs, identification, np.random.default_rng(seed))
    if trainer == "adam":
        # torch is needed by this trainer alone, and takes seconds to import.
        from twin.torch_reference import train_adam  # noqa: PLC0415

        return train_adam(start, runs, identification, max_iterations=max_iterations, progress=progress)
    return train_network(start, runs, validation_runs, identification, max_iterations=max_iterations, progress=progress)


def _network_card(model: Model) -> NetworkCard:
    if isinstance(model, PhysicalModel):
        return NetworkCard(units=0, inputs=(), parameter_count=0)
    if isinstance(model, Narx):
        return NetworkCard(units=NARX_UNITS, inputs=("speed", "command"), parameter_count=PARAMETER_COUNT)
    return NetworkCard(model.network.units, model.network.inputs, model.network.parameter_count)


def _validation_card(figures: Figures, source: Literal["held-out", "training"]) -> ValidationCard:
    def finite(value: float) -> float | None:
        return value if np.isfinite(value) else None

    return ValidationCard(
        source=source,
        samples=figures.samples,
        rmse=finite(figures.rmse_rad_s),
        max_error=finite(figures.max_error_rad_s),
        r2=finite(figures.r2),
        one_step_rmse=finite(figures.one_step_rmse_rad_s),
        coverage_2_sigma=finite(figures.coverage_2_sigma),
    )


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
