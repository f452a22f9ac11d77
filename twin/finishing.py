"""From a fitted model to a twin with its card: band, uncertainty, torque balance, and figures on healthy runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import reduce
from importlib.metadata import PackageNotFoundError, version
from operator import add
from pathlib import Path

import numpy as np

from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.schemas.reference_conditions import ReferenceConditions
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.twin_card import DataCard, DriveCard, TrainingCard, TwinCard, ValidationCard
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import (
    Evaluation,
    UnseenStd,
    compared_readings,
    evaluation_pieces,
    figure_sums,
    free_run_of_piece,
)
from fantwin.twin.evaluation.reading_range import reading_sigma_rad_s
from fantwin.twin.evaluation.residual_analysis import finite_or_none, healthy_residual
from fantwin.twin.export.onnx_export import export_onnx
from fantwin.twin.fitting.balance_fit import fit_balance
from fantwin.twin.fitting.drive_fit import FoundDrive
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.fitting.static_fit import StaticFit, typical_error_rad_s
from fantwin.twin.models.drive import DRIVE_PARAMETERS
from fantwin.twin.models.model import Model
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.progress import Progress
from fantwin.twin.runs import Array, Run


@dataclass(frozen=True, eq=False)
class TrainedTwin:
    """A trained model with its identification and validation. parameters: (fans, 4), behind a drive (fans, 7)."""

    model: Model
    parameters: Array
    card: TwinCard
    identification: Identification
    validation: Evaluation

    def onnx(self) -> bytes:
        """The ONNX file."""
        return export_onnx(self.model, self.card)

    def save(self, path: Path) -> Path:
        """Write the ONNX file; return its path. Raises OSError where it cannot be written."""
        path.write_bytes(self.onnx())
        return path


def finish_twin(
    model: Model,
    parameters: Array,
    identification: Identification,
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    *,
    name: str,
    training: TrainingCard,
    drive: FoundDrive | None,
    static: StaticFit | None = None,
    uncertainty: ModelUncertainty | None,
    standstill: Standstill | None,
    conditions: ReferenceConditions | None,
    tacho: tuple[Tacho, ...],
    validation_data: Sequence[DataCard],
    command_unit: str,
    created: datetime | None,
    progress: Progress,
) -> TrainedTwin:
    """The twin of a fitted model. parameters: (fans, 4), behind a drive (fans, 7). runs: healthy ones that it was
    fitted to, at the conditions. The other arguments are those of build.train_twin.

    Raises TwinError when a fan was never measured, the free run diverges, or a balance never moves.
    """
    judged = validation_runs or runs
    progress("evaluation", 0, 0, np.nan)
    pieces = evaluation_pieces(judged)
    free_runs = [free_run_of_piece(model, parameters, piece) for piece in pieces]
    sigma_rad_s, healthy = healthy_residual(np.concatenate([each.residual_rad_s for each in free_runs]), pieces)
    if static is not None:  # what it misses right after a change of the command, it is expected to miss
        sigma_rad_s = typical_error_rad_s([compared_readings(each.piece) - each.expected_rad_s for each in free_runs])
    unmeasured = np.flatnonzero(sigma_rad_s == 0.0)
    if unmeasured.size:
        where = "held-out" if validation_runs else "training"
        raise TwinError(
            f"fan {unmeasured[0]}: no measured speed in the {where} runs, so no band; give runs in which it was "
            "measured, or leave it out"
        )
    if not np.all(np.isfinite(sigma_rad_s)):
        raise TwinError(
            f"the {model.kind} model of {name!r} diverges when run freely; record more levels, or try another kind"
        )
    unseen_std = unseen_std_of(uncertainty, drive.card if drive else None)
    sums = (figure_sums(model, parameters, sigma_rad_s, each, unseen_std) for each in free_runs)
    validation = reduce(add, sums).evaluation()
    progress("torque balance", 0, 0, np.nan)
    if static is not None:
        balance = static.balance
    elif drive is None:
        balance = fit_balance(runs, validation_runs, identification)
    else:
        balance = fit_balance(drive.raised(runs), drive.raised(validation_runs), identification)
    settings = drive.settings if drive else np.zeros((len(parameters), 0))
    figures = validation.pooled
    counts = any(its.window_s > 0.0 for its in pieces[0].tacho)
    speeds = np.concatenate([run.speed_rad_s.ravel() for run in runs])
    commands = np.concatenate([run.command.ravel() for run in runs])
    card = TwinCard(
        kind=model.kind,
        name=name,
        created=(created or datetime.now(UTC)).isoformat(timespec="seconds"),
        fans=len(parameters),
        n_state=model.state_layout.size,
        state_layout=model.state_layout,
        fixed_rate=model.fixed_rate,
        parameter_names=model.used_parameters if static else (*PARAMETER_NAMES, *(DRIVE_PARAMETERS if drive else ())),
        used_parameters=(*model.used_parameters, *(DRIVE_PARAMETERS if drive else ())),
        parameters=_rows(parameters),
        identified_parameters=_rows(np.hstack((identification.parameters, settings))),
        parameter_interval_95=tuple(
            tuple((float(low), float(high)) for low, high in fan)
            for fan in np.concatenate((identification.interval_95, np.stack((settings, settings), axis=-1)), axis=1)
        ),
        sigma_rad_s=tuple(sigma_rad_s.tolist()),
        healthy=healthy,
        balance=balance,
        speed_range_rad_s=(float(np.nanmin(speeds)), float(np.nanmax(speeds))),
        command_range=(float(commands.min()), float(commands.max())),
        rate_hz=1.0 / float(np.median(np.concatenate([np.diff(run.t_s) for run in runs]))),
        network=model.network_card,
        training=training,
        validation=ValidationCard(
            source="held-out" if validation_runs else "training",
            data=tuple(validation_data),
            samples=figures.samples,
            rmse=finite_or_none(figures.rmse_rad_s),
            max_error=finite_or_none(figures.max_error_rad_s),
            r2=finite_or_none(figures.r2),
            one_step_rmse=finite_or_none(figures.one_step_rmse_rad_s),
            coverage_2_sigma=finite_or_none(figures.coverage_2_sigma),
        ),
        versions={package: _version(package) for package in ("fantwin", "numpy", "onnx")},
        command_unit=command_unit,
        tacho=tacho[:1] if len(set(tacho)) == 1 else tacho,
        standstill=standstill,
        conditions=conditions,
        closed_loop=tuple(identification.closed_loop.tolist()),
        drive=drive.card if drive else None,
        reading_sigma_rad_s=tuple(
            reading_sigma_rad_s(model, parameters, sigma_rad_s, standstill, pieces).tolist() if counts else ()
        ),
        model_uncertainty=uncertainty,
        steady_commands=tuple(static.model.knots.tolist()) if static else (),
    )
    return TrainedTwin(model, parameters, card, identification, validation)


def unseen_std_of(table: ModelUncertainty | None, drive: DriveCard | None) -> UnseenStd | None:
    """The standard deviation of the unseen error by speed and command; None without a table."""
    if table is None:
        return None
    return lambda speed_rad_s, command: table.unseen_std_at(speed_rad_s, drive.raised(command) if drive else command)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        # Run from a checkout that was never installed.
        return "unknown"


def _rows(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in values.tolist())
