"""From measured runs to a twin: identify, train, finish; and a twin on other runs."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import get_args

import numpy as np

from fantwin.schemas.twin_card import DataCard, TrainingCard, TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import (
    Evaluation,
    FigureSums,
    UnseenStd,
    compared_readings,
    evaluation_pieces,
    free_run_residuals,
    sums_of_model,
)
from fantwin.twin.export.fan_rows import drive_of_fans, fan_rows, measured_as_in_card
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.finishing import TrainedTwin, finish_twin, unseen_std_of
from fantwin.twin.fitting.drive_fit import find_drive
from fantwin.twin.fitting.identification import identify
from fantwin.twin.fitting.model_fits import FitRequest, Trainer
from fantwin.twin.fitting.model_uncertainty import model_uncertainty
from fantwin.twin.fitting.reference_choice import AtReference, behind_a_drive, identify_at_reference
from fantwin.twin.fitting.standstill import find_standstill
from fantwin.twin.fitting.static_fit import StaticFit, as_read, static_at_reference, static_instead
from fantwin.twin.fitting.training import MOST_NETWORKS
from fantwin.twin.kinds import ModelKind, find_kind
from fantwin.twin.models.fan_ode import NetworkOde
from fantwin.twin.models.model import Model
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.models.static import StaticModel
from fantwin.twin.network_training import ForEachNetwork, one_after_another
from fantwin.twin.progress import Progress, unreported, within
from fantwin.twin.reference import at_reference
from fantwin.twin.runs import Array, Run, common_fans, common_tacho


def train_twin(
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    kind: str,
    *,
    name: str,
    seed: int = 0,
    trainer: Trainer = "levenberg-marquardt",
    max_iterations: int | None = None,
    networks: int = 1,
    each_network: ForEachNetwork = one_after_another,
    command_unit: str = "",
    fan_numbers: Sequence[int] | None = None,
    fan_names: Sequence[str] = (),
    data: Sequence[DataCard] = (),
    validation_data: Sequence[DataCard] = (),
    created: datetime | None = None,
    progress: Progress = unreported,
) -> TrainedTwin:
    """Build a twin of healthy runs.

    validation_runs: held out of the fit; they choose the best weights and give the healthy sigmas and the card's
    figures. If empty, the training runs are used instead, and the card says so. networks: how many are trained and
    averaged, 1 to MOST_NETWORKS. trainer "adam" trains one, keeps the physics as identified, and keeps the weights with
    the smallest training error. each_network: runs their trainings.
    fan_numbers and fan_names (what the recordings call the runs' fans; default: counted from 0), command_unit, data and
    validation_data (the files that the runs are from) and created (default: now) go into the card. The same seed and
    runs give the same model.
    Raises TwinError when the runs do not determine the parameters, are not measured alike, or the result cannot serve
    as a twin.
    """
    model_kind = find_kind(kind)
    _require_possible(model_kind, trainer, networks)
    fans = common_fans([*runs, *validation_runs])
    numbers = tuple(range(fans) if fan_numbers is None else fan_numbers)
    started_s = time.monotonic()
    found, static = _identified(model_kind, runs, validation_runs, progress)
    if static is not None:
        model_kind = find_kind(static.model.kind)
    if model_kind.predicts == "readings":
        runs, validation_runs = as_read(runs), as_read(validation_runs)
    tacho = common_tacho([*runs, *validation_runs])
    conditions, identification, notes = found.conditions, found.identification, found.notes
    recorded, validation_recorded = at_reference(runs, None), at_reference(validation_runs, None)
    runs, validation_runs = at_reference(runs, conditions), at_reference(validation_runs, conditions)
    standstill = find_standstill([*recorded, *validation_recorded])
    drive = None
    if model_kind.knows_drives:
        drive = find_drive(recorded, validation_recorded, identification, standstill, progress)
    if drive is not None:  # how a fan that controls its own speed depends on its supply is not known
        conditions, runs, validation_runs, notes = None, recorded, validation_recorded, behind_a_drive(found)
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
            progress,
            drive,
            networks,
            each_network,
            static,
        )
    )
    model, parameters = fitted.model, fitted.parameters
    duration_s = time.monotonic() - started_s
    identification = replace(identification, warnings=(*notes, *identification.warnings, *fitted.warnings))
    uncertainty = None
    if isinstance(model, NetworkOde) and model.has_physics:
        progress("uncertainty", 0, 0, np.nan)
        commanded, of_physics = drive.raised(runs) if drive else runs, parameters[:, : len(PARAMETER_NAMES)]
        friction = drive.friction if drive else np.zeros(fans)
        uncertainty = model_uncertainty(model, of_physics, commanded, acting, friction, identification)
    physics = "refined" if fitted.is_refined else "fixed"
    training = TrainingCard(
        trainer=trainer,
        physics=physics,
        seed=seed,
        iterations=fitted.iterations,
        duration_s=round(duration_s, 3),
        data=tuple(data),
        fans=numbers,
        networks=networks,
        fan_names=tuple(fan_names) if any(fan_names) else (),
    )
    return finish_twin(
        model,
        parameters,
        identification,
        runs,
        validation_runs,
        name=name,
        training=training,
        drive=drive,
        static=static,
        uncertainty=uncertainty,
        standstill=standstill,
        conditions=conditions,
        tacho=tacho,
        validation_data=validation_data,
        command_unit=command_unit,
        created=created,
        progress=progress,
    )


def _identified(
    kind: ModelKind, runs: Sequence[Run], validation_runs: Sequence[Run], progress: Progress
) -> tuple[AtReference, StaticFit | None]:
    """The physics of every fan; or the static model where that is wanted, or samples are too far apart for motion.

    Raises TwinError when the data do not determine them.
    """
    if kind.name == StaticModel.kind:
        return static_at_reference(runs, validation_runs)
    if kind.predicts == "readings":
        runs, validation_runs = as_read(runs), as_read(validation_runs)
    try:
        found = identify_at_reference(runs, validation_runs, progress=progress)
    except TwinError:
        if (static := static_instead(runs, validation_runs, None)) is None:
            raise
        return static
    return static_instead(runs, validation_runs, found) or (found, None)


@dataclass(frozen=True, eq=False)
class RunsOfTwin:
    """A twin and runs of fans that it knows. rows: of its card, one for each fan. runs: with the tachos of the card, at
    its reference conditions.
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
        unseen_std=unseen_std_of(table.of_fans(rows) if table else None, drive_of_fans(card, rows)),
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


def _require_possible(kind: ModelKind, trainer: str, networks: int) -> None:
    """Raise TwinError where the trainer cannot train the kind, or so many networks of it."""
    if trainer not in get_args(Trainer):
        raise TwinError(f"trainer {trainer!r} is unknown; use one of {', '.join(get_args(Trainer))}")
    if trainer == "adam" and not kind.has_ode_network:
        raise TwinError(f"trainer {trainer!r} cannot train the {kind.name} model; use levenberg-marquardt")
    if not 1 <= networks <= MOST_NETWORKS:
        raise TwinError(f"{networks} networks cannot be averaged; ask for 1 to {MOST_NETWORKS}")
    if networks > 1 and (trainer == "adam" or not kind.has_ode_network):
        raise TwinError(
            f"several networks cannot be averaged with model {kind.name} and trainer {trainer}; use the hybrid or the "
            "neural ODE, with trainer levenberg-marquardt"
        )
