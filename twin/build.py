"""From measured runs to a twin with its card: identify, train, validate, export."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from schemas.model_uncertainty import ModelUncertainty
from schemas.standstill import Standstill
from schemas.tacho import INSTANTANEOUS
from schemas.twin_card import (
    BalanceCard,
    DataCard,
    DriveCard,
    Four,
    HealthyCard,
    TrainingCard,
    TwinCard,
    ValidationCard,
)
from twin.errors import TwinError
from twin.evaluation.accuracy import (
    Evaluation,
    Figures,
    FigureSums,
    UnseenStd,
    compared_readings,
    evaluate_model,
    evaluation_pieces,
    free_run_residuals,
    sums_of_model,
)
from twin.evaluation.reading_range import reading_sigma_rad_s
from twin.evaluation.residual_analysis import QUANTILES, HealthyResidual, healthy_residual
from twin.export.fan_rows import drive_of_fans, fan_rows, measured_as_in_card
from twin.export.onnx_export import export_onnx
from twin.export.onnx_twin import OnnxTwin
from twin.fitting.balance import FILTER_RATE_PER_S
from twin.fitting.balance_fit import BalanceFit, fit_balance
from twin.fitting.drive_fit import find_drive
from twin.fitting.identification import Identification, identify
from twin.fitting.model_fits import FitRequest, Trainer
from twin.fitting.model_uncertainty import model_uncertainty
from twin.fitting.standstill import find_standstill
from twin.fitting.training import MOST_NETWORKS, Physics
from twin.kinds import BOTH_INPUTS, ModelKind, find_kind
from twin.models.drive import DRIVE_PARAMETERS
from twin.models.model import Model
from twin.models.network_ode import NetworkOde
from twin.models.physics import PARAMETER_NAMES
from twin.progress import Progress, unreported, within
from twin.runs import Array, Run, common_fans, common_tacho


@dataclass(frozen=True, eq=False)
class TrainedTwin:
    """A trained model with its identification and validation. parameters: (fans, 4), behind a drive (fans, 7)."""

    model: Model
    parameters: Array
    card: TwinCard
    identification: Identification
    validation: Evaluation

    def save(self, path: str | Path) -> Path:
        """Write the ONNX file; returns its path. Raises TwinError when it cannot be written."""
        target = Path(path)
        try:
            target.write_bytes(export_onnx(self.model, self.card))
        except OSError as error:
            raise TwinError(f"{target}: cannot be written ({error.strerror}); choose another path") from error
        return target


def train_twin(
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    kind: str,
    *,
    name: str,
    seed: int = 0,
    trainer: Trainer = "levenberg-marquardt",
    max_iterations: int | None = None,
    network_inputs: tuple[str, ...] = BOTH_INPUTS,
    physics: Physics = "refined",
    networks: int = 1,
    command_unit: str = "",
    fan_numbers: Sequence[int] | None = None,
    data: Sequence[DataCard] = (),
    validation_data: Sequence[DataCard] = (),
    created: datetime | None = None,
    progress: Progress = unreported,
) -> TrainedTwin:
    """Build a twin of healthy runs.

    validation_runs: held out of the fit; they choose the best weights and give the healthy sigmas and the card's
    figures. If empty, the training runs are used instead, and the card says so. network_inputs: of the hybrid's and
    neural ODE's network. physics: whether a hybrid's physics are refined along with its network, or stay as they were
    identified. networks: how many are trained and averaged, 1 to MOST_NETWORKS. trainer "adam" trains one, keeps the
    physics as identified, and keeps the weights with the smallest training error.
    fan_numbers (what the recordings call the runs' fans; default: counted from 0), command_unit, data and
    validation_data (the files that the runs are from) and created (default: now) go into the card. The same seed and
    runs give the same model.
    Raises TwinError when the runs do not determine the parameters, are not measured alike, or the result cannot serve
    as a twin.
    """
    model_kind = find_kind(kind)
    _require_trainer(model_kind, trainer)
    _require_networks(model_kind, trainer, networks)
    fans = common_fans([*runs, *validation_runs])
    numbers = tuple(range(fans) if fan_numbers is None else fan_numbers)
    if model_kind.predicts == "readings":
        runs, validation_runs = _as_if_instantaneous(runs), _as_if_instantaneous(validation_runs)
    tacho = common_tacho([*runs, *validation_runs])
    started_s = time.monotonic()
    identification = identify(runs, progress=progress)
    standstill = find_standstill([*runs, *validation_runs])
    drive = find_drive(runs, validation_runs, identification, standstill, progress) if model_kind.knows_drives else None
    acting, validation_acting = runs, validation_runs
    if drive is not None:
        acting, validation_acting = drive.driven(runs), drive.driven(validation_runs)
        identification = identify(acting, progress=within("behind the drive", progress))
    fitted = model_kind.fit(
        FitRequest(
            acting,
            validation_acting,
            identification,
            seed,
            trainer,
            max_iterations,
            network_inputs,
            physics,
            progress,
            drive,
            networks,
        )
    )
    model, parameters = fitted.model, fitted.parameters
    duration_s = time.monotonic() - started_s
    identification = replace(identification, warnings=(*identification.warnings, *fitted.warnings))
    judged = validation_runs or runs
    progress("evaluation", 0, 0, np.nan)
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
    uncertainty = None
    if isinstance(model, NetworkOde) and model.has_physics:
        commanded = drive.raised(runs) if drive else runs
        of_physics = parameters[:, : len(PARAMETER_NAMES)]
        uncertainty = model_uncertainty(model, of_physics, commanded, acting, identification)
    unseen_std = _unseen_std(uncertainty, drive.card if drive else None)
    validation = evaluate_model(model, parameters, sigma_rad_s, judged, unseen_std)
    progress("torque balance", 0, 0, np.nan)
    if drive is None:
        balance = fit_balance(runs, validation_runs, identification)
    else:
        balance = fit_balance(drive.raised(runs), drive.raised(validation_runs), identification)
    settings = drive.settings if drive else np.zeros((fans, 0))
    speeds = np.concatenate([run.speed_rad_s.ravel() for run in runs])
    commands = np.concatenate([run.command.ravel() for run in runs])
    card = TwinCard(
        kind=kind,
        name=name,
        created=(created or datetime.now(UTC)).isoformat(timespec="seconds"),
        fans=fans,
        n_state=model.state_layout.size,
        state_layout=model.state_layout,
        fixed_rate=model.fixed_rate,
        parameter_names=(*PARAMETER_NAMES, *(DRIVE_PARAMETERS if drive else ())),
        used_parameters=(*model.used_parameters, *(DRIVE_PARAMETERS if drive else ())),
        parameters=_rows(parameters),
        identified_parameters=_rows(np.hstack((identification.parameters, settings))),
        parameter_std_errors=_rows(np.hstack((identification.standard_errors, np.zeros_like(settings)))),
        parameter_interval_95=tuple(
            tuple((float(low), float(high)) for low, high in fan)
            for fan in np.concatenate((identification.interval_95, np.stack((settings, settings), axis=-1)), axis=1)
        ),
        sigma_rad_s=healthy.sigma_rad_s,
        healthy=_healthy_card(healthy),
        balance=_balance_card(balance),
        speed_range_rad_s=(float(np.nanmin(speeds)), float(np.nanmax(speeds))),
        command_range=(float(commands.min()), float(commands.max())),
        rate_hz=1.0 / float(np.median(np.concatenate([np.diff(run.t_s) for run in runs]))),
        network=model.network_card,
        training=TrainingCard(
            trainer, fitted.physics, seed, fitted.iterations, round(duration_s, 3), tuple(data), numbers, networks
        ),
        validation=_validation_card(
            validation.pooled, "held-out" if validation_runs else "training", tuple(validation_data)
        ),
        versions=_versions(),
        command_unit=command_unit,
        tacho=tacho[:1] if len(set(tacho)) == 1 else tacho,
        standstill=standstill,
        drive=drive.card if drive else None,
        reading_sigma_rad_s=_reading_sigma_rad_s(model, parameters, sigma_rad_s, standstill, pieces),
        model_uncertainty=uncertainty,
    )
    return TrainedTwin(model, parameters, card, identification, validation)


@dataclass(frozen=True, eq=False)
class RunsOfTwin:
    """A twin and runs of fans that it knows. rows: of its card, one for each fan. runs: with the tachos of the card.
    parameters: (fans, 4), behind a drive (fans, 7). unseen_std: what widens the band where the twin was not trained."""

    model: OnnxTwin | Model
    card: TwinCard
    rows: list[int]
    runs: list[Run]
    parameters: Array
    sigma_rad_s: Array
    unseen_std: UnseenStd | None


def runs_of_twin(
    twin: OnnxTwin | TrainedTwin, runs: Sequence[Run], fan_numbers: Sequence[int] | None = None
) -> RunsOfTwin:
    """The runs as those of a twin's fans.

    fan_numbers: what the recordings call the runs' fans, as in fan_rows. A twin of one fan serves any. Raises TwinError
    when the fans do not fit.
    """
    card = twin.card
    rows = fan_rows(card, common_fans(runs), fan_numbers)
    table = card.model_uncertainty
    return RunsOfTwin(
        model=twin if isinstance(twin, OnnxTwin) else twin.model,
        card=card,
        rows=rows,
        runs=measured_as_in_card(card, rows, runs),
        parameters=twin.parameters[rows],
        sigma_rad_s=np.array(card.sigma_rad_s)[rows],
        unseen_std=_unseen_std(table.of_fans(rows) if table else None, drive_of_fans(card, rows)),
    )


def evaluate(
    twin: str | Path | OnnxTwin | TrainedTwin, runs: Sequence[Run], fan_numbers: Sequence[int] | None = None
) -> Evaluation:
    """Figures of a twin, or of its file, on runs. fan_numbers, and what is raised: as for runs_of_twin."""
    return evaluation_sums(twin, runs, fan_numbers).evaluation()


def evaluation_sums(
    twin: str | Path | OnnxTwin | TrainedTwin, runs: Sequence[Run], fan_numbers: Sequence[int] | None = None
) -> FigureSums:
    """What the figures are made of, to be added to that of other runs. Arguments and errors as of evaluate."""
    of = runs_of_twin(OnnxTwin(twin) if isinstance(twin, str | Path) else twin, runs, fan_numbers)
    return sums_of_model(of.model, of.parameters, of.sigma_rad_s, of.runs, of.unseen_std)


def free_run_of(twin: OnnxTwin, runs: Sequence[Run]) -> tuple[Array, Array, Array]:
    """Residual of the free run and measured speed, rad/s, and command: (samples, fans) each, over runs of its fans.

    NaN where nothing can be compared. Raises TwinError when the fans do not fit.
    """
    rows = fan_rows(twin.card, common_fans(runs))
    pieces = evaluation_pieces(measured_as_in_card(twin.card, rows, runs))
    residual = free_run_residuals(twin, twin.parameters[rows], pieces)
    measured = np.concatenate([compared_readings(piece) for piece in pieces])
    return residual, measured, np.concatenate([piece.command for piece in pieces])


def _unseen_std(table: ModelUncertainty | None, drive: DriveCard | None) -> UnseenStd | None:
    if table is None:
        return None
    return lambda speed_rad_s, command: table.unseen_std_at(speed_rad_s, drive.raised(command) if drive else command)


def _reading_sigma_rad_s(
    model: Model, parameters: Array, sigma_rad_s: Array, standstill: Standstill | None, pieces: Sequence[Run]
) -> tuple[float, ...]:
    if all(tacho.window_s == 0.0 for tacho in pieces[0].tacho):
        return ()
    return tuple(reading_sigma_rad_s(model, parameters, sigma_rad_s, standstill, pieces).tolist())


def _as_if_instantaneous(runs: Sequence[Run]) -> list[Run]:
    """The runs for a model whose output is compared with the readings as they are."""
    return [replace(run, tacho=INSTANTANEOUS) for run in runs]


def _require_trainer(kind: ModelKind, trainer: str) -> None:
    if trainer not in get_args(Trainer):
        raise TwinError(f"trainer {trainer!r} is unknown; use one of {', '.join(get_args(Trainer))}")
    if trainer not in kind.trainers:
        raise TwinError(f"trainer {trainer!r} cannot train the {kind.name} model; use {' or '.join(kind.trainers)}")


def _require_networks(kind: ModelKind, trainer: str, networks: int) -> None:
    if not 1 <= networks <= MOST_NETWORKS:
        raise TwinError(f"{networks} networks cannot be averaged; ask for 1 to {MOST_NETWORKS}")
    if networks > 1 and not (kind.averages_networks and trainer == "levenberg-marquardt"):
        raise TwinError(
            f"several networks cannot be averaged with model {kind.name} and trainer {trainer}; use the hybrid or the "
            "neural ODE, with trainer levenberg-marquardt"
        )


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
        covariance=tuple(map(_square, balance.covariance)),
        lag_s=tuple(balance.lag_s.tolist()),
        source=balance.sources,
        sigma_command=tuple(balance.sigma_command.tolist()),
        autocorrelation_time_s=tuple(balance.autocorrelation_time_s.tolist()),
        lowest_speed_rad_s=tuple(balance.lowest_speed_rad_s.tolist()),
        filter_rate_per_s=FILTER_RATE_PER_S,
    )


def _square(matrix: Array) -> tuple[Four, Four, Four, Four]:
    first, second, third, fourth = _fours(matrix)
    return first, second, third, fourth


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
