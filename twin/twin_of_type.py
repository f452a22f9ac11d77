"""A twin of fans of a known type, from the twin of other fans of the type and a few minutes of their own running."""

import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from fantwin.schemas.twin_card import DataCard, TrainingCard, TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.export.onnx_twin import OnnxTwin, stored_ode
from fantwin.twin.finishing import TrainedTwin, finish_twin
from fantwin.twin.fitting.drive_fit import FoundDrive
from fantwin.twin.fitting.fans_of_a_type import place_fans
from fantwin.twin.fitting.model_uncertainty import placed_uncertainty
from fantwin.twin.fitting.standstill import find_standstill
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.progress import Progress, unreported
from fantwin.twin.reference import at_reference
from fantwin.twin.runs import Array, Run, common_fans, common_tacho


def place_twin(
    type_twin: Path,
    runs: Sequence[Run],
    validation_runs: Sequence[Run],
    *,
    name: str,
    fan_numbers: Sequence[int] | None = None,
    fan_names: Sequence[str] = (),
    data: Sequence[DataCard] = (),
    validation_data: Sequence[DataCard] = (),
    created: datetime | None = None,
    progress: Progress = unreported,
) -> TrainedTwin:
    """A twin of the fans of healthy runs. type_twin: file of a hybrid of other fans of the same type.

    Its network and drive are those of the type; each fan gets physics of its own (twin.fitting.fans_of_a_type). The
    other arguments are those of build.train_twin.
    Raises TwinError when the twin is no hybrid, the tachos differ, or a fan has hardly any readings.
    """
    card = OnnxTwin(type_twin).card
    model = stored_ode(type_twin, type_twin.read_bytes(), card)
    if not isinstance(model, Hybrid):
        raise TwinError(f"{type_twin}: a {card.kind} twin has no physics beside a network; give a hybrid")
    tacho = common_tacho([*runs, *validation_runs])
    strange = [fan for fan, each in enumerate(tacho) if each not in card.tacho]
    if strange:
        raise TwinError(
            f"fan {strange[0]}: measured by {tacho[strange[0]]}, and the fans of {card.name!r} by {card.tacho[0]}: "
            "train a twin of fans that are measured as these are"
        )
    started_s = time.monotonic()
    fans = common_fans([*runs, *validation_runs])
    drive = _typical_drive(model, card, fans)
    standstill = find_standstill([*runs, *validation_runs]) or card.standstill
    runs, validation_runs = at_reference(runs, card.conditions), at_reference(validation_runs, card.conditions)
    acting = drive.driven(runs) if drive else runs
    identification, of_unknowns = place_fans(model.network, card, acting, _correlated_samples(card, runs), progress)
    uncertainty = None
    if card.model_uncertainty:
        friction = drive.friction if drive else np.zeros(fans)
        top_speed_rad_s = float(identification.top_speed_rad_s[0])
        uncertainty = placed_uncertainty(
            card.model_uncertainty, model, identification.parameters, of_unknowns, top_speed_rad_s, friction
        )
    numbers = tuple(range(fans) if fan_numbers is None else fan_numbers)
    training = TrainingCard(
        card.training.trainer,
        "refined",
        card.training.seed,
        identification.iterations,
        round(time.monotonic() - started_s, 3),
        tuple(data),
        numbers,
        card.training.networks,
        of_type=card.name,
        fan_names=tuple(fan_names) if any(fan_names) else (),
    )
    return finish_twin(
        model,
        np.hstack((identification.parameters, drive.settings)) if drive else identification.parameters,
        identification,
        runs,
        validation_runs,
        name=name,
        training=training,
        drive=drive,
        uncertainty=uncertainty,
        standstill=standstill,
        conditions=card.conditions,
        tacho=tacho,
        validation_data=validation_data,
        command_unit=card.command_unit,
        created=created,
        progress=progress,
    )


def _typical_drive(model: Hybrid, card: TwinCard, fans: int) -> FoundDrive | None:
    """The drive of the type, with the median of its settings for each fan."""
    if model.drive is None:
        return None
    settings: Array = np.median(np.array(card.parameters)[:, len(PARAMETER_NAMES) :], axis=0)
    return FoundDrive(model.drive, np.tile(settings, (fans, 1)))


def _correlated_samples(card: TwinCard, runs: Sequence[Run]) -> float:
    """So many samples of the residual of a healthy fan of the type count as one."""
    known_s = [each for each in card.healthy.autocorrelation_time_s if each is not None]
    period_s = float(np.median([run.median_period_s for run in runs]))
    return max(1.0, 2.0 * float(np.median(known_s)) / period_s) if known_s else 1.0
